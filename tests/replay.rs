//! `samsod replay`: what samsodd has recorded is seen again, by the same program to the byte.

#![allow(clippy::expect_used, clippy::unwrap_used, clippy::panic, reason = "helpers of tests fail by panicking")]

mod support;

use std::fs;
use std::path::{Path, PathBuf};

use image::RgbImage;
use samsod_frame::{CameraId, FramePublisher, FrameServiceConfig, PixelFormat};
use support::{Ended, TestCell, compose, count, json, messages, picture, samsod, test_data};

/// Records what samsodd with further keys sees in some pictures. The folder of parts, if there is one, is a copy.
fn record(cell: &TestCell, more: &[(&str, &str)], pictures: &[RgbImage]) -> PathBuf {
    let daemon = cell.spawn_daemon(&cell.config(more), &[]);
    daemon.wait_for_line("ready, waiting for frames");
    let service = FrameServiceConfig { max_frame_bytes: 4 << 20, ..cell.service.clone() };
    let mut publisher = FramePublisher::open(&service, CameraId::new("test").unwrap()).unwrap();
    let mut scenes = cell.scenes();
    for (sequence, picture) in (0..).zip(pictures) {
        let mut loan = publisher.loan(picture.width(), picture.height(), PixelFormat::Rgb8).unwrap();
        loan.pixels().copy_from_slice(picture);
        loan.send().unwrap();
        scenes.of_frame(sequence);
    }
    daemon.terminate().assert_success();
    cell.recordings().pop().unwrap()
}

/// A catalogue of its own, which a test may change.
fn copy_parts(to: &Path) {
    for part in fs::read_dir(test_data("parts")).unwrap().map(|entry| entry.unwrap().path()) {
        let folder = to.join(part.file_name().unwrap());
        fs::create_dir_all(&folder).unwrap();
        for file in fs::read_dir(part).unwrap().map(|entry| entry.unwrap().path()).filter(|path| path.is_file()) {
            fs::copy(&file, folder.join(file.file_name().unwrap())).unwrap();
        }
    }
}

fn replay(file: &Path, arguments: &[&str]) -> Ended {
    samsod(&[&["replay", file.to_str().unwrap()], arguments].concat())
}

/// The columns `frames` and `differ` of a stage in the table.
fn stage(ended: &Ended, name: &str) -> (u64, u64) {
    let line = ended.stdout.lines().find(|line| line.starts_with(&format!("{name} ")));
    let mut words = line.unwrap_or_else(|| panic!("{name}: {ended:?}")).split_whitespace().skip(1);
    let mut number = || words.next().unwrap().parse().unwrap();
    (number(), number())
}

#[test]
fn the_same_program_sees_the_same_bytes_with_any_number_of_threads_though_camera_file_and_caches_are_gone() {
    let cell = TestCell::new();
    let (parts, camera) = (cell.path("parts"), cell.path("camera.toml"));
    copy_parts(&parts);
    fs::copy(test_data("cell/camera.toml"), &camera).unwrap();
    let keys = [
        ("catalogue", "folder = \"parts\""),
        ("camera", "file = \"camera.toml\"\nobject_height_mm = 15.0"),
        ("recording", "saliency_encoding = \"32FC1\""),
    ];
    let pictures = [
        compose(&[("hex_nut", [0, 0]), ("sensor_box", [-220, 150])]),
        // Parts that touch, and one that is cut by nothing.
        compose(&[("star_knob", [120, -90]), ("washer", [40, 60]), ("bearing", [-150, -60])]),
        compose(&[]),
        compose(&[("terminal_block", [-90, 40]), ("hex_nut", [210, 120])]),
    ];
    let file = record(&cell, &keys, &pictures);
    let recorded = json(&messages(&file), "/scene");
    assert_eq!(recorded.len(), pictures.len());
    let named = recorded.iter().flat_map(|scene| scene["detections"].as_array().unwrap());
    assert!(named.filter(|detection| !detection["name"].is_null()).count() >= 4, "{recorded:?}");
    // What was computed from a part is computed again; and a camera may have been calibrated anew.
    for part in fs::read_dir(&parts).unwrap() {
        let _ = fs::remove_file(part.unwrap().path().join("descriptors"));
    }
    fs::remove_file(&camera).unwrap();
    for threads in ["1", "2", "7"] {
        let ended = replay(&file, &["--threads", threads]);
        ended.assert_success();
        assert!(ended.stdout.ends_with("4 frames, every stage the same\n"), "{threads}: {}", ended.stdout);
        assert!(ended.stdout.contains(&format!("threads        {threads}\n")), "{}", ended.stdout);
        assert!(ended.stdout.contains("configuration  that of the recording\n"), "{}", ended.stdout);
    }
}

#[test]
fn a_frame_is_seen_the_same_whatever_came_before_it() {
    let cell = TestCell::new();
    let large = |number| image::imageops::resize(&picture(number), 320, 240, image::imageops::FilterType::Triangle);
    let many: Vec<RgbImage> =
        (0..6).flat_map(|number| [picture(number), large(number), picture(40 - number)]).collect();
    let file = record(&cell, &[], &many);
    let alone = TestCell::new();
    // The last frame first, in a chain that has seen nothing yet.
    let first = record(&alone, &[], &many[many.len() - 1..]);
    let last = |file: &Path, topic: &str| {
        let messages = messages(file);
        messages.into_iter().filter(|(name, _)| name == topic).map(|(_, data)| data).next_back().unwrap()
    };
    let figures = |file: &Path| {
        let mut scene: serde_json::Value = serde_json::from_slice(&last(file, "/scene")).unwrap();
        scene["sequence"].take();
        scene
    };
    assert_eq!(figures(&file), figures(&first));
    // Pixels are the last of a message.
    for (topic, bytes_per_pixel) in [("/segment/labels", 2), ("/saliency", 1), ("/masks", 1)] {
        let pixels = |file: &Path| {
            let message = last(file, topic);
            message[message.len() - 64 * 48 * bytes_per_pixel..].to_vec()
        };
        assert_eq!(pixels(&file), pixels(&first), "{topic}");
    }
    replay(&file, &[]).assert_success();
}

#[test]
fn another_configuration_gives_a_table_of_what_it_changes_and_code_1() {
    let cell = TestCell::new();
    let pictures: Vec<RgbImage> = (0..3).map(picture).collect();
    let file = record(&cell, &[], &pictures);
    // The robot goes straight to what is seen: where it was sent follows from the frame.
    assert!(count(&messages(&file), "/robot/command") > 0);
    let other = cell.path("other.toml");
    let text = fs::read_to_string(cell.path("cell.toml")).unwrap();
    fs::write(&other, format!("{text}mm_per_px = 0.5\n[regions]\nthreshold = 0.99\n[log]\nlevel = \"warn\"\n"))
        .unwrap();
    let ended = replay(&file, &["--config", other.to_str().unwrap()]);
    assert_eq!(ended.status.code(), Some(1), "{ended:?}");
    for line in [
        "configuration  [regions] threshold: \"positive\" -> 0.99",
        "configuration  [view] mm_per_px: 0.4 -> 0.5",
        "3 frames, 3 differ",
    ] {
        assert!(ended.stdout.lines().any(|l| l.starts_with(line)), "{line}: {}", ended.stdout);
    }
    assert!(!ended.stdout.contains("level"), "nothing is seen by it: {}", ended.stdout);
    // Before the threshold nothing has changed, behind it everything.
    assert_eq!((stage(&ended, "labels"), stage(&ended, "saliency")), ((3, 0), (3, 0)), "{}", ended.stdout);
    for behind in ["regions", "masks", "outlines", "objects"] {
        assert_eq!(stage(&ended, behind), (3, 3), "{behind}: {}", ended.stdout);
    }
    let (targets, other_targets) = stage(&ended, "target");
    assert!(targets > 0 && targets == other_targets, "{}", ended.stdout);

    // The square is too small for a partition of its own: by how many pixels that differs is measured.
    fs::write(&other, format!("{text}[segment]\nmin_area_px = 2000\n")).unwrap();
    let ended = replay(&file, &["--config", other.to_str().unwrap(), "--threads", "1"]);
    assert_eq!((ended.status.code(), stage(&ended, "labels")), (Some(1), (3, 3)), "{ended:?}");
    let line = ended.stdout.lines().find(|line| line.starts_with("labels ")).unwrap();
    assert!(line.contains("in up to 144 px (4.69 %) of a frame; 2 became 1"), "{line}");
}

#[test]
fn a_part_that_was_taught_anew_is_named() {
    let cell = TestCell::new();
    copy_parts(&cell.path("parts"));
    let keys = [("catalogue", "folder = \"parts\""), ("camera", "file = \"camera.toml\"")];
    fs::copy(test_data("cell/camera.toml"), cell.path("camera.toml")).unwrap();
    let file = record(&cell, &keys, &[compose(&[("hex_nut", [0, 0])])]);
    fs::rename(cell.path("parts"), cell.path("moved")).unwrap();
    let missing = replay(&file, &[]);
    assert_eq!(missing.status.code(), Some(1));
    assert!(missing.stderr.contains("parts") && missing.stderr.contains("--catalogue names another"), "{missing:?}");
    let moved = cell.path("moved");
    let moved = moved.to_str().unwrap();
    replay(&file, &["--catalogue", moved]).assert_success();
    fs::remove_dir_all(cell.path("moved/washer")).unwrap();
    fs::rename(cell.path("moved/hex_nut"), cell.path("hex_nut")).unwrap();
    let ended = replay(&file, &["--catalogue", moved]);
    assert_eq!(ended.status.code(), Some(1), "{ended:?}");
    for line in ["configuration  [catalogue] hex_nut is missing", "configuration  [catalogue] washer is missing"] {
        assert!(ended.stdout.lines().any(|l| l == line), "{line}: {}", ended.stdout);
    }
    assert!(ended.stdout.contains(" names: frame 0 hex_nut -> "), "{}", ended.stdout);
}

#[test]
fn a_cut_recording_is_replayed_as_far_as_it_goes_with_code_3() {
    let cell = TestCell::new();
    let pictures: Vec<RgbImage> = (0..4).map(picture).collect();
    let file = record(&cell, &[], &pictures);
    let whole = fs::read(&file).unwrap();
    let cut = cell.path("cut.mcap");
    let frames_of = |twentieths: usize| -> u64 {
        fs::write(&cut, &whole[..whole.len() * twentieths / 20]).unwrap();
        let ended = replay(&cut, &[]);
        assert_eq!(ended.status.code(), Some(3), "{ended:?}");
        assert!(ended.stderr.contains("cut.mcap is not complete"), "{}", ended.stderr);
        let line = ended.stdout.lines().last().unwrap();
        let frames = line.strip_suffix(" frames, every stage the same").unwrap_or_else(|| panic!("{line}"));
        frames.parse().unwrap()
    };
    // What stands behind the frames of so small a file is as long as they are.
    let fewer = (1..20).rev().map(frames_of).find(|frames| *frames < 4).unwrap();
    assert!(fewer >= 1, "{fewer}");
}

#[test]
fn pixels_that_were_not_seen_are_told() {
    let cell = TestCell::new();
    let file = record(&cell, &[("recording", "image_encoding = \"jpeg\"")], &[picture(3)]);
    let ended = replay(&file, &[]);
    assert!(ended.stdout.contains("1 frames are recorded as JPEG: the recorded pixels are not those"), "{ended:?}");
    assert!(matches!(ended.status.code(), Some(0 | 1)), "{ended:?}");
}

#[test]
fn a_recording_that_does_not_say_what_it_was_made_with_needs_a_configuration() {
    let cell = TestCell::new();
    let pixels = picture(1);
    let view = samsod::segment::RgbView::from_raw(64, 48, pixels.as_raw().as_slice()).unwrap();
    let scene = samsod::Cell::new(samsod::CellParams::default()).unwrap().inspect(&view).unwrap();
    let config = samsod_daemon::recording::RecorderConfig {
        folder: cell.path("recordings"),
        min_free_mib: 0,
        ..samsod_daemon::recording::RecorderConfig::default()
    };
    let recorder = samsod_daemon::recording::Recorder::start(&config, "old").unwrap();
    assert!(recorder.log_frame(&samsod_daemon::recording::FrameRecord {
        timestamp_ns: 1,
        sequence: 0,
        camera: "test",
        image: &view,
        scene: &scene,
        places: None,
        base_from_world: None,
        other_times: &[],
    }));
    let file = recorder.finish().unwrap().files.remove(0);
    let refused = replay(&file, &[]);
    assert_eq!(refused.status.code(), Some(1));
    assert!(refused.stderr.contains("does not say with what configuration") && refused.stderr.contains("--config"));
    let without_view = cell.path("without.toml");
    fs::write(&without_view, "[cell]\nname = \"old\"\n").unwrap();
    let ended = replay(&file, &["--config", without_view.to_str().unwrap()]);
    ended.assert_success();
    assert!(ended.stdout.contains("made by        it does not say"), "{}", ended.stdout);

    fs::write(cell.path("notes.mcap"), "not a recording").unwrap();
    let refusals = [("notes.mcap", "is no MCAP recording"), ("none.mcap", "cannot read"), (".", "it is a folder")];
    for (path, expected) in refusals {
        let ended = replay(&cell.path(path), &[]);
        assert_eq!(ended.status.code(), Some(1), "{ended:?}");
        assert!(ended.stderr.contains(expected), "{path}: {}", ended.stderr);
    }
}
