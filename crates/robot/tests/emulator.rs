//! What the emulated controller answers to a host that speaks plain lines, and what it keeps of it.

// A test says what went wrong best by stopping there.
#![allow(clippy::unwrap_used, clippy::panic)]

use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::Duration;

use samsod_robot::emulator::{
    CommandResult, EmptyTable, Emulator, EmulatorConfig, EmulatorError, FaultKind, FaultPhase, FaultRule, FaultScript,
};
use samsod_robot::motoman::reply::{Reply, ReplyParser};
use samsod_robot::{ArmModel, Fault, Joints, ManualClock};

struct Host {
    stream: TcpStream,
    parser: ReplyParser,
    replies: Vec<Reply>,
}

impl Host {
    fn new(emulator: &Emulator) -> Self {
        let stream = TcpStream::connect(emulator.address()).unwrap();
        stream.set_read_timeout(Some(Duration::from_secs(10))).unwrap();
        stream.set_nodelay(true).unwrap();
        let mut host = Self { stream, parser: ReplyParser::new(), replies: Vec::new() };
        host.stream.write_all(b"CONNECT Robot_access Keep-Alive:-1\r\n").unwrap();
        assert!(matches!(host.reply(), Reply::Ok { .. }));
        host
    }

    fn reply(&mut self) -> Reply {
        let mut buffer = [0; 512];
        while self.replies.is_empty() {
            let count = self.stream.read(&mut buffer).unwrap();
            assert!(count > 0, "the emulator closed the connection");
            self.parser.feed(&buffer[..count], &mut self.replies).unwrap();
        }
        self.replies.remove(0)
    }

    fn ask(&mut self, command: &str, data: &str) -> Reply {
        let end = if data.is_empty() { "" } else { "\r" };
        let size = data.len() + end.len();
        let header = format!("HOSTCTRL_REQUEST {command} {size}\r\n");
        self.stream.write_all(header.as_bytes()).unwrap();
        assert_eq!(self.reply(), Reply::Ok { text: command.into() });
        self.stream.write_all(format!("{data}{end}").as_bytes()).unwrap();
        self.reply()
    }
}

fn emulator() -> (Emulator, ManualClock) {
    let clock = ManualClock::new();
    (Emulator::start(EmulatorConfig::default(), clock.clone(), Box::new(EmptyTable)).unwrap(), clock)
}

const DOWN: &str = "0,100.0,0,400,0,300,180,0,0,0,0,0,0,0,0,0,0";

fn refused(code: u32) -> Reply {
    Reply::Error { code }
}

fn data(line: &str) -> Reply {
    Reply::Data(line.into())
}

#[test]
fn it_moves_at_the_commanded_speed_on_its_clock() {
    let (emulator, clock) = emulator();
    let mut host = Host::new(&emulator);
    assert_eq!(host.ask("MOVL", DOWN), Reply::Done);
    assert_eq!(host.ask("RSTATS", ""), data("200,64"), "running");
    clock.advance(Duration::from_millis(250));
    assert_eq!(host.ask("RPOSC", "0,0"), data("400.000,0.000,375.000,180.0000,0.0000,0.0000,0,0"));
    clock.advance(Duration::from_millis(749));
    assert_eq!(host.ask("RSTATS", ""), data("200,64"), "running");
    clock.advance(Duration::from_millis(1));
    assert_eq!(host.ask("RSTATS", ""), data("192,64"));
    assert_eq!(host.ask("IMOV", "0,50,0,10,0,0,0,0,0,0,0,0,0,0,0,0,0"), Reply::Done);
    clock.advance(Duration::from_secs(1));
    assert_eq!(host.ask("RPOSC", "1,0"), data("410.000,0.000,300.000,180.0000,0.0000,0.0000,0,0"));
}

#[test]
fn its_joints_are_counted_in_pulses_and_moved_by_them() {
    let (emulator, clock) = emulator();
    let mut host = Host::new(&emulator);
    let Reply::Data(home) = host.ask("RPOSJ", "") else { panic!() };
    let counts: Vec<f64> = home.split(',').map(|count| count.parse().unwrap()).collect();
    let arm = ArmModel::mh5(100.0);
    let at_home = arm.joints_at(&emulator.position(), &Joints([0.0; 6])).unwrap();
    assert_eq!(counts.len(), 12);
    for (count, angle) in counts.iter().zip(at_home.0) {
        assert!((count - angle.to_degrees() * 1000.0).abs() <= 0.5, "{home}");
    }
    // S by 30 degrees: the tool goes round the foot of the arm, 2.96 rad/s at 100 %.
    let turned = |s: i64| {
        let [_, l, u, r, b, t] = [0, 1, 2, 3, 4, 5].map(|i| counts[i] as i64);
        format!("10.00,{s},{l},{u},{r},{b},{t},0,0,0,0,0,0,0")
    };
    assert_eq!(host.ask("PMOVJ", &turned(30_000)), Reply::Done);
    clock.advance(Duration::from_secs_f64(30f64.to_radians() / 0.296 - 0.01));
    assert_eq!(host.ask("RSTATS", ""), data("200,64"), "running");
    clock.advance(Duration::from_millis(20));
    assert_eq!(host.ask("RSTATS", ""), data("192,64"));
    let at = emulator.position();
    assert!((at.x_mm - 400.0 * 30f64.to_radians().cos()).hypot(at.y_mm - 200.0) < 0.01, "{at}");
    assert_eq!(host.ask("PMOVJ", &turned(171_000)), refused(1012), "S turns by 170 degrees at most");
    // Within its arms, and beyond them.
    assert_eq!(host.ask("MOVJ", "10.00,0,150,0,100,180,0,0,0,0,0,0,0,0,0,0"), refused(1012));
    assert_eq!(host.ask("MOVL", "0,100.0,0,900,0,100,180,0,0,0,0,0,0,0,0,0,0"), refused(1012));
}

#[test]
fn it_refuses_with_the_code_of_the_reason() {
    let faults = [(Fault::ServoOff, 2070), (Fault::ExternalHold, 2040), (Fault::Alarm(1), 2060), (Fault::Teach, 2080)];
    for (fault, code) in faults {
        let (emulator, _clock) = emulator();
        let mut host = Host::new(&emulator);
        emulator.inject(fault);
        assert_eq!(host.ask("MOVL", DOWN), refused(code), "{fault:?}");
        assert_eq!(emulator.motions_begun(), 0);
        emulator.restore();
        assert_eq!(host.ask("MOVL", DOWN), Reply::Done);
        assert_eq!(host.ask("MOVL", DOWN), refused(2010), "it is running");
    }
    let (emulator, _clock) = emulator();
    let mut host = Host::new(&emulator);
    assert_eq!(host.ask("HOLD", "1"), Reply::Done);
    let cases = [
        ("MOVL", DOWN, 2050),
        ("MOVE", DOWN, 1010),
        ("MOVL", "0,100,0,400,0,300", 1011),
        ("MOVL", "0,1501,0,400,0,300,180,0,0,0,0,0,0,0,0,0,0", 1012),
        ("MOVL", "0,100,0,400,zero,300,180,0,0,0,0,0,0,0,0,0,0", 1012),
        ("MOVL", "0,100,0,nan,0,300,180,0,0,0,0,0,0,0,0,0,0", 1012),
        ("MOVL", "0,100,7,400,0,300,180,0,0,0,0,0,0,0,0,0,0", 3350),
        ("START", "NOBODY", 4040),
        ("START", "A-NAME-LONGER-THAN-THIRTY-TWO-CHARACTERS", 1013),
        ("HOLD", "2", 1012),
        ("IOREAD", "20031,8", 1012),
        ("IOWRITE", "27010,16,1", 1011),
        ("LOADV", "0,100,1", 1012),
        ("LOADV", "0,1,256", 1012),
        ("LOADV", "5,1,1", 1012),
        ("SAVEV", "4,3", 4130),
        ("PMOVJ", "10.00,200000,0,0,0,0,0,0,0,0,0,0,0,0", 2050),
    ];
    for (command, data, code) in cases {
        assert_eq!(host.ask(command, data), refused(code), "{command} {data}");
    }
    assert_eq!(host.ask("HOLD", "0"), Reply::Done);
    emulator.inject(Fault::EmergencyStop);
    assert_eq!(host.ask("SVON", "1"), refused(3450), "not while the stop is pressed");
}

#[test]
fn an_alarm_is_reset_and_an_error_cancelled() {
    for (what, answer, clears, other) in [
        (FaultKind::Alarm { code: 4107 }, "0,0,4107,0,0,0,0,0,0,0", "RESET", "CANCEL"),
        (FaultKind::Error { code: 17 }, "17,0,0,0,0,0,0,0,0,0", "CANCEL", "RESET"),
    ] {
        let rule = FaultRule { command: None, nth: 1, phase: FaultPhase::Header, share: 0.0, what };
        let config = EmulatorConfig { script: FaultScript { faults: vec![rule] }, ..EmulatorConfig::default() };
        let emulator = Emulator::start(config, ManualClock::new(), Box::new(EmptyTable)).unwrap();
        let mut host = Host::new(&emulator);
        assert_eq!(host.ask("MOVL", DOWN), refused(2060));
        assert_eq!(host.ask("RALARM", ""), data(answer));
        assert_eq!(host.ask(other, ""), Reply::Done);
        assert_eq!(host.ask("MOVL", DOWN), refused(2060), "{other} does not clear {what:?}");
        assert_eq!(host.ask(clears, ""), Reply::Done);
        assert_eq!(host.ask("MOVL", DOWN), Reply::Done);
    }
}

#[test]
fn a_size_that_does_not_count_the_end_of_the_data_is_refused() {
    let (emulator, _clock) = emulator();
    let mut host = Host::new(&emulator);
    host.stream.write_all(b"HOSTCTRL_REQUEST HOLD 1\r\n1").unwrap();
    assert_eq!((host.reply(), host.reply()), (Reply::Ok { text: "HOLD".into() }, refused(1013)));
}

#[test]
fn variables_and_inputs_are_read_back_as_they_were_written() {
    let (emulator, _clock) = emulator();
    let mut host = Host::new(&emulator);
    let place = "1,0,400.000,0.000,300.000,180.0000,0.0000,0.0000,0,0";
    for (kind, value) in [(0, "255"), (1, "-32768"), (2, "70000"), (3, "1.5"), (4, place), (7, "BRACKET")] {
        assert_eq!(host.ask("LOADV", &format!("{kind},9,{value}")), Reply::Done);
        assert_eq!(host.ask("SAVEV", &format!("{kind},9")), data(value));
    }
    assert_eq!(host.ask("SAVEV", "0,10"), data("0"));
    assert_eq!(host.ask("IOWRITE", "27050,16,3,200"), Reply::Done);
    assert_eq!(host.ask("IOREAD", "27050,24"), data("3,200,0"));
    assert_eq!(host.ask("JSEQ", "GRIP-OPEN,0"), Reply::Done);
    assert_eq!(host.ask("RJSEQ", ""), data("GRIP-OPEN,1,1"));
}

#[test]
fn a_wrong_start_line_or_header_gets_ng_and_a_close() {
    let (emulator, _clock) = emulator();
    for (lines, answer) in [
        ("GET / HTTP/1.1\r\n", "NG: HTTP Error Response\r\n"),
        ("CONNECT Robot_access Keep-Alive:0\r\n", "NG: HTTP Error Response\r\n"),
        (
            "CONNECT Robot_access Keep-Alive:2\r\nRSTATS\r\n",
            "OK: DX Information Server(4.00) Keep-Alive:2.\r\nNG: HOSTCTRL_REQUEST is not correct\r\n",
        ),
        // Without a number of commands one is served.
        (
            "CONNECT Robot_access\r\nHOSTCTRL_REQUEST RSTATS 0\r\n",
            "OK: DX Information Server(4.00) Keep-Alive:1.\r\nOK: RSTATS\r\n192,64\r",
        ),
    ] {
        let mut stream = TcpStream::connect(emulator.address()).unwrap();
        stream.set_read_timeout(Some(Duration::from_secs(10))).unwrap();
        stream.write_all(lines.as_bytes()).unwrap();
        let mut all = String::new();
        stream.read_to_string(&mut all).unwrap();
        assert_eq!(all, answer);
    }
}

#[test]
fn the_journal_is_in_memory_and_in_a_file_line_by_line() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("journal.jsonl");
    let rule = FaultRule {
        command: Some("HOLD".into()),
        nth: 1,
        phase: FaultPhase::Answer,
        share: 0.0,
        what: FaultKind::EmergencyStop,
    };
    let config = EmulatorConfig {
        journal_file: Some(path.clone()),
        script: FaultScript { faults: vec![rule] },
        ..EmulatorConfig::default()
    };
    let clock = ManualClock::new();
    let emulator = Emulator::start(config, clock.clone(), Box::new(EmptyTable)).unwrap();
    let mut host = Host::new(&emulator);
    clock.advance(Duration::from_millis(1500));
    assert_eq!(host.ask("HOLD", "0"), Reply::Done);
    assert_eq!(host.ask("MOVL", DOWN), refused(2070));
    host.stream.write_all(b"HOSTCTRL_REQUEST MOVJ 40\r\n").unwrap();
    host.reply();
    let journal = emulator.stop();
    assert_eq!(journal[0].result, CommandResult::Executed { answer: "0000".into() });
    assert_eq!((journal[0].time_ms, journal[1].result.clone()), (1500.0, CommandResult::Refused { code: 2070 }));
    assert_eq!(journal[2].result, CommandResult::HeaderOnly);
    let lines: Vec<serde_json::Value> =
        std::fs::read_to_string(&path).unwrap().lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert_eq!(lines.len(), 3);
    assert_eq!(lines[0]["faults"][0]["what"]["kind"], "emergency_stop");
    assert_eq!((lines[1]["command"].as_str(), lines[1]["data"].as_str()), (Some("MOVL"), Some(DOWN)));
    assert_eq!(lines[1]["result"]["code"], 2070);
}

#[test]
fn a_second_client_can_take_the_robot_away_and_is_told_apart() {
    let rule = FaultRule {
        command: Some("MOVL".into()),
        nth: 1,
        phase: FaultPhase::Header,
        share: 0.0,
        what: FaultKind::SecondClient,
    };
    let config = EmulatorConfig { script: FaultScript { faults: vec![rule] }, ..EmulatorConfig::default() };
    let emulator = Emulator::start(config, ManualClock::new(), Box::new(EmptyTable)).unwrap();
    let mut host = Host::new(&emulator);
    assert_eq!(host.ask("MOVL", DOWN), refused(2010));
    let journal = emulator.stop();
    let theirs: Vec<_> = journal.iter().filter(|entry| entry.second_client).collect();
    assert_eq!((theirs.len(), &*theirs[0].command), (1, "MOVL"));
    assert!(matches!(theirs[0].result, CommandResult::Executed { .. }));
}

#[test]
fn faults_in_the_middle_of_a_motion_happen_there() {
    for (share, z) in [(0.25, "375.000"), (0.5, "350.000")] {
        let rule = FaultRule { command: None, nth: 1, phase: FaultPhase::MidMotion, share, what: FaultKind::StopShort };
        let config = EmulatorConfig { script: FaultScript { faults: vec![rule] }, ..EmulatorConfig::default() };
        let clock = ManualClock::new();
        let emulator = Emulator::start(config, clock.clone(), Box::new(EmptyTable)).unwrap();
        let mut host = Host::new(&emulator);
        assert_eq!(host.ask("MOVL", DOWN), Reply::Done);
        clock.advance(Duration::from_secs(30));
        assert_eq!(host.ask("RPOSC", "0,0"), data(&format!("400.000,0.000,{z},180.0000,0.0000,0.0000,0,0")));
    }
}

#[test]
fn a_configuration_is_read_from_a_file_and_checked() {
    let config: EmulatorConfig = toml::from_str(&toml::to_string(&EmulatorConfig::default()).unwrap()).unwrap();
    assert_eq!(config.listen, EmulatorConfig::default().listen);
    let start = |config| Emulator::start(config, ManualClock::new(), Box::new(EmptyTable)).err().unwrap();
    let error = start(EmulatorConfig { tool_length_mm: f64::NAN, ..Default::default() });
    assert_eq!(error.to_string(), "tool_length_mm is NaN; it must be 0 to 1000");
    let error =
        start(EmulatorConfig { pulses_per_deg: [1000.0, 0.0, 1000.0, 1000.0, 1000.0, 1000.0], ..Default::default() });
    assert_eq!(error.to_string(), "pulses_per_deg is 0; it must be above 0, at most 1000000");
    let error = start(EmulatorConfig { tool_length_mm: 900.0, ..Default::default() });
    assert!(error.to_string().starts_with("home: (400.0, 0.0, 400.0)"), "{error}");
    let error = start(EmulatorConfig { listen: "nowhere".into(), ..Default::default() });
    assert!(matches!(error, EmulatorError::Listen { .. }), "{error}");
    assert!(error.to_string().contains("nowhere"), "{error}");
}
