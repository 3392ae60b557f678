//! An operator's hold that reaches a robot in motion.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use crate::{
    CommandId, ConnectError, Controller, GripperCommand, GripperError, HoldError, Motion, MotionError, PollError, Pose,
    PositionError, Progress, ResumeError, Sighting, Status, StatusError,
};

/// A controller that is put on hold at the next poll after somebody has asked for it, from any thread.
#[derive(Debug)]
pub struct HoldSwitch<C> {
    inner: C,
    asked: Arc<AtomicBool>,
}

impl<C: Controller> HoldSwitch<C> {
    /// Wraps a controller. Whoever sets `asked` wants the robot to stand; it is cleared when the hold has got through.
    pub fn new(inner: C, asked: Arc<AtomicBool>) -> Self {
        Self { inner, asked }
    }
}

impl<C: Controller> Controller for HoldSwitch<C> {
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

    fn base_on(&mut self, sighting: Option<Sighting>) {
        self.inner.base_on(sighting);
    }

    /// Nothing new is started while somebody wants the robot to stand.
    fn start_motion(&mut self, id: CommandId, motion: &Motion) -> Result<(), MotionError> {
        if self.asked.load(Ordering::SeqCst) {
            return Err(MotionError::HoldAsked);
        }
        self.inner.start_motion(id, motion)
    }

    fn start_gripper(&mut self, id: CommandId, command: GripperCommand) -> Result<(), GripperError> {
        if self.asked.load(Ordering::SeqCst) {
            return Err(GripperError::HoldAsked);
        }
        self.inner.start_gripper(id, command)
    }

    fn poll(&mut self, id: CommandId) -> Result<Progress, PollError> {
        // A hold that did not get through is tried again at the next poll.
        if self.asked.load(Ordering::SeqCst) && self.inner.hold(true).is_ok() {
            self.asked.store(false, Ordering::SeqCst);
        }
        self.inner.poll(id)
    }

    fn hold(&mut self, on: bool) -> Result<(), HoldError> {
        self.inner.hold(on)?;
        if on {
            self.asked.store(false, Ordering::SeqCst);
        }
        Ok(())
    }

    fn latch(&mut self, reason: &str) {
        self.inner.latch(reason);
    }

    /// An operator who resumes has taken back the wish that the robot stand, also one that never got through.
    fn resume(&mut self) -> Result<Pose, ResumeError> {
        let position = self.inner.resume()?;
        self.asked.store(false, Ordering::SeqCst);
        Ok(position)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{AbortReason, Clock, ManualClock, Outcome, Simulated, SimulatedConfig};
    use std::time::Duration;

    #[test]
    fn a_robot_in_motion_stands_at_the_next_poll_and_starts_nothing_while_asked_to_stand() {
        let clock = ManualClock::new();
        let arm = Simulated::new(SimulatedConfig::default(), clock.clone()).unwrap();
        let panel = arm.panel();
        let asked = Arc::new(AtomicBool::new(false));
        let mut robot = HoldSwitch::new(arm, Arc::clone(&asked));
        robot.connect().unwrap();
        let motion = Motion::Linear { target: Pose::gripper_down(400.0, 0.0, 200.0, 0.0), speed_mm_s: 50.0 };
        robot.start_motion(CommandId(1), &motion).unwrap();
        clock.sleep(Duration::from_secs(1));
        asked.store(true, Ordering::SeqCst);
        let outcome = robot.poll(CommandId(1)).unwrap().outcome;
        assert_eq!(outcome, Outcome::Aborted { reason: AbortReason::Hold });
        assert!((panel.position().z_mm - 350.0).abs() < 1e-6);
        robot.hold(false).unwrap();
        asked.store(true, Ordering::SeqCst);
        assert_eq!(robot.start_motion(CommandId(2), &motion), Err(MotionError::HoldAsked));
        assert_eq!(robot.start_gripper(CommandId(3), GripperCommand::Open), Err(GripperError::HoldAsked));
        assert_eq!(panel.motions_begun(), 1);
        // Nothing was in motion that a hold could have reached: resume takes the wish back.
        robot.resume().unwrap();
        robot.start_motion(CommandId(4), &motion).unwrap();
        assert_eq!(panel.motions_begun(), 2);
    }
}
