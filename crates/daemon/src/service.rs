//! The service: frames in, every stage to the recording, scenes to local clients, commands to the robot.
//!
//! Input: a [`Config`], and frames in shared memory. Output: a recording, scenes in shared memory, commands, and a
//! [`Report`] at the end.
//!
//! ```text
//! frame client -> shared memory -> vision (this thread) -> shared memory -> scene readers
//!                                        |- bounded queue -> recorder thread -> MCAP
//!                                        '- one order, if idle -> robot thread -> controller
//! ```
//!
//! Vision waits for frames asleep and for nothing else: a full recorder queue or a busy robot cost it no time. What is
//! lost is counted: frames that came while vision was busy, frames the recorder had no room for.

use std::fmt;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use samsod::{Cell, CellError, CellParams, Scene};
use samsod_frame::{
    Frame, FrameCounts, FrameSubscriber, ReceiveError, ScenePublisher, SendError, ServiceError, unix_time_ns,
};
use samsod_robot::{ConnectError, Controller, MonotonicClock, Simulated, SimulatedConfigError};
use serde::Serialize;
use tracing::{debug, error, info, warn};

use crate::cell_lock::CellLock;
pub use crate::cell_lock::LockError;
pub use crate::commander::CommandCounts;
use crate::commander::{CommandOptions, Commander, Order};
use crate::config::{Config, ControllerKind, RobotConfig, ViewConfig};
use crate::durations::Durations;
use crate::pick;
use crate::recording::{FrameRecord, LogLevel, RecordError, Recorder, RecordingSummary, RegionMessage, SceneMessage};

/// Longest sleep before the service looks whether it should end.
const TICK: Duration = Duration::from_millis(200);
/// How often the counts are logged.
const STATUS_INTERVAL: Duration = Duration::from_secs(10);

/// When the service ends by itself.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct RunOptions {
    /// After so many processed frames; without it only by a signal.
    pub frames: Option<u64>,
}

/// Why the service did not start.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum StartError {
    /// Another daemon serves the cell, or it cannot be told.
    #[error(transparent)]
    Lock(#[from] LockError),
    /// The recording cannot be written.
    #[error("recording: {0}")]
    Record(#[from] RecordError),
    /// The shared memory cannot be used.
    #[error(transparent)]
    Service(#[from] ServiceError),
    /// The vision parameters are out of range.
    #[error("vision: {0}")]
    Vision(#[from] CellError),
    /// The simulated arm cannot be made.
    #[error("[robot.simulated] {0}")]
    Simulated(#[from] SimulatedConfigError),
    /// The robot controller is not there.
    #[error("robot: {0}")]
    Connect(#[from] ConnectError),
    /// The robot thread cannot be started.
    #[error("cannot start the robot thread: {0}")]
    Thread(std::io::Error),
}

/// Why the service ended.
#[derive(Debug)]
pub enum End {
    /// The number of frames it was asked for is done.
    Frames,
    /// It was told to by a signal.
    Stopped,
    /// The shared memory failed.
    Failed(ReceiveError),
}

/// What the service did.
#[derive(Debug)]
pub struct Report {
    /// Name of the cell.
    pub cell: String,
    /// Why it ended.
    pub end: End,
    /// From ready to end.
    pub elapsed: Duration,
    /// Frames as the subscriber counts them.
    pub frames: FrameCounts,
    /// Frames and stages as vision counts them.
    pub vision: VisionCounts,
    /// Commands; `None` without a robot.
    pub commands: Option<CommandCounts>,
    /// The recording, or what its writer met.
    pub recording: Result<RecordingSummary, RecordError>,
    times: Vec<(&'static str, Durations)>,
}

/// What vision did with the frames it was handed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct VisionCounts {
    /// Frames inspected.
    pub processed: u64,
    /// Frames larger than the configuration allows.
    pub too_large: u64,
    /// Frames on which the vision chain reported an error.
    pub failed: u64,
    /// Frames on which the vision chain panicked.
    pub panicked: u64,
    /// Salient regions found.
    pub regions: u64,
}

impl Report {
    /// Median and 99th percentile of a stage (`transport`, `segment`, ..), if any frame went through it.
    pub fn stage(&self, name: &str) -> Option<(Duration, Duration)> {
        let (_, times) = self.times.iter().find(|(stage, times)| *stage == name && times.count() > 0)?;
        Some((times.quantile(0.5), times.quantile(0.99)))
    }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let end = match &self.end {
            End::Frames => "all frames done".to_owned(),
            End::Stopped => "stopped".to_owned(),
            End::Failed(e) => format!("failed: {e}"),
        };
        let (frames, vision) = (&self.frames, &self.vision);
        writeln!(f, "cell {}: {end} after {:.1} s", self.cell, self.elapsed.as_secs_f64())?;
        writeln!(
            f,
            "frames     received {}  processed {}  dropped {}  rejected {}  failed {}",
            frames.received,
            vision.processed,
            frames.dropped,
            frames.rejected + vision.too_large,
            vision.failed + vision.panicked
        )?;
        let per_frame = vision.regions as f64 / vision.processed.max(1) as f64;
        writeln!(f, "regions    {} ({per_frame:.1} a frame)", vision.regions)?;
        writeln!(f, "stage      {:>12} {:>12} {:>12}", "median ms", "p99 ms", "max ms")?;
        for (stage, times) in self.times.iter().filter(|(_, times)| times.count() > 0) {
            let ms = |d: Duration| d.as_secs_f64() * 1e3;
            let (median, p99) = (times.quantile(0.5), times.quantile(0.99));
            writeln!(f, "{stage:<10} {:>12.3} {:>12.3} {:>12.3}", ms(median), ms(p99), ms(times.max()))?;
        }
        match &self.commands {
            Some(c) => writeln!(
                f,
                "commands   sent {}  done {}  not executed {}  aborted {}  unknown {}",
                c.sent, c.done, c.not_executed, c.aborted, c.unknown
            )?,
            None => writeln!(f, "commands   none, no robot")?,
        }
        match &self.recording {
            Ok(summary) => write!(f, "recording  {summary}"),
            Err(e) => write!(f, "recording  incomplete: {e}"),
        }
    }
}

/// Runs the service until `stop` is set or the frames of `options` are done.
///
/// # Errors
/// [`StartError`] when it could not start. Later failures are in the [`Report`], whose recording is closed.
pub fn run(config: &Config, options: RunOptions, stop: &AtomicBool) -> Result<Report, StartError> {
    let service = config.service();
    let _lock = CellLock::take(&service)?;
    let mut vision = Vision::new(config)?;
    let recorder = Arc::new(Recorder::start(&config.recording, &config.cell.name)?);
    let path = recorder.path().to_owned();
    info!(path = %path.display(), "recording");
    let commander = start_robot(&config.robot, &recorder)?;
    let mut scenes = SceneSender::open(config)?;
    let mut frames = FrameSubscriber::open(&service)?;
    info!(cell = %config.cell.name, "ready, waiting for frames");

    let start = Instant::now();
    let mut last_status = start;
    let end = loop {
        if stop.load(Ordering::Relaxed) {
            break End::Stopped;
        }
        if options.frames.is_some_and(|n| vision.counts.processed >= n) {
            break End::Frames;
        }
        if last_status.elapsed() >= STATUS_INTERVAL {
            last_status = Instant::now();
            let (seen, counts) = (frames.counts(), recorder.summary());
            info!(
                processed = vision.counts.processed,
                dropped = seen.dropped,
                rejected = seen.rejected,
                recorder_dropped = counts.frames_dropped,
                "status"
            );
        }
        let frame = match frames.wait(TICK) {
            Ok(Some(frame)) => frame,
            Ok(None) => continue,
            Err(e @ ReceiveError::Rejected { .. }) => {
                warn!(error = %e, "frame rejected");
                // A failed recording is reported once, by `Vision::see`.
                let _ = recorder.log_text(LogLevel::Warning, unix_time_ns(), "frames", &e.to_string());
                continue;
            }
            Err(e) => {
                error!(error = %e, "no more frames can be received");
                break End::Failed(e);
            }
        };
        if frame.is_from_new_publisher() {
            let (layout, publisher) = (frame.layout(), frame.publisher());
            let (width, height, format) = (layout.width(), layout.height(), layout.format());
            info!(%publisher, camera = frame.camera(), width, height, %format, "frames from a new client");
        }
        vision.see(&frame, &recorder, commander.as_ref(), &mut scenes);
    };
    let elapsed = start.elapsed();
    let frames = frames.counts();
    // Told to stop means no new motion; done means that the last frame is answered, too.
    let begin_last = matches!(end, End::Frames);
    let commands = commander.map(|commander| commander.finish(begin_last));
    // The robot thread has ended, so this is the last owner.
    let recording = match Arc::into_inner(recorder) {
        Some(recorder) => recorder.finish(),
        None => Err(RecordError::Writer { path, cause: "it is still in use".to_owned() }),
    };
    if let Err(e) = &recording {
        error!(error = %e, "the recording is incomplete");
    }
    let Vision { counts, times, .. } = vision;
    Ok(Report { cell: config.cell.name.clone(), end, elapsed, frames, vision: counts, commands, recording, times })
}

fn start_robot(config: &RobotConfig, recorder: &Arc<Recorder>) -> Result<Option<Commander>, StartError> {
    let mut controller: Box<dyn Controller> = match config.controller {
        ControllerKind::None => return Ok(None),
        ControllerKind::Simulated => Box::new(Simulated::new(config.simulated.clone(), MonotonicClock::new())?),
    };
    controller.connect()?;
    info!(controller = controller.name(), "robot connected");
    let options = CommandOptions {
        speed_fraction: config.joint_speed_fraction,
        timeout: Duration::from_millis(config.motion_timeout_ms),
    };
    Commander::start(controller, options, Arc::clone(recorder)).map(Some).map_err(StartError::Thread)
}

/// The vision chain with all that it reuses from frame to frame.
struct Vision {
    params: CellParams,
    cell: Cell,
    scene: Scene,
    scratch: Vec<u8>,
    max_size: (u32, u32),
    view: ViewConfig,
    heights_mm: Heights,
    counts: VisionCounts,
    times: Vec<(&'static str, Durations)>,
    told_of_failure: bool,
}

#[derive(Debug, Clone, Copy)]
struct Heights {
    safe: f64,
    grasp: f64,
}

/// Names under which times are kept beside the stages of the vision chain.
///
/// `transport` is the time from the client's timestamp to the frame in hand, of frames that vision was waiting for;
/// `age` is that of all frames, which includes how long a frame lay there while vision was busy with the one before.
/// `total` is the time from the frame in hand to its scene and its order handed on, here and in the recording; the copy
/// for the recorder comes after it and is `record`, which the recording itself cannot hold.
const TRANSPORT: &str = "transport";
const AGE: &str = "age";
const CONVERT: &str = "convert";
const HAND_ON: &str = "hand on";
const TOTAL: &str = "total";
const RECORD: &str = "record";

impl Vision {
    fn new(config: &Config) -> Result<Self, CellError> {
        let params = config.vision();
        let scene = Scene::default();
        let stages = scene.times.stages().map(|(name, _)| name);
        let names = [TRANSPORT, AGE, CONVERT].into_iter().chain(stages).chain([HAND_ON, TOTAL, RECORD]);
        Ok(Self {
            cell: Cell::new(params.clone())?,
            params,
            scene,
            scratch: Vec::new(),
            max_size: (config.frames.max_width_px, config.frames.max_height_px),
            view: config.view,
            heights_mm: Heights { safe: config.robot.safe_height_mm, grasp: config.robot.grasp_height_mm },
            counts: VisionCounts::default(),
            times: names.map(|name| (name, Durations::default())).collect(),
            told_of_failure: false,
        })
    }

    /// Takes one frame through the chain and hands on what it showed.
    fn see(&mut self, frame: &Frame, recorder: &Recorder, commander: Option<&Commander>, scenes: &mut SceneSender) {
        let start = Instant::now();
        let sequence = frame.sequence();
        let fail = |text: String| {
            error!(sequence, "{text}");
            let _ = recorder.log_text(LogLevel::Error, unix_time_ns(), "vision", &text);
        };
        let (width, height) = (frame.layout().width(), frame.layout().height());
        if width > self.max_size.0 || height > self.max_size.1 {
            self.counts.too_large += 1;
            let (max_width, max_height) = self.max_size;
            return fail(format!(
                "frame is {width} x {height} px; at most {max_width} x {max_height} px are processed"
            ));
        }
        let image = match frame.rgb(&mut self.scratch) {
            Ok(image) => image,
            Err(e) => {
                self.counts.failed += 1;
                return fail(e.to_string());
            }
        };
        let converted = Instant::now();
        let (cell, scene) = (&mut self.cell, &mut self.scene);
        // A bug that panics on one frame must cost that frame, not the recording of all the others.
        match catch_unwind(AssertUnwindSafe(|| cell.inspect_into(&image, scene))) {
            Ok(Ok(())) => {}
            Ok(Err(e)) => {
                self.counts.failed += 1;
                return fail(e.to_string());
            }
            Err(_) => {
                self.counts.panicked += 1;
                // What the panic left behind is not to be trusted.
                self.scene = Scene::default();
                if let Ok(cell) = Cell::new(self.params.clone()) {
                    self.cell = cell;
                }
                return fail("the vision chain panicked; the frame is left out".to_owned());
            }
        }
        let inspected = Instant::now();

        let best = pick::best_region(&self.scene.regions);
        if let (Some(best), Some(commander)) = (best, commander) {
            let target = pick::pose_above(&self.scene.regions[best], &self.view, self.heights_mm.safe);
            commander.offer(Order { frame_sequence: sequence, frame_timestamp_ns: frame.timestamp_ns(), target });
        }
        scenes.send(frame, &self.scene, best, &self.view, self.heights_mm.grasp);
        let latency = frame.latency();
        let transport = latency.filter(|_| !frame.was_waiting());
        let handed_on = Instant::now();
        let (convert, total) = ((CONVERT, converted - start), (TOTAL, handed_on - start));
        // A client whose clock is ahead has no age, and without an age there is no transport time.
        let other_times: &[_] = match (latency, transport) {
            (Some(age), Some(transport)) => &[convert, total, (AGE, age), (TRANSPORT, transport)],
            (Some(age), None) => &[convert, total, (AGE, age)],
            (None, _) => &[convert, total],
        };
        // The recorder copies the frame: its slot in shared memory must be free before the writer gets to it.
        let queued = recorder.log_frame(&FrameRecord {
            timestamp_ns: frame.timestamp_ns(),
            sequence,
            camera: frame.camera(),
            image: &image,
            scene: &self.scene,
            other_times,
        });
        if !queued
            && !self.told_of_failure
            && let Some(e) = recorder.failure()
        {
            error!(error = %e, "nothing more is recorded");
            self.told_of_failure = true;
        }
        let end = Instant::now();

        self.counts.processed += 1;
        self.counts.regions += self.scene.regions.len() as u64;
        let stages = self.scene.times.stages();
        let all = [convert, (HAND_ON, handed_on - inspected), total, (RECORD, end - handed_on)];
        let waits = transport.map(|time| (TRANSPORT, time)).into_iter().chain(latency.map(|time| (AGE, time)));
        for (name, time) in all.into_iter().chain(stages).chain(waits) {
            if let Some((_, times)) = self.times.iter_mut().find(|(stage, _)| *stage == name) {
                times.add(time);
            }
        }
        debug!(
            sequence,
            regions = self.scene.regions.len(),
            age_us = latency.map(|l| l.as_micros() as u64),
            waited = frame.was_waiting(),
            total_us = (end - start).as_micros() as u64,
            queued,
            "frame"
        );
    }
}

/// Publishes scenes; a scene that cannot be published costs nobody else anything.
struct SceneSender {
    publisher: ScenePublisher,
    /// Reused from scene to scene.
    json: Vec<u8>,
    max_bytes: usize,
    last_error: Option<SendError>,
}

impl SceneSender {
    fn open(config: &Config) -> Result<Self, ServiceError> {
        let service = config.service();
        let publisher = ScenePublisher::open(&service)?;
        Ok(Self { publisher, json: Vec::new(), max_bytes: service.max_scene_bytes, last_error: None })
    }

    fn send(&mut self, frame: &Frame, scene: &Scene, best: Option<usize>, view: &ViewConfig, grasp_height_mm: f64) {
        let mut shown = scene.regions.len();
        loop {
            let message = SceneJson::new(frame, scene, shown, best, view, grasp_height_mm);
            self.json.clear();
            if let Err(e) = serde_json::to_writer(&mut self.json, &message) {
                return error!(error = %e, "scene cannot be written");
            }
            if self.json.len() <= self.max_bytes || shown == 0 {
                break;
            }
            // Regions come largest first, so the smallest are left out.
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
struct SceneJson<'a> {
    timestamp_ns: u64,
    #[serde(flatten)]
    scene: SceneMessage<'a>,
    /// All regions; `regions` may hold fewer.
    region_count: usize,
    /// Id of the region that is picked next.
    best: Option<usize>,
    /// Where it would be grasped.
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
}

impl<'a> SceneJson<'a> {
    fn new(
        frame: &'a Frame,
        scene: &'a Scene,
        shown: usize,
        best: Option<usize>,
        view: &ViewConfig,
        grasp_height_mm: f64,
    ) -> Self {
        let ms = |d: Duration| d.as_secs_f64() * 1e3;
        let grasp = best.map(|best| {
            let pose = pick::pose_above(&scene.regions[best], view, grasp_height_mm);
            GraspJson { x_mm: pose.x_mm, y_mm: pose.y_mm, z_mm: pose.z_mm, yaw_deg: pose.rz_rad.to_degrees() }
        });
        let regions = scene.regions[..shown].iter().enumerate().map(|(id, region)| RegionMessage::new(id, region));
        Self {
            timestamp_ns: frame.timestamp_ns(),
            scene: SceneMessage {
                sequence: frame.sequence(),
                camera: frame.camera(),
                width_px: frame.layout().width(),
                height_px: frame.layout().height(),
                partitions: scene.partition.len(),
                regions: regions.collect(),
            },
            region_count: scene.regions.len(),
            best,
            grasp,
            times_ms: TimesJson {
                age: frame.latency().map(ms),
                segment: ms(scene.times.segment),
                saliency: ms(scene.times.saliency),
                regions: ms(scene.times.regions),
            },
        }
    }
}
