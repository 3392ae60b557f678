//! samsodd at work: frames in from other processes, scenes, recording and commands out.

mod support;

use std::path::{Path, PathBuf};

use samsod_frame::{FrameHeader, PixelFormat};
use support::{TestCell, assert_closed, count, json, messages, send};

const FRAME_TOPICS: [&str; 11] = [
    "/camera/image",
    "/segment/labels",
    "/saliency",
    "/regions",
    "/detections",
    "/masks",
    "/outlines",
    "/places",
    "/tf",
    "/scene",
    "/stage/timings",
];

fn only_recording(cell: &TestCell) -> PathBuf {
    let files = cell.recordings();
    assert_eq!(files.len(), 1, "{files:?}");
    files[0].clone()
}

#[test]
fn frames_of_a_client_are_recorded_published_and_answered() {
    let cell = TestCell::new();
    let mut scenes = cell.scenes();
    let daemon = cell.start_daemon(&["--frames", "6"]);
    // Goes on until the daemon has its six: a machine under load may lose some.
    let client = cell.spawn_client(&cell.images(3), &["--rate", "20", "--loop"]);
    let scene = scenes.next();
    // Slots for frames of 9 kB, and nothing like a multiple of them.
    let slots = cell.service.slots() as u64;
    let memory = client.message_memory();
    assert!((slots * 64 * 48 * 3..slots * 64 * 48 * 3 * 2).contains(&memory), "{memory} bytes for {slots} slots");
    assert_eq!((&scene["width_px"], &scene["height_px"]), (&64.into(), &48.into()));
    let counts = (&scene["region_count"], &scene["object_count"], &scene["best_object"]);
    assert_eq!(counts, (&1.into(), &1.into(), &0.into()), "{scene}");
    let region = &scene["regions"][0];
    assert_eq!((&region["width_px"], &region["height_px"]), (&12.into(), &12.into()), "{scene}");
    // The square lies in rows 16 to 27; a view of 0.4 mm a pixel with row 479 at y = 0 is the default.
    let object = &scene["objects"][0];
    assert_eq!((&object["id"], &object["region"]), (&0.into(), &0.into()), "{scene}");
    assert!((130..=150).contains(&object["area_px"].as_u64().unwrap()), "12 x 12 px: {scene}");
    assert!((object["world"]["y_mm"].as_f64().unwrap() - (479.0 - 21.5) * 0.4).abs() < 0.4, "{scene}");
    assert_eq!(object["base"], object["world"], "the view is given in the frame of the robot: {scene}");
    assert_eq!((&scene["grasp"]["x_mm"], &scene["grasp"]["y_mm"]), (&object["base"]["x_mm"], &object["base"]["y_mm"]));
    assert_eq!(scene["grasp"]["z_mm"], 20.0);
    let ended = daemon.wait();
    ended.assert_success();
    assert!(ended.stdout.starts_with("cell test-cell: all frames done after"), "{}", ended.stdout);
    assert_eq!(ended.count("frames", "processed"), 6);
    check_recording(&only_recording(&cell), 6);
    let client = client.terminate();
    client.assert_success();
}

/// Checks that every frame has all its stages, every command its outcome, and that nothing else moved the robot.
fn check_recording(path: &Path, frames: usize) {
    assert_closed(path);
    let messages = messages(path);
    for topic in FRAME_TOPICS {
        assert_eq!(count(&messages, topic), frames, "{topic}");
    }
    let commands = json(&messages, "/robot/command");
    let outcomes = json(&messages, "/robot/outcome");
    assert!(!commands.is_empty());
    assert_eq!(count(&messages, "/pick/target"), commands.len());
    // The acknowledgement, then the result, and no other outcome.
    assert_eq!(2 * commands.len(), outcomes.len());
    for (i, (command, outcomes)) in commands.iter().zip(outcomes.chunks_exact(2)).enumerate() {
        assert_eq!(command["id"], i + 1);
        assert!(outcomes.iter().all(|outcome| outcome["id"] == i + 1));
        assert_eq!((&outcomes[0]["outcome"], &outcomes[1]["outcome"]), (&"accepted".into(), &"done".into()));
    }
}

#[test]
fn every_processed_frame_is_in_the_recording() {
    let cell = TestCell::new();
    let mut scenes = cell.scenes();
    let daemon = cell.start_daemon(&["--frames", "5"]);
    let mut publisher = cell.publisher();
    for number in 0..5 {
        send(&mut publisher, number);
        scenes.of_frame(number.into());
    }
    let ended = daemon.wait();
    ended.assert_success();
    assert_eq!(ended.count("frames", "processed"), 5);
    assert_eq!(ended.count("frames", "dropped"), 0);
    assert!(ended.count("commands", "sent") >= 1);
    assert_eq!(ended.count("commands", "sent"), ended.count("commands", "done"), "{}", ended.stdout);
    assert!(ended.stdout.lines().any(|l| l == "objects    5 (1.0 a frame), 5 placed in mm"), "{}", ended.stdout);
    for stage in ["age", "segment", "saliency", "regions", "shadow", "recognize", "total"] {
        assert!(ended.stdout.lines().any(|line| line.starts_with(stage)), "{stage}: {}", ended.stdout);
    }
    let recording = only_recording(&cell);
    assert!(ended.stdout.contains(recording.to_str().unwrap()), "{}", ended.stdout);
    check_recording(&recording, 5);
}

#[test]
fn a_client_whose_clock_is_ahead_has_no_age_in_the_recording() {
    let cell = TestCell::new();
    let mut scenes = cell.scenes();
    let daemon = cell.start_daemon(&["--frames", "1"]);
    let mut publisher = cell.publisher();
    let image = support::picture(0);
    let mut loan = publisher.loan(image.width(), image.height(), PixelFormat::Rgb8).unwrap();
    loan.pixels().copy_from_slice(&image);
    loan.set_timestamp_ns(samsod_frame::unix_time_ns() + 3_600_000_000_000);
    loan.send().unwrap();
    assert!(scenes.of_frame(0)["times_ms"]["age"].is_null());
    let ended = daemon.wait();
    ended.assert_success();
    let times = json(&messages(&only_recording(&cell)), "/stage/timings");
    assert_eq!(times.len(), 1);
    assert!(times[0].get("age_ms").is_none() && times[0].get("transport_ms").is_none(), "{}", times[0]);
    // The table and the recording mean the same by the total; the greatest value in the table is exact.
    let line = ended.stdout.lines().find(|line| line.starts_with("total")).unwrap();
    let greatest: f64 = line.split_whitespace().last().unwrap().parse().unwrap();
    let recorded = times[0]["total_ms"].as_f64().unwrap();
    assert!((greatest - recorded).abs() <= 0.001, "{greatest} in the table, {recorded} in the recording");
}

#[test]
fn sigterm_and_sigint_close_the_file() {
    for signal in ["TERM", "INT"] {
        let cell = TestCell::new();
        let mut scenes = cell.scenes();
        let daemon = cell.start_daemon(&[]);
        let mut publisher = cell.publisher();
        send(&mut publisher, 0);
        scenes.of_frame(0);
        daemon.signal(signal);
        let ended = daemon.wait();
        ended.assert_success();
        assert!(ended.stdout.starts_with("cell test-cell: stopped after"), "{}", ended.stdout);
        assert_eq!(ended.count("frames", "processed"), 1);
        assert_closed(&only_recording(&cell));
    }
}

#[test]
fn a_slow_daemon_drops_old_frames_and_counts_them() {
    let cell = TestCell::new();
    let mut scenes = cell.scenes();
    let daemon = cell.start_daemon(&[]);
    let mut publisher = cell.publisher();
    send(&mut publisher, 0);
    scenes.of_frame(0);
    daemon.freeze();
    for number in 1..=20 {
        // Sending never waits for the slow one.
        send(&mut publisher, number);
    }
    daemon.thaw();
    assert_eq!(scenes.next()["sequence"], 20, "the latest frame comes next");
    let ended = daemon.terminate();
    ended.assert_success();
    assert_eq!(ended.count("frames", "received"), 2);
    assert_eq!(ended.count("frames", "dropped"), 19);
}

#[test]
fn a_header_that_lies_is_refused_with_its_reason() {
    let cell = TestCell::new();
    let mut scenes = cell.scenes();
    let daemon = cell.start_daemon(&[]);
    let mut publisher = cell.publisher();
    let lies = [
        (FrameHeader { width: 1078, height: 958, stride: 3234, pixel_format: 1, ..FrameHeader::default() }, 100),
        (FrameHeader { width: 4, height: 4, stride: 12, pixel_format: 77, ..FrameHeader::default() }, 48),
        (FrameHeader { width: 0, height: 4, stride: 12, pixel_format: 1, ..FrameHeader::default() }, 48),
        (FrameHeader { width: 4, height: 4, stride: 2, pixel_format: 1, ..FrameHeader::default() }, 48),
    ];
    let reasons = [
        "payload has 100 bytes; 1078 x 958 px of rgb8 with a stride of 3234 need 3098172",
        "pixel format 77 is unknown",
        "frame width is 0 px; 1 to 16384 px are allowed",
        "stride is 2 bytes; 12 to 65536 are allowed",
    ];
    for ((header, len), reason) in lies.into_iter().zip(reasons) {
        publisher.loan_raw(header, len).unwrap().send().unwrap();
        daemon.wait_for_line(reason);
    }
    send(&mut publisher, 0);
    scenes.of_frame(4);
    let ended = daemon.terminate();
    ended.assert_success();
    assert_eq!(ended.count("frames", "rejected"), 4);
    assert_eq!(ended.count("frames", "processed"), 1);
    let log = messages(&only_recording(&cell));
    assert_eq!(count(&log, "/log"), 4);
}

#[test]
fn frames_of_every_format_and_size_are_processed() {
    let cell = TestCell::new();
    let mut scenes = cell.scenes();
    let daemon = cell.start_daemon(&[]);
    let mut publisher = cell.publisher();
    let mut sequence = 0;
    for (width, height) in [(1, 1), (1, 7), (7, 1), (33, 21)] {
        for format in PixelFormat::ALL {
            let stride = width * format.bytes_per_pixel() as u32 + 5;
            let mut loan = publisher.loan_with_stride(width, height, format, stride).unwrap();
            loan.pixels().fill(90);
            loan.send().unwrap();
            let scene = scenes.of_frame(sequence);
            assert_eq!((&scene["width_px"], &scene["height_px"]), (&width.into(), &height.into()));
            assert_eq!(scene["region_count"], 0, "one colour has no region: {scene}");
            sequence += 1;
        }
    }
    let ended = daemon.terminate();
    ended.assert_success();
    assert_eq!(ended.count("frames", "processed"), sequence);
    assert_eq!(ended.count("frames", "failed"), 0);
}

#[test]
fn a_frame_larger_than_allowed_is_refused() {
    let cell = TestCell::new();
    let config = cell.config(&[("frames", "max_width_px = 63")]);
    let daemon = cell.spawn_daemon(&config, &[]);
    daemon.wait_for_line("ready, waiting for frames");
    let mut publisher = cell.publisher();
    send(&mut publisher, 0);
    daemon.wait_for_line("frame is 64 x 48 px; at most 63 x 8192 px are processed");
    assert_eq!(daemon.terminate().count("frames", "rejected"), 1);
}

#[test]
fn a_killed_daemon_leaves_the_cell_to_the_next() {
    let cell = TestCell::new();
    let mut publisher = cell.publisher();
    for round in 0..3 {
        // The reader comes after the dead daemon: its own start is one that has to clean up.
        let daemon = cell.start_daemon(&[]);
        let mut scenes = cell.scenes();
        send(&mut publisher, 0);
        scenes.of_frame(round);
        daemon.kill();
    }
    let daemon = cell.start_daemon(&[]);
    let mut scenes = cell.scenes();
    send(&mut publisher, 0);
    scenes.of_frame(3);
    daemon.terminate().assert_success();
    assert_eq!(cell.recordings().len(), 4);
}

#[test]
fn killed_clients_leave_their_places_to_the_next() {
    let cell = TestCell::new();
    let images = cell.images(2);
    let mut scenes = cell.scenes();
    let daemon = cell.start_daemon(&[]);
    // One more than there are places for publishers.
    for _ in 0..3 {
        let client = cell.spawn_client(&images, &["--rate", "50", "--loop"]);
        daemon.wait_for_line("frames from a new client");
        scenes.next();
        client.kill();
    }
    let ended = daemon.terminate();
    ended.assert_success();
    assert_closed(&only_recording(&cell));
}

#[test]
fn a_scene_that_is_too_large_goes_without_its_regions_and_their_objects() {
    let cell = TestCell::new();
    let mut scenes = cell.scenes();
    let daemon = cell.spawn_daemon(&cell.config(&[("frames", "max_scene_bytes = 600")]), &["--frames", "1"]);
    daemon.wait_for_line("ready, waiting for frames");
    let mut publisher = cell.publisher();
    send(&mut publisher, 0);
    let scene = scenes.of_frame(0);
    assert_eq!((&scene["region_count"], &scene["object_count"]), (&1.into(), &1.into()), "{scene}");
    assert!(scene["regions"].as_array().unwrap().is_empty() && scene["objects"].as_array().unwrap().is_empty());
    assert!(scene["grasp"].is_object(), "what a client acts on is there: {scene}");
    daemon.wait().assert_success();
    // The recording has them.
    assert_eq!(json(&messages(&only_recording(&cell)), "/scene")[0]["objects"].as_array().unwrap().len(), 1);
}
