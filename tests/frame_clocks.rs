//! Clients whose clocks step or whose numbers run back, and frames that cannot be looked at: named in log and health, kept from the
//! robot, and over with the next good frame.

#![allow(clippy::expect_used, clippy::unwrap_used, clippy::panic, reason = "helpers of tests fail by panicking")]

mod support;

use samsod_frame::{FrameHeader, FramePublisher, PixelFormat, unix_time_ns};
use support::{HTTP, Process, Scenes, TestCell, address_of, count, get, json, messages, picture, send, wait_for};

const SECOND: u64 = 1_000_000_000;

/// State and detail of the frames in the health answer, and its code.
fn frames(address: &str) -> (u16, String, String) {
    let (code, body) = get(address, "/healthz");
    let health: serde_json::Value = serde_json::from_str(&body).expect("JSON");
    let text = |key: &str| health["parts"]["frames"][key].as_str().unwrap_or_default().to_owned();
    (code, text("state"), text("detail"))
}

struct Watched {
    cell: TestCell,
    daemon: Process,
    address: String,
    publisher: FramePublisher,
    scenes: Scenes,
}

impl Watched {
    fn start() -> Self {
        let cell = TestCell::new();
        let daemon = cell.spawn_daemon(&cell.config(&[HTTP]), &[]);
        let address = address_of(&daemon);
        let (publisher, scenes) = (cell.publisher(), cell.scenes());
        Self { cell, daemon, address, publisher, scenes }
    }

    /// Sends a picture of a time, and waits for its scene.
    fn send_at(&mut self, timestamp_ns: u64) {
        let sequence = self.publisher.sent();
        let image = picture(sequence as u32);
        let mut loan = self.publisher.loan(64, 48, PixelFormat::Rgb8).expect("loan");
        loan.pixels().copy_from_slice(&image);
        loan.set_timestamp_ns(timestamp_ns);
        loan.send().expect("send");
        self.scenes.of_frame(sequence);
    }

    /// Waits until health says so of the frames; returns the detail.
    fn wait_for_state(&self, state: &str) -> String {
        let ill = wait_for(state, || {
            let (code, now, detail) = frames(&self.address);
            (now == state).then_some((code, detail))
        });
        assert_eq!(ill.0, if state == "flowing" { 200 } else { 503 }, "{ill:?}");
        ill.1
    }
}

#[test]
fn a_clock_that_steps_keeps_its_frames_from_the_robot_until_it_is_right_again() {
    let mut cell = Watched::start();
    // An hour ahead: seen and recorded, and nothing is gone to.
    cell.send_at(unix_time_ns() + 3600 * SECOND);
    let line = cell.daemon.wait_for_line("clock of the frame client is");
    assert!(line.contains("frame=0 client=1") && line.contains("state=\"clock ahead\""), "{line}");
    assert!(cell.wait_for_state("clock ahead").contains("ms ahead; the robot is not shown it"));
    // It is set right, which is a step back.
    cell.send_at(unix_time_ns());
    let line = cell.daemon.wait_for_line("has stepped back by");
    assert!(line.contains("frame=1"), "{line}");
    cell.wait_for_state("clock stepped back");
    // Far behind.
    cell.send_at(unix_time_ns() - 3600 * SECOND);
    cell.send_at(unix_time_ns() - 3599 * SECOND);
    let line = cell.daemon.wait_for_line("ms old, [robot.limits] target_age_max_ms allows 10000");
    assert!(line.contains("frame=3") && line.contains("state=\"too old\""), "{line}");
    cell.wait_for_state("too old");
    // Right again: at once in force.
    cell.send_at(unix_time_ns());
    let line = cell.daemon.wait_for_line("frames are believed again");
    assert!(line.contains("frame=4") && line.contains("was=\"too old\""), "{line}");
    cell.wait_for_state("flowing");
    let line = cell.daemon.wait_for_line("command given");
    assert!(line.contains("frame=4"), "{line}");
    let ended = cell.daemon.terminate();
    ended.assert_success();
    assert_eq!(ended.count("frames", "processed"), 5);
    let recorded = messages(&cell.cell.recordings()[0]);
    assert_eq!(count(&recorded, "/camera/image"), 5, "all are recorded");
    let commands = json(&recorded, "/robot/command");
    assert!(!commands.is_empty() && commands.iter().all(|command| command["frame_sequence"] == 4), "{commands:?}");
}

#[test]
fn numbers_that_run_back_and_frames_that_cannot_be_looked_at_are_named() {
    let mut cell = Watched::start();
    for sequence in [7, 7, 3] {
        cell.publisher.number_from(sequence);
        cell.send_at(unix_time_ns());
    }
    let line = cell.daemon.wait_for_line("its number is not above that of the frame before it, 7");
    assert!(line.contains("frame=7") && line.contains("state=\"numbers run back\""), "{line}");
    cell.wait_for_state("numbers run back");
    cell.send_at(unix_time_ns());
    let line = cell.daemon.wait_for_line("frames are believed again");
    assert!(line.contains("frame=4"), "{line}");
    cell.wait_for_state("flowing");
    // A header that lies.
    let lie = FrameHeader { width: 4, height: 4, stride: 12, pixel_format: 77, ..FrameHeader::default() };
    cell.publisher.loan_raw(lie, 48).unwrap().send().unwrap();
    let line = cell.daemon.wait_for_line("frame rejected");
    assert!(line.contains("frame=5"), "{line}");
    assert!(cell.wait_for_state("refused").contains("pixel format 77 is unknown"));
    cell.send_at(unix_time_ns());
    cell.wait_for_state("flowing");
    let ended = cell.daemon.terminate();
    ended.assert_success();
    assert_eq!((ended.count("frames", "processed"), ended.count("frames", "rejected")), (5, 1));
}

#[test]
fn a_client_that_is_started_anew_is_another_one() {
    let cell = TestCell::new();
    let daemon = cell.spawn_daemon(&cell.config(&[("log", "level = \"debug\"")]), &[]);
    daemon.wait_for_line("ready, waiting for frames");
    for client in 1..=2 {
        let (mut scenes, mut publisher) = (cell.scenes(), cell.publisher());
        send(&mut publisher, 0);
        scenes.of_frame(0);
        // Its numbers begin at 0 again, which is no doubt.
        let line = daemon.wait_for_line(" seen frame=0");
        assert!(line.contains(&format!("client={client} camera=\"test\"")), "{line}");
    }
    daemon.terminate().assert_success();
}
