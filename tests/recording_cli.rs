//! `samsod recording` and `samsod inspect`, as an operator runs them.

// A test says what went wrong best by stopping there.
#![allow(clippy::unwrap_used, clippy::panic)]

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use image::{Rgb, RgbImage};
use samsod::segment::RgbView;
use samsod::{Cell, CellParams};
use samsod_daemon::recording::{CommandRecord, FrameRecord, Recorder, RecorderConfig};
use samsod_robot::{CommandId, Motion, Pose};

const FRAMES: u64 = 5;

/// A grey table with a red and a blue part on it.
fn table() -> RgbImage {
    RgbImage::from_fn(160, 120, |x, y| match (x, y) {
        (30..=60, 30..=70) => Rgb([190, 40, 40]),
        (100..=130, 50..=80) => Rgb([40, 60, 180]),
        _ => Rgb([150, 150, 145]),
    })
}

fn record(folder: &Path) -> PathBuf {
    let image = table();
    let view = RgbView::from_raw(160, 120, image.as_raw().as_slice()).unwrap();
    let scene = Cell::new(CellParams::default()).unwrap().inspect(&view).unwrap();
    let config = RecorderConfig { folder: folder.to_path_buf(), min_free_mib: 0, ..RecorderConfig::default() };
    let recorder = Recorder::start(&config, "bench").unwrap();
    for sequence in 0..FRAMES {
        let timestamp_ns = 1_700_000_000_000_000_000 + sequence * 500_000_000;
        let frame = FrameRecord {
            timestamp_ns,
            sequence,
            camera: "overhead",
            image: &view,
            scene: &scene,
            places: None,
            base_from_world: None,
            other_times: &[],
        };
        while !recorder.log_frame(&frame) {
            std::thread::yield_now();
        }
    }
    let command = samsod_robot::Command::Move(Motion::Joint {
        target: Pose::gripper_down(400.0, 0.0, 200.0, 0.0),
        speed_fraction: 0.2,
    });
    recorder
        .log_command(&CommandRecord {
            id: CommandId(1),
            timestamp_ns: 1_700_000_001_000_000_000,
            frame_sequence: Some(0),
            frame_timestamp_ns: None,
            phase: None,
            part: None,
            command: &command,
        })
        .unwrap();
    recorder.finish().unwrap().files.remove(0)
}

fn samsod(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_samsod")).args(arguments).output().unwrap()
}

fn stdout(output: &Output) -> String {
    String::from_utf8(output.stdout.clone()).unwrap()
}

fn stderr(output: &Output) -> String {
    String::from_utf8(output.stderr.clone()).unwrap()
}

/// The figures of the line that begins with `name`.
fn line<'a>(text: &'a str, name: &str) -> Vec<&'a str> {
    let found = text.lines().find(|line| line.split_whitespace().next() == Some(name));
    found.unwrap_or_else(|| panic!("no line {name} in\n{text}")).split_whitespace().skip(1).collect()
}

#[test]
fn a_recording_is_listed() {
    let folder = tempfile::tempdir().unwrap();
    let file = record(folder.path());
    let output = samsod(&["recording", file.to_str().unwrap()]);
    let text = stdout(&output);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    assert_eq!(line(&text, "length")[0], "2.000");
    assert_eq!(line(&text, "frames")[0], "5,");
    assert_eq!(line(&text, "found")[..7], ["10", "salient", "regions,", "10", "objects", "(2.0", "a"], "{text}");
    assert_eq!(line(&text, "commands"), ["1"]);
    assert_eq!(line(&text, "/camera/image")[..3], ["foxglove.CompressedImage", "protobuf", "5"]);
    assert_eq!(line(&text, "/segment/labels")[..3], ["foxglove.RawImage", "protobuf", "5"]);
    assert_eq!(line(&text, "/regions")[..3], ["foxglove.ImageAnnotations", "protobuf", "5"]);
    assert_eq!(line(&text, "/detections")[..3], ["foxglove.ImageAnnotations", "protobuf", "5"]);
    assert!(!text.contains("recognised"), "no catalogue, no parts: {text}");
    assert_eq!(line(&text, "/masks")[..3], ["foxglove.RawImage", "protobuf", "5"]);
    assert_eq!(line(&text, "/outlines")[..3], ["foxglove.ImageAnnotations", "protobuf", "5"]);
    assert_eq!(line(&text, "/places")[..3], ["foxglove.PosesInFrame", "protobuf", "0"]);
    assert_eq!(line(&text, "/robot/command")[..3], ["samsod.Command", "json", "1"]);
    for stage in ["segment", "saliency", "regions", "shadow", "recognize", "total"] {
        assert_eq!(line(&text, stage)[0], "5", "{stage}");
    }
}

#[test]
fn a_cut_off_recording_is_listed_as_far_as_it_goes_with_exit_code_3() {
    let folder = tempfile::tempdir().unwrap();
    let file = record(folder.path());
    let whole = std::fs::read(&file).unwrap();
    std::fs::write(&file, &whole[..whole.len() * 6 / 10]).unwrap();
    let output = samsod(&["recording", file.to_str().unwrap()]);
    assert_eq!(output.status.code(), Some(3), "{}", stderr(&output));
    assert!(stderr(&output).contains(file.to_str().unwrap()), "{}", stderr(&output));
    let images: u64 = line(&stdout(&output), "/camera/image")[2].parse().unwrap();
    assert!((1..FRAMES).contains(&images), "{images}");
}

#[test]
fn a_sheet_is_drawn_from_the_recording_alone_even_a_cut_off_one() {
    let folder = tempfile::tempdir().unwrap();
    let file = record(folder.path());
    let sheet = folder.path().join("sheet.png");
    let arguments = ["recording", file.to_str().unwrap(), "--sheet", sheet.to_str().unwrap(), "--frames", "2"];
    let output = samsod(&arguments);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    let picture = image::open(&sheet).unwrap().into_rgb8();
    assert_eq!(picture.dimensions(), (5 * 366 + 6, 2 * 276 + 6));
    // The middle of the red part: as it is in the frame, in its mean colour among the partitions, bright in the map.
    let at = |tile: u32| picture.get_pixel(6 + tile * 366 + 45 * 360 / 160, 6 + 50 * 270 / 120).0;
    for tile in [0, 1, 3] {
        let [red, green, _] = at(tile);
        assert!(red > 150 && green < 80, "tile {tile}: {:?}", at(tile));
    }
    assert!(at(2)[0] > 120 && at(2)[0] == at(2)[1], "{:?}", at(2));
    // Off its number, the red part is tinted among the objects, and the table is not.
    let in_objects = |x: u32, y: u32| picture.get_pixel(6 + 4 * 366 + x * 360 / 160, 6 + y * 270 / 120).0;
    assert_ne!(in_objects(36, 62), [190, 40, 40]);
    assert!(in_objects(36, 62)[0] > 190, "towards the first colour of the palette: {:?}", in_objects(36, 62));
    assert_eq!(in_objects(10, 10), [150, 150, 145]);

    let whole = std::fs::read(&file).unwrap();
    std::fs::write(&file, &whole[..whole.len() * 6 / 10]).unwrap();
    std::fs::remove_file(&sheet).unwrap();
    assert_eq!(samsod(&arguments).status.code(), Some(3));
    assert_eq!(image::open(&sheet).unwrap().width(), 5 * 366 + 6);
}

#[test]
fn what_is_no_recording_is_an_error_that_names_the_file() {
    let folder = tempfile::tempdir().unwrap();
    let text = folder.path().join("notes.mcap");
    std::fs::write(&text, "not a recording").unwrap();
    let missing = folder.path().join("missing.mcap");
    let empty = folder.path().join("empty.mcap");
    std::fs::write(&empty, "").unwrap();
    let in_its_place = folder.path().join("folder.mcap");
    std::fs::create_dir(&in_its_place).unwrap();
    for (file, what) in [
        (&text, "is no MCAP recording: it begins with \"not a re\""),
        (&missing, "No such file"),
        (&empty, "is no MCAP recording: it is empty"),
        (&in_its_place, "is no MCAP recording: it is a folder"),
    ] {
        for command in ["recording", "recover"] {
            let output = samsod(&[command, file.to_str().unwrap()]);
            assert_eq!(output.status.code(), Some(1), "{command}");
            let said = stderr(&output);
            assert!(said.contains(file.to_str().unwrap()) && said.contains(what), "{command}: {said}");
        }
    }
    let left: Vec<_> = std::fs::read_dir(folder.path()).unwrap().collect();
    assert_eq!(left.len(), 3, "nothing was made of nothing: {left:?}");
}

#[test]
fn a_recording_is_recovered_whole_or_cut_off() {
    let folder = tempfile::tempdir().unwrap();
    let file = record(folder.path());
    let out = folder.path().join("whole.mcap");
    let arguments = ["recover", file.to_str().unwrap(), "--out", out.to_str().unwrap()];
    let output = samsod(&arguments);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    assert_eq!(line(&stdout(&output), "/camera/image"), ["5", "0"]);
    assert!(!stdout(&output).contains("lost  ") && !stdout(&output).contains("not closed"), "{}", stdout(&output));
    // Never over what is there.
    let before = std::fs::read(&out).unwrap();
    let output = samsod(&arguments);
    assert_eq!(output.status.code(), Some(1));
    assert!(stderr(&output).contains("File exists") && stderr(&output).contains("--out"), "{}", stderr(&output));
    assert_eq!(std::fs::read(&out).unwrap(), before);

    let whole = std::fs::read(&file).unwrap();
    std::fs::write(&file, &whole[..whole.len() * 6 / 10]).unwrap();
    let output = samsod(&["recover", file.to_str().unwrap()]);
    assert_eq!(output.status.code(), Some(3), "{}", stderr(&output));
    assert!(stderr(&output).contains("1 damaged places"), "{}", stderr(&output));
    let text = stdout(&output);
    assert!(text.contains("the file ends in the middle of"), "{text}");
    let images: u64 = line(&text, "/camera/image")[0].parse().unwrap();
    assert!((1..FRAMES).contains(&images), "{text}");
    // What came of it is whole.
    let recovered = file.with_file_name(format!("{}-recovered.mcap", file.file_stem().unwrap().to_str().unwrap()));
    let output = samsod(&["recording", recovered.to_str().unwrap()]);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    assert_eq!(line(&stdout(&output), "/camera/image")[2], images.to_string());
}

#[test]
fn inspect_writes_pictures_and_figures() {
    let folder = tempfile::tempdir().unwrap();
    let image = folder.path().join("table.png");
    table().save(&image).unwrap();
    let out = folder.path().join("results");
    let output = samsod(&["inspect", image.to_str().unwrap(), "--out", out.to_str().unwrap()]);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    for name in ["table-objects.png", "table-regions.png", "table-partitions.png", "table-saliency.png"] {
        assert_eq!(image::open(out.join(name)).unwrap().into_rgb8().dimensions(), (160, 120), "{name}");
    }
    let report: serde_json::Value = serde_json::from_slice(&std::fs::read(out.join("table.json")).unwrap()).unwrap();
    let regions = report["regions"].as_array().unwrap();
    assert_eq!(regions.len(), 2, "{report}");
    let first = regions[0]["centroid_px"].as_array().unwrap();
    let near = |value: &serde_json::Value, expected: f64| (value.as_f64().unwrap() - expected).abs() < 3.0;
    assert!(near(&first[0], 45.0) && near(&first[1], 50.0), "the red part is the larger: {report}");
    assert!(report["times_ms"]["segment"].as_f64().unwrap() > 0.0);
    // The outline of the red part must show on the picture.
    let drawn = image::open(out.join("table-regions.png")).unwrap().into_rgb8();
    assert_ne!(drawn.get_pixel(30, 50), table().get_pixel(30, 50));
    assert_eq!(drawn.get_pixel(10, 10), table().get_pixel(10, 10));
    let drawn = image::open(out.join("table-objects.png")).unwrap().into_rgb8();
    assert_ne!(drawn.get_pixel(36, 62), table().get_pixel(36, 62), "inside the red part");
    assert_eq!(drawn.get_pixel(10, 10), table().get_pixel(10, 10));
    // Nobody has told how large a pixel is.
    assert!(report["objects"].as_array().unwrap().len() == 2 && report["objects"][0]["world"].is_null(), "{report}");
    assert!(!stdout(&output).contains("world mm"), "{}", stdout(&output));
}

#[test]
fn inspect_places_objects_with_a_camera_file_or_a_view() {
    let folder = tempfile::tempdir().unwrap();
    let image = folder.path().join("table.png");
    table().save(&image).unwrap();
    let write = |name: &str, text: &str| {
        let path = folder.path().join(name);
        std::fs::write(&path, text).unwrap();
        path.to_str().unwrap().to_owned()
    };
    // 400 mm above the table, 0.5 mm a pixel; the origin is under the middle of the image.
    let camera = "[intrinsics]\nwidth_px = 160\nheight_px = 120\nfx_px = 800.0\nfy_px = 800.0\ncx_px = 80.0\ncy_px = 60.0\n\
        k1 = 0.0\nk2 = 0.0\np1 = 0.0\np2 = 0.0\nk3 = 0.0\n[world]\nworld_from_camera_mm = [[1.0, 0.0, 0.0, 0.0], \
        [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 400.0], [0.0, 0.0, 0.0, 1.0]]\n";
    let camera = write("camera.toml", camera);
    let with_camera = write("camera-cell.toml", "[camera]\nfile = \"camera.toml\"\n");
    let with_view = write("view-cell.toml", "[view]\nmm_per_px = 0.5\norigin_px = [80.0, 60.0]\n");
    let out = folder.path().join("results");
    for (option, file, base) in
        [("--camera", &camera, false), ("--config", &with_camera, false), ("--config", &with_view, true)]
    {
        let output = samsod(&["inspect", image.to_str().unwrap(), "--out", out.to_str().unwrap(), option, file]);
        let text = stdout(&output);
        assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
        assert_eq!((text.contains("world mm"), text.contains("base mm")), (true, base), "{text}");
        let report: serde_json::Value =
            serde_json::from_slice(&std::fs::read(out.join("table.json")).unwrap()).unwrap();
        let red = &report["objects"][0];
        let near = |value: &serde_json::Value, expected: f64| (value.as_f64().unwrap() - expected).abs() < 1.0;
        assert!(near(&red["world"]["x_mm"], -17.5) && near(&red["world"]["y_mm"], 5.0), "{red}");
        assert!(near(&red["size_mm"][0], 20.5) && near(&red["size_mm"][1], 15.5), "{red}");
        assert!(near(&red["world"]["yaw_deg"], 90.0), "it is higher than wide: {red}");
    }
    // A camera of another size would give wrong places that look right.
    let other = std::fs::read_to_string(&camera).unwrap().replace("width_px = 160", "width_px = 161");
    let other = write("other.toml", &other);
    let output = samsod(&["inspect", image.to_str().unwrap(), "--out", out.to_str().unwrap(), "--camera", &other]);
    assert_eq!(output.status.code(), Some(1));
    assert!(stderr(&output).contains("has 160 x 120 pixels, the camera of the camera file has 161 x 120"));
}

#[test]
fn what_is_no_image_is_an_error_that_names_the_file_and_writes_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let text = folder.path().join("notes.png");
    std::fs::write(&text, "no image").unwrap();
    let out = folder.path().join("results");
    let output = samsod(&["inspect", text.to_str().unwrap(), "--out", out.to_str().unwrap()]);
    assert_eq!(output.status.code(), Some(1));
    assert!(stderr(&output).contains(text.to_str().unwrap()), "{}", stderr(&output));
    assert!(!out.exists());
}

#[test]
fn an_unknown_key_of_the_configuration_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let image = folder.path().join("table.png");
    table().save(&image).unwrap();
    let config = folder.path().join("cell.toml");
    std::fs::write(&config, "[segment]\nspatial_bandwith = 3\n").unwrap();
    let output = samsod(&["inspect", image.to_str().unwrap(), "--config", config.to_str().unwrap()]);
    assert_eq!(output.status.code(), Some(1));
    assert!(stderr(&output).contains("spatial_bandwith"), "{}", stderr(&output));
}
