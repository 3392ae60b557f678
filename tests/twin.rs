//! The cell twin: random tables, their pictures, and frames that follow the table file.

// A test says what went wrong best by stopping there.
#![allow(clippy::unwrap_used, clippy::panic)]

mod support;

use std::fs::{self, File, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::Command;

use image::{Rgb, RgbImage};
use samsod::recognize::Part;
use samsod_daemon::twin::{Arrangement, DrawArguments, Twin, TwinError};
use samsod_frame::{FrameSubscriber, unix_time_ns};
use samsod_robot::{Convex, TablePart, TableState, Whereabouts};
use support::{Ended, Process, TestCell, WATCHDOG, samsod, test_data};

const SIZE_PX: [u32; 2] = [1078, 958];
/// Of tests/data/cell/camera.toml: the middle of the table is here in the base frame.
const BASE_X_MM: f64 = 500.0;
const FOCAL_PX: f64 = 1600.0;
const CENTRE_PX: [f64; 2] = [541.2, 476.6];
const CAMERA_HEIGHT_MM: f64 = 900.0;

fn config(cell: &TestCell) -> PathBuf {
    let camera = format!("file = {:?}", test_data("cell/camera.toml"));
    cell.config(&[("camera", &camera), ("catalogue", &format!("folder = {:?}", test_data("parts")))])
}

/// A plain grey table.
fn grey(cell: &TestCell) -> PathBuf {
    let path = cell.path("grey.png");
    RgbImage::from_pixel(SIZE_PX[0], SIZE_PX[1], Rgb([128; 3])).save(&path).unwrap();
    path
}

fn draw(cell: &TestCell) -> DrawArguments {
    DrawArguments {
        table: cell.path("table.json"),
        config: config(cell),
        background: grey(cell),
        lighting: Arrangement::Soft,
        lamp_azimuth_deg: None,
        lamp_elevation_deg: None,
        lamp_softness_deg: None,
        exposure: 1.0,
        noise: 0.0,
        seed: 1,
    }
}

/// A part at a place of the world, mm and degrees.
fn part(name: &str, [x_mm, y_mm]: [f64; 2], yaw_deg: f64) -> TablePart {
    TablePart {
        name: name.to_owned(),
        whereabouts: Whereabouts::Table,
        x_mm: x_mm + BASE_X_MM,
        y_mm,
        z_mm: 0.0,
        yaw_rad: yaw_deg.to_radians(),
        height_mm: 10.0,
        grasp_width_mm: 10.0,
        grasp_offset_mm: [0.0; 2],
        grasp_angle_rad: 0.0,
        symmetry_order: 1,
        outline_mm: Convex::rectangle([0.0; 2], [10.0; 2], 0.0),
    }
}

fn frame(twin: &mut Twin, parts: Vec<TablePart>) -> RgbImage {
    twin.compose(&TableState::new(parts)).unwrap();
    let mut image = RgbImage::new(SIZE_PX[0], SIZE_PX[1]);
    twin.expose(0, &mut image);
    image
}

/// The pixel of a point of the world.
fn pixel([x, y, z]: [f64; 3]) -> [f64; 2] {
    let scale = FOCAL_PX / (CAMERA_HEIGHT_MM - z);
    [CENTRE_PX[0] + x * scale, CENTRE_PX[1] - y * scale]
}

/// Pixels of two images that plainly differ: low light from the sky reaches far, and little of it is missing there.
fn changed(a: &RgbImage, b: &RgbImage) -> Vec<[f64; 2]> {
    let differs = |a: &Rgb<u8>, b: &Rgb<u8>| (0..3).any(|i| a[i].abs_diff(b[i]) > 3);
    let pixels = a.enumerate_pixels().zip(b.pixels()).filter(|((_, _, a), b)| differs(a, b));
    pixels.map(|((x, y, _), _)| [f64::from(x), f64::from(y)]).collect()
}

#[test]
fn a_part_where_its_template_was_taken_looks_like_the_template() {
    let cell = TestCell::new();
    let mut twin = Twin::open(&draw(&cell)).unwrap();
    for name in ["asym_plate", "housing_block", "sensor_box", "terminal_block", "washer"] {
        let template = Part::read(&test_data("parts").join(name)).unwrap().template;
        // The templates were taken by the camera of the cell.
        let image = frame(&mut twin, vec![part(name, template.origin_mm, template.yaw_rad.to_degrees())]);
        let at = |x: u32, y: u32| *image.get_pixel(x + template.crop_px[0], y + template.crop_px[1]);
        let (mut difference, mut inside, mut covered) = (0u64, 0u64, 0u64);
        for (x, y, _) in template.mask.enumerate_pixels().filter(|(_, _, value)| value[0] > 127) {
            let drawn = at(x, y);
            inside += 1;
            covered += u64::from(drawn != Rgb([128; 3]));
            let shown = template.image.get_pixel(x, y);
            difference += (0..3).map(|i| u64::from(drawn[i].abs_diff(shown[i]))).sum::<u64>();
        }
        let mean = difference as f64 / (3 * inside) as f64;
        assert!(mean < 6.0, "{name}: {mean} levels a pixel from its template");
        assert!(covered * 100 > inside * 97, "{name}: {covered} of {inside} px are drawn");
    }
}

#[test]
fn a_frame_differs_from_the_bare_table_where_parts_and_shadows_are() {
    let cell = TestCell::new();
    let background = test_data("tables/blue_belt.jpg");
    let mut twin = Twin::open(&DrawArguments { background: background.clone(), ..draw(&cell) }).unwrap();
    let bare = image::open(&background).unwrap().into_rgb8();
    assert_eq!(frame(&mut twin, Vec::new()), bare);
    let places = [[-120.0, 90.0], [150.0, -60.0]];
    let image = frame(&mut twin, vec![part("u_channel", places[0], 20.0), part("t_piece", places[1], -70.0)]);
    let off = changed(&image, &bare);
    // Either part is a few thousand pixels.
    assert!(off.len() > 6_000, "{} px", off.len());
    for at in &off {
        // Half the longest part and its shadow, 60 mm, are 107 px.
        let near = places.iter().any(|[x, y]| {
            let [u, v] = pixel([*x, *y, 10.0]);
            (at[0] - u).hypot(at[1] - v) < 160.0
        });
        assert!(near, "{at:?} differs, far from both parts");
    }
}

#[test]
fn sides_of_tall_parts_come_into_view_away_from_the_middle() {
    let cell = TestCell::new();
    let mut twin = Twin::open(&draw(&cell)).unwrap();
    let bare = image::open(grey(&cell)).unwrap().into_rgb8();
    let name = "housing_block";
    let mesh = Part::read(&test_data("parts").join(name)).unwrap().mesh.unwrap();
    for (at, yaw_deg) in [([0.0, 0.0], 0.0), ([200.0, 150.0], 30.0)] {
        let image = frame(&mut twin, vec![part(name, at, yaw_deg)]);
        let (sin, cos) = yaw_deg.to_radians().sin_cos();
        // Every corner of the model, from the table to its top, lies on pixels that are not those of the bare table.
        for [x, y, z] in mesh.vertices().iter().map(|v| v.map(f64::from)) {
            let [u, v] = pixel([at[0] + cos * x - sin * y, at[1] + sin * x + cos * y, z]);
            // Towards the part by a pixel: corners lie on borders.
            let [mu, mv] = pixel([at[0], at[1], z]);
            let length = (mu - u).hypot(mv - v).max(1.0);
            let [u, v] = [u + 1.5 * (mu - u) / length, v + 1.5 * (mv - v) / length].map(|c| c.round() as u32);
            assert_ne!(image.get_pixel(u, v), bare.get_pixel(u, v), "{u}, {v}");
        }
    }
}

#[test]
fn shadows_fall_away_from_the_lamp() {
    let cell = TestCell::new();
    let light = |azimuth_deg| {
        let side = Arrangement::Side;
        let arguments = DrawArguments { lighting: side, lamp_azimuth_deg: Some(azimuth_deg), ..draw(&cell) };
        let image = frame(&mut Twin::open(&arguments).unwrap(), vec![part("housing_block", [0.0, 0.0], 0.0)]);
        // The block reaches 50 mm to the sides; in the next 20 mm lies its shadow.
        let mean = |x_mm: f64| {
            let [u, v] = pixel([x_mm, 0.0, 0.0]).map(|c| c as u32);
            let square = (u - 3..=u + 3).flat_map(|u| (v - 3..=v + 3).map(move |v| (u, v)));
            square.map(|(u, v)| f64::from(image.get_pixel(u, v)[1])).sum::<f64>() / 49.0
        };
        let half_mm = {
            let mesh = Part::read(&test_data("parts/housing_block")).unwrap().mesh.unwrap();
            f64::from(mesh.vertices().iter().map(|v| v[0]).fold(0.0, f32::max))
        };
        (mean(-half_mm - 9.0), mean(half_mm + 9.0))
    };
    let (left, right) = light(0.0);
    assert!(left < 90.0 && right > 110.0, "lamp on the right: {left} on the left, {right} on the right");
    let (left, right) = light(180.0);
    assert!(left > 110.0 && right < 90.0, "lamp on the left: {left} on the left, {right} on the right");
}

#[test]
fn only_what_lies_in_view_is_drawn_and_the_rest_must_be_known() {
    let cell = TestCell::new();
    let mut twin = Twin::open(&draw(&cell)).unwrap();
    let bare = image::open(grey(&cell)).unwrap().into_rgb8();
    let at = |whereabouts| TablePart { whereabouts, ..part("washer", [40.0, 10.0], 0.0) };
    for (whereabouts, is_drawn) in [
        (Whereabouts::Table, true),
        (Whereabouts::Jig, true),
        (Whereabouts::Gripper, false),
        (Whereabouts::Dropped, true),
    ] {
        assert_eq!(frame(&mut twin, vec![at(whereabouts)]) != bare, is_drawn, "{whereabouts:?}");
    }
    // What was let go in the air has fallen onto the table.
    let in_the_air = TablePart { z_mm: 150.0, ..at(Whereabouts::Dropped) };
    assert_eq!(frame(&mut twin, vec![in_the_air]), frame(&mut twin, vec![at(Whereabouts::Table)]));
    // Out of view, or behind the camera.
    let (mut aside, mut behind) = (at(Whereabouts::Table), at(Whereabouts::Table));
    (aside.x_mm, behind.z_mm) = (5_000.0, 2_000.0);
    assert_eq!(frame(&mut twin, vec![aside, behind]), bare);
    let unknown = TablePart { name: "spanner".to_owned(), ..at(Whereabouts::Dropped) };
    let message = twin.compose(&TableState::new(vec![unknown])).unwrap_err().to_string();
    assert!(message.starts_with("no part is named \"spanner\"; known are asym_plate, bearing, "), "{message}");
}

/// Runs `samsod twin table`.
fn table(cell: &TestCell, parts: &str, more: &[&str], out: &Path) -> Ended {
    let (config, out) = (config(cell), out.to_str().unwrap());
    let mut arguments = vec!["twin", "table", "--parts", parts, "--config", config.to_str().unwrap(), "--out", out];
    arguments.extend(more);
    samsod(&arguments)
}

/// Points along the outline of a part, 1 mm apart, in the base frame.
fn outline(part: &TablePart) -> Vec<[f64; 2]> {
    let outline = part.outline();
    let corners = outline.corners_mm();
    let sides = (0..corners.len()).map(|i| (corners[i], corners[(i + 1) % corners.len()]));
    let points = sides.flat_map(|(a, b)| {
        let steps = (a[0] - b[0]).hypot(a[1] - b[1]).ceil();
        (0..steps as usize).map(move |i| [0, 1].map(|axis| a[axis] + (b[axis] - a[axis]) * i as f64 / steps))
    });
    points.collect()
}

#[test]
fn random_tables_keep_gaps_view_and_reach_and_are_the_same_for_a_seed() {
    let cell = TestCell::new();
    let names = ["hex_nut", "housing_block", "flange", "asym_plate", "washer", "hex_nut"];
    let path = |name: &str| cell.path(name);
    let free = [640.0, 150.0, 80.0];
    for (seed, gap_mm) in [(1, 25.0), (2, 25.0), (3, 60.0)] {
        let (seed, gap) = (seed.to_string(), gap_mm.to_string());
        let more = ["--seed", &seed, "--gap-mm", &gap, "--keep-free-mm", "640,150,80"];
        for name in ["first.json", "again.json"] {
            table(&cell, &names.join(","), &more, &path(name)).assert_success();
        }
        assert_eq!(fs::read(path("first.json")).unwrap(), fs::read(path("again.json")).unwrap(), "seed {seed}");
        let parts = TableState::read(&path("first.json")).unwrap().parts;
        assert_eq!(parts.iter().map(|p| p.name.as_str()).collect::<Vec<_>>(), names, "in the order asked for");
        for (i, part) in parts.iter().enumerate() {
            assert!(part.whereabouts == Whereabouts::Table && part.outline_mm.corners_mm().len() >= 4, "{part:?}");
            let points = outline(part);
            for [x, y] in &points {
                assert!((x - free[0]).hypot(y - free[1]) >= free[2] - 0.1, "{part:?} lies where it must not");
                for z in [0.0, part.height_mm] {
                    let [u, v] = pixel([x - BASE_X_MM, *y, z]);
                    assert!((20.0..1058.0).contains(&u) && (20.0..938.0).contains(&v), "{part:?} is cut off");
                }
            }
            let [x, y] = part.grasp_mm();
            assert!((310.0..=600.0).contains(&x.hypot(y)), "{part:?} is out of reach");
            for other in &parts[i + 1..] {
                let others = outline(other);
                let distances = points.iter().flat_map(|p| others.iter().map(|q| (p[0] - q[0]).hypot(p[1] - q[1])));
                let least = distances.fold(f64::INFINITY, f64::min);
                assert!(least >= gap_mm, "{} and {} are {least} mm apart", part.name, other.name);
            }
        }
    }
    let first = fs::read(path("first.json")).unwrap();
    table(&cell, &names.join(","), &["--seed", "4"], &path("other.json")).assert_success();
    assert_ne!(first, fs::read(path("other.json")).unwrap());
    // What the robot needs of a part is that of the catalogue.
    let nut = &TableState::read(&path("first.json")).unwrap().parts[0];
    assert_eq!((nut.height_mm, nut.grasp_width_mm, nut.symmetry_order), (11.0, 21.0, 6));
    assert_eq!((nut.grasp_offset_mm, nut.grasp_angle_rad, nut.z_mm), ([0.0; 2], 0.0, 0.0));
}

#[test]
fn tables_that_cannot_be_are_refused_and_nothing_is_written() {
    let cell = TestCell::new();
    let out = cell.path("table.json");
    let crowd = ["flange"; 40].join(",");
    for (parts, more, expected) in [
        ("hex_nut,spanner", &[][..], "no part is named \"spanner\"; known are asym_plate, bearing, cable_clip, "),
        ("hex_nut", &["--gap-mm", "-1"], "gap_mm is -1; allowed: 0 to 1000"),
        ("hex_nut", &["--gap-mm", "NaN"], "gap_mm is NaN; allowed: 0 to 1000"),
        (&crowd, &[], "of 40 parts find a place with 25 mm between them"),
    ] {
        let ended = table(&cell, parts, more, &out);
        assert_eq!(ended.status.code(), Some(1), "{ended:?}");
        assert!(ended.stderr.contains(expected), "{}", ended.stderr);
        assert!(!out.exists());
    }
    let ended = table(&cell, "hex_nut", &["--keep-free-mm", "640,150"], &out);
    assert!(ended.stderr.contains("three numbers with commas are needed: X,Y,R"), "{}", ended.stderr);
    assert_eq!(ended.status.code(), Some(2), "{ended:?}");
}

#[test]
fn a_picture_does_not_tell_what_lay_there_before() {
    let cell = TestCell::new();
    let arguments = DrawArguments { background: test_data("tables/blue_belt.jpg"), ..draw(&cell) };
    let mut twin = Twin::open(&arguments).unwrap();
    // Near enough for shadows on the table that are of both, and a tall part that hides some of a flat one.
    let mut parts = vec![
        part("flange", [30.0, -20.0], 0.0),
        part("housing_block", [150.0, 90.0], 25.0),
        part("washer", [212.0, 131.0], 0.0),
        part("u_channel", [-110.0, 60.0], 31.07),
    ];
    let composed = twin.compose(&TableState::new(parts.clone())).unwrap();
    assert_eq!((composed.in_view, composed.drawn), (4, 4));
    let mut picked = |change: &dyn Fn(&mut Vec<TablePart>), in_view: usize, drawn: usize| {
        change(&mut parts);
        // As the robot leaves it: the file is read and written at each pick.
        let path = cell.path("table.json");
        TableState::new(parts.clone()).write(&path).unwrap();
        let table = TableState::read(&path).unwrap();
        parts = table.parts.clone();
        let composed = twin.compose(&table).unwrap();
        assert_eq!((composed.in_view, composed.drawn), (in_view, drawn));
        let mut fresh = Twin::open(&arguments).unwrap();
        fresh.compose(&table).unwrap();
        assert!(twin.levels() == fresh.levels(), "{in_view} parts in view");
    };
    picked(&|parts| parts[1].whereabouts = Whereabouts::Gripper, 3, 0);
    picked(&|parts| parts.reverse(), 3, 0);
    // Placed out of view: of the block nothing is left.
    picked(&|parts| (parts[2].whereabouts, parts[2].x_mm) = (Whereabouts::Jig, -700.0), 3, 1);
    picked(&|parts| parts[0].x_mm += 40.0, 3, 1);
    // Put back where it lay.
    picked(&|parts| parts[0].x_mm -= 40.0, 3, 0);
}

#[test]
fn table_files_that_cannot_be_used_are_told_by_name() {
    let cell = TestCell::new();
    let path = cell.path("table.json");
    let arguments = draw(&cell);
    let refused = |text: &str| {
        fs::write(&path, text).unwrap();
        let ended = start(&cell, &path, &["--wait", "0"]).wait();
        assert_eq!(ended.status.code(), Some(1), "{ended:?}");
        assert!(ended.stderr.contains(arguments.table.to_str().unwrap()), "{}", ended.stderr);
        ended.stderr
    };
    TableState::new(vec![part("washer", [0.0; 2], 0.0)]).write(&path).unwrap();
    let whole = fs::read_to_string(&path).unwrap();
    for length in [0, whole.len() / 2] {
        assert!(refused(&whole[..length]).contains("EOF"), "{length} bytes");
    }
    assert!(refused(&whole.replace("\"version\": 1", "\"version\": 2")).contains("version is 2"));
    let far = refused(&whole.replace("\"x_mm\": 500.0", "\"x_mm\": -1e9"));
    assert!(far.contains("part \"washer\": x_mm is -1000000000; allowed: -100000 to 100000"), "{far}");
    // Keys that are not known are passed over.
    let mut twin = Twin::open(&arguments).unwrap();
    let bytes = whole.replacen('{', "{\"made_by\": \"hand\", ", 1);
    twin.compose(&TableState::parse(&path, bytes.as_bytes()).unwrap()).unwrap();
}

#[test]
fn cells_that_the_twin_cannot_draw_are_refused() {
    let cell = TestCell::new();
    let refused = |arguments: DrawArguments| match Twin::open(&arguments) {
        Ok(_) => panic!("{arguments:?} is taken"),
        Err(error) => error.to_string(),
    };
    let camera_file = fs::read_to_string(test_data("cell/camera.toml")).unwrap();
    let with_camera = |text: &str| {
        let arguments = draw(&cell);
        fs::write(cell.path("camera.toml"), text).unwrap();
        let camera = format!("file = {:?}", cell.path("camera.toml"));
        cell.config(&[("camera", &camera), ("catalogue", &format!("folder = {:?}", test_data("parts")))]);
        arguments
    };
    let message = refused(with_camera(&camera_file.replace("k1 = 0.0", "k1 = -0.1")));
    assert!(message.contains("the camera has distortion (k1 = -0.1)"), "{message}");
    let message = refused(with_camera(camera_file.split("[base]").next().unwrap()));
    assert!(message.contains("the twin needs a [base] in the camera file"), "{message}");
    let arguments = draw(&cell);
    cell.config(&[("camera", &format!("file = {:?}", test_data("cell/camera.toml")))]);
    assert!(refused(arguments).contains("the twin needs a [catalogue] folder"));

    let small = cell.path("small.png");
    RgbImage::new(64, 48).save(&small).unwrap();
    let message = refused(DrawArguments { background: small, ..draw(&cell) });
    assert!(message.contains("has 64 x 48 pixels, the camera of the camera file has 1078 x 958"), "{message}");
    assert!(refused(DrawArguments { exposure: 0.0, ..draw(&cell) }).contains("exposure is 0; allowed: 0.05 to 20"));
    let low = DrawArguments { lamp_elevation_deg: Some(1.0), ..draw(&cell) };
    assert_eq!(refused(low), "lamp: elevation_deg is 1; allowed: 10 to 90");
    let missing = Twin::open(&DrawArguments { background: cell.path("no.png"), ..draw(&cell) });
    assert!(matches!(missing, Err(TwinError::Background(_))), "{missing:?}");
}

/// Starts `samsod twin run` on a grey table without noise.
fn start(cell: &TestCell, table: &Path, more: &[&str]) -> Process {
    let mut command = Command::new(env!("CARGO_BIN_EXE_samsod"));
    command.args(["twin", "run", "--noise", "0"]);
    command.arg("--table").arg(table).arg("--config").arg(config(cell)).arg("--background").arg(grey(cell)).args(more);
    Process::spawn(command)
}

/// A frame, its slot given back.
struct Shot {
    sequence: u64,
    timestamp_ns: u64,
    pixels: Vec<u8>,
}

fn next(subscriber: &mut FrameSubscriber) -> Shot {
    let frame = subscriber.wait(WATCHDOG).unwrap().unwrap_or_else(|| panic!("no frame within {WATCHDOG:?}"));
    assert_eq!((frame.layout().width(), frame.layout().height(), frame.camera()), (SIZE_PX[0], SIZE_PX[1], "twin"));
    Shot { sequence: frame.sequence(), timestamp_ns: frame.timestamp_ns(), pixels: frame.bytes().to_vec() }
}

/// The first frame of a time or later.
fn next_since(subscriber: &mut FrameSubscriber, time_ns: u64) -> Shot {
    loop {
        let shot = next(subscriber);
        if shot.timestamp_ns >= time_ns {
            return shot;
        }
    }
}

/// Whether anything lies within 20 px of a place of the world.
fn lies(shot: &Shot, [x_mm, y_mm]: [f64; 2]) -> bool {
    let [u, v] = pixel([x_mm, y_mm, 5.0]).map(|c| c as usize);
    let row = |v: usize| &shot.pixels[(v * SIZE_PX[0] as usize + u - 20) * 3..][..40 * 3];
    // Shadows from afar are faint, and a nut is not.
    (v - 20..v + 20).any(|v| row(v).iter().any(|level| level.abs_diff(128) > 20))
}

#[test]
fn a_part_that_was_taken_is_gone_from_the_frames_after() {
    let cell = TestCell::new();
    let path = cell.path("table.json");
    let places = [[-100.0, 50.0], [100.0, -50.0]];
    let mut parts = vec![part("hex_nut", places[0], 0.0), part("star_knob", places[1], 0.0)];
    TableState::new(parts.clone()).write(&path).unwrap();
    let mut subscriber = FrameSubscriber::open(&cell.service).unwrap();
    let twin = start(&cell, &path, &["--rate", "50", "--wait", "100"]);
    let frame = next(&mut subscriber);
    assert!(places.iter().all(|place| lies(&frame, *place)));
    parts[0].whereabouts = Whereabouts::Gripper;
    TableState::new(parts.clone()).write(&path).unwrap();
    let taken_ns = unix_time_ns();
    let frame = next_since(&mut subscriber, taken_ns);
    assert_eq!(places.map(|place| lies(&frame, place)), [false, true]);

    // A table that cannot be read is not guessed at.
    let whole = fs::read(&path).unwrap();
    fs::write(&path, &whole[..whole.len() / 2]).unwrap();
    twin.wait_for_line(&format!(
        "no frame is sent until the table can be used: {} is no table of parts: EOF",
        path.display()
    ));
    (parts[0].whereabouts, parts[0].x_mm, parts[0].y_mm) = (Whereabouts::Jig, BASE_X_MM, 120.0);
    TableState::new(parts).write(&path).unwrap();
    let placed_ns = unix_time_ns();
    let frame = next_since(&mut subscriber, placed_ns);
    assert_eq!([places[0], places[1], [0.0, 120.0]].map(|place| lies(&frame, place)), [false, true, true]);
    let ended = twin.terminate();
    ended.assert_success();
    assert!(ended.stdout.contains(" frames of 3 tables sent in "), "{}", ended.stdout);
    assert!(!ended.stdout.contains(" 0 withheld"), "{}", ended.stdout);
}

/// A named pipe in the place of the table file hands out a table when the test says so.
#[test]
fn the_time_of_a_frame_is_before_its_table_is_read() {
    let cell = TestCell::new();
    let path = cell.path("table.json");
    assert!(Command::new("mkfifo").arg(&path).status().unwrap().success());
    let mut subscriber = FrameSubscriber::open(&cell.service).unwrap();
    let place = [30.0, 30.0];
    let file = cell.path("text.json");
    TableState::new(vec![part("hex_nut", place, 0.0)]).write(&file).unwrap();
    let text = fs::read(&file).unwrap();
    let twin = start(&cell, &path, &["--count", "2", "--wait", "100"]);
    // Opening waits for the reader. The first reading is for no frame.
    let feed = || -> File { OpenOptions::new().write(true).open(&path).unwrap() };
    feed().write_all(&text).unwrap();
    // It has closed the pipe by then; what came earlier would be read with the rest.
    twin.wait_for_line("waiting for samsodd");
    for number in 0..2 {
        let mut pipe = feed();
        let read_ns = unix_time_ns();
        pipe.write_all(&text).unwrap();
        drop(pipe);
        let frame = next(&mut subscriber);
        assert_eq!(frame.sequence, number);
        assert!(frame.timestamp_ns <= read_ns, "{} ns late", frame.timestamp_ns - read_ns);
        assert!(lies(&frame, place));
    }
    let ended = twin.wait();
    ended.assert_success();
    assert!(ended.stdout.starts_with("2 frames of 1 tables sent in "), "{}", ended.stdout);
}

#[test]
fn a_run_that_cannot_begin_says_why() {
    let cell = TestCell::new();
    let path = cell.path("table.json");
    let ended = start(&cell, &path, &[]).wait();
    assert_eq!(ended.status.code(), Some(1), "{ended:?}");
    assert!(ended.stderr.contains(&format!("cannot read the table {}: ", path.display())), "{}", ended.stderr);
    TableState::new(Vec::new()).write(&path).unwrap();
    let ended = start(&cell, &path, &["--rate", "0"]).wait();
    assert!(ended.stderr.contains("rate is 0 Hz; 0.001 to 1000 Hz are allowed"), "{}", ended.stderr);
    let ended = start(&cell, &path, &["--wait", "0"]).wait();
    assert!(ended.stderr.contains("no subscriber on cell \"test-cell\" within 0.0 s"), "{}", ended.stderr);
}

#[test]
fn a_picture_is_the_first_frame_and_noise_follows_the_seed() {
    let cell = TestCell::new();
    let path = cell.path("table.json");
    TableState::new(vec![part("flange", [0.0, 0.0], 10.0)]).write(&path).unwrap();
    let picture = |seed: &str| {
        let out = cell.path("frame.png");
        let (config, grey) = (config(&cell), grey(&cell));
        let of = |path: &Path| path.to_str().unwrap().to_owned();
        let files = [of(&path), of(&config), of(&grey), of(&out)];
        let ended = samsod(&[
            "twin",
            "picture",
            "--seed",
            seed,
            "--table",
            &files[0],
            "--config",
            &files[1],
            "--background",
            &files[2],
            "--out",
            &files[3],
        ]);
        ended.assert_success();
        assert_eq!(ended.stdout, format!("{}\n", out.display()));
        image::open(&out).unwrap().into_rgb8()
    };
    let first = picture("3");
    assert_eq!(first.dimensions(), SIZE_PX.into());
    assert_eq!(first, picture("3"));
    assert_ne!(first, picture("4"));
}
