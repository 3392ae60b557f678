//! Scenes for local clients: what the recording says of a frame, and what a client needs to act on it.
//!
//! In: a frame, its scene and places. Out: one JSON object in shared memory. A scene that is too large goes without its
//! smallest regions and what lies in them.

use std::time::Duration;

use samsod::Scene;
use samsod_camera::nalgebra::Isometry3;
use samsod_frame::{Frame, ScenePublisher, SendError, ServiceError};
use serde::Serialize;
use tracing::{error, warn};

use crate::config::Config;
use crate::pick::Pick;
use crate::place::Place;
use crate::recording::{DetectionMessage, ObjectMessage, RegionMessage, SceneMessage};

/// Publishes scenes; a scene that cannot be published costs nobody else anything.
pub(crate) struct SceneSender {
    publisher: ScenePublisher,
    /// Reused from scene to scene.
    json: Vec<u8>,
    max_bytes: usize,
    last_error: Option<SendError>,
}

/// What is known of a frame beside its scene.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Findings<'a> {
    /// The place, if it has one, of each object; empty when nothing is placed.
    pub(crate) places: &'a [Option<Place>],
    /// Pose of the table in the base frame of the robot, mm, if it is known.
    pub(crate) base_from_world: Option<&'a Isometry3<f64>>,
    /// Where the robot is sent next.
    pub(crate) pick: Option<Pick>,
    /// The tool as it would grasp it, in the base frame of the robot.
    pub(crate) grasp: Option<samsod_robot::Pose>,
}

/// What is known of a frame beside its pixels.
#[derive(Debug, Clone)]
pub(crate) struct FrameFacts<'a> {
    pub(crate) sequence: u64,
    pub(crate) timestamp_ns: u64,
    pub(crate) camera: &'a str,
    pub(crate) size_px: [u32; 2],
    /// From the client's timestamp to the frame in hand, if its clock is not ahead.
    pub(crate) age: Option<Duration>,
}

impl<'a> FrameFacts<'a> {
    pub(crate) fn of(frame: &'a Frame) -> Self {
        let layout = frame.layout();
        Self {
            sequence: frame.sequence(),
            timestamp_ns: frame.timestamp_ns(),
            camera: frame.camera(),
            size_px: [layout.width(), layout.height()],
            age: frame.latency(),
        }
    }
}

impl SceneSender {
    pub(crate) fn open(config: &Config) -> Result<Self, ServiceError> {
        let service = config.service();
        let publisher = ScenePublisher::open(&service)?;
        Ok(Self { publisher, json: Vec::new(), max_bytes: service.max_scene_bytes, last_error: None })
    }

    pub(crate) fn send(&mut self, frame: &Frame, scene: &Scene, findings: &Findings<'_>) {
        let (facts, mut shown) = (FrameFacts::of(frame), scene.regions.len());
        loop {
            let message = SceneJson::new(&facts, scene, shown, findings);
            self.json.clear();
            if let Err(e) = serde_json::to_writer(&mut self.json, &message) {
                return error!(error = %e, "scene cannot be written");
            }
            if self.json.len() <= self.max_bytes || shown == 0 {
                break;
            }
            // Regions come largest first, so the smallest are left out, and with them their objects.
            shown /= 2;
        }
        let sent = self.publisher.send(frame.sequence(), frame.timestamp_ns(), &self.json);
        if let Err(e) = sent
            && self.last_error.as_ref() != Some(&e)
        {
            warn!(error = %e, "scene not published");
            self.last_error = Some(e);
        }
    }
}

/// A scene as local clients read it: that of the recording, and what a client needs to act on it.
#[derive(Debug, Serialize)]
pub(crate) struct SceneJson<'a> {
    timestamp_ns: u64,
    #[serde(flatten)]
    scene: SceneMessage<'a>,
    /// All regions; `regions` may hold fewer.
    region_count: usize,
    /// All objects; `objects` may hold fewer.
    object_count: usize,
    /// All detections; `detections` may hold fewer.
    detection_count: usize,
    /// Id of the object that is picked next.
    best_object: Option<usize>,
    /// Id of the detection that is picked next, in a cell with a catalogue.
    best_detection: Option<usize>,
    /// Where it would be grasped, in the base frame of the robot.
    grasp: Option<GraspJson>,
    times_ms: TimesJson,
}

#[derive(Debug, Serialize)]
struct GraspJson {
    x_mm: f64,
    y_mm: f64,
    z_mm: f64,
    yaw_deg: f64,
}

#[derive(Debug, Serialize)]
struct TimesJson {
    /// From the client's timestamp to the frame in hand.
    age: Option<f64>,
    segment: f64,
    saliency: f64,
    regions: f64,
    shadow: f64,
    recognize: f64,
}

impl<'a> SceneJson<'a> {
    /// `shown` regions of the scene, the largest, and what lies in them.
    pub(crate) fn new(frame: &FrameFacts<'a>, scene: &'a Scene, shown: usize, findings: &Findings<'_>) -> Self {
        let ms = |d: Duration| d.as_secs_f64() * 1e3;
        let grasp = findings.grasp.map(|pose| GraspJson {
            x_mm: pose.x_mm,
            y_mm: pose.y_mm,
            z_mm: pose.z_mm,
            yaw_deg: pose.rz_rad.to_degrees(),
        });
        let regions = scene.regions[..shown].iter().enumerate().map(|(id, region)| RegionMessage::new(id, region));
        // Objects come in the order of their regions.
        let objects = scene.objects.partition_point(|object| object.region < shown);
        let mut detections = DetectionMessage::all(&scene.detections, findings.base_from_world);
        detections.retain(|detection| detection.region() < shown);
        Self {
            timestamp_ns: frame.timestamp_ns,
            scene: SceneMessage {
                sequence: frame.sequence,
                camera: frame.camera,
                width_px: frame.size_px[0],
                height_px: frame.size_px[1],
                partitions: scene.partition.len(),
                regions: regions.collect(),
                objects: ObjectMessage::all(&scene.objects[..objects], findings.places),
                detections,
            },
            region_count: scene.regions.len(),
            object_count: scene.objects.len(),
            detection_count: scene.detections.len(),
            best_object: findings.pick.and_then(|pick| pick.object),
            best_detection: findings.pick.and_then(|pick| pick.detection),
            grasp,
            times_ms: TimesJson {
                age: frame.age.map(ms),
                segment: ms(scene.times.segment),
                saliency: ms(scene.times.saliency),
                regions: ms(scene.times.regions),
                shadow: ms(scene.times.shadow),
                recognize: ms(scene.times.recognize),
            },
        }
    }
}
