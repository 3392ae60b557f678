//! The Motoman controller before whatever may be at the other end of a connection, and what it sees of a robot.
//!
//! Bad peers are servers that send prepared bytes; everything else is the emulated controller. All of it over TCP.

// A test says what went wrong best by stopping there.
#![allow(clippy::unwrap_used, clippy::panic)]

use std::io::{Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::Duration;

use samsod_robot::emulator::{EmptyTable, Emulator, EmulatorConfig, FaultKind, FaultPhase, FaultRule, FaultScript};
use samsod_robot::motoman::{GripperConfig, Mode};
use samsod_robot::{
    AbortReason, CommandId, ConnectError, Controller, Fault, FollowOptions, GripperCommand, GripperState, ManualClock,
    MonotonicClock, Motion, MotionError, Motoman, MotomanConfig, NoWireLog, NotReady, Outcome, Pose, PositionError,
    StatusError, WireLog, Workpieces, follow,
};

/// What a peer does when it has sent all that was prepared.
#[derive(Clone, Copy, PartialEq)]
enum Then {
    Close,
    /// Says nothing more, and waits until the other side has given up.
    Silence,
    /// As `Silence`, and then sends the last answer late.
    Late(&'static [u8]),
}

type Conversation = (Vec<Vec<&'static [u8]>>, Then);

/// A server that answers every line with prepared segments, one conversation after the other.
fn peer(conversations: Vec<Conversation>) -> (String, JoinHandle<()>) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap().to_string();
    let thread = std::thread::spawn(move || {
        for (answers, then) in conversations {
            let (mut stream, _) = listener.accept().unwrap();
            stream.set_nodelay(true).unwrap();
            converse(&mut stream, answers, then);
        }
    });
    (address, thread)
}

fn converse(stream: &mut TcpStream, answers: Vec<Vec<&'static [u8]>>, then: Then) {
    for segments in answers {
        let mut byte = [0];
        while byte != *b"\r" {
            if !matches!(stream.read(&mut byte), Ok(1)) {
                return;
            }
        }
        for segment in segments {
            if stream.write_all(segment).is_err() {
                return;
            }
        }
    }
    if then == Then::Close {
        stream.shutdown(Shutdown::Write).unwrap();
    }
    // Until the other side has given up, too. It may end with a reset.
    let mut rest = Vec::new();
    let _ = stream.read_to_end(&mut rest);
    if let Then::Late(answer) = then {
        let _ = stream.write_all(answer);
    }
}

const GREETING: &[u8] = b"OK: FS Information Server(2.07) Keep-Alive:-1.\r\n";
const READY: &[u8] = b"OK: RSTATS\r\n192,64\r";
const PLACE: &[u8] = b"400.000,0.000,400.000,180.0000,0.0000,0.0000,0,0\r";

/// For peers that are to be found silent.
const SOON_MS: u64 = 500;

/// For everybody else: however busy the machine is.
const PATIENT_MS: u64 = 20_000;

fn config(address: &str, timeout_ms: u64) -> MotomanConfig {
    MotomanConfig {
        address: address.into(),
        greeting_timeout_ms: timeout_ms,
        header_timeout_ms: timeout_ms,
        answer_timeout_ms: timeout_ms,
        ..MotomanConfig::default()
    }
}

fn motoman(address: &str, timeout_ms: u64) -> Motoman {
    Motoman::new(config(address, timeout_ms), ManualClock::new(), Box::new(NoWireLog)).unwrap()
}

fn patience_with(answer: &[&[u8]], then: Then) -> u64 {
    if answer == [b""] && then != Then::Close { SOON_MS } else { PATIENT_MS }
}

fn target() -> Pose {
    Pose::gripper_down(400.0, 0.0, 300.0, 0.0)
}

fn down() -> Motion {
    Motion::Linear { target: target(), speed_mm_s: 100.0 }
}

/// Gives a motion to a peer that answers the header of MOVL, and then its data, with these segments; when that has
/// broken the connection, the peer answers `afterwards`.
fn motion_before(
    header: &[&'static [u8]],
    data: &[&'static [u8]],
    then: Then,
    afterwards: Vec<Vec<&'static [u8]>>,
) -> (Motoman, Result<(), MotionError>) {
    let mut answers = vec![vec![GREETING], vec![READY], vec![b"OK: RPOSC\r\n"], vec![PLACE]];
    answers.extend([header.to_vec(), data.to_vec()].into_iter().filter(|segments| !segments.is_empty()));
    let (address, _thread) = peer(vec![(answers, then), (afterwards, Then::Silence)]);
    let timeout_ms = patience_with(header, then).min(patience_with(data, then));
    let mut robot = motoman(&address, timeout_ms);
    robot.connect().unwrap();
    let result = robot.start_motion(CommandId(1), &down());
    (robot, result)
}

#[test]
fn a_motion_is_accepted_however_the_answer_is_cut() {
    let (byte_by_byte, merged): (Vec<&[u8]>, Vec<&[u8]>) = (b"0000\r\n".chunks(1).collect(), vec![b"0000\r"]);
    for data in [byte_by_byte, merged] {
        let (_, result) = motion_before(&[b"OK:", b" MOVL\r"], &data, Then::Close, vec![]);
        assert_eq!(result, Ok(()));
    }
}

#[test]
fn what_spoils_the_answer_to_a_header_leaves_the_motion_not_executed() {
    let cases: [(&[u8], Then, &str); 7] = [
        (b"", Then::Close, "closed the connection"),
        (b"", Then::Silence, "no answer within 500 ms"),
        (b"", Then::Late(b"OK: MOVL\r\n"), "no answer within 500 ms"),
        (b"OK: MO", Then::Close, "ended within a reply, after \"OK: MO\""),
        (b"OK: RSTATS\r\n", Then::Silence, "OK: with the name of the command"),
        (b"NG: no\r\n", Then::Silence, "answered NG: no"),
        (b"OK: M\xd6VL\r\n", Then::Silence, "byte 0xd6 in a reply"),
    ];
    for (header, then, message) in cases {
        let (_, result) = motion_before(&[header], &[], then, vec![]);
        let error = result.unwrap_err();
        assert!(matches!(error, MotionError::NotSent { .. }), "{error}");
        assert!(error.to_string().contains(message), "{error} does not say {message}");
    }
}

#[test]
fn what_spoils_the_answer_to_the_data_leaves_the_motion_unknown_and_latches() {
    let long: &'static [u8] = &[b'0'; 3000];
    let cases: [(&[u8], Then, &str); 8] = [
        (b"", Then::Close, "closed the connection"),
        (b"", Then::Silence, "no answer within 500 ms"),
        (b"", Then::Late(b"0000\r\n"), "no answer within 500 ms"),
        (b"00", Then::Close, "ended within a reply, after \"00\""),
        (b"00\x000\r\n", Then::Silence, "byte 0x00 in a reply"),
        (b"1,2,3\r", Then::Silence, "answered \"1,2,3\""),
        (b"ERROR: MOVL is not successful\r\n", Then::Silence, "no code in brackets"),
        (long, Then::Silence, "more than 2048 bytes"),
    ];
    // Then everything is well at the robot: READY to the status, and what resuming reads.
    let well = vec![vec![GREETING], vec![READY], vec![READY], vec![b"OK: RPOSC\r\n"], vec![PLACE], vec![READY]];
    for (data, then, message) in cases {
        let (mut robot, result) = motion_before(&[b"OK: MOVL\r\n"], &[data], then, well.clone());
        let error = result.unwrap_err();
        assert!(matches!(error.outcome(), Outcome::Unknown { .. }), "{error}");
        assert!(error.to_string().contains(message), "{error} does not say {message}");

        robot.connect().unwrap();
        let refused = robot.start_motion(CommandId(2), &down()).unwrap_err();
        assert!(matches!(refused, MotionError::NotReady(NotReady::Latched { .. })), "{refused}");
        assert_eq!(robot.resume().unwrap().z_mm, 400.0, "an operator sees where it is");
    }
}

#[test]
fn a_refusal_tells_its_code_and_what_it_means() {
    let cases: [(&[u8], &str); 4] = [
        (b"ERROR: MOVL is not successful(2070).\r\n", "2070 (servo power is off)"),
        (b"ERROR: MOVL is not successful(3350).\r\n", "3350 (the user frame is not taught)"),
        (b"ERROR: MOVL is not successful(9123).\r\n", "9123 (not a known interpreter message)"),
        (b"ERROR:(12)\r", "12 (not a known interpreter message)"),
    ];
    for (answer, message) in cases {
        let (_, result) = motion_before(&[b"OK: MOVL\r\n"], &[answer], Then::Close, vec![]);
        let error = result.unwrap_err();
        assert!(matches!(error.outcome(), Outcome::NotExecuted { .. }), "{error}");
        assert!(error.to_string().contains(message), "{error}");
    }
    // Refused at the header already.
    let (_, result) = motion_before(&[b"ERROR: MOVL is not successful(1010).\r\n"], &[], Then::Close, vec![]);
    assert!(matches!(result, Err(MotionError::Refused { code: 1010, .. })), "{result:?}");
}

#[test]
fn more_than_an_answer_ends_the_connection_before_the_next_command_leaves() {
    let (mut robot, result) = motion_before(&[b"OK: MOVL\r\n"], &[b"0000\r\n0000\r\n"], Then::Silence, vec![]);
    assert_eq!(result, Ok(()));
    let error = robot.status().unwrap_err();
    assert!(error.to_string().contains("where silence was due"), "{error}");
}

#[test]
fn answers_that_are_no_status_and_no_place_are_shown() {
    let answers = vec![vec![GREETING], vec![b"OK: RSTATS\r\n300,1\r"], vec![b"OK: RPOSC\r\n"], vec![b"1,2,x\r"]];
    let (address, _thread) = peer(vec![(answers, Then::Silence)]);
    let mut robot = motoman(&address, PATIENT_MS);
    robot.connect().unwrap();
    assert_eq!(robot.status(), Err(StatusError::Malformed { answer: "300,1".into() }));
    assert_eq!(robot.position(), Err(PositionError::Malformed { answer: "1,2,x".into() }));
}

#[test]
fn whoever_is_no_controller_is_named_with_what_it_said() {
    let cases: [(&[u8], Then, &str); 5] = [
        (b"220 ftp.example ready\r\n", Then::Silence, "answered \"220 ftp.example ready\" to the greeting"),
        (b"NG: HTTP Error Response\r\n", Then::Silence, "answered \"NG: HTTP Error Response\""),
        (b"\x16\x03\x01", Then::Silence, "byte 0x16"),
        (b"", Then::Close, "cannot reach the controller"),
        // Half open: it takes the connection and is gone.
        (b"", Then::Silence, "did not answer the greeting within 500 ms"),
    ];
    for (greeting, then, message) in cases {
        let (address, thread) = peer(vec![(vec![vec![greeting]], then)]);
        let error = motoman(&address, patience_with(&[greeting], then)).connect().unwrap_err();
        assert!(error.to_string().contains(message), "{error} does not say {message}");
        assert!(error.to_string().contains(&address), "{error} does not say where");
        thread.join().unwrap();
    }
}

#[test]
fn attempts_to_connect_are_spaced_out_until_one_serves() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap().to_string();
    drop(listener);
    let clock = ManualClock::new();
    let mut robot = Motoman::new(config(&address, PATIENT_MS), clock.clone(), Box::new(NoWireLog)).unwrap();
    for wait_ms in [250, 500, 1000, 2000, 4000, 5000, 5000] {
        let refused = robot.connect().unwrap_err();
        assert!(matches!(refused, ConnectError::Unreachable { .. }), "{refused}");
        let early = robot.connect().unwrap_err();
        assert_eq!(early, ConnectError::BackingOff { address: address.clone(), wait_ms });
        clock.advance(Duration::from_millis(wait_ms));
    }
}

/// Keeps what is sent; refuses to record the line that begins with `refuses`.
#[derive(Clone)]
struct Log {
    sent: Arc<Mutex<Vec<String>>>,
    refuses: &'static str,
}

impl WireLog for Log {
    fn sending(&mut self, bytes: &[u8]) -> Result<(), String> {
        let line = String::from_utf8(bytes.to_vec()).unwrap();
        if line.starts_with(self.refuses) {
            return Err("disk full".into());
        }
        self.sent.lock().unwrap().push(line);
        Ok(())
    }

    fn received(&mut self, bytes: &[u8]) {
        self.sent.lock().unwrap().push(format!("> {}", String::from_utf8_lossy(bytes)));
    }
}

struct Cell {
    robot: Motoman,
    emulator: Emulator,
    clock: ManualClock,
}

impl Cell {
    fn with(emulated: EmulatorConfig, change: impl FnOnce(&mut MotomanConfig), log: Box<dyn WireLog>) -> Self {
        Self::among(emulated, change, log, Box::new(EmptyTable))
    }

    fn among(
        emulated: EmulatorConfig,
        change: impl FnOnce(&mut MotomanConfig),
        log: Box<dyn WireLog>,
        workpieces: Box<dyn Workpieces>,
    ) -> Self {
        let clock = ManualClock::new();
        let emulator = Emulator::start(emulated, clock.clone(), workpieces).unwrap();
        let mut config = config(&emulator.address().to_string(), PATIENT_MS);
        change(&mut config);
        let mut robot = Motoman::new(config, clock.clone(), log).unwrap();
        robot.connect().unwrap();
        Self { robot, emulator, clock }
    }

    fn new() -> Self {
        Self::with(EmulatorConfig::default(), |_| (), Box::new(NoWireLog))
    }

    fn follow(&mut self, id: u64) -> Outcome {
        follow(&mut self.robot, &self.clock, CommandId(id), &FollowOptions::default(), |_| ())
    }

    fn go(&mut self, id: u64, motion: &Motion) -> Outcome {
        self.robot.start_motion(CommandId(id), motion).unwrap();
        self.follow(id)
    }

    fn grip(&mut self, id: u64, command: GripperCommand) -> Outcome {
        self.robot.start_gripper(CommandId(id), command).unwrap();
        self.follow(id)
    }

    fn commands(&self) -> Vec<String> {
        self.emulator.journal().into_iter().map(|entry| entry.command).collect()
    }
}

#[test]
fn a_pose_that_is_no_number_writes_no_byte() {
    let log = Log { sent: Arc::default(), refuses: "nothing" };
    let mut cell = Cell::with(EmulatorConfig::default(), |_| (), Box::new(log.clone()));
    let before = log.sent.lock().unwrap().len();
    let motion = Motion::Linear { target: Pose { z_mm: f64::NAN, ..target() }, speed_mm_s: 100.0 };
    let error = cell.robot.start_motion(CommandId(1), &motion).unwrap_err();
    assert_eq!(error.to_string(), "target: z_mm of a pose is NaN; it must be a finite number");
    assert_eq!(log.sent.lock().unwrap().len(), before);
    assert_eq!(cell.go(1, &down()), Outcome::Done, "its id is not used up");
}

#[test]
fn what_cannot_be_recorded_is_not_sent() {
    for refuses in ["HOSTCTRL_REQUEST MOVL", "0,100.00"] {
        let log = Log { sent: Arc::default(), refuses };
        let mut cell = Cell::with(EmulatorConfig::default(), |_| (), Box::new(log));
        let error = cell.robot.start_motion(CommandId(1), &down()).unwrap_err();
        assert!(matches!(&error, MotionError::NotSent { cause } if cause.contains("disk full")), "{error}");
        assert_eq!(cell.emulator.motions_begun(), 0, "{refuses}");
        assert!(cell.emulator.stop().iter().all(|entry| entry.command != "MOVL" || entry.data.is_none()));
    }
}

#[test]
fn a_hold_is_sent_though_it_cannot_be_recorded_and_its_release_is_not() {
    for refuses in ["HOSTCTRL_REQUEST HOLD", "1\r"] {
        let log = Log { sent: Arc::default(), refuses };
        let mut cell = Cell::with(EmulatorConfig::default(), |_| (), Box::new(log));
        cell.robot.hold(true).unwrap();
        assert!(cell.robot.status().unwrap().hold_command, "{refuses:?}");
    }
    let log = Log { sent: Arc::default(), refuses: "HOSTCTRL_REQUEST HOLD" };
    let mut cell = Cell::with(EmulatorConfig::default(), |_| (), Box::new(log));
    cell.robot.hold(true).unwrap();
    let refused = cell.robot.hold(false).unwrap_err();
    assert!(refused.to_string().contains("disk full"), "{refused}");
}

#[test]
fn every_byte_of_the_wire_is_in_the_log() {
    let log = Log { sent: Arc::default(), refuses: "nothing" };
    let mut cell = Cell::with(EmulatorConfig::default(), |_| (), Box::new(log.clone()));
    cell.robot.hold(true).unwrap();
    let sent: String = log.sent.lock().unwrap().concat();
    let expected = "CONNECT Robot_access Keep-Alive:-1\r\n> OK: DX Information Server(4.00) Keep-Alive:-1.\r\n\
                    HOSTCTRL_REQUEST HOLD 2\r\n> OK: HOLD\r\n1\r> 0000\r\n";
    assert_eq!(sent, expected);
}

#[test]
fn the_motion_on_the_wire_is_the_one_that_was_given() {
    let mut cell = Cell::with(EmulatorConfig { figure: 5, ..Default::default() }, |c| c.tool = 2, Box::new(NoWireLog));
    assert_eq!(cell.go(1, &down()), Outcome::Done);
    let joint = Motion::Joint { target: Pose { rz_rad: -0.5, ..target() }, speed_fraction: 0.25 };
    assert_eq!(cell.go(2, &joint), Outcome::Done);
    let journal = cell.emulator.stop();
    let data = |command| journal.iter().find(|entry| entry.command == command).unwrap().data.clone().unwrap();
    // Flip, elbow and front or back are told to stay as they are: type 5.
    assert_eq!(data("MOVL"), "0,100.00,0,400.000,0.000,300.000,180.0000,0.0000,0.0000,5,2,0,0,0,0,0,0");
    assert_eq!(data("MOVJ"), "25.00,0,400.000,0.000,300.000,180.0000,0.0000,-28.6479,5,2,0,0,0,0,0,0");
}

#[test]
fn it_all_works_on_the_clock_of_life_too() {
    let clock = MonotonicClock::new();
    let table = Table::default();
    let emulator = Emulator::start(EmulatorConfig::default(), clock, Box::new(table.clone())).unwrap();
    let config = config(&emulator.address().to_string(), PATIENT_MS);
    let mut robot = Motoman::new(config, clock, Box::new(NoWireLog)).unwrap();
    robot.connect().unwrap();
    let target = Pose { z_mm: 380.0, ..target() };
    robot.start_motion(CommandId(1), &Motion::Linear { target, speed_mm_s: 200.0 }).unwrap();
    assert_eq!(follow(&mut robot, &clock, CommandId(1), &FollowOptions::default(), |_| ()), Outcome::Done);
    robot.start_gripper(CommandId(2), GripperCommand::Open).unwrap();
    assert_eq!(follow(&mut robot, &clock, CommandId(2), &FollowOptions::default(), |_| ()), Outcome::Done);
    assert!(emulator.position().distance_mm(&target) < 1e-9);
    assert!(table.opened.lock().unwrap()[0].distance_mm(&target) < 1e-9);
}

#[test]
fn a_taught_job_gets_its_variables_before_it_is_started() {
    let job = EmulatorConfig::default().move_job;
    let change = |c: &mut MotomanConfig| (c.mode, c.job) = (Mode::Job, Some(job));
    let mut cell = Cell::with(EmulatorConfig::default(), change, Box::new(NoWireLog));
    assert_eq!(cell.go(1, &down()), Outcome::Done);
    let journal = cell.emulator.stop();
    let at = journal.iter().position(|entry| entry.command == "LOADV").unwrap();
    let data: Vec<_> = journal[at..at + 4].iter().map(|entry| entry.data.clone().unwrap()).collect();
    let place = "4,10,1,0,400.000,0.000,300.000,180.0000,0.0000,0.0000,0,0";
    assert_eq!(data, [place, "1,11,1000", "0,12,2", "SAMSOD-MOVE"]);
}

#[test]
fn a_variable_that_may_not_have_arrived_moves_nothing() {
    let what = FaultKind::Close;
    let rule = FaultRule { command: Some("LOADV".into()), nth: 2, phase: FaultPhase::Answer, share: 0.0, what };
    let emulated = EmulatorConfig { script: FaultScript { faults: vec![rule] }, ..Default::default() };
    let job = emulated.move_job.clone();
    let change = |c: &mut MotomanConfig| (c.mode, c.job) = (Mode::Job, Some(job));
    let mut cell = Cell::with(emulated, change, Box::new(NoWireLog));
    let error = cell.robot.start_motion(CommandId(1), &down()).unwrap_err();
    assert!(matches!(error, MotionError::NotSent { .. }), "{error}");
    cell.robot.connect().unwrap();
    assert_eq!(cell.go(2, &down()), Outcome::Done);
    assert_eq!(cell.emulator.motions_begun(), 1);
}

#[test]
fn a_job_that_is_not_ours_is_named_and_latched() {
    let job = EmulatorConfig::default().move_job;
    let change = |c: &mut MotomanConfig| (c.mode, c.job) = (Mode::Job, Some(job));
    let mut cell = Cell::with(EmulatorConfig::default(), change, Box::new(NoWireLog));
    cell.robot.start_motion(CommandId(1), &down()).unwrap();
    cell.clock.advance(Duration::from_millis(200));
    // Somebody else stops our job and starts another.
    cell.emulator.inject(Fault::StopShort);
    let mut other = TcpStream::connect(cell.emulator.address()).unwrap();
    for (line, answer) in [
        ("CONNECT Robot_access Keep-Alive:-1\r\n", "OK: DX Information Server(4.00) Keep-Alive:-1.\r\n"),
        ("HOSTCTRL_REQUEST START 10\r\n", "OK: START\r\n"),
        ("GRIP-OPEN\r", "0000\r\n"),
    ] {
        exchange(&mut other, line, answer);
    }
    let outcome = cell.robot.poll(CommandId(1)).unwrap().outcome;
    assert_eq!(outcome, Outcome::Aborted { reason: AbortReason::OtherJob { job: "GRIP-OPEN".into() } });
    assert!(cell.robot.status().unwrap().latched.is_some());
}

fn exchange(stream: &mut TcpStream, line: &str, answer: &str) {
    stream.write_all(line.as_bytes()).unwrap();
    let mut bytes = vec![0; answer.len()];
    stream.read_exact(&mut bytes).unwrap();
    assert_eq!(String::from_utf8_lossy(&bytes), answer, "to {line}");
}

/// Holds something wherever it closes below 310 mm; keeps the way of the tool.
#[derive(Clone, Default)]
struct Table {
    way: Arc<Mutex<Vec<Pose>>>,
    opened: Arc<Mutex<Vec<Pose>>>,
}

impl Workpieces for Table {
    fn passes(&mut self, tool: &Pose) {
        self.way.lock().unwrap().push(*tool);
    }

    fn close(&mut self, tool: &Pose) -> bool {
        tool.z_mm < 310.0
    }

    fn open(&mut self, tool: &Pose) {
        self.opened.lock().unwrap().push(*tool);
    }
}

#[test]
fn a_part_sensor_tells_holding_from_empty_and_what_is_lost_on_the_way() {
    for jobs in [false, true] {
        let (emulated, table) = (EmulatorConfig::default(), Table::default());
        let sensor = emulated.part_sensor;
        let change = |c: &mut MotomanConfig| {
            c.part_sensor = Some(sensor);
            if jobs {
                let (open_job, close_job) = ("GRIP-OPEN".into(), "GRIP-CLOSE".into());
                c.gripper = GripperConfig::Jobs { open_job, close_job };
            }
        };
        let mut cell = Cell::among(emulated, change, Box::new(NoWireLog), Box::new(table.clone()));
        assert_eq!(cell.grip(1, GripperCommand::Close), Outcome::Done);
        assert_eq!(cell.robot.status().unwrap().gripper, GripperState::Empty, "there is nothing up there");
        assert_eq!(cell.grip(2, GripperCommand::Open), Outcome::Done);
        assert_eq!(cell.robot.status().unwrap().gripper, GripperState::Open);
        assert_eq!(cell.go(3, &down()), Outcome::Done);
        cell.robot.start_gripper(CommandId(4), GripperCommand::Close).unwrap();
        let status = cell.robot.status().unwrap();
        assert_eq!((status.gripper, status.running), (GripperState::Moving, true));
        let refused = cell.robot.start_motion(CommandId(5), &down()).unwrap_err();
        assert_eq!(refused, MotionError::NotReady(NotReady::Running), "not with a gripper that is half closed");
        assert_eq!(cell.follow(4), Outcome::Done);
        assert_eq!(cell.robot.status().unwrap().gripper, GripperState::Holding);
        assert_eq!(table.opened.lock().unwrap().len(), 1);
        let way = table.way.lock().unwrap();
        assert!(way.len() >= 50, "100 mm in steps of at most 2 mm");
        let steps = way.windows(2).map(|pair| pair[0].distance_mm(&pair[1]));
        assert!(steps.fold(0.0, f64::max) <= 2.0 + 1e-9);
        assert!(way.last().unwrap().distance_mm(&target()) < 1e-9);
    }
}

#[test]
fn what_is_lost_while_the_robot_stands_is_latched_too() {
    for (fault, word) in [(Fault::ServoOff, "servo"), (Fault::Alarm(4107), "4107"), (Fault::Teach, "remote")] {
        let mut cell = Cell::new();
        assert!(cell.robot.status().unwrap().check_ready().is_ok());
        cell.emulator.inject(fault);
        assert!(cell.robot.status().unwrap().latched.unwrap().contains(word));
        cell.emulator.restore();
        let refused = cell.robot.start_motion(CommandId(1), &down()).unwrap_err();
        assert!(matches!(refused, MotionError::NotReady(NotReady::Latched { .. })), "{refused}");
        cell.robot.resume().unwrap();
        assert_eq!(cell.go(1, &down()), Outcome::Done);
    }
}

#[test]
fn a_robot_that_was_found_without_servo_power_is_not_at_fault() {
    let mut cell = Cell::new();
    cell.emulator.inject(Fault::ServoOff);
    let status = cell.robot.status().unwrap();
    assert!(!status.servo_on && status.latched.is_none());
    let refused = cell.robot.start_motion(CommandId(1), &down()).unwrap_err();
    assert_eq!(refused, MotionError::NotReady(NotReady::ServoOff));
    cell.emulator.restore();
    assert_eq!(cell.go(1, &down()), Outcome::Done);
    assert!(!cell.commands().iter().any(|command| command == "SVON"), "servo power is the operator's");
}

#[test]
fn an_emergency_stop_without_a_signal_shows_as_servo_power_off() {
    let mut cell = Cell::new();
    cell.robot.start_motion(CommandId(1), &down()).unwrap();
    cell.emulator.inject(Fault::EmergencyStop);
    let outcome = cell.robot.poll(CommandId(1)).unwrap().outcome;
    assert_eq!(outcome, Outcome::Aborted { reason: AbortReason::ServoOff });
}

#[test]
fn a_stop_short_is_told_with_what_was_left_but_not_before_the_robot_may_have_begun() {
    let mut cell = Cell::new();
    cell.robot.start_motion(CommandId(1), &down()).unwrap();
    // As a controller looks that has accepted and does not run yet.
    cell.emulator.inject(Fault::StopShort);
    assert_eq!(cell.robot.poll(CommandId(1)).unwrap().outcome, Outcome::Accepted);
    cell.clock.advance(Duration::from_millis(300));
    let outcome = cell.robot.poll(CommandId(1)).unwrap().outcome;
    assert_eq!(outcome, Outcome::Aborted { reason: AbortReason::StoppedShort { remaining_um: 100_000 } });
    assert!(cell.robot.status().unwrap().latched.is_some());
}

#[test]
fn a_motion_that_nobody_followed_is_concluded_before_the_next() {
    let mut cell = Cell::new();
    cell.robot.start_motion(CommandId(1), &down()).unwrap();
    cell.emulator.inject(Fault::StopShort);
    let refused = cell.robot.start_motion(CommandId(2), &down()).unwrap_err();
    assert_eq!(refused, MotionError::NotReady(NotReady::Running), "it may begin yet");
    cell.clock.advance(Duration::from_millis(300));
    let refused = cell.robot.start_gripper(CommandId(2), GripperCommand::Open).unwrap_err();
    assert!(refused.to_string().contains("stopped 100000 um short"), "{refused}");
    cell.robot.resume().unwrap();
    cell.robot.start_motion(CommandId(3), &down()).unwrap();
    cell.clock.advance(Duration::from_secs(5));
    cell.robot.start_motion(CommandId(4), &Motion::Linear { target: target(), speed_mm_s: 50.0 }).unwrap();
    assert_eq!(cell.emulator.motions_begun(), 3);
}

#[test]
fn a_hold_that_was_released_before_anybody_looked_is_still_a_hold() {
    let mut cell = Cell::new();
    cell.robot.start_motion(CommandId(1), &down()).unwrap();
    cell.clock.advance(Duration::from_millis(200));
    cell.robot.hold(true).unwrap();
    cell.robot.hold(false).unwrap();
    assert_eq!(cell.follow(1), Outcome::Aborted { reason: AbortReason::Hold });
    assert_eq!(cell.go(2, &down()), Outcome::Done);
}

#[test]
fn a_connection_for_some_commands_is_renewed_without_a_fault() {
    let mut cell = Cell::with(EmulatorConfig::default(), |c| c.keep_alive = 2, Box::new(NoWireLog));
    assert_eq!(cell.go(1, &down()), Outcome::Done);
    let journal = cell.emulator.stop();
    let last = journal.last().unwrap();
    assert!(last.connection > 3, "{last:?}");
    assert_eq!(journal.iter().filter(|entry| entry.command == "MOVL").count(), 1);
}
