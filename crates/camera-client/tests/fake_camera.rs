//! `samsod-camera` and Aravis' fake GigE camera, over real GVCP and GVSP on loopback: processes, sockets and shared memory.

#![cfg(feature = "aravis")]
#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests fail by panicking, too")]

use std::fs::{self, File};
use std::io::{BufRead, BufReader};
use std::path::PathBuf;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::{Arc, Mutex};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use samsod_frame::{Frame, FrameServiceConfig, FrameSubscriber, PixelFormat};
use tempfile::TempDir;

/// Long enough for any machine: a test that needs it has failed.
const WATCHDOG: Duration = Duration::from_secs(30);
const FAKE: &str = "arv-fake-gv-camera-0.8";

/// There is one port for GigE Vision and one loopback address: one fake camera at a time, of all tests of this machine.
fn the_only_camera() -> File {
    let lock = File::create(std::env::temp_dir().join("samsod-fake-camera.lock")).unwrap();
    lock.lock().unwrap();
    lock
}

/// A process that does not outlive its test.
struct Process(Child);

impl Process {
    /// As a plug that is pulled.
    fn kill(mut self) {
        self.0.kill().unwrap();
        self.0.wait().unwrap();
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// A camera that loses so many of a thousand packets.
fn fake_camera(lost_per_thousand: u32) -> Process {
    let lost = lost_per_thousand.to_string();
    let started = Command::new(FAKE)
        .args(["-i", "127.0.0.1", "-s", "SAMSOD", "-r", &lost])
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn();
    Process(started.unwrap_or_else(|e| panic!("{FAKE}: {e}; it is in Debian's aravis-tools")))
}

/// A folder with the configuration of a client, and the cell that it sends to.
struct Bench {
    folder: TempDir,
    cell: FrameServiceConfig,
}

impl Bench {
    fn new() -> Self {
        let folder = tempfile::Builder::new().prefix("cam").tempdir().unwrap();
        let root_path = Some(folder.path().to_owned());
        // Many may wait: a test on a busy machine looks at every frame.
        let cell = FrameServiceConfig { root_path, buffer_frames: 16, ..FrameServiceConfig::for_cell("fake-camera") };
        Self { folder, cell }
    }

    /// Writes a configuration; `keys` are those of `[camera]`, and whole sections after them.
    fn config(&self, keys: &str) -> PathBuf {
        let path = self.folder.path().join("camera-client.toml");
        let root = self.folder.path().display();
        let text = format!(
            "[cell]\nname = \"fake-camera\"\nroot_path = \"{root}\"\nbuffer_frames = 16\n[report]\nevery_s = 1\n\
             [camera]\ndevice = \"Aravis-Fake-SAMSOD\"\nname = \"top\"\n{keys}\n"
        );
        fs::write(&path, text).unwrap();
        path
    }

    fn subscriber(&self) -> FrameSubscriber {
        FrameSubscriber::open(&self.cell).unwrap()
    }

    fn start(&self, keys: &str) -> Client {
        Client::start(&self.config(keys))
    }
}

/// `samsod-camera`, and what it has told so far.
struct Client {
    process: Process,
    log: Arc<Mutex<String>>,
    reader: JoinHandle<()>,
}

impl Client {
    fn start(config: &std::path::Path) -> Self {
        let mut child = Command::new(env!("CARGO_BIN_EXE_samsod-camera"))
            .args(["--config", config.to_str().unwrap()])
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let lines = BufReader::new(child.stderr.take().unwrap()).lines();
        let log = Arc::new(Mutex::new(String::new()));
        let told = Arc::clone(&log);
        let reader = thread::spawn(move || {
            for line in lines.map_while(Result::ok) {
                let mut told = told.lock().unwrap();
                told.push_str(&without_colours(&line));
                told.push('\n');
            }
        });
        Self { process: Process(child), log, reader }
    }

    fn log(&self) -> String {
        self.log.lock().unwrap().clone()
    }

    /// Waits until a line says so.
    fn wait_for(&self, text: &str) {
        let start = Instant::now();
        while !self.log().contains(text) {
            assert!(start.elapsed() < WATCHDOG, "{text}: {}", self.log());
            thread::sleep(Duration::from_millis(10));
        }
    }

    /// Waits for its end.
    fn wait(mut self) -> (ExitStatus, String) {
        let start = Instant::now();
        let status = loop {
            if let Some(status) = self.process.0.try_wait().unwrap() {
                break status;
            }
            assert!(start.elapsed() < WATCHDOG, "it goes on: {}", self.log());
            thread::sleep(Duration::from_millis(10));
        };
        self.reader.join().unwrap();
        let log = self.log.lock().unwrap().clone();
        (status, log)
    }

    /// Ends it as systemd does; what it counted: sent, incomplete, missing.
    fn terminate(self) -> [u64; 3] {
        let id = self.process.0.id().to_string();
        assert!(Command::new("kill").args(["-TERM", &id]).status().unwrap().success());
        let (status, log) = self.wait();
        assert!(status.success(), "{status}: {log}");
        let last = log.lines().rfind(|line| line.contains("ended")).unwrap_or_else(|| panic!("{log}"));
        let number = |key: &str| {
            let word = last.split_whitespace().find_map(|word| word.strip_prefix(key));
            word.and_then(|number| number.parse().ok()).unwrap_or_else(|| panic!("{key}: {last}"))
        };
        [number("sent="), number("incomplete="), number("missing=")]
    }
}

fn without_colours(line: &str) -> String {
    let mut plain = String::new();
    let mut escaped = false;
    for c in line.chars() {
        match c {
            '\u{1b}' => escaped = true,
            'm' if escaped => escaped = false,
            c if !escaped => plain.push(c),
            _ => {}
        }
    }
    plain
}

fn next(subscriber: &mut FrameSubscriber, client: &Client) -> Frame {
    let start = Instant::now();
    loop {
        if let Some(frame) = subscriber.wait(Duration::from_millis(200)).unwrap() {
            return frame;
        }
        assert!(start.elapsed() < WATCHDOG, "no frame: {}", client.log());
    }
}

/// The picture of the fake camera: a ramp that moves with the number of the frame. At 10 ms and without gain it is not scaled.
fn assert_whole(frame: &Frame) {
    let (width, stride) = (frame.layout().width() as usize, frame.layout().stride());
    let number = frame.header().camera_frame as usize;
    for (y, row) in frame.bytes().chunks(stride).enumerate() {
        for (x, level) in row[..width].iter().enumerate() {
            let expected = ((x + y + number) % 255) as u8;
            assert_eq!(*level, expected, "frame {number} at {x}, {y}");
        }
    }
}

const PLAIN: &str = "pixel_format = \"mono8\"\nexposure_us = 10000\ngain = 0.0\nframe_rate_hz = 20";

#[test]
fn frames_arrive_whole_and_in_order() {
    let _only = the_only_camera();
    let bench = Bench::new();
    let mut subscriber = bench.subscriber();
    let _camera = fake_camera(0);
    let client = bench.start(&format!("{PLAIN}\nwidth_px = 320\nheight_px = 200"));
    let mut last: Option<Frame> = None;
    for _ in 0..30 {
        let frame = next(&mut subscriber, &client);
        assert_eq!((frame.camera(), frame.layout().format()), ("top", PixelFormat::Mono8));
        assert_eq!((frame.layout().width(), frame.layout().height()), (320, 200));
        assert_whole(&frame);
        let header = *frame.header();
        assert!(header.timestamp_ns > 0 && frame.latency().is_some(), "not from the future");
        if let Some(before) = last.as_ref().map(|frame| *frame.header()) {
            // The fake camera's numbers are short, and end soon.
            let order = header.camera_frame > before.camera_frame || before.camera_frame > 65_500;
            assert!(order && header.sequence > before.sequence, "{before:?}, then {header:?}");
            assert!(header.camera_time_ns > before.camera_time_ns && header.timestamp_ns > before.timestamp_ns);
        }
        last = Some(frame);
    }
    drop(last);
    client.wait_for("status");
    let [sent, ..] = client.terminate();
    while subscriber.wait(Duration::from_millis(50)).unwrap().is_some() {}
    let counts = subscriber.counts();
    assert_eq!(counts.received + counts.dropped, sent, "every frame is accounted for: {counts:?}");
    assert_eq!((counts.rejected, counts.publishers), (0, 1));
}

#[test]
fn settings_reach_the_camera() {
    let _only = the_only_camera();
    let bench = Bench::new();
    let mut subscriber = bench.subscriber();
    let _camera = fake_camera(0);
    // Ten times the exposure: the fake camera doubles its levels.
    let keys = "pixel_format = \"mono8\"\nexposure_us = 100000.0\ngain = 0\nwidth_px = 256\nheight_px = 64\n\
                frame_rate_hz = 10\n[gige]\npacket_size = 1000\npacket_delay_ns = 1000";
    let client = bench.start(keys);
    let frame = next(&mut subscriber, &client);
    let number = frame.header().camera_frame as usize;
    for (x, level) in frame.bytes()[..256].iter().enumerate() {
        assert_eq!(usize::from(*level), ((x + number) % 255 * 2).min(255), "frame {number} at {x}");
    }
    drop(frame);
    client.wait_for("exposure too long by a factor of at least");
    client.terminate();

    let client = bench.start("pixel_format = \"bayer_gb8\"\nframe_rate_hz = 10");
    let frame = loop {
        let frame = next(&mut subscriber, &client);
        if frame.layout().format() != PixelFormat::Mono8 {
            break frame;
        }
    };
    assert_eq!(frame.layout().format(), PixelFormat::BayerGb8);
    assert!(frame.is_from_new_publisher());
    client.terminate();
}

#[test]
fn no_frame_that_lost_packets_reaches_the_cell() {
    let _only = the_only_camera();
    let bench = Bench::new();
    let mut subscriber = bench.subscriber();
    // One packet in a hundred, and small packets: every second frame loses one or more, and none is sent again.
    let _camera = fake_camera(10);
    let client = bench.start(&format!(
        "{PLAIN}\nwidth_px = 240\nheight_px = 200\n[gige]\npacket_size = 700\nresend = false\nframe_retention_ms = 50"
    ));
    for _ in 0..25 {
        assert_whole(&next(&mut subscriber, &client));
    }
    client.wait_for("frames lost between the camera and here");
    let [sent, incomplete, _] = client.terminate();
    while let Some(frame) = subscriber.wait(Duration::from_millis(50)).unwrap() {
        assert_whole(&frame);
    }
    assert!(incomplete > 0, "{sent} were sent");
    let counts = subscriber.counts();
    assert_eq!(counts.received + counts.dropped, sent);
}

#[test]
fn a_camera_that_was_killed_comes_back_by_itself() {
    let _only = the_only_camera();
    let bench = Bench::new();
    let mut subscriber = bench.subscriber();
    let camera = fake_camera(0);
    let client = bench.start(&format!("{PLAIN}\nwidth_px = 320\nheight_px = 200"));
    let mut before = None;
    for _ in 0..15 {
        before = Some(*next(&mut subscriber, &client).header());
    }
    camera.kill();
    client.wait_for("camera is gone; it is looked for");
    while let Some(frame) = subscriber.wait(Duration::from_millis(50)).unwrap() {
        before = Some(*frame.header());
    }
    let _camera = fake_camera(0);
    let back = Instant::now();
    let frame = next(&mut subscriber, &client);
    println!("frames again {} ms after the camera was started", back.elapsed().as_millis());
    assert_whole(&frame);
    let before = before.unwrap();
    assert!(frame.sequence() > before.sequence && !frame.is_from_new_publisher(), "numbers go on");
    assert!(frame.header().camera_frame < before.camera_frame, "those of the camera begin anew: {:?}", frame.header());
    drop(frame);
    client.terminate();
}

#[test]
fn a_camera_that_comes_late_is_waited_for() {
    let _only = the_only_camera();
    let bench = Bench::new();
    let mut subscriber = bench.subscriber();
    let client = bench.start(PLAIN);
    client.wait_for("no camera; it is looked for");
    let _camera = fake_camera(0);
    assert_whole(&next(&mut subscriber, &client));
    client.terminate();
}

#[test]
fn what_the_camera_does_not_take_is_refused_with_code_2() {
    let _only = the_only_camera();
    let bench = Bench::new();
    let _camera = fake_camera(0);
    for (keys, expected) in [
        ("exposure_us = 59000000.0", ["[camera] exposure_us = 59000000; allowed: ", " with this camera as it is set"]),
        ("gain = \"nothing\"", ["\"nothing\" is not allowed", "or \"auto\""]),
        ("width_px = 16000", ["[camera] width_px = 16000; allowed: 1 to ", " with this camera as it is set"]),
        ("frame_rate_hz = 9999", ["[camera] frame_rate_hz = 9999; allowed: ", " with this camera as it is set"]),
        ("trigger = \"Line77\"", ["[camera] trigger = \"Line77\"; allowed: \"off\", ", " with this camera"]),
        ("pixel_format = \"bgr8\"", ["[camera] pixel_format = \"bgr8\"; allowed: ", "\"mono8\" with this camera"]),
    ] {
        let (status, log) = bench.start(keys).wait();
        assert_eq!(status.code(), Some(2), "{keys}: {log}");
        assert!(expected.iter().all(|part| log.contains(part)), "{keys}: {log}");
    }
}

#[test]
fn a_camera_can_be_triggered_by_the_client() {
    let _only = the_only_camera();
    let bench = Bench::new();
    let mut subscriber = bench.subscriber();
    let _camera = fake_camera(0);
    let keys =
        "pixel_format = \"mono8\"\nexposure_us = 10000.0\ngain = 0.0\ntrigger = \"Software\"\ntrigger_rate_hz = 8.0";
    let client = bench.start(keys);
    for _ in 0..4 {
        assert_whole(&next(&mut subscriber, &client));
    }
    client.terminate();
}
