//! The pick-and-place sequence of section 5.3 (figure 7, algorithm 2), over any controller.
//!
//! ```text
//! home
//! for each part in the order of the assembly list:
//!   joint move above it at the safe height, the gripper turned to its angle     Above
//!   open                                                                        Open
//!   linear down to the grasp height: the table and half the height of the part  Down
//!   close                                                                       Close
//!   linear up                                                                   Up
//!   joint move above the jig slot at the safe height                            AboveSlot
//!   linear down, open, linear up                                                DownSlot, Release, UpSlot
//! ```
//!
//! Every command is handed to the [`SequenceLog`] before it is given, its outcomes afterwards. One that was certainly not
//! executed because the connection broke before it is given again under a new id, once, after reconnecting; nothing else is ever
//! repeated. Whatever ends otherwise than done is a [`Fault`](SequenceFault): latched, told with what the gripper may hold, and
//! left by [`Sequence::resume`] alone, after which a new cycle begins from home.

use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::follow::hold_anyway;
use crate::plan::Filled;
use crate::{
    AbortReason, Clock, Command, CommandId, ConnectError, Controller, FollowOptions, GripperCommand, GripperError,
    GripperState, HoldReason, Motion, MotionError, NotReady, Outcome, PassedOver, Pick, Planner, Pose, ResumeError,
    RobotState, Sight, Sighting, StatusError, follow,
};

/// Waits between attempts to reconnect, ms: back-off from 0.25 to 5 s.
const BACK_OFF_MS: [u64; 6] = [250, 500, 1000, 2000, 4000, 5000];
/// In such steps it is waited, so that the end is not waited for as long, ms.
const STEP_MS: u64 = 50;
/// Missed status reports in a row after which a robot at rest is lost.
const MOST_MISSES: u32 = 5;

/// How fast, and from where.
#[derive(Debug, Clone, PartialEq)]
pub struct SequenceOptions {
    /// Where the tool waits, out of the camera's view.
    pub home: Pose,
    /// Height of the tool on its way, base frame, mm: it goes up to that before it goes home.
    pub safe_z_mm: f64,
    /// Share of the greatest joint speed on the way.
    pub joint_speed_fraction: f64,
    /// Speed of the way down and up, mm/s.
    pub linear_speed_mm_s: f64,
    /// Greatest time of a joint motion; linear ones have the time of their way, half as much again, and 2 s.
    pub joint_timeout: Duration,
    /// Greatest time of the gripper.
    pub gripper_timeout: Duration,
    /// Time between polls.
    pub poll_interval: Duration,
}

/// A step of the sequence.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Phase {
    /// Up to the safe height, before the way home.
    Lift,
    /// Home.
    Home,
    /// Above the part.
    Above,
    /// The gripper opens.
    Open,
    /// Down to the part.
    Down,
    /// The gripper closes.
    Close,
    /// Up with the part.
    Up,
    /// Above the slot.
    AboveSlot,
    /// Down to the slot.
    DownSlot,
    /// The gripper lets go.
    Release,
    /// Up without the part.
    UpSlot,
}

impl std::fmt::Display for Phase {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Lift => "lift",
            Self::Home => "home",
            Self::Above => "above the part",
            Self::Open => "open",
            Self::Down => "down to the part",
            Self::Close => "close",
            Self::Up => "up with the part",
            Self::AboveSlot => "above the slot",
            Self::DownSlot => "down to the slot",
            Self::Release => "release",
            Self::UpSlot => "up from the slot",
        })
    }
}

/// What the gripper holds, as far as that is known.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "gripper", content = "part", rename_all = "snake_case")]
pub enum GripperHolds {
    /// Nothing.
    #[default]
    Nothing,
    /// Perhaps this part.
    Perhaps(String),
    /// This part.
    Part(String),
}

impl std::fmt::Display for GripperHolds {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Nothing => write!(f, "the gripper is empty"),
            Self::Perhaps(part) => write!(f, "the gripper may hold the {part}"),
            Self::Part(part) => write!(f, "the gripper holds the {part}"),
        }
    }
}

/// Why the sequence stands still until an operator resumes.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct SequenceFault {
    /// What happened.
    pub reason: String,
    /// In which step, if in one.
    pub phase: Option<Phase>,
    /// What the gripper may hold.
    pub holds: GripperHolds,
    /// Who has asked that the robot stand, if it stands for that.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub held_by: Option<HoldReason>,
}

impl std::fmt::Display for SequenceFault {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self.phase {
            Some(phase) => write!(f, "{phase}: {}; {}", self.reason, self.holds),
            None => write!(f, "{}; {}", self.reason, self.holds),
        }
    }
}

/// Where the sequence stands.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "state", rename_all = "snake_case")]
pub enum SequenceState {
    /// It has to go home first.
    FromHome,
    /// It waits for a fresh frame.
    Ready,
    /// Every slot of the jig is filled.
    Complete,
    /// It was told to stop.
    Stopped {
        /// What the gripper may hold.
        holds: GripperHolds,
    },
    /// Latched until an operator resumes.
    Faulted(SequenceFault),
}

/// Why a command is given.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Purpose<'a> {
    /// The step.
    pub phase: Phase,
    /// The part, if one is being handled.
    pub part: Option<&'a str>,
    /// The frame that it follows from, if it does.
    pub frame: Option<u64>,
    /// What the gripper may hold.
    pub holds: &'a GripperHolds,
}

/// What became of a pick.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "result", rename_all = "snake_case")]
pub enum PickResult {
    /// It lies in its slot.
    Placed,
    /// The gripper has closed on nothing, or has lost it on the way up.
    Missed,
    /// It could not be gone to; the next frame may show why, or another.
    NotReached {
        /// Why.
        reason: String,
    },
}

/// One pick, for the record.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PickReport {
    /// Line of the assembly list.
    pub slot: usize,
    /// The part.
    pub part: String,
    /// The frame in which it was seen.
    pub frame: u64,
    /// How sure it was.
    pub score: f64,
    /// From the frame to its first command, ms.
    pub gap_ms: f64,
    /// Time that the robot had stood before for want of a frame, ms.
    pub waited_ms: f64,
    /// From the first command to the end of the last, ms.
    pub took_ms: f64,
    /// What became of it.
    #[serde(flatten)]
    pub result: PickResult,
}

/// What goes on while a sequence runs: its recording, and whether it is to stop.
pub trait SequenceLog {
    /// A command is about to be given. Returns when it is recorded.
    ///
    /// # Errors
    /// Why it could not be recorded; it is then not given, and the sequence faults.
    fn command(&mut self, id: CommandId, command: &Command, purpose: &Purpose<'_>) -> Result<(), String>;

    /// What became known of it: accepted, then its end.
    fn outcome(&mut self, id: CommandId, outcome: &Outcome);

    /// The state of the robot, at every poll.
    fn state(&mut self, state: &RobotState);

    /// Parts that were passed over in a frame, with the reasons; empty when there are none.
    fn passed_over(&mut self, frame: u64, parts: &[PassedOver]);

    /// A pick is over.
    fn picked(&mut self, report: &PickReport);

    /// A fault has been latched.
    fn fault(&mut self, fault: &SequenceFault);

    /// Work was cut short because the sequence is to end: where, and what the gripper may hold. The robot is on hold.
    fn cut_short(&mut self, cut: &SequenceFault) {
        let _ = cut;
    }

    /// Whether the sequence is to end: no further command is given. A motion in flight is followed to its end, unless a
    /// [`HoldSwitch`](crate::HoldSwitch) ends it.
    fn is_stopping(&self) -> bool {
        false
    }
}

/// Why a sequence stays faulted.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum SequenceResumeError {
    /// There is nothing to resume.
    #[error("no fault is latched")]
    NotFaulted,
    /// The gripper may hold a part: where it would be let go nobody knows.
    #[error("{0}; take it out, and say that the gripper is empty")]
    GripperNotEmpty(GripperHolds),
    /// The controller cannot be reached.
    #[error(transparent)]
    Connect(#[from] ConnectError),
    /// The hold by command could not be taken back.
    #[error("hold cannot be released: {cause}")]
    Hold {
        /// Why.
        cause: String,
    },
    /// The controller does not resume.
    #[error(transparent)]
    Controller(#[from] ResumeError),
}

/// Ends of a step other than done.
enum Ended {
    Fault(SequenceFault),
    /// Not executed, for a reason that lies in its target.
    NotReached(String),
    Missed,
    /// The sequence is to end.
    Stopped {
        phase: Phase,
        reason: String,
        /// It was ended on its way.
        in_motion: bool,
    },
}

/// Why a pick is handled.
struct Handling<'a> {
    part: &'a str,
    frame: u64,
}

/// The sequence; see the module documentation.
#[derive(Debug)]
pub struct Sequence<C, K> {
    controller: C,
    clock: K,
    options: SequenceOptions,
    planner: Planner,
    state: SequenceState,
    holds: GripperHolds,
    filled: Vec<Option<Filled>>,
    missed: Vec<u32>,
    last_id: CommandId,
    /// Frames from before this show what is no longer so.
    fresh_after: Duration,
    ready_since: Duration,
    misses: u32,
    /// Why the robot cannot move at the moment though nothing is wrong: a hold, or a motion of somebody else.
    waits_for: Option<NotReady>,
    tool: Pose,
    /// Where the last motion has left it, if one has.
    left_at: Option<Pose>,
    /// The last command ended by a hold.
    ended_by_hold: bool,
    /// A command has been given.
    has_begun: bool,
}

/// Distance from where the last motion has left the tool from which on somebody else has moved it, mm.
const MOVED_MM: f64 = 2.0;

impl<C: Controller, K: Clock> Sequence<C, K> {
    /// A sequence over a controller that is connected, or will be. Ids of commands follow on `last_id`.
    pub fn new(controller: C, clock: K, options: SequenceOptions, planner: Planner, last_id: CommandId) -> Self {
        let slots = planner.order.len();
        let (now, tool) = (clock.now(), options.home);
        Self {
            controller,
            clock,
            options,
            planner,
            state: SequenceState::FromHome,
            holds: GripperHolds::Nothing,
            filled: vec![None; slots],
            missed: vec![0; slots],
            last_id,
            fresh_after: now,
            ready_since: now,
            misses: 0,
            waits_for: None,
            tool,
            left_at: None,
            ended_by_hold: false,
            has_begun: false,
        }
    }

    /// Goes on with other speeds, heights and times, between two picks. The assembly list stays what it is: what is filled belongs
    /// to it.
    pub fn change(&mut self, options: SequenceOptions, planner: Planner) {
        let order = std::mem::take(&mut self.planner.order);
        (self.options, self.planner) = (options, Planner { order, ..planner });
    }

    /// Where it stands.
    pub fn state(&self) -> &SequenceState {
        &self.state
    }

    /// Slots that are filled, in the order of the assembly list.
    pub fn filled(&self) -> impl Iterator<Item = bool> + '_ {
        self.filled.iter().map(Option::is_some)
    }

    /// The time on the robot's clock from which on a frame is fresh enough to be worked with.
    pub fn fresh_after(&self) -> Duration {
        self.fresh_after
    }

    /// The id of the last command.
    pub fn last_id(&self) -> CommandId {
        self.last_id
    }

    /// The controller, for what is not a motion.
    pub fn controller(&mut self) -> &mut C {
        &mut self.controller
    }

    /// Goes home: up to the safe height first if the tool is below it.
    pub fn go_home(&mut self, log: &mut impl SequenceLog) {
        if self.state != SequenceState::FromHome && self.state != SequenceState::Complete {
            return;
        }
        let complete = self.state == SequenceState::Complete;
        let end = self.home(log);
        if self.settle(end, log).is_some() && !complete {
            self.ready();
        }
    }

    fn home(&mut self, log: &mut impl SequenceLog) -> Result<(), Ended> {
        self.controller.base_on(None);
        let mut at = self.look(Phase::Home, log)?.position;
        if at.z_mm < self.options.safe_z_mm - 0.5 {
            at.z_mm = self.options.safe_z_mm;
            self.line(Phase::Lift, at, None, log)?;
        }
        let home = self.options.home;
        self.joint(Phase::Home, home, None, log)
    }

    fn ready(&mut self) {
        let now = self.clock.now();
        // A fault after the last part was let go, or on the way home, empties no slot.
        let is_full = self.filled.iter().all(Option::is_some);
        self.state = if is_full { SequenceState::Complete } else { SequenceState::Ready };
        self.ready_since = now;
        self.fresh_after = self.fresh_after.max(now);
    }

    /// Works with what a frame has shown: picks the next part that can be picked and places it. Returns what became of it; `None`
    /// when nothing can be picked, when the frame is older than [`fresh_after`](Self::fresh_after), or on a fault.
    pub fn work(&mut self, sight: &Sight, log: &mut impl SequenceLog) -> Option<PickReport> {
        if self.state != SequenceState::Ready || self.waits_for.is_some() || sight.taken_at < self.fresh_after {
            return None;
        }
        let (pick, passed_over) = self.planner.choose(sight, &self.filled, &self.missed, &self.tool);
        log.passed_over(sight.frame, &passed_over);
        let pick = pick?;
        let start = self.clock.now();
        let ms = |duration: Duration| duration.as_secs_f64() * 1000.0;
        let mut report = PickReport {
            slot: pick.slot,
            part: pick.part.clone(),
            frame: sight.frame,
            score: pick.score,
            gap_ms: ms(start.saturating_sub(sight.taken_at)),
            waited_ms: ms(start.saturating_sub(self.ready_since)),
            took_ms: 0.0,
            result: PickResult::Placed,
        };
        self.controller.base_on(Some(Sighting { taken_at: sight.taken_at, score: pick.score }));
        let end = self.pick_and_place(&pick, sight.frame, log);
        self.controller.base_on(None);
        report.took_ms = ms(self.clock.now().saturating_sub(start));
        let result = match end {
            Err(Ended::Missed) => {
                self.missed[pick.slot] += 1;
                PickResult::Missed
            }
            Err(Ended::NotReached(reason)) => {
                self.missed[pick.slot] += 1;
                PickResult::NotReached { reason }
            }
            end => {
                self.settle(end, log)?;
                PickResult::Placed
            }
        };
        if result != PickResult::Placed {
            // What was seen is not so, or cannot be gone to: only a new frame tells, and one without the arm over the part.
            (self.state, self.fresh_after) = (SequenceState::FromHome, self.clock.now());
        }
        report.result = result;
        log.picked(&report);
        self.ready_since = self.clock.now();
        if self.filled.iter().all(Option::is_some) {
            self.state = SequenceState::Complete;
        }
        Some(report)
    }

    fn pick_and_place(&mut self, pick: &Pick, frame: u64, log: &mut impl SequenceLog) -> Result<(), Ended> {
        let handling = Handling { part: &pick.part, frame };
        let handling = Some(&handling);
        self.joint(Phase::Above, pick.above, handling, log)?;
        self.gripper(Phase::Open, GripperCommand::Open, handling, log)?;
        self.line(Phase::Down, pick.grasp, handling, log)?;
        // From here on the part may be in the gripper, and what was seen has been used up.
        self.controller.base_on(None);
        self.holds = GripperHolds::Perhaps(pick.part.clone());
        self.gripper(Phase::Close, GripperCommand::Close, handling, log)?;
        let held = self.look(Phase::Close, log)?.status.gripper;
        match held {
            GripperState::Holding => self.holds = GripperHolds::Part(pick.part.clone()),
            GripperState::Empty => self.holds = GripperHolds::Nothing,
            // Without a sensor it stays a guess.
            _ => {}
        }
        self.line(Phase::Up, pick.above, handling, log)?;
        if held == GripperState::Empty || self.look(Phase::Up, log)?.status.gripper == GripperState::Empty {
            self.holds = GripperHolds::Nothing;
            return Err(Ended::Missed);
        }
        self.joint(Phase::AboveSlot, pick.above_slot, handling, log)?;
        self.line(Phase::DownSlot, pick.release, handling, log)?;
        self.gripper(Phase::Release, GripperCommand::Open, handling, log)?;
        self.holds = GripperHolds::Nothing;
        self.filled[pick.slot] = Some(pick.fills.clone());
        // From here on a frame shows the table without the part: the camera may look while the arm goes up.
        self.fresh_after = self.clock.now();
        self.line(Phase::UpSlot, pick.above_slot, handling, log)
    }

    /// Takes in how a step ended. `None` on a fault or a stop.
    fn settle(&mut self, end: Result<(), Ended>, log: &mut impl SequenceLog) -> Option<()> {
        match end {
            Ok(()) => Some(()),
            Err(Ended::Stopped { phase, reason, in_motion }) => {
                if in_motion {
                    // It is on hold by now: that is what has ended it.
                    log.cut_short(&self.fault(Some(phase), reason));
                } else if self.holds != GripperHolds::Nothing {
                    self.leave_held(Some(phase), reason, log);
                }
                self.state = SequenceState::Stopped { holds: self.holds.clone() };
                None
            }
            Err(Ended::Fault(fault)) => {
                self.latch(fault, log);
                None
            }
            // Told by the caller in its report; home and the lift never end so.
            Err(Ended::NotReached(_) | Ended::Missed) => Some(()),
        }
    }

    fn fault(&self, phase: Option<Phase>, reason: String) -> SequenceFault {
        SequenceFault { reason, phase, holds: self.holds.clone(), held_by: None }
    }

    fn latch(&mut self, fault: SequenceFault, log: &mut impl SequenceLog) {
        self.controller.latch(&fault.reason);
        log.fault(&fault);
        self.state = SequenceState::Faulted(fault);
    }

    /// Leaves the robot on hold, which outlives this program: the next one then asks an operator before it moves.
    fn leave_held(&mut self, phase: Option<Phase>, mut reason: String, log: &mut impl SequenceLog) {
        if let Err(cause) = hold_anyway(&mut self.controller) {
            reason += &format!("; the robot is not left on hold: {cause}");
        }
        log.cut_short(&self.fault(phase, reason));
    }

    /// The program ends. A robot that stands by a fault with something in its gripper is left on hold, for the fault itself is
    /// forgotten.
    pub fn leave(&mut self, log: &mut impl SequenceLog) {
        if let SequenceState::Faulted(fault) = &self.state
            && self.holds != GripperHolds::Nothing
        {
            let (phase, reason) = (fault.phase, fault.reason.clone());
            self.leave_held(phase, reason, log);
        }
    }

    /// Looks at a robot that stands: call it at least every 100 ms. Latches what would have ended a motion, and five reports missed
    /// in a row.
    pub fn watch(&mut self, log: &mut impl SequenceLog) {
        if matches!(self.state, SequenceState::Faulted(_)) {
            return;
        }
        let mut state = self.read_state();
        if state.is_err() && !self.has_begun {
            // One that has been given nothing is waited for: it may be switched on later than this machine.
            state = match self.controller.connect() {
                Ok(()) => self.read_state(),
                Err(ConnectError::BackingOff { .. }) if self.waits_for.is_some() => return,
                Err(error) => Err(error.to_string()),
            };
            if let Err(cause) = state {
                self.waits_for = Some(NotReady::NotConnected { cause });
                return;
            }
        }
        let reason = match state {
            Ok(state) => {
                self.misses = 0;
                log.state(&state);
                self.tool = state.position;
                self.waits_for = state.status.check_ready().err();
                match &self.waits_for {
                    None => {
                        // From where somebody else has put the tool the way to a part may be blocked: up and home first.
                        if self.state == SequenceState::Ready && self.is_elsewhere(&state.position) {
                            self.state = SequenceState::FromHome;
                        }
                        return;
                    }
                    // Nobody else takes it back, and what its gripper holds nobody here knows.
                    Some(NotReady::Hold { by: "command" }) if !self.has_begun => {
                        self.holds = GripperHolds::Perhaps("part of an earlier run".to_owned());
                        "the robot is on hold by command: an earlier run was ended in its work".to_owned()
                    }
                    // A hold that was set while the robot stood has stopped nothing.
                    Some(NotReady::Hold { .. } | NotReady::Running) => return,
                    Some(reason) => reason.to_string(),
                }
            }
            Err(reason) => {
                self.misses += 1;
                if self.misses < MOST_MISSES {
                    return;
                }
                // At rest nothing is lost by a broken connection: make it anew, then go on watching.
                match self.controller.connect() {
                    Ok(()) => {
                        self.misses = 0;
                        return;
                    }
                    // Too early for an attempt: one of the next looks makes it.
                    Err(ConnectError::BackingOff { .. }) => return,
                    Err(_) => format!("{} status reports missed in a row: {reason}", self.misses),
                }
            }
        };
        let fault = self.fault(None, reason);
        self.latch(fault, log);
    }

    fn is_elsewhere(&self, position: &Pose) -> bool {
        self.left_at.is_some_and(|left_at| left_at.distance_mm(position) > MOVED_MM)
    }

    fn read_state(&mut self) -> Result<RobotState, String> {
        let status = self.controller.status().map_err(|e| e.to_string())?;
        let position = self.controller.position().map_err(|e| e.to_string())?;
        Ok(RobotState { status, position })
    }

    /// An empty jig has been put in place of the full one: begins anew from home. False when the jig was not full.
    pub fn new_jig(&mut self) -> bool {
        if self.state != SequenceState::Complete {
            return false;
        }
        self.filled.fill(None);
        self.missed.fill(0);
        (self.state, self.fresh_after) = (SequenceState::FromHome, self.clock.now());
        true
    }

    /// Why the robot is not given anything though no fault is latched, if so.
    pub fn waits_for(&self) -> Option<&NotReady> {
        self.waits_for.as_ref()
    }

    /// Somebody wants the robot to stand: puts it on hold and latches that. A motion is reached through a
    /// [`HoldSwitch`](crate::HoldSwitch); this is for a robot that stands, and to say who has stopped one that moved.
    ///
    /// # Errors
    /// Why it did not reach the robot, which may still be moving; it is latched all the same.
    pub fn hold(&mut self, reason: HoldReason, log: &mut impl SequenceLog) -> Result<(), String> {
        self.hold_because(reason, &reason.to_string(), log)
    }

    /// [`hold`](Self::hold) in words of its own, which are told with the fault.
    ///
    /// # Errors
    /// As [`hold`](Self::hold).
    pub fn hold_because(&mut self, reason: HoldReason, words: &str, log: &mut impl SequenceLog) -> Result<(), String> {
        let held = hold_anyway(&mut self.controller);
        let held = held.map_err(|e| format!("{words} did not reach the robot: {e}"));
        match &mut self.state {
            SequenceState::Faulted(fault) if self.ended_by_hold && fault.held_by.is_none() => {
                // The switch was faster than the words.
                fault.reason = format!("{words}, {}", fault.reason);
                fault.held_by = Some(reason);
                self.controller.latch(&fault.reason);
                log.fault(fault);
            }
            SequenceState::Faulted(_) => {}
            _ => {
                let text = held.clone().err().unwrap_or_else(|| words.to_owned());
                let fault = SequenceFault { held_by: Some(reason), ..self.fault(None, text) };
                self.latch(fault, log);
            }
        }
        held
    }

    /// An operator has looked: reads the position back, and begins anew from home.
    ///
    /// `gripper_is_empty` says that the operator has taken out what the gripper may have held.
    ///
    /// # Errors
    /// [`SequenceResumeError`]; the fault then stays latched.
    pub fn resume(&mut self, gripper_is_empty: bool) -> Result<Pose, SequenceResumeError> {
        if !matches!(self.state, SequenceState::Faulted(_)) {
            return Err(SequenceResumeError::NotFaulted);
        }
        if self.holds != GripperHolds::Nothing && !gripper_is_empty {
            return Err(SequenceResumeError::GripperNotEmpty(self.holds.clone()));
        }
        let status = match self.controller.status() {
            Ok(status) => status,
            Err(StatusError::NotConnected | StatusError::NoAnswer { .. } | StatusError::Malformed { .. }) => {
                self.connect_once()?;
                self.controller.status().map_err(ResumeError::from)?
            }
        };
        // The hold that stopped the robot was this program's own.
        if status.hold_command {
            self.controller.hold(false).map_err(|e| SequenceResumeError::Hold { cause: e.to_string() })?;
        }
        let position = self.controller.resume()?;
        (self.holds, self.misses, self.waits_for, self.tool) = (GripperHolds::Nothing, 0, None, position);
        (self.left_at, self.ended_by_hold) = (None, false);
        self.missed.fill(0);
        (self.state, self.fresh_after) = (SequenceState::FromHome, self.clock.now());
        Ok(position)
    }

    /// Looks at the robot between two commands. Nothing is lost by a connection that breaks over a look: it is made anew, once.
    fn look(&mut self, phase: Phase, log: &mut impl SequenceLog) -> Result<RobotState, Ended> {
        let mut state = self.read_state();
        if state.is_err() && self.reconnect(log) {
            state = self.read_state();
        }
        match state {
            Ok(state) => {
                log.state(&state);
                Ok(state)
            }
            Err(reason) => Err(Ended::Fault(self.fault(Some(phase), reason))),
        }
    }

    fn joint(
        &mut self,
        phase: Phase,
        target: Pose,
        handling: Option<&Handling<'_>>,
        log: &mut impl SequenceLog,
    ) -> Result<(), Ended> {
        let motion = Motion::Joint { target, speed_fraction: self.options.joint_speed_fraction };
        let deadline = self.options.joint_timeout;
        self.carry(phase, Command::Move(motion), deadline, handling, log)
    }

    fn line(
        &mut self,
        phase: Phase,
        target: Pose,
        handling: Option<&Handling<'_>>,
        log: &mut impl SequenceLog,
    ) -> Result<(), Ended> {
        let speed_mm_s = self.options.linear_speed_mm_s;
        let motion = Motion::Linear { target, speed_mm_s };
        let deadline = FollowOptions::for_motion(self.tool.distance_mm(&target), speed_mm_s).deadline;
        self.carry(phase, Command::Move(motion), deadline, handling, log)
    }

    fn gripper(
        &mut self,
        phase: Phase,
        gripper: GripperCommand,
        handling: Option<&Handling<'_>>,
        log: &mut impl SequenceLog,
    ) -> Result<(), Ended> {
        let deadline = self.options.gripper_timeout;
        self.carry(phase, Command::Gripper { gripper }, deadline, handling, log)
    }

    /// Gives one command and sees it through.
    fn carry(
        &mut self,
        phase: Phase,
        command: Command,
        deadline: Duration,
        handling: Option<&Handling<'_>>,
        log: &mut impl SequenceLog,
    ) -> Result<(), Ended> {
        let mut again = true;
        loop {
            if log.is_stopping() {
                let reason = "told to end before it was begun".to_owned();
                return Err(Ended::Stopped { phase, reason, in_motion: false });
            }
            self.last_id.0 += 1;
            self.has_begun = true;
            let id = self.last_id;
            let (part, frame) = (handling.map(|handling| handling.part), handling.map(|handling| handling.frame));
            let purpose = Purpose { phase, part, frame, holds: &self.holds };
            if let Err(cause) = log.command(id, &command, &purpose) {
                let reason = format!("command {id} could not be recorded, so it was not given: {cause}");
                return Err(Ended::Fault(self.fault(Some(phase), reason)));
            }
            let (end, kind) = self.give(id, &command, deadline, log);
            log.outcome(id, &end);
            let in_motion = matches!(end, Outcome::Aborted { reason: AbortReason::Hold });
            self.ended_by_hold = in_motion || matches!(end, Outcome::NotExecuted { .. }) && kind == NotGiven::Held;
            // By the hold that ends it, and not by a fault of its own.
            let is_told_to_end = log.is_stopping() && (in_motion || matches!(end, Outcome::NotExecuted { .. }));
            let reason = match end {
                Outcome::Done => {
                    if let Some(target) = command.target() {
                        (self.tool, self.left_at) = (*target, Some(*target));
                    }
                    return Ok(());
                }
                Outcome::NotExecuted { reason } => match kind {
                    // It did not happen for certain, and a new connection says where the robot is.
                    NotGiven::Connection if again && self.reconnect(log) => {
                        again = false;
                        let position = self.look(phase, log)?.position;
                        if !self.is_elsewhere(&position) {
                            continue;
                        }
                        format!("command {id} was not executed: {reason}; meanwhile somebody has moved the robot")
                    }
                    // From below the tool must go up before anything else is tried.
                    NotGiven::Target if matches!(phase, Phase::Above | Phase::Down) => {
                        return Err(Ended::NotReached(reason));
                    }
                    _ => format!("command {id} was not executed: {reason}"),
                },
                end @ (Outcome::Aborted { .. } | Outcome::Unknown { .. } | Outcome::Accepted) => {
                    format!("command {id}: {end}")
                }
            };
            // The gripper was told to move: whether it did is not known.
            if let (Phase::Release, GripperHolds::Part(part)) = (phase, self.holds.clone()) {
                self.holds = GripperHolds::Perhaps(part);
            }
            if is_told_to_end {
                return Err(Ended::Stopped { phase, reason: format!("told to end; {reason}"), in_motion });
            }
            return Err(Ended::Fault(self.fault(Some(phase), reason)));
        }
    }

    fn give(
        &mut self,
        id: CommandId,
        command: &Command,
        deadline: Duration,
        log: &mut impl SequenceLog,
    ) -> (Outcome, NotGiven) {
        let started = match command {
            Command::Move(motion) => {
                self.controller.start_motion(id, motion).map_err(|e| (e.outcome(), NotGiven::of_motion(&e)))
            }
            Command::Gripper { gripper } => {
                self.controller.start_gripper(id, *gripper).map_err(|e| (e.outcome(), NotGiven::of_gripper(&e)))
            }
            Command::Hold { on } => match self.controller.hold(*on) {
                Ok(()) => return (Outcome::Done, NotGiven::Otherwise),
                Err(e) => return (Outcome::Unknown { reason: e.to_string() }, NotGiven::Otherwise),
            },
        };
        if let Err(not_given) = started {
            return not_given;
        }
        log.outcome(id, &Outcome::Accepted);
        let options = FollowOptions { interval: self.options.poll_interval, deadline, ..FollowOptions::default() };
        let end = follow(&mut self.controller, &self.clock, id, &options, |progress| log.state(&progress.state));
        (end, NotGiven::Otherwise)
    }

    /// Makes the connection anew, with back-off; false when it cannot be made.
    fn reconnect(&mut self, log: &mut impl SequenceLog) -> bool {
        for wait_ms in BACK_OFF_MS {
            if log.is_stopping() {
                return false;
            }
            if self.connect_once().is_ok() {
                return true;
            }
            for _ in 0..wait_ms / STEP_MS {
                if log.is_stopping() {
                    return false;
                }
                self.clock.sleep(Duration::from_millis(STEP_MS));
            }
        }
        self.connect_once().is_ok()
    }

    /// One attempt to connect, after the wait that the controller demands from the last one that failed.
    fn connect_once(&mut self) -> Result<(), ConnectError> {
        match self.controller.connect() {
            Err(ConnectError::BackingOff { wait_ms, .. }) => {
                // It is told in whole milliseconds, rounded down.
                self.clock.sleep(Duration::from_millis(wait_ms + 1));
                self.controller.connect()
            }
            made => made,
        }
    }
}

/// Why a command was certainly not executed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum NotGiven {
    /// The connection broke before it.
    Connection,
    /// Its target cannot be gone to.
    Target,
    /// Somebody wants the robot to stand.
    Held,
    Otherwise,
}

impl NotGiven {
    fn of_motion(error: &MotionError) -> Self {
        match error {
            MotionError::NotConnected | MotionError::NotSent { .. } => Self::Connection,
            MotionError::HoldAsked => Self::Held,
            MotionError::Target(_)
            | MotionError::OutOfReach { .. }
            | MotionError::Singular { .. }
            | MotionError::Limit { .. } => Self::Target,
            _ => Self::Otherwise,
        }
    }

    fn of_gripper(error: &GripperError) -> Self {
        match error {
            GripperError::NotConnected | GripperError::NotSent { .. } => Self::Connection,
            GripperError::HoldAsked => Self::Held,
            _ => Self::Otherwise,
        }
    }
}
