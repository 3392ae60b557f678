//! The closed loop as real processes: a table that is drawn, samsodd that sees and clears it, a robot that takes parts from it,
//! simulated or behind TCP; and the operator's part in it.

#![allow(clippy::unwrap_used, reason = "helpers of tests fail by panicking")]

mod support;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use samsod_robot::{TableState, Whereabouts};
use serde_json::Value;
use support::{Ended, Process, TestCell, json, messages, samsod, test_data, wait_for};

const PARTS: [&str; 2] = ["terminal_block", "star_knob"];

/// A cell with two parts on a simulated table and a jig for them.
struct Loop {
    cell: TestCell,
    config: PathBuf,
}

impl Loop {
    fn new(robot: &str) -> Self {
        let cell = TestCell::new();
        // A catalogue of two: an unoptimised chain is slow enough.
        let parts = cell.path("parts");
        for part in PARTS {
            let folder = parts.join(part);
            fs::create_dir_all(&folder).unwrap();
            for file in ["part.toml", "template.png", "mask.png", "model.stl"] {
                fs::copy(test_data("parts").join(part).join(file), folder.join(file)).unwrap();
            }
        }
        let table = cell.path("table.json");
        TableState::new(Vec::new()).write(&table).unwrap();
        let camera = format!("file = {:?}\nobject_height_mm = 15.0\n", test_data("cell/camera.toml"));
        let robot = format!(
            "armed = true\nsafe_height_mm = 120.0\nlinear_speed_mm_s = 500.0\njoint_speed_fraction = 1.0\n\
             home = {{ x_mm = 250.0, y_mm = 330.0, z_mm = 250.0, rx_deg = 180.0, ry_deg = 0.0, rz_deg = 0.0 }}\n{robot}"
        );
        // A machine under load shows frames that are seconds old.
        let limits = "target_age_max_ms = 600000\n";
        let order = format!(
            "order = [{{ part = {:?}, x_mm = 180.0, y_mm = 330.0 }}, {{ part = {:?}, x_mm = 300.0, y_mm = 330.0, yaw_deg = 90.0 }}]\n",
            PARTS[0], PARTS[1]
        );
        let config = cell.config(&[
            ("camera", &camera),
            ("catalogue", &format!("folder = {parts:?}\n")),
            ("recording", "image_encoding = \"jpeg\""),
            ("robot", &robot),
            ("robot.limits", limits),
            ("jig", &order),
        ]);
        let laid = Self { cell, config };
        let seed = ["--seed", "5", "--parts", &PARTS.join(",")];
        laid.run(
            &[&["twin", "table"][..], &seed, &["--config", &laid.text("cell.toml"), "--out", &laid.text("table.json")]]
                .concat(),
        )
        .assert_success();
        laid
    }

    fn text(&self, name: &str) -> String {
        self.cell.path(name).to_str().unwrap().to_owned()
    }

    fn run(&self, arguments: &[&str]) -> Ended {
        samsod(arguments)
    }

    fn spawn(&self, arguments: &[&str]) -> Process {
        let mut command = Command::new(env!("CARGO_BIN_EXE_samsod"));
        command.args(arguments);
        Process::spawn(command)
    }

    fn twin(&self) -> Process {
        let background = test_data("tables/blue_belt.jpg");
        let (table, config) = (self.text("table.json"), self.text("cell.toml"));
        self.spawn(&[
            "twin",
            "run",
            "--table",
            &table,
            "--config",
            &config,
            "--background",
            background.to_str().unwrap(),
            "--exposure",
            "1.15",
            "--rate",
            "5",
            "--wait",
            "100",
        ])
    }

    fn table(&self) -> TableState {
        TableState::read(&self.cell.path("table.json")).unwrap()
    }

    fn recording(&self) -> PathBuf {
        let files = self.cell.recordings();
        assert_eq!(files.len(), 1, "{files:?}");
        files[0].clone()
    }

    /// Checks that the table is cleared as it should be.
    fn assert_cleared(&self) {
        let score = self.run(&["twin", "score", "--table", &self.text("table.json")]);
        assert!(score.status.success(), "{score:#?}");
        assert!(score.stdout.contains("placed 2 of 2, 0 collisions, worst pick error 0."), "{}", score.stdout);
        assert!(self.table().parts.iter().all(|part| part.whereabouts == Whereabouts::Jig));
        for (part, x_mm) in [(PARTS[0], 180.0), (PARTS[1], 300.0)] {
            let placed = self.table().parts.into_iter().find(|placed| placed.name == part).unwrap();
            let off = (placed.x_mm - x_mm).hypot(placed.y_mm - 330.0);
            assert!(off < 1.0, "{part} lies {off} mm beside its slot");
        }
    }
}

/// Every command in the recording: its id, phase, and what it was.
fn commands(path: &Path) -> Vec<Value> {
    json(&messages(path), "/robot/command")
}

#[test]
fn samsodd_clears_the_table_and_every_command_is_recorded_before_its_outcome() {
    let laid = Loop::new("[robot.simulated]\ntable = \"table.json\"\n");
    let twin = laid.twin();
    let ended = laid.cell.spawn_daemon(&laid.config, &["--until-jig-is-full"]).wait();
    ended.assert_success();
    twin.terminate().assert_success();
    laid.assert_cleared();
    assert!(ended.stdout.starts_with("cell test-cell: the jig is full after"), "{}", ended.stdout);
    assert!(ended.stdout.contains("jig        2 of 2 slots filled"), "{}", ended.stdout);

    let all = messages(&laid.recording());
    let phases: Vec<_> = commands(&laid.recording()).iter().map(|c| c["phase"].as_str().unwrap().to_owned()).collect();
    let pick = ["above", "open", "down", "close", "up", "above_slot", "down_slot", "release", "up_slot"];
    let expected: Vec<_> = ["home"].into_iter().chain(pick).chain(pick).collect();
    // The way home at the end may still be under way, or not yet begun, when the service ends.
    assert_eq!(phases[..expected.len()], expected);
    let picks = json(&all, "/robot/pick");
    let placed: Vec<_> = picks.iter().map(|pick| (&pick["part"], &pick["result"])).collect();
    assert_eq!(
        placed,
        PARTS.map(|part| (Value::from(part), Value::from("placed"))).iter().map(|(a, b)| (a, b)).collect::<Vec<_>>()
    );
    let outcomes = json(&all, "/robot/outcome");
    for command in commands(&laid.recording()) {
        let of: Vec<_> =
            outcomes.iter().filter(|o| o["id"] == command["id"]).map(|o| o["outcome"].as_str().unwrap()).collect();
        assert_eq!(of, ["accepted", "done"], "{command}");
        // Every motion to a part names the frame that it follows from.
        assert_eq!(
            command["frame_sequence"].is_u64(),
            !["home", "lift"].contains(&command["phase"].as_str().unwrap()),
            "{command}"
        );
    }
}

#[test]
fn through_tcp_the_journal_of_the_controller_and_the_recording_agree_command_by_command() {
    let free = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let laid = Loop::new(&format!(
        "controller = \"motoman\"\n[robot.motoman]\naddress = \"{free}\"\n\
         part_sensor = {{ start_address = 20030, bit = 4 }}\nanswer_timeout_ms = 30000\nheader_timeout_ms = 30000\n"
    ));
    let (config, table, journal) = (laid.text("cell.toml"), laid.text("table.json"), laid.text("journal.jsonl"));
    let listen = free.to_string();
    let emulator = laid.spawn(&[
        "emulate",
        "motoman",
        "--listen",
        &listen,
        "--config",
        &config,
        "--table",
        &table,
        "--journal",
        &journal,
    ]);
    emulator.wait_for_line("listening on");
    let twin = laid.twin();
    let ended = laid.cell.spawn_daemon(&laid.config, &["--until-jig-is-full"]).wait();
    ended.assert_success();
    twin.terminate().assert_success();
    emulator.terminate().assert_success();
    laid.assert_cleared();

    let journal = fs::read_to_string(&journal).unwrap();
    let journal: Vec<Value> = journal.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let acts: Vec<&Value> = journal
        .iter()
        .filter(|entry| ["MOVJ", "MOVL", "IOWRITE"].contains(&entry["command"].as_str().unwrap()))
        .collect();
    let commands = commands(&laid.recording());
    assert_eq!(acts.len(), commands.len(), "every command once");
    for (act, command) in acts.iter().zip(&commands) {
        let kind = match (command["command"].as_str().unwrap(), command["motion"].as_str()) {
            ("move", Some("joint")) => "MOVJ",
            ("move", Some("linear")) => "MOVL",
            _ => "IOWRITE",
        };
        assert_eq!(act["command"], kind, "{command} is {act}");
        if kind != "IOWRITE" {
            let fields: Vec<f64> =
                act["data"].as_str().unwrap().split(',').map(|f| f.trim().parse().unwrap()).collect();
            let at = if kind == "MOVL" { 3 } else { 2 };
            for (field, key) in fields[at..at + 3].iter().zip(["x_mm", "y_mm", "z_mm"]) {
                assert!((field - command["target"][key].as_f64().unwrap()).abs() < 1e-3, "{command} is {act}");
            }
        }
    }
    // Every byte of it is in the recording.
    let wire = json(&messages(&laid.recording()), "/robot/wire");
    let sent: String =
        wire.iter().filter(|line| line["direction"] == "sent").map(|line| line["bytes"].as_str().unwrap()).collect();
    for kind in ["MOVJ", "MOVL", "IOWRITE"] {
        let journalled = acts.iter().filter(|act| act["command"] == kind).count();
        assert_eq!(sent.matches(&format!("HOSTCTRL_REQUEST {kind} ")).count(), journalled, "{kind}");
    }
}

#[test]
fn an_operators_hold_stands_until_a_resume_and_then_the_table_is_cleared() {
    let laid = Loop::new("[robot.simulated]\ntable = \"table.json\"\n");
    let daemon = laid.cell.spawn_daemon(&laid.config, &[]);
    daemon.wait_for_line("ready, waiting for frames");
    let ask = |command: &[&str]| laid.run(&[command, &["--config", &laid.text("cell.toml")]].concat());
    let stands = ask(&["hold"]);
    stands.assert_success();
    assert!(
        stands.stdout.contains("stands until resumed: hold by an operator; the gripper is empty"),
        "{}",
        stands.stdout
    );

    let mut scenes = laid.cell.scenes();
    let twin = laid.twin();
    // Whatever is seen, nothing moves.
    let seen = (0..3).map(|_| scenes.next()).find(|scene| scene["object_count"] == 2);
    assert!(seen.is_some(), "two parts lie there");
    let status = ask(&["status"]);
    assert!(status.stdout.contains("0 of 2 slots filled"), "{}", status.stdout);
    assert_eq!(laid.table().picks, []);

    let resumed = ask(&["resume"]);
    assert!(resumed.stdout.contains("begins from home") || resumed.stdout.contains("at work"), "{}", resumed.stdout);
    wait_for("a full jig", || ask(&["status"]).stdout.contains("the jig is full").then_some(()));
    twin.terminate().assert_success();
    laid.assert_cleared();
    assert!(ask(&["resume"]).stderr.contains("no fault is latched"));
    let again = ask(&["new-jig"]);
    assert!(again.stdout.contains("0 of 2 slots filled"), "{again:?}");
    daemon.terminate().assert_success();
    let gone = ask(&["status"]);
    assert!(!gone.status.success() && gone.stderr.contains("no samsodd answers for cell \"test-cell\""), "{gone:?}");
}

#[test]
fn a_part_in_the_gripper_is_told_when_samsodd_ends() {
    let laid = Loop::new("[robot.simulated]\ntable = \"table.json\"\n");
    // The way up with the part takes some seconds.
    let text =
        fs::read_to_string(&laid.config).unwrap().replace("linear_speed_mm_s = 500.0", "linear_speed_mm_s = 20.0");
    fs::write(&laid.config, text).unwrap();
    let twin = laid.twin();
    let daemon = laid.cell.spawn_daemon(&laid.config, &[]);
    daemon.wait_for_line("phase=up with the part");
    let ended = daemon.terminate();
    ended.assert_success();
    twin.terminate().assert_success();
    let part = laid.table().parts.into_iter().find(|part| part.whereabouts == Whereabouts::Gripper).unwrap().name;
    assert!(ended.stdout.contains(&format!("stopped    the gripper holds the {part}")), "{}", ended.stdout);
    assert!(ended.stderr.contains("work is cut short, the robot is left on hold"), "{}", ended.stderr);
    support::assert_closed(&laid.recording());
    let all = messages(&laid.recording());
    let faults = json(&all, "/robot/fault");
    assert_eq!(faults.len(), 1, "{faults:?}");
    let held = (&faults[0]["phase"], &faults[0]["holds"]["gripper"], &faults[0]["holds"]["part"]);
    assert_eq!(held, (&"up".into(), &"part".into(), &part.as_str().into()), "{faults:?}");
    let outcomes = json(&all, "/robot/outcome");
    assert_eq!(outcomes.last().unwrap()["outcome"], "aborted", "{outcomes:?}");
}

#[test]
fn a_robot_that_is_not_armed_is_looked_at_and_not_moved() {
    let free = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let laid = Loop::new(&format!("controller = \"motoman\"\n[robot.motoman]\naddress = \"{free}\"\n"));
    let text = fs::read_to_string(&laid.config).unwrap().replace("armed = true", "armed = false");
    fs::write(&laid.config, text).unwrap();
    let journal = laid.text("journal.jsonl");
    let emulator = laid.spawn(&["emulate", "motoman", "--listen", &free.to_string(), "--journal", &journal]);
    emulator.wait_for_line("listening on");
    let daemon = laid.cell.spawn_daemon(&laid.config, &["--until-jig-is-full"]);
    let ended = daemon.wait();
    assert_eq!(ended.status.code(), Some(5), "{ended:#?}");
    assert!(ended.stdout.contains("armed = true is missing"), "{}", ended.stdout);
    emulator.terminate().assert_success();
    let journal = fs::read_to_string(&journal).unwrap();
    assert!(journal.contains("RSTATS") && !journal.contains("MOV") && !journal.contains("IOWRITE"), "{journal}");
}
