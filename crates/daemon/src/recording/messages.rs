//! Topics, their schemas, and the messages on them.
//!
//! Images, annotations, poses and log lines use the protobuf messages that Foxglove publishes, so that its viewer and any
//! MCAP reader show them with no work; small messages of our own are JSON with a JSON schema.
//!
//! Units: pixels with pixel centres at integers; milliseconds, millimetres and degrees in JSON (named in the keys);
//! metres and quaternions in Foxglove's pose, because its viewer takes them so.

use foxglove::Encode;
use foxglove::bytes::Bytes;
use foxglove::messages::{
    Color, CompressedImage, FrameTransforms, ImageAnnotations, Log, Point2, PointsAnnotation, Pose as FoxglovePose,
    PoseInFrame, PosesInFrame, Quaternion, RawImage, TextAnnotation, Timestamp, Vector3, log, points_annotation,
};
use image::Rgb;
use samsod::saliency::SalientRegion;
use samsod_robot::{Command, CommandId, Outcome, Phase, Pose, RobotState};
use serde::Serialize;

use super::detections::DetectionMessage;
use super::objects::ObjectMessage;
use crate::picture::{Outline, region_colour};

/// Frame of reference of robot poses.
pub(super) const ROBOT_BASE: &str = "robot_base";

/// A topic of a recording; the discriminant is its index in the tables of a writer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub(super) enum Topic {
    Image,
    Labels,
    Saliency,
    Regions,
    Detections,
    Masks,
    Outlines,
    Places,
    Transforms,
    Scene,
    PickTarget,
    Command,
    Outcome,
    RobotState,
    Pick,
    Fault,
    Wire,
    Timings,
    Log,
}

/// How the messages of a topic are described in the file.
pub(super) struct Description {
    pub(super) topic: Topic,
    pub(super) name: &'static str,
    pub(super) message_encoding: &'static str,
    pub(super) schema: foxglove::Schema,
}

pub(super) const IMAGE: &str = "/camera/image";
pub(super) const LABELS: &str = "/segment/labels";
pub(super) const SALIENCY: &str = "/saliency";
pub(super) const REGIONS: &str = "/regions";
pub(super) const DETECTIONS: &str = "/detections";
pub(super) const MASKS: &str = "/masks";
pub(super) const OUTLINES: &str = "/outlines";
pub(super) const PLACES: &str = "/places";
pub(super) const TRANSFORMS: &str = "/tf";
pub(super) const SCENE: &str = "/scene";
pub(super) const COMMAND: &str = "/robot/command";
pub(super) const OUTCOME: &str = "/robot/outcome";
pub(super) const PICK: &str = "/robot/pick";
pub(super) const FAULT: &str = "/robot/fault";
pub(super) const WIRE: &str = "/robot/wire";
pub(super) const TIMINGS: &str = "/stage/timings";

/// All topics, in the order of [`Topic`]; `compressed_image` says which message carries the camera image.
pub(super) fn descriptions(compressed_image: bool) -> Vec<Description> {
    fn of<M: Encode>(topic: Topic, name: &'static str) -> Option<Description> {
        Some(Description { topic, name, message_encoding: "protobuf", schema: M::get_schema()? })
    }
    fn json(topic: Topic, name: &'static str, schema_name: &str, schema: &'static str) -> Option<Description> {
        let schema = foxglove::Schema::new(schema_name, "jsonschema", schema.as_bytes());
        Some(Description { topic, name, message_encoding: "json", schema })
    }
    let image =
        if compressed_image { of::<CompressedImage>(Topic::Image, IMAGE) } else { of::<RawImage>(Topic::Image, IMAGE) };
    [
        image,
        of::<RawImage>(Topic::Labels, LABELS),
        of::<RawImage>(Topic::Saliency, SALIENCY),
        of::<ImageAnnotations>(Topic::Regions, REGIONS),
        of::<ImageAnnotations>(Topic::Detections, DETECTIONS),
        of::<RawImage>(Topic::Masks, MASKS),
        of::<ImageAnnotations>(Topic::Outlines, OUTLINES),
        of::<PosesInFrame>(Topic::Places, PLACES),
        of::<FrameTransforms>(Topic::Transforms, TRANSFORMS),
        json(Topic::Scene, SCENE, "samsod.Scene", SCENE_SCHEMA),
        of::<PoseInFrame>(Topic::PickTarget, "/pick/target"),
        json(Topic::Command, COMMAND, "samsod.Command", COMMAND_SCHEMA),
        json(Topic::Outcome, OUTCOME, "samsod.Outcome", OUTCOME_SCHEMA),
        json(Topic::RobotState, "/robot/state", "samsod.RobotState", ROBOT_STATE_SCHEMA),
        json(Topic::Pick, PICK, "samsod.Pick", PICK_SCHEMA),
        json(Topic::Fault, FAULT, "samsod.Fault", FAULT_SCHEMA),
        json(Topic::Wire, WIRE, "samsod.Wire", WIRE_SCHEMA),
        json(Topic::Timings, TIMINGS, "samsod.StageTimings", TIMINGS_SCHEMA),
        of::<Log>(Topic::Log, "/log"),
    ]
    .into_iter()
    .flatten()
    .collect()
}

const SCENE_SCHEMA: &str = r#"{
  "title": "samsod.Scene", "type": "object",
  "description": "What one frame showed. Pixel coordinates: x right, y down, pixel centres at integers.",
  "properties": {
    "sequence": {"type": "integer"}, "camera": {"type": "string"},
    "width_px": {"type": "integer"}, "height_px": {"type": "integer"},
    "partitions": {"type": "integer", "description": "number of proto-object partitions"},
    "regions": {"type": "array", "items": {"type": "object", "properties": {
      "id": {"type": "integer", "description": "index in this scene, largest region first"},
      "area_px": {"type": "integer"}, "mean_saliency": {"type": "number", "description": "0 to 1"},
      "x_px": {"type": "integer"}, "y_px": {"type": "integer"},
      "width_px": {"type": "integer"}, "height_px": {"type": "integer"},
      "centroid_px": {"type": "array", "items": {"type": "number"}},
      "axis_deg": {"type": "number", "description": "longest axis, counter-clockwise from image right"},
      "partitions": {"type": "array", "items": {"type": "integer"}, "description": "their labels"}}}},
    "objects": {"type": "array", "items": {"type": "object", "properties": {
      "id": {"type": "integer", "description": "index in this scene; /masks and /outlines count alike"},
      "region": {"type": "integer", "description": "id of its region"}, "area_px": {"type": "integer"},
      "centroid_px": {"type": "array", "items": {"type": "number"}},
      "box": {"type": "object", "description": "smallest rectangle round it", "properties": {
        "center_px": {"type": "array", "items": {"type": "number"}},
        "length_px": {"type": "number"}, "width_px": {"type": "number"},
        "angle_deg": {"type": "number", "description": "longer side, counter-clockwise from image right"}}},
      "size_mm": {"type": ["array", "null"], "items": {"type": "number"}, "description": "length and width of the box"},
      "world": {"type": ["object", "null"], "description": "place of the centroid, the table is z = 0", "properties": {
        "x_mm": {"type": "number"}, "y_mm": {"type": "number"}, "z_mm": {"type": "number"},
        "yaw_deg": {"type": "number", "description": "longer side about z, counter-clockwise from above, (-90, 90]"}}},
      "base": {"type": ["object", "null"], "description": "as world, in the base frame of the robot"}}}},
    "detections": {"type": "array", "description": "what the objects are; empty without a catalogue",
     "items": {"type": "object", "properties": {
      "id": {"type": "integer", "description": "index in this scene; /detections counts alike"},
      "name": {"type": ["string", "null"], "description": "of the part; null of something unknown"},
      "score": {"type": "number", "description": "0 to 1; of something unknown that of the part that came closest"},
      "margin": {"type": "number", "description": "score less that of the next best part"},
      "method": {"type": "string", "enum": ["sift", "shape"]},
      "region": {"type": "integer"}, "objects": {"type": "array", "items": {"type": "integer"}},
      "area_px": {"type": "integer"},
      "image": {"type": "object", "properties": {
        "origin_px": {"type": "array", "items": {"type": "number"}, "description": "origin of the part, at its height"},
        "angle_deg": {"type": "number", "description": "x axis of the part, counter-clockwise from image right"}}},
      "height_mm": {"type": ["number", "null"]},
      "world": {"type": ["object", "null"], "description": "origin of the part on the table, z = 0", "properties": {
        "x_mm": {"type": "number"}, "y_mm": {"type": "number"}, "z_mm": {"type": "number"},
        "yaw_deg": {"type": "number", "description": "about z, counter-clockwise from above, (-180, 180]"}}},
      "base": {"type": ["object", "null"], "description": "as world, in the base frame of the robot"}}}}}}"#;

const COMMAND_SCHEMA: &str = r#"{
  "title": "samsod.Command", "type": "object",
  "description": "A command, written before it is sent. Poses are base_from_tool, R = Rz Ry Rx.",
  "properties": {
    "id": {"type": "integer"}, "frame_sequence": {"type": ["integer", "null"]},
    "frame_timestamp_ns": {"type": ["integer", "null"], "description": "frame that the command follows from"},
    "phase": {"type": ["string", "null"], "description": "step of the pick-and-place sequence"},
    "part": {"type": ["string", "null"], "description": "part that is being handled"},
    "command": {"type": "string", "enum": ["move", "gripper", "hold"]},
    "motion": {"type": "string", "enum": ["joint", "linear"]},
    "target": {"type": "object"}, "speed_mm_s": {"type": "number"}, "speed_fraction": {"type": "number"},
    "gripper": {"type": "string", "enum": ["open", "close"]}, "on": {"type": "boolean"}}}"#;

const OUTCOME_SCHEMA: &str = r#"{
  "title": "samsod.Outcome", "type": "object", "description": "What became known of a command.",
  "properties": {
    "id": {"type": "integer"},
    "outcome": {"type": "string", "enum": ["not_executed", "accepted", "done", "aborted", "unknown"]},
    "reason": {"description": "text, or for aborted an object with kind and figures"}}}"#;

const ROBOT_STATE_SCHEMA: &str = r#"{
  "title": "samsod.RobotState", "type": "object", "description": "Status and position, read together.",
  "properties": {"status": {"type": "object"},
    "position": {"type": "object", "description": "base_from_tool", "properties": {
      "x_mm": {"type": "number"}, "y_mm": {"type": "number"}, "z_mm": {"type": "number"},
      "rx_deg": {"type": "number"}, "ry_deg": {"type": "number"}, "rz_deg": {"type": "number"}}}}}"#;

const PICK_SCHEMA: &str = r#"{
  "title": "samsod.Pick", "type": "object", "description": "What became of a pick.",
  "properties": {
    "slot": {"type": "integer", "description": "line of the assembly list, from 0"}, "part": {"type": "string"},
    "frame": {"type": "integer", "description": "sequence number of the frame in which it was seen"},
    "score": {"type": "number"},
    "gap_ms": {"type": "number", "description": "from the frame to its first command, on the clock of the robot"},
    "waited_ms": {"type": "number", "description": "time that the robot had stood for want of a frame"},
    "took_ms": {"type": "number", "description": "from the first command to the end of the last"},
    "result": {"type": "string", "enum": ["placed", "missed", "not_reached"]}, "reason": {"type": "string"}}}"#;

const FAULT_SCHEMA: &str = r#"{
  "title": "samsod.Fault", "type": "object", "description": "Why the robot stands until an operator resumes.",
  "properties": {
    "reason": {"type": "string"}, "phase": {"type": ["string", "null"]},
    "held_by": {"type": "string", "description": "who has asked that it stand, if it stands for that"},
    "holds": {"type": "object", "properties": {
      "gripper": {"type": "string", "enum": ["nothing", "perhaps", "part"]}, "part": {"type": "string"}}}}}"#;

const WIRE_SCHEMA: &str = r#"{
  "title": "samsod.Wire", "type": "object", "description": "Bytes between samsodd and the controller; those sent are written before they leave.",
  "properties": {
    "direction": {"type": "string", "enum": ["sent", "received"]},
    "bytes": {"type": "string", "description": "ASCII; other bytes, CR, LF and backslash as in C"}}}"#;

const TIMINGS_SCHEMA: &str = r#"{
  "title": "samsod.StageTimings", "type": "object",
  "description": "Wall-clock time of each stage of one frame, one key <stage>_ms a stage.",
  "properties": {
    "sequence": {"type": "integer"},
    "frames_dropped": {"type": "integer", "description": "frames that this recording has lost so far"},
    "segment_ms": {"type": "number"}, "saliency_ms": {"type": "number"}, "regions_ms": {"type": "number"},
    "shadow_ms": {"type": "number"}, "recognize_ms": {"type": "number"},
    "total_ms": {"type": "number", "description": "from the frame in hand to its scene and order handed on; without a measurement the sum of the vision stages"}},
  "additionalProperties": {"type": "number"}}"#;

/// Foxglove's timestamp; it counts seconds in 32 bits, which end in 2106.
pub(super) fn timestamp(ns: u64) -> Timestamp {
    let sec = u32::try_from(ns / 1_000_000_000).unwrap_or(u32::MAX);
    Timestamp::new_checked(sec, (ns % 1_000_000_000) as u32).unwrap_or(Timestamp::MAX)
}

/// An image message whose pixels are taken from `data` and given back by [`take_back`].
pub(super) fn raw_image(
    timestamp_ns: u64,
    camera: &str,
    (width, height): (u32, u32),
    encoding: &str,
    bytes_per_pixel: u32,
    data: Vec<u8>,
) -> RawImage {
    RawImage {
        timestamp: Some(timestamp(timestamp_ns)),
        frame_id: camera.to_string(),
        width,
        height,
        encoding: encoding.to_string(),
        step: width * bytes_per_pixel,
        data: Bytes::from(data),
    }
}

/// A compressed image message; `format` is `png` or `jpeg`.
pub(super) fn compressed_image(timestamp_ns: u64, camera: &str, format: &str, data: Vec<u8>) -> CompressedImage {
    CompressedImage {
        timestamp: Some(timestamp(timestamp_ns)),
        frame_id: camera.to_string(),
        data: Bytes::from(data),
        format: format.to_string(),
    }
}

/// The buffer of a message that nobody else holds, without a copy.
pub(super) fn take_back(data: Bytes) -> Vec<u8> {
    Vec::from(data)
}

/// Outlines and names of the regions, for an overlay on the image.
pub(super) fn regions(timestamp_ns: u64, regions: &[(&SalientRegion, Vec<Outline>)]) -> ImageAnnotations {
    let mut annotations = ImageAnnotations { timestamp: Some(timestamp(timestamp_ns)), ..Default::default() };
    for (id, (region, outlines)) in regions.iter().enumerate() {
        let colour = colour(region_colour(id));
        for outline in outlines {
            annotations.points.push(PointsAnnotation {
                timestamp: annotations.timestamp,
                r#type: points_annotation::Type::LineLoop.into(),
                points: outline.iter().map(|&[x, y]| Point2 { x: x.into(), y: y.into() }).collect(),
                outline_color: Some(colour),
                thickness: 2.0,
                ..Default::default()
            });
        }
        annotations.texts.push(TextAnnotation {
            timestamp: annotations.timestamp,
            position: Some(Point2 { x: region.bbox.x.into(), y: region.bbox.y.into() }),
            text: format!("region {id}: S {:.3}, {} px", region.mean_saliency, region.area),
            font_size: 14.0,
            text_color: Some(colour),
            background_color: Some(Color { r: 0.0, g: 0.0, b: 0.0, a: 0.6 }),
            ..Default::default()
        });
    }
    annotations
}

/// As the viewer takes it, opaque.
pub(super) fn colour(Rgb([r, g, b]): Rgb<u8>) -> Color {
    Color { r: f64::from(r) / 255.0, g: f64::from(g) / 255.0, b: f64::from(b) / 255.0, a: 1.0 }
}

/// Where the tool is sent, in metres.
pub(super) fn pick_target(timestamp_ns: u64, pose: &Pose) -> PoseInFrame {
    let [x, y, z, w] = pose.quaternion_xyzw();
    PoseInFrame {
        timestamp: Some(timestamp(timestamp_ns)),
        frame_id: ROBOT_BASE.to_string(),
        pose: Some(FoxglovePose {
            position: Some(Vector3 { x: pose.x_mm / 1000.0, y: pose.y_mm / 1000.0, z: pose.z_mm / 1000.0 }),
            orientation: Some(Quaternion { x, y, z, w }),
        }),
    }
}

/// How grave a line of the log is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LogLevel {
    /// For those who look for a fault.
    Debug,
    /// The course of things.
    Info,
    /// Something went wrong and was made good.
    Warning,
    /// Something was lost or did not happen.
    Error,
}

/// A line of the log.
pub(super) fn log_line(timestamp_ns: u64, level: LogLevel, name: &str, text: &str) -> Log {
    let level = match level {
        LogLevel::Debug => log::Level::Debug,
        LogLevel::Info => log::Level::Info,
        LogLevel::Warning => log::Level::Warning,
        LogLevel::Error => log::Level::Error,
    };
    Log {
        timestamp: Some(timestamp(timestamp_ns)),
        level: level.into(),
        message: text.to_string(),
        name: name.to_string(),
        ..Default::default()
    }
}

/// `samsod.Command`.
#[derive(Serialize)]
pub(super) struct CommandMessage<'a> {
    pub(super) id: CommandId,
    pub(super) frame_sequence: Option<u64>,
    pub(super) frame_timestamp_ns: Option<u64>,
    pub(super) phase: Option<Phase>,
    pub(super) part: Option<&'a str>,
    #[serde(flatten)]
    pub(super) command: &'a Command,
}

/// `samsod.Outcome`.
#[derive(Serialize)]
pub(super) struct OutcomeMessage<'a> {
    pub(super) id: CommandId,
    #[serde(flatten)]
    pub(super) outcome: &'a Outcome,
}

/// `samsod.Wire`.
#[derive(Serialize)]
pub(super) struct WireMessage {
    pub(super) direction: &'static str,
    pub(super) bytes: String,
}

/// `samsod.RobotState`.
pub(super) type RobotStateMessage<'a> = &'a RobotState;

/// `samsod.Scene`; also what `samsod inspect` writes.
#[derive(Debug, Serialize)]
pub(crate) struct SceneMessage<'a> {
    pub(crate) sequence: u64,
    pub(crate) camera: &'a str,
    pub(crate) width_px: u32,
    pub(crate) height_px: u32,
    pub(crate) partitions: usize,
    pub(crate) regions: Vec<RegionMessage<'a>>,
    pub(crate) objects: Vec<ObjectMessage>,
    pub(crate) detections: Vec<DetectionMessage<'a>>,
}

/// One region of a [`SceneMessage`].
#[derive(Debug, Serialize)]
pub(crate) struct RegionMessage<'a> {
    id: usize,
    area_px: u32,
    mean_saliency: f32,
    x_px: u32,
    y_px: u32,
    width_px: u32,
    height_px: u32,
    centroid_px: [f32; 2],
    axis_deg: f32,
    partitions: &'a [u32],
}

impl<'a> RegionMessage<'a> {
    /// Region `id` of its scene.
    pub(crate) fn new(id: usize, region: &'a SalientRegion) -> Self {
        Self {
            id,
            area_px: region.area,
            mean_saliency: region.mean_saliency,
            x_px: region.bbox.x,
            y_px: region.bbox.y,
            width_px: region.bbox.width,
            height_px: region.bbox.height,
            centroid_px: region.centroid,
            axis_deg: region.axis_rad.to_degrees(),
            partitions: &region.partitions,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn topics_are_described_in_their_order_and_own_schemas_are_json() {
        for compressed in [false, true] {
            let described = descriptions(compressed);
            assert_eq!(described.len(), Topic::Log as usize + 1);
            for (i, description) in described.iter().enumerate() {
                assert_eq!(description.topic as usize, i, "{}", description.name);
                assert!(!description.schema.data.is_empty(), "{}", description.name);
                if description.message_encoding == "json" {
                    let schema: serde_json::Value = serde_json::from_slice(&description.schema.data).unwrap();
                    assert_eq!(schema["title"], description.schema.name.as_str());
                }
            }
        }
    }

    #[test]
    fn a_buffer_comes_back_without_a_copy() {
        let mut data = Vec::with_capacity(1000);
        data.extend_from_slice(&[7; 600]);
        let at = data.as_ptr();
        let image = raw_image(1, "camera", (10, 20), "rgb8", 3, data);
        let back = take_back(image.data);
        assert_eq!((back.as_ptr(), back.len()), (at, 600));
    }

    #[test]
    fn a_command_is_flat_json_in_millimetres_and_degrees() {
        let command = Command::Move(samsod_robot::Motion::Linear {
            target: Pose::gripper_down(400.0, 50.0, 120.0, 0.0),
            speed_mm_s: 80.0,
        });
        let message = CommandMessage {
            id: CommandId(3),
            frame_sequence: Some(9),
            frame_timestamp_ns: None,
            phase: Some(Phase::AboveSlot),
            part: Some("flange"),
            command: &command,
        };
        let json = serde_json::to_value(&message).unwrap();
        assert_eq!(json["command"], "move");
        assert_eq!(json["motion"], "linear");
        assert_eq!(json["target"]["rx_deg"], 180.0);
        assert_eq!(json["frame_sequence"], 9);
        assert_eq!((&json["phase"], &json["part"]), (&"above_slot".into(), &"flange".into()));
    }

    #[test]
    fn a_target_is_in_metres_and_its_quaternion_turns_the_gripper_down() {
        let target = pick_target(1_500_000_000, &Pose::gripper_down(400.0, 50.0, 120.0, 0.0));
        assert_eq!(target.timestamp, Some(Timestamp::new(1, 500_000_000)));
        let pose = target.pose.unwrap();
        assert_eq!(pose.position.unwrap(), Vector3 { x: 0.4, y: 0.05, z: 0.12 });
        assert!((pose.orientation.unwrap().x.abs() - 1.0).abs() < 1e-12);
    }
}
