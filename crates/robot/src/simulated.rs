//! A controller without a robot: a Yaskawa MH5 that moves at finite speed, keeps its state, and can be made to fail.
//!
//! The arm is an [`ArmModel`]: a *linear* motion takes the tool along the straight line, a *joint* motion turns every joint
//! from where it is, all arriving together. What is out of reach, or cannot be followed near a singularity, is refused
//! before anything moves. The gripper closes on what its [`Workpieces`] give it.
//!
//! State is a function of the [`Clock`]: nothing runs in the background, and two reads at the same time agree.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::{
    AbortReason, ArmModel, ArmPath, Clock, CommandId, ConnectError, Controller, GripperCommand, GripperError,
    GripperState, HoldError, Joints, Motion, MotionError, Outcome, PollError, Pose, PositionError, Progress,
    ResumeError, RobotState, Status, StatusError, Workpieces,
};

/// Steps in which workpieces are told where the tool passes, mm.
const PASS_STEP_MM: f64 = 2.0;

/// A simulated arm.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SimulatedConfig {
    /// Where the tool is at the start, `base_from_tool`.
    pub home: Pose,
    /// Length of the tool: from the flange straight out to the tool centre point between the finger tips, mm.
    pub tool_length_mm: f64,
    /// Greatest speed of a linear motion, mm/s.
    pub linear_speed_max_mm_s: f64,
    /// Time that the gripper takes, ms.
    pub gripper_time_ms: u64,
}

impl Default for SimulatedConfig {
    fn default() -> Self {
        Self {
            home: Pose::gripper_down(400.0, 0.0, 400.0, 0.0),
            tool_length_mm: 100.0,
            linear_speed_max_mm_s: 1500.0,
            gripper_time_ms: 200,
        }
    }
}

/// Why a simulated arm cannot be made.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum SimulatedConfigError {
    /// A number is out of range. Key and value are those of a configuration file.
    #[error("{key} is {value}; it must be {allowed}")]
    OutOfRange {
        /// The key.
        key: &'static str,
        /// Its value, in the unit of the key.
        value: f64,
        /// What is allowed.
        allowed: &'static str,
    },
    /// The home pose cannot be reached.
    #[error("home: {0}")]
    Home(#[source] Box<MotionError>),
}

impl SimulatedConfig {
    /// The arm that these describe.
    pub fn arm(&self) -> ArmModel {
        ArmModel::mh5(self.tool_length_mm)
    }

    /// Checks the numbers, and that home can be reached. Returns the joints at home.
    ///
    /// # Errors
    /// [`SimulatedConfigError`] names the key.
    pub fn check(&self) -> Result<Joints, SimulatedConfigError> {
        let (key, value) = ("linear_speed_max_mm_s", self.linear_speed_max_mm_s);
        if !(value.is_finite() && value > 0.0) {
            return Err(SimulatedConfigError::OutOfRange { key, value, allowed: "a finite number above 0" });
        }
        let (key, value) = ("tool_length_mm", self.tool_length_mm);
        if !(0.0..=1000.0).contains(&value) {
            return Err(SimulatedConfigError::OutOfRange { key, value, allowed: "0 to 1000" });
        }
        self.arm().joints_at(&self.home, &Joints([0.0; 6])).map_err(|e| SimulatedConfigError::Home(Box::new(e)))
    }
}

/// Something that goes wrong at the robot or on the way to it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Fault {
    /// The emergency stop is pressed; servo power goes off and stays off.
    EmergencyStop,
    /// Servo power goes off.
    ServoOff,
    /// The controller raises an alarm.
    Alarm(u32),
    /// Hold by an outside signal.
    ExternalHold,
    /// The key switch is turned to teach.
    Teach,
    /// The motion stops short without a word.
    StopShort,
    /// The motion goes on but never arrives.
    Stall,
    /// The connection breaks now.
    Disconnect,
    /// The connection breaks just before the next motion or gripper command is complete: it is not executed.
    LoseNextCommand,
    /// The answer to the next motion or gripper command is lost: it is executed.
    LoseNextAnswer,
}

/// The robot's side of a [`Simulated`] controller: what a person at the cell can do and see.
#[derive(Debug, Clone)]
pub struct Panel {
    shared: Arc<Mutex<Arm>>,
}

impl Panel {
    /// Makes something go wrong.
    pub fn inject(&self, fault: Fault) {
        lock(&self.shared).inject(fault);
    }

    /// Puts everything right at the robot: releases the stop and outside holds, resets the alarm, turns to play, switches
    /// the servo on. What the controller object has latched stays latched.
    pub fn restore(&self) {
        lock(&self.shared).restore();
    }

    /// How many motions the arm has begun. A command that was sent twice would show here.
    pub fn motions_begun(&self) -> u64 {
        lock(&self.shared).motions_begun
    }

    /// Where the tool is, even while the connection is broken.
    pub fn position(&self) -> Pose {
        lock(&self.shared).now()
    }
}

/// A simulated controller; see the module documentation.
#[derive(Debug)]
pub struct Simulated {
    shared: Arc<Mutex<Arm>>,
}

impl Simulated {
    /// Makes an arm that stands at home with servo power on. It is not connected yet.
    ///
    /// # Errors
    /// [`SimulatedConfigError`] names the key that is out of range.
    pub fn new(config: SimulatedConfig, clock: impl Clock + 'static) -> Result<Self, SimulatedConfigError> {
        let joints = config.check()?;
        let arm = Arm {
            at: config.home,
            joints,
            model: config.arm(),
            config,
            workpieces: None,
            clock: SharedClock(Arc::new(clock)),
            action: None,
            last: None,
            status: Status { remote: true, play: true, servo_on: true, ..Status::default() },
            connected: false,
            lose: None,
            motions_begun: 0,
        };
        Ok(Self { shared: Arc::new(Mutex::new(arm)) })
    }

    /// Puts things on the table: the gripper then closes on them, and says whether it holds one.
    pub fn with_workpieces(self, workpieces: Box<dyn Workpieces>) -> Self {
        lock(&self.shared).workpieces = Some(workpieces);
        self
    }

    /// The robot's side.
    pub fn panel(&self) -> Panel {
        Panel { shared: Arc::clone(&self.shared) }
    }
}

/// A poisoned lock only says that another thread panicked; the arm's state is valid after every statement.
fn lock(shared: &Mutex<Arm>) -> MutexGuard<'_, Arm> {
    shared.lock().unwrap_or_else(PoisonError::into_inner)
}

struct SharedClock(Arc<dyn Clock>);

impl std::fmt::Debug for SharedClock {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Clock({:?})", self.0.now())
    }
}

/// The arm as it is at the robot, whether or not anybody is connected.
struct Arm {
    config: SimulatedConfig,
    model: ArmModel,
    clock: SharedClock,
    workpieces: Option<Box<dyn Workpieces>>,
    /// Where tool and joints stood when the last action ended.
    at: Pose,
    joints: Joints,
    action: Option<Action>,
    last: Option<(CommandId, Outcome)>,
    status: Status,
    connected: bool,
    lose: Option<Fault>,
    motions_begun: u64,
}

impl std::fmt::Debug for Arm {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { clock, at, joints, action, last, status, connected, .. } = self;
        f.debug_struct("Arm")
            .field("clock", clock)
            .field("at", at)
            .field("joints", joints)
            .field("action", action)
            .field("last", last)
            .field("status", status)
            .field("connected", connected)
            .finish_non_exhaustive()
    }
}

#[derive(Debug, Clone)]
struct Action {
    start: Duration,
    lasts: Duration,
    what: Doing,
    stalled: bool,
    /// Share of the way of which the workpieces have been told.
    told: f64,
}

#[derive(Debug, Clone)]
enum Doing {
    Motion(ArmPath),
    Gripper(GripperCommand),
}

impl Action {
    /// Share of the way that is gone.
    fn share(&self, now: Duration) -> f64 {
        let share = if self.lasts.is_zero() {
            1.0
        } else {
            (now.saturating_sub(self.start).as_secs_f64() / self.lasts.as_secs_f64()).clamp(0.0, 1.0)
        };
        // A stalled motion creeps up to its target and stays just short of it.
        if self.stalled { share.min(0.999) } else { share }
    }
}

impl Arm {
    /// Brings the state up to the clock and says where the tool is.
    fn now(&mut self) -> Pose {
        let now = self.clock.0.now();
        let Some(action) = &mut self.action else {
            return self.at;
        };
        let share = action.share(now);
        match &action.what {
            Doing::Motion(path) => {
                if let Some(workpieces) = &mut self.workpieces {
                    tell(&mut **workpieces, &self.model, path, action.told, share);
                    action.told = share;
                }
                (self.at, self.joints) = (path.tool(&self.model, share), path.joints(share));
            }
            Doing::Gripper(command) if share >= 1.0 => {
                self.status.gripper = match (command, &mut self.workpieces) {
                    (GripperCommand::Open, workpieces) => {
                        if let Some(workpieces) = workpieces {
                            workpieces.open(&self.at);
                        }
                        GripperState::Open
                    }
                    (GripperCommand::Close, None) => GripperState::Closed,
                    (GripperCommand::Close, Some(workpieces)) => {
                        if workpieces.close(&self.at) {
                            GripperState::Holding
                        } else {
                            GripperState::Empty
                        }
                    }
                };
            }
            Doing::Gripper(_) => {}
        }
        if share >= 1.0 {
            self.action = None;
            self.status.running = false;
            self.conclude(Outcome::Done);
        }
        self.at
    }

    fn conclude(&mut self, outcome: Outcome) {
        if let Some((_, known @ Outcome::Accepted)) = &mut self.last {
            *known = outcome;
        }
    }

    /// Stops where the tool is now.
    fn stop(&mut self, outcome: Outcome) {
        self.now();
        if let Some(action) = self.action.take() {
            if let Doing::Gripper(_) = action.what {
                self.status.gripper = GripperState::Unknown;
            }
            self.status.running = false;
            self.conclude(outcome);
        }
    }

    /// The first reason stays: later ones are mostly its consequences.
    fn latch(&mut self, reason: &str) {
        self.status.latched.get_or_insert_with(|| reason.to_string());
    }

    fn inject(&mut self, fault: Fault) {
        let reason = match fault {
            Fault::EmergencyStop => {
                (self.status.emergency_stop, self.status.servo_on) = (true, false);
                AbortReason::EmergencyStop
            }
            Fault::ServoOff => {
                self.status.servo_on = false;
                AbortReason::ServoOff
            }
            Fault::Alarm(code) => {
                self.status.alarm = Some(code);
                AbortReason::Alarm { code }
            }
            Fault::Teach => {
                (self.status.play, self.status.remote) = (false, false);
                AbortReason::NotRemote
            }
            Fault::ExternalHold => {
                self.status.hold_external = true;
                self.stop(Outcome::Aborted { reason: AbortReason::Hold });
                return;
            }
            Fault::StopShort => {
                let remaining_mm = match &self.action {
                    Some(Action { what: Doing::Motion(path), .. }) => {
                        let target = *path.target();
                        self.now().distance_mm(&target)
                    }
                    _ => 0.0,
                };
                AbortReason::StoppedShort { remaining_um: (remaining_mm * 1000.0).round() as u64 }
            }
            Fault::Stall => {
                if let Some(action) = &mut self.action {
                    action.stalled = true;
                }
                return;
            }
            Fault::Disconnect => {
                self.connected = false;
                return;
            }
            Fault::LoseNextCommand | Fault::LoseNextAnswer => {
                self.lose = Some(fault);
                return;
            }
        };
        self.stop(Outcome::Aborted { reason: reason.clone() });
        self.latch(&reason.to_string());
    }

    fn restore(&mut self) {
        self.now();
        let (gripper, latched, running, hold_command) =
            (self.status.gripper, self.status.latched.take(), self.status.running, self.status.hold_command);
        self.status = Status {
            remote: true,
            play: true,
            servo_on: true,
            running,
            hold_command,
            latched,
            gripper,
            ..Status::default()
        };
    }

    fn check_fresh(&self, id: CommandId) -> Result<(), CommandId> {
        match self.last {
            Some((last, _)) if id <= last => Err(last),
            _ => Ok(()),
        }
    }

    /// Plans a motion from where the arm stands.
    fn plan(&self, motion: &Motion) -> Result<ArmPath, MotionError> {
        match motion {
            Motion::Joint { target, speed_fraction } => self.model.plan_joint(&self.joints, target, *speed_fraction),
            Motion::Linear { target, speed_mm_s } => {
                self.model.plan_line(&self.joints, target, *speed_mm_s, self.config.linear_speed_max_mm_s)
            }
        }
    }

    /// Begins an action that has been checked, unless the command gets lost on its way. Tells what was lost.
    fn begin(&mut self, id: CommandId, lasts: Duration, what: Doing) -> Option<Fault> {
        let lost = self.lose.take();
        if lost == Some(Fault::LoseNextCommand) {
            self.connected = false;
            self.last = Some((id, Outcome::NotExecuted { reason: "the connection broke before the command".into() }));
            return lost;
        }
        match what {
            Doing::Gripper(_) => self.status.gripper = GripperState::Moving,
            Doing::Motion(_) => self.motions_begun += 1,
        }
        self.action = Some(Action { start: self.clock.0.now(), lasts, what, stalled: false, told: 0.0 });
        self.status.running = true;
        self.last = Some((id, Outcome::Accepted));
        if lost.is_some() {
            self.connected = false;
            self.last = Some((id, Outcome::Unknown { reason: "the answer was lost".into() }));
            self.latch(&format!("the outcome of command {id} is unknown"));
        }
        lost
    }
}

impl Controller for Simulated {
    fn name(&self) -> &str {
        "simulated"
    }

    fn connect(&mut self) -> Result<(), ConnectError> {
        lock(&self.shared).connected = true;
        Ok(())
    }

    fn status(&mut self) -> Result<Status, StatusError> {
        let mut arm = lock(&self.shared);
        arm.now();
        if arm.connected { Ok(arm.status.clone()) } else { Err(StatusError::NotConnected) }
    }

    fn position(&mut self) -> Result<Pose, PositionError> {
        let mut arm = lock(&self.shared);
        if arm.connected { Ok(arm.now()) } else { Err(PositionError::NotConnected) }
    }

    fn start_motion(&mut self, id: CommandId, motion: &Motion) -> Result<(), MotionError> {
        let mut arm = lock(&self.shared);
        if !arm.connected {
            return Err(MotionError::NotConnected);
        }
        arm.check_fresh(id).map_err(|last| MotionError::StaleId { id, last })?;
        arm.now();
        arm.status.check_ready()?;
        let path = arm.plan(motion)?;
        match arm.begin(id, path.lasts(), Doing::Motion(path)) {
            Some(Fault::LoseNextCommand) => Err(MotionError::NotSent { cause: "the connection broke".into() }),
            Some(_) => Err(MotionError::NoAnswer { cause: "the connection broke".into() }),
            None => Ok(()),
        }
    }

    fn start_gripper(&mut self, id: CommandId, command: GripperCommand) -> Result<(), GripperError> {
        let mut arm = lock(&self.shared);
        if !arm.connected {
            return Err(GripperError::NotConnected);
        }
        arm.check_fresh(id).map_err(|last| GripperError::StaleId { id, last })?;
        arm.now();
        arm.status.check_ready()?;
        let lasts = Duration::from_millis(arm.config.gripper_time_ms);
        match arm.begin(id, lasts, Doing::Gripper(command)) {
            Some(Fault::LoseNextCommand) => Err(GripperError::NotSent { cause: "the connection broke".into() }),
            Some(_) => Err(GripperError::NoAnswer { cause: "the connection broke".into() }),
            None => Ok(()),
        }
    }

    fn poll(&mut self, id: CommandId) -> Result<Progress, PollError> {
        let mut arm = lock(&self.shared);
        let position = arm.now();
        if !arm.connected {
            return Err(StatusError::NotConnected.into());
        }
        match &arm.last {
            Some((last, outcome)) if *last == id => {
                Ok(Progress { outcome: outcome.clone(), state: RobotState { status: arm.status.clone(), position } })
            }
            last => Err(PollError::NotTheLast { id, last: last.as_ref().map(|(last, _)| *last) }),
        }
    }

    fn hold(&mut self, on: bool) -> Result<(), HoldError> {
        let mut arm = lock(&self.shared);
        if !arm.connected {
            return Err(HoldError::NotConnected);
        }
        if on {
            arm.stop(Outcome::Aborted { reason: AbortReason::Hold });
        }
        arm.status.hold_command = on;
        Ok(())
    }

    fn latch(&mut self, reason: &str) {
        lock(&self.shared).latch(reason);
    }

    fn resume(&mut self) -> Result<Pose, ResumeError> {
        let mut arm = lock(&self.shared);
        if !arm.connected {
            return Err(StatusError::NotConnected.into());
        }
        let position = arm.now();
        let mut status = arm.status.clone();
        status.latched = None;
        status.check_ready()?;
        arm.status.latched = None;
        Ok(position)
    }
}

/// Tells where the tool passes between two shares of a path.
fn tell(workpieces: &mut dyn Workpieces, arm: &ArmModel, path: &ArmPath, from: f64, to: f64) {
    let (mut last, end) = (path.tool(arm, from), path.tool(arm, to));
    // A joint motion bends: the chord between the ends is too short a measure of it.
    let middle = path.tool(arm, (from + to) / 2.0);
    let length = (last.distance_mm(&middle) + middle.distance_mm(&end)) * 1.2;
    let steps = (length / PASS_STEP_MM).ceil().clamp(1.0, 10_000.0);
    for i in 1..=steps as usize {
        let tool = path.tool(arm, from + (to - from) * i as f64 / steps);
        if tool != last {
            workpieces.passes(&tool);
        }
        last = tool;
    }
}
