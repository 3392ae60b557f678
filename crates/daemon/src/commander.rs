//! The robot thread: one pose after another, each written to the recording before it is sent.
//!
//! Input: orders, taken only while the robot is idle and ready; an order that comes otherwise is let go, because the frame
//! it was found in is old by the time the robot could act. Output: commands and outcomes in the recording, and counts.
//! Vision only ever touches a lock that is held for some instructions.

use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use samsod_frame::unix_time_ns;
use samsod_robot::{
    Command, CommandId, Controller, FollowOptions, MonotonicClock, Motion, Outcome, Pose, RobotState, follow,
};
use tracing::{error, info, warn};

use crate::recording::{CommandRecord, OutcomeRecord, Recorder};

/// How often a robot that is not ready is asked again.
const READY_INTERVAL: Duration = Duration::from_millis(500);

/// Where the robot is to go, and why.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Order {
    pub(crate) frame_sequence: u64,
    pub(crate) frame_timestamp_ns: u64,
    pub(crate) target: Pose,
}

/// How commands are carried out.
#[derive(Debug, Clone, Copy)]
pub(crate) struct CommandOptions {
    pub(crate) speed_fraction: f64,
    pub(crate) timeout: Duration,
}

/// What became of the commands.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
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

#[derive(Debug, Default)]
struct State {
    idle: bool,
    ending: bool,
    order: Option<Order>,
    counts: CommandCounts,
}

#[derive(Debug, Default)]
struct Shared {
    state: Mutex<State>,
    wake: Condvar,
}

impl Shared {
    /// Every statement leaves the state valid, so a panic elsewhere does not spoil it.
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The robot thread, seen from vision.
#[derive(Debug)]
pub(crate) struct Commander {
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

impl Commander {
    /// Starts the thread on a controller that is connected.
    pub(crate) fn start(
        controller: Box<dyn Controller>,
        options: CommandOptions,
        recorder: Arc<Recorder>,
    ) -> std::io::Result<Self> {
        let shared = Arc::new(Shared::default());
        let robot = RobotThread { controller, options, recorder, shared: Arc::clone(&shared), last_id: 0 };
        let thread = thread::Builder::new().name("robot".to_owned()).spawn(move || robot.run())?;
        Ok(Self { shared, thread: Some(thread) })
    }

    /// Gives an order if the robot is idle; false when it is not. Never waits for the robot.
    pub(crate) fn offer(&self, order: Order) -> bool {
        let mut state = self.shared.lock();
        if !state.idle || state.ending {
            return false;
        }
        state.idle = false;
        state.order = Some(order);
        self.shared.wake.notify_one();
        true
    }

    /// Takes no more orders, waits until the command in flight has its outcome, and ends the thread. An order that was
    /// taken but not begun is carried out only if `begin_last` says so.
    ///
    /// A motion in flight is followed to its end rather than left alone: it is bounded by its timeout.
    pub(crate) fn finish(mut self, begin_last: bool) -> CommandCounts {
        self.end(begin_last);
        self.shared.lock().counts
    }

    fn end(&mut self, begin_last: bool) {
        {
            let mut state = self.shared.lock();
            state.ending = true;
            if !begin_last {
                state.order = None;
            }
        }
        self.shared.wake.notify_one();
        if self.thread.take().is_some_and(|thread| thread.join().is_err()) {
            error!("the robot thread panicked; the outcome of its last command is not known");
        }
    }
}

impl Drop for Commander {
    fn drop(&mut self) {
        self.end(false);
    }
}

struct RobotThread {
    controller: Box<dyn Controller>,
    options: CommandOptions,
    recorder: Arc<Recorder>,
    shared: Arc<Shared>,
    last_id: u64,
}

impl RobotThread {
    fn run(mut self) {
        while self.wait_until_ready() {
            let Some(order) = self.next_order() else { return };
            if !self.carry_out(&order) {
                return;
            }
        }
    }

    /// False when the service ends.
    fn wait_until_ready(&mut self) -> bool {
        let mut told = None;
        loop {
            let state = self.controller.status().map_err(|e| e.to_string()).and_then(|status| {
                status.check_ready().map_err(|e| e.to_string())?;
                let position = self.controller.position().map_err(|e| e.to_string())?;
                Ok(RobotState { status, position })
            });
            match state {
                Ok(state) => {
                    // A failed recording is reported once, by vision; see `Recorder::failure`.
                    let _ = self.recorder.log_robot_state(unix_time_ns(), &state);
                    if told.is_some() {
                        info!("robot is ready again");
                    }
                    return true;
                }
                Err(reason) if told.as_ref() != Some(&reason) => {
                    warn!(%reason, "robot is not ready; it gets no commands until it is");
                    told = Some(reason);
                }
                Err(_) => {}
            }
            let state = self.shared.lock();
            if state.ending {
                return false;
            }
            // Woken early only to end.
            drop(self.shared.wake.wait_timeout(state, READY_INTERVAL));
        }
    }

    fn next_order(&self) -> Option<Order> {
        let mut state = self.shared.lock();
        state.idle = true;
        loop {
            if let Some(order) = state.order.take() {
                return Some(order);
            }
            if state.ending {
                return None;
            }
            state = self.shared.wake.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// False when commands can no longer be recorded: then none may be given.
    fn carry_out(&mut self, order: &Order) -> bool {
        self.last_id += 1;
        let id = CommandId(self.last_id);
        let motion = Motion::Joint { target: order.target, speed_fraction: self.options.speed_fraction };
        let command = Command::Move(motion);
        let record = CommandRecord {
            id,
            timestamp_ns: unix_time_ns(),
            frame_sequence: Some(order.frame_sequence),
            frame_timestamp_ns: Some(order.frame_timestamp_ns),
            command: &command,
        };
        if let Err(e) = self.recorder.log_command(&record) {
            error!(%id, error = %e, "command not recorded, so not sent; the robot gets no more commands");
            return false;
        }
        self.shared.lock().counts.sent += 1;
        info!(%id, frame = order.frame_sequence, target = %order.target, "command");
        let start = Instant::now();
        let outcome = match self.controller.start_motion(id, &motion) {
            Err(e) => e.outcome(),
            Ok(()) => {
                self.record_outcome(id, &Outcome::Accepted);
                let follow_options = FollowOptions { deadline: self.options.timeout, ..FollowOptions::default() };
                let recorder = &self.recorder;
                follow(&mut *self.controller, &MonotonicClock::new(), id, &follow_options, |progress| {
                    let _ = recorder.log_robot_state(unix_time_ns(), &progress.state);
                })
            }
        };
        let milliseconds = start.elapsed().as_millis() as u64;
        {
            let counts = &mut self.shared.lock().counts;
            *match &outcome {
                Outcome::Done => &mut counts.done,
                Outcome::NotExecuted { .. } => &mut counts.not_executed,
                Outcome::Aborted { .. } => &mut counts.aborted,
                Outcome::Accepted | Outcome::Unknown { .. } => &mut counts.unknown,
            } += 1;
        }
        match &outcome {
            Outcome::Done => info!(%id, milliseconds, %outcome, "command ended"),
            Outcome::NotExecuted { .. } | Outcome::Aborted { .. } => {
                warn!(%id, milliseconds, %outcome, "command ended")
            }
            Outcome::Accepted | Outcome::Unknown { .. } => error!(%id, milliseconds, %outcome, "command ended"),
        }
        self.record_outcome(id, &outcome);
        true
    }

    /// The acknowledgement of a command, and later its result.
    fn record_outcome(&self, id: CommandId, outcome: &Outcome) {
        let record = OutcomeRecord { id, timestamp_ns: unix_time_ns(), outcome };
        if let Err(e) = self.recorder.log_outcome(&record) {
            error!(%id, error = %e, "outcome not recorded");
        }
    }
}
