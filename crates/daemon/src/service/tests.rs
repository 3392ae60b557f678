//! What no input is known to bring about, and no disk does when it is asked to: a vision chain that panics, a write that hangs.

use std::fs;
use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::path::Path;
use std::sync::atomic::Ordering;
use std::thread;

use samsod_frame::{CameraId, FramePublisher, FrameServiceConfig, PixelFormat, SceneSubscriber};
use samsod_robot::SequenceState;

use super::*;
use crate::control::{self, Request};
use crate::recording::faults::{self, Fault};
use crate::recording::{self, Survey};

const PATIENCE: Duration = Duration::from_secs(120);

/// The camera whose frame 1 panics.
const PANICS: &str = "panics";

pub(super) fn panic_if_asked(camera: &str, sequence: u64) {
    assert!(camera != PANICS || sequence != 1, "a panic on purpose");
}

/// Ends the service when the test does, also by a failure.
struct Stop<'a>(&'a AtomicBool);

impl Drop for Stop<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::SeqCst);
    }
}

fn wait_for(what: &str, mut condition: impl FnMut() -> bool) {
    let deadline = Instant::now() + PATIENCE;
    while !condition() {
        assert!(Instant::now() < deadline, "{what}: not within {PATIENCE:?}");
        thread::yield_now();
    }
}

fn pixel(number: u8) -> [u8; 3] {
    [100 + number, 120, 140]
}

fn send(publisher: &mut FramePublisher, number: u8) {
    let mut loan = publisher.loan(48, 32, PixelFormat::Rgb8).unwrap();
    loan.pixels().copy_from_slice(&pixel(number).repeat(48 * 32));
    loan.send().unwrap();
}

fn wait_for_scene(scenes: &mut SceneSubscriber, sequence: u64) {
    wait_for("scene", || {
        let scene = scenes.wait(PATIENCE).unwrap();
        scene.is_some_and(|scene| scene.header().sequence == sequence)
    });
}

#[test]
fn a_frame_that_brings_vision_down_is_kept_with_the_configuration_and_the_robot_is_held() {
    let folder = tempfile::Builder::new().prefix("samsod-").tempdir_in("/tmp").unwrap();
    let parts = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/data/parts");
    let recordings = folder.path().join("recordings");
    let text = format!(
        "[cell]\nname = \"panics\"\n[frames]\nroot_path = {:?}\n[recording]\nfolder = {recordings:?}\nmin_free_mib = 0\n\
         [view]\n[catalogue]\nfolder = {parts:?}\n[jig]\norder = [{{ part = \"hex_nut\", x_mm = 300.0, y_mm = 250.0 }}]\n\
         [robot.simulated]\nclock_rate = 100.0\n",
        folder.path().join("shm")
    );
    let file = folder.path().join("cell.toml");
    fs::write(&file, text).unwrap();
    let config = Config::read(&file).unwrap();
    let service = FrameServiceConfig { max_frame_bytes: 1 << 14, ..config.service() };
    let stop = Arc::new(AtomicBool::new(false));

    let report = thread::scope(|scope| {
        let _stop = Stop(&stop);
        let running = scope.spawn(|| run(&config, RunOptions::default(), &stop).unwrap());
        let mut scenes = SceneSubscriber::open(&service).unwrap();
        let mut publisher = FramePublisher::open(&service, CameraId::new(PANICS).unwrap()).unwrap();
        wait_for("subscriber", || publisher.subscribers() > 0);
        send(&mut publisher, 0);
        wait_for_scene(&mut scenes, 0);
        send(&mut publisher, 1);
        wait_for("hold", || {
            let state = control::ask(&service, Request::Status).unwrap().sequence;
            matches!(state, Some(SequenceState::Faulted(fault)) if fault.held_by == Some(HoldReason::VisionPanic)
                && fault.to_string().contains("hold after a panic of the vision chain"))
        });
        // The next frame finds a chain that works.
        send(&mut publisher, 2);
        wait_for_scene(&mut scenes, 2);
        stop.store(true, Ordering::SeqCst);
        running.join().unwrap()
    });

    assert_eq!((report.vision.processed, report.vision.panicked), (2, 1));
    let recording = report.recording.unwrap().files[0].clone();
    let stem = recording.with_extension("").display().to_string();
    let kept = image::open(format!("{stem}-panic-1.png")).unwrap().into_rgb8();
    assert_eq!(kept.dimensions(), (48, 32));
    assert!(kept.pixels().all(|p| p.0 == pixel(1)), "the frame that panicked, not another");
    let configuration = Config::read(Path::new(&format!("{stem}-panic-1.toml"))).unwrap();
    assert_eq!((&configuration.cell, &configuration.jig), (&config.cell, &config.jig));
    assert!(!Path::new(&format!("{stem}-panic-0.png")).exists());
}

fn get(listen: SocketAddr, path: &str) -> String {
    let mut stream = TcpStream::connect(listen).unwrap();
    write!(stream, "GET {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n").unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).unwrap();
    answer
}

/// What becomes of a cell whose disk hangs in the middle of a write. Returns what it told at its end, and what it recorded.
fn with_a_disk_that_hangs(policy: &str) -> (Report, Survey) {
    let folder = tempfile::Builder::new().prefix("samsod-").tempdir_in("/tmp").unwrap();
    let recordings = folder.path().join("recordings");
    // Free at the moment; nobody else on this machine asks for a certain one of these.
    let listen = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let text = format!(
        "[cell]\nname = \"hangs-{policy}\"\n[frames]\nroot_path = {:?}\n[recording]\nfolder = {recordings:?}\nmin_free_mib = 0\n\
         on_log_failure = \"{policy}\"\n[view]\n[robot.simulated]\nclock_rate = 100.0\n[http]\nlisten = \"{listen}\"\n",
        folder.path().join("shm")
    );
    let file = folder.path().join("cell.toml");
    fs::write(&file, text).unwrap();
    let config = Config::read(&file).unwrap();
    let service = FrameServiceConfig { max_frame_bytes: 1 << 14, ..config.service() };
    let stop = Arc::new(AtomicBool::new(false));
    let disk = faults::of(&recordings);

    let report = thread::scope(|scope| {
        let _stop = Stop(&stop);
        let running = scope.spawn(|| run(&config, RunOptions::default(), &stop).unwrap());
        let mut scenes = SceneSubscriber::open(&service).unwrap();
        let mut publisher = FramePublisher::open(&service, CameraId::new("test").unwrap()).unwrap();
        wait_for("subscriber", || publisher.subscribers() > 0);
        let mut sent = 0;
        let mut next = |scenes: &mut SceneSubscriber| {
            send_square(&mut publisher);
            wait_for_scene(scenes, sent);
            sent += 1;
            sent
        };
        let commands = || control::ask(&service, Request::Status).unwrap().commands.sent;
        wait_for("a command", || next(&mut scenes) > 0 && commands() > 0);

        disk.set(Fault::Hangs);
        next(&mut scenes);
        disk.wait_for_write();
        // Within a second it is told, and vision sees every frame that comes.
        let told = |answer: &str| answer.starts_with("HTTP/1.1 503") && answer.contains("recorder slow");
        wait_for("health", || next(&mut scenes) > 0 && told(&get(listen, "/healthz")));
        let processed = next(&mut scenes);
        let dropped = "samsod_recorder_frames_total{result=\"dropped\"}";
        wait_for("metrics", || {
            let text = get(listen, "/metrics");
            let value = |name: &str| {
                let line = text.lines().find_map(|line| line.strip_prefix(name));
                line.and_then(|value| value.trim().parse::<f64>().ok()).unwrap()
            };
            value(dropped) > 0.0 && value("samsod_frames_processed_total") == processed as f64
        });
        let before = commands();
        if policy == "hold" {
            let waits = || control::ask(&service, Request::Status).unwrap().waits_for.unwrap_or_default();
            wait_for("a robot that is held", || next(&mut scenes) > 0 && waits().contains("record"));
            assert_eq!(commands(), before, "nothing is given that is not written");
            let refused = control::ask(&service, Request::Resume { gripper_is_empty: false }).unwrap_err().to_string();
            assert!(refused.contains("held while recording is stuck"), "{refused}");
        } else {
            wait_for("commands that go on", || next(&mut scenes) > 0 && commands() >= before + 2);
        }
        disk.set(Fault::None);
        let well = |answer: &str| !answer.contains("recorder slow") && !answer.contains("recorder stuck");
        wait_for("a disk that writes", || well(&get(listen, "/healthz")));
        if policy == "hold" {
            control::ask(&service, Request::Resume { gripper_is_empty: false }).unwrap();
        }
        let before = commands();
        wait_for("a command after it", || next(&mut scenes) > 0 && commands() > before);
        let all = next(&mut scenes);
        stop.store(true, Ordering::SeqCst);
        let report = running.join().unwrap();
        assert_eq!((report.vision.processed, report.frames.dropped), (all, 0), "no frame has waited for the disk");
        report
    });
    let survey = recording::survey(&report.recording.as_ref().unwrap().files[0]).unwrap();
    (report, survey)
}

/// A frame with something on it to go to.
fn send_square(publisher: &mut FramePublisher) {
    let mut loan = publisher.loan(48, 32, PixelFormat::Rgb8).unwrap();
    for (i, pixel) in loan.pixels().chunks_exact_mut(3).enumerate() {
        let inside = (16..28).contains(&(i % 48)) && (10..22).contains(&(i / 48));
        pixel.copy_from_slice(if inside { &[200, 40, 40] } else { &[120, 120, 120] });
    }
    loan.send().unwrap();
}

#[test]
fn a_disk_that_hangs_holds_the_robot_and_keeps_no_frame_waiting() {
    let (report, survey) = with_a_disk_that_hangs("hold");
    let recording = report.recording.unwrap();
    assert!(recording.frames_dropped > 0 && recording.commands_not_written == 0, "{recording}");
    // One that was on its way to the disk when patience ended may be in it, with the word that it was not given.
    let (sent, not_given) = (report.robot.unwrap().commands.sent, survey.outcomes.get("not_executed").copied());
    assert_eq!(survey.damage, None);
    assert!((sent..=sent + not_given.unwrap_or(0)).contains(&survey.commands), "{survey:?} {sent}");
}

#[test]
fn a_disk_that_hangs_costs_a_robot_that_goes_on_its_record() {
    let (report, survey) = with_a_disk_that_hangs("continue");
    let recording = report.recording.unwrap();
    assert!(recording.frames_dropped > 0 && recording.has_lost_data(), "{recording}");
    let sent = report.robot.unwrap().commands.sent;
    assert_eq!(recording.commands + recording.commands_not_written, sent, "{recording}");
    assert!(survey.damage.is_none() && survey.commands >= recording.commands, "{survey:?}");
}

#[test]
fn a_robot_with_an_assembly_list_is_held_while_space_is_short_and_says_why() {
    let folder = tempfile::Builder::new().prefix("samsod-").tempdir_in("/tmp").unwrap();
    let parts = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/data/parts");
    let text = format!(
        "[cell]\nname = \"short\"\n[frames]\nroot_path = {:?}\n[recording]\nfolder = {:?}\nmin_free_mib = 1099511627776\n\
         [view]\n[catalogue]\nfolder = {parts:?}\n[jig]\norder = [{{ part = \"hex_nut\", x_mm = 300.0, y_mm = 250.0 }}]\n\
         [robot.simulated]\nclock_rate = 100.0\n",
        folder.path().join("shm"),
        folder.path().join("recordings")
    );
    let file = folder.path().join("cell.toml");
    fs::write(&file, text).unwrap();
    let config = Config::read(&file).unwrap();
    let stop = Arc::new(AtomicBool::new(false));
    let report = thread::scope(|scope| {
        let _stop = Stop(&stop);
        let running = scope.spawn(|| run(&config, RunOptions::default(), &stop).unwrap());
        let ask = |request| control::ask(&config.service(), request);
        wait_for("hold", || {
            let state = ask(Request::Status).ok().and_then(|report| report.sequence);
            matches!(state, Some(SequenceState::Faulted(fault)) if fault.reason.starts_with("recording is short of space: "))
        });
        let refused = ask(Request::Resume { gripper_is_empty: true }).unwrap_err().to_string();
        assert!(refused.contains("held while recording is short of space"), "{refused}");
        stop.store(true, Ordering::SeqCst);
        running.join().unwrap()
    });
    assert_eq!(report.robot.unwrap().commands.sent, 0);
    let survey = recording::survey(&report.recording.unwrap().files[0]).unwrap();
    let faults = survey.topics.iter().find(|topic| topic.name == "/robot/fault").unwrap().messages;
    assert_eq!((survey.commands, faults, survey.damage), (0, 1, None), "what is left of the space is for the fault");
}
