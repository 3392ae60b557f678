//! Recordings on disks that fail and hang.

use std::sync::Arc;
use std::time::{Duration, Instant};

use super::faults::{Fault, Faults};
use super::tests::{START_NS, config, count, frame, log, log_motion, log_surely, square};
use super::*;

/// Deadline that only a test that has failed reaches.
const WATCHDOG: Duration = Duration::from_secs(120);

const NO_SPACE: i32 = 28;
const INPUT_OUTPUT_ERROR: i32 = 5;
const READ_ONLY: i32 = 30;

fn wait_for(what: &str, mut condition: impl FnMut() -> bool) {
    let deadline = Instant::now() + WATCHDOG;
    while !condition() {
        assert!(Instant::now() < deadline, "{what}: not within {WATCHDOG:?}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// A folder on a disk that does as it is told.
fn disk() -> (tempfile::TempDir, Arc<Faults>) {
    let folder = tempfile::tempdir().unwrap();
    let faults = faults::of(folder.path());
    (folder, faults)
}

#[test]
fn a_failure_is_told_and_a_disk_that_comes_back_is_used() {
    let (folder, faults) = disk();
    let (image, scene) = frame(40, 24, square);
    let recorder = Recorder::start(&config(folder.path()), "demo").unwrap();
    let view = recorder.view();
    log_surely(&recorder, 1, &image, &scene);
    log_motion(&recorder, 1).unwrap();
    wait_for("the frame", || view.summary().frames_written == 1);
    faults.set(Fault::Fails(NO_SPACE));
    let refusal = log_motion(&recorder, 2).unwrap_err().to_string();
    assert!(refusal.contains("No space left on device"), "{refusal}");
    let held = view.holds_robot().unwrap();
    assert!(held.starts_with("recording has failed: ") && held.contains("No space left"), "{held}");
    // Nobody waits for a disk that is known to fail.
    assert_eq!(log_motion(&recorder, 3).unwrap_err().to_string(), held);
    assert!(!log(&recorder, 2, &image, &scene) && view.loses_frames());
    assert!(recorder.log_text(LogLevel::Info, START_NS, "test", "lost").is_err());

    faults.set(Fault::Fails(READ_ONLY));
    wait_for("another failure", || view.trouble().is_some_and(|t| t.to_string().contains("Read-only file system")));
    faults.set(Fault::None);
    wait_for("a new file", || view.trouble().is_none());
    assert_eq!(view.holds_robot(), None);
    log_surely(&recorder, 3, &image, &scene);
    log_motion(&recorder, 4).unwrap();
    let summary = recorder.finish().unwrap();
    assert_eq!((summary.frames_written, summary.frames_not_written, summary.commands), (2, 1, 2), "{summary}");
    // The second command with its target, the outcome that it was not given, and the text.
    assert_eq!((summary.failures, summary.commands_not_written), (1, 0), "{summary}");
    assert!(summary.lines_not_written >= 3 && summary.has_lost_data(), "{summary}");
    let surveys: Vec<Survey> = summary.files.iter().map(|file| survey(file).unwrap()).collect();
    assert_eq!(surveys.iter().map(|s| (s.frames, s.commands)).collect::<Vec<_>>(), [(1, 1), (1, 1)]);
    assert!(surveys[0].damage.is_some() && surveys[1].damage.is_none());
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 2, "nothing is left of the attempts");
}

#[test]
fn whoever_goes_on_gives_commands_that_are_counted_as_not_recorded() {
    let (folder, faults) = disk();
    let (image, scene) = frame(40, 24, square);
    let config = RecorderConfig { on_log_failure: OnLogFailure::Continue, ..config(folder.path()) };
    let recorder = Recorder::start(&config, "demo").unwrap();
    let view = recorder.view();
    faults.set(Fault::Fails(INPUT_OUTPUT_ERROR));
    for id in 1..=3 {
        log_motion(&recorder, id).unwrap();
    }
    recorder.log_sent(START_NS, b"STATUS").unwrap();
    assert_eq!(view.holds_robot(), None);
    assert!(view.trouble().unwrap().to_string().contains("Input/output error"));
    faults.set(Fault::None);
    wait_for("a new file", || view.trouble().is_none());
    log_motion(&recorder, 4).unwrap();
    log_surely(&recorder, 1, &image, &scene);
    let summary = recorder.finish().unwrap();
    assert_eq!((summary.commands, summary.commands_not_written, summary.frames_written), (1, 3, 1), "{summary}");
    let text = summary.to_string();
    assert!(text.contains("1 commands") && text.contains("3 commands not written, "), "{text}");
}

#[test]
fn a_disk_that_hangs_keeps_no_frame_waiting_and_a_command_is_not_given() {
    let (folder, faults) = disk();
    let (image, scene) = frame(40, 24, square);
    let recorder = Recorder::start(&RecorderConfig { queue_frames: 2, ..config(folder.path()) }, "demo").unwrap();
    let view = recorder.view();
    faults.set(Fault::Hangs);
    log_surely(&recorder, 1, &image, &scene);
    faults.wait_for_write();
    // Two wait and all others are dropped; whoever logs them is not kept.
    let taken = (2..50).filter(|&sequence| log(&recorder, sequence, &image, &scene)).count();
    assert_eq!((taken, view.summary().frames_dropped), (2, 46));
    assert!(view.loses_frames());
    let refusal = log_motion(&recorder, 1).unwrap_err().to_string();
    assert!(refusal.contains("the disk has not taken it within 5s"), "{refusal}");
    let held = view.holds_robot().unwrap();
    assert!(held.starts_with("recording is stuck: the disk has taken nothing for "), "{held}");
    faults.set(Fault::None);
    wait_for("the frames", || view.summary().frames_written == 3);
    assert_eq!(view.holds_robot(), None);
    log_motion(&recorder, 2).unwrap();
    let summary = recorder.finish().unwrap();
    let survey = survey(&summary.files[0]).unwrap();
    assert_eq!(
        (survey.frames, survey.commands, survey.damage),
        (3, 1, None),
        "the command that was not given is not in it"
    );
    assert_eq!(survey.outcomes.into_iter().collect::<Vec<_>>(), [("not_executed".to_string(), 1)]);
}

#[test]
fn whoever_goes_on_waits_for_a_disk_that_hangs_but_once() {
    let (folder, faults) = disk();
    let config = RecorderConfig { on_log_failure: OnLogFailure::Continue, ..config(folder.path()) };
    let recorder = Recorder::start(&config, "demo").unwrap();
    faults.set(Fault::Hangs);
    let start = Instant::now();
    for id in 1..=1000 {
        log_motion(&recorder, id).unwrap();
    }
    // A thousand waits would take more than an hour.
    assert!(start.elapsed() < WATCHDOG);
    faults.set(Fault::None);
    let summary = recorder.finish().unwrap();
    assert_eq!(summary.commands_not_written, 1000, "{summary}");
}

#[test]
fn the_end_does_not_wait_for_a_disk_that_takes_nothing() {
    let (folder, faults) = disk();
    let (image, scene) = frame(40, 24, square);
    let recorder = Recorder::start(&config(folder.path()), "demo").unwrap();
    faults.set(Fault::Hangs);
    log_surely(&recorder, 1, &image, &scene);
    let error = recorder.finish().unwrap_err().to_string();
    assert!(error.contains("the disk has taken nothing for 1s"), "{error}");
    faults.set(Fault::None);
}

#[test]
fn whoever_goes_on_begins_without_a_disk_and_whoever_holds_does_not() {
    let (folder, faults) = disk();
    faults.set(Fault::Fails(READ_ONLY));
    let error = Recorder::start(&config(folder.path()), "demo").unwrap_err().to_string();
    assert!(error.contains(folder.path().to_str().unwrap()) && error.contains("Read-only"), "{error}");
    let config = RecorderConfig { on_log_failure: OnLogFailure::Continue, ..config(folder.path()) };
    let recorder = Recorder::start(&config, "demo").unwrap();
    assert!(recorder.summary().files.is_empty());
    log_motion(&recorder, 1).unwrap();
    faults.set(Fault::None);
    wait_for("a file", || recorder.failure().is_none());
    log_motion(&recorder, 2).unwrap();
    let summary = recorder.finish().unwrap();
    assert_eq!((summary.commands, summary.commands_not_written, summary.failures), (1, 1, 1), "{summary}");
    assert_eq!(count(&survey(&summary.files[0]).unwrap(), "/robot/command"), 1);
}

#[test]
fn old_recordings_are_deleted_while_a_new_one_is_written() {
    let folder = tempfile::tempdir().unwrap();
    let old = folder.path().join("demo-20200101T000000.000Z.mcap");
    let other = folder.path().join("demo-notes.mcap");
    for path in [&old, &other] {
        std::fs::write(path, "long ago").unwrap();
        let long_ago = std::time::SystemTime::now() - Duration::from_secs(3 * 86_400);
        std::fs::File::options().write(true).open(path).unwrap().set_modified(long_ago).unwrap();
    }
    let recorder = Recorder::start(&RecorderConfig { keep_days: 2, ..config(folder.path()) }, "demo").unwrap();
    wait_for("the sweep", || recorder.summary().files_deleted == 1);
    assert!(!old.exists() && other.exists() && recorder.path().exists());
    assert!(!recorder.finish().unwrap().has_lost_data());
}

#[test]
fn numbers_out_of_range_are_named() {
    for (config, expected) in [
        (
            RecorderConfig { keep_mib: 100, ..RecorderConfig::default() },
            "keep_mib = 100; allowed is 0, or max_file_mib to 1099511627776",
        ),
        (RecorderConfig { keep_days: 36_501, ..RecorderConfig::default() }, "keep_days = 36501; allowed is 0 to 36500"),
        (
            RecorderConfig { max_file_minutes: 600_000, ..RecorderConfig::default() },
            "max_file_minutes = 600000; allowed is 0 to 525600",
        ),
    ] {
        assert_eq!(config.check().unwrap_err().to_string(), expected);
    }
    RecorderConfig { keep_mib: 4096, ..RecorderConfig::default() }.check().unwrap();
}
