//! The pick-and-place sequence over the simulated arm and its table: what is placed, what waits, what faults, and that nothing
//! moves by itself.

// A test says what went wrong best by stopping there.
#![allow(clippy::unwrap_used, clippy::panic)]

use std::collections::HashMap;
use std::f64::consts::FRAC_PI_2;
use std::time::Duration;

use proptest::prelude::*;
use samsod_robot::{
    Clock, Command, CommandId, Controller, Convex, Fault, Grasp, GripperHolds, GripperShape, HoldReason, JigSlot,
    Limited, Limits, ManualClock, Outcome, Panel, PartTable, PassedOver, Phase, PickReport, PickResult, PickTolerance,
    Planner, Pose, Purpose, Reason, RobotState, SeenPart, Sequence, SequenceFault, SequenceLog, SequenceOptions,
    SequenceResumeError, SequenceState, Sight, Simulated, SimulatedConfig, TablePart, TableState, Whereabouts,
};

/// Everything that was logged, and what shall go wrong at a step.
#[derive(Default)]
struct Log {
    commands: Vec<(CommandId, Phase, Command)>,
    outcomes: Vec<(CommandId, Outcome)>,
    picks: Vec<PickReport>,
    passed_over: Vec<PassedOver>,
    faults: Vec<SequenceFault>,
    inject: Option<(Phase, Panel, Fault)>,
    refuse_at: Option<Phase>,
}

impl SequenceLog for Log {
    fn command(&mut self, id: CommandId, command: &Command, purpose: &Purpose<'_>) -> Result<(), String> {
        if self.refuse_at == Some(purpose.phase) {
            return Err("the disk is full".to_owned());
        }
        self.commands.push((id, purpose.phase, *command));
        Ok(())
    }

    fn outcome(&mut self, id: CommandId, outcome: &Outcome) {
        let running = *outcome == Outcome::Accepted;
        self.outcomes.push((id, outcome.clone()));
        if running
            && let Some((phase, panel, fault)) = &self.inject
            && self.commands.last().is_some_and(|(_, now, _)| now == phase)
        {
            panel.inject(*fault);
            self.inject = None;
        }
    }

    fn state(&mut self, _state: &RobotState) {}

    fn passed_over(&mut self, _frame: u64, parts: &[PassedOver]) {
        self.passed_over = parts.to_vec();
    }

    fn picked(&mut self, report: &PickReport) {
        self.picks.push(report.clone());
    }

    fn fault(&mut self, fault: &SequenceFault) {
        self.faults.push(fault.clone());
    }
}

impl Log {
    fn phases(&self) -> Vec<Phase> {
        self.commands.iter().map(|(_, phase, _)| *phase).collect()
    }
}

/// A block of 40 x 20 mm, 30 mm high.
fn block(name: &str, x_mm: f64, y_mm: f64, yaw_deg: f64) -> TablePart {
    TablePart {
        name: name.to_owned(),
        whereabouts: Whereabouts::Table,
        x_mm,
        y_mm,
        z_mm: 0.0,
        yaw_rad: yaw_deg.to_radians(),
        height_mm: 30.0,
        grasp_width_mm: 20.0,
        grasp_offset_mm: [0.0, 0.0],
        grasp_angle_rad: 0.0,
        symmetry_order: 1,
        outline_mm: Convex::rectangle([0.0, 0.0], [40.0, 20.0], 0.0),
    }
}

fn slot(part: &str, y_mm: f64) -> JigSlot {
    JigSlot { part: part.to_owned(), x_mm: 250.0, y_mm, z_mm: 0.0, yaw_rad: FRAC_PI_2 }
}

fn gripper() -> GripperShape {
    GripperShape { opening_mm: 50.0, finger_thickness_mm: 5.0, finger_width_mm: 10.0, ..GripperShape::default() }
}

type Robot = Limited<Simulated, ManualClock>;

struct Cell {
    sequence: Sequence<Robot, ManualClock>,
    clock: ManualClock,
    table: PartTable,
    panel: Panel,
    log: Log,
    frame: u64,
}

impl Cell {
    fn new(parts: Vec<TablePart>, order: Vec<JigSlot>) -> Self {
        let clock = ManualClock::new();
        let table = PartTable::new(TableState::new(parts), gripper(), PickTolerance::default());
        let config = SimulatedConfig::default();
        let mut robot = Simulated::new(config.clone(), clock.clone()).unwrap().with_workpieces(Box::new(table.clone()));
        robot.connect().unwrap();
        let panel = robot.panel();
        let robot = Limited::new(robot, clock.clone(), Limits::default());
        let options = SequenceOptions {
            home: config.home,
            safe_z_mm: 120.0,
            joint_speed_fraction: 0.5,
            linear_speed_mm_s: 200.0,
            joint_timeout: Duration::from_secs(20),
            gripper_timeout: Duration::from_secs(2),
            poll_interval: Duration::from_millis(50),
        };
        let planner = Planner {
            order,
            gripper: gripper(),
            clearance_mm: 2.0,
            safe_height_mm: 120.0,
            score_min: 0.5,
            arm: Some(config.arm()),
            limits: Some(Limits::default()),
        };
        let sequence = Sequence::new(robot, clock.clone(), options, planner, CommandId(0));
        Self { sequence, clock, table, panel, log: Log::default(), frame: 0 }
    }

    /// A frame taken now: what lies on the table, `off_mm` beside where it is.
    fn look(&mut self, off_mm: [f64; 2]) -> Sight {
        self.frame += 1;
        let lying = self.table.state().parts;
        let lying = lying.iter().filter(|part| part.whereabouts != Whereabouts::Gripper);
        let parts = lying.map(|part| {
            let extent = part.outline_mm.extent_mm(0.0).unwrap();
            let grasp = Grasp { offset_mm: part.grasp_offset_mm, angle_rad: 0.0, width_mm: part.grasp_width_mm };
            SeenPart {
                name: Some(part.name.clone()),
                score: 0.9,
                at_mm: [part.x_mm + off_mm[0], part.y_mm + off_mm[1]],
                yaw_rad: part.yaw_rad,
                z_mm: 0.0,
                height_mm: part.height_mm,
                outline_mm: part.outline_mm.clone(),
                grasps: vec![grasp, Grasp { angle_rad: FRAC_PI_2, width_mm: extent[1] - extent[0], ..grasp }],
                symmetry_order: part.symmetry_order,
            }
        });
        Sight { frame: self.frame, taken_at: self.clock.now(), parts: parts.collect() }
    }

    /// Frame after frame until nothing more can be picked.
    fn run(&mut self) {
        self.sequence.go_home(&mut self.log);
        for _ in 0..50 {
            self.clock.sleep(Duration::from_millis(40));
            let sight = self.look([0.2, -0.2]);
            self.clock.sleep(Duration::from_millis(60));
            if self.sequence.work(&sight, &mut self.log).is_none() {
                return;
            }
        }
        panic!("no end");
    }

    fn part(&self, name: &str) -> TablePart {
        self.table.state().parts.into_iter().find(|part| part.name == name).unwrap()
    }
}

#[test]
fn parts_are_placed_in_the_order_of_the_list_by_the_steps_of_figure_7() {
    let mut cell = Cell::new(
        vec![block("a", 420.0, 100.0, 20.0), block("b", 480.0, -60.0, -70.0)],
        vec![slot("b", 260.0), slot("a", 200.0)],
    );
    cell.run();
    assert_eq!(*cell.sequence.state(), SequenceState::Complete, "{:?}", cell.log.faults);
    let one = [
        Phase::Above,
        Phase::Open,
        Phase::Down,
        Phase::Close,
        Phase::Up,
        Phase::AboveSlot,
        Phase::DownSlot,
        Phase::Release,
        Phase::UpSlot,
    ];
    assert_eq!(cell.log.phases(), [&[Phase::Home][..], &one, &one].concat());
    let placed: Vec<_> = cell.log.picks.iter().map(|pick| (pick.part.as_str(), pick.result.clone())).collect();
    assert_eq!(placed, [("b", PickResult::Placed), ("a", PickResult::Placed)]);
    // Seen 0.28 mm off, so it lies as much off in its slot.
    for (name, y_mm) in [("b", 260.0), ("a", 200.0)] {
        let part = cell.part(name);
        assert_eq!(part.whereabouts, Whereabouts::Jig);
        assert!((part.x_mm - 250.0).hypot(part.y_mm - y_mm) < 0.3, "{part:?}");
        assert!((part.yaw_rad - FRAC_PI_2).abs() < 1e-6, "{part:?}");
    }
    // The grasp lies at half the height of the part.
    let down = cell.log.commands.iter().find(|(_, phase, _)| *phase == Phase::Down).unwrap();
    assert_eq!(down.2.target().unwrap().z_mm, 15.0);
    assert_eq!(cell.table.state().collisions, []);
    // Frames are 60 ms old when they are worked with.
    assert!(cell.log.picks.iter().all(|pick| (pick.gap_ms - 60.0).abs() < 1e-6), "{:?}", cell.log.picks);
    let ids: Vec<_> = cell.log.commands.iter().map(|(id, ..)| id.0).collect();
    assert_eq!(ids, (1..=19).collect::<Vec<_>>());
}

#[test]
fn a_blocked_part_waits_until_what_blocks_it_is_gone_or_is_gripped_across() {
    // b stands 12 mm beside a: no room for a finger, on the long side of either.
    let order = vec![slot("a", 200.0), slot("b", 260.0)];
    let mut wide = block("a", 420.0, 0.0, 0.0);
    wide.outline_mm = Convex::rectangle([0.0, 0.0], [60.0, 20.0], 0.0);
    // Wider than the gripper opens on its long side, so it cannot be gripped across.
    let mut cell = Cell::new(vec![wide, block("b", 420.0, 32.0, 0.0)], order.clone());
    cell.run();
    let placed: Vec<_> = cell.log.picks.iter().map(|pick| pick.part.as_str()).collect();
    assert_eq!(placed, ["b", "a"], "{:?}", cell.log.passed_over);
    assert_eq!(cell.table.state().collisions, []);

    let mut cell = Cell::new(vec![block("a", 420.0, 0.0, 0.0), block("b", 420.0, 32.0, 0.0)], order);
    cell.run();
    let placed: Vec<_> = cell.log.picks.iter().map(|pick| pick.part.as_str()).collect();
    assert_eq!(placed, ["a", "b"], "gripped across, 40 mm wide");
    let down = cell.log.commands.iter().find(|(_, phase, _)| *phase == Phase::Down).unwrap();
    let turn = down.2.target().unwrap().rz_rad.to_degrees();
    assert!((turn.abs() - 90.0).abs() < 1e-6, "{turn}");
    assert_eq!(cell.table.state().collisions, []);
}

#[test]
fn what_cannot_be_picked_is_passed_over_with_the_reason_and_the_rest_is_placed() {
    let mut far = slot("far", 0.0);
    far.x_mm = 760.0;
    let order = vec![far, slot("none", 320.0), slot("doubtful", 260.0), slot("a", 200.0)];
    let parts =
        vec![block("far", 420.0, 100.0, 0.0), block("doubtful", 480.0, -60.0, 0.0), block("a", 400.0, 0.0, 0.0)];
    let mut cell = Cell::new(parts, order);
    cell.sequence.go_home(&mut cell.log);
    let mut sight = cell.look([0.0; 2]);
    sight.parts[1].score = 0.4;
    let placed = cell.sequence.work(&sight, &mut cell.log).unwrap();
    assert_eq!((placed.part.as_str(), placed.result), ("a", PickResult::Placed));
    let reasons: HashMap<_, _> =
        cell.log.passed_over.iter().map(|over| (over.part.as_str(), over.reason.to_string())).collect();
    assert!(reasons["far"].starts_with("above the jig slot: (760.0, "), "{reasons:?}");
    assert_eq!(reasons["none"], "it is not seen");
    assert_eq!(reasons["doubtful"], "its score is 0.40; needed is 0.50");

    let mut sight = cell.look([0.0; 2]);
    sight.parts.retain(|part| part.name.as_deref() == Some("doubtful"));
    sight.parts[0].at_mm[0] = f64::NAN;
    assert_eq!(cell.sequence.work(&sight, &mut cell.log), None);
    let reason = &cell.log.passed_over.last().unwrap().reason;
    assert!(matches!(reason, Reason::Pose(_)), "{reason}");
}

#[test]
fn something_unknown_or_too_high_is_in_the_way() {
    let mut cell = Cell::new(vec![block("a", 420.0, 0.0, 0.0)], vec![slot("a", 200.0)]);
    cell.sequence.go_home(&mut cell.log);
    let unknown = |outline_mm, height_mm| SeenPart {
        name: None,
        score: 0.9,
        at_mm: [0.0; 2],
        yaw_rad: 0.0,
        z_mm: 0.0,
        height_mm,
        outline_mm,
        grasps: Vec::new(),
        symmetry_order: 1,
    };
    let mut sight = cell.look([0.0; 2]);
    sight.parts.push(unknown(Convex::rectangle([420.0, 28.0], [60.0, 10.0], 0.0), 20.0));
    sight.parts.push(unknown(Convex::rectangle([455.0, 0.0], [10.0, 30.0], 0.0), 20.0));
    assert_eq!(cell.sequence.work(&sight, &mut cell.log), None);
    let reason = cell.log.passed_over[0].reason.to_string();
    assert!(reason.starts_with("something unknown is in the way of the gripper"), "{reason}");

    let mut sight = cell.look([0.0; 2]);
    sight.parts.push(unknown(Convex::rectangle([520.0, -150.0], [20.0, 20.0], 0.0), 110.0));
    assert_eq!(cell.sequence.work(&sight, &mut cell.log), None);
    let reason = cell.log.passed_over[0].reason.to_string();
    assert!(
        reason.starts_with("the safe height of 120.0 mm is too low to carry it over something unknown"),
        "{reason}"
    );
    assert_eq!(cell.panel.motions_begun(), 1, "home only");
}

#[test]
fn what_lies_outside_the_region_of_interest_is_passed_over_and_in_the_way_by_its_name() {
    let (a, b) = (block("a", 420.0, 0.0, 0.0), block("b", 420.0, 32.0, 0.0));
    let (c, d) = (block("c", 480.0, -150.0, 0.0), block("d", 462.0, 0.0, 0.0));
    let mut cell = Cell::new(vec![a, b, c, d], vec![slot("a", 200.0), slot("b", 260.0), slot("c", 320.0)]);
    cell.sequence.go_home(&mut cell.log);
    let mut sight = cell.look([0.0; 2]);
    for part in sight.parts.iter_mut().filter(|part| ["b", "d"].contains(&part.name.as_deref().unwrap())) {
        part.grasps.clear();
    }
    let report = cell.sequence.work(&sight, &mut cell.log).unwrap();
    assert_eq!(report.part, "c", "{:?}", cell.log.passed_over);
    let reasons: Vec<_> =
        cell.log.passed_over.iter().map(|over| (over.part.as_str(), over.reason.to_string())).collect();
    assert!(reasons[0].0 == "a" && reasons[0].1.starts_with("b is in the way of the gripper"), "{reasons:?}");
    assert_eq!(reasons[1], ("b", "it lies outside the region of interest".to_owned()));
}

#[test]
fn a_pick_that_misses_is_told_and_tried_again_with_a_fresh_frame_three_times_at_most() {
    let mut cell = Cell::new(vec![block("a", 420.0, 0.0, 0.0)], vec![slot("a", 200.0)]);
    cell.sequence.go_home(&mut cell.log);
    for _ in 0..3 {
        let sight = cell.look([3.5, 0.0]);
        let report = cell.sequence.work(&sight, &mut cell.log).unwrap();
        assert_eq!(report.result, PickResult::Missed);
        assert_eq!(*cell.log.phases().last().unwrap(), Phase::Up);
        assert_eq!(cell.sequence.work(&sight, &mut cell.log), None, "the frame is from before the miss");
        // The arm does not wait over the part, where the camera would see it.
        assert_eq!(*cell.sequence.state(), SequenceState::FromHome);
        cell.sequence.go_home(&mut cell.log);
    }
    let sight = cell.look([0.0, 0.0]);
    assert_eq!(cell.sequence.work(&sight, &mut cell.log), None);
    assert_eq!(cell.log.passed_over[0].reason.to_string(), "it was missed, or not reached, 3 times");
    assert_eq!(*cell.sequence.state(), SequenceState::Ready);
}

#[test]
fn a_frame_from_before_the_last_place_or_older_than_the_limit_moves_nothing() {
    let parts = vec![block("a", 420.0, 0.0, 0.0), block("b", 480.0, 100.0, 0.0)];
    let mut cell = Cell::new(parts, vec![slot("a", 200.0), slot("b", 260.0)]);
    let before = cell.look([0.0; 2]);
    cell.clock.sleep(Duration::from_millis(1));
    cell.sequence.go_home(&mut cell.log);
    assert_eq!(cell.sequence.work(&before, &mut cell.log), None);
    let sight = cell.look([0.0; 2]);
    cell.sequence.work(&sight, &mut cell.log).unwrap();
    let begun = cell.panel.motions_begun();
    assert_eq!(cell.sequence.work(&sight, &mut cell.log), None, "it shows the part that was taken");
    let sight = cell.look([0.0; 2]);
    cell.clock.sleep(Duration::from_secs(11));
    let late = cell.sequence.work(&sight, &mut cell.log).unwrap();
    let PickResult::NotReached { reason } = late.result else { panic!("{late:?}") };
    assert_eq!(reason, "target_age_max_ms is 11000 ms; allowed: at most 10000 ms");
    assert_eq!(cell.panel.motions_begun(), begun);
}

#[test]
fn whatever_goes_wrong_in_whatever_step_is_latched_with_what_the_gripper_may_hold() {
    let part = || "a".to_owned();
    let nothing = || GripperHolds::Nothing;
    let steps = [
        (Phase::Home, nothing()),
        (Phase::Above, nothing()),
        (Phase::Open, nothing()),
        (Phase::Down, nothing()),
        (Phase::Close, GripperHolds::Perhaps(part())),
        (Phase::Up, GripperHolds::Part(part())),
        (Phase::AboveSlot, GripperHolds::Part(part())),
        (Phase::DownSlot, GripperHolds::Part(part())),
        (Phase::Release, GripperHolds::Perhaps(part())),
        (Phase::UpSlot, nothing()),
    ];
    let faults = [
        Fault::EmergencyStop,
        Fault::ServoOff,
        Fault::Alarm(4107),
        Fault::Teach,
        Fault::ExternalHold,
        Fault::Stall,
        Fault::Disconnect,
    ];
    for fault in faults {
        for (phase, holds) in &steps {
            // A gripper that stalls is not part of the simulation.
            if fault == Fault::Stall && matches!(phase, Phase::Open | Phase::Close | Phase::Release) {
                continue;
            }
            let case = format!("{fault:?} at {phase}");
            let mut cell = Cell::new(vec![block("a", 420.0, 0.0, 0.0)], vec![slot("a", 200.0)]);
            // Home is where it starts: go there from elsewhere, so that the way takes its time.
            let elsewhere = samsod_robot::Motion::Joint {
                target: Pose::gripper_down(420.0, 200.0, 200.0, 0.5),
                speed_fraction: 1.0,
            };
            let (controller, clock) = (cell.sequence.controller(), &cell.clock);
            controller.start_motion(CommandId(0), &elsewhere).unwrap();
            clock.sleep(Duration::from_secs(10));
            controller.poll(CommandId(0)).unwrap();
            cell.log.inject = Some((*phase, cell.panel.clone(), fault));
            cell.run();
            let SequenceState::Faulted(told) = cell.sequence.state().clone() else {
                panic!("{case}: {:?}", cell.sequence.state())
            };
            assert_eq!((told.phase, &told.holds), (Some(*phase), holds), "{case}: {told}");
            assert_eq!(cell.log.faults, [told], "{case}");
            let (begun, given) = (cell.panel.motions_begun(), cell.log.commands.len());

            // Nothing moves by itself, whatever is put right and whatever is seen.
            cell.panel.restore();
            cell.clock.sleep(Duration::from_secs(60));
            let sight = cell.look([0.0; 2]);
            cell.sequence.watch(&mut cell.log);
            cell.sequence.go_home(&mut cell.log);
            assert_eq!(cell.sequence.work(&sight, &mut cell.log), None);
            assert_eq!((cell.panel.motions_begun(), cell.log.commands.len()), (begun, given), "{case}");

            if *holds != GripperHolds::Nothing {
                let refused = cell.sequence.resume(false).unwrap_err();
                assert_eq!(refused, SequenceResumeError::GripperNotEmpty(holds.clone()), "{case}");
            }
            let read_back = cell.sequence.resume(true).unwrap_or_else(|e| panic!("{case}: {e}"));
            assert_eq!(read_back, cell.panel.position(), "{case}");
            assert_eq!(cell.panel.motions_begun(), begun, "{case}: resume moves nothing");
            cell.sequence.go_home(&mut cell.log);
            // A part that lies in its slot lies there.
            let goes_on = if *phase == Phase::UpSlot { SequenceState::Complete } else { SequenceState::Ready };
            assert_eq!(*cell.sequence.state(), goes_on, "{case}: {:?}", cell.log.faults.last());
            let begins = cell.log.commands[given..].iter().map(|(_, phase, _)| *phase).collect::<Vec<_>>();
            assert!(begins == [Phase::Home] || begins == [Phase::Lift, Phase::Home], "{case}: {begins:?}");
        }
    }
}

#[test]
fn a_command_that_cannot_be_recorded_is_not_given() {
    let mut cell = Cell::new(vec![block("a", 420.0, 0.0, 0.0)], vec![slot("a", 200.0)]);
    cell.log.refuse_at = Some(Phase::Down);
    cell.run();
    let SequenceState::Faulted(fault) = cell.sequence.state() else { panic!() };
    assert!(fault.reason.contains("could not be recorded, so it was not given: the disk is full"), "{fault}");
    assert_eq!(cell.panel.motions_begun(), 2, "home and above");
}

#[test]
fn a_connection_that_breaks_before_a_command_is_made_anew_and_the_command_given_once_more_under_a_new_id() {
    let mut cell = Cell::new(vec![block("a", 420.0, 0.0, 0.0)], vec![slot("a", 200.0)]);
    cell.sequence.go_home(&mut cell.log);
    cell.panel.inject(Fault::LoseNextCommand);
    let sight = cell.look([0.0; 2]);
    assert_eq!(cell.sequence.work(&sight, &mut cell.log).unwrap().result, PickResult::Placed);
    assert_eq!(cell.log.phases()[1..4], [Phase::Above, Phase::Above, Phase::Open]);
    assert_eq!(cell.panel.motions_begun(), 7, "home and the six motions of a pick");
    // An answer that got lost is another matter.
    let mut cell = Cell::new(vec![block("a", 420.0, 0.0, 0.0)], vec![slot("a", 200.0)]);
    cell.sequence.go_home(&mut cell.log);
    cell.panel.inject(Fault::LoseNextAnswer);
    let sight = cell.look([0.0; 2]);
    assert_eq!(cell.sequence.work(&sight, &mut cell.log), None);
    assert!(cell.log.faults[0].reason.contains("unknown"), "{}", cell.log.faults[0]);
    assert_eq!(cell.panel.motions_begun(), 2);
}

#[test]
fn a_connection_that_is_broken_between_two_commands_is_made_anew_and_nothing_is_given_twice() {
    let mut cell = Cell::new(vec![block("a", 420.0, 0.0, 0.0)], vec![slot("a", 200.0)]);
    cell.panel.inject(Fault::Disconnect);
    cell.sequence.go_home(&mut cell.log);
    assert_eq!(*cell.sequence.state(), SequenceState::Ready, "{:?}", cell.log.faults);
    assert_eq!((cell.log.phases(), cell.panel.motions_begun()), (vec![Phase::Home], 1));
}

#[test]
fn a_robot_that_stands_is_watched_and_an_operators_hold_needs_a_resume() {
    let mut cell = Cell::new(vec![block("a", 420.0, 0.0, 0.0)], vec![slot("a", 200.0)]);
    cell.sequence.go_home(&mut cell.log);
    cell.panel.inject(Fault::ExternalHold);
    cell.sequence.watch(&mut cell.log);
    let sight = cell.look([0.0; 2]);
    assert_eq!(cell.sequence.work(&sight, &mut cell.log), None);
    assert!(cell.sequence.waits_for().is_some());
    assert_eq!(*cell.sequence.state(), SequenceState::Ready, "a hold at rest has stopped nothing");
    cell.panel.restore();
    cell.panel.inject(Fault::EmergencyStop);
    cell.sequence.watch(&mut cell.log);
    assert!(matches!(cell.sequence.state(), SequenceState::Faulted(_)));
    cell.panel.restore();
    cell.sequence.resume(false).unwrap();
    cell.sequence.hold(HoldReason::VisionPanic, &mut cell.log).unwrap();
    // Whoever comes later does not take the place of the first.
    cell.sequence.hold(HoldReason::Operator, &mut cell.log).unwrap();
    let SequenceState::Faulted(fault) = cell.sequence.state() else { panic!() };
    assert_eq!(fault.to_string(), "hold after a panic of the vision chain; the gripper is empty");
    assert_eq!(fault.held_by, Some(HoldReason::VisionPanic));
    cell.sequence.resume(false).unwrap();
    cell.sequence.hold(HoldReason::Operator, &mut cell.log).unwrap();
    let SequenceState::Faulted(fault) = cell.sequence.state() else { panic!() };
    assert_eq!(fault.to_string(), "hold by an operator; the gripper is empty");
    cell.sequence.resume(false).unwrap();
    cell.run();
    assert_eq!(*cell.sequence.state(), SequenceState::Complete);
}

#[test]
fn a_fault_after_the_last_part_leaves_a_full_jig_that_can_be_replaced() {
    let mut cell = Cell::new(vec![block("a", 420.0, 0.0, 0.0)], vec![slot("a", 200.0)]);
    cell.log.inject = Some((Phase::UpSlot, cell.panel.clone(), Fault::EmergencyStop));
    cell.run();
    assert!(matches!(cell.sequence.state(), SequenceState::Faulted(_)));
    assert!(!cell.sequence.new_jig());
    cell.panel.restore();
    cell.sequence.resume(false).unwrap();
    cell.sequence.go_home(&mut cell.log);
    assert_eq!(*cell.sequence.state(), SequenceState::Complete);
    assert!(cell.sequence.new_jig());
    assert_eq!(cell.sequence.filled().filter(|filled| *filled).count(), 0);
}

#[test]
fn a_robot_that_somebody_has_moved_goes_home_before_it_picks() {
    let mut cell = Cell::new(vec![block("a", 420.0, 0.0, 0.0)], vec![slot("a", 200.0)]);
    cell.sequence.go_home(&mut cell.log);
    let low = samsod_robot::Motion::Joint { target: Pose::gripper_down(420.0, 150.0, 20.0, 0.0), speed_fraction: 1.0 };
    // Beside the sequence: its own commands count on from there.
    cell.sequence.controller().start_motion(CommandId(2), &low).unwrap();
    cell.clock.sleep(Duration::from_secs(10));
    cell.sequence.watch(&mut cell.log);
    assert_eq!(*cell.sequence.state(), SequenceState::FromHome);
    let sight = cell.look([0.0; 2]);
    assert_eq!(cell.sequence.work(&sight, &mut cell.log), None);
}

#[test]
fn what_a_limit_forbids_at_the_slot_is_not_gripped() {
    let mut cell = Cell::new(vec![block("a", 420.0, 0.0, 0.0)], vec![JigSlot { z_mm: -14.9, ..slot("a", 200.0) }]);
    cell.sequence.go_home(&mut cell.log);
    let sight = cell.look([0.0; 2]);
    assert_eq!(cell.sequence.work(&sight, &mut cell.log), None);
    let reason = cell.log.passed_over[0].reason.to_string();
    assert!(reason.contains("at the jig slot: min_height_mm"), "{reason}");
    assert_eq!(cell.panel.motions_begun(), 1, "home only");
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, failure_persistence: None, ..ProptestConfig::default() })]

    /// However the parts lie, crowded as they may be: what is picked is held, nothing is met, and what is not placed has a reason.
    #[test]
    fn no_table_makes_it_miss_or_collide(
        places in proptest::collection::vec((330.0..560.0f64, -180.0..120.0f64, -180.0..180.0f64, 12.0..45.0f64, 5.0..50.0f64), 1..9),
    ) {
        let mut parts: Vec<TablePart> = Vec::new();
        for (x, y, yaw, width, height) in places {
            let mut part = block(&format!("p{}", parts.len()), x, y, yaw);
            part.outline_mm = Convex::rectangle([0.0, 0.0], [width * 1.5, width], 0.0);
            (part.grasp_width_mm, part.height_mm) = (width, height);
            if parts.iter().all(|other| other.outline().gap_mm(&part.outline()) > 1.0) {
                parts.push(part);
            }
        }
        let order = parts.iter().enumerate().map(|(i, part)| {
            JigSlot { part: part.name.clone(), x_mm: 230.0 + 90.0 * (i % 4) as f64, y_mm: 220.0 + 90.0 * (i / 4) as f64, z_mm: 0.0, yaw_rad: 0.0 }
        }).collect::<Vec<_>>();
        let count = parts.len();
        let mut cell = Cell::new(parts, order);
        cell.run();
        prop_assert_eq!(&cell.log.faults, &[]);
        prop_assert_eq!(&cell.table.state().collisions, &[]);
        prop_assert!(cell.table.state().picks.iter().all(|pick| pick.held && pick.error_mm < 0.3));
        let placed = cell.sequence.filled().filter(|filled| *filled).count();
        prop_assert_eq!(placed, cell.table.state().parts.iter().filter(|p| p.whereabouts == Whereabouts::Jig).count());
        if placed < count {
            prop_assert_eq!(cell.log.passed_over.len(), count - placed);
        } else {
            prop_assert_eq!(cell.sequence.state(), &SequenceState::Complete);
        }
    }
}
