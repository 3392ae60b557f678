//! What no input is known to bring about: a vision chain that panics.

use std::fs;
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread;

use samsod_frame::{CameraId, FramePublisher, FrameServiceConfig, PixelFormat, SceneSubscriber};
use samsod_robot::SequenceState;

use super::*;
use crate::control::{self, Request};

const PATIENCE: Duration = Duration::from_secs(120);

/// Number of the frame that panics.
static PANIC_ON: AtomicU64 = AtomicU64::new(u64::MAX);

pub(super) fn panic_if_asked(sequence: u64) {
    assert_ne!(sequence, PANIC_ON.load(Ordering::SeqCst), "a panic on purpose");
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
    PANIC_ON.store(1, Ordering::SeqCst);
    let stop = Arc::new(AtomicBool::new(false));

    let report = thread::scope(|scope| {
        let _stop = Stop(&stop);
        let running = scope.spawn(|| run(&config, RunOptions::default(), &stop).unwrap());
        let mut scenes = SceneSubscriber::open(&service).unwrap();
        let mut publisher = FramePublisher::open(&service, CameraId::new("test").unwrap()).unwrap();
        wait_for("subscriber", || publisher.subscribers() > 0);
        send(&mut publisher, 0);
        wait_for_scene(&mut scenes, 0);
        send(&mut publisher, 1);
        wait_for("hold", || {
            let state = control::ask(&service, Request::Status).unwrap().sequence;
            matches!(state, Some(SequenceState::Faulted(fault)) if fault.to_string().contains("hold"))
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
