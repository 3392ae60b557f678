//! Messages about objects: their outlines, places and figures, and where the table lies at the robot.
//!
//! Poses are in metres, as the viewer takes them; figures in JSON are in millimetres and degrees, named in the keys.

use foxglove::messages::{
    Color, FrameTransform, FrameTransforms, ImageAnnotations, Point2, PointsAnnotation, Pose as FoxglovePose,
    PosesInFrame, Quaternion, TextAnnotation, Vector3, points_annotation,
};
use samsod::shadow::ObjectRegion;
use samsod_camera::nalgebra::Isometry3;
use serde::Serialize;

use super::messages::{ROBOT_BASE, colour, timestamp};
use crate::picture::region_colour;
use crate::place::{Place, PlanePose};

/// Frame of reference of the table.
const WORLD: &str = "world";
/// Height of the text beside an object, px.
const FONT_SIZE: f64 = 14.0;

/// Outlines of the objects, with their numbers and places, for an overlay on the image.
pub(super) fn outlines(timestamp_ns: u64, objects: &[ObjectRegion], places: &[Option<Place>]) -> ImageAnnotations {
    let mut annotations = ImageAnnotations { timestamp: Some(timestamp(timestamp_ns)), ..Default::default() };
    for (id, object) in objects.iter().enumerate() {
        let colour = colour(region_colour(id));
        for outline in std::iter::once(&object.outline).chain(&object.holes) {
            annotations.points.push(PointsAnnotation {
                timestamp: annotations.timestamp,
                r#type: points_annotation::Type::LineLoop.into(),
                points: outline.iter().map(|&[x, y]| Point2 { x: x.into(), y: y.into() }).collect(),
                outline_color: Some(colour),
                thickness: 2.0,
                ..Default::default()
            });
        }
        let bbox = object.mask.bbox();
        annotations.texts.push(TextAnnotation {
            timestamp: annotations.timestamp,
            // Below the object: the name of its region stands above. The position is that of the lower left corner.
            position: Some(Point2 { x: bbox.x.into(), y: f64::from(bbox.bottom()) + FONT_SIZE + 4.0 }),
            text: name(id, object, places.get(id).copied().flatten().as_ref()),
            font_size: FONT_SIZE,
            text_color: Some(colour),
            background_color: Some(Color { r: 0.0, g: 0.0, b: 0.0, a: 0.6 }),
            ..Default::default()
        });
    }
    annotations
}

fn name(id: usize, object: &ObjectRegion, place: Option<&Place>) -> String {
    match place {
        Some(Place { world: PlanePose { x_mm, y_mm, yaw_deg, .. }, .. }) => {
            format!("object {id}: ({x_mm:.1}, {y_mm:.1}) mm, {yaw_deg:.0}\u{b0}")
        }
        None => format!("object {id}: {} px", object.area),
    }
}

/// Where the objects lie on the table, in metres, in their order; those without a place are left out.
pub(super) fn places(timestamp_ns: u64, places: &[Option<Place>]) -> PosesInFrame {
    let pose = |at: &PlanePose| FoxglovePose {
        position: Some(metres([at.x_mm, at.y_mm, at.z_mm])),
        orientation: Some({
            let (z, w) = (at.yaw_deg.to_radians() / 2.0).sin_cos();
            Quaternion { x: 0.0, y: 0.0, z, w }
        }),
    };
    PosesInFrame {
        timestamp: Some(timestamp(timestamp_ns)),
        frame_id: WORLD.to_string(),
        poses: places.iter().flatten().map(|place| pose(&place.world)).collect(),
    }
}

/// Where the table lies at the robot, so that a viewer can show places and targets together.
pub(super) fn transforms(timestamp_ns: u64, base_from_world: &Isometry3<f64>) -> FrameTransforms {
    let turn = &base_from_world.rotation.coords;
    FrameTransforms {
        transforms: vec![FrameTransform {
            timestamp: Some(timestamp(timestamp_ns)),
            parent_frame_id: ROBOT_BASE.to_string(),
            child_frame_id: WORLD.to_string(),
            translation: Some(metres(base_from_world.translation.vector.into())),
            rotation: Some(Quaternion { x: turn.x, y: turn.y, z: turn.z, w: turn.w }),
        }],
    }
}

fn metres([x, y, z]: [f64; 3]) -> Vector3 {
    Vector3 { x: x / 1000.0, y: y / 1000.0, z: z / 1000.0 }
}

/// One object of a scene.
#[derive(Debug, Serialize)]
pub(crate) struct ObjectMessage {
    id: usize,
    region: usize,
    area_px: u32,
    centroid_px: [f32; 2],
    #[serde(rename = "box")]
    oriented_box: BoxMessage,
    /// Longer and shorter side of the box on the plane of the objects.
    size_mm: Option<[f64; 2]>,
    world: Option<PlanePose>,
    base: Option<PlanePose>,
}

#[derive(Debug, Serialize)]
struct BoxMessage {
    center_px: [f32; 2],
    length_px: f32,
    width_px: f32,
    angle_deg: f32,
}

impl ObjectMessage {
    /// Object `id` of its scene.
    pub(crate) fn new(id: usize, object: &ObjectRegion, place: Option<&Place>) -> Self {
        let found = &object.oriented_box;
        Self {
            id,
            region: object.region,
            area_px: object.area,
            centroid_px: object.centroid,
            oriented_box: BoxMessage {
                center_px: found.center_px,
                length_px: found.length_px,
                width_px: found.width_px,
                // Adding 0 makes -0 a 0.
                angle_deg: found.angle_rad.to_degrees() + 0.0,
            },
            size_mm: place.map(|place| place.size_mm),
            world: place.map(|place| place.world),
            base: place.and_then(|place| place.base),
        }
    }

    /// All objects of a scene. `places` has a place, or none, for each of them, or is empty.
    pub(crate) fn all(objects: &[ObjectRegion], places: &[Option<Place>]) -> Vec<Self> {
        let message = |(id, object)| Self::new(id, object, places.get(id).and_then(Option::as_ref));
        objects.iter().enumerate().map(message).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use samsod_camera::nalgebra::Vector3 as V;

    #[test]
    fn poses_are_in_metres_turned_about_z_and_only_of_what_has_a_place() {
        let world = PlanePose { x_mm: 120.0, y_mm: -45.0, z_mm: 12.0, yaw_deg: 90.0 };
        let found = places(1_500_000_000, &[None, Some(Place { world, base: None, size_mm: [1.0; 2] })]);
        assert_eq!((found.frame_id.as_str(), found.poses.len()), ("world", 1));
        let pose = found.poses[0];
        assert_eq!(pose.position.unwrap(), Vector3 { x: 0.12, y: -0.045, z: 0.012 });
        let turn = pose.orientation.unwrap();
        assert!((turn.z - 0.5f64.sqrt()).abs() < 1e-12 && (turn.w - 0.5f64.sqrt()).abs() < 1e-12, "{turn:?}");
    }

    #[test]
    fn the_table_lies_at_the_robot_where_the_camera_file_says() {
        let found = transforms(0, &Isometry3::new(V::new(400.0, -120.0, 15.0), V::z() * std::f64::consts::PI));
        let frame = &found.transforms[0];
        assert_eq!((frame.parent_frame_id.as_str(), frame.child_frame_id.as_str()), ("robot_base", "world"));
        assert_eq!(frame.translation.unwrap(), Vector3 { x: 0.4, y: -0.12, z: 0.015 });
        assert!((frame.rotation.unwrap().z.abs() - 1.0).abs() < 1e-12);
    }
}
