//! The service: frames in, every stage to the recording, scenes to local clients, commands to the robot.
//!
//! Input: a [`Config`], and frames in shared memory. Output: a recording, scenes in shared memory, commands, and a
//! [`Report`] at the end.
//!
//! ```text
//! frame client -> shared memory -> vision (this thread) -> shared memory -> scene readers
//!                                        |- bounded queue -> recorder thread -> MCAP
//!                                        '- one order, if idle -> robot thread -> controller
//! supervisor thread: the pulse of each of them -> log, systemd;  http thread: the operator's page, health, metrics
//! ```
//!
//! Frames are handed to the operator's page while somebody watches it.
//!
//! Vision waits for frames asleep and for nothing else: a full recorder queue or a busy robot cost it no time. What is
//! lost is counted: frames that came while vision was busy, frames the recorder had no room for.

mod reload;

use std::net::SocketAddr;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant, SystemTime};

use samsod::recognize::Catalogue;
use samsod::shadow::ObjectRegion;
use samsod::{Cell, CellError, CellParams, Scene};
use samsod_camera::nalgebra::Isometry3;
use samsod_frame::{Frame, FrameSubscriber, ReceiveError, ServiceError, unix_time_ns};
use samsod_robot::{
    Controller, Disarmed, HoldReason, HoldSwitch, Limited, Motoman, PartTable, PartTableError, Planner, ScaledClock,
    SequenceOptions, SharedLimits, Sight, Simulated, SimulatedConfigError, WireLog,
};
use tracing::{debug, error, info, warn};

pub use self::reload::Reload;
pub(crate) use self::reload::ReloadCounts;
use self::reload::{Prepared, Reloader};
use crate::cell_lock::CellLock;
pub use crate::cell_lock::LockError;
pub use crate::commander::{CommandCounts, RobotReport};
use crate::commander::{Commander, Content, Robot, Shown, Task};
use crate::config::{Config, ConfigError, ControllerKind};
use crate::control::ControlSocket;
use crate::durations::Durations;
use crate::ending::{self, Ended, Ending};
use crate::frame_clients::{Doubt, FrameClients, Stamp};
use crate::health::{FrameTrouble, Monitor};
use crate::http::{self, HttpServer, Served};
use crate::interest::{Interest, Region};
use crate::kept_frame;
use crate::made_with::MadeWith;
use crate::metrics::{Metrics, StageTimes};
use crate::page::{Page, Raw, Showing, Window};
use crate::pick::{self, Pick};
use crate::place::{ImagePlace, Place, Placer};
use crate::pulse::Pulse;
use crate::recording::{FrameRecord, LiveView, LiveViewError, LogLevel, RecordError, Recorder};
pub use crate::report::{End, NotCommanded, Report, VisionCounts};
use crate::scene_sender::{Findings, FrameFacts, SceneSender};
use crate::sight::Sighter;
use crate::supervisor::Supervisor;
use crate::wall_clock::WallClock;
use crate::watched::{SharedLook, Watched};

/// Longest sleep before the service looks whether it should end.
const TICK: Duration = Duration::from_millis(200);
/// How often the counts are logged.
const STATUS_INTERVAL: Duration = Duration::from_secs(10);

/// When the service ends by itself.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct RunOptions {
    /// After so many processed frames; without it only by a signal.
    pub frames: Option<u64>,
    /// When the jig is full, or a fault is latched.
    pub until_jig_is_full: bool,
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
    /// The camera file or the catalogue cannot be used (any more).
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The simulated arm cannot be made.
    #[error("[robot] {0}")]
    Simulated(#[from] SimulatedConfigError),
    /// The table of the simulated arm cannot be used.
    #[error("[robot.simulated] table: {0}")]
    Table(#[from] PartTableError),
    /// The operator's socket cannot be opened.
    #[error("cannot open the operator's socket {}: {source}", path.display())]
    Control {
        /// The socket.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// It was told to end before it was ready.
    #[error("told to end before it was ready")]
    Stopped,
    /// It was told to end, and something that is neither robot nor recording did not end in time.
    #[error("told to end; robot and recording are done with, something else hangs")]
    Hangs,
    /// Page, health and metrics cannot be served.
    #[error(
        "cannot serve page, health and metrics on {listen}: {source}; [http] listen takes a free address and port of this machine, \
         and without the section [http] nothing is served"
    )]
    Http {
        /// Address and port.
        listen: SocketAddr,
        /// What the system said.
        source: std::io::Error,
    },
    /// There is no live view.
    #[error(transparent)]
    Live(#[from] LiveViewError),
    /// The region of interest cannot be used.
    #[error("[interest] file: {cause}")]
    Interest {
        /// Which file, and why.
        cause: String,
    },
    /// There is no token for what the page changes.
    #[error("[http] token_file: {cause}")]
    Token {
        /// Which file, and why.
        cause: String,
    },
    /// A thread cannot be started.
    #[error("cannot start the {name} thread: {source}")]
    Thread {
        /// Its name.
        name: &'static str,
        /// What the system said.
        source: std::io::Error,
    },
}

/// Runs the service until `stop` is set or the frames of `options` are done.
///
/// Returns within two seconds from `stop` being set: with a controller, a disk or a frame that takes longer than that, threads
/// of the service may still be there, so the process is to end then.
///
/// # Errors
/// [`StartError`] when it could not start. Later failures are in the [`Report`], whose recording is closed.
pub fn run(config: &Config, options: RunOptions, stop: &Arc<AtomicBool>) -> Result<Report, StartError> {
    run_with_reload(config, options, stop, None)
}

/// [`run`], going on with a new configuration when one is asked for.
///
/// # Errors
/// As [`run`].
pub fn run_with_reload(
    config: &Config,
    options: RunOptions,
    stop: &Arc<AtomicBool>,
    reload: Option<Reload>,
) -> Result<Report, StartError> {
    let ending = Arc::new(Ending::new(&config.cell.name, stop));
    let (config, for_service) = (config.clone(), Arc::clone(&ending));
    ending::in_time(&ending, move || serve(&config, options, reload, &for_service))
}

/// None if the end was taken out of its hands.
fn serve(
    config: &Config,
    options: RunOptions,
    reload: Option<Reload>,
    ending: &Ending,
) -> Result<Option<Report>, StartError> {
    let service = config.service();
    service.check_root()?;
    let _lock = CellLock::take(&service)?;
    let http_error = |source| {
        let listen = config.http.clone().unwrap_or_default().listen;
        StartError::Http { listen, source }
    };
    let listener = config.http.as_ref().map(|http| http::listen(http.listen)).transpose().map_err(http_error)?;
    let placer = config.placer()?;
    let interest = Interest::open(config.interest_file()).map_err(|e| StartError::Interest { cause: e.to_string() })?;
    let interest = Arc::new(interest);
    let mut vision = Vision::new(config, placer, Arc::clone(&interest))?;
    if let Some(catalogue) = &vision.catalogue {
        info!(parts = catalogue.parts().len(), "catalogue");
    }
    let made_with = Arc::new(MadeWith::new(config, vision.catalogue.as_ref())?);
    info!(build = made_with.build, configuration = made_with.digest(), "made with");
    let live = config.foxglove.map(|live| LiveView::start(live, &config.recording, &config.cell.name)).transpose()?;
    let recorder =
        Recorder::start_with(&config.recording, &config.cell.name, Some(Arc::clone(&made_with)), live).map(Arc::new)?;
    ending.records(&recorder);
    let mut reloader = reload.map(|reload| Reloader::new(reload, config, made_with, Arc::clone(&interest)));
    info!(path = %recorder.path().display(), "recording");
    let commander = start_robot(config, placer.as_ref(), &recorder)?.map(Arc::new);
    ending.commands(&commander);
    let commander = commander.as_deref().map_err(|reason| *reason);
    let operator = commander.as_ref().ok().map(|commander| commander.operator());
    let not_commanded = commander.as_ref().err().copied();
    let watched = operator.clone().ok_or(not_commanded.unwrap_or(NotCommanded::NoRobot));
    let control = ControlSocket::open(&service, operator);
    let _control =
        control.map_err(|source| StartError::Control { path: crate::control::socket_path(&service), source })?;
    let mut scenes = SceneSender::open(config)?;
    let mut frames = FrameSubscriber::open(&service)?;
    let monitor = Arc::new(Monitor::new(config, recorder.view(), watched));
    let metrics = Metrics::new(Arc::clone(&monitor), &vision.stage_times);
    let window = Arc::new(Window::new());
    let mut showing = listener.is_some().then(|| Showing::new(Arc::clone(&window)));
    let _http = match listener {
        Some(listener) => {
            let page = Page::new(config, Arc::clone(&monitor), window, interest, &recorder);
            let page = page.map_err(|e| StartError::Token { cause: e.to_string() })?;
            let served = Served { monitor: Arc::clone(&monitor), metrics: Arc::new(metrics), page: Arc::new(page) };
            Some(HttpServer::start(listener, served).map_err(http_error)?)
        }
        None => None,
    };
    let supervisor =
        Supervisor::start(Arc::clone(&monitor)).map_err(|source| StartError::Thread { name: "supervisor", source })?;
    ending.is_ready(&monitor);
    info!(cell = %config.cell.name, "ready, waiting for frames");

    let start = Instant::now();
    let mut last_status = start;
    let mut wall_clock = WallClock::new(start, SystemTime::now());
    let end = loop {
        if ending.is_asked() {
            break End::Stopped;
        }
        if options.frames.is_some_and(|n| vision.counts.processed >= n) {
            break End::Frames;
        }
        if options.until_jig_is_full
            && let Some(end) = commander.as_ref().ok().and_then(|commander| commander.is_complete())
        {
            break match end {
                Ok(()) => End::JigFull,
                Err(fault) => End::RobotFault(fault),
            };
        }
        if last_status.elapsed() >= STATUS_INTERVAL {
            last_status = Instant::now();
            let (seen, counts) = (frames.counts(), recorder.summary());
            info!(
                processed = vision.counts.processed,
                dropped = seen.dropped,
                rejected = seen.rejected + vision.counts.too_large + vision.counts.wrong_size,
                recorder_dropped = counts.frames_dropped,
                "status"
            );
        }
        if let Some(reloader) = &mut reloader {
            let commander = commander.ok();
            if let Some(prepared) = reloader.step(&vision, commander) {
                vision.go_on_with(prepared, &recorder);
                commander.into_iter().for_each(Commander::goes_on);
            }
            monitor.count_reloads(reloader.counts);
        }
        if let Some(by_ms) = wall_clock.step_ms(Instant::now(), SystemTime::now()) {
            warn!(by_ms, "the clock of this machine has stepped; frames under way are not believed");
            let text = format!("the clock of this machine has stepped by {by_ms} ms");
            let _ = recorder.log_text(LogLevel::Warning, unix_time_ns(), "clock", &text);
        }
        monitor.count(frames.counts(), vision.counts);
        monitor.waits_for_frames();
        let asked_before = showing.as_ref().map_or(0, Showing::last_question);
        let patience = showing.as_ref().map_or(TICK, |showing| showing.patience(TICK));
        let frame = match frames.wait(patience) {
            Ok(Some(frame)) => frame,
            Ok(None) => {
                if let Some(showing) = &mut showing {
                    showing.show_if_wanted();
                }
                continue;
            }
            Err(e @ ReceiveError::Rejected { .. }) => {
                if let ReceiveError::Rejected { sequence, .. } = &e {
                    warn!(frame = sequence, error = %e, "frame rejected");
                }
                monitor.has_trouble(Some(FrameTrouble::refused(e.to_string())));
                monitor.has_seen();
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
            info!(frame = frame.sequence(), %publisher, camera = frame.camera(), width, height, %format, "frames from a new client");
        }
        monitor.count(frames.counts(), vision.counts);
        monitor.sees();
        // A frame that lay there may be older than a question that was asked meanwhile.
        let question = showing.as_mut().map(|showing| {
            showing.forget();
            if frame.was_waiting() { asked_before } else { showing.last_question() }
        });
        vision.see(&frame, &recorder, commander.as_ref().ok().copied(), &mut scenes);
        monitor.has_trouble(vision.trouble.take());
        if let (Some(showing), Some(question)) = (&mut showing, question) {
            vision.show(frame, question, showing);
        }
        monitor.has_seen();
    };
    // Its frame lies in shared memory, which is left next.
    drop(showing);
    monitor.count(frames.counts(), vision.counts);
    supervisor.is_ending();
    // This thread does not look for frames any more.
    monitor.ends();
    let elapsed = start.elapsed();
    let frames = frames.counts();
    // Told to stop means no new motion; done means that the last frame is answered, too.
    let Some(Ended { robot, recording }) = ending.end(matches!(end, End::Frames)) else { return Ok(None) };
    let parts = vision.catalogue.as_ref().map(|catalogue| catalogue.parts().len());
    let Vision { counts, times, .. } = vision;
    let cell = config.cell.name.clone();
    Ok(Some(Report { cell, end, elapsed, frames, vision: counts, robot, recording, parts, times }))
}

fn start_robot(
    config: &Config,
    placer: Option<&Placer>,
    recorder: &Arc<Recorder>,
) -> Result<Result<Commander, NotCommanded>, StartError> {
    let no_place = match placer {
        None => Some(NotCommanded::NoCamera),
        Some(placer) if !placer.knows_base() => Some(NotCommanded::NoBase),
        Some(_) => None,
    };
    // Said with and without a robot: it is also why objects have no place.
    match no_place {
        Some(reason @ NotCommanded::NoCamera) => warn!("{reason}: objects have no place in mm, no robot is commanded"),
        Some(reason) => warn!("{reason}; objects are placed on the table only, no robot is commanded"),
        None => {}
    }
    let (robot, base_from_world) = (&config.robot, placer.and_then(Placer::base_from_world));
    let hold_asked = Arc::new(AtomicBool::new(false));
    let (controller, clock, table): (Box<dyn Controller>, _, _) = match (robot.controller, no_place) {
        (ControllerKind::None, _) => return Ok(Err(NotCommanded::NoRobot)),
        (_, Some(reason)) => return Ok(Err(reason)),
        (ControllerKind::Simulated, None) => {
            let clock = ScaledClock::new(robot.simulated.clock_rate);
            let arm = Simulated::new(robot.simulated_arm(), clock)?;
            let tolerance = robot.simulated.pick_tolerance;
            let open = |path: &PathBuf| PartTable::open(path, robot.gripper, tolerance);
            let table = robot.simulated.table.as_ref().map(open).transpose()?;
            let arm = match table.clone() {
                Some(table) => arm.with_workpieces(Box::new(table)),
                None => arm,
            };
            (Box::new(arm), clock, table)
        }
        (ControllerKind::Motoman, None) => {
            let clock = ScaledClock::new(1.0);
            let log = Box::new(WireRecord { recorder: Arc::clone(recorder) });
            let motoman = Motoman::new(robot.motoman.clone(), clock, log).map_err(ConfigError::from)?;
            (Box::new(motoman), clock, None)
        }
    };
    let is_armed = robot.armed || robot.controller == ControllerKind::Simulated;
    let (pulse, look) = (Arc::new(Pulse::new()), Arc::new(SharedLook::default()));
    let controller: Box<dyn Controller> = if is_armed {
        controller
    } else {
        warn!("[robot] armed = true is missing: the robot is looked at and not moved");
        Box::new(Disarmed::new(controller))
    };
    let controller = Watched::new(controller, Arc::clone(&pulse), Arc::clone(&look));
    let limits = SharedLimits::from(robot.limits);
    let limited = Limited::new(controller, clock, limits.clone());
    let mut controller = Box::new(HoldSwitch::new(limited, Arc::clone(&hold_asked)));
    match controller.connect() {
        Ok(()) => info!(controller = controller.name(), "robot connected"),
        // It may be switched on later than this machine; the robot thread goes on trying.
        Err(error) => warn!(%error, "the robot is not reached; it is tried again and again"),
    }
    let task = task_of(config, base_from_world);
    let robot = Robot { controller, clock, limits, table, hold_asked, pulse, look };
    let started = Commander::start(robot, task, Arc::clone(recorder));
    started.map(Ok).map_err(|source| StartError::Thread { name: "robot", source })
}

/// What the robot does in a cell whose robot stands there.
fn task_of(config: &Config, base_from_world: Option<Isometry3<f64>>) -> Task {
    let robot = &config.robot;
    let timeout = Duration::from_millis(robot.motion_timeout_ms);
    if config.jig.order.is_empty() {
        Task::GoAbove { speed_fraction: robot.joint_speed_fraction, timeout }
    } else {
        let table_z_mm = base_from_world.map_or(0.0, |base| base.translation.z);
        let options = SequenceOptions {
            home: robot.home,
            // Over the table and over every slot.
            safe_z_mm: config.jig.order.iter().map(|slot| slot.z_mm).fold(table_z_mm, f64::max) + robot.safe_height_mm,
            joint_speed_fraction: robot.joint_speed_fraction,
            linear_speed_mm_s: robot.linear_speed_mm_s,
            joint_timeout: timeout,
            gripper_timeout: Duration::from_millis(robot.gripper_timeout_ms),
            poll_interval: Duration::from_millis(robot.poll_interval_ms),
        };
        let planner = Planner {
            order: config.jig.order.clone(),
            gripper: robot.gripper,
            clearance_mm: robot.clearance_mm,
            safe_height_mm: robot.safe_height_mm,
            score_min: robot.limits.score_min,
            arm: Some(robot.arm()),
            limits: Some(robot.limits),
        };
        Task::Assemble { options: Box::new(options), planner: Box::new(planner) }
    }
}

/// Every byte to and from a controller, in the recording.
struct WireRecord {
    recorder: Arc<Recorder>,
}

impl WireLog for WireRecord {
    fn sending(&mut self, bytes: &[u8]) -> Result<(), String> {
        self.recorder.log_sent(unix_time_ns(), bytes).map_err(|e| e.to_string())
    }

    fn sending_hold(&mut self, bytes: &[u8]) {
        let _ = self.recorder.log_sending_hold(unix_time_ns(), bytes);
    }

    fn received(&mut self, bytes: &[u8]) {
        // A failed recording is reported once, by `Vision::see`; and nothing more is sent then.
        let _ = self.recorder.log_received(unix_time_ns(), bytes);
    }
}

/// The vision chain with all that it reuses from frame to frame.
struct Vision {
    params: CellParams,
    catalogue: Option<Catalogue>,
    cell: Cell,
    /// Size of the frames that the camera of the cell is of, px; of a view, that follows from the frames.
    camera_size: Option<[u32; 2]>,
    /// Shared with those who watch the page: while they look at it, vision works on in a spare one.
    scene: Arc<Scene>,
    spare_scenes: Vec<Arc<Scene>>,
    /// What is known of the scene; none when the last frame has none.
    seen: Option<SeenFrame>,
    interest: Arc<Interest>,
    /// The region that has been told of.
    told_region: Option<Arc<Region>>,
    scratch: Vec<u8>,
    max_size: (u32, u32),
    placer: Option<Placer>,
    /// Of the placer, for the recording.
    base_from_world: Option<Isometry3<f64>>,
    /// Makes sights for a robot that works with them.
    sighter: Option<Sighter>,
    /// The place of each object of the scene; reused from frame to frame.
    places: Vec<Option<Place>>,
    heights_mm: Heights,
    counts: VisionCounts,
    times: Vec<(&'static str, Durations)>,
    /// The same, as they are served.
    stage_times: StageTimes,
    /// The configuration in force, for what is kept of a frame that brings vision down.
    configuration: String,
    told_of_failure: bool,
    clients: FrameClients,
    /// Greatest age of a frame that the robot may go by.
    oldest: Duration,
    /// What is wrong with the last frame, if anything is.
    trouble: Option<FrameTrouble>,
    /// The doubt that the log was told of last.
    told_of_doubt: Option<&'static str>,
}

/// What became of a frame.
#[derive(Debug, Clone)]
struct SeenFrame {
    pick: Option<Pick>,
    grasp: Option<samsod_robot::Pose>,
    inside: Inside,
    total: Duration,
}

/// Spare scenes: one that viewers look at, and one that they are about to let go of.
const MOST_SPARE_SCENES: usize = 3;

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
/// for the recorder comes after it and is `record`, which the recording itself cannot hold, and so is the copy for the
/// operator's page, `show`.
const TRANSPORT: &str = "transport";
const AGE: &str = "age";
const CONVERT: &str = "convert";
const HAND_ON: &str = "hand on";
const TOTAL: &str = "total";
const RECORD: &str = "record";
const SHOW: &str = "show";

impl Vision {
    fn new(config: &Config, placer: Option<Placer>, interest: Arc<Interest>) -> Result<Self, ConfigError> {
        let cell = config.make_cell()?;
        let base_from_world = placer.as_ref().and_then(Placer::base_from_world);
        let sighter = cell.catalogue().zip(base_from_world);
        let sighter = sighter.map(|(parts, base)| Sighter::new(parts, base, config.jig.unknown_height_mm));
        let scene = Arc::new(Scene::default());
        let stages = scene.times.stages().map(|(name, _)| name);
        let names = [TRANSPORT, AGE, CONVERT].into_iter().chain(stages).chain([HAND_ON, TOTAL, RECORD, SHOW]);
        Ok(Self {
            catalogue: cell.catalogue().cloned(),
            cell,
            camera_size: None,
            params: config.vision(),
            scene,
            spare_scenes: Vec::new(),
            seen: None,
            interest,
            told_region: None,
            scratch: Vec::new(),
            max_size: (config.frames.max_width_px, config.frames.max_height_px),
            placer,
            base_from_world,
            sighter,
            places: Vec::new(),
            heights_mm: Heights { safe: config.robot.safe_height_mm, grasp: config.robot.grasp_height_mm },
            counts: VisionCounts::default(),
            times: names.map(|name| (name, Durations::default())).collect(),
            stage_times: StageTimes::default(),
            configuration: config.to_toml()?,
            told_of_failure: false,
            clients: FrameClients::default(),
            oldest: Duration::from_millis(config.robot.limits.target_age_max_ms),
            trouble: None,
            told_of_doubt: None,
        })
    }

    /// Goes on with a new configuration from the next frame on, which begins a new file of the recording.
    fn go_on_with(&mut self, prepared: Prepared, recorder: &Recorder) {
        let Prepared { vision, made_with, changes, .. } = prepared;
        let (configuration, changes) = (made_with.digest(), changes.join(", "));
        recorder.goes_on_with(made_with);
        info!(configuration, changes, "a new configuration is in force");
        let text = format!("configuration {configuration} is in force: {changes}");
        // A failed recording is reported once, by `see`.
        let _ = recorder.log_text(LogLevel::Info, unix_time_ns(), "configuration", &text);
        (self.params, self.catalogue, self.cell) = (vision.params, vision.catalogue, vision.cell);
        (self.placer, self.base_from_world, self.sighter) = (vision.placer, vision.base_from_world, vision.sighter);
        (self.max_size, self.heights_mm, self.oldest) = (vision.max_size, vision.heights_mm, vision.oldest);
        (self.configuration, self.camera_size) = (vision.configuration, None);
    }

    /// Takes one frame through the chain and hands on what it showed.
    fn see(&mut self, frame: &Frame, recorder: &Recorder, commander: Option<&Commander>, scenes: &mut SceneSender) {
        let start = Instant::now();
        self.seen = None;
        let sequence = frame.sequence();
        let stamp = Stamp {
            publisher: frame.publisher(),
            sequence,
            timestamp_ns: frame.timestamp_ns(),
            received_ns: frame.received_ns(),
        };
        // Whoever moves nothing may take its time.
        let oldest = if commander.is_some() { self.oldest } else { Duration::MAX };
        let (client, doubt) = self.clients.see(&stamp, oldest);
        self.tell_of(doubt, client, frame, recorder);
        let fail = |text: String| {
            error!(frame = sequence, client, camera = frame.camera(), "{text}");
            let _ = recorder.log_text(LogLevel::Error, unix_time_ns(), "vision", &text);
        };
        let (width, height) = (frame.layout().width(), frame.layout().height());
        if width > self.max_size.0 || height > self.max_size.1 {
            self.counts.too_large += 1;
            let (max_width, max_height) = self.max_size;
            let text = format!("frame is {width} x {height} px; at most {max_width} x {max_height} px are processed");
            self.trouble = Some(FrameTrouble::refused(text.clone()));
            return fail(text);
        }
        // Places from a frame of another camera, or of a cropped one, would be wrong and look right.
        if let Some([camera_width, camera_height]) = self.placer.as_ref().and_then(Placer::image_size_px)
            && (width, height) != (camera_width, camera_height)
        {
            self.counts.wrong_size += 1;
            let text = format!(
                "frame is {width} x {height} px; the camera of [camera] file has {camera_width} x {camera_height} px"
            );
            self.trouble = Some(FrameTrouble::refused(text.clone()));
            return fail(text);
        }
        let image = match frame.rgb(&mut self.scratch) {
            Ok(image) => image,
            Err(e) => {
                self.counts.failed += 1;
                return fail(e.to_string());
            }
        };
        if self.camera_size != Some([width, height]) {
            self.cell.set_camera(self.placer.as_ref().and_then(|placer| placer.camera([width, height])));
            self.camera_size = Some([width, height]);
        }
        let converted = Instant::now();
        let (cell, scene) = (&mut self.cell, own_scene(&mut self.scene, &mut self.spare_scenes));
        // A bug that panics on one frame must cost that frame, not the recording of all the others.
        let inspect = || {
            #[cfg(test)]
            tests::panic_if_asked(frame.camera(), sequence);
            cell.inspect_into(&image, scene)
        };
        match catch_unwind(AssertUnwindSafe(inspect)) {
            Ok(Ok(())) => {}
            Ok(Err(e)) => {
                self.counts.failed += 1;
                return fail(e.to_string());
            }
            Err(_) => {
                self.counts.panicked += 1;
                // What the panic left behind is not to be trusted.
                self.scene = Arc::default();
                if let Ok(cell) = make_cell(&self.params, self.catalogue.as_ref()) {
                    (self.cell, self.camera_size) = (cell, None);
                }
                // What it did not see, the robot cannot stay clear of; and what comes next is not known either.
                if let Some(commander) = commander {
                    commander.operator().hold(HoldReason::VisionPanic);
                }
                fail("the vision chain panicked; the frame is left out, and a robot is held".to_owned());
                if self.counts.panicked <= kept_frame::MOST_KEPT {
                    match kept_frame::keep(recorder.path(), sequence, &image, &self.configuration) {
                        Ok(path) => error!(frame = sequence, client, path = %path.display(), "the frame is kept"),
                        Err(e) => fail(format!("the frame cannot be kept: {e}")),
                    }
                }
                return;
            }
        }
        let inspected = Instant::now();

        place_objects(self.placer.as_ref(), &self.scene.objects, &mut self.places);
        let region = self.interest.region();
        if region != self.told_region {
            let text = region_text(region.as_deref());
            info!("{text}");
            let _ = recorder.log_text(LogLevel::Info, unix_time_ns(), "interest", &text);
            self.told_region.clone_from(&region);
        }
        let inside = Inside::of(region.as_deref(), [width, height], &self.scene);
        let pick = match (&self.catalogue, &self.base_from_world) {
            (None, _) => pick::best_object(&self.scene.objects, &self.places, |i| inside.object(i)),
            (Some(catalogue), Some(base)) => {
                pick::best_part(&self.scene.detections, catalogue, base, |i| inside.detection(i))
            }
            (Some(_), None) => None,
        };
        let tool = |height_mm| pick.and_then(|p| self.placer.as_ref()?.tool(p.at_mm, p.base_yaw_deg, height_mm));
        // Of a frame in doubt nobody knows how old it is: it moves nothing.
        let age = frame.latency().filter(|_| doubt.is_none());
        if let (Some(commander), Some(age)) = (commander, age) {
            // From here on by a clock that does not step.
            let taken_at = commander.ago(age + start.elapsed());
            let content = if commander.works_with_sights() {
                let camera = self.placer.as_ref().and_then(|placer| placer.camera([width, height]));
                self.sighter.as_ref().zip(camera).map(|(sighter, camera)| {
                    let parts = sighter.parts(&self.scene, &camera, |i| inside.detection(i));
                    Content::Sight(Sight { frame: sequence, taken_at, parts })
                })
            } else {
                tool(self.heights_mm.safe).map(Content::Above)
            };
            if let Some(content) = content {
                let (frame_sequence, frame_timestamp_ns) = (sequence, frame.timestamp_ns());
                commander.show(Shown { frame_sequence, frame_timestamp_ns, taken_at, content });
            }
        }
        let grasp = tool(self.heights_mm.grasp);
        let findings = Findings { places: &self.places, base_from_world: self.base_from_world.as_ref(), pick, grasp };
        scenes.send(frame, &self.scene, &findings);
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
            places: self.placer.is_some().then_some(&self.places),
            base_from_world: self.base_from_world.as_ref(),
            other_times,
        });
        match recorder.failure().filter(|_| !queued) {
            Some(e) if !self.told_of_failure => {
                error!(error = %e, "frames are not recorded");
                self.told_of_failure = true;
            }
            Some(_) => {}
            None => self.told_of_failure = false,
        }
        let end = Instant::now();
        self.seen = Some(SeenFrame { pick, grasp, inside, total: handed_on - start });

        self.counts.processed += 1;
        self.counts.regions += self.scene.regions.len() as u64;
        self.counts.objects += self.scene.objects.len() as u64;
        self.counts.placed += self.places.iter().flatten().count() as u64;
        let recognized = self.scene.detections.iter().filter(|detection| detection.name.is_some()).count();
        self.counts.recognized += recognized as u64;
        self.counts.unknown += (self.scene.detections.len() - recognized) as u64;
        let stages = self.scene.times.stages();
        let all = [convert, (HAND_ON, handed_on - inspected), total, (RECORD, end - handed_on)];
        let waits = transport.map(|time| (TRANSPORT, time)).into_iter().chain(latency.map(|time| (AGE, time)));
        for (name, time) in all.into_iter().chain(stages).chain(waits) {
            self.count_time(name, time);
        }
        debug!(
            frame = sequence,
            client,
            camera = frame.camera(),
            regions = self.scene.regions.len(),
            objects = self.scene.objects.len(),
            recognized,
            age_us = latency.map(|l| l.as_micros() as u64),
            waited = frame.was_waiting(),
            total_us = (end - start).as_micros() as u64,
            queued,
            "seen"
        );
    }

    /// Tells the log of a doubt when it begins and when it is over, and health while it is there.
    fn tell_of(&mut self, doubt: Option<Doubt>, client: u64, frame: &Frame, recorder: &Recorder) {
        let state = doubt.as_ref().map(Doubt::state);
        let (sequence, camera) = (frame.sequence(), frame.camera());
        match (&doubt, self.told_of_doubt) {
            (Some(doubt), told) if told != state => {
                warn!(frame = sequence, client, camera, state, "{doubt}");
                let text = format!("frame {sequence} of client {client}: {doubt}");
                // A failed recording is reported once, below.
                let _ = recorder.log_text(LogLevel::Warning, unix_time_ns(), "frames", &text);
            }
            (None, Some(was)) => info!(frame = sequence, client, camera, was, "frames are believed again"),
            _ => {}
        }
        self.told_of_doubt = state;
        self.trouble = doubt.map(|doubt| FrameTrouble { state: doubt.state(), detail: doubt.to_string() });
    }

    fn count_time(&mut self, name: &'static str, time: Duration) {
        if let Some((_, times)) = self.times.iter_mut().find(|(stage, _)| *stage == name) {
            times.add(time);
            self.stage_times.add(name, time);
        }
    }

    /// Hands the frame that was seen last to those who watch.
    fn show(&mut self, frame: Frame, question: u64, showing: &mut Showing) {
        let Some(SeenFrame { pick, grasp, inside, total }) = self.seen.take() else { return };
        let start = Instant::now();
        let FrameFacts { sequence, timestamp_ns, camera, size_px, age } = FrameFacts::of(&frame);
        let raw = Raw {
            number: self.counts.processed,
            sequence,
            timestamp_ns,
            camera: camera.to_owned(),
            size_px,
            age,
            total,
            rgb: Vec::new(),
            detections_inside: inside.detections,
            objects_inside: inside.objects,
            scene: Arc::clone(&self.scene),
            places: self.places.clone(),
            base_from_world: self.base_from_world,
            pick,
            grasp,
        };
        showing.offer(frame, raw, question);
        self.count_time(SHOW, start.elapsed());
    }
}

/// A scene that nobody else looks at.
fn own_scene<'a>(scene: &'a mut Arc<Scene>, spare: &mut Vec<Arc<Scene>>) -> &'a mut Scene {
    if Arc::strong_count(scene) > 1 {
        let free = spare.iter().position(|spare| Arc::strong_count(spare) == 1);
        let own = free.map_or_else(Arc::default, |free| spare.swap_remove(free));
        let looked_at = std::mem::replace(scene, own);
        if spare.len() < MOST_SPARE_SCENES {
            spare.push(looked_at);
        }
    }
    // Never copies: this is the only one.
    Arc::make_mut(scene)
}

/// Whether the region of interest has each detection, and each object, of a scene.
#[derive(Debug, Clone, Default)]
struct Inside {
    detections: Vec<bool>,
    objects: Vec<bool>,
}

impl Inside {
    fn of(region: Option<&Region>, size_px: [u32; 2], scene: &Scene) -> Self {
        let has = |at| region.is_none_or(|region| region.has(size_px, at));
        Self {
            detections: scene.detections.iter().map(|detection| has(detection.image.origin_px)).collect(),
            objects: scene.objects.iter().map(|object| has(object.centroid.map(f64::from))).collect(),
        }
    }

    fn detection(&self, index: usize) -> bool {
        self.detections.get(index).is_some_and(|inside| *inside)
    }

    fn object(&self, index: usize) -> bool {
        self.objects.get(index).is_some_and(|inside| *inside)
    }
}

fn region_text(region: Option<&Region>) -> String {
    match region {
        Some(Region { width_px, height_px, points_px }) => {
            format!("parts are picked in the region of interest alone: {points_px:?} px of {width_px} x {height_px}")
        }
        None => "parts are picked on the whole picture".to_owned(),
    }
}

fn make_cell(params: &CellParams, catalogue: Option<&Catalogue>) -> Result<Cell, CellError> {
    match catalogue {
        Some(catalogue) => Cell::with_catalogue(params.clone(), catalogue.clone()),
        None => Cell::new(params.clone()),
    }
}

/// Places the objects of a scene. One that the camera cannot place has none: a tilted camera may see past the table.
fn place_objects(placer: Option<&Placer>, objects: &[ObjectRegion], places: &mut Vec<Option<Place>>) {
    places.clear();
    if let Some(placer) = placer {
        places.extend(objects.iter().map(|object| placer.place(&ImagePlace::from(object)).ok()));
    }
}

#[cfg(test)]
mod tests;
