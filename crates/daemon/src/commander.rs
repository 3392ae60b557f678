//! The robot thread: everything that moves the robot, each command written to the recording before it is given.
//!
//! Input: what vision sees, of which the newest counts, and an operator's requests. Output: commands and outcomes in the recording,
//! counts, and a [`RobotReport`]. Vision only ever touches a lock that is held for some instructions.
//!
//! With an assembly list the robot works by it: a [`Sequence`] that is shown one sight after another. Without one it goes above
//! the best object of a frame, whenever it is idle.

use std::mem::{self, Discriminant};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{self, Receiver, SyncSender};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use samsod_frame::unix_time_ns;
use samsod_robot::{
    Command, CommandId, Controller, FollowOptions, GripperHolds, HoldReason, Limits, Motion, Outcome, PartTable,
    PassedOver, Phase, PickReport, PickResult, Planner, Pose, Purpose, Reason, RobotState, ScaledClock, Sequence,
    SequenceFault, SequenceLog, SequenceOptions, SequenceState, SharedLimits, Sight, Sighting, follow,
};
use serde::{Deserialize, Serialize};
use tracing::{debug, error, info, warn};

use crate::control::Request;
use crate::ending::Deadlines;
use crate::pulse::{EndsWith, Pulse};
use crate::recording::{CommandRecord, OutcomeRecord, Recorder, RecorderView};
use crate::watched::{RobotLook, SharedLook};

/// How often a robot that stands is looked at.
const WATCH_INTERVAL: Duration = Duration::from_millis(100);
/// How often a robot that is not ready is asked again.
const READY_INTERVAL: Duration = Duration::from_millis(500);

/// How often it is looked whether the end of the robot thread is to be waited for any longer.
const END_TICK: Duration = Duration::from_millis(20);

/// Picks that a report tells of: the last ones.
const MOST_PICKS: usize = 1000;

/// What vision shows the robot.
#[derive(Debug, Clone)]
pub(crate) struct Shown {
    pub(crate) frame_sequence: u64,
    pub(crate) frame_timestamp_ns: u64,
    /// The same on the clock of the robot.
    pub(crate) taken_at: Duration,
    pub(crate) content: Content,
}

/// What the robot does about a frame.
#[derive(Debug, Clone)]
pub(crate) enum Content {
    /// It goes there.
    Above(Pose),
    /// It works with that.
    Sight(Sight),
}

/// What the robot thread does.
#[derive(Debug)]
pub(crate) enum Task {
    /// Goes above the best object of a frame.
    GoAbove { speed_fraction: f64, timeout: Duration },
    /// Places parts by the assembly list.
    Assemble { options: Box<SequenceOptions>, planner: Box<Planner> },
}

/// What the robot thread goes on with.
#[derive(Debug)]
pub(crate) struct RobotSettings {
    pub(crate) limits: Limits,
    /// Of the same kind as before, with the same assembly list.
    pub(crate) task: Task,
}

/// What became of the commands.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct CommandCounts {
    /// Written to the recording and given to the controller.
    pub sent: u64,
    /// Executed to their end.
    pub done: u64,
    /// For certain not executed, e.g. out of reach.
    pub not_executed: u64,
    /// Stopped on the way.
    pub aborted: u64,
    /// Of unknown outcome.
    pub unknown: u64,
}

/// How the robot and its work stand.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct RobotReport {
    /// Name of the controller.
    pub controller: String,
    /// Where the sequence stands; none in a cell without an assembly list.
    pub sequence: Option<SequenceState>,
    /// Why the robot is given nothing though no fault is latched, if so.
    pub waits_for: Option<String>,
    /// Where the tool was when it was last looked at, `base_from_tool`.
    pub position: Option<Pose>,
    /// Whether each slot is filled, in the order of the assembly list.
    pub filled: Vec<bool>,
    /// Every pick so far.
    pub picks: Vec<PickReport>,
    /// Why parts were passed over in the last frame, in words.
    pub passed_over: Vec<String>,
    /// Commands so far.
    pub commands: CommandCounts,
}

/// What became of the picks since the start; a report holds the last ones only.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct PickCounts {
    pub(crate) placed: u64,
    pub(crate) missed: u64,
    pub(crate) not_reached: u64,
}

/// How robot and work stand, in short.
#[derive(Debug, Clone)]
pub(crate) struct Standing {
    pub(crate) sequence: Option<SequenceState>,
    pub(crate) waits_for: Option<String>,
    pub(crate) commands: CommandCounts,
    pub(crate) picks: PickCounts,
    pub(crate) look: RobotLook,
    /// The thread has ended by itself, or is about to because the service is.
    pub(crate) has_stopped: bool,
}

/// What the robot is at, for whoever watches it.
#[derive(Debug, Clone, Default)]
pub(crate) struct Work {
    pub(crate) report: RobotReport,
    /// The step of the command that was given last, and the part that it handles; none while the robot waits.
    pub(crate) step: Option<(Phase, Option<String>)>,
    /// The parts that were passed over in the last frame.
    pub(crate) passed_over: Vec<PassedOver>,
}

/// A step of the sequence that was begun.
#[derive(Debug, Clone)]
struct Step {
    phase: Phase,
    part: Option<String>,
    /// What the gripper held then.
    holds: GripperHolds,
}

impl Step {
    fn of(purpose: &Purpose<'_>) -> Self {
        let part = purpose.part.map(str::to_owned);
        Self { phase: purpose.phase, part, holds: purpose.holds.clone() }
    }
}

type Reply = SyncSender<Result<RobotReport, String>>;

#[derive(Debug, Default)]
struct State {
    idle: bool,
    ending: bool,
    shown: Option<Shown>,
    requests: Vec<Asked>,
    /// Taken when no motion and no pick is under way, and then told.
    settings: Option<(Box<RobotSettings>, SyncSender<()>)>,
    /// Vision still sees by the old settings: nothing is shown.
    holds_back: bool,
    /// The robot thread has ended: nobody answers any more.
    ended: bool,
    report: RobotReport,
    picks: PickCounts,
    passed_over: Vec<PassedOver>,
    has_stopped: bool,
    /// The command whose end is not known yet.
    in_flight: Option<CommandId>,
    /// The last step that was begun.
    step: Option<Step>,
    /// It is over: the robot waits.
    is_step_over: bool,
    /// The robot thread is not waited for any more: whatever it does still is not recorded, and it is given nothing.
    is_given_up: bool,
}

/// A request on its way to the robot thread.
#[derive(Debug)]
struct Asked {
    request: Request,
    /// Of a hold: who wants it.
    hold_reason: HoldReason,
    /// Whoever asked has gone away by then.
    until: Instant,
    reply: Reply,
}

#[derive(Debug, Default)]
struct Shared {
    state: Mutex<State>,
    wake: Condvar,
    /// The robot thread has ended.
    gone: Condvar,
    /// Without taking the lock: asked at every command.
    stopping: AtomicBool,
}

impl Shared {
    /// Every statement leaves the state valid, so a panic elsewhere does not spoil it.
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A connection of the operator to the robot thread.
#[derive(Debug, Clone)]
pub(crate) struct Operator {
    shared: Arc<Shared>,
    pulse: Arc<Pulse>,
    look: Arc<SharedLook>,
    hold_asked: Arc<AtomicBool>,
    recorder: RecorderView,
}

impl Operator {
    /// Of the robot thread.
    pub(crate) fn pulse(&self) -> &Pulse {
        &self.pulse
    }

    pub(crate) fn standing(&self) -> Standing {
        let state = self.shared.lock();
        Standing {
            sequence: state.report.sequence.clone(),
            waits_for: state.report.waits_for.clone(),
            commands: state.report.commands,
            picks: state.picks,
            look: self.look.get(),
            has_stopped: state.has_stopped || state.ending,
        }
    }

    /// How the work stands, with the last picks only.
    pub(crate) fn work(&self, most_picks: usize) -> Work {
        let state = self.shared.lock();
        let RobotReport { controller, sequence, waits_for, position, filled, picks, passed_over: _, commands } =
            &state.report;
        let report = RobotReport {
            controller: controller.clone(),
            sequence: sequence.clone(),
            waits_for: waits_for.clone(),
            position: *position,
            filled: filled.clone(),
            picks: picks[picks.len().saturating_sub(most_picks)..].to_vec(),
            passed_over: Vec::new(),
            commands: *commands,
        };
        let step = state.step.as_ref().filter(|_| !state.is_step_over);
        let step = step.map(|step| (step.phase, step.part.clone()));
        Work { report, step, passed_over: state.passed_over.clone() }
    }

    /// A motion in flight is put on hold at its next poll; returns at once. [`Self::ask`] for a hold latches the robot, too.
    pub(crate) fn stop_motion(&self) {
        self.hold_asked.store(true, Ordering::SeqCst);
    }

    /// Has the robot stand until an operator resumes it; does not wait for that.
    pub(crate) fn hold(&self, hold_reason: HoldReason) {
        self.hold_asked.store(true, Ordering::SeqCst);
        // Nobody waits for the answer.
        let (reply, _) = mpsc::sync_channel(1);
        // Nobody waits for the answer, so nobody gives up.
        let until = Instant::now() + Duration::from_secs(600);
        self.shared.lock().requests.push(Asked { request: Request::Hold, hold_reason, until, reply });
        self.shared.wake.notify_one();
    }

    /// Asks, and waits for the answer.
    pub(crate) fn ask(&self, request: Request, patience: Duration) -> Result<RobotReport, String> {
        match request {
            Request::Status => return Ok(self.shared.lock().report.clone()),
            // Reaches a motion in flight at its next poll; the request itself latches a robot that stands.
            Request::Hold => self.hold_asked.store(true, Ordering::SeqCst),
            // It would be held again at once.
            Request::Resume { .. } => {
                if let Some(reason) = self.recorder.holds_robot() {
                    return Err(format!("not resumed, for the robot is held while {reason}"));
                }
            }
            Request::NewJig => {}
        }
        let (reply, answer) = mpsc::sync_channel(1);
        {
            let mut state = self.shared.lock();
            if state.ended {
                return Err("the robot thread has ended".to_owned());
            }
            // A resume is for the fault that the operator has looked at, never for one that is still to come.
            let is_faulted = matches!(state.report.sequence, None | Some(SequenceState::Faulted(_)));
            if matches!(request, Request::Resume { .. }) && !is_faulted {
                return Err("no fault is latched".to_owned());
            }
            let (hold_reason, until) = (HoldReason::Operator, Instant::now() + patience);
            state.requests.push(Asked { request, hold_reason, until, reply });
        }
        self.shared.wake.notify_one();
        answer
            .recv_timeout(patience)
            .unwrap_or_else(|_| Err(format!("the robot thread gave no answer within {patience:?}")))
    }
}

/// The robot thread, seen from vision.
#[derive(Debug)]
pub(crate) struct Commander {
    shared: Arc<Shared>,
    operator: Operator,
    clock: ScaledClock,
    table: Option<PartTable>,
    works_with_sights: bool,
    recorder: Arc<Recorder>,
    /// Until somebody waits for its end.
    thread: Mutex<Option<JoinHandle<()>>>,
}

/// What the robot thread is started with.
pub(crate) struct Robot {
    pub(crate) controller: Box<dyn Controller>,
    pub(crate) clock: ScaledClock,
    /// Those of the controller.
    pub(crate) limits: SharedLimits,
    /// The table of a simulated robot.
    pub(crate) table: Option<PartTable>,
    /// Set by the operator; the controller looks at it.
    pub(crate) hold_asked: Arc<AtomicBool>,
    /// Beaten by the controller, and by the thread.
    pub(crate) pulse: Arc<Pulse>,
    /// The state of the controller.
    pub(crate) look: Arc<SharedLook>,
}

impl Commander {
    /// Starts the thread on a controller that is connected.
    pub(crate) fn start(robot: Robot, task: Task, recorder: Arc<Recorder>) -> std::io::Result<Self> {
        let Robot { controller, clock, limits, table, hold_asked, pulse, look } = robot;
        let shared = Arc::new(Shared::default());
        shared.lock().report.controller = controller.name().to_owned();
        let works_with_sights = matches!(task, Task::Assemble { .. });
        let for_thread = Arc::clone(&shared);
        let end = EndOfThread { shared: Arc::clone(&shared) };
        let log = ThreadLog {
            recorder: Arc::clone(&recorder),
            shared: Arc::clone(&shared),
            pulse: Arc::clone(&pulse),
            limits,
            shown: None,
            picks: 0,
            is_picking: false,
            passed_over: Vec::new(),
        };
        let (of_robot, view) = (Arc::clone(&pulse), recorder.view());
        let operator = Operator { shared: Arc::clone(&shared), pulse: of_robot, look, hold_asked, recorder: view };
        let run = move || {
            let _ends = EndsWith(&pulse);
            let _end = end;
            match task {
                Task::GoAbove { speed_fraction, timeout } => {
                    GoAbove { controller, clock, speed_fraction, timeout, log, last_id: 0, is_held: false }.run();
                }
                Task::Assemble { options, planner } => {
                    let sequence = Sequence::new(controller, clock, *options, *planner, CommandId(0));
                    Assembly { sequence, log }.run();
                }
            }
            // Not reached by a panic: before the pulse ends, so that this end is not taken for one.
            for_thread.lock().has_stopped = true;
        };
        let thread = thread::Builder::new().name("robot".to_owned()).spawn(run)?;
        Ok(Self { shared, operator, clock, table, works_with_sights, recorder, thread: Mutex::new(Some(thread)) })
    }

    /// Whether the robot works with sights, rather than with a place to go to.
    pub(crate) fn works_with_sights(&self) -> bool {
        self.works_with_sights
    }

    /// The time so long ago on the robot's clock.
    pub(crate) fn ago(&self, age: Duration) -> Duration {
        self.clock.ago(age)
    }

    /// The operator's connection.
    pub(crate) fn operator(&self) -> Operator {
        self.operator.clone()
    }

    /// Shows what a frame has. A place to go to is taken if the robot is idle, and let go if not: it is old by the time that it
    /// could be gone to. A sight replaces the one before. Never waits for the robot.
    pub(crate) fn show(&self, shown: Shown) {
        let mut state = self.shared.lock();
        if state.ending || state.holds_back || (!self.works_with_sights && !state.idle) {
            return;
        }
        state.idle = false;
        state.shown = Some(shown);
        self.shared.wake.notify_one();
    }

    /// Has the robot go on with other settings as soon as no motion and no pick is under way; whoever asks is told then, or that the
    /// robot thread has ended. Nothing is shown to it until [`goes_on`](Self::goes_on).
    pub(crate) fn change(&self, settings: RobotSettings) -> Receiver<()> {
        let (done, taken) = mpsc::sync_channel(1);
        let mut state = self.shared.lock();
        state.holds_back = true;
        state.shown = None;
        if !state.ended {
            state.settings = Some((Box::new(settings), done));
            self.shared.wake.notify_one();
        }
        taken
    }

    /// Vision sees by the new settings, too.
    pub(crate) fn goes_on(&self) {
        self.shared.lock().holds_back = false;
    }

    /// Whether every slot of the jig is filled; or a fault, if one is latched.
    pub(crate) fn is_complete(&self) -> Option<Result<(), SequenceFault>> {
        match &self.shared.lock().report.sequence {
            Some(SequenceState::Complete) => Some(Ok(())),
            Some(SequenceState::Faulted(fault)) => Some(Err(fault.clone())),
            _ => None,
        }
    }

    /// The robot is to stand and to be given nothing more: a motion in flight is put on hold at its next poll. Does not wait.
    pub(crate) fn stand(&self) {
        self.operator.hold_asked.store(true, Ordering::SeqCst);
        self.shared.stopping.store(true, Ordering::SeqCst);
        let mut state = self.shared.lock();
        (state.ending, state.shown) = (true, None);
        self.shared.wake.notify_one();
    }

    /// Takes nothing more, waits until the command in flight has its outcome, and ends the thread. A place that was taken but not
    /// yet gone to is gone to only if `begin_last` says so.
    ///
    /// A motion in flight is followed to its end, unless the robot was told to [`stand`](Self::stand). If there are
    /// `deadlines`, a controller that has not answered by then is given up.
    pub(crate) fn finish(&self, begin_last: bool, deadlines: &dyn Fn() -> Option<Deadlines>) -> RobotReport {
        self.end(begin_last, deadlines);
        if let Some(failure) = self.table.as_ref().and_then(PartTable::failure) {
            error!(error = %failure, "the table of the simulated robot is not what its file says");
        }
        self.shared.lock().report.clone()
    }

    fn end(&self, begin_last: bool, deadlines: &dyn Fn() -> Option<Deadlines>) {
        let Some(thread) = self.thread.lock().unwrap_or_else(PoisonError::into_inner).take() else { return };
        self.shared.stopping.store(true, Ordering::SeqCst);
        let mut state = self.shared.lock();
        state.ending = true;
        if !begin_last {
            state.shown = None;
        }
        self.shared.wake.notify_one();
        while !state.ended {
            if deadlines().is_some_and(|until| Instant::now() >= until.robot) {
                return self.give_up(state);
            }
            state = self.shared.gone.wait_timeout(state, END_TICK).unwrap_or_else(PoisonError::into_inner).0;
        }
        drop(state);
        if thread.join().is_err() {
            error!("the robot thread panicked; the outcome of its last command is not known");
        }
    }

    /// Writes down what is known of a robot whose controller does not answer in time.
    fn give_up(&self, mut state: MutexGuard<'_, State>) {
        state.is_given_up = true;
        let in_flight = state.in_flight.take();
        state.report.commands.unknown += u64::from(in_flight.is_some());
        let (phase, holds) = match state.step.clone().map(|step| (step.phase, step.holds)) {
            // It may have been let go by now, or gripped.
            Some((phase @ (Phase::Close | Phase::Release), GripperHolds::Part(part) | GripperHolds::Perhaps(part))) => {
                (Some(phase), GripperHolds::Perhaps(part))
            }
            Some((phase, holds)) => (Some(phase), holds),
            None => (None, GripperHolds::Nothing),
        };
        if self.works_with_sights {
            state.report.sequence = Some(SequenceState::Stopped { holds: holds.clone() });
        }
        drop(state);
        let mut reason = "told to end, and the controller did not answer in time".to_owned();
        if let Some(id) = in_flight {
            reason += "; the robot may still be moving";
            let outcome = Outcome::Unknown { reason: reason.clone() };
            error!(%id, %outcome, "command ended");
            let record = OutcomeRecord { id, timestamp_ns: unix_time_ns(), outcome: &outcome };
            if let Err(e) = self.recorder.log_outcome(&record) {
                error!(%id, error = %e, "outcome not recorded");
            }
        }
        // One that has never been given anything stands as it was found.
        if phase.is_none() && in_flight.is_none() {
            return warn!("{reason}");
        }
        let cut = SequenceFault { reason, phase, holds, held_by: None };
        error!(%cut, "the robot is given up");
        if let Err(e) = self.recorder.log_fault(unix_time_ns(), &cut) {
            error!(error = %e, "fault not recorded");
        }
    }
}

impl Drop for Commander {
    fn drop(&mut self) {
        self.end(false, &|| None);
    }
}

impl Shared {
    /// The requests that wait, without those whose operator has given up: nothing is done that nobody waits for.
    fn requests(&self) -> Vec<Asked> {
        let requests = mem::take(&mut self.lock().requests);
        requests.into_iter().filter(|asked| Instant::now() < asked.until).collect()
    }
}

/// The robot thread has ended, however that came: those who still wait get no answer, and learn it at once.
struct EndOfThread {
    shared: Arc<Shared>,
}

impl Drop for EndOfThread {
    fn drop(&mut self) {
        let mut state = self.shared.lock();
        state.ended = true;
        state.requests.clear();
        state.settings = None;
        drop(state);
        self.shared.gone.notify_all();
    }
}

/// The recording, the counts and the log, for everything that the robot thread does.
struct ThreadLog {
    recorder: Arc<Recorder>,
    shared: Arc<Shared>,
    pulse: Arc<Pulse>,
    limits: SharedLimits,
    /// The frame that is being worked with: its number and time.
    shown: Option<(u64, u64)>,
    /// Picks that have ended; the next one is numbered after them.
    picks: u64,
    /// A command of the next pick has been given.
    is_picking: bool,
    /// Slots that were passed over in the last frame that passed over other ones, and the kind of the reason.
    passed_over: Vec<(usize, Discriminant<Reason>)>,
}

impl ThreadLog {
    fn begin(&mut self, id: CommandId, command: &Command, purpose: Option<&Purpose<'_>>) -> Result<(), String> {
        let record = CommandRecord {
            id,
            timestamp_ns: unix_time_ns(),
            frame_sequence: self.shown.map(|(sequence, _)| sequence),
            frame_timestamp_ns: self.shown.map(|(_, timestamp_ns)| timestamp_ns),
            phase: purpose.map(|purpose| purpose.phase),
            part: purpose.and_then(|purpose| purpose.part),
            command,
        };
        self.recorder.log_command(&record).map_err(|e| e.to_string())?;
        {
            let mut state = self.shared.lock();
            if state.is_given_up {
                return Err("samsodd has ended".to_owned());
            }
            state.report.commands.sent += 1;
            state.in_flight = Some(id);
            state.step = purpose.map(Step::of);
            state.is_step_over = false;
        }
        let (frame, part) = (record.frame_sequence, record.part);
        let phase = record.phase.map(tracing::field::display);
        // What handles a part belongs to a pick; it has begun with its first command.
        self.is_picking |= part.is_some();
        let pick = part.map(|_| self.picks + 1);
        let target = command.target().map(tracing::field::display);
        info!(command = id.0, frame, pick, phase, part, target, "command given");
        Ok(())
    }

    /// Goes on with new settings, if there are some. Call it when no motion and no pick is under way.
    fn take_settings(&self, change: impl FnOnce(Task)) {
        let Some((settings, done)) = self.shared.lock().settings.take() else { return };
        let RobotSettings { limits, task } = *settings;
        self.limits.set(limits);
        change(task);
        info!("the robot goes on with the new configuration");
        let _ = done.send(());
    }

    /// The acknowledgement of a command, and later its result.
    fn outcome_of(&self, id: CommandId, outcome: &Outcome) {
        {
            let mut state = self.shared.lock();
            if state.is_given_up {
                return;
            }
            if outcome.is_final() {
                state.in_flight = None;
                let counts = &mut state.report.commands;
                *match outcome {
                    Outcome::Done => &mut counts.done,
                    Outcome::NotExecuted { .. } => &mut counts.not_executed,
                    Outcome::Aborted { .. } => &mut counts.aborted,
                    Outcome::Accepted | Outcome::Unknown { .. } => &mut counts.unknown,
                } += 1;
            }
        }
        let (frame, pick) = (self.shown.map(|(frame, _)| frame), self.is_picking.then_some(self.picks + 1));
        match outcome {
            Outcome::Accepted => {}
            Outcome::Done => info!(command = id.0, frame, pick, %outcome, "command ended"),
            Outcome::NotExecuted { .. } | Outcome::Aborted { .. } => {
                warn!(command = id.0, frame, pick, %outcome, "command ended");
            }
            Outcome::Unknown { .. } => error!(command = id.0, frame, pick, %outcome, "command ended"),
        }
        let record = OutcomeRecord { id, timestamp_ns: unix_time_ns(), outcome };
        if let Err(e) = self.recorder.log_outcome(&record) {
            error!(command = id.0, frame, pick, error = %e, "outcome not recorded");
        }
    }

    fn state_of(&self, state: &RobotState) {
        // A failed recording is reported once, by vision; see `Recorder::failure`.
        let _ = self.recorder.log_robot_state(unix_time_ns(), state);
        self.shared.lock().report.position = Some(state.position);
    }
}

impl SequenceLog for ThreadLog {
    fn command(&mut self, id: CommandId, command: &Command, purpose: &Purpose<'_>) -> Result<(), String> {
        self.begin(id, command, Some(purpose))
    }

    fn outcome(&mut self, id: CommandId, outcome: &Outcome) {
        self.outcome_of(id, outcome);
    }

    fn state(&mut self, state: &RobotState) {
        self.state_of(state);
    }

    fn passed_over(&mut self, frame: u64, parts: &[PassedOver]) {
        // Frame after frame shows the same, with other digits: said once.
        let kinds: Vec<_> = parts.iter().map(|over| (over.slot, mem::discriminant(&over.reason))).collect();
        if self.passed_over != kinds {
            for over in parts {
                info!(frame, part = over.part, slot = over.slot + 1, reason = %over.reason, "passed over");
            }
            let _ = self.recorder.log_passed_over(unix_time_ns(), frame, parts);
            self.passed_over = kinds;
        }
        let texts = parts.iter().map(|over| format!("{}: {}", over.part, over.reason)).collect();
        let mut state = self.shared.lock();
        state.report.passed_over = texts;
        state.passed_over = parts.to_vec();
    }

    fn picked(&mut self, report: &PickReport) {
        let PickReport { part, slot, frame, gap_ms, took_ms, result, .. } = report;
        (self.picks, self.is_picking) = (self.picks + 1, false);
        let (pick, slot) = (self.picks, slot + 1);
        match result {
            PickResult::Placed => info!(pick, frame, part, slot, gap_ms, took_ms, "placed"),
            PickResult::Missed => warn!(pick, frame, part, slot, "the gripper has missed it"),
            PickResult::NotReached { reason } => warn!(pick, frame, part, slot, reason, "not reached"),
        }
        let _ = self.recorder.log_pick(unix_time_ns(), report);
        let mut state = self.shared.lock();
        *match result {
            PickResult::Placed => &mut state.picks.placed,
            PickResult::Missed => &mut state.picks.missed,
            PickResult::NotReached { .. } => &mut state.picks.not_reached,
        } += 1;
        let picks = &mut state.report.picks;
        // A service that runs for months keeps what people look at.
        if picks.len() >= MOST_PICKS {
            picks.remove(0);
        }
        picks.push(report.clone());
    }

    fn fault(&mut self, fault: &SequenceFault) {
        let (frame, pick) = (self.shown.map(|(frame, _)| frame), self.is_picking.then_some(self.picks + 1));
        let held_by = fault.held_by.map(tracing::field::debug);
        error!(frame, pick, held_by, %fault, "the robot stands until an operator resumes");
        if std::mem::take(&mut self.is_picking) {
            // It is not gone on with: the next pick is another.
            self.picks += 1;
        }
        if let Err(e) = self.recorder.log_fault(unix_time_ns(), fault) {
            error!(frame, pick, error = %e, "fault not recorded");
        }
    }

    fn cut_short(&mut self, cut: &SequenceFault) {
        if self.shared.lock().is_given_up {
            return;
        }
        warn!(%cut, "work is cut short, the robot is left on hold");
        if let Err(e) = self.recorder.log_fault(unix_time_ns(), cut) {
            error!(error = %e, "fault not recorded");
        }
    }

    fn is_stopping(&self) -> bool {
        self.shared.stopping.load(Ordering::SeqCst)
    }
}

/// Works by the assembly list.
struct Assembly {
    sequence: Sequence<Box<dyn Controller>, ScaledClock>,
    log: ThreadLog,
}

impl Assembly {
    fn run(mut self) {
        let mut is_home_at_end = false;
        loop {
            self.log.pulse.beat();
            self.answer_requests();
            if self.log.is_stopping() {
                break;
            }
            self.hold_with_the_recording();
            match self.sequence.state() {
                SequenceState::FromHome => {
                    is_home_at_end = false;
                    self.log.shown = None;
                    self.sequence.watch(&mut self.log);
                    if self.sequence.waits_for().is_none() {
                        self.sequence.go_home(&mut self.log);
                    }
                }
                SequenceState::Complete if !is_home_at_end => {
                    is_home_at_end = true;
                    self.log.shown = None;
                    self.sequence.go_home(&mut self.log);
                }
                SequenceState::Ready => {
                    self.sequence.watch(&mut self.log);
                    let shown = self.log.shared.lock().shown.take();
                    if let Some(Shown { frame_sequence, frame_timestamp_ns, content: Content::Sight(sight), .. }) =
                        shown
                    {
                        self.log.shown = Some((frame_sequence, frame_timestamp_ns));
                        self.sequence.work(&sight, &mut self.log);
                        self.log.shown = None;
                    }
                }
                SequenceState::Complete => self.sequence.watch(&mut self.log),
                SequenceState::Faulted(_) => {}
                SequenceState::Stopped { .. } => break,
            }
            // It is done when the robot is home.
            if *self.sequence.state() == SequenceState::Complete && !is_home_at_end {
                continue;
            }
            self.publish();
            self.rest();
        }
        self.sequence.leave(&mut self.log);
        self.publish();
        self.answer_requests();
    }

    /// A robot that stands is held as soon as its commands would not be recorded; one at work is refused the next.
    fn hold_with_the_recording(&mut self) {
        if matches!(self.sequence.state(), SequenceState::Faulted(_)) {
            return;
        }
        if let Some(reason) = self.log.recorder.view().holds_robot() {
            // The fault tells it.
            let _ = self.sequence.hold_because(HoldReason::Recording, &reason, &mut self.log);
        }
    }

    /// Sleeps until there is something to do: a new sight, a request, the end, or the next look at the robot.
    fn rest(&self) {
        let mut state = self.log.shared.lock();
        let moves_on = match self.sequence.state() {
            SequenceState::Ready => state.shown.is_some(),
            SequenceState::Stopped { .. } => true,
            _ => false,
        };
        if moves_on || state.ending || !state.requests.is_empty() {
            return;
        }
        state.idle = true;
        self.log.pulse.rest();
        drop(self.log.shared.wake.wait_timeout(state, WATCH_INTERVAL));
    }

    fn publish(&self) {
        let mut state = self.log.shared.lock();
        state.is_step_over = true;
        let report = &mut state.report;
        report.sequence = Some(self.sequence.state().clone());
        report.waits_for = self.sequence.waits_for().map(ToString::to_string);
        report.filled.clear();
        report.filled.extend(self.sequence.filled());
    }

    fn answer_requests(&mut self) {
        self.log.take_settings(|task| {
            if let Task::Assemble { options, planner } = task {
                self.sequence.change(*options, *planner);
            }
        });
        for Asked { request, hold_reason, reply, .. } in self.log.shared.requests() {
            let answer = match request {
                Request::Status => Ok(()),
                Request::Hold => self.sequence.hold(hold_reason, &mut self.log),
                Request::Resume { gripper_is_empty } => match self.sequence.resume(gripper_is_empty) {
                    Ok(position) => {
                        info!(%position, "resumed by an operator; a new cycle begins from home");
                        Ok(())
                    }
                    Err(e) => Err(e.to_string()),
                },
                Request::NewJig if self.sequence.new_jig() => {
                    info!("a new jig; begins from home");
                    Ok(())
                }
                Request::NewJig => Err("the jig is not full yet".to_owned()),
            };
            self.publish();
            // The operator may have gone away.
            let _ = reply.send(answer.map(|()| self.log.shared.lock().report.clone()));
        }
    }
}

/// What a robot that goes above things does next.
enum Next {
    Shown(Shown),
    Look,
    End,
}

/// Goes above what is seen.
struct GoAbove {
    controller: Box<dyn Controller>,
    clock: ScaledClock,
    speed_fraction: f64,
    timeout: Duration,
    log: ThreadLog,
    last_id: u64,
    /// By the recording.
    is_held: bool,
}

impl GoAbove {
    fn run(mut self) {
        while self.wait_until_ready() {
            match self.next() {
                Next::Shown(shown) => self.carry_out(&shown),
                Next::Look => {}
                Next::End => return,
            }
        }
    }

    /// As [`Assembly::hold_with_the_recording`].
    fn hold_with_the_recording(&mut self) {
        let reason = self.log.recorder.view().holds_robot();
        if let Some(reason) = reason.as_ref().filter(|_| !self.is_held) {
            self.hold_because(reason);
        }
        self.is_held = reason.is_some();
    }

    fn hold_because(&mut self, reason: &str) {
        error!(reason, "the robot stands until an operator resumes");
        self.controller.latch(reason);
        if let Err(error) = self.controller.hold(true) {
            error!(%error, "the hold did not reach the robot; it is given no command");
        }
    }

    /// False when the service ends.
    fn wait_until_ready(&mut self) -> bool {
        let mut told = None;
        loop {
            self.log.pulse.beat();
            self.answer_requests();
            self.hold_with_the_recording();
            let state = self.controller.status().map_err(|e| e.to_string()).and_then(|status| {
                status.check_ready().map_err(|e| e.to_string())?;
                let position = self.controller.position().map_err(|e| e.to_string())?;
                Ok(RobotState { status, position })
            });
            match state {
                Ok(state) => {
                    self.log.state_of(&state);
                    self.log.shared.lock().report.waits_for = None;
                    if told.is_some() {
                        info!("robot is ready again");
                        self.log.shared.lock().report.waits_for = None;
                    }
                    return true;
                }
                Err(reason) => {
                    if self.log.shared.lock().ending {
                        return false;
                    }
                    if told.as_ref() != Some(&reason) {
                        warn!(%reason, "robot is not ready; it gets no commands until it is");
                        self.log.shared.lock().report.waits_for = Some(reason.clone());
                        told = Some(reason);
                    }
                    // A connection that is there is kept; one that is not costs one attempt a look.
                    if self.controller.status().is_err()
                        && let Err(error) = self.controller.connect()
                    {
                        debug!(%error, "robot not reached");
                    }
                }
            }
            let state = self.log.shared.lock();
            if state.ending {
                return false;
            }
            self.log.pulse.rest();
            // Woken early only to end, or by a request.
            drop(self.log.shared.wake.wait_timeout(state, READY_INTERVAL));
        }
    }

    /// What the robot does next; it is looked at again after a while of nothing.
    fn next(&mut self) -> Next {
        self.log.pulse.beat();
        self.answer_requests();
        let mut state = self.log.shared.lock();
        if let Some(shown) = state.shown.take() {
            return Next::Shown(shown);
        }
        if state.ending {
            return Next::End;
        }
        if state.requests.is_empty() {
            self.log.pulse.rest();
            // Only now: what is shown to a robot that moves is old by the time that it could be gone to.
            state.idle = true;
            let (mut state, _) =
                self.log.shared.wake.wait_timeout(state, WATCH_INTERVAL).unwrap_or_else(PoisonError::into_inner);
            if let Some(shown) = state.shown.take() {
                return Next::Shown(shown);
            }
            state.idle = false;
        }
        Next::Look
    }

    fn answer_requests(&mut self) {
        self.log.take_settings(|task| {
            if let Task::GoAbove { speed_fraction, timeout } = task {
                (self.speed_fraction, self.timeout) = (speed_fraction, timeout);
            }
        });
        for Asked { request, hold_reason, reply, .. } in self.log.shared.requests() {
            let answer = match request {
                Request::Status => Ok(()),
                Request::Hold => {
                    self.controller.latch(&hold_reason.to_string());
                    self.controller.hold(true).map_err(|e| e.to_string())
                }
                Request::Resume { .. } => {
                    let released = self.controller.hold(false).map_err(|e| e.to_string());
                    released.and_then(|()| self.controller.resume().map(|_| ()).map_err(|e| e.to_string()))
                }
                Request::NewJig => Err("there is no [jig] order in this cell".to_owned()),
            };
            let _ = reply.send(answer.map(|()| self.log.shared.lock().report.clone()));
        }
    }

    /// A command that cannot be recorded is not given, and the robot is held.
    fn carry_out(&mut self, shown: &Shown) {
        let Content::Above(target) = shown.content else { return };
        self.last_id += 1;
        let id = CommandId(self.last_id);
        let motion = Motion::Joint { target, speed_fraction: self.speed_fraction };
        self.log.shown = Some((shown.frame_sequence, shown.frame_timestamp_ns));
        if let Err(e) = self.log.begin(id, &Command::Move(motion), None) {
            let frame = shown.frame_sequence;
            self.hold_because(&format!("command {id} (frame {frame}) could not be recorded, so it was not given: {e}"));
            return;
        }
        // Of what is gone above nothing is claimed, so no score can be too low.
        self.controller.base_on(Some(Sighting { taken_at: shown.taken_at, score: 1.0 }));
        let outcome = match self.controller.start_motion(id, &motion) {
            Err(e) => e.outcome(),
            Ok(()) => {
                self.log.outcome_of(id, &Outcome::Accepted);
                let follow_options = FollowOptions { deadline: self.timeout, ..FollowOptions::default() };
                let log = &self.log;
                follow(&mut self.controller, &self.clock, id, &follow_options, |progress| log.state_of(&progress.state))
            }
        };
        self.log.outcome_of(id, &outcome);
        if matches!(outcome, Outcome::Aborted { .. } | Outcome::Unknown { .. }) {
            self.controller.latch(&format!("command {id}: {outcome}"));
        }
    }
}
