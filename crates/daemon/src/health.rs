//! How the service is: each part with its pulse, and what is wrong, for `GET /healthz`, the log and systemd's watchdog.
//!
//! Input: the pulses of the parts, and what the recorder and the robot thread say of themselves. Output: a [`Health`].
//!
//! Three grades: fine; *ill*, of which somebody must be told (frames have stopped, nothing is recorded any more), while a new
//! start would cure nothing; and *stuck*, where only a new start helps and systemd's watchdog is not fed any more.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use samsod_frame::FrameCounts;
use samsod_robot::SequenceState;
use serde::Serialize;

use crate::commander::{Operator, Standing};
use crate::config::Config;
use crate::pulse::{Pulse, Sign};
use crate::recording::{RecorderView, Trouble};
use crate::report::{NotCommanded, VisionCounts};
use crate::service::ReloadCounts;

/// Time without a sign of life from which on the disk of the recording is told to be slow: a loss is told within a second.
const SLOW_DISK: Duration = Duration::from_millis(700);

/// Counts of the thread that receives frames and sees.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Counts {
    pub(crate) frames: FrameCounts,
    pub(crate) vision: VisionCounts,
}

impl Counts {
    /// Frames that were received and are not done with.
    pub(crate) fn unfinished(&self) -> u64 {
        let VisionCounts { processed, too_large, wrong_size, failed, panicked, .. } = self.vision;
        self.frames.received.saturating_sub(processed + too_large + wrong_size + failed + panicked)
    }
}

/// All that can be asked of a running service, from any thread.
#[derive(Debug)]
pub(crate) struct Monitor {
    cell: String,
    start: Instant,
    stuck_after: Duration,
    stalled_after: Duration,
    frames: Pulse,
    vision: Pulse,
    /// When the last frame was done with, ms since the start; 0 before the first.
    last_frame_ms: AtomicU64,
    /// What is wrong with the last frame, if anything is.
    trouble: Mutex<Option<FrameTrouble>>,
    counts: Mutex<Counts>,
    reloads: Mutex<ReloadCounts>,
    pub(crate) recorder: RecorderView,
    pub(crate) robot: Result<Operator, NotCommanded>,
}

/// What is wrong with a frame that has come.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct FrameTrouble {
    /// In a word or two.
    pub(crate) state: &'static str,
    /// More words.
    pub(crate) detail: String,
}

impl FrameTrouble {
    /// The frame cannot be looked at.
    pub(crate) fn refused(detail: String) -> Self {
        Self { state: "refused", detail }
    }
}

/// How a part is.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(crate) struct PartHealth {
    /// In a word or two.
    pub(crate) state: &'static str,
    /// Since its last sign of life, ms; of frames, since the last frame, if there was one. None of what is not there.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) pulse_age_ms: Option<u64>,
    /// More words.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) detail: Option<String>,
    #[serde(skip)]
    pub(crate) grade: Grade,
}

/// How bad it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Grade {
    Fine,
    Ill,
    Stuck,
}

/// How the service is.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct Health {
    /// `"ok"`, or which parts are what, e.g. `"recorder stuck"`.
    pub(crate) status: String,
    pub(crate) cell: String,
    pub(crate) version: &'static str,
    pub(crate) uptime_s: u64,
    pub(crate) parts: Parts,
}

/// The parts by their names.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct Parts {
    pub(crate) frames: PartHealth,
    pub(crate) vision: PartHealth,
    pub(crate) recorder: PartHealth,
    pub(crate) robot: PartHealth,
}

impl Parts {
    pub(crate) fn all(&self) -> [(&'static str, &PartHealth); 4] {
        [("frames", &self.frames), ("vision", &self.vision), ("recorder", &self.recorder), ("robot", &self.robot)]
    }
}

impl Health {
    pub(crate) fn is_fine(&self) -> bool {
        self.parts.all().iter().all(|(_, part)| part.grade == Grade::Fine)
    }

    pub(crate) fn is_stuck(&self) -> bool {
        self.parts.all().iter().any(|(_, part)| part.grade == Grade::Stuck)
    }
}

impl Monitor {
    pub(crate) fn new(config: &Config, recorder: RecorderView, robot: Result<Operator, NotCommanded>) -> Self {
        let vision = Pulse::new();
        vision.rest();
        Self {
            cell: config.cell.name.clone(),
            start: Instant::now(),
            stuck_after: Duration::from_millis(config.supervision.stuck_after_ms),
            stalled_after: Duration::from_millis(config.frames.stalled_after_ms),
            frames: Pulse::new(),
            vision,
            last_frame_ms: AtomicU64::new(0),
            trouble: Mutex::default(),
            counts: Mutex::default(),
            reloads: Mutex::default(),
            recorder,
            robot,
        }
    }

    /// The thread of frames and vision looks for a frame.
    pub(crate) fn waits_for_frames(&self) {
        self.vision.rest();
        self.frames.beat();
    }

    /// A frame has come, and vision works on it.
    pub(crate) fn sees(&self) {
        self.frames.rest();
        self.vision.beat();
    }

    /// Vision has done with a frame. Frames that stop are missed from here on: nobody looked for one before.
    pub(crate) fn has_seen(&self) {
        self.last_frame_ms.store((self.start.elapsed().as_millis() as u64).max(1), Ordering::SeqCst);
        self.waits_for_frames();
    }

    /// What is wrong with the last frame, if anything is.
    pub(crate) fn has_trouble(&self, trouble: Option<FrameTrouble>) {
        *self.trouble.lock().unwrap_or_else(PoisonError::into_inner) = trouble;
    }

    /// The service ends: neither frames nor scenes are looked for any more.
    pub(crate) fn ends(&self) {
        self.frames.rest();
        self.vision.rest();
    }

    pub(crate) fn count(&self, frames: FrameCounts, vision: VisionCounts) {
        *self.counts.lock().unwrap_or_else(PoisonError::into_inner) = Counts { frames, vision };
    }

    pub(crate) fn counts(&self) -> Counts {
        *self.counts.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(crate) fn count_reloads(&self, counts: ReloadCounts) {
        *self.reloads.lock().unwrap_or_else(PoisonError::into_inner) = counts;
    }

    pub(crate) fn reloads(&self) -> ReloadCounts {
        *self.reloads.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(crate) fn health(&self) -> Health {
        let parts =
            Parts { frames: self.frames(), vision: self.vision(), recorder: self.recorder(), robot: self.robot() };
        let bad = parts.all().into_iter().filter(|(_, part)| part.grade != Grade::Fine);
        let bad: Vec<_> = bad.map(|(name, part)| format!("{name} {}", part.state)).collect();
        let status = if bad.is_empty() { "ok".to_owned() } else { bad.join(", ") };
        let (cell, version) = (self.cell.clone(), env!("CARGO_PKG_VERSION"));
        Health { status, cell, version, uptime_s: self.start.elapsed().as_secs(), parts }
    }

    fn frames(&self) -> PartHealth {
        let last = Duration::from_millis(self.last_frame_ms.load(Ordering::SeqCst));
        let age = (!last.is_zero()).then(|| self.start.elapsed().saturating_sub(last));
        let trouble = self.trouble.lock().unwrap_or_else(PoisonError::into_inner).clone();
        let is_late = age.is_some_and(|age| age > self.stalled_after);
        let (state, grade, detail) = match (self.frames.sign(self.stuck_after), age, trouble) {
            (Sign::Stuck, ..) => ("stuck", Grade::Stuck, None),
            // While vision is busy nobody looks for frames, and none is missed.
            (sign, ..) if is_late && sign != Sign::Rests => {
                let detail = format!("none for more than {} ms", self.stalled_after.as_millis());
                ("stalled", Grade::Ill, Some(detail))
            }
            (.., Some(FrameTrouble { state, detail })) => (state, Grade::Ill, Some(detail)),
            (Sign::Rests, ..) | (_, Some(_), _) => ("flowing", Grade::Fine, None),
            (_, None, None) => ("waiting", Grade::Fine, None),
        };
        PartHealth { state, pulse_age_ms: age.map(|age| age.as_millis() as u64), detail, grade }
    }

    fn vision(&self) -> PartHealth {
        let (state, grade) = match self.vision.sign(self.stuck_after) {
            Sign::Stuck | Sign::Ended => ("stuck", Grade::Stuck),
            Sign::Works => ("busy", Grade::Fine),
            Sign::Rests => ("idle", Grade::Fine),
        };
        part(state, grade, &self.vision, None)
    }

    fn recorder(&self) -> PartHealth {
        let (pulse, trouble) = (self.recorder.pulse(), self.recorder.trouble());
        let (state, grade) = match (&trouble, pulse.sign(self.stuck_after), pulse.sign(SLOW_DISK)) {
            // Not cured by a new start, and no reason to see nothing any more.
            (Some(Trouble::Failed { .. }), ..) => ("failed", Grade::Ill),
            (_, Sign::Stuck | Sign::Ended, _) => ("stuck", Grade::Stuck),
            (_, _, Sign::Stuck) => ("slow", Grade::Ill),
            (Some(Trouble::ShortOfSpace { .. }), ..) => ("short of space", Grade::Ill),
            _ if self.recorder.loses_frames() => ("losing frames", Grade::Ill),
            _ => ("recording", Grade::Fine),
        };
        let detail = match (trouble, state) {
            (Some(trouble), _) => Some(trouble.to_string()),
            (None, "slow" | "stuck") => Some("the disk takes nothing".to_owned()),
            (None, "losing frames") => Some("frames were lost in the last seconds".to_owned()),
            _ => None,
        };
        part(state, grade, pulse, detail)
    }

    fn robot(&self) -> PartHealth {
        let robot = match &self.robot {
            Ok(robot) => robot,
            Err(reason) => {
                let detail = Some(reason.to_string());
                return PartHealth { state: "not commanded", pulse_age_ms: None, detail, grade: Grade::Fine };
            }
        };
        let Standing { sequence, waits_for, look, has_stopped, .. } = robot.standing();
        let (state, grade, detail) = match (robot.pulse().sign(self.stuck_after), sequence) {
            (Sign::Stuck, _) => ("stuck", Grade::Stuck, None),
            // It stops by itself when its commands cannot be recorded, and when the service ends.
            (Sign::Ended, _) if has_stopped => ("stopped", Grade::Ill, None),
            (Sign::Ended, _) => ("stuck", Grade::Stuck, Some("its thread is no more".to_owned())),
            (_, Some(SequenceState::Faulted(fault))) => ("faulted", Grade::Fine, Some(fault.to_string())),
            _ if !look.connected => ("not connected", Grade::Ill, waits_for),
            _ if look.latched => ("faulted", Grade::Fine, waits_for),
            (_, Some(SequenceState::Stopped { .. })) => ("stopped", Grade::Ill, None),
            _ if look.moving => ("moving", Grade::Fine, None),
            (_, Some(SequenceState::Complete)) => ("jig is full", Grade::Fine, None),
            _ if waits_for.is_some() => ("not ready", Grade::Fine, waits_for),
            _ => ("ready", Grade::Fine, None),
        };
        part(state, grade, robot.pulse(), detail)
    }
}

fn part(state: &'static str, grade: Grade, pulse: &Pulse, detail: Option<String>) -> PartHealth {
    PartHealth { state, pulse_age_ms: Some(pulse.age().as_millis() as u64), detail, grade }
}

/// What everybody who asks holds.
pub(crate) type SharedMonitor = Arc<Monitor>;
