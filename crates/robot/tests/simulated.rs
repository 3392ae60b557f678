//! What the simulated arm promises beyond the conformance suite: time, path and reach.

// A test says what went wrong best by stopping there.
#![allow(clippy::unwrap_used, clippy::panic)]

use std::sync::{Arc, Mutex};
use std::time::Duration;

use proptest::prelude::*;
use samsod_robot::{
    Clock, Command, CommandId, Controller, Fault, GripperCommand, GripperState, Joints, ManualClock, Motion,
    MotionError, Outcome, Pose, Simulated, SimulatedConfig, SimulatedConfigError, Workpieces,
};

fn arm() -> (Simulated, ManualClock) {
    let clock = ManualClock::new();
    let mut robot = Simulated::new(SimulatedConfig::default(), clock.clone()).unwrap();
    robot.connect().unwrap();
    (robot, clock)
}

/// Poses in front of the base, between which no straight line leaves the reach or passes a singularity.
fn pose() -> impl Strategy<Value = Pose> {
    (300.0..450.0f64, -250.0..250.0f64, 100.0..400.0f64, -1.5..1.5f64)
        .prop_map(|(x, y, z, yaw)| Pose::gripper_down(x, y, z, yaw))
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 128, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn a_linear_motion_stays_on_the_segment_and_arrives_when_distance_over_speed_says(
        goal in pose(), speed in 20.0..400.0f64, shares in proptest::collection::vec(0.0..0.99f64, 1..8),
    ) {
        let (mut robot, clock) = arm();
        let start = robot.position().unwrap();
        // Orientation kept: its own speed limit would lengthen short motions.
        let goal = Pose { rz_rad: start.rz_rad, ..goal };
        let distance = start.distance_mm(&goal);
        robot.start_motion(CommandId(1), &Motion::Linear { target: goal, speed_mm_s: speed }).unwrap();
        let lasts = distance / speed;
        let mut shares = shares;
        shares.sort_by(f64::total_cmp);
        let mut before = 0.0;
        for share in shares {
            clock.advance(Duration::from_secs_f64((share - before) * lasts));
            before = share;
            let at = robot.position().unwrap();
            let (gone, left) = (start.distance_mm(&at), at.distance_mm(&goal));
            prop_assert!((gone + left - distance).abs() < 1e-6, "off the segment: {gone} + {left} != {distance}");
            prop_assert!((gone - share * distance).abs() < 1e-3, "not at constant speed: {gone} of {distance} at {share}");
        }
        let just_before = Duration::from_secs_f64((lasts - 1e-6).max(0.0));
        clock.advance(just_before.saturating_sub(clock.now()));
        prop_assert_eq!(robot.poll(CommandId(1)).unwrap().outcome, Outcome::Accepted);
        clock.advance(Duration::from_micros(2));
        prop_assert_eq!(robot.poll(CommandId(1)).unwrap().outcome, Outcome::Done);
        prop_assert_eq!(robot.position().unwrap(), goal);
    }

    #[test]
    fn a_joint_motion_takes_the_time_that_its_slowest_joint_needs(first in pose(), goal in pose(), fraction in 0.05..1.0f64) {
        let (mut robot, clock) = arm();
        robot.start_motion(CommandId(1), &Motion::Joint { target: first, speed_fraction: 1.0 }).unwrap();
        clock.advance(Duration::from_secs(60));
        prop_assert_eq!(robot.poll(CommandId(1)).unwrap().outcome, Outcome::Done);
        let model = SimulatedConfig::default().arm();
        let home = model.joints_at(&SimulatedConfig::default().home, &Joints([0.0; 6])).unwrap();
        let from = model.joints_at(&first, &home).unwrap();
        let to = model.joints_at(&goal, &from).unwrap();
        let speeds = [2.96, 2.96, 2.96, 3.48, 3.48, 6.97];
        let times = (0..6).map(|i| (to.0[i] - from.0[i]).abs() / speeds[i] / fraction);
        let lasts = times.fold(0.0, f64::max);
        robot.start_motion(CommandId(2), &Motion::Joint { target: goal, speed_fraction: fraction }).unwrap();
        clock.advance(Duration::from_secs_f64((lasts - 1e-5).max(0.0)));
        if lasts > 1e-5 {
            prop_assert_eq!(robot.poll(CommandId(2)).unwrap().outcome, Outcome::Accepted);
        }
        clock.advance(Duration::from_micros(20));
        prop_assert_eq!(robot.poll(CommandId(2)).unwrap().outcome, Outcome::Done);
        prop_assert_eq!(robot.position().unwrap(), goal);
    }

    #[test]
    fn no_target_and_no_fault_make_it_panic_or_leave_its_reach(
        x in -2000.0..2000.0f64, y in -2000.0..2000.0f64, z in -2000.0..2000.0f64, fault in 0usize..6, when in 0.0..3.0f64,
    ) {
        let (mut robot, clock) = arm();
        let faults =
            [Fault::EmergencyStop, Fault::StopShort, Fault::Stall, Fault::ExternalHold, Fault::Disconnect, Fault::Teach];
        let motion = Motion::Linear { target: Pose::gripper_down(x, y, z, 0.0), speed_mm_s: 300.0 };
        let accepted = robot.start_motion(CommandId(1), &motion).is_ok();
        clock.advance(Duration::from_secs_f64(when));
        robot.panel().inject(faults[fault]);
        clock.advance(Duration::from_secs(9));
        let at = robot.panel().position();
        // The wrist lies 186.5 mm above a tool that points down; both arms together are 617.7 mm long.
        let from_joint_l = (at.x_mm.hypot(at.y_mm) - 88.0).hypot(at.z_mm + 186.5 - 330.0);
        prop_assert!(from_joint_l < 617.7, "{at}");
        prop_assert_eq!(robot.panel().motions_begun(), u64::from(accepted));
    }
}

#[test]
fn a_turn_in_place_takes_the_time_of_the_wrist() {
    let (mut robot, clock) = arm();
    let target = Pose { rz_rad: 1.74, ..robot.position().unwrap() };
    robot.start_motion(CommandId(1), &Motion::Linear { target, speed_mm_s: 100.0 }).unwrap();
    clock.advance(Duration::from_millis(499));
    assert_eq!(robot.poll(CommandId(1)).unwrap().outcome, Outcome::Accepted);
    clock.advance(Duration::from_millis(2));
    assert_eq!(robot.poll(CommandId(1)).unwrap().outcome, Outcome::Done, "1.74 rad at 3.48 rad/s take 0.5 s");
}

#[test]
fn a_line_past_the_axis_of_the_base_is_refused_although_both_ends_can_be_reached() {
    let (mut robot, clock) = arm();
    let right = Pose::gripper_down(10.0, -400.0, 200.0, 0.0);
    robot.start_motion(CommandId(1), &Motion::Joint { target: right, speed_fraction: 1.0 }).unwrap();
    clock.advance(Duration::from_secs(20));
    let left = Pose::gripper_down(10.0, 400.0, 200.0, 0.0);
    let refused = robot.start_motion(CommandId(2), &Motion::Linear { target: left, speed_mm_s: 500.0 }).unwrap_err();
    assert!(matches!(refused, MotionError::OutOfReach { .. } | MotionError::Singular { .. }), "{refused}");
    assert_eq!(robot.position().unwrap(), right);
    robot.start_motion(CommandId(3), &Motion::Joint { target: left, speed_fraction: 1.0 }).unwrap();
}

/// A table with one thing on it, within 5 mm of a point, that counts what it is told.
struct OneThing {
    at: Pose,
    passed: Arc<Mutex<Vec<Pose>>>,
}

impl Workpieces for OneThing {
    fn passes(&mut self, tool: &Pose) {
        self.passed.lock().unwrap().push(*tool);
    }

    fn close(&mut self, tool: &Pose) -> bool {
        tool.distance_mm(&self.at) < 5.0
    }

    fn open(&mut self, _tool: &Pose) {}
}

#[test]
fn the_gripper_holds_what_it_closes_on_and_the_table_sees_every_step_of_the_way() {
    let passed = Arc::new(Mutex::new(Vec::new()));
    let clock = ManualClock::new();
    let thing = OneThing { at: Pose::gripper_down(420.0, 30.0, 120.0, 0.0), passed: Arc::clone(&passed) };
    let robot = Simulated::new(SimulatedConfig::default(), clock.clone()).unwrap();
    let mut robot = robot.with_workpieces(Box::new(thing));
    robot.connect().unwrap();
    let mut id = 0;
    let mut finish = |robot: &mut Simulated, command: Command| {
        id += 1;
        match command {
            Command::Move(motion) => robot.start_motion(CommandId(id), &motion).unwrap(),
            Command::Gripper { gripper } => robot.start_gripper(CommandId(id), gripper).unwrap(),
            Command::Hold { .. } => unreachable!(),
        }
        for _ in 0..100 {
            clock.advance(Duration::from_millis(100));
            if robot.poll(CommandId(id)).unwrap().outcome == Outcome::Done {
                return robot.status().unwrap().gripper;
            }
        }
        panic!("not done after ten seconds");
    };
    let close = Command::Gripper { gripper: GripperCommand::Close };
    let open = Command::Gripper { gripper: GripperCommand::Open };
    assert_eq!(finish(&mut robot, close), GripperState::Empty, "nothing lies at home");
    assert_eq!(finish(&mut robot, open), GripperState::Open);
    let target = Pose::gripper_down(420.0, 33.0, 120.0, 0.0);
    let joint = Command::Move(Motion::Joint { target: Pose { z_mm: 220.0, ..target }, speed_fraction: 0.3 });
    finish(&mut robot, joint);
    finish(&mut robot, Command::Move(Motion::Linear { target, speed_mm_s: 200.0 }));
    assert_eq!(finish(&mut robot, close), GripperState::Holding);
    let passed = passed.lock().unwrap();
    assert!(passed.windows(2).all(|pair| pair[0].distance_mm(&pair[1]) < 2.5), "steps of at most 2 mm");
    assert_eq!(*passed.last().unwrap(), target);
}

#[test]
fn a_stop_short_says_how_much_was_left() {
    let (mut robot, clock) = arm();
    let home = robot.position().unwrap();
    let target = Pose { z_mm: home.z_mm - 100.0, ..home };
    robot.start_motion(CommandId(1), &Motion::Linear { target, speed_mm_s: 50.0 }).unwrap();
    clock.advance(Duration::from_millis(1500));
    robot.panel().inject(Fault::StopShort);
    let outcome = robot.poll(CommandId(1)).unwrap().outcome;
    assert_eq!(outcome.to_string(), "aborted: stopped 25000 um short of the target");
}

#[test]
fn a_configuration_that_makes_no_arm_names_the_key() {
    let clock = ManualClock::new();
    let bad = [
        (SimulatedConfig { linear_speed_max_mm_s: f64::NAN, ..Default::default() }, "linear_speed_max_mm_s is NaN"),
        (SimulatedConfig { tool_length_mm: -3.0, ..Default::default() }, "tool_length_mm is -3; it must be 0 to 1000"),
    ];
    for (config, message) in bad {
        let error = Simulated::new(config, clock.clone()).unwrap_err();
        assert!(error.to_string().starts_with(message), "{error}");
    }
    let far = SimulatedConfig { home: Pose::gripper_down(3000.0, 0.0, 0.0, 0.0), ..Default::default() };
    assert!(matches!(Simulated::new(far, clock), Err(SimulatedConfigError::Home(_))));
}
