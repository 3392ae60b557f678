//! Objects in millimetres: samsodd with a calibrated camera, from a frame to the recording and the robot.

// A test says what went wrong best by stopping there.
#![allow(clippy::unwrap_used, clippy::panic)]

mod support;

use std::fs;
use std::path::{Path, PathBuf};

use foxglove::messages::{FrameTransforms, ImageAnnotations, PosesInFrame, RawImage};
use prost::Message;
use serde_json::Value;
use support::{TestCell, count, json, messages, send};

const FRAME: &str = "0032.jpg";
/// What lies on the table of that frame: (x, y), mm, and the yaw of the longer side, degrees, where one is plainly longer.
/// From the description by which it was rendered.
const PARTS: [(&str, [f64; 2], Option<f64>); 4] = [
    ("star knob", [-129.7, -231.0], None),
    ("sensor box", [152.5, -80.3], Some(114.7)),
    ("flange", [-92.2, -80.9], None),
    ("dovetail plate", [46.8, -47.0], Some(39.6)),
];
/// The parts are 14 to 27 mm high; what is seen of them lies at about this height.
const OBJECT_HEIGHT_MM: f64 = 15.0;
/// Masks are those of the chain, not the true ones, and parts are of different heights: 0.6 mm a pixel.
const TOLERANCE_MM: f64 = 4.0;
const TOLERANCE_DEG: f64 = 3.0;

/// The camera that the frame was rendered with.
const CAMERA: &str = "\
[intrinsics]
width_px = 1078
height_px = 958
fx_px = 1600.0
fy_px = 1600.0
cx_px = 541.2
cy_px = 476.6
k1 = 0.0
k2 = 0.0
p1 = 0.0
p2 = 0.0
k3 = 0.0
[world]
world_from_camera_mm = [[1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 900.0], [0.0, 0.0, 0.0, 1.0]]
";
/// The robot stands at the side: base x is world y, base y is minus world x.
const BASE: &str = "\
[base]
base_from_world_mm = [[0.0, 1.0, 0.0, 500.0], [-1.0, 0.0, 0.0, 30.0], [0.0, 0.0, 1.0, 12.0], [0.0, 0.0, 0.0, 1.0]]
points = 4
rms_mm = 0.2
";

/// A folder with the frame alone.
fn frame_folder(cell: &TestCell) -> PathBuf {
    let folder = cell.path("frames");
    fs::create_dir_all(&folder).unwrap();
    let bundled = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/data/cell").join(FRAME);
    fs::copy(bundled, folder.join(FRAME)).unwrap();
    folder
}

/// Writes a camera file and a configuration that uses it.
fn config(cell: &TestCell, camera: &str) -> PathBuf {
    fs::write(cell.path("camera.toml"), camera).unwrap();
    let keys = format!("file = \"camera.toml\"\nobject_height_mm = {OBJECT_HEIGHT_MM:?}");
    cell.config(&[("camera", &keys)])
}

/// What samsodd recorded of the frame, and its report.
fn record(cell: &TestCell, config: &Path) -> (Vec<(String, Vec<u8>)>, support::Ended) {
    let daemon = cell.spawn_daemon(config, &["--frames", "1"]);
    daemon.wait_for_line("ready, waiting for frames");
    // Again and again: under load the service may still be joining when the first is sent.
    let client = cell.spawn_client(&frame_folder(cell), &["--rate", "2", "--loop"]);
    let ended = daemon.wait();
    ended.assert_success();
    client.terminate();
    let files = cell.recordings();
    assert_eq!(files.len(), 1, "{files:?}");
    (messages(&files[0]), ended)
}

fn only<M: Message + Default>(messages: &[(String, Vec<u8>)], topic: &str) -> M {
    let data: Vec<_> = messages.iter().filter(|(t, _)| t == topic).collect();
    assert_eq!(data.len(), 1, "{topic}");
    M::decode(data[0].1.as_slice()).unwrap()
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("{value} is no number"))
}

fn xy(pose: &Value) -> [f64; 2] {
    [number(&pose["x_mm"]), number(&pose["y_mm"])]
}

fn distance(a: [f64; 2], b: [f64; 2]) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

/// Between lines, which have no direction.
fn angle_between(a_deg: f64, b_deg: f64) -> f64 {
    let turned = (a_deg - b_deg).rem_euclid(180.0);
    turned.min(180.0 - turned)
}

#[test]
fn parts_are_recorded_where_they_lie_on_the_table_and_at_the_robot() {
    let cell = TestCell::new();
    let (messages, ended) = record(&cell, &config(&cell, &format!("{CAMERA}{BASE}")));
    let scene = &json(&messages, "/scene")[0];
    let objects = scene["objects"].as_array().unwrap();
    assert!((PARTS.len()..PARTS.len() + 3).contains(&objects.len()), "{scene}");
    for (part, at, yaw_deg) in PARTS {
        let off = |object: &&Value| distance(xy(&object["world"]), at);
        let nearest = objects.iter().min_by(|a, b| off(a).total_cmp(&off(b))).unwrap();
        assert!(off(&nearest) < TOLERANCE_MM, "{part} at {at:?} is off by {} mm: {nearest}", off(&nearest));
        assert_eq!(nearest["world"]["z_mm"], OBJECT_HEIGHT_MM);
        if let Some(yaw_deg) = yaw_deg {
            let error = angle_between(number(&nearest["world"]["yaw_deg"]), yaw_deg);
            assert!(error < TOLERANCE_DEG, "{part} is turned by {error} degrees: {nearest}");
        }
    }

    let masks: RawImage = only(&messages, "/masks");
    assert_eq!((masks.width, masks.height, masks.encoding.as_str(), masks.step), (1078, 958, "mono8", 1078));
    let code_at = |x: f64, y: f64| masks.data[y as usize * 1078 + x as usize];
    let outlines: ImageAnnotations = only(&messages, "/outlines");
    let places: PosesInFrame = only(&messages, "/places");
    assert_eq!(
        (places.frame_id.as_str(), places.poses.len(), outlines.texts.len()),
        ("world", objects.len(), objects.len())
    );
    for (i, object) in objects.iter().enumerate() {
        let code = 255 - i as u8;
        // Numbers, codes, outlines and poses are of the same object.
        let (mut area, mut sum) = (0.0, [0.0; 2]);
        for (pixel, _) in masks.data.iter().enumerate().filter(|(_, c)| **c == code) {
            area += 1.0;
            sum[0] += (pixel % 1078) as f64;
            sum[1] += (pixel / 1078) as f64;
        }
        assert_eq!(object["area_px"], area, "object {i}");
        let [u, v] = sum.map(|s| s / area);
        let centroid = [number(&object["centroid_px"][0]), number(&object["centroid_px"][1])];
        assert!(distance(centroid, [u, v]) < 0.01, "object {i}: {centroid:?}, its mask has {u}, {v}");
        // By hand: straight down, the plane of the objects is 885 mm away.
        let scale = (900.0 - OBJECT_HEIGHT_MM) / 1600.0;
        let by_hand = [(u - 541.2) * scale, (476.6 - v) * scale];
        let world = xy(&object["world"]);
        assert!(distance(world, by_hand) < 0.01, "object {i}: {world:?}, by hand {by_hand:?}");
        let position = places.poses[i].position.unwrap();
        assert!(distance([position.x * 1e3, position.y * 1e3], world) < 1e-6, "metres on /places");
        let base = &object["base"];
        assert!(distance(xy(base), [500.0 + world[1], 30.0 - world[0]]) < 1e-6, "{object}");
        assert!((number(&base["z_mm"]) - 12.0 - OBJECT_HEIGHT_MM).abs() < 1e-9, "{object}");
        let turned = number(&base["yaw_deg"]) + 90.0;
        assert!(angle_between(turned, number(&object["world"]["yaw_deg"])) < 1e-6, "{object}");
        let text = &outlines.texts[i].text;
        assert!(text.starts_with(&format!("object {i}: ({:.1}, {:.1}) mm", world[0], world[1])), "{text}");
    }
    for outline in &outlines.points {
        let code = code_at(outline.points[0].x, outline.points[0].y);
        assert!(code >= 129 && outline.points.iter().all(|p| code_at(p.x, p.y) == code), "an outline beside its mask");
    }
    // Every part of this frame throws a shadow, and shadows have the numbers of objects.
    let shadow: Vec<u8> = masks.data.iter().copied().filter(|code| (1..=127).contains(code)).collect();
    assert!(shadow.len() > 3000, "{} px of shadow", shadow.len());
    assert!(shadow.iter().all(|code| usize::from(127 - code) < objects.len()));

    let tf: FrameTransforms = only(&messages, "/tf");
    let at = tf.transforms[0].translation.unwrap();
    assert_eq!((at.x, at.y, at.z), (0.5, 0.03, 0.012));
    // The robot is sent over the object with the most pixels.
    let largest = objects.iter().max_by_key(|o| o["area_px"].as_u64()).unwrap();
    let target = &json(&messages, "/robot/command")[0]["target"];
    assert!(distance(xy(target), xy(&largest["base"])) < 1e-6, "{target} for {largest}");
    // 200 mm over the table, which is 12 mm over the base.
    assert!((number(&target["z_mm"]) - 212.0).abs() < 1e-9, "{target}");
    assert_eq!((ended.count("commands", "sent"), ended.count("commands", "done")), (1, 1));
}

#[test]
fn without_a_base_objects_are_placed_and_the_robot_is_not_commanded() {
    let cell = TestCell::new();
    let (messages, ended) = record(&cell, &config(&cell, CAMERA));
    let scene = &json(&messages, "/scene")[0];
    let objects = scene["objects"].as_array().unwrap();
    assert!(!objects.is_empty() && objects.iter().all(|o| o["world"].is_object() && o["base"].is_null()), "{scene}");
    for (topic, expected) in [("/places", 1), ("/tf", 0), ("/robot/command", 0), ("/pick/target", 0)] {
        assert_eq!(count(&messages, topic), expected, "{topic}");
    }
    let reason =
        "commands   none, the camera file has no [base]: touch points of the table with `samsod calibrate touch`";
    assert!(ended.stdout.lines().any(|line| line == reason), "{}", ended.stdout);
}

#[test]
fn without_a_camera_objects_have_places_in_the_image_only() {
    let cell = TestCell::new();
    let mut scenes = cell.scenes();
    let daemon = cell.spawn_daemon(&cell.config(&[("camera", "")]), &["--frames", "1"]);
    let expected = "neither [camera] file nor [view] is given: objects have no place in mm, no robot is commanded";
    daemon.wait_for_line(expected);
    daemon.wait_for_line("ready, waiting for frames");
    let mut publisher = cell.publisher();
    send(&mut publisher, 0);
    let scene = scenes.of_frame(0);
    let object = &scene["objects"][0];
    assert!((6.0..30.0).contains(&number(&object["centroid_px"][0])), "{scene}");
    assert!(object["world"].is_null() && object["base"].is_null() && object["size_mm"].is_null(), "{scene}");
    assert!(scene["grasp"].is_null() && scene["best_object"].is_null(), "{scene}");
    let ended = daemon.wait();
    ended.assert_success();
    let messages = messages(&cell.recordings()[0]);
    for (topic, expected) in [("/masks", 1), ("/outlines", 1), ("/places", 0), ("/tf", 0), ("/robot/command", 0)] {
        assert_eq!(count(&messages, topic), expected, "{topic}");
    }
    let line = "objects    1 (1.0 a frame), 0 placed in mm";
    assert!(ended.stdout.lines().any(|l| l == line), "{}", ended.stdout);
}

#[test]
fn a_frame_of_another_size_than_the_calibrations_is_refused() {
    let cell = TestCell::new();
    let daemon = cell.spawn_daemon(&config(&cell, CAMERA), &[]);
    daemon.wait_for_line("ready, waiting for frames");
    let mut publisher = cell.publisher();
    send(&mut publisher, 0);
    daemon.wait_for_line("frame is 64 x 48 px; the camera of [camera] file has 1078 x 958 px");
    let ended = daemon.terminate();
    assert_eq!((ended.count("frames", "rejected"), ended.count("frames", "processed")), (1, 0));
    assert_eq!(count(&messages(&cell.recordings()[0]), "/log"), 1);
}

#[test]
fn a_camera_file_that_cannot_be_used_stops_the_service_and_the_check() {
    let cell = TestCell::new();
    let unplaced = CAMERA.split("[world]").next().unwrap();
    for arguments in [&[][..], &["--check-config"]] {
        let ended = cell.spawn_daemon(&config(&cell, unplaced), arguments).wait();
        assert_eq!(ended.status.code(), Some(2), "{ended:?}");
        let expected = format!("[camera] file: {}: there is no [world]", cell.path("camera.toml").display());
        assert!(ended.stderr.contains(&expected), "{}", ended.stderr);
    }
    let ended = cell.spawn_daemon(&config(&cell, CAMERA), &["--check-config"]).wait();
    ended.assert_success();
    assert!(ended.stdout.contains("object_height_mm = 15.0"), "{}", ended.stdout);
    let both = cell.config(&[("camera", "file = \"camera.toml\""), ("view", "")]);
    let ended = cell.spawn_daemon(&both, &[]).wait();
    assert_eq!(ended.status.code(), Some(2), "{ended:?}");
    assert!(ended.stderr.contains("camera.toml and [view] are both given"), "{}", ended.stderr);
}
