//! Parts by name: samsodd and samsod inspect with a catalogue, and a part that the catalogue had not known.

// A test says what went wrong best by stopping there.
#![allow(clippy::unwrap_used, clippy::panic)]

mod support;

use std::fs;
use std::path::{Path, PathBuf};

use foxglove::messages::{ImageAnnotations, points_annotation};
use prost::Message;
use serde_json::Value;
use support::{Ended, TestCell, count, json, messages, samsod, send, test_data};

/// What lies on the table of frame 0032: name, (x, y) mm, yaw in degrees and the order of the part's symmetry. From the
/// description by which it was rendered.
const PARTS: [(&str, [f64; 2], f64, f64); 4] = [
    ("star_knob", [-129.7, -231.0], 134.8, 5.0),
    ("sensor_box", [152.5, -80.3], 114.7, 1.0),
    ("flange", [-92.2, -80.9], 80.8, 1.0),
    ("dovetail_plate", [46.8, -47.0], 39.6, 1.0),
];

/// Places and yaws are those of the chain's masks and of matching, not the rendered ones.
const TOLERANCE_MM: f64 = 3.0;
const TOLERANCE_DEG: f64 = 5.0;

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("{value} is no number"))
}

/// Between directions of a part that looks the same `order` times a turn.
fn angle_between(a_deg: f64, b_deg: f64, order: f64) -> f64 {
    let turn = 360.0 / order;
    let off = (a_deg - b_deg).rem_euclid(turn);
    off.min(turn - off)
}

/// Runs samsodd on one frame with the bundled camera and a catalogue.
fn record(cell: &TestCell, catalogue: &Path) -> (Vec<(String, Vec<u8>)>, Ended) {
    let camera = format!("file = {:?}\nobject_height_mm = 15.0", test_data("cell/camera.toml"));
    let config = cell.config(&[("camera", &camera), ("catalogue", &format!("folder = {catalogue:?}"))]);
    let daemon = cell.spawn_daemon(&config, &["--frames", "1"]);
    daemon.wait_for_line("ready, waiting for frames");
    let frames = cell.path("frames");
    fs::create_dir_all(&frames).unwrap();
    fs::copy(test_data("cell/0032.jpg"), frames.join("0032.jpg")).unwrap();
    // Again and again: under load the service may still be joining when the first is sent.
    let client = cell.spawn_client(&frames, &["--rate", "2", "--loop"]);
    let ended = daemon.wait();
    ended.assert_success();
    client.terminate();
    (messages(&cell.recordings()[0]), ended)
}

#[test]
fn parts_are_recorded_by_name_where_they_lie_and_the_robot_goes_to_the_surest() {
    let cell = TestCell::new();
    let (messages, ended) = record(&cell, &test_data("parts"));
    let scene = &json(&messages, "/scene")[0];
    let detections = scene["detections"].as_array().unwrap();
    for (name, [x, y], yaw_deg, order) in PARTS {
        let found: Vec<_> = detections.iter().filter(|d| d["name"] == name).collect();
        assert_eq!(found.len(), 1, "{name}: {scene}");
        let (world, base) = (&found[0]["world"], &found[0]["base"]);
        let off = (number(&world["x_mm"]) - x).hypot(number(&world["y_mm"]) - y);
        assert!(off < TOLERANCE_MM, "{name} is off by {off} mm: {}", found[0]);
        let turned = angle_between(number(&world["yaw_deg"]), yaw_deg, order);
        assert!(turned < TOLERANCE_DEG, "{name} is turned by {turned} degrees: {}", found[0]);
        // The camera looks straight down: counter-clockwise is the same from above and on the screen.
        let image_deg = number(&found[0]["image"]["angle_deg"]);
        assert!(angle_between(image_deg, number(&world["yaw_deg"]), order) < 1.0, "{}", found[0]);
        assert!((number(&base["x_mm"]) - number(&world["x_mm"]) - 500.0).abs() < 1e-6, "{}", found[0]);
        assert!(!found[0]["objects"].as_array().unwrap().is_empty(), "{}", found[0]);
    }
    let overlay = messages.iter().find(|(topic, _)| topic == "/detections").unwrap();
    let overlay = ImageAnnotations::decode(overlay.1.as_slice()).unwrap();
    assert_eq!(overlay.texts.len(), detections.len());
    for (text, detection) in overlay.texts.iter().zip(detections) {
        let name = detection["name"].as_str().unwrap_or("unknown");
        let expected = format!("{name} {:.2}", number(&detection["score"]));
        assert!(text.text.starts_with(&expected), "{} for {detection}", text.text);
    }
    let lists = i32::from(points_annotation::Type::LineList);
    assert_eq!(overlay.points.iter().filter(|p| p.r#type == lists).count(), detections.len());
    assert!(number(&json(&messages, "/stage/timings")[0]["recognize_ms"]) > 0.0);

    let surest = detections
        .iter()
        .filter(|d| d["name"].is_string())
        .max_by(|a, b| number(&a["score"]).total_cmp(&number(&b["score"])));
    let (target, base) = (&json(&messages, "/robot/command")[0]["target"], &surest.unwrap()["base"]);
    // The grasps of the bundled parts are at their origins.
    let off = (number(&target["x_mm"]) - number(&base["x_mm"])).hypot(number(&target["y_mm"]) - number(&base["y_mm"]));
    assert!(off < 1e-6, "{target} for {base}");
    assert!(ended.stdout.contains("recognised, ") && ended.stdout.contains("the catalogue has 20"), "{}", ended.stdout);
}

#[test]
fn nothing_unknown_is_gone_to() {
    let cell = TestCell::new();
    let mut scenes = cell.scenes();
    let catalogue = format!("folder = {:?}", test_data("parts"));
    let daemon = cell.spawn_daemon(&cell.config(&[("catalogue", &catalogue)]), &["--frames", "1"]);
    daemon.wait_for_line("ready, waiting for frames");
    let mut publisher = cell.publisher();
    // A red square of 12 px, 4.8 mm: no part of the catalogue is so small.
    send(&mut publisher, 0);
    let scene = scenes.of_frame(0);
    assert_eq!(scene["object_count"], 1, "{scene}");
    assert!(scene["objects"][0]["base"].is_object(), "it has a place: {scene}");
    assert!(scene["best_object"].is_null() && scene["best_detection"].is_null() && scene["grasp"].is_null(), "{scene}");
    assert!(scene["detections"].as_array().unwrap().iter().all(|d| d["name"].is_null()), "{scene}");
    assert!(number(&scene["times_ms"]["recognize"]) >= 0.0, "{scene}");
    let ended = daemon.wait();
    ended.assert_success();
    assert_eq!(ended.count("commands", "sent"), 0);
    let messages = messages(&cell.recordings()[0]);
    assert_eq!((count(&messages, "/detections"), count(&messages, "/robot/command")), (1, 0));
}

/// Inspects a bundled frame with a catalogue.
fn inspect(frame: &str, catalogue: &Path, out: &Path) -> (Ended, Value) {
    let (image, camera) = (test_data(&format!("cell/{frame}.jpg")), test_data("cell/camera.toml"));
    let mut arguments = vec!["inspect", text(&image), "--camera", text(&camera)];
    arguments.extend(["--catalogue", text(catalogue), "--out", text(out)]);
    let ended = samsod(&arguments);
    ended.assert_success();
    let report = fs::read(out.join(format!("{frame}.json"))).unwrap();
    (ended, serde_json::from_slice(&report).unwrap())
}

fn names(report: &Value) -> Vec<String> {
    let detections = report["detections"].as_array().unwrap();
    detections.iter().filter_map(|d| d["name"].as_str()).map(str::to_owned).collect()
}

/// The bundled catalogue without a part.
fn catalogue_without(name: &str, folder: &Path) -> PathBuf {
    let parts = folder.join("parts");
    for entry in fs::read_dir(test_data("parts")).unwrap() {
        let path = entry.unwrap().path();
        if !path.is_dir() || path.file_name().unwrap() == name {
            continue;
        }
        let copy = parts.join(path.file_name().unwrap());
        fs::create_dir_all(&copy).unwrap();
        for file in ["part.toml", "template.png", "mask.png", "model.stl"] {
            fs::copy(path.join(file), copy.join(file)).unwrap();
        }
    }
    parts
}

#[test]
fn inspect_names_parts_in_its_table_its_figures_and_its_picture() {
    let folder = tempfile::tempdir().unwrap();
    let (ended, report) = inspect("0032", &test_data("parts"), folder.path());
    let drawn = image::open(folder.path().join("0032-detections.png")).unwrap().into_rgb8();
    let frame = image::open(test_data("cell/0032.jpg")).unwrap().into_rgb8();
    assert_eq!(drawn.dimensions(), frame.dimensions());
    let found = names(&report);
    for (name, ..) in PARTS {
        assert!(found.iter().any(|n| n == name), "{name}: {found:?}");
        assert!(ended.stdout.lines().any(|line| line.starts_with(&format!("{name} "))), "{}", ended.stdout);
    }
    // Names are white dots, or coloured, on black: a frame has no black row of 20 px.
    let black_rows = drawn.rows().filter(|row| {
        let row: Vec<bool> = row.clone().map(|p| p.0 == [0; 3]).collect();
        row.windows(20).any(|window| window.iter().all(|&black| black))
    });
    assert!(black_rows.count() >= 2 * PARTS.len(), "names stand on black fields");
}

#[test]
fn few_features_name_a_part_only_where_its_edges_confirm_it() {
    let folder = tempfile::tempdir().unwrap();
    let detections = |parts: &Path, confirm: bool| -> Vec<Value> {
        let config = folder.path().join("cell.toml");
        let recognize = format!("[recognize]\nmethod = \"sift\"\nsift = {{ confirm = {confirm} }}\n");
        fs::write(&config, format!("[cell]\nname = \"features\"\n[view]\n{recognize}")).unwrap();
        let mut arguments = vec!["inspect".to_owned(), text(&test_data("cell/0008.jpg")).to_owned()];
        for (flag, path) in [
            ("--config", config.as_path()),
            ("--camera", &test_data("cell/camera.toml")),
            ("--catalogue", parts),
            ("--out", folder.path()),
        ] {
            arguments.extend([flag.to_owned(), text(path).to_owned()]);
        }
        samsod(&arguments.iter().map(String::as_str).collect::<Vec<_>>()).assert_success();
        let report: Value = serde_json::from_slice(&fs::read(folder.path().join("0008.json")).unwrap()).unwrap();
        report["detections"].as_array().unwrap().clone()
    };
    let named = |found: &[Value], name: &str| found.iter().find(|d| d["name"] == name).cloned();
    // The lettering of the shaft is too fine for features to agree on, that of the plate is not.
    let (alone, confirmed) = (detections(&test_data("parts"), false), detections(&test_data("parts"), true));
    for found in [&alone, &confirmed] {
        assert_eq!(named(found, "asym_plate").unwrap()["method"], "sift", "{found:?}");
    }
    assert_eq!(named(&alone, "stepped_shaft"), None);
    let shaft = named(&confirmed, "stepped_shaft").unwrap();
    assert_eq!(shaft["method"], "shape", "its pose is that of its edges: {shaft}");
    // What is missing from the catalogue is not called anything else.
    let parts = catalogue_without("stepped_shaft", folder.path());
    let [u, v] = [0, 1].map(|i| number(&shaft["image"]["origin_px"][i]));
    let there = detections(&parts, true).into_iter().find(|d| {
        let [x, y] = [0, 1].map(|i| number(&d["image"]["origin_px"][i]));
        (x - u).hypot(y - v) < 30.0
    });
    assert!(there.as_ref().is_none_or(|d| d["name"].is_null()), "{there:?}");
}

#[test]
fn a_part_that_the_catalogue_has_never_seen_is_named_once_it_is_taught() {
    let folder = tempfile::tempdir().unwrap();
    let parts = catalogue_without("sensor_box", folder.path());
    let (_, before) = inspect("0032", &parts, folder.path());
    let at_box = |report: &Value| {
        let detections = report["detections"].as_array().unwrap().clone();
        detections.into_iter().find(|d| {
            let [u, v] = [0, 1].map(|i| number(&d["image"]["origin_px"][i]));
            (u - 815.7).hypot(v - 622.1) < 30.0
        })
    };
    let unknown = at_box(&before).unwrap();
    assert!(unknown["name"].is_null(), "not forced to be another: {unknown}");
    let (picture, camera) = (test_data("teach/sensor_box.jpg"), test_data("cell/camera.toml"));
    let model = test_data("parts/sensor_box/model.stl");
    let mut arguments = vec!["teach", text(&picture), "--name", "sensor_box", "--stl", text(&model)];
    arguments.extend(["--camera", text(&camera), "--catalogue", text(&parts)]);
    samsod(&arguments).assert_success();
    let (_, after) = inspect("0032", &parts, folder.path());
    assert_eq!(at_box(&after).unwrap()["name"], "sensor_box");
}
