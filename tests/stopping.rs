//! samsodd is told to end, whatever it is at: the recording is closed, and the robot stands in a state that is written down.
//!
//! Whatever hangs in these tests would hang for a minute or for ever: a service that waits for it does not come through.

#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests fail by panicking")]

mod support;

use std::fs;
use std::net::TcpListener;
use std::path::PathBuf;
use std::process::Command;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;

use samsod_frame::PixelFormat;
use serde_json::Value;
use support::{Ended, Process, TestCell, assert_closed, json, messages, samsod, send, test_data, wait_for};

/// The way home takes a minute or so.
const SLOW: &str = "joint_speed_fraction = 0.002\n";
/// A motion that takes a minute, away from where the arm begins.
const FAR_HOME: &str =
    "home = { x_mm = 250.0, y_mm = 330.0, z_mm = 250.0, rx_deg = 180.0, ry_deg = 0.0, rz_deg = 0.0 }\n";

fn only_recording(cell: &TestCell) -> PathBuf {
    let files = cell.recordings();
    assert_eq!(files.len(), 1, "{files:?}");
    files[0].clone()
}

/// Sends the signal, waits for the end, and checks what holds for every end.
#[track_caller]
fn end(cell: &TestCell, daemon: Process, signal: &str) -> Ended {
    daemon.signal(signal);
    let ended = daemon.wait();
    ended.assert_success();
    assert!(ended.stdout.starts_with("cell test-cell: stopped after"), "{ended:#?}");
    let frames = |name| ended.count("frames", name);
    // Whatever was received is one of these.
    assert_eq!(frames("received"), frames("processed") + frames("failed"), "{}", ended.stdout);
    let commands = |name| ended.count("commands", name);
    let ends = ["done", "not executed", "aborted", "unknown"].map(commands);
    assert_eq!(commands("sent"), ends.iter().sum::<u64>(), "every command has an end: {}", ended.stdout);
    let last = cell.recordings().pop().unwrap();
    assert_closed(&last);
    ended
}

/// Final outcomes in a recording.
fn outcomes(cell: &TestCell) -> Vec<Value> {
    let last = cell.recordings().pop().unwrap();
    let all = json(&messages(&last), "/robot/outcome");
    all.into_iter().filter(|outcome| outcome["outcome"] != "accepted").collect()
}

fn faults(cell: &TestCell) -> Vec<Value> {
    json(&messages(&cell.recordings().pop().unwrap()), "/robot/fault")
}

/// A cell with an assembly list, whose robot is an emulated controller: it goes home as soon as it can.
struct Emulated {
    cell: TestCell,
    config: PathBuf,
    emulator: Process,
    journal: PathBuf,
}

impl Emulated {
    /// `patience_ms`: how long samsodd waits for an answer of the controller.
    fn new(patience_ms: u64) -> Self {
        let cell = TestCell::new();
        let free = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().to_string();
        let journal = cell.path("journal.jsonl");
        let mut command = Command::new(env!("CARGO_BIN_EXE_samsod"));
        command.args(["emulate", "motoman", "--listen", &free, "--journal"]).arg(&journal);
        let emulator = Process::spawn(command);
        emulator.wait_for_line("listening on");
        let parts = test_data("parts");
        let motoman = format!(
            "address = \"{free}\"\nanswer_timeout_ms = {patience_ms}\nheader_timeout_ms = {patience_ms}\n\
             greeting_timeout_ms = {patience_ms}\n"
        );
        let config = cell.config(&[
            ("catalogue", &format!("folder = {parts:?}\n")),
            ("robot", &format!("controller = \"motoman\"\narmed = true\n{SLOW}{FAR_HOME}")),
            ("robot.motoman", &motoman),
            ("jig", "order = [{ part = \"hex_nut\", x_mm = 300.0, y_mm = 250.0 }]\n"),
        ]);
        Self { cell, config, emulator, journal }
    }

    /// Starts samsodd and waits until the arm is on its way.
    fn start_moving(&self) -> Process {
        let daemon = self.cell.spawn_daemon(&self.config, &[]);
        let line = daemon.wait_for_line("command");
        assert!(line.contains("phase=home"), "{line}");
        daemon.wait_for_line("ready, waiting for frames");
        wait_for("a motion that has begun", || (!self.commands("MOVJ").is_empty()).then_some(()));
        daemon
    }

    /// The data of a command, each time that it was executed.
    fn commands(&self, name: &str) -> Vec<String> {
        let text = fs::read_to_string(&self.journal).unwrap();
        let whole = text.rsplit_once('\n').map_or("", |(whole, _)| whole);
        let entries = whole.lines().map(|line| serde_json::from_str::<Value>(line).unwrap());
        let executed = entries.filter(|entry| entry["command"] == name && entry["result"]["result"] == "executed");
        executed.map(|entry| entry["data"].as_str().unwrap_or_default().to_owned()).collect()
    }

    fn ask(&self, arguments: &[&str]) -> Ended {
        samsod(&[arguments, &["--config", self.config.to_str().unwrap()]].concat())
    }
}

#[test]
fn a_service_that_waits_or_stands_held_just_ends() {
    for (signal, is_held) in [("TERM", false), ("INT", false), ("TERM", true)] {
        let cell = TestCell::new();
        let daemon = cell.start_daemon(&[]);
        if is_held {
            samsod(&["hold", "--config", cell.path("cell.toml").to_str().unwrap()]).assert_success();
        }
        let ended = end(&cell, daemon, signal);
        assert_eq!(ended.count("frames", "received"), 0);
    }
}

#[test]
fn vision_that_is_at_a_frame_for_long_is_left_there_and_the_frame_is_counted() {
    let cell = TestCell::new();
    // The reference saliency on a frame of many partitions takes its time.
    let daemon = cell.spawn_daemon(&cell.config(&[("saliency", "method = \"exact\"")]), &[]);
    daemon.wait_for_line("ready, waiting for frames");
    let mut publisher = cell.publisher_of(1600 * 1200 * 3);
    let mut loan = publisher.loan(1600, 1200, PixelFormat::Rgb8).unwrap();
    for (i, byte) in loan.pixels().iter_mut().enumerate() {
        *byte = ((i / 3 % 1600 / 16 + i / 4800 / 16) * 67 % 251) as u8;
    }
    loan.send().unwrap();
    daemon.wait_for_line("frames from a new client");
    let ended = end(&cell, daemon, "TERM");
    assert!(ended.stderr.contains("told to end while vision is at a frame"), "{}", ended.stderr);
    assert_eq!((ended.count("frames", "received"), ended.count("frames", "failed")), (1, 1), "{}", ended.stdout);
}

#[test]
fn a_simulated_arm_on_its_way_is_put_on_hold() {
    for signal in ["TERM", "INT"] {
        let cell = TestCell::new();
        let daemon = cell.spawn_daemon(&cell.config(&[("robot", SLOW)]), &[]);
        daemon.wait_for_line("ready, waiting for frames");
        let mut publisher = cell.publisher();
        send(&mut publisher, 0);
        daemon.wait_for_line("command");
        let ended = end(&cell, daemon, signal);
        assert_eq!(ended.count("commands", "aborted"), 1, "{}", ended.stdout);
        let outcomes = outcomes(&cell);
        assert_eq!((outcomes.len(), &outcomes[0]["outcome"]), (1, &"aborted".into()), "{outcomes:?}");
        assert!(outcomes[0].to_string().contains("hold"), "{outcomes:?}");
    }
}

#[test]
fn a_controller_is_told_to_hold_and_the_next_samsodd_asks_an_operator_before_it_moves() {
    let rig = Emulated::new(30_000);
    let ended = end(&rig.cell, rig.start_moving(), "TERM");
    assert_eq!(rig.commands("HOLD"), ["1"], "told once");
    assert_eq!(rig.commands("MOVJ").len(), 1);
    assert_eq!(ended.count("commands", "aborted"), 1, "{}", ended.stdout);
    assert!(ended.stdout.contains("stopped    the gripper is empty"), "{}", ended.stdout);
    let (outcomes, faults) = (outcomes(&rig.cell), faults(&rig.cell));
    assert_eq!((outcomes.len(), &outcomes[0]["outcome"]), (1, &"aborted".into()), "{outcomes:?}");
    assert_eq!(faults.len(), 1, "{faults:?}");
    assert_eq!((&faults[0]["phase"], &faults[0]["holds"]["gripper"]), (&"home".into(), &"nothing".into()));

    // The hold outlives samsodd.
    let daemon = rig.cell.spawn_daemon(&rig.config, &[]);
    daemon.wait_for_line("the robot stands until an operator resumes");
    let refused = rig.ask(&["resume"]);
    assert!(refused.stderr.contains("the gripper may hold the part of an earlier run"), "{refused:?}");
    assert_eq!(rig.commands("MOVJ").len(), 1, "nothing moves by itself");
    rig.ask(&["resume", "--gripper-is-empty"]).assert_success();
    daemon.wait_for_line("phase=home");
    wait_for("the way home", || (rig.commands("MOVJ").len() == 2).then_some(()));
    end(&rig.cell, daemon, "TERM");
    assert_eq!(rig.commands("HOLD"), ["1", "0", "1"]);
}

#[test]
fn a_controller_that_does_not_answer_is_given_up_and_its_command_is_unknown() {
    let rig = Emulated::new(60_000);
    let daemon = rig.start_moving();
    rig.emulator.freeze();
    let ended = end(&rig.cell, daemon, "TERM");
    assert_eq!(ended.count("commands", "unknown"), 1, "{}", ended.stdout);
    let (outcomes, faults) = (outcomes(&rig.cell), faults(&rig.cell));
    assert_eq!((outcomes.len(), &outcomes[0]["outcome"]), (1, &"unknown".into()), "{outcomes:?}");
    assert_eq!(faults.len(), 1, "{faults:?}");
    assert!(faults[0]["reason"].as_str().unwrap().contains("the robot may still be moving"), "{faults:?}");
}

#[test]
fn a_start_that_hangs_at_the_controller_is_left_there() {
    let cell = TestCell::new();
    // Connections are taken by the system, and nobody ever greets.
    let silent = TcpListener::bind("127.0.0.1:0").unwrap();
    let motoman = format!("address = \"{}\"\ngreeting_timeout_ms = 60000\n", silent.local_addr().unwrap());
    let config = cell.config(&[("robot", "controller = \"motoman\"\narmed = true\n"), ("robot.motoman", &motoman)]);
    let daemon = cell.spawn_daemon(&config, &[]);
    let _connection = silent.accept().unwrap();
    daemon.signal("TERM");
    let ended = daemon.wait();
    ended.assert_success();
    assert!(ended.stderr.contains("told to end before it was ready"), "{}", ended.stderr);
    assert_closed(&only_recording(&cell));
}

#[test]
fn a_client_that_floods_the_cell_does_not_keep_it_up() {
    let cell = TestCell::new();
    let daemon = cell.start_daemon(&[]);
    let is_over = AtomicBool::new(false);
    thread::scope(|scope| {
        scope.spawn(|| {
            let mut publisher = cell.publisher();
            let mut number = 0;
            while !is_over.load(Ordering::SeqCst) {
                send(&mut publisher, number);
                number += 1;
            }
        });
        daemon.wait_for_line("frames from a new client");
        let ended = end(&cell, daemon, "TERM");
        is_over.store(true, Ordering::SeqCst);
        assert!(ended.count("frames", "received") > 0);
    });
}

#[test]
fn a_controller_that_is_switched_on_later_is_waited_for() {
    let cell = TestCell::new();
    let free = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().to_string();
    let config = cell.config(&[
        ("catalogue", &format!("folder = {:?}\n", test_data("parts"))),
        ("robot", &format!("controller = \"motoman\"\narmed = true\njoint_speed_fraction = 1.0\n{FAR_HOME}")),
        ("robot.motoman", &format!("address = \"{free}\"\n")),
        ("jig", "order = [{ part = \"hex_nut\", x_mm = 300.0, y_mm = 250.0 }]\n"),
    ]);
    let daemon = cell.spawn_daemon(&config, &[]);
    daemon.wait_for_line("the robot is not reached");
    daemon.wait_for_line("ready, waiting for frames");
    // Vision works meanwhile.
    let (mut scenes, mut publisher) = (cell.scenes(), cell.publisher());
    send(&mut publisher, 0);
    scenes.of_frame(0);
    let status = samsod(&["status", "--config", config.to_str().unwrap()]);
    assert!(status.stdout.contains("the controller is not connected"), "{status:?}");
    let mut command = Command::new(env!("CARGO_BIN_EXE_samsod"));
    command.args(["emulate", "motoman", "--listen", &free]);
    let _emulator = Process::spawn(command);
    daemon.wait_for_line("phase=home");
    wait_for("a robot at work", || {
        samsod(&["status", "--config", config.to_str().unwrap()]).stdout.contains("at work").then_some(())
    });
    let ended = end(&cell, daemon, "TERM");
    assert_eq!(ended.count("commands", "done"), 1, "{}", ended.stdout);
}
