//! How the cell is, for the page: health, counts, the recording, the robot and its work.
//!
//! Input: what the parts of the service leave behind for whoever asks. Output: a [`Status`]. Nobody is waited for.

use std::sync::Arc;

use samsod_robot::{JigSlot, PickReport, Pose, SequenceState};
use serde::Serialize;

use crate::commander::{CommandCounts, Work};
use crate::config::Config;
use crate::health::{Health, SharedMonitor};
use crate::interest::{Interest, Region};

/// Picks that are told, the last ones.
const LAST_PICKS: usize = 20;

/// Where everything is asked.
#[derive(Debug)]
pub(crate) struct StatusSource {
    monitor: SharedMonitor,
    interest: Arc<Interest>,
    recording: String,
    order: Vec<JigSlot>,
    places: Places,
    controller: &'static str,
    started_unix_ms: u64,
}

/// See the module documentation.
#[derive(Debug, Serialize)]
pub(crate) struct Status {
    /// When this run began: frames are counted anew by each.
    started_unix_ms: u64,
    #[serde(flatten)]
    health: Health,
    frames: Frames,
    objects: Objects,
    recorder: Recorder,
    places: Places,
    region_of_interest: Option<Region>,
    /// None in a cell whose robot is not commanded; `parts.robot.detail` then says why.
    robot: Option<Robot>,
}

#[derive(Debug, Serialize)]
struct Frames {
    received: u64,
    processed: u64,
    /// Passed over because a newer one was there.
    dropped: u64,
    rejected: u64,
    failed: u64,
    clients: u64,
}

#[derive(Debug, Serialize)]
struct Objects {
    found: u64,
    recognized: u64,
    unknown: u64,
}

#[derive(Debug, Serialize)]
struct Recorder {
    /// The file.
    file: String,
    written: u64,
    dropped: u64,
    not_written: u64,
    bytes: u64,
    queue_frames: usize,
    disk_free_bytes: Option<u64>,
}

/// What the cell has to place and name things by.
#[derive(Debug, Clone, Copy, Serialize)]
struct Places {
    /// `"camera"`, `"view"` or `"none"`.
    by: &'static str,
    catalogue: bool,
}

#[derive(Debug, Serialize)]
struct Robot {
    controller: String,
    simulated: bool,
    connected: bool,
    moving: bool,
    /// It stands until it is resumed.
    latched: bool,
    sequence: Option<SequenceState>,
    /// Why it is latched, with what the gripper may hold; or why it waits.
    reason: Option<String>,
    gripper_may_hold: Option<String>,
    step: Option<Step>,
    position: Option<Pose>,
    jig: Vec<Slot>,
    picks: Vec<PickReport>,
    placed: u64,
    missed: u64,
    not_reached: u64,
    commands: CommandCounts,
}

#[derive(Debug, Serialize)]
struct Step {
    name: String,
    part: Option<String>,
}

/// A line of the assembly list.
#[derive(Debug, Serialize)]
struct Slot {
    part: String,
    x_mm: f64,
    y_mm: f64,
    yaw_deg: f64,
    filled: bool,
    /// Why its part is not picked now, if it was passed over in the last frame.
    passed_over: Option<String>,
}

impl StatusSource {
    pub(crate) fn new(config: &Config, monitor: SharedMonitor, interest: Arc<Interest>, recording: String) -> Self {
        let by = match (&config.camera.file, config.view) {
            (Some(_), _) => "camera",
            (None, Some(_)) => "view",
            (None, None) => "none",
        };
        Self {
            monitor,
            interest,
            recording,
            order: config.jig.order.clone(),
            places: Places { by, catalogue: config.catalogue.folder.is_some() },
            controller: match config.robot.controller {
                crate::config::ControllerKind::Simulated => "simulated",
                crate::config::ControllerKind::Motoman => "motoman",
                crate::config::ControllerKind::None => "none",
            },
            started_unix_ms: samsod_frame::unix_time_ns() / 1_000_000,
        }
    }

    pub(crate) fn status(&self) -> Status {
        let counts = self.monitor.counts();
        let (frames, vision) = (counts.frames, counts.vision);
        let recorder = &self.monitor.recorder;
        let summary = recorder.summary();
        let mut health = self.monitor.health();
        let parts = &mut health.parts;
        for part in [&mut parts.frames, &mut parts.vision, &mut parts.recorder, &mut parts.robot] {
            // Another at every look; the health answer has it.
            part.pulse_age_ms = None;
        }
        Status {
            started_unix_ms: self.started_unix_ms,
            health,
            frames: Frames {
                received: frames.received,
                processed: vision.processed,
                dropped: frames.dropped,
                rejected: frames.rejected + vision.too_large + vision.wrong_size,
                failed: vision.failed + vision.panicked,
                clients: frames.publishers,
            },
            objects: Objects { found: vision.objects, recognized: vision.recognized, unknown: vision.unknown },
            recorder: Recorder {
                file: self.recording.clone(),
                written: summary.frames_written,
                dropped: summary.frames_dropped,
                not_written: summary.frames_not_written,
                bytes: summary.bytes,
                queue_frames: recorder.waiting_frames(),
                disk_free_bytes: recorder.free_bytes(),
            },
            places: self.places,
            region_of_interest: self.interest.region().as_deref().cloned(),
            robot: self.robot(),
        }
    }

    fn robot(&self) -> Option<Robot> {
        let operator = self.monitor.robot.as_ref().ok()?;
        let (standing, work) = (operator.standing(), operator.work(LAST_PICKS));
        let Work { report, step, passed_over } = work;
        let fault = match &report.sequence {
            Some(SequenceState::Faulted(fault)) => Some(fault),
            _ => None,
        };
        let slots = self.order.iter().enumerate().map(|(i, slot)| Slot {
            part: slot.part.clone(),
            x_mm: slot.x_mm,
            y_mm: slot.y_mm,
            yaw_deg: slot.yaw_rad.to_degrees() + 0.0,
            filled: report.filled.get(i).copied().unwrap_or(false),
            passed_over: passed_over.iter().find(|over| over.slot == i).map(|over| over.reason.to_string()),
        });
        Some(Robot {
            controller: report.controller.clone(),
            simulated: self.controller == "simulated",
            connected: standing.look.connected,
            moving: standing.look.moving,
            latched: standing.look.latched || fault.is_some(),
            reason: fault.map(ToString::to_string).or(report.waits_for),
            gripper_may_hold: fault.and_then(|fault| match &fault.holds {
                samsod_robot::GripperHolds::Nothing => None,
                samsod_robot::GripperHolds::Perhaps(part) | samsod_robot::GripperHolds::Part(part) => {
                    Some(part.clone())
                }
            }),
            sequence: report.sequence,
            step: step.map(|(phase, part)| Step { name: phase.to_string(), part }),
            position: report.position,
            jig: slots.collect(),
            picks: report.picks,
            placed: standing.picks.placed,
            missed: standing.picks.missed,
            not_reached: standing.picks.not_reached,
            commands: report.commands,
        })
    }
}
