//! From the objects of a scene to the one that the robot is sent to.
//!
//! The rule: the object with the most pixels among those whose place at the robot is known; of equal ones the first. The
//! gripper points down over its centroid at safe height, its x axis along the longer side of the object's box.

use samsod::shadow::ObjectRegion;

use crate::place::Place;

/// What the robot does next.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Pick {
    /// Index of the object in its scene.
    pub(crate) object: usize,
    /// Where it lies.
    pub(crate) place: Place,
}

/// The object that is picked. `places` has a place, or none, for each of `objects`.
pub(crate) fn best_object(objects: &[ObjectRegion], places: &[Option<Place>]) -> Option<Pick> {
    let at_robot = |place: &Option<Place>| place.filter(|place| place.base.is_some());
    let placed = objects.iter().zip(places).enumerate();
    let placed = placed.filter_map(|(i, (object, place))| Some((object.area, i, at_robot(place)?)));
    let best = placed.max_by(|(a, i, _), (b, j, _)| a.cmp(b).then(j.cmp(i)))?;
    Some(Pick { object: best.1, place: best.2 })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::place::PlanePose;
    use samsod::shadow::{Mask, MaskRun, OrientedBox};

    fn object(area: u32) -> ObjectRegion {
        ObjectRegion {
            region: 0,
            mask: Mask::from_runs(&[MaskRun { y: 0, start: 0, end: 1 }]).unwrap(),
            shadow: None,
            outline: Vec::new(),
            holes: Vec::new(),
            area,
            centroid: [0.0; 2],
            oriented_box: OrientedBox { center_px: [0.0; 2], length_px: 1.0, width_px: 1.0, angle_rad: 0.0 },
            axis_rad: 0.0,
        }
    }

    fn place(x_mm: f64, at_robot: bool) -> Option<Place> {
        let world = PlanePose { x_mm, y_mm: 0.0, z_mm: 0.0, yaw_deg: 0.0 };
        Some(Place { world, base: at_robot.then_some(world), size_mm: [1.0; 2] })
    }

    #[test]
    fn the_largest_that_has_a_place_at_the_robot_then_the_first() {
        let picked = |areas: &[u32], places: &[Option<Place>]| {
            let objects: Vec<_> = areas.iter().map(|&area| object(area)).collect();
            best_object(&objects, places).map(|pick| (pick.object, pick.place.world.x_mm))
        };
        assert_eq!(picked(&[], &[]), None);
        assert_eq!(picked(&[5, 9, 7], &[place(1.0, true), place(2.0, true), place(3.0, true)]), Some((1, 2.0)));
        assert_eq!(picked(&[5, 9, 9], &[place(1.0, true), place(2.0, true), place(3.0, true)]), Some((1, 2.0)));
        assert_eq!(picked(&[5, 9, 7], &[place(1.0, true), None, place(3.0, true)]), Some((2, 3.0)));
        // Placed on the table, but nobody knows where the robot stands.
        assert_eq!(picked(&[5, 9], &[place(1.0, false), place(2.0, false)]), None);
        assert_eq!(picked(&[5, 9], &[]), None);
    }
}
