//! From the regions of a scene to the pose that the robot is sent to.
//!
//! Input: salient regions in pixels and the overhead view. Output: the region to pick and a pose above it, in mm.
//!
//! The rule: the region with the largest mean saliency; of equal ones the larger, then the first. The gripper points
//! down over its centroid at safe height, its x axis along the longest axis of the region.

use samsod::saliency::SalientRegion;
use samsod_robot::Pose;

use crate::config::ViewConfig;

/// The region that is picked, by its index.
pub(crate) fn best_region(regions: &[SalientRegion]) -> Option<usize> {
    let rank = |i: &usize, j: &usize| {
        let (a, b) = (&regions[*i], &regions[*j]);
        a.mean_saliency.total_cmp(&b.mean_saliency).then(a.area.cmp(&b.area)).then(j.cmp(i))
    };
    (0..regions.len()).max_by(rank)
}

/// The pose above a region: gripper down, at `height_mm`.
pub(crate) fn pose_above(region: &SalientRegion, view: &ViewConfig, height_mm: f64) -> Pose {
    let [u, v] = region.centroid.map(f64::from);
    let [x_mm, y_mm] = view.table_from_image(u, v);
    // The view has no rotation: counter-clockwise on the screen is counter-clockwise from above.
    Pose::gripper_down(x_mm, y_mm, height_mm, f64::from(region.axis_rad))
}

#[cfg(test)]
mod tests {
    use super::*;
    use samsod::segment::BoundingBox;

    fn region(mean_saliency: f32, area: u32) -> SalientRegion {
        SalientRegion {
            partitions: vec![0],
            area,
            bbox: BoundingBox { x: 0, y: 0, width: 1, height: 1 },
            centroid: [30.0, 10.0],
            axis_rad: 0.5,
            mean_saliency,
        }
    }

    #[test]
    fn the_most_salient_then_the_largest_then_the_first() {
        assert_eq!(best_region(&[]), None);
        assert_eq!(best_region(&[region(0.2, 9), region(0.3, 1), region(0.1, 99)]), Some(1));
        assert_eq!(best_region(&[region(0.3, 1), region(0.3, 2), region(0.3, 2)]), Some(1));
    }

    #[test]
    fn image_up_is_table_y_and_image_right_is_table_x() {
        let view = ViewConfig { mm_per_px: 2.0, origin_px: [20.0, 15.0] };
        let pose = pose_above(&region(1.0, 1), &view, 300.0);
        assert_eq!((pose.x_mm, pose.y_mm, pose.z_mm), (20.0, 10.0, 300.0));
        assert!((pose.angle_rad(&Pose::gripper_down(0.0, 0.0, 0.0, 0.5))).abs() < 1e-6);
    }
}
