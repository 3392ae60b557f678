//! The end by a signal: within two seconds, whatever a part of the service is at.
//!
//! The service works on a thread of its own. The thread that called for it waits for the report, and looks whether it is told
//! to end. From that moment on:
//!
//! ```text
//! at once   the robot is told: no new command, and a motion in flight is put on hold
//! 1.0 s     a service that is still at a frame, or at its start, is left there: this thread does the rest in its place
//! 1.3 s     a controller that has not answered is given up: the outcome of its command is recorded as unknown
//! 1.5 s     frames that still wait for the recorder are let go and counted
//! 1.8 s     a writer that hangs is given up: the recording is not closed, and a reader finds what was flushed
//! ```
//!
//! Mostly all of it takes a fifth of a second. An end without a signal has no limit: a motion in flight is followed to its end.

use std::panic::resume_unwind;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{self, RecvTimeoutError};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use tracing::{error, info, warn};

use crate::commander::{Commander, RobotReport};
use crate::health::SharedMonitor;
use crate::recording::{RecordError, Recorder, RecordingSummary};
use crate::report::{End, NotCommanded, Report, VisionCounts};
use crate::service::StartError;

/// That of the first thread of a process.
const STACK_BYTES: usize = 8 << 20;
/// How often it is looked whether the service is to end.
const TICK: Duration = Duration::from_millis(20);
/// From being told to end on, until a service that has not begun to end is left alone.
const LEFT_AFTER: Duration = Duration::from_millis(1000);
/// The same, until a controller is given up.
const ROBOT_AFTER: Duration = Duration::from_millis(1300);
/// The same, until no more frames are recorded.
const FRAMES_AFTER: Duration = Duration::from_millis(1500);
/// The same, until the writer of the recording is given up.
const WRITER_AFTER: Duration = Duration::from_millis(1800);
/// The same, until the report of a service that ends by itself is not waited for any more.
const REPORT_AFTER: Duration = Duration::from_millis(1850);

/// Times until which the parts are waited for.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Deadlines {
    /// The robot thread.
    pub(crate) robot: Instant,
    /// Frames that wait for the recorder.
    pub(crate) frames: Instant,
    /// The writer of the recording.
    pub(crate) writer: Instant,
}

/// What has to be ended in order, once it runs.
#[derive(Debug, Default)]
struct Running {
    robot: Option<Result<Arc<Commander>, NotCommanded>>,
    recorder: Option<Arc<Recorder>>,
    ready: Option<(Instant, SharedMonitor)>,
}

/// What is left of the parts when they have ended.
pub(crate) struct Ended {
    pub(crate) robot: Result<RobotReport, NotCommanded>,
    pub(crate) recording: Result<RecordingSummary, RecordError>,
}

/// Whether and since when the service is to end, and what has to be ended then.
#[derive(Debug)]
pub(crate) struct Ending {
    cell: String,
    stop: Arc<AtomicBool>,
    since: OnceLock<Instant>,
    running: Mutex<Running>,
    /// Somebody does it already: the service itself, or the one that waits for it.
    is_claimed: AtomicBool,
}

impl Ending {
    pub(crate) fn new(cell: &str, stop: &Arc<AtomicBool>) -> Self {
        let (since, running) = (OnceLock::new(), Mutex::default());
        Self { cell: cell.to_owned(), stop: Arc::clone(stop), since, running, is_claimed: AtomicBool::new(false) }
    }

    /// Every statement leaves it valid, so a panic elsewhere does not spoil it.
    fn lock(&self) -> MutexGuard<'_, Running> {
        self.running.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Whether the service is told to end.
    pub(crate) fn is_asked(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }

    /// The recording has begun.
    pub(crate) fn records(&self, recorder: &Arc<Recorder>) {
        self.lock().recorder = Some(Arc::clone(recorder));
    }

    /// The robot thread has been started, or never will be.
    pub(crate) fn commands(&self, robot: &Result<Arc<Commander>, NotCommanded>) {
        self.lock().robot = Some(robot.clone());
        if self.is_asked() {
            self.tell_robot();
        }
    }

    /// Frames can come.
    pub(crate) fn is_ready(&self, monitor: &SharedMonitor) {
        self.lock().ready = Some((Instant::now(), Arc::clone(monitor)));
    }

    fn tell_robot(&self) {
        // Cloned out, so that the lock is not held meanwhile.
        let robot = self.lock().robot.clone();
        if let Some(Ok(commander)) = robot {
            commander.stand();
        }
    }

    /// None as long as nobody has told the service to end.
    pub(crate) fn deadlines(&self) -> Option<Deadlines> {
        let since = *self.since.get()?;
        Some(Deadlines { robot: since + ROBOT_AFTER, frames: since + FRAMES_AFTER, writer: since + WRITER_AFTER })
    }

    /// Ends robot and recording, in this order. None if somebody else is at it, or the service has not come that far.
    pub(crate) fn end(&self, begin_last: bool) -> Option<Ended> {
        if self.is_claimed.swap(true, Ordering::SeqCst) {
            return None;
        }
        let (recorder, robot) = {
            let running = self.lock();
            (running.recorder.clone(), running.robot.clone())
        };
        let deadlines = || self.deadlines();
        let robot = robot.map(|robot| robot.map(|commander| commander.finish(begin_last, &deadlines)));
        let recording = recorder?.end(&deadlines);
        if let Err(e) = &recording {
            error!(error = %e, "the recording is incomplete");
        }
        Some(Ended { robot: robot?, recording })
    }

    /// Ends in place of a service that is at something else.
    fn end_for_it(&self) -> Result<Report, StartError> {
        let ready = self.lock().ready.clone();
        let at = if ready.is_some() { "a frame" } else { "its start" };
        warn!("told to end while vision is at {at}: it is left there");
        let (Some(Ended { robot, recording }), Some((start, monitor))) = (self.end(false), ready) else {
            return Err(StartError::Stopped);
        };
        let counts = monitor.counts();
        let vision = VisionCounts { unfinished: counts.unfinished(), ..counts.vision };
        let (cell, elapsed, frames) = (self.cell.clone(), start.elapsed(), counts.frames);
        let (parts, times) = (None, Vec::new());
        Ok(Report { cell, end: End::Stopped, elapsed, frames, vision, robot, recording, parts, times })
    }
}

/// Runs the service on a thread of its own, and returns its report; within two seconds from being told to end.
pub(crate) fn in_time(
    ending: &Arc<Ending>,
    serve: impl FnOnce() -> Result<Option<Report>, StartError> + Send + 'static,
) -> Result<Report, StartError> {
    let (sender, reports) = mpsc::sync_channel(1);
    let work = move || {
        // Nobody listens any more if it took too long.
        let _ = sender.send(serve());
    };
    // Under the name of what it does most of the time.
    let thread = thread::Builder::new().name("vision".to_owned()).stack_size(STACK_BYTES).spawn(work);
    let thread = thread.map_err(|source| StartError::Thread { name: "vision", source })?;
    loop {
        match reports.recv_timeout(TICK) {
            Ok(report) => {
                // It has sent its last: what it has opened is closed when it has ended.
                let _ = thread.join();
                if report.is_err() && ending.is_asked() {
                    // A start that the signal has broken off; in time, whatever had been started.
                    ending.end(false);
                    return Err(StartError::Stopped);
                }
                return report?.ok_or(StartError::Stopped);
            }
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => match thread.join() {
                Err(panic) => resume_unwind(panic),
                Ok(()) => return Err(StartError::Stopped),
            },
        }
        if !ending.is_asked() {
            continue;
        }
        let since = *ending.since.get_or_init(|| {
            info!("told to end");
            ending.tell_robot();
            Instant::now()
        });
        let is_claimed = ending.is_claimed.load(Ordering::SeqCst);
        match since.elapsed() {
            waited if waited >= LEFT_AFTER && !is_claimed => return ending.end_for_it(),
            // Robot and recording are done with; something else holds the service up.
            waited if waited >= REPORT_AFTER => return Err(StartError::Hangs),
            _ => {}
        }
    }
}
