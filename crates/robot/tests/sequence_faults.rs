//! The pick-and-place sequence over a Motoman controller over TCP, before an emulated one that has random faults, with parts
//! that its gripper picks and an operator who puts things right.
//!
//! Each run goes on until the jig is full, nothing more can be picked, or it was told to stop. Then three witnesses are held
//! against each other: what the sequence logged, which bytes left ([`WireLog`]), and what came in (the journal of the
//! emulator). Whatever happened on the way:
//!
//! - no command leaves before it was logged, none twice, and none while a fault is latched or an outcome unknown;
//! - the commands of log and journal agree one by one: what is said to be done or begun was executed, what is said not to be
//!   executed was not, and only a command of unknown outcome may be either;
//! - the gripper is never said to be empty while a part is in it;
//! - every call ends in a state that says how it stands, and once all is put right the cell works on to a defined end.
//!
//! 1,000 runs are made; `SAMSOD_FAULT_RUNS=10000` makes more, `SAMSOD_FAULT_SEED=17` the one of that seed.

// A test says what went wrong best by stopping there.
#![allow(clippy::unwrap_used, clippy::panic)]

mod random_faults;

use std::collections::BTreeMap;
use std::f64::consts::FRAC_PI_2;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::Duration;

use random_faults::{Dice, TIMEOUT_MS, random_script};
use samsod_robot::emulator::{
    CommandResult, EmptyTable, Emulator, EmulatorConfig, FaultScript, Incoming, JournalEntry, RequestParser,
};
use samsod_robot::motoman::{GripperConfig, Mode};
use samsod_robot::{
    ArmModel, Clock, Command, CommandId, ConnectError, Controller, Convex, Grasp, GripperCommand, GripperHolds,
    GripperShape, HoldReason, HoldSwitch, JigSlot, Limited, Limits, ManualClock, Motion, Motoman, MotomanConfig,
    NoWireLog, Outcome, PartTable, PassedOver, PickReport, PickResult, PickTolerance, Planner, Purpose, RobotState,
    SeenPart, Sequence, SequenceFault, SequenceLog, SequenceOptions, SequenceState, Sight, TablePart, TableState,
    Whereabouts, WireLog, Workpieces,
};

/// Commands that move arm or gripper.
const ACTING: [&str; 6] = ["MOVL", "MOVJ", "IMOV", "PMOVJ", "START", "IOWRITE"];

/// What was logged, in order, from all sides.
#[derive(Debug, Clone)]
enum Event {
    /// The sequence is about to give a command.
    Command(CommandId, Command),
    /// What became known of it.
    Outcome(CommandId, Outcome),
    /// A fault was latched, by the sequence or by the controller.
    Latched(String),
    /// An operator has resumed.
    Resumed,
    /// A connection was begun.
    Connecting,
    /// A whole command is about to leave, or a header whose data follows.
    Leaving { command: String, data: Option<String> },
    /// Something was answered.
    Answered,
}

type Events = Arc<Mutex<Vec<Event>>>;

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap()
}

/// Takes apart what leaves.
struct Wire {
    events: Events,
    parser: RequestParser,
    /// How many writes are left until one cannot be recorded.
    fails_in: Option<u64>,
}

impl WireLog for Wire {
    fn sending(&mut self, bytes: &[u8]) -> Result<(), String> {
        if let Some(left) = &mut self.fails_in {
            *left = left.wrapping_sub(1);
            if *left == 0 {
                return Err("the disk is full".to_owned());
            }
        }
        self.note(bytes);
        Ok(())
    }

    /// It leaves on a full disk, too.
    fn sending_hold(&mut self, bytes: &[u8]) {
        self.note(bytes);
    }

    fn received(&mut self, _bytes: &[u8]) {
        lock(&self.events).push(Event::Answered);
    }
}

impl Wire {
    fn note(&mut self, bytes: &[u8]) {
        if bytes.starts_with(b"CONNECT") {
            self.parser = RequestParser::new();
        }
        let mut parts = Vec::new();
        self.parser.feed(bytes, &mut parts).unwrap();
        let mut events = lock(&self.events);
        for part in parts {
            match part {
                Incoming::Start { .. } => events.push(Event::Connecting),
                Incoming::Header { command, .. } => events.push(Event::Leaving { command, data: None }),
                Incoming::Data(bytes) => {
                    let text = String::from_utf8(bytes).unwrap().trim_end().to_owned();
                    // One command is in flight: the last header is the one that these data belong to.
                    let header = events.iter().rev().find_map(|event| match event {
                        Event::Leaving { command, data: None } => Some(command.clone()),
                        _ => None,
                    });
                    events.push(Event::Leaving { command: header.unwrap(), data: Some(text) });
                }
            }
        }
    }
}

/// What the sequence tells, and what an operator and a disk do in between.
struct Log {
    events: Events,
    emulator: Arc<Emulator>,
    table: PartTable,
    passed_over: Vec<PassedOver>,
    picks: Vec<PickReport>,
    commands: u64,
    accepted: u64,
    /// An operator asks for hold while this command runs.
    hold_at: u64,
    hold_asked: Arc<AtomicBool>,
    /// The request itself waits for the end of the command, as the daemon has it.
    hold_requested: bool,
    /// This command cannot be recorded.
    refuse_at: u64,
    /// It is told to stop at this command.
    stop_at: u64,
    has_sensor: bool,
    violations: Vec<String>,
}

impl Log {
    /// The name of the part that is in the gripper.
    fn in_gripper(&self) -> Option<String> {
        self.emulator.position();
        let parts = self.table.state().parts;
        parts.into_iter().find(|part| part.whereabouts == Whereabouts::Gripper).map(|part| part.name)
    }

    fn check_holds(&mut self, holds: &GripperHolds, when: &str) {
        let held = self.in_gripper();
        let wrong = match (holds, &held) {
            (GripperHolds::Nothing, Some(_)) => true,
            (GripperHolds::Part(said) | GripperHolds::Perhaps(said), Some(held)) => said != held,
            (_, None) => false,
        };
        if wrong {
            self.violations.push(format!("{when}: {holds}, but {held:?} is in it"));
        }
    }
}

impl SequenceLog for Log {
    fn command(&mut self, id: CommandId, command: &Command, _purpose: &Purpose<'_>) -> Result<(), String> {
        self.commands += 1;
        if self.commands == self.refuse_at {
            return Err("the disk is full".to_owned());
        }
        lock(&self.events).push(Event::Command(id, *command));
        Ok(())
    }

    fn outcome(&mut self, id: CommandId, outcome: &Outcome) {
        lock(&self.events).push(Event::Outcome(id, outcome.clone()));
        if *outcome == Outcome::Accepted {
            self.accepted += 1;
            if self.accepted == self.hold_at {
                self.hold_asked.store(true, Ordering::SeqCst);
                self.hold_requested = true;
            }
        }
    }

    fn state(&mut self, state: &RobotState) {
        if let Some(reason) = &state.status.latched {
            lock(&self.events).push(Event::Latched(reason.clone()));
        }
    }

    fn passed_over(&mut self, _frame: u64, parts: &[PassedOver]) {
        self.passed_over = parts.to_vec();
    }

    fn picked(&mut self, report: &PickReport) {
        self.picks.push(report.clone());
        if let Some(held) = self.in_gripper() {
            self.violations.push(format!("{held} is in the gripper after {report:?}"));
        }
        let parts = self.table.state().parts;
        let part = parts.iter().find(|part| part.name == report.part).unwrap();
        if report.result == PickResult::Placed && self.has_sensor && part.whereabouts == Whereabouts::Table {
            self.violations.push(format!("it still lies on the table: {report:?}"));
        }
    }

    fn fault(&mut self, fault: &SequenceFault) {
        lock(&self.events).push(Event::Latched(fault.reason.clone()));
        self.check_holds(&fault.holds, &format!("at the fault {fault}"));
    }

    fn is_stopping(&self) -> bool {
        self.stop_at != 0 && self.commands >= self.stop_at
    }
}

type Robot = HoldSwitch<Limited<Motoman, ManualClock>>;

struct Cell {
    sequence: Sequence<Robot, ManualClock>,
    clock: ManualClock,
    log: Log,
    frame: u64,
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
        symmetry_order: 2,
        outline_mm: Convex::rectangle([0.0, 0.0], [40.0, 20.0], 0.0),
    }
}

fn gripper() -> GripperShape {
    GripperShape { opening_mm: 50.0, finger_thickness_mm: 5.0, finger_width_mm: 10.0, ..GripperShape::default() }
}

fn sequence_options() -> SequenceOptions {
    SequenceOptions {
        home: EmulatorConfig::default().home,
        safe_z_mm: 120.0,
        joint_speed_fraction: 0.5,
        linear_speed_mm_s: 200.0,
        joint_timeout: Duration::from_secs(20),
        gripper_timeout: Duration::from_secs(2),
        poll_interval: Duration::from_millis(250),
    }
}

fn planner() -> Planner {
    let slot = |part: &str, y_mm| JigSlot { part: part.to_owned(), x_mm: 250.0, y_mm, z_mm: 0.0, yaw_rad: FRAC_PI_2 };
    Planner {
        order: vec![slot("a", 200.0), slot("b", 260.0)],
        gripper: gripper(),
        clearance_mm: 2.0,
        safe_height_mm: 120.0,
        score_min: 0.5,
        arm: Some(ArmModel::mh5(100.0)),
        limits: None,
    }
}

impl Cell {
    /// A frame taken now: what lies on table and jig, seen a little off where it is, and sometimes far too much.
    fn look(&mut self, dice: &mut Dice) -> Sight {
        self.frame += 1;
        let off = if dice.below(20) == 0 { 4.0 } else { dice.below(100) as f64 * 0.005 };
        let lying = self.log.table.state().parts.into_iter();
        let lying = lying.filter(|part| matches!(part.whereabouts, Whereabouts::Table | Whereabouts::Jig));
        let parts = lying.map(|part| SeenPart {
            name: Some(part.name),
            score: 0.9,
            at_mm: [part.x_mm + off, part.y_mm],
            yaw_rad: part.yaw_rad,
            z_mm: 0.0,
            height_mm: part.height_mm,
            outline_mm: part.outline_mm,
            grasps: vec![
                Grasp { offset_mm: [0.0; 2], angle_rad: 0.0, width_mm: 20.0 },
                Grasp { offset_mm: [0.0; 2], angle_rad: FRAC_PI_2, width_mm: 40.0 },
            ],
            symmetry_order: part.symmetry_order,
        });
        Sight { frame: self.frame, taken_at: self.clock.now(), parts: parts.collect() }
    }

    /// Goes on until the jig is full, nothing can be picked, or it was told to stop.
    fn drive(&mut self, dice: &mut Dice) -> Result<(), String> {
        // Frames in a row from which nothing could be picked.
        let mut idle = 0;
        for _ in 0..400 {
            if std::mem::take(&mut self.log.hold_requested) {
                // One that does not get through is latched all the same.
                let _ = self.sequence.hold(HoldReason::Operator, &mut self.log);
            }
            match self.sequence.state().clone() {
                SequenceState::FromHome => {
                    self.sequence.go_home(&mut self.log);
                    if *self.sequence.state() == SequenceState::FromHome {
                        return Err("it neither went home nor said why not".to_owned());
                    }
                }
                SequenceState::Ready => {
                    self.sequence.watch(&mut self.log);
                    if self.sequence.waits_for().is_some() {
                        // Somebody holds the robot, or moves it: that ends.
                        self.log.emulator.restore();
                        self.clock.advance(Duration::from_secs(2));
                        continue;
                    }
                    self.clock.advance(Duration::from_millis(40));
                    let sight = self.look(dice);
                    self.clock.advance(Duration::from_millis(60));
                    match self.sequence.work(&sight, &mut self.log) {
                        Some(_) => idle = 0,
                        None if *self.sequence.state() == SequenceState::Ready => idle += 1,
                        None => {}
                    }
                    if idle == 3 {
                        return Ok(());
                    }
                }
                SequenceState::Complete => {
                    self.sequence.go_home(&mut self.log);
                    if !matches!(self.sequence.state(), SequenceState::Faulted(_)) {
                        return Ok(());
                    }
                    // The jig is full all the same, but the robot does not stand at home.
                }
                SequenceState::Stopped { .. } => return Ok(()),
                SequenceState::Faulted(fault) => {
                    self.nothing_moves_by_itself(dice);
                    self.operator_resumes(&fault)?;
                }
            }
        }
        Err(format!("no end, it is {:?}; {:?}", self.sequence.state(), self.log.passed_over))
    }

    fn nothing_moves_by_itself(&mut self, dice: &mut Dice) {
        let (state, given) = (self.sequence.state().clone(), self.log.commands);
        for _ in 0..3 {
            self.clock.advance(Duration::from_secs(3));
            self.sequence.watch(&mut self.log);
            self.sequence.go_home(&mut self.log);
            let sight = self.look(dice);
            let worked = self.sequence.work(&sight, &mut self.log);
            if worked.is_some() || self.sequence.new_jig() || *self.sequence.state() != state {
                self.log.violations.push(format!("it left {state:?} by itself: {:?}", self.sequence.state()));
            }
        }
        if self.log.commands != given {
            self.log.violations.push(format!("commands were given in {state:?}"));
        }
    }

    /// Puts everything right at the robot, takes out what is in the gripper, and resumes.
    fn operator_resumes(&mut self, fault: &SequenceFault) -> Result<(), String> {
        let mut last = String::new();
        // Several times: a fault may come in between, and a busy machine may miss a deadline.
        for _ in 0..20 {
            // What the controller still works on is waited for: it may execute a command whose host has given up.
            while !self.log.emulator.is_idle() {
                std::thread::yield_now();
            }
            self.log.emulator.restore();
            // Motions that are still being made end.
            self.clock.advance(Duration::from_secs(20));
            self.log.check_holds(&fault.holds, &format!("before the resume of {fault}"));
            let is_refused = self.sequence.resume(false).is_err();
            if fault.holds != GripperHolds::Nothing {
                if !is_refused {
                    return Err(format!("it resumed although {}", fault.holds));
                }
                if self.log.in_gripper().is_some() {
                    let tool = self.log.emulator.position();
                    self.log.table.open(&tool);
                }
            }
            let resumed = if is_refused { self.sequence.resume(true).map(|_| ()) } else { Ok(()) };
            match resumed {
                Ok(()) => {
                    lock(&self.log.events).push(Event::Resumed);
                    return Ok(());
                }
                Err(error) => last = error.to_string(),
            }
        }
        Err(format!("{fault}: it does not resume: {last}"))
    }
}

/// How a run ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum End {
    Complete,
    /// Nothing more can be picked: what is left has a reason.
    Exhausted,
    Stopped,
}

#[derive(Debug)]
struct Run {
    end: End,
    faults: usize,
    outcomes: BTreeMap<&'static str, u64>,
}

/// One run with the faults of `seed`; says how it ended, or what must not have been.
fn run(seed: u64) -> Result<Run, String> {
    let mut dice = Dice(seed ^ 0x5eed_0000_0000);
    let script = random_script(&mut dice);
    let clock = ManualClock::new();
    let parts = vec![block("a", 420.0, 100.0, 20.0), block("b", 480.0, -60.0, -70.0)];
    let table = PartTable::new(TableState::new(parts), gripper(), PickTolerance::default());
    let emulated = EmulatorConfig {
        script: script.clone(),
        lone_cr: dice.below(4) == 0,
        coalesce: dice.below(4) == 0,
        ..EmulatorConfig::default()
    };
    let jobs = dice.below(3) == 0;
    let gripper_by = if jobs {
        let (open_job, close_job) = (emulated.gripper_open_job.clone(), emulated.gripper_close_job.clone());
        GripperConfig::Jobs { open_job, close_job }
    } else {
        MotomanConfig::default().gripper
    };
    let has_sensor = dice.below(3) != 0;
    let config = MotomanConfig {
        mode: if jobs { Mode::Job } else { Mode::Direct },
        job: Some(emulated.move_job.clone()),
        gripper: gripper_by,
        emergency_stop: (dice.below(2) == 0).then_some(emulated.emergency_stop),
        part_sensor: has_sensor.then_some(emulated.part_sensor),
        keep_alive: dice.one_of(&[-1, -1, 5, 40]),
        greeting_timeout_ms: TIMEOUT_MS,
        header_timeout_ms: TIMEOUT_MS,
        answer_timeout_ms: TIMEOUT_MS,
        ..MotomanConfig::default()
    };
    let emulator = Emulator::start(emulated, clock.clone(), Box::new(table.clone())).map_err(|e| e.to_string())?;
    let emulator = Arc::new(emulator);
    let config = MotomanConfig { address: emulator.address().to_string(), ..config };
    let events = Events::default();
    let sometimes = |dice: &mut Dice, one_in, most| if dice.below(one_in) == 0 { 1 + dice.below(most) } else { 0 };
    let fails_in = sometimes(&mut dice, 10, 400);
    let wire = Wire {
        events: Arc::clone(&events),
        parser: RequestParser::new(),
        fails_in: (fails_in > 0).then_some(fails_in),
    };
    let motoman = Motoman::new(config, clock.clone(), Box::new(wire)).map_err(|e| e.to_string())?;
    let hold_asked = Arc::new(AtomicBool::new(false));
    let limited = Limited::new(motoman, clock.clone(), Limits::default());
    let robot = HoldSwitch::new(limited, Arc::clone(&hold_asked));
    let log = Log {
        events: Arc::clone(&events),
        emulator: Arc::clone(&emulator),
        table,
        passed_over: Vec::new(),
        picks: Vec::new(),
        commands: 0,
        accepted: 0,
        hold_at: sometimes(&mut dice, 5, 20),
        hold_asked,
        hold_requested: false,
        refuse_at: sometimes(&mut dice, 15, 20),
        stop_at: sometimes(&mut dice, 15, 20),
        has_sensor,
        violations: Vec::new(),
    };
    let sequence = Sequence::new(robot, clock.clone(), sequence_options(), planner(), CommandId(0));
    let mut cell = Cell { sequence, clock, log, frame: 0 };
    // As the daemon does: who does not answer is called again by the sequence.
    let _ = cell.sequence.controller().connect();

    let mut driven = cell.drive(&mut dice);
    if driven.is_ok() && !matches!(cell.sequence.state(), SequenceState::Stopped { .. }) {
        // Faults that have not happened yet do so no more: then the cell works to its end.
        emulator.set_script(FaultScript::default()).map_err(|e| e.to_string())?;
        driven = cell.drive(&mut dice);
    }
    if let Err(stuck) = driven {
        cell.log.violations.push(stuck);
    }
    let end = match cell.sequence.state() {
        SequenceState::Complete => End::Complete,
        SequenceState::Ready => End::Exhausted,
        SequenceState::Stopped { .. } => End::Stopped,
        state => {
            cell.log.violations.push(format!("it ended {state:?}"));
            End::Exhausted
        }
    };
    let left = cell.sequence.filled().filter(|filled| !filled).count();
    if end == End::Exhausted && left == 0 {
        cell.log.violations.push("every slot is filled, and it is not complete".to_owned());
    }
    if end == End::Exhausted && cell.log.passed_over.len() != left {
        cell.log.violations.push(format!("{left} slots are empty, reasons are {:?}", cell.log.passed_over));
    }
    let Cell { sequence, log: Log { mut violations, emulator: told, .. }, .. } = cell;
    drop(told);
    // Closes the connection, and leaves the emulator to us alone.
    drop(sequence);
    let journal = Arc::into_inner(emulator).map(Emulator::stop).ok_or("somebody still holds the emulator")?;
    let events = lock(&events).clone();
    let run = check(&events, &journal, &mut violations, end);
    if violations.is_empty() {
        return Ok(run);
    }
    if random_faults::number("SAMSOD_FAULT_SEED").is_some() {
        events.iter().for_each(|event| println!("{event:?}"));
        journal.iter().for_each(|entry| println!("{entry:?}"));
    }
    Err(format!("seed {seed}: {violations:#?}\n{script:#?}"))
}

/// A command of the protocol as it left.
struct Left<'a> {
    command: &'a str,
    data: Option<&'a str>,
    /// The command of the sequence that it carries out, if it acts and is complete.
    carries: Option<CommandId>,
}

/// One connection as it was seen from the host.
#[derive(Default)]
struct Seen<'a> {
    left: Vec<Left<'a>>,
    /// Of these for certain the controller has had the header.
    answered: usize,
}

/// Holds the log, what left, and what came in against each other.
fn check(events: &[Event], journal: &[JournalEntry], violations: &mut Vec<String>, end: End) -> Run {
    let mut given = BTreeMap::<CommandId, (Command, Outcome)>::new();
    let mut left = BTreeMap::<CommandId, u64>::new();
    let mut connections: Vec<Seen<'_>> = Vec::new();
    let mut unresumed: Option<String> = None;
    let (mut faults, mut target) = (0, String::new());
    for event in events {
        match event {
            Event::Command(id, command) => {
                if given.insert(*id, (*command, Outcome::Accepted)).is_some() {
                    violations.push(format!("{id} was logged twice"));
                }
            }
            Event::Outcome(id, outcome) => {
                match given.get_mut(id) {
                    Some((_, known)) if !known.is_final() => *known = outcome.clone(),
                    known => violations.push(format!("{id} is {outcome}, and was {known:?}")),
                }
                if let Outcome::Unknown { .. } | Outcome::Aborted { .. } = outcome {
                    unresumed = Some(format!("{id} {outcome}"));
                }
            }
            Event::Latched(reason) => {
                faults += usize::from(unresumed.is_none());
                unresumed.get_or_insert_with(|| reason.clone());
            }
            Event::Resumed => unresumed = None,
            Event::Connecting => connections.push(Seen::default()),
            Event::Answered => {
                if let Some(connection) = connections.last_mut() {
                    connection.answered = connection.left.len();
                }
            }
            Event::Leaving { command, data: None } => {
                let header = Left { command, data: None, carries: None };
                match connections.last_mut() {
                    Some(connection) => connection.left.push(header),
                    None => violations.push(format!("{command} left without a connection")),
                }
            }
            Event::Leaving { command, data: Some(data) } => {
                let Some(last) = connections.last_mut().and_then(|connection| connection.left.last_mut()) else {
                    continue;
                };
                last.data = Some(data);
                if command == "LOADV" && data.starts_with("4,") {
                    target.clone_from(data);
                }
                if !ACTING.contains(&&**command) {
                    continue;
                }
                let place = if command == "START" { &target } else { data };
                match given.last_key_value() {
                    Some((id, (what, Outcome::Accepted))) if carries_out(command, data, place, what) => {
                        last.carries = Some(*id);
                        *left.entry(*id).or_default() += 1;
                    }
                    logged => violations.push(format!("{command} {data} left; the last that was logged is {logged:?}")),
                }
                if let Some(reason) = &unresumed {
                    violations.push(format!("{command} {data} left before an operator resumed from {reason}"));
                }
            }
        }
    }
    for (id, times) in &left {
        if *times > 1 {
            violations.push(format!("{id} left {times} times"));
        }
    }
    let came_in = align(&connections, journal, violations);
    for (id, (command, outcome)) in &given {
        let fits = match (outcome, came_in.get(id), left.contains_key(id)) {
            (Outcome::Done | Outcome::Aborted { .. }, Some(CommandResult::Executed { .. }), _) => true,
            (Outcome::NotExecuted { .. }, None, false) => true,
            (Outcome::NotExecuted { .. }, Some(CommandResult::Refused { .. }), _) => true,
            // It may have left or, like a motion that nobody could follow to its end, have begun for certain.
            (Outcome::Unknown { .. }, _, true) => true,
            _ => false,
        };
        if !fits {
            violations.push(format!("{id} {command:?} is {outcome}; what came in: {:?}", came_in.get(id)));
        }
    }
    let mut outcomes = BTreeMap::new();
    for (_, outcome) in given.values() {
        *outcomes.entry(kind(outcome)).or_default() += 1;
    }
    Run { end, faults, outcomes }
}

/// Finds for every command that came in the one that left, connection by connection, and gives what came of those that act.
fn align(
    connections: &[Seen<'_>],
    journal: &[JournalEntry],
    violations: &mut Vec<String>,
) -> BTreeMap<CommandId, CommandResult> {
    let mut groups = BTreeMap::<u64, Vec<&JournalEntry>>::new();
    for entry in journal.iter().filter(|entry| !entry.second_client) {
        groups.entry(entry.connection).or_default().push(entry);
    }
    let mut came_in = BTreeMap::new();
    let mut seen = connections.iter();
    for group in groups.values() {
        let begins = |left: &[Left<'_>]| {
            group.len() <= left.len()
                && group.iter().zip(left).all(|(entry, left)| {
                    entry.command == left.command && entry.data.as_deref().is_none_or(|data| Some(data) == left.data)
                })
        };
        // One of which nothing came in has been answered nothing.
        let found = loop {
            match seen.next() {
                Some(connection) if begins(&connection.left) && group.len() >= connection.answered => {
                    break Some(connection);
                }
                Some(connection) if connection.answered == 0 => {}
                _ => break None,
            }
        };
        let Some(connection) = found else {
            violations.push(format!("came in on a connection and did not leave: {group:?}"));
            return came_in;
        };
        for (entry, left) in group.iter().zip(&connection.left) {
            let Some(id) = left.carries else {
                if ACTING.contains(&&*entry.command) && entry.result != CommandResult::HeaderOnly {
                    violations.push(format!("came in although it was not given: {entry:?}"));
                }
                continue;
            };
            if let Some(before) = came_in.insert(id, entry.result.clone()) {
                violations.push(format!("{id} came in twice: {before:?} and {entry:?}"));
            }
        }
    }
    for connection in seen.filter(|connection| connection.answered > 0) {
        violations.push(format!("{} commands were answered that did not come in", connection.answered));
    }
    came_in
}

/// Whether these bytes are this command.
fn carries_out(command: &str, data: &str, place: &str, what: &Command) -> bool {
    let is_place = |motion: &Motion| {
        let target = motion.target();
        place.contains(&format!(",{:.3},{:.3},{:.3},", target.x_mm, target.y_mm, target.z_mm))
    };
    match (command, what) {
        ("MOVL", Command::Move(motion @ Motion::Linear { .. })) => is_place(motion),
        ("MOVJ", Command::Move(motion @ Motion::Joint { .. })) => is_place(motion),
        ("START", Command::Move(motion)) => data == "SAMSOD-MOVE" && is_place(motion),
        ("START", Command::Gripper { gripper: GripperCommand::Open }) => data == "GRIP-OPEN",
        ("START", Command::Gripper { gripper: GripperCommand::Close }) => data == "GRIP-CLOSE",
        ("IOWRITE", Command::Gripper { gripper: GripperCommand::Open }) => data == "27010,8,1",
        ("IOWRITE", Command::Gripper { gripper: GripperCommand::Close }) => data == "27010,8,2",
        _ => false,
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
fn whatever_goes_wrong_the_sequence_gives_nothing_twice_or_unlogged_or_before_a_resume_and_comes_to_an_end() {
    let (count, results) = random_faults::runs(1000, run);
    let (mut ends, mut outcomes) = (BTreeMap::<End, u64>::new(), BTreeMap::<&str, u64>::new());
    let (mut faulted, mut failures) = (0, Vec::new());
    for result in results {
        match result {
            Ok(run) => {
                *ends.entry(run.end).or_default() += 1;
                faulted += u64::from(run.faults > 0);
                for (kind, times) in run.outcomes {
                    *outcomes.entry(kind).or_default() += times;
                }
            }
            Err(failure) => failures.push(failure),
        }
    }
    println!("{count} runs, {faulted} of them with a latched fault, ends: {ends:?}; commands: {outcomes:?}");
    assert!(failures.is_empty(), "{} of the runs failed:\n{}", failures.len(), failures.join("\n"));
    if count >= 1000 {
        // Otherwise the faults would not happen, or nothing else.
        for end in [End::Complete, End::Exhausted, End::Stopped] {
            assert!(ends.get(&end).is_some_and(|count| *count >= 20), "too few runs ended {end:?}: {ends:?}");
        }
        for kind in ["not executed", "aborted", "unknown"] {
            assert!(outcomes.get(kind).is_some_and(|count| *count >= 20), "too few commands were {kind}: {outcomes:?}");
        }
        assert!(faulted * 5 >= count, "too few runs had a fault");
    }
}

/// A log of faults alone.
#[derive(Default)]
struct Faults(Vec<String>);

impl SequenceLog for Faults {
    fn command(&mut self, _id: CommandId, _command: &Command, _purpose: &Purpose<'_>) -> Result<(), String> {
        Ok(())
    }

    fn outcome(&mut self, _id: CommandId, _outcome: &Outcome) {}

    fn state(&mut self, _state: &RobotState) {}

    fn passed_over(&mut self, _frame: u64, _parts: &[PassedOver]) {}

    fn picked(&mut self, _report: &PickReport) {}

    fn fault(&mut self, fault: &SequenceFault) {
        self.0.push(fault.to_string());
    }
}

#[test]
fn waits_before_connecting_are_kept_by_a_robot_that_is_watched_and_by_a_resume() {
    let clock = ManualClock::new();
    let start = |listen: String| {
        let config = EmulatorConfig { listen, ..EmulatorConfig::default() };
        Emulator::start(config, clock.clone(), Box::new(EmptyTable)).unwrap()
    };
    let emulator = start("127.0.0.1:0".to_owned());
    let address = emulator.address().to_string();
    let config = MotomanConfig { address: address.clone(), ..MotomanConfig::default() };
    let mut robot = Motoman::new(config, clock.clone(), Box::new(NoWireLog)).unwrap();
    robot.connect().unwrap();
    let mut sequence = Sequence::new(robot, clock.clone(), sequence_options(), planner(), CommandId(0));
    let mut log = Faults::default();
    sequence.go_home(&mut log);
    assert_eq!(*sequence.state(), SequenceState::Ready);

    // The controller is gone for a while, and somebody has called it in vain: the next attempt has to wait.
    emulator.stop();
    assert!(sequence.controller().connect().is_err());
    for _ in 0..20 {
        sequence.watch(&mut log);
    }
    assert_eq!(*sequence.state(), SequenceState::Ready, "{:?}", log.0);
    let emulator = start(address.clone());
    clock.advance(Duration::from_millis(300));
    sequence.watch(&mut log);
    sequence.watch(&mut log);
    assert_eq!(*sequence.state(), SequenceState::Ready, "{:?}", log.0);
    assert!(emulator.journal().iter().any(|entry| entry.command == "RPOSC"), "it is watched again");

    // Gone for longer than a wait.
    emulator.stop();
    for _ in 0..5 {
        sequence.watch(&mut log);
    }
    assert!(log.0[0].starts_with("5 status reports missed in a row"), "{:?}", log.0);
    let _emulator = start(address);
    let (before, too_early) = (clock.now(), sequence.controller().connect().unwrap_err());
    assert!(matches!(too_early, ConnectError::BackingOff { .. }), "{too_early}");
    sequence.resume(false).unwrap();
    assert!(clock.now() - before >= Duration::from_millis(200), "the wait was kept");
    sequence.go_home(&mut log);
    assert_eq!(*sequence.state(), SequenceState::Ready, "{:?}", log.0);
}
