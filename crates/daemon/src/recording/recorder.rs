//! The front of the recorder: what other threads call.
//!
//! One lock guards two queues: a short one of frames in recycled slots, bounded, and one of small messages (commands,
//! outcomes, states, log lines), which the writer thread empties first and between the images of a frame.

use std::collections::VecDeque;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError, mpsc};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use foxglove::Encode;
use samsod::Scene;
use samsod::recognize::Detection;
use samsod::saliency::SalientRegion;
use samsod::segment::RgbView;
use samsod::shadow::ObjectRegion;
use samsod_camera::nalgebra::Isometry3;
use samsod_robot::{Command, CommandId, Outcome, PassedOver, Phase, PickReport, RobotState, SequenceFault};

use super::live::LiveView;
use super::messages::{
    CommandMessage, LogLevel, OutcomeMessage, RobotStateMessage, Topic, WireMessage, log_line, pick_target,
};
use super::trouble::{COMMAND_PATIENCE, Trouble};
use super::writer::{self, Writer};
use super::{OnLogFailure, RecordError, RecorderConfig, RecordingSummary, SaliencyEncoding};
use crate::ending::Deadlines;
use crate::made_with::MadeWith;
use crate::place::Place;
use crate::pulse::{Pulse, Sign};

/// States and log lines that may wait; beyond that they are dropped.
const MOST_WAITING_LINES: usize = 10_000;

/// Outcomes and bytes of the wire that may wait: on a disk that has hung for hours.
const MOST_WAITING_OF_ALL: usize = 200_000;

/// How long a loss of frames is told of as one that goes on.
const LOSS_LASTS: Duration = Duration::from_secs(10);

/// How long the end waits for a disk that takes nothing.
const CLOSE_PATIENCE: Duration = Duration::from_secs(1);
/// How often it is looked whether the end of the writer is to be waited for any longer.
const END_TICK: Duration = Duration::from_millis(20);

/// One frame with everything that was found in it.
#[derive(Debug, Clone, Copy)]
pub struct FrameRecord<'a> {
    /// When the frame was taken, ns since the Unix epoch.
    pub timestamp_ns: u64,
    /// Number that the camera gave it.
    pub sequence: u64,
    /// Name of the camera.
    pub camera: &'a str,
    /// The pixels.
    pub image: &'a RgbView<'a>,
    /// What was found.
    pub scene: &'a Scene,
    /// The place, if it has one, of each object of the scene; `None` when nothing is known about the camera.
    pub places: Option<&'a [Option<Place>]>,
    /// Pose of the table in the base frame of the robot, mm, if it is known.
    pub base_from_world: Option<&'a Isometry3<f64>>,
    /// Times of further stages, by name, beside those of the scene.
    pub other_times: &'a [(&'a str, Duration)],
}

/// A command that is about to be sent.
#[derive(Debug, Clone, Copy)]
pub struct CommandRecord<'a> {
    /// Its number.
    pub id: CommandId,
    /// Now, ns since the Unix epoch.
    pub timestamp_ns: u64,
    /// The frame that it follows from, if it does.
    pub frame_sequence: Option<u64>,
    /// When that frame was taken, ns since the Unix epoch.
    pub frame_timestamp_ns: Option<u64>,
    /// The step of the pick-and-place sequence, if it is one.
    pub phase: Option<Phase>,
    /// The part that is being handled, if one is.
    pub part: Option<&'a str>,
    /// The command.
    pub command: &'a Command,
}

/// What became known of a command.
#[derive(Debug, Clone, Copy)]
pub struct OutcomeRecord<'a> {
    /// Its number.
    pub id: CommandId,
    /// Now, ns since the Unix epoch.
    pub timestamp_ns: u64,
    /// What is known.
    pub outcome: &'a Outcome,
}

/// A frame on its way to the writer, in memory that is used again.
#[derive(Debug, Default)]
pub(super) struct FrameSlot {
    pub(super) timestamp_ns: u64,
    pub(super) sequence: u64,
    pub(super) camera: String,
    pub(super) size: (u32, u32),
    pub(super) rgb: Vec<u8>,
    /// 2 bytes a pixel up to 65 536 labels, else 4 (f32), little endian.
    pub(super) labels: Vec<u8>,
    pub(super) wide_labels: bool,
    /// 1 byte a pixel or 4, as configured.
    pub(super) saliency: Vec<u8>,
    pub(super) partitions: usize,
    pub(super) regions: Vec<SalientRegion>,
    pub(super) objects: Vec<ObjectRegion>,
    pub(super) detections: Vec<Detection>,
    pub(super) places: Option<Vec<Option<Place>>>,
    pub(super) base_from_world: Option<Isometry3<f64>>,
    pub(super) times: Vec<(String, Duration)>,
    pub(super) total: Duration,
    pub(super) frames_dropped: u64,
    /// What it was seen with.
    pub(super) made_with: Option<Arc<MadeWith>>,
}

/// Greatest number of labels that 16 bits can tell apart.
const MOST_MONO16_LABELS: usize = 1 << 16;

impl FrameSlot {
    pub(super) fn fill(&mut self, frame: &FrameRecord<'_>, saliency_encoding: SaliencyEncoding, frames_dropped: u64) {
        let scene = frame.scene;
        self.timestamp_ns = frame.timestamp_ns;
        self.sequence = frame.sequence;
        self.camera.clear();
        self.camera.push_str(frame.camera);
        self.size = frame.image.dimensions();
        self.rgb.clear();
        self.rgb.extend_from_slice(frame.image.as_raw());
        self.partitions = scene.partition.len();
        self.wide_labels = scene.partition.len() > MOST_MONO16_LABELS;
        let labels = scene.partition.labels();
        if self.wide_labels {
            fill_bytes(&mut self.labels, labels, |&label| (label as f32).to_le_bytes());
        } else {
            fill_bytes(&mut self.labels, labels, |&label| (label as u16).to_le_bytes());
        }
        let saliency = scene.saliency.values();
        match saliency_encoding {
            SaliencyEncoding::Mono8 => fill_bytes(&mut self.saliency, saliency, |&s| [(s * 255.0 + 0.5) as u8]),
            SaliencyEncoding::Float32 => fill_bytes(&mut self.saliency, saliency, |s| s.to_le_bytes()),
        }
        self.regions.clone_from(&scene.regions);
        self.objects.clone_from(&scene.objects);
        self.detections.clone_from(&scene.detections);
        self.places = frame.places.map(<[_]>::to_vec);
        self.base_from_world = frame.base_from_world.copied();
        self.times.clear();
        let stages = scene.times.stages();
        let all = stages.iter().chain(frame.other_times);
        self.times.extend(all.map(|(name, time)| ((*name).to_string(), *time)));
        self.total = scene.times.total();
        self.frames_dropped = frames_dropped;
    }
}

/// Converts into a buffer that keeps its memory; the loop is one that compilers vectorise.
fn fill_bytes<T, const N: usize>(bytes: &mut Vec<u8>, values: &[T], convert: impl Fn(&T) -> [u8; N]) {
    bytes.resize(values.len() * N, 0);
    for (out, value) in bytes.chunks_exact_mut(N).zip(values) {
        out.copy_from_slice(&convert(value));
    }
}

/// A message that is small and ready to be written.
pub(super) struct Line {
    pub(super) topic: Topic,
    pub(super) timestamp_ns: u64,
    pub(super) data: Vec<u8>,
    /// Who waits until the line has been handed to the operating system.
    pub(super) waiter: Option<Waiter>,
}

impl Line {
    /// Tells who waits that it could not be written.
    pub(super) fn refuse(&mut self, error: &RecordError) {
        if let Some(waiter) = self.waiter.take() {
            let (path, cause) = match error {
                RecordError::Write { path, cause } => (path.clone(), cause.clone()),
                other => (PathBuf::new(), other.to_string()),
            };
            waiter.tell(Err(RecordError::Write { path, cause }));
        }
    }
}

/// Who waits for a line.
pub(super) struct Waiter {
    flushed: mpsc::SyncSender<Result<(), RecordError>>,
    has_given_up: Arc<AtomicBool>,
}

impl Waiter {
    pub(super) fn has_given_up(&self) -> bool {
        self.has_given_up.load(Ordering::SeqCst)
    }

    pub(super) fn tell(self, result: Result<(), RecordError>) {
        // Nobody listens any more: then nobody needs to know.
        let _ = self.flushed.send(result);
    }
}

#[derive(Default)]
pub(super) struct Queues {
    pub(super) lines: VecDeque<Line>,
    pub(super) frames: VecDeque<FrameSlot>,
    pub(super) free: Vec<FrameSlot>,
    pub(super) closing: bool,
    /// The writer has ended.
    pub(super) ended: bool,
    /// Frames that are not written by then are let go, once it is closing.
    pub(super) frames_until: Option<Instant>,
    /// Why nothing can be written at the moment, or, when the writer has ended, any more.
    pub(super) failed: Option<String>,
    /// Frames are left out because the file system is nearly full.
    pub(super) space_is_short: bool,
    /// Free space of the file system when it was last looked at, bytes; none if it cannot tell.
    pub(super) free_bytes: Option<u64>,
    /// When a frame was last lost.
    lost_a_frame: Option<Instant>,
    pub(super) summary: RecordingSummary,
}

impl Queues {
    /// A frame that came to the writer is lost.
    pub(super) fn lose_frame(&mut self) {
        self.summary.frames_not_written += 1;
        self.lost_a_frame = Some(Instant::now());
    }

    /// The frames that wait are lost.
    pub(super) fn lose_frames(&mut self) {
        while let Some(slot) = self.frames.pop_front() {
            self.free.push(slot);
            self.lose_frame();
        }
    }
}

pub(super) struct Shared {
    queues: Mutex<Queues>,
    /// Of the writer thread.
    pub(super) pulse: Arc<Pulse>,
    pub(super) wake: Condvar,
    /// The writer has ended.
    pub(super) gone: Condvar,
    min_free_mib: u64,
    on_log_failure: OnLogFailure,
}

impl Shared {
    /// A poisoned lock only says that another thread panicked; the queues are valid after every statement.
    pub(super) fn lock(&self) -> MutexGuard<'_, Queues> {
        self.queues.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// What is wrong at the moment, the worst first.
    fn trouble(&self) -> Option<Trouble> {
        let queues = self.lock();
        if let Some(cause) = &queues.failed {
            return Some(Trouble::Failed { cause: cause.clone() });
        }
        if self.pulse.sign(COMMAND_PATIENCE) == Sign::Stuck {
            return Some(Trouble::Stuck { for_ms: self.pulse.age().as_millis() as u64 });
        }
        queues.space_is_short.then(|| Trouble::ShortOfSpace {
            free_mib: queues.free_bytes.unwrap_or(0) >> 20,
            least_mib: self.min_free_mib,
        })
    }

    fn holds(&self) -> Option<String> {
        if self.on_log_failure == OnLogFailure::Continue {
            return None;
        }
        self.trouble().map(|trouble| trouble.to_string())
    }
}

/// Writes one recording; see the [module documentation](super).
///
/// Closes its file when dropped; [`finish`](Self::finish) does so too and tells how it went.
pub struct Recorder {
    shared: Arc<Shared>,
    saliency_encoding: SaliencyEncoding,
    /// What the frames to come are seen with.
    made_with: Mutex<Option<Arc<MadeWith>>>,
    path: PathBuf,
    /// Until somebody waits for its end.
    thread: Mutex<Option<JoinHandle<Result<(), RecordError>>>>,
}

impl std::fmt::Debug for Recorder {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Recorder").field("path", &self.path).finish_non_exhaustive()
    }
}

impl Recorder {
    /// Makes the folder if need be, a file named after the cell and the time (UTC) in it, and starts the writer thread.
    ///
    /// With `on_log_failure = "continue"` a folder that cannot be written to is tried again and again, as if it had failed later.
    ///
    /// # Errors
    /// [`RecordError::Config`], or [`RecordError::Folder`] or [`RecordError::Write`] when the folder cannot be written to.
    pub fn start(config: &RecorderConfig, cell_name: &str) -> Result<Self, RecordError> {
        Self::start_with(config, cell_name, None, None)
    }

    /// [`start`](Self::start) for files that say what they were made with, with a live view of what is written.
    ///
    /// # Errors
    /// As [`start`](Self::start).
    pub(crate) fn start_with(
        config: &RecorderConfig,
        cell_name: &str,
        made_with: Option<Arc<MadeWith>>,
        live: Option<LiveView>,
    ) -> Result<Self, RecordError> {
        config.check()?;
        let pulse = Arc::new(Pulse::new());
        let mut writer = Writer::create(config, cell_name, made_with.clone(), &pulse)?;
        writer.shows(live);
        let (path, failed) = (writer.path(), writer.failure());
        let failures = u64::from(failed.is_some());
        let files = if failed.is_none() { vec![path.clone()] } else { Vec::new() };
        let queues = Queues {
            free: (0..=config.queue_frames).map(|_| FrameSlot::default()).collect(),
            failed,
            summary: RecordingSummary { files, failures, ..RecordingSummary::default() },
            ..Queues::default()
        };
        let (min_free_mib, on_log_failure) = (config.min_free_mib, config.on_log_failure);
        let queues = Mutex::new(queues);
        let (wake, gone) = (Condvar::new(), Condvar::new());
        let shared = Arc::new(Shared { queues, pulse, wake, gone, min_free_mib, on_log_failure });
        // No command may be given before it is known how much space there is.
        writer.look_at_space(&shared);
        let for_thread = Arc::clone(&shared);
        let thread = std::thread::Builder::new()
            .name("recorder".to_string())
            .spawn(move || writer::run(writer, &for_thread))
            .map_err(|e| RecordError::Writer { path: path.clone(), cause: e.to_string() })?;
        let (saliency_encoding, made_with) = (config.saliency_encoding, Mutex::new(made_with));
        Ok(Self { shared, saliency_encoding, made_with, path, thread: Mutex::new(Some(thread)) })
    }

    /// The frames to come are seen with something else: the first of them begins a new file.
    pub fn goes_on_with(&self, made_with: Arc<MadeWith>) {
        *self.made_with.lock().unwrap_or_else(PoisonError::into_inner) = Some(made_with);
    }

    /// The first file of the recording; it may be one that could not be begun.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// What the recording holds so far.
    pub fn summary(&self) -> RecordingSummary {
        self.shared.lock().summary.clone()
    }

    /// Why nothing can be written at the moment, if so.
    pub fn failure(&self) -> Option<RecordError> {
        let cause = self.shared.lock().failed.clone()?;
        Some(RecordError::Write { path: self.path.clone(), cause })
    }

    /// A look at the recorder that may outlive it.
    pub(crate) fn view(&self) -> RecorderView {
        RecorderView(Arc::clone(&self.shared))
    }

    /// Copies a frame and its scene for the writer. Does not wait; costs one pass over the pixels.
    ///
    /// Returns whether it will be written: `false` when too many frames wait, which is counted, or when writing has failed.
    pub fn log_frame(&self, frame: &FrameRecord<'_>) -> bool {
        let (slot, frames_dropped) = {
            let mut queues = self.shared.lock();
            if queues.failed.is_some() {
                queues.lose_frame();
                return false;
            }
            let slot = queues.free.pop();
            if slot.is_none() {
                queues.summary.frames_dropped += 1;
                queues.lost_a_frame = Some(Instant::now());
            }
            (slot, queues.summary.frames_dropped)
        };
        let Some(mut slot) = slot else { return false };
        slot.fill(frame, self.saliency_encoding, frames_dropped);
        slot.made_with.clone_from(&self.made_with.lock().unwrap_or_else(PoisonError::into_inner));
        {
            let mut queues = self.shared.lock();
            // The disk may have failed meanwhile.
            if queues.failed.is_some() {
                queues.free.push(slot);
                queues.lose_frame();
                return false;
            }
            queues.frames.push_back(slot);
        }
        self.shared.wake.notify_one();
        true
    }

    /// Writes a command and its target, and returns when the operating system has them: call it before sending.
    ///
    /// Waits for the image that is being written at the moment (some milliseconds), and at most five seconds for a disk that takes
    /// nothing.
    ///
    /// # Errors
    /// With `on_log_failure = "hold"` any [`RecordError`]: the command is then not known to be recorded, and must not be given;
    /// also [`RecordError::Held`] while space is short. With `"continue"` the command may be given all the same: what is not
    /// recorded is counted and told in the log, and the only error is [`RecordError::Encode`].
    pub fn log_command(&self, record: &CommandRecord<'_>) -> Result<(), RecordError> {
        let CommandRecord { id, timestamp_ns, frame_sequence, frame_timestamp_ns, phase, part, command } = *record;
        let message = CommandMessage { id, frame_sequence, frame_timestamp_ns, phase, part, command };
        let data = json("/robot/command", &message)?;
        let target = match command.target() {
            Some(pose) => Some(protobuf("/pick/target", &pick_target(timestamp_ns, pose))?),
            None => None,
        };
        if let Some(cause) = self.shared.holds() {
            return Err(RecordError::Held { cause });
        }
        let target = target.map(|data| Line { topic: Topic::PickTarget, timestamp_ns, data, waiter: None });
        let Err(error) = self.write_ahead(target, Topic::Command, timestamp_ns, data) else { return Ok(()) };
        match self.shared.on_log_failure {
            OnLogFailure::Hold => {
                // It may come through to the disk yet, and is not given: nobody shall think that it was.
                let outcome = Outcome::NotExecuted { reason: format!("not recorded in time, so not given: {error}") };
                let _ = self.log_outcome(&OutcomeRecord { id, timestamp_ns, outcome: &outcome });
                Err(error)
            }
            OnLogFailure::Continue => {
                self.shared.lock().summary.commands_not_written += 1;
                tracing::error!(%id, %error, "a command is given that is not recorded");
                Ok(())
            }
        }
    }

    /// Writes bytes that are about to be sent to the robot, and returns when the operating system has them.
    ///
    /// # Errors
    /// As [`log_command`](Self::log_command); they may be sent while space is short, for otherwise nobody could look at the robot.
    pub fn log_sent(&self, timestamp_ns: u64, bytes: &[u8]) -> Result<(), RecordError> {
        let message = WireMessage { direction: "sent", bytes: bytes.escape_ascii().to_string() };
        match self.write_ahead(None, Topic::Wire, timestamp_ns, json("/robot/wire", &message)?) {
            Err(_) if self.shared.on_log_failure == OnLogFailure::Continue => {
                self.shared.lock().summary.lines_not_written += 1;
                Ok(())
            }
            written => written,
        }
    }

    /// Queues bytes that are about to be sent to make the robot stand; not waited for.
    ///
    /// # Errors
    /// As [`log_outcome`](Self::log_outcome).
    pub(crate) fn log_sending_hold(&self, timestamp_ns: u64, bytes: &[u8]) -> Result<(), RecordError> {
        let message = WireMessage { direction: "sent", bytes: bytes.escape_ascii().to_string() };
        self.push(Topic::Wire, timestamp_ns, json("/robot/wire", &message)?)
    }

    /// Queues bytes that have come from the robot; not waited for.
    ///
    /// # Errors
    /// As [`log_outcome`](Self::log_outcome).
    pub fn log_received(&self, timestamp_ns: u64, bytes: &[u8]) -> Result<(), RecordError> {
        let message = WireMessage { direction: "received", bytes: bytes.escape_ascii().to_string() };
        self.push(Topic::Wire, timestamp_ns, json("/robot/wire", &message)?)
    }

    /// Queues a line after another and waits until it has been handed to the operating system.
    fn write_ahead(
        &self,
        before: Option<Line>,
        topic: Topic,
        timestamp_ns: u64,
        data: Vec<u8>,
    ) -> Result<(), RecordError> {
        let (flushed, answer) = mpsc::sync_channel(1);
        let has_given_up = Arc::new(AtomicBool::new(false));
        // Whoever goes on anyway does not wait each time for a disk that is known to take nothing.
        let goes_on = self.shared.on_log_failure == OnLogFailure::Continue;
        let is_stuck = self.shared.pulse.sign(COMMAND_PATIENCE) == Sign::Stuck;
        {
            let mut queues = self.shared.lock();
            if let Some(cause) = &queues.failed {
                return Err(RecordError::Write { path: self.path.clone(), cause: cause.clone() });
            }
            if goes_on && is_stuck {
                let cause = "the disk takes nothing".to_owned();
                return Err(RecordError::Write { path: self.path.clone(), cause });
            }
            queues.lines.extend(before);
            let waiter = Some(Waiter { flushed, has_given_up: Arc::clone(&has_given_up) });
            queues.lines.push_back(Line { topic, timestamp_ns, data, waiter });
        }
        self.shared.wake.notify_one();
        match answer.recv_timeout(COMMAND_PATIENCE) {
            Ok(written) => written,
            Err(mpsc::RecvTimeoutError::Timeout) => {
                has_given_up.store(true, Ordering::SeqCst);
                let cause = format!("the disk has not taken it within {COMMAND_PATIENCE:?}");
                Err(RecordError::Write { path: self.path.clone(), cause })
            }
            Err(mpsc::RecvTimeoutError::Disconnected) => Err(RecordError::Writer {
                path: self.path.clone(),
                cause: "it ended before the command was written".into(),
            }),
        }
    }

    /// Queues what became known of a command; not waited for.
    ///
    /// # Errors
    /// [`RecordError::Encode`], or [`RecordError::Write`] when writing has failed.
    pub fn log_outcome(&self, record: &OutcomeRecord<'_>) -> Result<(), RecordError> {
        let data = json("/robot/outcome", &OutcomeMessage { id: record.id, outcome: record.outcome })?;
        self.push(Topic::Outcome, record.timestamp_ns, data)
    }

    /// Queues a state of the robot; dropped and counted when thousands wait.
    ///
    /// # Errors
    /// As [`log_outcome`](Self::log_outcome).
    pub fn log_robot_state(&self, timestamp_ns: u64, state: &RobotState) -> Result<(), RecordError> {
        let message: RobotStateMessage<'_> = state;
        self.push(Topic::RobotState, timestamp_ns, json("/robot/state", message)?)
    }

    /// Queues what became of a pick; never dropped, not waited for.
    ///
    /// # Errors
    /// As [`log_outcome`](Self::log_outcome).
    pub fn log_pick(&self, timestamp_ns: u64, report: &PickReport) -> Result<(), RecordError> {
        self.push(Topic::Pick, timestamp_ns, json("/robot/pick", report)?)
    }

    /// Queues a fault; never dropped, not waited for.
    ///
    /// # Errors
    /// As [`log_outcome`](Self::log_outcome).
    pub fn log_fault(&self, timestamp_ns: u64, fault: &SequenceFault) -> Result<(), RecordError> {
        self.push(Topic::Fault, timestamp_ns, json("/robot/fault", fault)?)
    }

    /// Queues why parts were passed over, as lines of the log.
    ///
    /// # Errors
    /// As [`log_outcome`](Self::log_outcome).
    pub fn log_passed_over(&self, timestamp_ns: u64, frame: u64, parts: &[PassedOver]) -> Result<(), RecordError> {
        for over in parts {
            let text =
                format!("frame {frame}: {} for slot {} is passed over: {}", over.part, over.slot + 1, over.reason);
            self.log_text(LogLevel::Info, timestamp_ns, "robot", &text)?;
        }
        Ok(())
    }

    /// Queues a line of the log; dropped and counted when thousands wait.
    ///
    /// # Errors
    /// As [`log_outcome`](Self::log_outcome).
    pub fn log_text(&self, level: LogLevel, timestamp_ns: u64, name: &str, text: &str) -> Result<(), RecordError> {
        self.push(Topic::Log, timestamp_ns, protobuf("/log", &log_line(timestamp_ns, level, name, text))?)
    }

    fn push(&self, topic: Topic, timestamp_ns: u64, data: Vec<u8>) -> Result<(), RecordError> {
        {
            let mut queues = self.shared.lock();
            if let Some(cause) = queues.failed.clone() {
                queues.summary.lines_not_written += 1;
                return Err(RecordError::Write { path: self.path.clone(), cause });
            }
            let may_drop = matches!(topic, Topic::RobotState | Topic::Log);
            let most = if may_drop { MOST_WAITING_LINES } else { MOST_WAITING_OF_ALL };
            if queues.lines.len() >= most {
                queues.summary.lines_dropped += 1;
                return Ok(());
            }
            queues.lines.push_back(Line { topic, timestamp_ns, data, waiter: None });
        }
        self.shared.wake.notify_one();
        Ok(())
    }

    /// Writes what waits, closes the file and tells what it holds. A disk that takes nothing any more is waited for one second.
    ///
    /// # Errors
    /// [`RecordError::Write`] or [`RecordError::Writer`]; the file is then not complete, but readable up to its end.
    pub fn finish(self) -> Result<RecordingSummary, RecordError> {
        self.end(&|| None)
    }

    /// As [`finish`](Self::finish), with a limit, if there is one: frames that still wait are then let go and counted, and later
    /// a writer that hangs is waited for no longer. Nothing is recorded any more after it.
    ///
    /// # Errors
    /// As [`finish`](Self::finish).
    pub(crate) fn end(&self, deadlines: &dyn Fn() -> Option<Deadlines>) -> Result<RecordingSummary, RecordError> {
        self.close(deadlines)?;
        Ok(self.summary())
    }

    fn close(&self, deadlines: &dyn Fn() -> Option<Deadlines>) -> Result<(), RecordError> {
        let Some(thread) = self.thread.lock().unwrap_or_else(PoisonError::into_inner).take() else { return Ok(()) };
        let mut queues = self.shared.lock();
        queues.closing = true;
        self.shared.wake.notify_all();
        // As long as anything comes through to the disk it is waited for, but not for longer than the service may take to end.
        let begun = Instant::now();
        while !queues.ended {
            let until = deadlines();
            queues.frames_until = until.map(|until| until.frames);
            if until.is_some_and(|until| Instant::now() >= until.writer) {
                let cause = "it was still writing when samsodd had to end; what was flushed can be read".to_string();
                return Err(RecordError::Writer { path: self.path.clone(), cause });
            }
            if begun.elapsed() > CLOSE_PATIENCE && self.shared.pulse.sign(CLOSE_PATIENCE) == Sign::Stuck {
                let cause = format!("the disk has taken nothing for {CLOSE_PATIENCE:?}; what waits is given up");
                return Err(RecordError::Writer { path: self.path.clone(), cause });
            }
            queues = self.shared.gone.wait_timeout(queues, END_TICK).unwrap_or_else(PoisonError::into_inner).0;
        }
        drop(queues);
        thread.join().unwrap_or_else(|_| {
            Err(RecordError::Writer { path: self.path.clone(), cause: "its thread panicked".to_string() })
        })
    }
}

impl Drop for Recorder {
    fn drop(&mut self) {
        if let Err(error) = self.close(&|| None) {
            tracing::error!(%error, "the recording is not complete");
        }
    }
}

/// How a recorder is, for any thread.
#[derive(Clone)]
pub(crate) struct RecorderView(Arc<Shared>);

impl std::fmt::Debug for RecorderView {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("RecorderView").finish_non_exhaustive()
    }
}

impl RecorderView {
    /// Of the writer thread.
    pub(crate) fn pulse(&self) -> &Pulse {
        &self.0.pulse
    }

    /// As [`Recorder::summary`].
    pub(crate) fn summary(&self) -> RecordingSummary {
        self.0.lock().summary.clone()
    }

    /// What is wrong at the moment, if anything is.
    pub(crate) fn trouble(&self) -> Option<Trouble> {
        self.0.trouble()
    }

    /// Why the robot must stand, if `on_log_failure = "hold"` wants it to.
    pub(crate) fn holds_robot(&self) -> Option<String> {
        self.0.holds()
    }

    /// Whether frames were lost in the last seconds.
    pub(crate) fn loses_frames(&self) -> bool {
        self.0.lock().lost_a_frame.is_some_and(|lost| lost.elapsed() < LOSS_LASTS)
    }

    /// Free space of the file system when it was last looked at, bytes; none if it cannot tell. Does not ask the disk, which may
    /// hang.
    pub(crate) fn free_bytes(&self) -> Option<u64> {
        self.0.lock().free_bytes
    }

    /// Frames that wait for the writer.
    pub(crate) fn waiting_frames(&self) -> usize {
        self.0.lock().frames.len()
    }
}

pub(super) fn json<T: serde::Serialize + ?Sized>(topic: &'static str, message: &T) -> Result<Vec<u8>, RecordError> {
    serde_json::to_vec(message).map_err(|e| RecordError::Encode { topic, cause: e.to_string() })
}

pub(super) fn protobuf<M: Encode>(topic: &'static str, message: &M) -> Result<Vec<u8>, RecordError> {
    let mut data = Vec::new();
    message.encode(&mut data).map_err(|e| RecordError::Encode { topic, cause: e.to_string() })?;
    Ok(data)
}
