//! A Motoman controller before an emulated one that has random faults at random commands.
//!
//! Each run drives a pick and place, and then asks the emulator's journal what came in. Whatever happened on the way:
//! no command came in twice, none after an outcome that was unknown until an operator resumed, none was executed that was
//! said not to be, none was said to be done that was not executed, and the cell can be brought back to work.
//!
//! 1,000 runs are made; `SAMSOD_FAULT_RUNS=10000` makes more, `SAMSOD_FAULT_SEED=17` the one of that seed.

// A test says what went wrong best by stopping there.
#![allow(clippy::unwrap_used, clippy::panic)]

mod random_faults;

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use random_faults::{Dice, TIMEOUT_MS, random_script};
use samsod_robot::emulator::{CommandResult, EmptyTable, Emulator, EmulatorConfig, FaultScript, JournalEntry};
use samsod_robot::motoman::{GripperConfig, Mode};
use samsod_robot::{
    CommandId, ConnectError, Controller, FollowOptions, GripperCommand, GripperError, HoldError, ManualClock, Motion,
    MotionError, Motoman, MotomanConfig, NoWireLog, Outcome, PollError, Pose, PositionError, Progress, ResumeError,
    Status, StatusError, follow,
};

/// A command as it was given to the controller, and what was last known of it.
#[derive(Debug, Clone)]
struct Given {
    what: What,
    outcome: Outcome,
}

#[derive(Debug, Clone, PartialEq)]
enum What {
    Motion(Pose),
    Gripper(GripperCommand),
}

/// A controller that writes down what it is told and what it says, and sees when it takes what it must not.
struct Witness {
    inner: Motoman,
    /// The robot itself, to see whether it is where it is said to be.
    emulator: Arc<Emulator>,
    given: BTreeMap<CommandId, Given>,
    /// An outcome is unknown, or a fault was latched, and nobody has resumed.
    unresumed: bool,
    violations: Vec<String>,
}

impl Witness {
    fn started(&mut self, id: CommandId, what: What, outcome: Outcome) {
        if outcome == Outcome::Accepted && self.unresumed {
            self.violations.push(format!("{id} was taken before an operator resumed"));
        }
        self.unresumed |= matches!(outcome, Outcome::Unknown { .. });
        let given = Given { what, outcome };
        if let Some(before) = self.given.insert(id, given) {
            self.violations.push(format!("{id} was given twice, first as {before:?}"));
        }
    }
}

impl Controller for Witness {
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

    fn start_motion(&mut self, id: CommandId, motion: &Motion) -> Result<(), MotionError> {
        let result = self.inner.start_motion(id, motion);
        let outcome = result.as_ref().err().map_or(Outcome::Accepted, MotionError::outcome);
        self.started(id, What::Motion(*motion.target()), outcome);
        result
    }

    fn start_gripper(&mut self, id: CommandId, command: GripperCommand) -> Result<(), GripperError> {
        let result = self.inner.start_gripper(id, command);
        let outcome = result.as_ref().err().map_or(Outcome::Accepted, GripperError::outcome);
        self.started(id, What::Gripper(command), outcome);
        result
    }

    fn poll(&mut self, id: CommandId) -> Result<Progress, PollError> {
        let progress = self.inner.poll(id)?;
        if let Some(given) = self.given.get_mut(&id) {
            if given.outcome.is_final() && given.outcome != progress.outcome {
                self.violations.push(format!("{id} was {} and now is {}", given.outcome, progress.outcome));
            }
            given.outcome = progress.outcome.clone();
            if let (Outcome::Done, What::Motion(target)) = (&given.outcome, &given.what)
                && self.emulator.position().distance_mm(target) > 0.51
            {
                let at = self.emulator.position();
                self.violations.push(format!("{id} is said to be done, but the robot is at {at} and not at {target}"));
            }
        }
        self.unresumed |= matches!(progress.outcome, Outcome::Unknown { .. });
        Ok(progress)
    }

    fn hold(&mut self, on: bool) -> Result<(), HoldError> {
        self.inner.hold(on)
    }

    fn latch(&mut self, reason: &str) {
        self.unresumed = true;
        self.inner.latch(reason);
    }

    fn resume(&mut self) -> Result<Pose, ResumeError> {
        let position = self.inner.resume()?;
        self.unresumed = false;
        Ok(position)
    }
}

/// A cell with faults: what a driver gets.
struct Cell {
    robot: Witness,
    clock: ManualClock,
}

impl Cell {
    /// Beyond every id that was given, by whomever.
    fn next_id(&self) -> CommandId {
        CommandId(self.robot.given.keys().next_back().map_or(1, |last| last.0 + 1))
    }

    /// One command to its end. What was not executed is given again under a new id, after reconnecting.
    fn command(&mut self, step: &Step) -> Outcome {
        let mut outcome = Outcome::Accepted;
        for _ in 0..3 {
            let id = self.next_id();
            let options = FollowOptions {
                interval: Duration::from_millis(100),
                deadline: Duration::from_secs(8),
                ..FollowOptions::default()
            };
            let started = match step {
                // A target of its own for every id, by which the journal tells them apart.
                Step::Move(motion) => self.robot.start_motion(id, &tagged(motion, id)).map_err(|e| e.outcome()),
                Step::Gripper(command) => self.robot.start_gripper(id, *command).map_err(|e| e.outcome()),
            };
            outcome = match started {
                Ok(()) => follow(&mut self.robot, &self.clock, id, &options, |_| ()),
                Err(outcome) => outcome,
            };
            if !matches!(outcome, Outcome::NotExecuted { .. }) {
                break;
            }
            // It may fail; then the next attempt says so.
            let _ = self.robot.connect();
        }
        outcome
    }
}

fn tagged(motion: &Motion, id: CommandId) -> Motion {
    let mut motion = *motion;
    let (Motion::Joint { target, .. } | Motion::Linear { target, .. }) = &mut motion;
    target.x_mm += id.0 as f64 * 0.01;
    motion
}

enum Step {
    Move(Motion),
    Gripper(GripperCommand),
}

fn pick_and_place(cell: &mut Cell) -> Outcome {
    let pose = |x_mm, y_mm, z_mm| Pose::gripper_down(x_mm, y_mm, z_mm, 0.5);
    let joint = |target| Step::Move(Motion::Joint { target, speed_fraction: 0.4 });
    let linear = |target| Step::Move(Motion::Linear { target, speed_mm_s: 150.0 });
    let steps = [
        Step::Gripper(GripperCommand::Open),
        joint(pose(420.0, -80.0, 180.0)),
        linear(pose(420.0, -80.0, 110.0)),
        Step::Gripper(GripperCommand::Close),
        linear(pose(420.0, -80.0, 180.0)),
        joint(pose(400.0, 120.0, 180.0)),
        linear(pose(400.0, 120.0, 120.0)),
        Step::Gripper(GripperCommand::Open),
        linear(pose(400.0, 120.0, 180.0)),
    ];
    for step in &steps {
        let outcome = cell.command(step);
        if outcome != Outcome::Done {
            return outcome;
        }
    }
    Outcome::Done
}

/// One run with the faults of `seed`; says how `drive` ended, or what must not have been.
fn run(seed: u64, drive: impl FnOnce(&mut Cell) -> Outcome) -> Result<Outcome, String> {
    let mut dice = Dice(seed);
    let script = random_script(&mut dice);
    let clock = ManualClock::new();
    let emulated = EmulatorConfig {
        script: script.clone(),
        lone_cr: dice.below(4) == 0,
        coalesce: dice.below(4) == 0,
        ..EmulatorConfig::default()
    };
    let jobs = dice.below(3) == 0;
    let gripper = if jobs {
        let (open_job, close_job) = (emulated.gripper_open_job.clone(), emulated.gripper_close_job.clone());
        GripperConfig::Jobs { open_job, close_job }
    } else {
        MotomanConfig::default().gripper
    };
    let config = MotomanConfig {
        mode: if jobs { Mode::Job } else { Mode::Direct },
        job: Some(emulated.move_job.clone()),
        gripper,
        emergency_stop: (dice.below(2) == 0).then_some(emulated.emergency_stop),
        part_sensor: (dice.below(2) == 0).then_some(emulated.part_sensor),
        keep_alive: dice.one_of(&[-1, -1, 5, 40]),
        greeting_timeout_ms: TIMEOUT_MS,
        header_timeout_ms: TIMEOUT_MS,
        answer_timeout_ms: TIMEOUT_MS,
        ..MotomanConfig::default()
    };
    let emulator = Emulator::start(emulated, clock.clone(), Box::new(EmptyTable)).map_err(|e| e.to_string())?;
    let emulator = Arc::new(emulator);
    let config = MotomanConfig { address: emulator.address().to_string(), ..config };
    let inner = Motoman::new(config, clock.clone(), Box::new(NoWireLog)).map_err(|e| e.to_string())?;
    let witnessed = Arc::clone(&emulator);
    let robot =
        Witness { inner, emulator: witnessed, given: BTreeMap::new(), unresumed: false, violations: Vec::new() };
    let mut cell = Cell { robot, clock };
    // If that takes too long the first command fails, and is given again.
    let _ = cell.robot.connect();

    let end = drive(&mut cell);
    if !end.is_final() {
        cell.robot.violations.push(format!("the drive ended {end}"));
    }
    without_an_operator_nothing_moves(&mut cell);
    if let Err(stuck) = recover(&mut cell, &emulator) {
        cell.robot.violations.push(stuck);
    }
    let Cell { robot: Witness { inner, emulator: witnessed, given, mut violations, .. }, .. } = cell;
    drop(witnessed);
    // Closes the connection, and leaves the emulator to us alone.
    drop(inner);
    let journal = Arc::into_inner(emulator).map(Emulator::stop).ok_or("somebody still holds the emulator")?;
    check_journal(&journal, &given, &mut violations);
    if violations.is_empty() {
        return Ok(end);
    }
    Err(format!("seed {seed}: {violations:#?}\n{script:#?}"))
}

/// Tries to move after what is unknown; that it is not taken is seen by the witness.
fn without_an_operator_nothing_moves(cell: &mut Cell) {
    if !cell.robot.unresumed {
        return;
    }
    for _ in 0..3 {
        cell.clock.advance(Duration::from_secs(6));
        let _ = cell.robot.connect();
        let id = cell.next_id();
        let target = Pose::gripper_down(430.0 + id.0 as f64 * 0.01, 0.0, 300.0, 0.0);
        let _ = cell.robot.start_motion(id, &Motion::Linear { target, speed_mm_s: 100.0 });
        let id = cell.next_id();
        let _ = cell.robot.start_gripper(id, GripperCommand::Open);
    }
}

/// An operator puts everything right, resumes, and sends the robot home.
fn recover(cell: &mut Cell, emulator: &Emulator) -> Result<(), String> {
    emulator.set_script(FaultScript::default()).map_err(|e| e.to_string())?;
    let mut last = String::new();
    // Several times: a busy machine may miss a deadline.
    for _ in 0..20 {
        emulator.restore();
        // Motions that are still being made end, and so do waits before connecting.
        cell.clock.advance(Duration::from_secs(20));
        if cell.robot.status().is_err()
            && let Err(error) = cell.robot.connect()
        {
            last = format!("connect: {error}");
            continue;
        }
        if let Err(error) = cell.robot.hold(false) {
            last = format!("hold off: {error}");
            continue;
        }
        if let Err(error) = cell.robot.resume() {
            last = format!("resume: {error}");
            continue;
        }
        let home = Pose::gripper_down(400.0, 0.0, 400.0, 0.0);
        let end = cell.command(&Step::Move(Motion::Joint { target: home, speed_fraction: 1.0 }));
        if end == Outcome::Done {
            return Ok(());
        }
        last = format!("home: {end}");
    }
    Err(format!("the cell could not be brought back to work: {last}"))
}

/// Holds what came in against what was given, in order.
fn check_journal(journal: &[JournalEntry], given: &BTreeMap<CommandId, Given>, violations: &mut Vec<String>) {
    let acting = ["MOVL", "MOVJ", "IMOV", "PMOVJ", "START", "IOWRITE"];
    let ours = || journal.iter().filter(|entry| !entry.second_client);
    let headers = ours().filter(|entry| acting.contains(&&*entry.command)).count();
    if headers > given.len() {
        violations.push(format!("{headers} commands came in, {} were given", given.len()));
    }
    let mut target = String::new();
    let mut left = given.iter();
    let mut executed = BTreeMap::new();
    for entry in ours() {
        let data = entry.data.as_deref().unwrap_or_default();
        if entry.command == "LOADV" && data.starts_with("4,") {
            target = data.to_string();
        }
        // Without its data nothing of a command can be executed.
        if !acting.contains(&&*entry.command) || entry.result == CommandResult::HeaderOnly {
            continue;
        }
        let place = if entry.command == "START" { &*target } else { data };
        let is_this = |given: &Given| match (&*entry.command, &given.what) {
            ("MOVL" | "MOVJ", What::Motion(pose)) => place.contains(&in_millimetres(pose)),
            ("START", What::Motion(pose)) => data == "SAMSOD-MOVE" && place.contains(&in_millimetres(pose)),
            ("START", What::Gripper(GripperCommand::Open)) => data == "GRIP-OPEN",
            ("START", What::Gripper(GripperCommand::Close)) => data == "GRIP-CLOSE",
            ("IOWRITE", What::Gripper(GripperCommand::Open)) => data == "27010,8,1",
            ("IOWRITE", What::Gripper(GripperCommand::Close)) => data == "27010,8,2",
            _ => false,
        };
        // Grippers look alike: one that was said not to be executed is passed over for the next that looks the same.
        let was_executed = matches!(entry.result, CommandResult::Executed { .. });
        let fits = |(_, given): &(&CommandId, &Given)| {
            is_this(given) && !(was_executed && matches!(given.outcome, Outcome::NotExecuted { .. }))
        };
        match left.find(fits) {
            Some((id, _)) => {
                executed.insert(*id, was_executed);
            }
            None => violations.push(format!("came in although it was not given, or not then: {entry:?}")),
        }
    }
    for (id, given) in given {
        if given.outcome == Outcome::Done && executed.get(id) != Some(&true) {
            violations.push(format!("{id} is said to be done, and was not executed: {given:?}"));
        }
    }
}

fn in_millimetres(pose: &Pose) -> String {
    format!(",{:.3},{:.3},{:.3},", pose.x_mm, pose.y_mm, pose.z_mm)
}

#[test]
fn whatever_goes_wrong_no_command_is_given_twice_or_after_an_unknown_one() {
    let (count, results) = random_faults::runs(1000, |seed| run(seed, pick_and_place));
    let (mut ends, mut failures) = (BTreeMap::<&str, u64>::new(), Vec::new());
    for result in results {
        match result {
            Ok(end) => *ends.entry(kind(&end)).or_default() += 1,
            Err(failure) => failures.push(failure),
        }
    }
    println!("{count} runs: {ends:?}");
    assert!(failures.is_empty(), "{} of the runs failed:\n{}", failures.len(), failures.join("\n"));
    if count >= 1000 {
        // Otherwise the faults would not happen, or nothing else.
        for end in ["done", "not executed", "aborted", "unknown"] {
            assert!(ends.get(end).is_some_and(|count| *count >= 20), "too few runs ended {end}: {ends:?}");
        }
    }
}

fn kind(outcome: &Outcome) -> &'static str {
    match outcome {
        Outcome::NotExecuted { .. } => "not executed",
        Outcome::Accepted => "accepted",
        Outcome::Done => "done",
        Outcome::Aborted { .. } => "aborted",
        Outcome::Unknown { .. } => "unknown",
    }
}

#[test]
fn the_check_sees_a_command_that_came_in_twice_and_one_that_should_not_have() {
    let entry = |number, data: &str, result| JournalEntry {
        number,
        time_ms: 0.0,
        connection: 1,
        second_client: false,
        command: "IOWRITE".into(),
        data: Some(data.into()),
        result,
        faults: Vec::new(),
    };
    let executed = || CommandResult::Executed { answer: "0000".into() };
    let given =
        |outcome| BTreeMap::from([(CommandId(1), Given { what: What::Gripper(GripperCommand::Open), outcome })]);
    let violations = |journal: &[JournalEntry], given| {
        let mut violations = Vec::new();
        check_journal(journal, &given, &mut violations);
        violations
    };
    let once = [entry(0, "27010,8,1", executed())];
    assert_eq!(violations(&once, given(Outcome::Done)), [""; 0]);
    let twice = [entry(0, "27010,8,1", executed()), entry(1, "27010,8,1", executed())];
    assert_eq!(violations(&twice, given(Outcome::Done)).len(), 2);
    assert_eq!(violations(&once, given(Outcome::NotExecuted { reason: String::new() })).len(), 1);
    assert_eq!(violations(&[], given(Outcome::Done)).len(), 1);
    assert_eq!(violations(&[entry(0, "27010,8,2", executed())], given(Outcome::Done)).len(), 2);
}
