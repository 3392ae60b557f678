//! Limits around any controller: what must never be asked of the robot in this cell, however it came about.
//!
//! [`Limited`] hands every call on to the controller inside, and refuses a motion that leaves the workspace, goes too low, too
//! fast or too far at once, or follows from something seen too long ago or too doubtfully. [`Disarmed`] refuses every motion.
//! What is refused has not been sent.
//!
//! These limits reduce errors. They are no safety device: that is the controller's own safety circuit. The ends of a motion
//! are checked; a joint motion between them bends, so leave room for that.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::{
    Clock, CommandId, ConnectError, Controller, GripperCommand, GripperError, HoldError, Motion, MotionError,
    PollError, Pose, PositionError, Progress, ResumeError, Status, StatusError,
};

/// What a motion is based on: something that the camera has seen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sighting {
    /// When the frame was taken, on the clock of the robot.
    pub taken_at: Duration,
    /// How sure it is what it is, in [0, 1].
    pub score: f64,
}

/// What is allowed.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct Limits {
    /// Corner of the workspace with the least x, y, z of the tool, base frame, mm.
    pub workspace_min_mm: [f64; 3],
    /// The opposite corner, mm.
    pub workspace_max_mm: [f64; 3],
    /// Least height of the tool over the base, mm: just above the table.
    pub min_height_mm: f64,
    /// Greatest share of the greatest joint speed.
    pub joint_speed_fraction_max: f64,
    /// Greatest speed of a linear motion, mm/s.
    pub linear_speed_max_mm_s: f64,
    /// Greatest distance of the ends of one motion, mm.
    pub step_max_mm: f64,
    /// Greatest age of a sighting when a motion that is based on it is sent, ms.
    pub target_age_max_ms: u64,
    /// Least score of a sighting.
    pub score_min: f64,
}

impl Default for Limits {
    /// The half space in front of an MH5, down to the table.
    fn default() -> Self {
        Self {
            workspace_min_mm: [100.0, -650.0, 0.0],
            workspace_max_mm: [750.0, 650.0, 700.0],
            min_height_mm: 0.5,
            joint_speed_fraction_max: 1.0,
            linear_speed_max_mm_s: 1000.0,
            step_max_mm: 1300.0,
            target_age_max_ms: 10_000,
            score_min: 0.5,
        }
    }
}

impl Limits {
    /// Checks that the limits are such.
    ///
    /// # Errors
    /// Key, value, and what is allowed.
    pub fn check(&self) -> Result<(), (&'static str, f64, &'static str)> {
        for (low, high) in self.workspace_min_mm.into_iter().zip(self.workspace_max_mm) {
            if !(low.is_finite() && high.is_finite() && low < high) {
                return Err(("workspace_min_mm", low, "below workspace_max_mm, axis by axis"));
            }
        }
        let in_range = |key, value: f64, least: f64, most: f64, allowed| {
            if (least..=most).contains(&value) { Ok(()) } else { Err((key, value, allowed)) }
        };
        in_range("min_height_mm", self.min_height_mm, -1000.0, 5000.0, "-1000 to 5000")?;
        let fraction = self.joint_speed_fraction_max;
        in_range("joint_speed_fraction_max", fraction, 0.001, 1.0, "0.001 to 1")?;
        in_range("linear_speed_max_mm_s", self.linear_speed_max_mm_s, 0.1, 1500.0, "0.1 to 1500")?;
        in_range("step_max_mm", self.step_max_mm, 1.0, 5000.0, "1 to 5000")?;
        in_range("target_age_max_ms", self.target_age_max_ms as f64, 1.0, 600_000.0, "1 to 600000")?;
        in_range("score_min", self.score_min, 0.0, 1.0, "0 to 1")
    }

    /// Whether a motion from a position may be sent now.
    ///
    /// # Errors
    /// [`MotionError::Limit`] with the limit, the value and what is allowed; [`MotionError::Target`].
    pub fn allow(
        &self,
        from: &Pose,
        motion: &Motion,
        sighting: Option<&Sighting>,
        now: Duration,
    ) -> Result<(), MotionError> {
        let refuse = |limit, value, allowed: String, unit| Err(MotionError::Limit { limit, value, allowed, unit });
        let target = motion.target();
        target.check()?;
        let axes = [("workspace x", target.x_mm), ("workspace y", target.y_mm), ("workspace z", target.z_mm)];
        for ((limit, value), (low, high)) in
            axes.into_iter().zip(self.workspace_min_mm.into_iter().zip(self.workspace_max_mm))
        {
            if !(low..=high).contains(&value) {
                return refuse(limit, value, format!("{low} to {high}"), "mm");
            }
        }
        if target.z_mm < self.min_height_mm {
            return refuse("min_height_mm", target.z_mm, format!("at least {}", self.min_height_mm), "mm");
        }
        let (limit, value, most, unit) = match motion {
            Motion::Joint { speed_fraction, .. } => {
                ("joint_speed_fraction_max", *speed_fraction, self.joint_speed_fraction_max, "of the greatest speed")
            }
            Motion::Linear { speed_mm_s, .. } => {
                ("linear_speed_max_mm_s", *speed_mm_s, self.linear_speed_max_mm_s, "mm/s")
            }
        };
        // Written so that NaN is refused.
        if !(value > 0.0 && value <= most) {
            return refuse(limit, value, format!("above 0, at most {most}"), unit);
        }
        let step = from.distance_mm(target);
        // Written so that NaN is refused, here and below.
        if !(0.0..=self.step_max_mm).contains(&step) {
            return refuse("step_max_mm", step, format!("at most {}", self.step_max_mm), "mm");
        }
        if let Some(sighting) = sighting {
            let age_ms = now.saturating_sub(sighting.taken_at).as_millis() as u64;
            if age_ms > self.target_age_max_ms {
                let allowed = format!("at most {}", self.target_age_max_ms);
                return refuse("target_age_max_ms", age_ms as f64, allowed, "ms");
            }
            if !(self.score_min..=1.0).contains(&sighting.score) {
                return refuse("score_min", sighting.score, format!("at least {}", self.score_min), "");
            }
        }
        Ok(())
    }
}

/// [`Limits`] that somebody may change between two motions; clones share them.
#[derive(Debug, Clone)]
pub struct SharedLimits(Arc<Mutex<Limits>>);

impl SharedLimits {
    /// The limits in force.
    pub fn get(&self) -> Limits {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Puts others in force, for the motions to come.
    pub fn set(&self, limits: Limits) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = limits;
    }
}

impl From<Limits> for SharedLimits {
    fn from(limits: Limits) -> Self {
        Self(Arc::new(Mutex::new(limits)))
    }
}

/// A controller within [`Limits`].
#[derive(Debug)]
pub struct Limited<C, K> {
    inner: C,
    clock: K,
    limits: SharedLimits,
    sighting: Option<Sighting>,
}

impl<C: Controller, K: Clock> Limited<C, K> {
    /// Puts limits around a controller. `clock` is that of its sightings.
    pub fn new(inner: C, clock: K, limits: impl Into<SharedLimits>) -> Self {
        Self { inner, clock, limits: limits.into(), sighting: None }
    }
}

/// A controller that may be looked at and not moved: `armed = true` is missing.
#[derive(Debug)]
pub struct Disarmed<C> {
    inner: C,
}

impl<C: Controller> Disarmed<C> {
    /// Takes the arms from a controller.
    pub fn new(inner: C) -> Self {
        Self { inner }
    }
}

/// The calls that a decorator hands on as they are.
macro_rules! hand_on {
    () => {
        fn name(&self) -> &str {
            self.inner.name()
        }

        fn connect(&mut self) -> Result<(), ConnectError> {
            self.inner.connect()
        }

        fn status(&mut self) -> Result<Status, StatusError> {
            self.inner.status()
        }

        fn position(&mut self) -> Result<Pose, PositionError> {
            self.inner.position()
        }

        fn poll(&mut self, id: CommandId) -> Result<Progress, PollError> {
            self.inner.poll(id)
        }

        fn hold(&mut self, on: bool) -> Result<(), HoldError> {
            self.inner.hold(on)
        }

        fn latch(&mut self, reason: &str) {
            self.inner.latch(reason);
        }

        fn resume(&mut self) -> Result<Pose, ResumeError> {
            self.inner.resume()
        }
    };
}

impl<C: Controller, K: Clock> Controller for Limited<C, K> {
    hand_on!();

    fn base_on(&mut self, sighting: Option<Sighting>) {
        self.sighting = sighting;
        self.inner.base_on(sighting);
    }

    fn start_motion(&mut self, id: CommandId, motion: &Motion) -> Result<(), MotionError> {
        let from = self.inner.position().map_err(|e| match e {
            PositionError::NotConnected => MotionError::NotConnected,
            other => MotionError::NotSent { cause: other.to_string() },
        })?;
        self.limits.get().allow(&from, motion, self.sighting.as_ref(), self.clock.now())?;
        self.inner.start_motion(id, motion)
    }

    fn start_gripper(&mut self, id: CommandId, command: GripperCommand) -> Result<(), GripperError> {
        self.inner.start_gripper(id, command)
    }
}

impl<C: Controller> Controller for Disarmed<C> {
    hand_on!();

    fn base_on(&mut self, sighting: Option<Sighting>) {
        self.inner.base_on(sighting);
    }

    fn start_motion(&mut self, _id: CommandId, _motion: &Motion) -> Result<(), MotionError> {
        Err(MotionError::NotArmed)
    }

    fn start_gripper(&mut self, _id: CommandId, _command: GripperCommand) -> Result<(), GripperError> {
        Err(GripperError::NotArmed)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{ManualClock, Outcome, Simulated, SimulatedConfig};

    fn limited(limits: Limits) -> (Limited<Simulated, ManualClock>, ManualClock) {
        let clock = ManualClock::new();
        let mut arm = Simulated::new(SimulatedConfig::default(), clock.clone()).unwrap();
        arm.connect().unwrap();
        (Limited::new(arm, clock.clone(), limits), clock)
    }

    fn line(x_mm: f64, z_mm: f64) -> Motion {
        Motion::Linear { target: Pose::gripper_down(x_mm, 0.0, z_mm, 0.0), speed_mm_s: 100.0 }
    }

    #[test]
    fn what_is_beyond_a_limit_is_refused_by_name_and_never_sent() {
        let limits = Limits { step_max_mm: 250.0, score_min: 0.7, target_age_max_ms: 500, ..Limits::default() };
        let (mut robot, clock) = limited(limits);
        clock.advance(Duration::from_secs(5));
        let seen = |ago_ms: u64, score| Some(Sighting { taken_at: Duration::from_millis(5000 - ago_ms), score });
        let fast = Motion::Linear { target: Pose::gripper_down(400.0, 0.0, 300.0, 0.0), speed_mm_s: 1200.0 };
        let hasty = Motion::Joint { target: Pose::gripper_down(400.0, 0.0, 300.0, 0.0), speed_fraction: f64::NAN };
        let cases = [
            (line(760.0, 300.0), None, "workspace x is 760 mm; allowed: 100 to 750 mm"),
            (line(400.0, 0.2), None, "min_height_mm is 0.2 mm; allowed: at least 0.5 mm"),
            (line(400.0, 149.0), None, "step_max_mm is 251 mm; allowed: at most 250 mm"),
            (fast, None, "linear_speed_max_mm_s is 1200 mm/s; allowed: above 0, at most 1000 mm/s"),
            (hasty, None, "joint_speed_fraction_max is NaN"),
            (line(400.0, 300.0), seen(501, 0.9), "target_age_max_ms is 501 ms; allowed: at most 500 ms"),
            (line(400.0, 300.0), seen(10, 0.69), "score_min is 0.69; allowed: at least 0.7"),
            (line(400.0, f64::NAN), None, "z_mm of a pose is NaN"),
        ];
        for (id, (motion, sighting, why)) in (1..).zip(cases) {
            robot.base_on(sighting);
            let refused = robot.start_motion(CommandId(id), &motion).unwrap_err();
            assert!(refused.to_string().contains(why), "{refused}");
            assert!(matches!(refused.outcome(), Outcome::NotExecuted { .. }));
        }
        assert_eq!(robot.inner.panel().motions_begun(), 0);
        robot.base_on(seen(499, 0.7));
        robot.start_motion(CommandId(20), &line(400.0, 300.0)).unwrap();
        assert_eq!(robot.inner.panel().motions_begun(), 1);
    }

    #[test]
    fn limits_that_were_changed_hold_from_the_next_motion_on() {
        let clock = ManualClock::new();
        let mut arm = Simulated::new(SimulatedConfig::default(), clock.clone()).unwrap();
        arm.connect().unwrap();
        let limits = SharedLimits::from(Limits::default());
        let mut robot = Limited::new(arm, clock, limits.clone());
        limits.set(Limits { step_max_mm: 1.0, ..Limits::default() });
        let refused = robot.start_motion(CommandId(1), &line(400.0, 300.0)).unwrap_err();
        assert!(refused.to_string().contains("step_max_mm"), "{refused}");
        limits.set(Limits::default());
        robot.start_motion(CommandId(2), &line(400.0, 300.0)).unwrap();
    }

    #[test]
    fn without_arms_the_robot_is_seen_and_not_moved() {
        let mut arm = Simulated::new(SimulatedConfig::default(), ManualClock::new()).unwrap();
        let panel = arm.panel();
        arm.connect().unwrap();
        let mut robot = Disarmed::new(arm);
        assert!(robot.status().unwrap().servo_on);
        let refused = robot.start_motion(CommandId(1), &line(400.0, 300.0)).unwrap_err();
        assert!(refused.to_string().contains("armed = true"), "{refused}");
        assert!(robot.start_gripper(CommandId(2), GripperCommand::Open).is_err());
        assert_eq!(panel.motions_begun(), 0);
    }
}
