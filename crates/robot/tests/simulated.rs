//! What the simulated arm promises beyond the conformance suite: time, path and reach.

// A test says what went wrong best by stopping there.
#![allow(clippy::unwrap_used, clippy::panic)]

use std::time::Duration;

use proptest::prelude::*;
use samsod_robot::{
    Clock, CommandId, Controller, Fault, ManualClock, Motion, MotionError, Outcome, Pose, Simulated, SimulatedConfig,
    SimulatedConfigError,
};

fn arm() -> (Simulated, ManualClock) {
    let clock = ManualClock::new();
    let mut robot = Simulated::new(SimulatedConfig::default(), clock.clone()).unwrap();
    robot.connect().unwrap();
    (robot, clock)
}

/// Poses in the quarter in front of the base, which no straight line between them leaves.
fn pose() -> impl Strategy<Value = Pose> {
    (250.0..450.0f64, -300.0..300.0f64, 100.0..500.0f64, -3.0..3.0f64)
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
    fn a_joint_motion_stays_between_its_ends_in_turn_radius_and_height(
        first in pose(), goal in pose(), fraction in 0.05..1.0f64, share in 0.0..1.0f64,
    ) {
        let (mut robot, clock) = arm();
        robot.start_motion(CommandId(1), &Motion::Joint { target: first, speed_fraction: 1.0 }).unwrap();
        clock.advance(Duration::from_secs(60));
        robot.start_motion(CommandId(2), &Motion::Joint { target: goal, speed_fraction: fraction }).unwrap();
        // The slowest that any axis can be: 2.96 rad/s, 1200 mm/s, 3.48 rad/s.
        clock.advance(Duration::from_secs_f64(share * 6.0 / 3.48 / fraction));
        let at = robot.position().unwrap();
        let between = |value: f64, a: f64, b: f64| value >= a.min(b) - 1e-6 && value <= a.max(b) + 1e-6;
        let turn = |p: &Pose| p.y_mm.atan2(p.x_mm);
        let radius = |p: &Pose| p.x_mm.hypot(p.y_mm);
        prop_assert!(between(turn(&at), turn(&first), turn(&goal)), "turn {at}");
        prop_assert!(between(radius(&at), radius(&first), radius(&goal)), "radius {at}");
        prop_assert!(between(at.z_mm, first.z_mm, goal.z_mm), "height {at}");
        clock.advance(Duration::from_secs(60));
        prop_assert_eq!(robot.poll(CommandId(2)).unwrap().outcome, Outcome::Done);
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
        let from_shoulder = (at.x_mm.powi(2) + at.y_mm.powi(2) + (at.z_mm - 330.0).powi(2)).sqrt();
        prop_assert!((149.9..790.1).contains(&from_shoulder), "{at}");
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
fn a_line_through_the_base_is_refused_although_both_ends_can_be_reached() {
    let (mut robot, clock) = arm();
    let right = Pose::gripper_down(50.0, -400.0, 330.0, 0.0);
    robot.start_motion(CommandId(1), &Motion::Joint { target: right, speed_fraction: 1.0 }).unwrap();
    clock.advance(Duration::from_secs(20));
    let left = Pose::gripper_down(50.0, 400.0, 330.0, 0.0);
    let refused = robot.start_motion(CommandId(2), &Motion::Linear { target: left, speed_mm_s: 100.0 }).unwrap_err();
    assert!(matches!(refused, MotionError::OutOfReach { value, .. } if (value - 50.0).abs() < 1e-6), "{refused}");
    robot.start_motion(CommandId(3), &Motion::Joint { target: left, speed_fraction: 1.0 }).unwrap();
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
        (SimulatedConfig { reach_min_mm: 900.0, ..Default::default() }, "reach_min_mm is 900"),
        (SimulatedConfig { linear_speed_max_mm_s: f64::NAN, ..Default::default() }, "linear_speed_max_mm_s is NaN"),
        (
            SimulatedConfig { base_turn_max_rad: 200f64.to_radians(), ..Default::default() },
            "base_turn_max_deg is 200; it must be above 0 and below 180",
        ),
        (
            SimulatedConfig { base_speed_max_rad_s: (-7f64).to_radians(), ..Default::default() },
            "base_speed_max_deg_s is -7; it must be a finite number above 0",
        ),
        (SimulatedConfig { wrist_speed_max_rad_s: 0.0, ..Default::default() }, "wrist_speed_max_deg_s is 0; "),
    ];
    for (config, message) in bad {
        let error = Simulated::new(config, clock.clone()).unwrap_err();
        assert!(error.to_string().starts_with(message), "{error}");
    }
    let far = SimulatedConfig { home: Pose::gripper_down(3000.0, 0.0, 0.0, 0.0), ..Default::default() };
    assert!(matches!(Simulated::new(far, clock), Err(SimulatedConfigError::Home(_))));
}
