//! A controller whose every call is a sign of life, and whose last state anybody may look at.

use std::sync::{Arc, Mutex, PoisonError};

use samsod_robot::{
    CommandId, ConnectError, Controller, GripperCommand, GripperError, HoldError, Motion, MotionError, PollError, Pose,
    PositionError, Progress, ResumeError, Sighting, Status, StatusError,
};

use crate::pulse::Pulse;

/// How the controller was when it was last looked at.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct RobotLook {
    /// It answers.
    pub(crate) connected: bool,
    /// It executes a motion.
    pub(crate) moving: bool,
    /// It refuses to move until an operator resumes.
    pub(crate) latched: bool,
}

/// [`RobotLook`] of a controller that another thread works with.
#[derive(Debug, Default)]
pub(crate) struct SharedLook(Mutex<RobotLook>);

impl SharedLook {
    pub(crate) fn get(&self) -> RobotLook {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn change(&self, change: impl FnOnce(&mut RobotLook)) {
        change(&mut self.0.lock().unwrap_or_else(PoisonError::into_inner));
    }
}

/// Wraps a controller.
#[derive(Debug)]
pub(crate) struct Watched<C> {
    inner: C,
    pulse: Arc<Pulse>,
    look: Arc<SharedLook>,
}

impl<C: Controller> Watched<C> {
    pub(crate) fn new(inner: C, pulse: Arc<Pulse>, look: Arc<SharedLook>) -> Self {
        Self { inner, pulse, look }
    }

    fn saw(&self, status: &Status) {
        let (moving, latched) = (status.running, status.latched.is_some());
        self.look.change(|look| *look = RobotLook { connected: true, moving, latched });
    }

    fn has_lost(&self) {
        self.look.change(|look| (look.connected, look.moving) = (false, false));
    }
}

impl<C: Controller> Controller for Watched<C> {
    fn name(&self) -> &str {
        self.inner.name()
    }

    fn connect(&mut self) -> Result<(), ConnectError> {
        self.pulse.beat();
        let connected = self.inner.connect();
        self.look.change(|look| look.connected = connected.is_ok());
        self.pulse.beat();
        connected
    }

    fn status(&mut self) -> Result<Status, StatusError> {
        self.pulse.beat();
        let status = self.inner.status();
        match &status {
            Ok(status) => self.saw(status),
            Err(_) => self.has_lost(),
        }
        status
    }

    fn position(&mut self) -> Result<Pose, PositionError> {
        self.pulse.beat();
        self.inner.position()
    }

    fn base_on(&mut self, sighting: Option<Sighting>) {
        self.inner.base_on(sighting);
    }

    fn start_motion(&mut self, id: CommandId, motion: &Motion) -> Result<(), MotionError> {
        self.pulse.beat();
        self.inner.start_motion(id, motion)
    }

    fn start_gripper(&mut self, id: CommandId, command: GripperCommand) -> Result<(), GripperError> {
        self.pulse.beat();
        self.inner.start_gripper(id, command)
    }

    fn poll(&mut self, id: CommandId) -> Result<Progress, PollError> {
        self.pulse.beat();
        let progress = self.inner.poll(id);
        match &progress {
            Ok(progress) => self.saw(&progress.state.status),
            Err(_) => self.has_lost(),
        }
        progress
    }

    fn hold(&mut self, on: bool) -> Result<(), HoldError> {
        self.pulse.beat();
        self.inner.hold(on)
    }

    fn latch(&mut self, reason: &str) {
        self.look.change(|look| look.latched = true);
        self.inner.latch(reason);
    }

    fn resume(&mut self) -> Result<Pose, ResumeError> {
        self.pulse.beat();
        let position = self.inner.resume()?;
        self.look.change(|look| look.latched = false);
        Ok(position)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use samsod_robot::{Clock, ManualClock, Simulated, SimulatedConfig};
    use std::time::Duration;

    #[test]
    fn the_look_follows_a_motion_a_fault_and_an_operator() {
        let clock = ManualClock::new();
        let arm = Simulated::new(SimulatedConfig::default(), clock.clone()).unwrap();
        let look = Arc::new(SharedLook::default());
        let mut robot = Watched::new(arm, Arc::new(Pulse::new()), Arc::clone(&look));
        assert_eq!(look.get(), RobotLook::default());
        robot.connect().unwrap();
        assert!(look.get().connected);
        let motion = Motion::Linear { target: Pose::gripper_down(400.0, 0.0, 200.0, 0.0), speed_mm_s: 50.0 };
        robot.start_motion(CommandId(1), &motion).unwrap();
        clock.sleep(Duration::from_secs(1));
        robot.poll(CommandId(1)).unwrap();
        assert_eq!(look.get(), RobotLook { connected: true, moving: true, latched: false });
        clock.sleep(Duration::from_secs(60));
        robot.poll(CommandId(1)).unwrap();
        assert!(!look.get().moving);
        robot.latch("a fault");
        assert!(look.get().latched && robot.status().unwrap().latched.is_some());
        robot.resume().unwrap();
        assert!(!look.get().latched && robot.status().unwrap().latched.is_none());
    }
}
