//! A controller without a robot: it moves at finite speed, keeps its state, and can be made to fail.
//!
//! The arm is modelled by what its user sees of it, not by its joints: a *linear* motion takes the tool along the straight
//! line; a *joint* motion turns the base and moves radius and height, as an arm does, each at its own greatest speed, the
//! slowest deciding. Orientation goes along the shortest rotation. Reach is a hollow sphere about the shoulder, without a
//! cylinder about the base axis and a wedge behind it; the figures are those of a Yaskawa MH5 with the flange as tool.
//!
//! State is a function of the [`Clock`]: nothing runs in the background, and two reads at the same time agree.

use std::f64::consts::PI;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use glam::{DQuat, DVec3};
use serde::{Deserialize, Serialize};

use crate::{
    AbortReason, Clock, CommandId, ConnectError, Controller, GripperCommand, GripperError, GripperState, HoldError,
    Motion, MotionError, Outcome, PollError, Pose, PositionError, Progress, ResumeError, RobotState, Status,
    StatusError,
};

/// Tolerance on reach, so that a pose that was reached is within it again: 1 um.
const REACH_TOLERANCE_MM: f64 = 1e-3;

/// Shape and speeds of a simulated arm.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SimulatedConfig {
    /// Where the tool is at the start, `base_from_tool`.
    pub home: Pose,
    /// Height of the shoulder above the base, mm.
    pub shoulder_height_mm: f64,
    /// Least distance of the tool from the shoulder, mm.
    pub reach_min_mm: f64,
    /// Greatest distance of the tool from the shoulder, mm.
    pub reach_max_mm: f64,
    /// Least distance of the tool from the axis of the base, mm.
    pub axis_clearance_mm: f64,
    /// Greatest turn of the base to either side, rad in (0, pi).
    #[serde(rename = "base_turn_max_deg", with = "crate::degrees")]
    pub base_turn_max_rad: f64,
    /// Greatest speed of a linear motion, mm/s.
    pub linear_speed_max_mm_s: f64,
    /// Greatest speed of the base, rad/s.
    #[serde(rename = "base_speed_max_deg_s", with = "crate::degrees")]
    pub base_speed_max_rad_s: f64,
    /// Greatest speed of radius and of height in a joint motion, mm/s.
    pub arm_speed_max_mm_s: f64,
    /// Greatest speed of the rotation of the tool, rad/s.
    #[serde(rename = "wrist_speed_max_deg_s", with = "crate::degrees")]
    pub wrist_speed_max_rad_s: f64,
    /// Time that the gripper takes, ms.
    pub gripper_time_ms: u64,
}

impl Default for SimulatedConfig {
    fn default() -> Self {
        Self {
            home: Pose::gripper_down(400.0, 0.0, 400.0, 0.0),
            shoulder_height_mm: 330.0,
            reach_min_mm: 150.0,
            reach_max_mm: 790.0,
            axis_clearance_mm: 100.0,
            base_turn_max_rad: 170.0 * PI / 180.0,
            linear_speed_max_mm_s: 1500.0,
            base_speed_max_rad_s: 2.96,
            arm_speed_max_mm_s: 1200.0,
            wrist_speed_max_rad_s: 3.48,
            gripper_time_ms: 200,
        }
    }
}

/// Why a simulated arm cannot be made.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum SimulatedConfigError {
    /// A number is out of range. Key and value are those of a configuration file: angles in degrees.
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
    fn check(&self) -> Result<(), SimulatedConfigError> {
        let positive = [
            ("reach_max_mm", self.reach_max_mm),
            ("linear_speed_max_mm_s", self.linear_speed_max_mm_s),
            ("base_speed_max_deg_s", in_degrees(self.base_speed_max_rad_s)),
            ("arm_speed_max_mm_s", self.arm_speed_max_mm_s),
            ("wrist_speed_max_deg_s", in_degrees(self.wrist_speed_max_rad_s)),
            // Without it the angle of the base would be undefined above the base.
            ("axis_clearance_mm", self.axis_clearance_mm),
        ];
        for (key, value) in positive {
            if !(value.is_finite() && value > 0.0) {
                return Err(SimulatedConfigError::OutOfRange { key, value, allowed: "a finite number above 0" });
            }
        }
        if !self.shoulder_height_mm.is_finite() {
            let (key, value) = ("shoulder_height_mm", self.shoulder_height_mm);
            return Err(SimulatedConfigError::OutOfRange { key, value, allowed: "a finite number" });
        }
        if !(self.reach_min_mm >= 0.0 && self.reach_min_mm < self.reach_max_mm) {
            let (key, value) = ("reach_min_mm", self.reach_min_mm);
            return Err(SimulatedConfigError::OutOfRange { key, value, allowed: "at least 0 and below reach_max_mm" });
        }
        if !(self.base_turn_max_rad > 0.0 && self.base_turn_max_rad < PI) {
            let (key, value) = ("base_turn_max_deg", in_degrees(self.base_turn_max_rad));
            return Err(SimulatedConfigError::OutOfRange { key, value, allowed: "above 0 and below 180" });
        }
        self.check_reach(&self.home).map_err(|e| SimulatedConfigError::Home(Box::new(e)))
    }

    /// Whether the tool can stand at `pose`.
    fn check_reach(&self, pose: &Pose) -> Result<(), MotionError> {
        pose.check()?;
        let from_shoulder = pose.position().distance(self.shoulder());
        self.within(pose, "the distance from the shoulder", from_shoulder, self.reach_min_mm, self.reach_max_mm)?;
        let from_axis = pose.x_mm.hypot(pose.y_mm);
        self.within(pose, "the distance from the base axis", from_axis, self.axis_clearance_mm, self.reach_max_mm)?;
        let turn = pose.y_mm.atan2(pose.x_mm);
        if turn.abs() > self.base_turn_max_rad {
            let most = self.base_turn_max_rad.to_degrees();
            return Err(MotionError::OutOfReach {
                target: *pose,
                quantity: "the turn of the base",
                value: turn.to_degrees(),
                least: -most,
                most,
                unit: "deg",
            });
        }
        Ok(())
    }

    /// Whether the straight line from `start` to `target`, both within reach, stays within it.
    fn check_line(&self, start: &Pose, target: &Pose) -> Result<(), MotionError> {
        let nearest = |to: DVec3, a: DVec3, b: DVec3| {
            let along = b - a;
            let t = if along.length_squared() > 0.0 { (to - a).dot(along) / along.length_squared() } else { 0.0 };
            (a + along * t.clamp(0.0, 1.0)).distance(to)
        };
        let (a, b) = (start.position(), target.position());
        let quantity = "the least distance from the shoulder on the way";
        self.within(target, quantity, nearest(self.shoulder(), a, b), self.reach_min_mm, self.reach_max_mm)?;
        let (flat_a, flat_b) = (DVec3::new(a.x, a.y, 0.0), DVec3::new(b.x, b.y, 0.0));
        let quantity = "the least distance from the base axis on the way";
        let from_axis = nearest(DVec3::ZERO, flat_a, flat_b);
        self.within(target, quantity, from_axis, self.axis_clearance_mm, self.reach_max_mm)?;
        // The wedge behind the base is convex: a line between points outside crosses it only from side to side, and then
        // crosses the half plane y = 0, x < 0.
        if (a.y < 0.0) != (b.y < 0.0) {
            let x = a.x + (b.x - a.x) * a.y / (a.y - b.y);
            if x < 0.0 {
                let most = self.base_turn_max_rad.to_degrees();
                return Err(MotionError::OutOfReach {
                    target: *target,
                    quantity: "the turn of the base on the way",
                    value: 180.0,
                    least: -most,
                    most,
                    unit: "deg",
                });
            }
        }
        Ok(())
    }

    fn within(
        &self,
        target: &Pose,
        quantity: &'static str,
        value: f64,
        least: f64,
        most: f64,
    ) -> Result<(), MotionError> {
        if value >= least - REACH_TOLERANCE_MM && value <= most + REACH_TOLERANCE_MM {
            return Ok(());
        }
        Err(MotionError::OutOfReach { target: *target, quantity, value, least, most, unit: "mm" })
    }

    fn shoulder(&self) -> DVec3 {
        DVec3::new(0.0, 0.0, self.shoulder_height_mm)
    }
}

/// An angle as it stands in a configuration file, without the last digits that the way through radians has changed.
fn in_degrees(radians: f64) -> f64 {
    let degrees = radians.to_degrees();
    let rounded = (degrees * 1e9).round() / 1e9;
    // Very small and very large values stay what they are.
    if rounded.is_finite() && rounded != 0.0 { rounded } else { degrees }
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
        config.check()?;
        let arm = Arm {
            at: config.home,
            config,
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
#[derive(Debug)]
struct Arm {
    config: SimulatedConfig,
    clock: SharedClock,
    /// Where the tool stood when the last action ended.
    at: Pose,
    action: Option<Action>,
    last: Option<(CommandId, Outcome)>,
    status: Status,
    connected: bool,
    lose: Option<Fault>,
    motions_begun: u64,
}

#[derive(Debug, Clone)]
struct Action {
    start: Duration,
    lasts: Duration,
    what: Doing,
    stalled: bool,
}

#[derive(Debug, Clone)]
enum Doing {
    Line { from: Pose, to: Pose },
    Joints { from: Pose, to: Pose },
    Gripper { ends: GripperState },
}

impl Action {
    fn share(&self, now: Duration) -> f64 {
        if self.lasts.is_zero() {
            return 1.0;
        }
        (now.saturating_sub(self.start).as_secs_f64() / self.lasts.as_secs_f64()).clamp(0.0, 1.0)
    }

    /// Where the tool is when `share` of the action's time has passed, if the action moves it.
    fn pose(&self, share: f64) -> Option<Pose> {
        match &self.what {
            // The target itself, not what rounding makes of it.
            Doing::Line { to, .. } | Doing::Joints { to, .. } if share >= 1.0 => Some(*to),
            Doing::Line { from, to } => {
                Some(Pose::from_parts(from.position().lerp(to.position(), share), turn(from, to, share)))
            }
            Doing::Joints { from, to } => {
                let (a, b) = (Cylinder::of(from), Cylinder::of(to));
                let mix = |a: f64, b: f64| a + (b - a) * share;
                let (angle, radius) = (mix(a.angle_rad, b.angle_rad), mix(a.radius_mm, b.radius_mm));
                let position = DVec3::new(radius * angle.cos(), radius * angle.sin(), mix(a.height_mm, b.height_mm));
                Some(Pose::from_parts(position, turn(from, to, share)))
            }
            Doing::Gripper { .. } => None,
        }
    }
}

fn turn(from: &Pose, to: &Pose, share: f64) -> DQuat {
    from.rotation().slerp(to.rotation(), share)
}

/// Position about the axis of the base: what the big joints of an arm move.
struct Cylinder {
    angle_rad: f64,
    radius_mm: f64,
    height_mm: f64,
}

impl Cylinder {
    fn of(pose: &Pose) -> Self {
        Self { angle_rad: pose.y_mm.atan2(pose.x_mm), radius_mm: pose.x_mm.hypot(pose.y_mm), height_mm: pose.z_mm }
    }
}

impl Arm {
    /// Brings the state up to the clock and says where the tool is.
    fn now(&mut self) -> Pose {
        let now = self.clock.0.now();
        let Some(action) = &self.action else {
            return self.at;
        };
        let share = action.share(now);
        if share < 1.0 || action.stalled {
            // A stalled motion creeps up to its target and stays just short of it.
            return action.pose(if action.stalled { share.min(0.999) } else { share }).unwrap_or(self.at);
        }
        if let Some(pose) = action.pose(1.0) {
            self.at = pose;
        }
        if let Doing::Gripper { ends } = action.what {
            self.status.gripper = ends;
        }
        self.action = None;
        self.status.running = false;
        self.conclude(Outcome::Done);
        self.at
    }

    fn conclude(&mut self, outcome: Outcome) {
        if let Some((_, known @ Outcome::Accepted)) = &mut self.last {
            *known = outcome;
        }
    }

    /// Stops where the tool is now.
    fn stop(&mut self, outcome: Outcome) {
        self.at = self.now();
        if let Some(action) = self.action.take() {
            if let Doing::Gripper { .. } = action.what {
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
                    Some(Action { what: Doing::Line { to, .. } | Doing::Joints { to, .. }, .. }) => {
                        let to = *to;
                        self.now().distance_mm(&to)
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

    /// Time that a motion takes, after checking that it may begin.
    fn plan(&self, from: &Pose, motion: &Motion) -> Result<(Duration, Doing), MotionError> {
        let config = &self.config;
        let (to, speed, at_most, unit) = match motion {
            Motion::Joint { target, speed_fraction } => (*target, *speed_fraction, 1.0, "of the greatest speed"),
            Motion::Linear { target, speed_mm_s } => (*target, *speed_mm_s, config.linear_speed_max_mm_s, "mm/s"),
        };
        // Written so that NaN is refused.
        if !(speed > 0.0 && speed <= at_most) {
            return Err(MotionError::Speed { value: speed, above: 0.0, at_most, unit });
        }
        config.check_reach(&to)?;
        let wrist = from.angle_rad(&to) / config.wrist_speed_max_rad_s;
        let (seconds, what) = match motion {
            Motion::Linear { .. } => {
                config.check_line(from, &to)?;
                ((from.distance_mm(&to) / speed).max(wrist), Doing::Line { from: *from, to })
            }
            Motion::Joint { .. } => {
                let (a, b) = (Cylinder::of(from), Cylinder::of(&to));
                let slowest = ((b.angle_rad - a.angle_rad).abs() / config.base_speed_max_rad_s)
                    .max((b.radius_mm - a.radius_mm).abs() / config.arm_speed_max_mm_s)
                    .max((b.height_mm - a.height_mm).abs() / config.arm_speed_max_mm_s)
                    .max(wrist);
                (slowest / speed, Doing::Joints { from: *from, to })
            }
        };
        Ok((Duration::try_from_secs_f64(seconds).unwrap_or(Duration::MAX), what))
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
            Doing::Gripper { .. } => self.status.gripper = GripperState::Moving,
            Doing::Line { .. } | Doing::Joints { .. } => self.motions_begun += 1,
        }
        self.action = Some(Action { start: self.clock.0.now(), lasts, what, stalled: false });
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
        let from = arm.now();
        arm.status.check_ready()?;
        let (lasts, what) = arm.plan(&from, motion)?;
        match arm.begin(id, lasts, what) {
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
        let ends = match command {
            GripperCommand::Open => GripperState::Open,
            GripperCommand::Close => GripperState::Closed,
        };
        let lasts = Duration::from_millis(arm.config.gripper_time_ms);
        match arm.begin(id, lasts, Doing::Gripper { ends }) {
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
