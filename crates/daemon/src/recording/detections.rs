//! Messages about what the objects are: an overlay on the image, and figures.

use foxglove::messages::{Color, ImageAnnotations, Point2, PointsAnnotation, TextAnnotation, points_annotation};
use samsod::recognize::{Detection, Method};
use samsod_camera::nalgebra::Isometry3;
use serde::Serialize;

use super::messages::{colour, timestamp};
use crate::caption::{self, Arrow};
use crate::picture::{mask_outlines, region_colour};
use crate::place::PlanePose;

/// Height of the name of a part, px.
const FONT_SIZE: f64 = 16.0;

/// Outline, name, score and direction of every detection, for an overlay on the image.
pub(super) fn detections(timestamp_ns: u64, detections: &[Detection]) -> ImageAnnotations {
    let mut annotations = ImageAnnotations { timestamp: Some(timestamp(timestamp_ns)), ..Default::default() };
    for (id, detection) in detections.iter().enumerate() {
        let colour = colour(region_colour(id));
        let line = |kind: points_annotation::Type, points: Vec<Point2>| PointsAnnotation {
            timestamp: annotations.timestamp,
            r#type: kind.into(),
            points,
            outline_color: Some(colour),
            thickness: 2.0,
            ..Default::default()
        };
        let outlines = mask_outlines(&detection.mask).into_iter().map(|outline| {
            let points = outline.iter().map(|&[x, y]| Point2 { x: x.into(), y: y.into() });
            line(points_annotation::Type::LineLoop, points.collect())
        });
        let arrow = Arrow::of(detection).lines().into_iter().flatten().map(|[x, y]| Point2 { x, y });
        let arrow = line(points_annotation::Type::LineList, arrow.collect());
        let lines: Vec<_> = outlines.chain([arrow]).collect();
        annotations.points.extend(lines);
        let bbox = detection.mask.bbox();
        annotations.texts.push(TextAnnotation {
            timestamp: annotations.timestamp,
            // On the object: names of regions stand above it, numbers of objects below.
            position: Some(Point2 { x: bbox.x.into(), y: f64::from(bbox.y) + f64::from(bbox.height) / 2.0 }),
            text: caption::with_score(detection),
            font_size: FONT_SIZE,
            text_color: Some(colour),
            background_color: Some(Color { r: 0.0, g: 0.0, b: 0.0, a: 0.6 }),
            ..Default::default()
        });
    }
    annotations
}

/// One detection of a scene.
#[derive(Debug, Serialize)]
pub(crate) struct DetectionMessage<'a> {
    id: usize,
    /// None of something unknown.
    name: Option<&'a str>,
    score: f32,
    margin: f32,
    method: Method,
    region: usize,
    objects: &'a [usize],
    area_px: u32,
    image: ImagePoseMessage,
    height_mm: Option<f64>,
    world: Option<PlanePose>,
    base: Option<PlanePose>,
}

#[derive(Debug, Serialize)]
struct ImagePoseMessage {
    origin_px: [f64; 2],
    angle_deg: f64,
}

impl<'a> DetectionMessage<'a> {
    /// Detection `id` of its scene.
    fn new(id: usize, detection: &'a Detection, base_from_world: Option<&Isometry3<f64>>) -> Self {
        let world = world_pose(detection);
        Self {
            id,
            name: detection.name.as_deref(),
            score: detection.score,
            margin: detection.margin,
            method: detection.method,
            region: detection.region,
            objects: &detection.objects,
            area_px: detection.mask.area(),
            image: ImagePoseMessage {
                origin_px: detection.image.origin_px,
                angle_deg: detection.image.angle_rad.to_degrees() + 0.0,
            },
            height_mm: detection.world.map(|world| world.height_mm),
            world,
            base: world.zip(base_from_world).map(|(world, base_from_world)| world.moved(base_from_world)),
        }
    }

    /// The salient region that it lies in.
    pub(crate) fn region(&self) -> usize {
        self.region
    }

    /// All of a scene.
    ///
    /// # Arguments
    /// * `base_from_world` - pose of the table in the base frame of the robot, mm, if it is known
    pub(crate) fn all(detections: &'a [Detection], base_from_world: Option<&Isometry3<f64>>) -> Vec<Self> {
        let message = |(id, detection)| Self::new(id, detection, base_from_world);
        detections.iter().enumerate().map(message).collect()
    }
}

/// The origin of a part on the table.
fn world_pose(detection: &Detection) -> Option<PlanePose> {
    let world = detection.world?;
    // Adding 0 makes -0 a 0.
    let yaw_deg = world.yaw_rad.to_degrees() + 0.0;
    Some(PlanePose { x_mm: world.x_mm, y_mm: world.y_mm, z_mm: 0.0, yaw_deg })
}

#[cfg(test)]
mod tests {
    use super::*;
    use samsod::recognize::{ImagePose, WorldPose};
    use samsod::shadow::{Mask, MaskRun};
    use samsod_camera::nalgebra::Vector3;

    fn detection(name: Option<&str>) -> Detection {
        let rows: Vec<_> = (20..30).map(|y| MaskRun { y, start: 10, end: 40 }).collect();
        Detection {
            region: 1,
            objects: vec![2, 3],
            name: name.map(str::to_owned),
            method: Method::Sift,
            score: 0.75,
            margin: 0.25,
            image: ImagePose { origin_px: [25.0, 25.0], angle_rad: 90f64.to_radians() },
            world: name.map(|_| WorldPose { x_mm: 100.0, y_mm: 20.0, yaw_rad: -0.5, height_mm: 12.0 }),
            mask: Mask::from_runs(&rows).unwrap(),
        }
    }

    #[test]
    fn a_part_has_its_outline_an_arrow_along_its_axis_and_its_name() {
        let found = detections(7, &[detection(Some("flange")), detection(None)]);
        assert_eq!(
            found.texts.iter().map(|t| t.text.as_str()).collect::<Vec<_>>(),
            ["flange 0.75, 90\u{b0}", "unknown 0.75"]
        );
        assert_eq!(found.points.len(), 4, "two outlines, an arrow and a line");
        let outline = &found.points[0];
        assert_eq!(outline.r#type, i32::from(points_annotation::Type::LineLoop));
        assert_eq!(outline.points.len(), 2 * 30 + 2 * 8, "every pixel of the border");
        let arrow = &found.points[1];
        assert_eq!(arrow.r#type, i32::from(points_annotation::Type::LineList));
        assert_eq!(arrow.points.len(), 6, "shaft and two sides of the head");
        assert_eq!((arrow.points[0].x, arrow.points[0].y), (25.0, 25.0));
        assert!((arrow.points[1].x - 25.0).abs() < 1e-9 && arrow.points[1].y < 15.0, "up: {:?}", arrow.points[1]);
        assert_eq!(found.points[3].points.len(), 2, "an axis has no head");
    }

    #[test]
    fn figures_are_in_degrees_and_at_the_robot_too() {
        let base_from_world =
            Isometry3::new(Vector3::new(400.0, 0.0, 15.0), Vector3::z() * std::f64::consts::FRAC_PI_2);
        let found = [detection(Some("flange")), detection(None)];
        let json = serde_json::to_value(DetectionMessage::all(&found, Some(&base_from_world))).unwrap();
        let (part, unknown) = (&json[0], &json[1]);
        assert_eq!(
            (&part["name"], &part["method"], &part["objects"]),
            (&"flange".into(), &"sift".into(), &[2, 3][..].into())
        );
        assert_eq!((&part["area_px"], &part["height_mm"]), (&300.into(), &12.0.into()));
        assert!((part["image"]["angle_deg"].as_f64().unwrap() - 90.0).abs() < 1e-9, "{part}");
        assert!((part["world"]["yaw_deg"].as_f64().unwrap() + 0.5f64.to_degrees()).abs() < 1e-9, "{part}");
        // Turned by a right angle: x of the table is y of the robot.
        let at = |key: &str| part["base"][key].as_f64().unwrap();
        assert!((at("x_mm") - 380.0).abs() < 1e-9 && (at("y_mm") - 100.0).abs() < 1e-9, "{part}");
        assert!(
            (at("z_mm") - 15.0).abs() < 1e-9 && (at("yaw_deg") - 90.0 + 0.5f64.to_degrees()).abs() < 1e-9,
            "{part}"
        );
        assert!(unknown["name"].is_null() && unknown["world"].is_null() && unknown["base"].is_null(), "{unknown}");
    }
}
