//! The conformance suite: what every controller must do, whatever robot is behind it.
//!
//! A backend joins by a function that makes a [`Rig`]: a connected controller, the clock it lives on, and hands at the
//! robot. Run on the simulated controller here; a backend over a network runs it against its emulator.

// A test says what went wrong best by stopping there.
#![allow(clippy::unwrap_used, clippy::panic)]

use std::f64::consts::FRAC_PI_2;
use std::time::Duration;

use samsod_robot::emulator::{EmptyTable, Emulator, EmulatorConfig};
use samsod_robot::motoman::{GripperConfig, Mode};
use samsod_robot::{
    AbortReason, Clock, CommandId, Controller, Fault, FollowOptions, GripperCommand, GripperError, GripperState,
    ManualClock, Motion, MotionError, Motoman, MotomanConfig, NoWireLog, NotReady, Outcome, Panel, PollError, Pose,
    ResumeError, Simulated, SimulatedConfig, follow,
};

/// Hands at the robot: what a test does there, and what it sees there and not through the controller.
trait AtTheRobot {
    /// Makes something go wrong.
    fn inject(&self, fault: Fault);
    /// Puts everything right at the robot.
    fn restore(&self);
    /// How many motions the robot has begun; the position `base_from_tool` of its tool.
    fn motions_begun(&self) -> u64;
    fn position(&self) -> Pose;
}

impl AtTheRobot for Panel {
    fn inject(&self, fault: Fault) {
        Panel::inject(self, fault);
    }

    fn restore(&self) {
        Panel::restore(self);
    }

    fn motions_begun(&self) -> u64 {
        Panel::motions_begun(self)
    }

    fn position(&self) -> Pose {
        Panel::position(self)
    }
}

impl AtTheRobot for Emulator {
    fn inject(&self, fault: Fault) {
        Emulator::inject(self, fault);
    }

    fn restore(&self) {
        Emulator::restore(self);
    }

    fn motions_begun(&self) -> u64 {
        Emulator::motions_begun(self)
    }

    fn position(&self) -> Pose {
        Emulator::position(self)
    }
}

/// A controller under test.
struct Rig {
    controller: Box<dyn Controller>,
    clock: Box<dyn Clock>,
    panel: Box<dyn AtTheRobot>,
    /// What it says of a target beyond its reach: itself, if it knows the arm, or the real controller's refusal.
    beyond_reach: &'static str,
}

impl Rig {
    fn go(&mut self, id: u64, motion: &Motion) -> Result<Outcome, MotionError> {
        let from = self.controller.position().unwrap();
        self.controller.start_motion(CommandId(id), motion)?;
        let options = FollowOptions::for_motion(from.distance_mm(motion.target()), 50.0);
        Ok(follow(&mut *self.controller, &*self.clock, CommandId(id), &options, |_| ()))
    }

    fn outcome(&mut self, id: u64) -> Outcome {
        self.controller.poll(CommandId(id)).unwrap().outcome
    }
}

fn above_the_table(y_mm: f64) -> Pose {
    Pose::gripper_down(420.0, y_mm, 120.0, FRAC_PI_2)
}

fn linear(y_mm: f64) -> Motion {
    Motion::Linear { target: above_the_table(y_mm), speed_mm_s: 100.0 }
}

/// The whole suite; `make` must give a fresh, connected controller each time.
fn conformance(make: impl Fn() -> Rig) {
    reaches_its_target(make());
    is_accepted_before_it_arrives(make());
    takes_one_command_at_a_time(make());
    never_takes_an_id_twice(make());
    refuses_what_is_no_target(make());
    works_the_gripper(make());
    hold_stops_and_release_continues_nothing(make());
    faults_abort_and_latch(&make);
    a_lost_command_did_not_move(make());
    a_lost_answer_is_unknown_and_needs_an_operator(make());
    a_robot_that_falls_silent_while_moving_is_reached_anew_and_stands(make());
    what_never_arrives_is_held_at_the_deadline(make());
    answers_nothing_unconnected(make());
}

fn reaches_its_target(mut rig: Rig) {
    let joint = Motion::Joint { target: above_the_table(-150.0), speed_fraction: 0.5 };
    for (id, motion) in [(1, joint), (2, linear(150.0))] {
        assert_eq!(rig.go(id, &motion).unwrap(), Outcome::Done);
        let at = rig.controller.position().unwrap();
        assert!(at.distance_mm(motion.target()) < 0.5, "{at} instead of {}", motion.target());
        assert!(at.angle_rad(motion.target()) < 0.01, "{at} instead of {}", motion.target());
        assert!(!rig.controller.status().unwrap().running);
    }
    assert_eq!(rig.panel.motions_begun(), 2);
}

fn is_accepted_before_it_arrives(mut rig: Rig) {
    rig.controller.start_motion(CommandId(1), &linear(0.0)).unwrap();
    let progress = rig.controller.poll(CommandId(1)).unwrap();
    assert_eq!(progress.outcome, Outcome::Accepted);
    assert!(progress.state.status.running);
    assert!(progress.state.position.distance_mm(&above_the_table(0.0)) > 100.0);
}

fn takes_one_command_at_a_time(mut rig: Rig) {
    rig.controller.start_motion(CommandId(1), &linear(0.0)).unwrap();
    let refused = rig.controller.start_motion(CommandId(2), &linear(50.0)).unwrap_err();
    assert_eq!(refused, MotionError::NotReady(NotReady::Running));
    assert!(matches!(refused.outcome(), Outcome::NotExecuted { .. }));
    let refused = rig.controller.start_gripper(CommandId(2), GripperCommand::Close).unwrap_err();
    assert_eq!(refused, GripperError::NotReady(NotReady::Running));
    let end = follow(&mut *rig.controller, &*rig.clock, CommandId(1), &FollowOptions::default(), |_| ());
    assert_eq!(end, Outcome::Done, "a refused command must not disturb the one under way");
    assert!(rig.controller.position().unwrap().distance_mm(&above_the_table(0.0)) < 0.5);
}

fn never_takes_an_id_twice(mut rig: Rig) {
    assert_eq!(rig.go(7, &linear(0.0)).unwrap(), Outcome::Done);
    for id in [7, 6] {
        let refused = rig.go(id, &linear(40.0)).unwrap_err();
        assert_eq!(refused, MotionError::StaleId { id: CommandId(id), last: CommandId(7) });
    }
    rig.controller.connect().unwrap();
    let refused = rig.controller.start_gripper(CommandId(7), GripperCommand::Open).unwrap_err();
    assert_eq!(refused, GripperError::StaleId { id: CommandId(7), last: CommandId(7) });
    assert_eq!(rig.panel.motions_begun(), 1);
}

fn refuses_what_is_no_target(mut rig: Rig) {
    let start = rig.controller.position().unwrap();
    let mut no_number = above_the_table(0.0);
    no_number.rz_rad = f64::NAN;
    let far = Pose::gripper_down(5000.0, 0.0, 100.0, 0.0);
    let cases = [
        (Motion::Linear { target: no_number, speed_mm_s: 50.0 }, "rz_rad of a pose is NaN"),
        (Motion::Linear { target: far, speed_mm_s: 50.0 }, rig.beyond_reach),
        (Motion::Joint { target: far, speed_fraction: 0.5 }, rig.beyond_reach),
        (Motion::Linear { target: above_the_table(0.0), speed_mm_s: 0.0 }, "speed 0 mm/s"),
        (Motion::Linear { target: above_the_table(0.0), speed_mm_s: f64::NAN }, "speed NaN mm/s"),
        (Motion::Joint { target: above_the_table(0.0), speed_fraction: 1.5 }, "speed 1.5"),
    ];
    for (id, (motion, why)) in (1..).zip(cases) {
        let refused = rig.controller.start_motion(CommandId(id), &motion).unwrap_err();
        assert!(refused.to_string().contains(why), "{refused}");
        assert!(matches!(refused.outcome(), Outcome::NotExecuted { .. }), "{refused}");
    }
    assert_eq!(rig.controller.position().unwrap(), start);
    assert_eq!(rig.panel.motions_begun(), 0);
}

fn works_the_gripper(mut rig: Rig) {
    for (id, command, ends) in
        [(1, GripperCommand::Open, GripperState::Open), (2, GripperCommand::Close, GripperState::Closed)]
    {
        rig.controller.start_gripper(CommandId(id), command).unwrap();
        let end = follow(&mut *rig.controller, &*rig.clock, CommandId(id), &FollowOptions::default(), |_| ());
        assert_eq!(end, Outcome::Done);
        assert_eq!(rig.controller.status().unwrap().gripper, ends);
    }
}

fn hold_stops_and_release_continues_nothing(mut rig: Rig) {
    rig.controller.start_motion(CommandId(1), &linear(0.0)).unwrap();
    rig.clock.sleep(Duration::from_millis(300));
    rig.controller.hold(true).unwrap();
    assert_eq!(rig.outcome(1), Outcome::Aborted { reason: AbortReason::Hold });
    let stands = rig.controller.position().unwrap();
    let refused = rig.controller.start_motion(CommandId(2), &linear(0.0)).unwrap_err();
    assert_eq!(refused, MotionError::NotReady(NotReady::Hold { by: "command" }));
    rig.controller.hold(false).unwrap();
    rig.clock.sleep(Duration::from_secs(5));
    assert_eq!(rig.controller.position().unwrap(), stands, "it moved on by itself");
    assert_eq!(rig.go(3, &linear(0.0)).unwrap(), Outcome::Done);
}

fn faults_abort_and_latch(make: impl Fn() -> Rig) {
    let cases = [
        (Fault::EmergencyStop, AbortReason::EmergencyStop),
        (Fault::ServoOff, AbortReason::ServoOff),
        (Fault::Alarm(4107), AbortReason::Alarm { code: 4107 }),
        (Fault::Teach, AbortReason::NotRemote),
    ];
    for (fault, reason) in cases {
        let mut rig = make();
        rig.controller.start_motion(CommandId(1), &linear(0.0)).unwrap();
        rig.clock.sleep(Duration::from_millis(300));
        rig.panel.inject(fault);
        assert_eq!(rig.outcome(1), Outcome::Aborted { reason });
        let stands = rig.controller.position().unwrap();

        let cannot = rig.controller.resume().unwrap_err();
        assert!(matches!(cannot, ResumeError::NotReady(_)), "{fault:?}: resumed while the fault stands");
        rig.panel.restore();
        let refused = rig.controller.start_motion(CommandId(2), &linear(0.0)).unwrap_err();
        assert!(
            matches!(refused, MotionError::NotReady(NotReady::Latched { .. })),
            "{fault:?}: moves without an operator's resume"
        );
        rig.clock.sleep(Duration::from_secs(5));
        assert_eq!(rig.controller.resume().unwrap(), stands, "{fault:?}");
        assert_eq!(rig.panel.motions_begun(), 1, "{fault:?}");
        assert_eq!(rig.go(3, &linear(0.0)).unwrap(), Outcome::Done, "{fault:?}");
    }
}

fn a_lost_command_did_not_move(mut rig: Rig) {
    let start = rig.panel.position();
    rig.panel.inject(Fault::LoseNextCommand);
    let error = rig.controller.start_motion(CommandId(1), &linear(0.0)).unwrap_err();
    assert!(matches!(error, MotionError::NotSent { .. }), "{error}");
    assert!(matches!(error.outcome(), Outcome::NotExecuted { .. }));
    rig.clock.sleep(Duration::from_secs(5));
    assert_eq!(rig.panel.position(), start);
    rig.controller.connect().unwrap();
    assert_eq!(rig.go(2, &linear(0.0)).unwrap(), Outcome::Done, "it may be given again under a new id");
    assert_eq!(rig.panel.motions_begun(), 1);
}

fn a_lost_answer_is_unknown_and_needs_an_operator(mut rig: Rig) {
    rig.panel.inject(Fault::LoseNextAnswer);
    let error = rig.controller.start_motion(CommandId(1), &linear(0.0)).unwrap_err();
    assert!(matches!(error.outcome(), Outcome::Unknown { .. }), "{error}");
    rig.controller.connect().unwrap();
    let moving = rig.controller.resume().unwrap_err();
    assert_eq!(moving, ResumeError::NotReady(NotReady::Running));
    rig.clock.sleep(Duration::from_secs(20));
    assert!(matches!(rig.outcome(1), Outcome::Unknown { .. }), "what was unknown must not become done");
    let refused = rig.go(2, &linear(50.0)).unwrap_err();
    assert!(matches!(refused, MotionError::NotReady(NotReady::Latched { .. })), "{refused}");
    let read_back = rig.controller.resume().unwrap();
    assert!(read_back.distance_mm(&above_the_table(0.0)) < 0.5);
    assert_eq!(rig.go(3, &linear(50.0)).unwrap(), Outcome::Done);
    assert_eq!(rig.panel.motions_begun(), 2);
}

fn a_robot_that_falls_silent_while_moving_is_reached_anew_and_stands(mut rig: Rig) {
    rig.controller.start_motion(CommandId(1), &linear(0.0)).unwrap();
    rig.panel.inject(Fault::Disconnect);
    let end = follow(&mut *rig.controller, &*rig.clock, CommandId(1), &FollowOptions::default(), |_| ());
    let Outcome::Unknown { reason } = end else { panic!("{end}") };
    assert!(reason.ends_with("the robot was put on hold"), "{reason}");
    let status = rig.controller.status().unwrap();
    assert!(status.hold_command && !status.running && status.latched.is_some(), "{status:?}");
    rig.clock.sleep(Duration::from_secs(20));
    assert!(rig.controller.position().unwrap().distance_mm(linear(0.0).target()) > 1.0, "it stopped on its way");
    let refused = rig.controller.start_motion(CommandId(2), &linear(50.0)).unwrap_err();
    assert!(matches!(refused, MotionError::NotReady(NotReady::Latched { .. })), "{refused}");
}

fn what_never_arrives_is_held_at_the_deadline(mut rig: Rig) {
    rig.controller.start_motion(CommandId(1), &linear(0.0)).unwrap();
    rig.panel.inject(Fault::Stall);
    let options = FollowOptions { deadline: Duration::from_secs(9), ..FollowOptions::default() };
    let end = follow(&mut *rig.controller, &*rig.clock, CommandId(1), &options, |_| ());
    assert!(matches!(end, Outcome::Aborted { reason: AbortReason::Timeout { allowed_ms: 9000, .. } }), "{end}");
    let status = rig.controller.status().unwrap();
    assert!(status.hold_command && !status.running && status.latched.is_some(), "{status:?}");
}

fn answers_nothing_unconnected(mut rig: Rig) {
    rig.panel.inject(Fault::Disconnect);
    assert!(rig.controller.status().is_err());
    assert!(rig.controller.position().is_err());
    assert!(matches!(rig.controller.poll(CommandId(1)), Err(PollError::Status(_))));
    assert!(rig.controller.hold(true).is_err());
    assert!(rig.controller.resume().is_err());
    assert_eq!(rig.controller.start_motion(CommandId(1), &linear(0.0)), Err(MotionError::NotConnected));
    rig.controller.connect().unwrap();
    let refused = rig.controller.poll(CommandId(9)).unwrap_err();
    assert_eq!(refused, PollError::NotTheLast { id: CommandId(9), last: None });
    assert_eq!(rig.go(1, &linear(0.0)).unwrap(), Outcome::Done);
}

fn simulated() -> Rig {
    let clock = ManualClock::new();
    let mut controller = Simulated::new(SimulatedConfig::default(), clock.clone()).unwrap();
    controller.connect().unwrap();
    let panel = Box::new(controller.panel());
    Rig { controller: Box::new(controller), clock: Box::new(clock), panel, beyond_reach: "out of reach" }
}

/// A Motoman before an emulated controller, over TCP.
fn motoman(config: MotomanConfig) -> Rig {
    let clock = ManualClock::new();
    let emulated = EmulatorConfig::default();
    let emergency_stop = Some(emulated.emergency_stop);
    let emulator = Emulator::start(emulated, clock.clone(), Box::new(EmptyTable)).unwrap();
    let config = MotomanConfig {
        address: emulator.address().to_string(),
        emergency_stop,
        // However busy the machine is.
        greeting_timeout_ms: 20_000,
        header_timeout_ms: 20_000,
        answer_timeout_ms: 20_000,
        ..config
    };
    let mut controller = Motoman::new(config, clock.clone(), Box::new(NoWireLog)).unwrap();
    controller.connect().unwrap();
    let beyond_reach = "refused the motion: 1012 (an operand is out of range)";
    Rig { controller: Box::new(controller), clock: Box::new(clock), panel: Box::new(emulator), beyond_reach }
}

fn gripper_jobs() -> GripperConfig {
    let EmulatorConfig { gripper_open_job: open_job, gripper_close_job: close_job, .. } = EmulatorConfig::default();
    GripperConfig::Jobs { open_job, close_job }
}

#[test]
fn simulated_conforms() {
    conformance(simulated);
}

#[test]
fn motoman_in_direct_mode_conforms() {
    conformance(|| motoman(MotomanConfig::default()));
}

#[test]
fn motoman_in_job_mode_conforms() {
    let job = Some(EmulatorConfig::default().move_job);
    conformance(|| {
        motoman(MotomanConfig { mode: Mode::Job, job: job.clone(), gripper: gripper_jobs(), ..Default::default() })
    });
}

#[test]
fn motoman_conforms_with_what_differs_from_controller_to_controller() {
    let config = MotomanConfig {
        data_terminator: samsod_robot::motoman::command::Terminator::CrLf,
        keep_alive: 7,
        gripper: gripper_jobs(),
        coordinate_system: 1,
        tool: 3,
        ..Default::default()
    };
    conformance(|| motoman(config.clone()));
}
