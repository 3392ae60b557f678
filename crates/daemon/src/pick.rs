//! From a scene to the one thing that the robot is sent to.
//!
//! Without a catalogue: the object with the most pixels among those whose place at the robot is known; of equal ones the
//! first. The gripper points down over its centroid, its x axis along the longer side of the object's box.
//!
//! With a catalogue: the part with the highest score among those that were recognised and have a place; of equal ones the
//! first. The gripper points down over its grasp, as the catalogue says. Nothing unknown is gone to.
//!
//! What lies outside the region of interest is never picked.

use samsod::recognize::{Catalogue, Detection};
use samsod::shadow::ObjectRegion;
use samsod_camera::nalgebra::Isometry3;

use crate::place::{Place, PlanePose};

/// What the robot does next.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Pick {
    /// Index of the object in its scene, of a part of the first that it covers.
    pub(crate) object: Option<usize>,
    /// Index of the detection in its scene, in a cell with a catalogue.
    pub(crate) detection: Option<usize>,
    /// Point of the table (x, y) over which it is gripped, mm.
    pub(crate) at_mm: [f64; 2],
    /// Direction of the gripper's x axis in the base frame of the robot, degrees.
    pub(crate) base_yaw_deg: f64,
}

/// The object that is picked. `places` has a place, or none, for each of `objects`; `is_inside` says whether the region of
/// interest has the object of an index.
pub(crate) fn best_object(
    objects: &[ObjectRegion],
    places: &[Option<Place>],
    is_inside: impl Fn(usize) -> bool,
) -> Option<Pick> {
    let at_robot = |place: &Option<Place>| place.and_then(|place| Some((place.world, place.base?)));
    let placed = objects.iter().zip(places).enumerate().filter(|(i, _)| is_inside(*i));
    let placed = placed.filter_map(|(i, (object, place))| Some((object.area, i, at_robot(place)?)));
    let (_, object, (world, base)) = placed.max_by(|(a, i, _), (b, j, _)| a.cmp(b).then(j.cmp(i)))?;
    Some(Pick { object: Some(object), detection: None, at_mm: [world.x_mm, world.y_mm], base_yaw_deg: base.yaw_deg })
}

/// The part that is picked. `is_inside` says whether the region of interest has the detection of an index.
pub(crate) fn best_part(
    detections: &[Detection],
    catalogue: &Catalogue,
    base_from_world: &Isometry3<f64>,
    is_inside: impl Fn(usize) -> bool,
) -> Option<Pick> {
    let inside = detections.iter().enumerate().filter(|(i, _)| is_inside(*i));
    let known = inside.filter_map(|(i, detection)| {
        let part = catalogue.part(detection.name.as_deref()?)?;
        Some((i, detection, detection.world?, &part.grasp))
    });
    let best = known.max_by(|(i, a, ..), (j, b, ..)| a.score.total_cmp(&b.score).then(j.cmp(i)))?;
    let (index, detection, pose, grasp) = best;
    let (sin, cos) = pose.yaw_rad.sin_cos();
    let [along, across] = grasp.offset_mm;
    let at_mm = [pose.x_mm + along * cos - across * sin, pose.y_mm + along * sin + across * cos];
    let [x_mm, y_mm] = at_mm;
    let gripper = PlanePose { x_mm, y_mm, z_mm: 0.0, yaw_deg: (pose.yaw_rad + grasp.angle_rad).to_degrees() };
    Some(Pick {
        object: detection.objects.first().copied(),
        detection: Some(index),
        at_mm,
        base_yaw_deg: gripper.moved(base_from_world).yaw_deg,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use samsod::recognize::{ImagePose, Method, WorldPose};
    use samsod::shadow::{Mask, MaskRun, OrientedBox};
    use samsod_camera::nalgebra::Vector3;

    fn mask() -> Mask {
        Mask::from_runs(&[MaskRun { y: 0, start: 0, end: 1 }]).unwrap()
    }

    fn object(area: u32) -> ObjectRegion {
        ObjectRegion {
            region: 0,
            mask: mask(),
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
            best_object(&objects, places, |_| true).map(|pick| (pick.object.unwrap(), pick.at_mm[0]))
        };
        assert_eq!(picked(&[], &[]), None);
        assert_eq!(picked(&[5, 9, 7], &[place(1.0, true), place(2.0, true), place(3.0, true)]), Some((1, 2.0)));
        assert_eq!(picked(&[5, 9, 9], &[place(1.0, true), place(2.0, true), place(3.0, true)]), Some((1, 2.0)));
        assert_eq!(picked(&[5, 9, 7], &[place(1.0, true), None, place(3.0, true)]), Some((2, 3.0)));
        // Placed on the table, but nobody knows where the robot stands.
        assert_eq!(picked(&[5, 9], &[place(1.0, false), place(2.0, false)]), None);
        assert_eq!(picked(&[5, 9], &[]), None);
        let (objects, places) = ([object(5), object(9)], [place(1.0, true), place(2.0, true)]);
        let inside = best_object(&objects, &places, |i| i == 0).unwrap();
        assert_eq!(inside.object, Some(0), "the larger one lies outside");
    }

    fn detection(name: Option<&str>, score: f32, world: Option<[f64; 2]>) -> Detection {
        Detection {
            region: 0,
            objects: vec![3],
            name: name.map(str::to_owned),
            method: Method::Shape,
            score,
            margin: 0.1,
            image: ImagePose { origin_px: [0.0; 2], angle_rad: 0.0 },
            world: world.map(|[x_mm, y_mm]| WorldPose { x_mm, y_mm, yaw_rad: 90f64.to_radians(), height_mm: 20.0 }),
            mask: mask(),
        }
    }

    #[test]
    fn the_part_with_the_best_score_is_gripped_where_the_catalogue_says_and_nothing_unknown() {
        let folder = tempfile::tempdir().unwrap();
        let bundled = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/data/parts/hex_nut");
        let nut = folder.path().join("hex_nut");
        std::fs::create_dir(&nut).unwrap();
        for entry in std::fs::read_dir(bundled).unwrap() {
            let path = entry.unwrap().path();
            std::fs::copy(&path, nut.join(path.file_name().unwrap())).unwrap();
        }
        let text = std::fs::read_to_string(nut.join("part.toml")).unwrap();
        let text = text.replace("grasp_offset_mm = [0.0, 0.0]", "grasp_offset_mm = [5.0, 1.0]");
        let text = text.replace("grasp_angle_deg = 0.0", "grasp_angle_deg = 30.0");
        std::fs::write(nut.join("part.toml"), text).unwrap();
        let catalogue = Catalogue::read(folder.path()).unwrap();
        // The robot is turned by 10 degrees against the table.
        let base_from_world = Isometry3::new(Vector3::new(400.0, 0.0, 15.0), Vector3::z() * 10f64.to_radians());
        let best = |detections: &[Detection]| best_part(detections, &catalogue, &base_from_world, |_| true);
        let nut = |score, world| detection(Some("hex_nut"), score, world);
        assert_eq!(best(&[detection(None, 0.99, Some([0.0; 2])), nut(0.9, None)]), None);
        let pick = best(&[
            detection(None, 0.99, Some([0.0; 2])),
            nut(0.6, Some([1.0, 1.0])),
            nut(0.8, Some([100.0, 50.0])),
            nut(0.8, Some([2.0, 2.0])),
        ])
        .unwrap();
        assert_eq!((pick.object, pick.detection), (Some(3), Some(2)));
        // The part is turned by 90 degrees: 5 mm along it are 5 mm along y.
        assert!((pick.at_mm[0] - 99.0).abs() < 1e-9 && (pick.at_mm[1] - 55.0).abs() < 1e-9, "{pick:?}");
        assert!((pick.base_yaw_deg - 130.0).abs() < 1e-9, "{pick:?}");
        let outside = [nut(0.6, Some([1.0, 1.0])), nut(0.8, Some([100.0, 50.0]))];
        let pick = best_part(&outside, &catalogue, &base_from_world, |i| i == 0).unwrap();
        assert_eq!(pick.detection, Some(0), "the better one lies outside");
    }
}
