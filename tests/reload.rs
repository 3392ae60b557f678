//! SIGHUP: samsodd reads its configuration again, takes it when nothing moves, or refuses it and says why.

#![allow(clippy::expect_used, clippy::unwrap_used, clippy::panic, reason = "helpers of tests fail by panicking")]

mod support;

use std::fs;
use std::path::{Path, PathBuf};

use support::{Process, TestCell, assert_closed, json, messages, samsod, send};

/// The files of a recording in their order: the first has no number.
fn recordings(cell: &TestCell) -> Vec<PathBuf> {
    let mut files = cell.recordings();
    files.sort_by_key(|file| (file.as_os_str().len(), file.clone()));
    files
}

/// Starts a daemon on a configuration; returns it ready.
fn start(cell: &TestCell, more: &[(&str, &str)]) -> Process {
    let daemon = cell.spawn_daemon(&cell.config(more), &[]);
    daemon.wait_for_line("ready, waiting for frames");
    daemon
}

#[test]
fn a_new_configuration_is_in_force_from_one_frame_to_the_next_and_begins_a_new_file() {
    let cell = TestCell::new();
    let daemon = start(&cell, &[]);
    let (mut scenes, mut publisher) = (cell.scenes(), cell.publisher());
    send(&mut publisher, 0);
    let before = scenes.of_frame(0);
    assert_eq!(before["regions"].as_array().unwrap().len(), 1, "{before}");
    // Nothing is salient enough any more, and the table is another.
    cell.config(&[("regions", "threshold = 1.0"), ("view", "mm_per_px = 0.5"), ("segment", "range_bandwidth = 9.5")]);
    daemon.signal("HUP");
    let line = daemon.wait_for_line("a new configuration is in force");
    for change in
        ["[regions] threshold: \\\"positive\\\" -> 1.0", "[view] mm_per_px: 0.4 -> 0.5", "range_bandwidth: 4.0 -> 9.5"]
    {
        assert!(line.contains(change), "{change}: {line}");
    }
    send(&mut publisher, 0);
    let after = scenes.of_frame(1);
    assert!(after["regions"].as_array().unwrap().is_empty(), "{after}");
    // The same once more says so, and begins nothing.
    daemon.signal("HUP");
    daemon.wait_for_line("the configuration has not changed");
    send(&mut publisher, 0);
    scenes.of_frame(2);
    let ended = daemon.terminate();
    ended.assert_success();

    let files = recordings(&cell);
    assert_eq!(files.len(), 2, "{files:?}");
    let scenes_of =
        |file: &Path| json(&messages(file), "/scene").iter().map(|s| s["sequence"].clone()).collect::<Vec<_>>();
    assert_eq!((scenes_of(&files[0]), scenes_of(&files[1])), (vec![0.into()], vec![1.into(), 2.into()]));
    for file in &files {
        assert_closed(file);
        let ended = samsod(&["replay", file.to_str().unwrap()]);
        ended.assert_success();
        assert!(ended.stdout.contains("configuration  that of the recording"), "{}", ended.stdout);
    }
}

#[test]
fn what_is_wrong_or_needs_a_restart_is_refused_with_the_reason_and_the_old_one_stays() {
    let cell = TestCell::new();
    let daemon = start(&cell, &[]);
    let path = cell.path("cell.toml");
    let good = fs::read_to_string(&path).unwrap();
    let (mut scenes, mut publisher) = (cell.scenes(), cell.publisher());
    let cases: [(String, &[&str]); 8] = [
        (good.replace("[view]", "[view"), &["TOML parse error"]),
        (good.replace("[view]", "[view]\nmm_per_px = -1.0"), &["[view] mm_per_px is -1; allowed: 0.001 to 1000"]),
        (good.replace("[view]", "[view]\nmm_per_inch = 1.0"), &["unknown field `mm_per_inch`"]),
        (String::new(), &["is empty"]),
        (good.replace("recordings", "elsewhere"), &["need a restart", "[recording] folder: ", "elsewhere"]),
        (
            format!(
                "{good}\n[robot]\narmed = true\n[robot.simulated]\nclock_rate = 2.0\n[segment]\nrange_bandwidth = 8.0\n"
            ),
            &["need a restart", "[robot] armed: false -> true", "[robot.simulated] clock_rate: 1.0 -> 2.0"],
        ),
        (good.replace("test-cell", "other-cell"), &["need a restart", "[cell] name: "]),
        // Whether the robot stands somewhere is no matter of a moment.
        (good.replace("[view]\n", ""), &["whether it is known where the robot stands", "needs a restart"]),
    ];
    for (number, (text, expected)) in (0..).zip(cases) {
        fs::write(&path, &text).unwrap();
        daemon.signal("HUP");
        // A reason may have several lines.
        let mut said = daemon.wait_for_line("ERROR");
        while !said.contains("the configuration is refused; the old one stays")
            || expected.iter().any(|e| !said.contains(e))
        {
            said += &daemon.wait_for_line("");
        }
        send(&mut publisher, 0);
        let scene = scenes.of_frame(number);
        assert_eq!(scene["regions"].as_array().unwrap().len(), 1, "{scene}");
    }
    // A folder where the file was.
    fs::remove_file(&path).unwrap();
    daemon.signal("HUP");
    let line = daemon.wait_for_line("is refused");
    assert!(line.contains("cannot read"), "{line}");
    fs::write(&path, &good).unwrap();
    daemon.signal("HUP");
    daemon.wait_for_line("the configuration has not changed");
    daemon.terminate().assert_success();
    assert_eq!(cell.recordings().len(), 1);
    assert!(!cell.path("elsewhere").exists());
}

#[test]
fn a_robot_in_motion_ends_it_first_and_new_limits_hold_from_the_next_motion_on() {
    let cell = TestCell::new();
    // So slow that the test comes between begin and end.
    let slow = ("robot", "joint_speed_fraction = 0.01\nmotion_timeout_ms = 120000");
    let daemon = start(&cell, &[slow]);
    let (mut scenes, mut publisher) = (cell.scenes(), cell.publisher());
    send(&mut publisher, 0);
    daemon.wait_for_line("command given command=1 frame=0");
    // Nothing may be gone to any more.
    cell.config(&[slow, ("robot.limits", "step_max_mm = 1.0")]);
    daemon.signal("HUP");
    daemon.wait_for_line("waits until no motion and no pick is under way");
    // Frames go on meanwhile, and the robot is not shown them.
    send(&mut publisher, 9);
    scenes.of_frame(1);
    let mut order = Vec::new();
    while order.len() < 3 {
        let line = daemon.wait_for_line("");
        let marks = ["command ended command=1", "the robot goes on with the new", "a new configuration is in force"];
        order.extend(marks.iter().find(|mark| line.contains(**mark)).copied());
        assert!(!line.contains("command=2"), "{line}");
    }
    assert_eq!(
        order,
        ["command ended command=1", "the robot goes on with the new", "a new configuration is in force"],
        "the motion in flight comes first"
    );
    send(&mut publisher, 20);
    let line = daemon.wait_for_line("command ended command=2");
    assert!(line.contains("step_max_mm") && line.contains("at most 1 mm"), "{line}");
    daemon.terminate().assert_success();
    let files = recordings(&cell);
    let outcomes: Vec<_> = files.iter().flat_map(|file| json(&messages(file), "/robot/outcome")).collect();
    let ended: Vec<_> = outcomes.iter().filter(|o| o["outcome"] != "accepted").map(|o| &o["outcome"]).collect();
    assert_eq!(ended[..2], ["done", "not_executed"], "{outcomes:?}");
}
