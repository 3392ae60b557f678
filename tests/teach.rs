//! `samsod teach` and `samsod catalogue`, as an operator runs them.

// A test says what went wrong best by stopping there.
#![allow(clippy::unwrap_used, clippy::panic)]

mod support;

use std::fs;
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};

use image::{GrayImage, Luma, Rgb, RgbImage};
use samsod::recognize::{Catalogue, Part};
use support::{Ended, compose, samsod, test_data};
use tempfile::TempDir;

/// A folder to work in.
struct Bench {
    folder: TempDir,
}

impl Bench {
    fn new() -> Self {
        Self { folder: tempfile::tempdir().unwrap() }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn parts(&self) -> PathBuf {
        self.path("parts")
    }

    /// Writes a frame of some bundled parts, each moved by so many pixels.
    fn frame(&self, parts: &[(&str, [i64; 2])]) -> PathBuf {
        let path = self.path("frame.png");
        compose(parts).save(&path).unwrap();
        path
    }

    /// Teaches a part from a picture, with the camera of the bundled frames.
    fn teach(&self, picture: &Path, name: &str, more: &[&str]) -> Ended {
        let (camera, parts) = (test_data("cell/camera.toml"), self.parts());
        let mut arguments = vec!["teach", text(picture), "--name", name, "--camera", text(&camera)];
        arguments.extend(["--catalogue", text(&parts)]);
        arguments.extend(more);
        samsod(&arguments)
    }

    #[track_caller]
    fn assert_refused(&self, ended: &Ended, expected: &[&str]) {
        assert_eq!(ended.status.code(), Some(1), "{ended:#?}");
        for part in expected {
            assert!(ended.stderr.contains(part), "{part}: {}", ended.stderr);
        }
    }

    /// What lies in the catalogue, hidden folders too.
    fn names(&self) -> Vec<String> {
        let Ok(entries) = fs::read_dir(self.parts()) else { return Vec::new() };
        let mut names: Vec<_> = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

fn model(name: &str) -> PathBuf {
    test_data(&format!("parts/{name}/model.stl"))
}

/// Overlap of two masks in the frame, over what either covers.
fn overlap(a: &Part, b: &Part) -> f64 {
    let inside = |part: &Part, x: u32, y: u32| {
        let [left, top] = part.template.crop_px;
        let at = x.checked_sub(left).zip(y.checked_sub(top));
        at.and_then(|(x, y)| part.template.mask.get_pixel_checked(x, y)).is_some_and(|value| value[0] > 127)
    };
    let pixels = (0..958).flat_map(|y| (0..1078).map(move |x| (x, y)));
    let (mut both, mut either) = (0.0, 0.0);
    for (a, b) in pixels.map(|(x, y)| (inside(a, x, y), inside(b, x, y))) {
        both += f64::from(u8::from(a && b));
        either += f64::from(u8::from(a || b));
    }
    both / either
}

#[test]
fn a_part_is_taught_from_one_picture_and_its_shape() {
    let bench = Bench::new();
    let ended = bench.teach(&bench.frame(&[("flange", [0, 0])]), "flange", &["--stl", text(&model("flange"))]);
    ended.assert_success();
    for line in
        ["height     27.0 mm", "symmetry   outline none, picture none", "shape      2868 triangles, 27.0 mm high"]
    {
        assert!(ended.stdout.lines().any(|l| l == line), "{line}: {}", ended.stdout);
    }
    assert_eq!(bench.names(), ["flange"]);
    let part = Part::read(&bench.parts().join("flange")).unwrap();
    let bundled = Part::read(&test_data("parts/flange")).unwrap();
    assert!(overlap(&part, &bundled) > 0.9, "the masks overlap by {}", overlap(&part, &bundled));
    assert_eq!((part.height_mm, part.grasp.width_mm, part.symmetry), (27.0, 82.0, bundled.symmetry));
    assert_eq!((part.template.camera, part.mesh), (bundled.template.camera, bundled.mesh));
    // The part lies where it was modelled: at the origin, its x axis along that of the table.
    let [x, y] = part.template.origin_mm;
    assert!(x.hypot(y) < 3.0 && part.template.yaw_rad.abs() < 0.05, "{:?} {}", [x, y], part.template.yaw_rad);

    let listed = samsod(&["catalogue", text(&bench.parts())]);
    listed.assert_success();
    let line = listed.stdout.lines().find(|line| line.starts_with("flange ")).unwrap();
    let figures: Vec<&str> = line.split_whitespace().collect();
    assert_eq!((figures[1], figures[2], *figures.last().unwrap()), ("27.0", "82.0", "2868"), "{line}");
}

#[test]
fn without_a_shape_the_height_is_needed_and_the_width_is_measured() {
    let bench = Bench::new();
    let frame = bench.frame(&[("u_channel", [120, -60])]);
    let ended = bench.teach(&frame, "channel", &[]);
    assert_eq!(ended.status.code(), Some(2), "{ended:#?}");
    assert!(ended.stderr.contains("--height-mm <H>"), "{}", ended.stderr);
    bench.teach(&frame, "channel", &["--height-mm", "25"]).assert_success();
    let part = Part::read(&bench.parts().join("channel")).unwrap();
    // 82 x 38 mm, moved by 120 and 60 px at 875 mm: 65.6 and 32.8 mm.
    assert!((part.grasp.width_mm - 38.0).abs() < 2.5, "{:?}", part.grasp);
    let turned = part.grasp.angle_rad.to_degrees().rem_euclid(180.0);
    assert!(turned.min(180.0 - turned) < 2.0, "along x: {:?}", part.grasp);
    let [x, y] = part.template.origin_mm;
    assert!((x - 65.6).hypot(y - 32.8) < 3.0, "{:?}", part.template.origin_mm);
    assert!(part.mesh.is_none() && part.template.yaw_rad == 0.0);
}

#[test]
fn a_picture_without_a_part_or_with_two_is_refused_until_a_mask_says_which() {
    let bench = Bench::new();
    let height = ["--height-mm", "23"];
    let empty = bench.frame(&[]);
    bench.assert_refused(&bench.teach(&empty, "knob", &height), &["frame.png: no object was found", "--mask"]);
    let two = bench.frame(&[("star_knob", [-200, 0]), ("hex_nut", [200, 100])]);
    let ended = bench.teach(&two, "knob", &height);
    bench.assert_refused(
        &ended,
        &["frame.png: 2 objects of notable size were found:", "leave the part alone", "--mask"],
    );
    let knob = ended.stderr.lines().nth(1).unwrap();
    let numbers: Vec<f64> =
        knob.split(|c: char| !c.is_ascii_digit()).filter_map(|number| number.parse().ok()).collect();
    assert!((numbers[1] - 341.0).abs() < 8.0 && (numbers[2] - 477.0).abs() < 8.0, "the larger first: {knob}");
    assert_eq!(bench.names(), [""; 0]);

    let knob = Part::read(&test_data("parts/star_knob")).unwrap().template;
    let mut mask = GrayImage::new(1078, 958);
    for (x, y, value) in knob.mask.enumerate_pixels() {
        mask.put_pixel(x + knob.crop_px[0] - 200, y + knob.crop_px[1], *value);
    }
    let mask_file = bench.path("mask.png");
    mask.save(&mask_file).unwrap();
    let with_mask = ["--height-mm", "23", "--mask", text(&mask_file)];
    bench.teach(&two, "knob", &with_mask).assert_success();
    let part = Part::read(&bench.parts().join("knob")).unwrap();
    let set = |mask: &GrayImage| mask.iter().filter(|&&value| value > 127).count();
    assert_eq!(set(&part.template.mask), set(&knob.mask));
    // A margin of 16 px round the part.
    let first = part.template.mask.enumerate_pixels().filter(|(_, _, value)| value[0] > 127).map(|p| p.0).min();
    assert_eq!(first, Some(16));

    GrayImage::from_pixel(1077, 958, Luma([255])).save(&mask_file).unwrap();
    let refused = bench.teach(&two, "other", &with_mask);
    bench.assert_refused(&refused, &["the mask has [1077, 958] px, the picture [1078, 958] px"]);
    GrayImage::new(1078, 958).save(&mask_file).unwrap();
    bench.assert_refused(&bench.teach(&two, "other", &with_mask), &["0 px of the mask are set"]);
    assert_eq!(bench.names(), ["knob"]);
}

#[test]
fn a_part_that_is_there_stays_unless_forced() {
    let bench = Bench::new();
    let frame = bench.frame(&[("hex_nut", [0, 0])]);
    bench.teach(&frame, "nut", &["--height-mm", "11"]).assert_success();
    let file = bench.parts().join("nut/part.toml");
    let before = fs::read_to_string(&file).unwrap();
    let refused = bench.teach(&frame, "nut", &["--height-mm", "12"]);
    bench.assert_refused(&refused, &["parts/nut is there already and was not changed; --force replaces it"]);
    assert_eq!(fs::read_to_string(&file).unwrap(), before);
    // Forced, but wrong: what was there stays.
    let refused = bench.teach(&frame, "nut", &["--height-mm", "-1", "--force"]);
    bench.assert_refused(&refused, &["the height is -1 mm; allowed: 0.01 to 5000"]);
    assert_eq!(fs::read_to_string(&file).unwrap(), before);
    bench.teach(&frame, "nut", &["--height-mm", "12", "--force"]).assert_success();
    assert_eq!(Part::read(&bench.parts().join("nut")).unwrap().height_mm, 12.0);
    assert_eq!(bench.names(), ["nut"]);
}

#[test]
fn shapes_that_are_none_are_refused_and_leave_nothing() {
    let bench = Bench::new();
    let frame = bench.frame(&[("hex_nut", [0, 0])]);
    let whole = fs::read(model("hex_nut")).unwrap();
    // Cut off in the middle; and a head that claims 4 294 967 295 triangles.
    let truncated = whole[..whole.len() / 2].to_vec();
    let mut boastful = whole[..484].to_vec();
    boastful[80..84].copy_from_slice(&u32::MAX.to_le_bytes());
    for bytes in [truncated, boastful, Vec::new(), b"no shape".to_vec()] {
        let path = bench.path("shape.stl");
        fs::write(&path, bytes).unwrap();
        let refused = bench.teach(&frame, "nut", &["--stl", text(&path)]);
        bench.assert_refused(&refused, &["shape.stl"]);
    }
    // A shape in metres: a nut of 0.02 mm.
    let mut metres = whole.clone();
    for number in metres[84..].chunks_exact_mut(50).flat_map(|triangle| triangle[12..48].chunks_exact_mut(4)) {
        let value = f32::from_le_bytes(number.try_into().unwrap()) / 1000.0;
        number.copy_from_slice(&value.to_le_bytes());
    }
    let path = bench.path("metres.stl");
    fs::write(&path, metres).unwrap();
    let refused = bench.teach(&frame, "nut", &["--stl", text(&path)]);
    bench.assert_refused(&refused, &["metres.stl", "is the unit millimetres?"]);
    let refused = bench.teach(&frame, "nut", &["--stl", text(&model("hex_nut")), "--height-mm", "20"]);
    bench.assert_refused(&refused, &["the height is 20 mm", "is 11.00 mm high"]);
    assert_eq!(bench.names(), [""; 0]);
}

#[test]
fn names_and_pictures_that_cannot_be_are_refused() {
    let bench = Bench::new();
    let frame = bench.frame(&[("hex_nut", [0, 0])]);
    let height = ["--height-mm", "11"];
    for name in ["a nut", "../nut", "", "."] {
        bench.assert_refused(&bench.teach(&frame, name, &height), &["name is ", "1 to 64 letters, digits, _ and -"]);
    }
    // Cropped: its camera would be another one.
    let cropped = bench.path("cropped.png");
    RgbImage::from_pixel(640, 480, Rgb([130; 3])).save(&cropped).unwrap();
    let refused = bench.teach(&cropped, "nut", &height);
    bench.assert_refused(&refused, &["cropped.png has 640 x 480 pixels", "has 1078 x 958"]);
    fs::write(&cropped, "no picture").unwrap();
    bench.assert_refused(&bench.teach(&cropped, "nut", &height), &["cropped.png is no PNG or JPEG"]);
    assert!(!bench.path("nut").exists() && bench.names().is_empty(), "{:?}", bench.names());
}

#[test]
fn the_first_part_goes_into_the_catalogue_of_a_configuration() {
    let bench = Bench::new();
    let frame = bench.frame(&[("hex_nut", [0, 0])]);
    let config = bench.path("cell.toml");
    // 0.5625 mm a pixel, the middle of the table under the middle of the image, as the bundled camera sees it.
    let view = "[catalogue]\nfolder = \"parts\"\n[view]\nmm_per_px = 0.5625\norigin_px = [541.2, 476.6]\n";
    fs::write(&config, "[catalogue]\nfolder = \"parts\"\n").unwrap();
    let arguments = ["teach", text(&frame), "--name", "nut", "--height-mm", "11", "--config", text(&config)];
    bench.assert_refused(&samsod(&arguments), &["cell.toml has neither [camera] file nor [view]", "--camera FILE"]);
    fs::write(&config, view).unwrap();
    samsod(&arguments).assert_success();
    let catalogue = Catalogue::read(&bench.parts()).unwrap();
    let nut = catalogue.part("nut").unwrap();
    let [x, y] = nut.template.origin_mm;
    assert!(
        x.hypot(y) < 1.5 && (nut.grasp.width_mm - 21.0).abs() < 2.0,
        "{:?} {:?}",
        nut.template.origin_mm,
        nut.grasp
    );
    let no_camera = samsod(&["teach", text(&frame), "--name", "nut", "--height-mm", "11"]);
    assert_eq!(no_camera.status.code(), Some(2), "{no_camera:?}");
}

/// Copies a bundled part into a folder of a catalogue.
fn copy_part(name: &str, folder: &Path) {
    fs::create_dir_all(folder).unwrap();
    for file in ["part.toml", "template.png", "mask.png", "model.stl"] {
        fs::copy(test_data(&format!("parts/{name}/{file}")), folder.join(file)).unwrap();
    }
}

#[test]
fn the_bundled_catalogue_is_listed_without_an_error() {
    let listed = samsod(&["catalogue", text(&test_data("parts"))]);
    listed.assert_success();
    assert!(listed.stdout.ends_with("20 parts, 0 errors\n"), "{}", listed.stdout);
    let line = |name: &str| listed.stdout.lines().find(|line| line.starts_with(name)).unwrap().to_owned();
    assert!(line("bearing").contains(" round     none "), "{}", line("bearing"));
    assert!(line("star_knob").contains(" 5-fold   5-fold "), "{}", line("star_knob"));
    // The lettering of the terminal block shows more than a plain disk does.
    let features = |name: &str| features(&listed.stdout, name);
    assert!(features("terminal_block") > 2 * features("washer"), "{}", listed.stdout);
}

/// The column of local features, the last but one.
fn features(listing: &str, name: &str) -> usize {
    let line = listing.lines().find(|line| line.starts_with(&format!("{name} "))).unwrap();
    line.split_whitespace().rev().nth(1).unwrap().parse().unwrap()
}

#[test]
fn a_catalogue_in_which_nothing_can_be_kept_is_listed_all_the_same() {
    let bench = Bench::new();
    let folder = bench.parts().join("flange");
    copy_part("flange", &folder);
    let listed = samsod(&["catalogue", text(&bench.parts())]);
    listed.assert_success();
    let kept = folder.join("descriptors");
    fs::remove_file(&kept).unwrap();
    // Nobody may write into the folder; and as that does not hold for root, there is something in the way, too.
    fs::create_dir_all(kept.join("in the way")).unwrap();
    fs::set_permissions(&folder, fs::Permissions::from_mode(0o555)).unwrap();
    let again = samsod(&["catalogue", text(&bench.parts())]);
    again.assert_success();
    assert_eq!(again.stdout, listed.stdout);
    assert!(features(&again.stdout, "flange") > 0, "{}", again.stdout);
    // What was begun is not left behind.
    let mut names: Vec<_> = fs::read_dir(&folder).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    names.sort();
    assert_eq!(names, ["descriptors", "mask.png", "model.stl", "part.toml", "template.png"]);
    fs::set_permissions(&folder, fs::Permissions::from_mode(0o755)).unwrap();
}

#[test]
fn every_error_of_a_catalogue_is_named_and_the_good_parts_are_listed() {
    let bench = Bench::new();
    let parts = bench.parts();
    for (name, folder) in [("washer", "a"), ("washer", "b"), ("hex_nut", "c"), ("flange", "d"), ("bearing", "e")] {
        copy_part(name, &parts.join(folder));
    }
    fs::create_dir(parts.join("drawings")).unwrap();
    fs::write(parts.join("c/mask.png"), "no image").unwrap();
    let toml = parts.join("d/part.toml");
    fs::write(&toml, fs::read_to_string(&toml).unwrap().replace("height_mm = 27.0", "height_mm = -27.0")).unwrap();
    let listed = samsod(&["catalogue", text(&parts)]);
    assert_eq!(listed.status.code(), Some(1), "{listed:?}");
    assert!(listed.stdout.ends_with("2 parts, 3 errors\n"), "{}", listed.stdout);
    assert!(listed.stdout.contains("parts/drawings is passed over: it has no part.toml"), "{}", listed.stdout);
    for expected in [
        "b/part.toml: both are named washer; every part needs a name of its own",
        "c/mask.png: ",
        "d/part.toml: height_mm is -27; allowed: 0.01 to 5000",
    ] {
        assert!(listed.stderr.lines().any(|line| line.contains(expected)), "{expected}: {}", listed.stderr);
    }
    // The service does not start with any of them.
    let cell = support::TestCell::new();
    let config = cell.config(&[("catalogue", &format!("folder = {parts:?}"))]);
    for arguments in [&[][..], &["--check-config"]] {
        let ended = cell.spawn_daemon(&config, arguments).wait();
        assert_eq!(ended.status.code(), Some(2), "{ended:?}");
        assert!(ended.stderr.contains("[catalogue] folder: ") && ended.stderr.contains("washer"), "{}", ended.stderr);
    }
}

#[test]
fn an_empty_catalogue_and_none_are_errors_that_say_what_to_do() {
    let bench = Bench::new();
    let parts = bench.parts();
    let listed = samsod(&["catalogue", text(&parts)]);
    assert_eq!(listed.status.code(), Some(1));
    assert!(listed.stderr.contains(&format!("cannot read {}", parts.display())), "{}", listed.stderr);
    fs::create_dir(&parts).unwrap();
    let listed = samsod(&["catalogue", text(&parts)]);
    assert_eq!(listed.status.code(), Some(1));
    assert!(listed.stderr.contains("no part in it") && listed.stderr.contains("samsod teach"), "{}", listed.stderr);
}
