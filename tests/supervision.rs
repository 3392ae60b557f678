//! samsodd as others watch it: health and metrics over HTTP, parts that are stuck, what systemd is told.

#![allow(clippy::expect_used, clippy::panic, reason = "helpers of tests fail by panicking")]

mod support;

use std::net::{TcpListener, TcpStream};
use std::os::unix::net::UnixDatagram;
use std::path::PathBuf;
use std::sync::mpsc::{self, Receiver};
use std::thread;
use std::time::Duration;

use samsod_frame::{FrameHeader, PixelFormat};
use support::{HTTP, TestCell, WATCHDOG, address_of, get, metric, send, wait_for};

fn health(address: &str) -> (u16, serde_json::Value) {
    let (code, body) = get(address, "/healthz");
    (code, serde_json::from_str(&body).unwrap_or_else(|e| panic!("{e}: {body}")))
}

#[test]
fn metrics_say_what_the_report_says_at_the_end() {
    let cell = TestCell::new();
    let daemon = cell.spawn_daemon(&cell.config(&[HTTP]), &[]);
    let address = address_of(&daemon);
    let (code, before) = health(&address);
    assert_eq!((code, &before["status"], &before["cell"]), (200, &"ok".into(), &"test-cell".into()), "{before}");
    assert_eq!(before["parts"]["frames"]["state"], "waiting", "{before}");
    assert_eq!(before["parts"]["recorder"]["state"], "recording", "{before}");

    let mut scenes = cell.scenes();
    let mut publisher = cell.publisher();
    for number in 0..3 {
        send(&mut publisher, number);
        scenes.of_frame(number.into());
    }
    let lie = FrameHeader { width: 4, height: 4, stride: 12, pixel_format: 77, ..FrameHeader::default() };
    publisher.loan_raw(lie, 48).unwrap().send().unwrap();
    daemon.wait_for_line("pixel format 77 is unknown");
    // The arm goes above what it sees, and stands again.
    let text = wait_for("numbers of all frames, and a robot at rest", || {
        let (code, text) = get(&address, "/metrics");
        assert_eq!(code, 200, "{text}");
        let value = |name| metric(&text, name).unwrap_or_else(|| panic!("{name}: {text}"));
        let rests = value("samsod_commands_total{outcome=\"done\"}") == value("samsod_commands_sent_total");
        let is_counted = value("samsod_frames_rejected_total{reason=\"header\"}") == 1.0
            && value("samsod_recorder_frames_total{result=\"written\"}") == 3.0;
        (rests && is_counted && value("samsod_robot_moving") == 0.0).then_some(text)
    });
    let value = |name: &str| metric(&text, name).unwrap_or_else(|| panic!("{name}: {text}"));
    for stage in ["segment", "saliency", "regions", "shadow", "total", "record"] {
        assert_eq!(value(&format!("samsod_stage_seconds_count{{stage=\"{stage}\"}}")), 3.0, "{stage}");
    }
    assert!(value("samsod_stage_seconds_sum{stage=\"total\"}") > 0.0);
    assert_eq!(value("samsod_stage_seconds_bucket{le=\"+Inf\",stage=\"total\"}"), 3.0);
    // The last frame was refused.
    for (part, ok) in [("frames", 0.0), ("vision", 1.0), ("recorder", 1.0), ("robot", 1.0)] {
        assert_eq!(value(&format!("samsod_part_ok{{part=\"{part}\"}}")), ok, "{part}");
    }
    assert_eq!((value("samsod_robot_connected"), value("samsod_robot_latched")), (1.0, 0.0));
    assert!(value("samsod_disk_free_bytes") > 0.0);
    assert!(value("samsod_recorder_written_bytes_total") > 0.0);
    assert_eq!(value("samsod_recorder_queue_frames"), 0.0);
    assert!(text.ends_with("# EOF\n"), "{text}");
    assert_eq!(get(&address, "/elsewhere").0, 404);

    let ended = daemon.terminate();
    ended.assert_success();
    for (name, line, column) in [
        ("samsod_frames_received_total", "frames", "received"),
        ("samsod_frames_processed_total", "frames", "processed"),
        ("samsod_frames_dropped_total", "frames", "dropped"),
        ("samsod_frames_rejected_total{reason=\"header\"}", "frames", "rejected"),
    ] {
        assert_eq!(value(name), ended.count(line, column) as f64, "{name}: {}", ended.stdout);
    }
    // The robot may have taken one more place since.
    let sent = value("samsod_commands_sent_total");
    assert!(sent >= 1.0 && sent <= ended.count("commands", "sent") as f64, "{sent}: {}", ended.stdout);
    assert!(TcpStream::connect(&address).is_err(), "nobody listens any more");
}

#[test]
fn a_port_that_is_taken_is_named_and_nothing_is_begun() {
    let cell = TestCell::new();
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = taken.local_addr().unwrap().to_string();
    let ended = cell.spawn_daemon(&cell.config(&[("http", &format!("listen = \"{address}\""))]), &[]).wait();
    assert_eq!(ended.status.code(), Some(1), "{ended:?}");
    let expected = format!("cannot serve page, health and metrics on {address}: Address already in use");
    assert!(ended.stderr.contains(&expected) && ended.stderr.contains("[http] listen takes"), "{}", ended.stderr);
    assert!(!cell.path("recordings").exists(), "it has touched nothing");
}

#[test]
fn an_address_that_is_none_is_refused() {
    let cell = TestCell::new();
    let ended = cell.spawn_daemon(&cell.config(&[("http", "listen = \"localhost\"")]), &[]).wait();
    assert_eq!(ended.status.code(), Some(2), "{ended:?}");
    assert!(ended.stderr.contains("listen = \"localhost\""), "{}", ended.stderr);
}

#[test]
fn a_latched_robot_is_seen_from_outside() {
    let cell = TestCell::new();
    let daemon = cell.spawn_daemon(&cell.config(&[HTTP]), &[]);
    let address = address_of(&daemon);
    let config = cell.path("cell.toml");
    support::samsod(&["hold", "--config", config.to_str().unwrap()]).assert_success();
    let (_, seen) = health(&address);
    assert_eq!(seen["parts"]["robot"]["state"], "faulted", "{seen}");
    assert_eq!(metric(&get(&address, "/metrics").1, "samsod_robot_latched"), Some(1.0));
    support::samsod(&["resume", "--config", config.to_str().unwrap()]).assert_success();
    assert_eq!(metric(&get(&address, "/metrics").1, "samsod_robot_latched"), Some(0.0));
    daemon.terminate().assert_success();
}

#[test]
fn frames_that_stop_are_told_once_and_so_is_their_return() {
    let cell = TestCell::new();
    let config = cell.config(&[HTTP, ("frames", "stalled_after_ms = 300")]);
    let daemon = cell.spawn_daemon(&config, &[]);
    let address = address_of(&daemon);
    let mut publisher = cell.publisher();
    send(&mut publisher, 0);
    let line = daemon.wait_for_line("part is not well");
    assert!(line.contains("part=\"frames\"") && line.contains("state=\"stalled\""), "{line}");
    let (code, seen) = health(&address);
    assert_eq!((code, &seen["status"]), (503, &"frames stalled".into()), "{seen}");
    assert!(seen["parts"]["frames"]["pulse_age_ms"].as_u64().unwrap() > 300, "{seen}");
    let client = cell.spawn_client(&cell.images(2), &["--rate", "50", "--loop"]);
    let line = daemon.wait_for_line("part is well again");
    assert!(line.contains("part=\"frames\""), "{line}");
    client.terminate().assert_success();
    daemon.wait_for_line("state=\"stalled\"");
    let ended = daemon.terminate();
    ended.assert_success();
    let of_frames = |line: &str| line.contains("not well") && line.contains("part=\"frames\"");
    assert!(!ended.stderr.lines().any(of_frames), "told once: {}", ended.stderr);
}

/// A socket that stands in for systemd's, and what comes in. It is read all the time: samsodd waits when it is full.
struct ServiceManager {
    messages: Receiver<String>,
    path: PathBuf,
}

impl ServiceManager {
    fn new(cell: &TestCell) -> Self {
        let path = cell.path("notify");
        let socket = UnixDatagram::bind(&path).expect("socket");
        let (sender, messages) = mpsc::channel();
        // Ends with the test program, or when the test is over and something more comes in.
        thread::spawn(move || {
            let mut buffer = [0; 4096];
            while let Ok(len) = socket.recv(&mut buffer) {
                let message = String::from_utf8_lossy(&buffer[..len]).trim_end().to_owned();
                if sender.send(message).is_err() {
                    return;
                }
            }
        });
        Self { messages, path }
    }

    /// Reads on until a message that `is_it`; returns all up to it.
    fn wait_for(&self, is_it: impl Fn(&str) -> bool) -> Vec<String> {
        let mut all = Vec::new();
        loop {
            all.push(self.messages.recv_timeout(WATCHDOG).expect("a message"));
            if is_it(&all[all.len() - 1]) {
                return all;
            }
        }
    }
}

#[test]
fn systemd_hears_that_it_is_ready_alive_and_ending() {
    let cell = TestCell::new();
    let manager = ServiceManager::new(&cell);
    let daemon = cell.spawn_notifying_daemon(&cell.config(&[]), &manager.path, Duration::from_millis(300));
    manager.wait_for(|message| message == "READY=1");
    manager.wait_for(|message| message == "WATCHDOG=1");
    let mut scenes = cell.scenes();
    let mut publisher = cell.publisher();
    send(&mut publisher, 0);
    scenes.of_frame(0);
    manager.wait_for(|message| message == "WATCHDOG=1");
    daemon.signal("TERM");
    let last = manager.wait_for(|message| message == "STOPPING=1");
    assert!(last.iter().all(|message| message != "READY=1"), "{last:?}");
    daemon.wait().assert_success();
}

#[test]
fn a_stuck_part_is_named_everywhere_and_starves_the_watchdog_until_it_moves_again() {
    let cell = TestCell::new();
    let manager = ServiceManager::new(&cell);
    // The reference saliency takes its time: for this patience, vision is stuck.
    let slow = [HTTP, ("saliency", "method = \"exact\""), ("supervision", "stuck_after_ms = 500")];
    let daemon = cell.spawn_notifying_daemon(&cell.config(&slow), &manager.path, Duration::from_millis(100));
    let address = address_of(&daemon);
    let mut publisher = cell.publisher();
    let mut loan = publisher.loan(640, 480, PixelFormat::Rgb8).unwrap();
    for (i, byte) in loan.pixels().iter_mut().enumerate() {
        *byte = ((i / 3 % 640 / 40 + i / 1920 / 40) * 67 % 251) as u8;
    }
    loan.send().unwrap();
    let line = daemon.wait_for_line("part is stuck");
    assert!(line.contains("part=\"vision\""), "{line}");
    let (code, seen) = health(&address);
    assert_eq!((code, &seen["status"]), (503, &"vision stuck".into()), "{seen}");
    let names_vision = |message: &str| message.starts_with("STATUS=") && message.contains("vision stuck");
    manager.wait_for(names_vision);
    let until_well = manager.wait_for(|message| message.starts_with("STATUS=") && !names_vision(message));
    assert!(until_well.iter().all(|message| message != "WATCHDOG=1"), "{until_well:?}");
    let line = daemon.wait_for_line("part is well again");
    assert!(line.contains("part=\"vision\"") && line.contains("was=\"stuck\""), "{line}");
    manager.wait_for(|message| message == "WATCHDOG=1");
    let ended = daemon.terminate();
    ended.assert_success();
    assert_eq!(ended.count("frames", "processed"), 1);
}
