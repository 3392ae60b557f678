//! Recognition from a frame to names and poses: frames composed of the bundled templates on a plain table.

// A test says what went wrong best by stopping there.
#![allow(clippy::unwrap_used, clippy::panic)]

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::LazyLock;

use image::{Rgb, RgbImage};
use samsod_camera::Camera;
use samsod_recognize::{
    Catalogue, Detection, MASK_FILE, MODEL_FILE, Method, PART_FILE, Part, RecognizeError, RecognizeParams, Recognizer,
    TEMPLATE_FILE,
};
use samsod_saliency::{Saliency, SaliencyParams, Threshold, salient_regions};
use samsod_segment::{RgbView, SegmentParams, Segmenter};
use samsod_shadow::{BareRegion, Mask, MaskRun, ObjectRegion, OrientedBox, ShadowParams, ShadowSeparator};
use tempfile::TempDir;

/// Parts of unlike shapes; flat, or laid under the camera, since a template shows the sides as seen from there.
const PARTS: [&str; 6] = ["asym_plate", "dovetail_plate", "sensor_box", "star_knob", "u_channel", "washer"];
/// A colour that no part has.
const TABLE: Rgb<u8> = Rgb([40, 80, 130]);

/// A part on the table: name, (x, y) mm, yaw in degrees, and whether it is mirrored in its x axis.
type Placed<'a> = (&'a str, [f64; 2], f64, bool);

const SCENE: [Placed<'_>; 3] = [
    ("sensor_box", [2.0, -3.0], 34.0, false),
    ("asym_plate", [-110.0, 60.0], 117.0, false),
    ("washer", [100.0, -70.0], 0.0, false),
];

fn bundled() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/data/parts")
}

/// The bundled parts in a folder of their own, for what is computed of them is kept there.
fn copy_parts(names: &[&str]) -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    for name in names {
        fs::create_dir(folder.path().join(name)).unwrap();
        for file in [PART_FILE, TEMPLATE_FILE, MASK_FILE, MODEL_FILE] {
            fs::copy(bundled().join(name).join(file), folder.path().join(name).join(file)).unwrap();
        }
    }
    folder
}

static CATALOGUE: LazyLock<Catalogue> = LazyLock::new(|| Catalogue::read(copy_parts(&PARTS).path()).unwrap());
static RECOGNIZER: LazyLock<Recognizer> =
    LazyLock::new(|| Recognizer::new(CATALOGUE.clone(), RecognizeParams::default()).unwrap());

/// The camera of all templates.
fn camera() -> &'static Camera {
    &CATALOGUE.parts()[0].template.camera
}

/// Colour of a part's template and share of the part between its pixels.
fn sample(part: &Part, [u, v]: [f64; 2]) -> Option<([f64; 3], f64)> {
    let (width, height) = part.template.mask.dimensions();
    let inside = |c: f64, size: u32| c >= 0.0 && c < f64::from(size) - 1.0;
    if !inside(u, width) || !inside(v, height) {
        return None;
    }
    let (mut colour, mut share) = ([0.0; 3], 0.0);
    for (dx, dy) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
        let (x, y) = (u as u32 + dx, v as u32 + dy);
        let weight = (1.0 - (u - f64::from(x)).abs()) * (1.0 - (v - f64::from(y)).abs());
        if part.template.mask.get_pixel(x, y).0[0] > 127 {
            let pixel = part.template.image.get_pixel(x, y).0;
            colour.iter_mut().zip(pixel).for_each(|(sum, value)| *sum += weight * f64::from(value));
            share += weight;
        }
    }
    (share > 0.0).then(|| (colour.map(|c| c / share), share))
}

/// A table with some parts, each on the plane of its height.
fn compose(parts: &[Placed<'_>]) -> RgbImage {
    let [width, height] = camera().intrinsics().size_px();
    let mut frame = RgbImage::from_pixel(width, height, TABLE);
    for (name, [x_mm, y_mm], yaw_deg, mirrored) in parts {
        let part = CATALOGUE.part(name).unwrap();
        let template = &part.template;
        let (sin, cos) = yaw_deg.to_radians().sin_cos();
        let (template_sin, template_cos) = template.yaw_rad.sin_cos();
        for (x, y, pixel) in frame.enumerate_pixels_mut() {
            let [wx, wy, _] = camera().world_from_image([f64::from(x), f64::from(y)], part.height_mm).unwrap();
            let (dx, dy) = (wx - x_mm, wy - y_mm);
            let (px, mut py) = (cos * dx + sin * dy, cos * dy - sin * dx);
            if px.hypot(py) > 150.0 {
                continue;
            }
            if *mirrored {
                py = -py;
            }
            let at = [
                template.origin_mm[0] + template_cos * px - template_sin * py,
                template.origin_mm[1] + template_sin * px + template_cos * py,
                part.height_mm,
            ];
            let [u, v] = template.camera.image_from_world(at).unwrap();
            let [left, top] = template.crop_px.map(f64::from);
            if let Some((colour, share)) = sample(part, [u - left, v - top]) {
                for (value, colour) in pixel.0.iter_mut().zip(colour) {
                    *value = (share * colour + (1.0 - share) * f64::from(*value)).round() as u8;
                }
            }
        }
    }
    frame
}

fn view(image: &RgbImage) -> RgbView<'_> {
    RgbView::from_raw(image.width(), image.height(), image.as_raw().as_slice()).unwrap()
}

/// The objects of a frame as the stages before find them.
fn objects(frame: &RgbImage) -> Vec<ObjectRegion> {
    let frame = view(frame);
    let partition = Segmenter::new(SegmentParams::default()).unwrap().segment(&frame).unwrap();
    let saliency = Saliency::new(SaliencyParams::default()).unwrap().compute(&partition).unwrap();
    let regions = salient_regions(&saliency, &partition, Threshold::default()).unwrap();
    let mut separator = ShadowSeparator::new(ShadowParams::default()).unwrap();
    separator.separate(&frame, &partition, &saliency, &regions).unwrap()
}

/// An object that is a rectangle.
fn rectangle([x, y, width, height]: [u32; 4]) -> ObjectRegion {
    let runs: Vec<MaskRun> = (y..y + height).map(|y| MaskRun { y, start: x, end: x + width }).collect();
    let [right, bottom] = [(x + width - 1) as i32, (y + height - 1) as i32];
    let (left, top) = (x as i32, y as i32);
    let mut outline: Vec<[i32; 2]> = (left..=right).map(|x| [x, top]).collect();
    outline.extend((top + 1..=bottom).map(|y| [right, y]));
    outline.extend((left..right).rev().filter(|_| height > 1).map(|x| [x, bottom]));
    outline.extend((top + 1..bottom).rev().filter(|_| width > 1).map(|y| [left, y]));
    let center = [(left + right) as f32 / 2.0, (top + bottom) as f32 / 2.0];
    ObjectRegion {
        region: 0,
        mask: Mask::from_runs(&runs).unwrap(),
        shadow: None,
        outline,
        holes: Vec::new(),
        area: width * height,
        centroid: center,
        oriented_box: OrientedBox {
            center_px: center,
            length_px: width.max(height) as f32,
            width_px: width.min(height) as f32,
            angle_rad: 0.0,
        },
        axis_rad: 0.0,
    }
}

fn named<'a>(detections: &'a [Detection], name: &str) -> Vec<&'a Detection> {
    detections.iter().filter(|d| d.name.as_deref() == Some(name)).collect()
}

/// Between directions of a part that looks the same `order` times a turn; 0: at any.
fn angle_between(a_rad: f64, b_rad: f64, order: u32) -> f64 {
    if order == 0 {
        return 0.0;
    }
    let turn = std::f64::consts::TAU / f64::from(order);
    let off = (a_rad - b_rad).rem_euclid(turn);
    off.min(turn - off)
}

fn assert_found(detections: &[Detection], placed: &[Placed<'_>]) {
    assert_found_within(detections, placed, 0.4, 0.5);
}

fn assert_found_within(detections: &[Detection], placed: &[Placed<'_>], most_mm: f64, most_deg: f64) {
    for (name, [x, y], yaw_deg, _) in placed {
        let [found] = named(detections, name)[..] else { panic!("{name}: {detections:#?}") };
        let world = found.world.unwrap();
        let off = (world.x_mm - x).hypot(world.y_mm - y);
        let order = CATALOGUE.part(name).unwrap().symmetry.shape_order;
        let turn = angle_between(world.yaw_rad, yaw_deg.to_radians(), order).to_degrees();
        assert!(
            off < most_mm && turn < most_deg,
            "{name} is off by {off} mm and {turn} degrees: {world:?}, {}",
            found.score
        );
        assert_eq!(world.height_mm, CATALOGUE.part(name).unwrap().height_mm);
        // The pose in the image is that of the world.
        let seen = camera().image_from_world([world.x_mm, world.y_mm, world.height_mm]).unwrap();
        let apart = (seen[0] - found.image.origin_px[0]).hypot(seen[1] - found.image.origin_px[1]);
        assert!(apart < 1e-6 && (0.5..=1.0).contains(&found.score) && (0.0..=1.0).contains(&found.margin), "{found:?}");
    }
}

#[test]
fn parts_have_names_and_poses() {
    let frame = compose(&SCENE);
    let objects = objects(&frame);
    let detections = RECOGNIZER.recognize(&view(&frame), &objects, Some(camera())).unwrap();
    assert_found(&detections, &SCENE);
    assert_eq!(detections.len(), 3, "{detections:#?}");
    for detection in &detections {
        let [object] = detection.objects[..] else { panic!("{detection:?}") };
        assert_eq!(detection.region, objects[object].region);
        let shared = objects[object].mask.runs().flat_map(|r| (r.start..r.end).map(move |x| (x, r.y)));
        let shared = shared.filter(|(x, y)| detection.mask.contains(*x, *y)).count() as f32;
        // The mask of an object may have a hole of its part filled, here that of the washer.
        assert!(shared > 0.5 * objects[object].area as f32, "{shared} of {}", objects[object].area);
    }
    // Without the camera that of the templates serves, but what is found has no place in the world.
    let without = RECOGNIZER.recognize(&view(&frame), &objects, None).unwrap();
    assert_eq!(without.len(), 3);
    for (with, without) in detections.iter().zip(&without) {
        assert_eq!(with, &Detection { world: with.world, ..without.clone() });
        assert_eq!(without.world, None);
    }
}

#[test]
fn every_angle_of_a_part_is_told() {
    for i in 0..6 {
        let scene = [("asym_plate", [1.0, 2.0], f64::from(i) * 60.0 - 177.0, false)];
        let frame = compose(&scene);
        assert_found(&RECOGNIZER.recognize(&view(&frame), &objects(&frame), Some(camera())).unwrap(), &scene);
    }
}

#[test]
fn angles_between_the_directions_of_shape_contexts_are_told() {
    for i in 0..12 {
        let scene = [("asym_plate", [1.0, 2.0], f64::from(i) * 30.0 - 165.0, false)];
        let frame = compose(&scene);
        assert_found(&RECOGNIZER.recognize(&view(&frame), &objects(&frame), Some(camera())).unwrap(), &scene);
    }
}

#[test]
fn a_mirrored_part_is_not_the_part() {
    for yaw_deg in [0.0, 73.0, 160.0] {
        let frame = compose(&[("asym_plate", [3.0, 5.0], yaw_deg, true), ("washer", [-120.0, 40.0], 0.0, false)]);
        let detections = RECOGNIZER.recognize(&view(&frame), &objects(&frame), Some(camera())).unwrap();
        assert!(named(&detections, "asym_plate").is_empty(), "at {yaw_deg} degrees: {detections:#?}");
        assert_eq!(named(&detections, "washer").len(), 1, "{detections:#?}");
    }
}

#[test]
fn a_part_that_is_not_in_the_catalogue_is_unknown() {
    let frame = compose(&SCENE);
    let objects = objects(&frame);
    for left_out in ["sensor_box", "asym_plate"] {
        let recognizer = Recognizer::new(CATALOGUE.without(&[left_out]), RecognizeParams::default()).unwrap();
        let detections = recognizer.recognize(&view(&frame), &objects, Some(camera())).unwrap();
        let others: Vec<Placed<'_>> = SCENE.into_iter().filter(|placed| placed.0 != left_out).collect();
        assert_found(&detections, &others);
        let unknown: Vec<&Detection> = detections.iter().filter(|d| d.name.is_none()).collect();
        let [unknown] = unknown[..] else { panic!("{left_out}: {detections:#?}") };
        // Where its object is.
        let [object] = unknown.objects[..] else { panic!("{unknown:?}") };
        assert_eq!((&unknown.mask, unknown.world), (&objects[object].mask, None));
        assert_eq!(unknown.image.origin_px, objects[object].centroid.map(f64::from));
        assert!(unknown.score < 0.5, "{}", unknown.score);
    }
}

#[test]
fn an_object_that_no_part_resembles_is_unknown() {
    let mut frame = compose(&[]);
    for (x, y) in (0..30).flat_map(|y| (0..300).map(move |x| (x, y))) {
        frame.put_pixel(300 + x, 400 + y, Rgb([30, 60, 120]));
    }
    let bar = [rectangle([300, 400, 300, 30])];
    let detections = RECOGNIZER.recognize(&view(&frame), &bar, Some(camera())).unwrap();
    let [detection] = &detections[..] else { panic!("{detections:#?}") };
    assert_eq!((detection.name.as_deref(), &detection.objects[..]), (None, &[0][..]));
}

#[test]
fn one_thread_says_the_same_as_four() {
    let frame = compose(&SCENE);
    let objects = objects(&frame);
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let recognizer = Recognizer::new(CATALOGUE.clone(), RecognizeParams::default()).unwrap();
            recognizer.recognize(&view(&frame), &objects, Some(camera())).unwrap()
        })
    };
    let one = with(1);
    assert_eq!(one.len(), 3);
    assert_eq!(one, with(4));
}

#[test]
fn every_method_finds_a_part_with_features() {
    let scene = [("sensor_box", [1.0, 2.0], 52.0, false)];
    let frame = compose(&scene);
    let objects = objects(&frame);
    for method in [Method::Sift, Method::Shape, Method::Best] {
        let params = RecognizeParams { method, ..RecognizeParams::default() };
        let recognizer = Recognizer::new(CATALOGUE.clone(), params).unwrap();
        let detections = recognizer.recognize(&view(&frame), &objects, Some(camera())).unwrap();
        if method == Method::Sift {
            // Features lie inside of a part, outlines at its ends.
            assert_found_within(&detections, &scene, 0.5, 1.0);
            assert_eq!(detections[0].method, Method::Sift);
        } else {
            assert_found(&detections, &scene);
        }
    }
    let conventional = RECOGNIZER.conventional_sift(&view(&frame), Some(camera())).unwrap();
    assert_found_within(&conventional, &scene, 0.5, 1.0);
    assert!(conventional.iter().all(|d| d.objects.is_empty()));
}

#[test]
fn what_was_computed_is_kept_and_not_needed() {
    let folder = copy_parts(&PARTS[..3]);
    let catalogue = Catalogue::read(folder.path()).unwrap();
    let frame = compose(&SCENE[..2]);
    let objects = objects(&frame);
    let recognize = |catalogue: &Catalogue| {
        let recognizer = Recognizer::new(catalogue.clone(), RecognizeParams::default()).unwrap();
        recognizer.recognize(&view(&frame), &objects, Some(camera())).unwrap()
    };
    let kept = |name: &str| folder.path().join(name).join("descriptors");
    let first = recognize(&catalogue);
    assert_found(&first, &SCENE[..2]);
    let written: Vec<Vec<u8>> = PARTS[..3].iter().map(|name| fs::read(kept(name)).unwrap()).collect();
    assert_eq!(recognize(&catalogue), first);
    // Files of another part and broken ones are made anew.
    fs::write(kept(PARTS[0]), &written[1]).unwrap();
    fs::write(kept(PARTS[1]), &written[1][..written[1].len() / 2]).unwrap();
    assert_eq!(recognize(&catalogue), first);
    for (name, written) in PARTS[..3].iter().zip(&written) {
        assert_eq!(&fs::read(kept(name)).unwrap(), written, "{name}");
    }
    // A folder that cannot be written to, since it is gone.
    folder.close().unwrap();
    assert_eq!(recognize(&catalogue), first);
}

#[test]
fn what_does_not_fit_together_is_refused() {
    let frame = compose(&[]);
    let small = RgbImage::from_pixel(640, 480, TABLE);
    let refused = |result: Result<Vec<Detection>, RecognizeError>| result.unwrap_err();
    let sizes = ([640, 480], [1078, 958]);
    let other = RecognizeError::CameraSize { frame: sizes.0, camera: sizes.1 };
    assert_eq!(refused(RECOGNIZER.recognize(&view(&small), &[], Some(camera()))), other);
    assert_eq!(other.to_string(), "frame of [640, 480] px for a camera of [1078, 958] px");
    let unknown = RecognizeError::CameraUnknown { frame: sizes.0, taught: sizes.1 };
    assert_eq!(refused(RECOGNIZER.recognize(&view(&small), &[], None)), unknown);
    assert_eq!(refused(RECOGNIZER.conventional_sift(&view(&small), None)), unknown);
    assert_eq!(refused(RECOGNIZER.conventional_shape(&view(&small), None)), unknown);
    let objects = [rectangle([0, 0, 20, 20]), rectangle([1070, 950, 9, 3])];
    let outside = refused(RECOGNIZER.recognize(&view(&frame), &objects, None));
    assert_eq!(outside, RecognizeError::ObjectOutside { object: 1, corner: [1078, 952], frame: sizes.1 });
    // So does a shadow.
    let shadow = rectangle([500, 950, 9, 10]).mask;
    let shaded = [ObjectRegion { shadow: Some(shadow), ..rectangle([500, 940, 9, 9]) }];
    let outside = refused(RECOGNIZER.recognize(&view(&frame), &shaded, None));
    assert_eq!(outside, RecognizeError::ObjectOutside { object: 0, corner: [508, 959], frame: sizes.1 });
    let none = Recognizer::new(CATALOGUE.without(&PARTS), RecognizeParams::default());
    assert_eq!(none.unwrap_err(), RecognizeError::Empty);
    let params = RecognizeParams { min_score: 2.0, ..RecognizeParams::default() };
    let message = Recognizer::new(CATALOGUE.clone(), params).unwrap_err().to_string();
    assert_eq!(message, "min_score = 2; allowed are 0 to 1");
}

#[test]
fn a_part_that_was_taken_for_shadow_is_found_in_its_region() {
    let frame = compose(&SCENE);
    let found = objects(&frame);
    for object in &found {
        let bare = BareRegion { region: 7, mask: object.mask.clone() };
        let detections = RECOGNIZER.recognize_all(&view(&frame), &[], &[bare], Some(camera())).unwrap();
        let [detection] = &detections[..] else { panic!("{detections:?}") };
        assert!(detection.region == 7 && detection.objects.is_empty(), "{detection:?}");
        let place = detection.world.unwrap();
        let near = |(name, [x, y], ..): &Placed<'_>| {
            detection.name.as_deref() == Some(*name) && (place.x_mm - x).hypot(place.y_mm - y) < 1.0
        };
        assert!(SCENE.iter().any(near), "{detection:?}");
    }
    // Bare table is no part.
    let region = |at: [u32; 4]| BareRegion { region: 0, mask: rectangle(at).mask };
    let (width, height) = frame.dimensions();
    let empty = region([width - 90, 20, 70, 60]);
    assert_eq!(RECOGNIZER.recognize_all(&view(&frame), &[], &[empty], Some(camera())).unwrap(), []);
    let outside = region([width - 10, height - 10, 40, 40]);
    let error = RECOGNIZER.recognize_all(&view(&frame), &[], &[outside], Some(camera())).unwrap_err();
    assert!(matches!(error, RecognizeError::RegionOutside { region: 0, .. }), "{error}");
}

#[test]
fn no_object_is_no_detection() {
    let frame = compose(&[]);
    assert_eq!(RECOGNIZER.recognize(&view(&frame), &[], Some(camera())).unwrap(), []);
}

#[test]
fn a_few_pixels_are_an_unknown_object() {
    let frame = compose(&[]);
    // In the middle, in corners of the frame, one pixel, and lines.
    let boxes = [[500, 400, 3, 3], [0, 0, 1, 1], [1077, 957, 1, 1], [0, 500, 1, 40], [600, 957, 70, 1], [7, 9, 2, 1]];
    for (i, place) in boxes.into_iter().enumerate() {
        let object = [rectangle(place)];
        let detections = RECOGNIZER.recognize(&view(&frame), &object, Some(camera())).unwrap();
        let [detection] = &detections[..] else { panic!("{place:?}: {detections:#?}") };
        assert_eq!((detection.name.as_deref(), &detection.mask), (None, &object[0].mask), "{i}: {place:?}");
    }
}

#[test]
fn thresholds_decide_what_has_a_name() {
    let frame = compose(&SCENE);
    let objects = objects(&frame);
    let names = |params: RecognizeParams| {
        let recognizer = Recognizer::new(CATALOGUE.clone(), params).unwrap();
        let detections = recognizer.recognize(&view(&frame), &objects, Some(camera())).unwrap();
        (detections.iter().filter(|d| d.name.is_some()).count(), detections.len())
    };
    // Nothing is as sure as 1.
    assert_eq!(names(RecognizeParams { min_score: 1.0, ..RecognizeParams::default() }), (0, 3));
    assert_eq!(names(RecognizeParams { min_margin: 1.0, ..RecognizeParams::default() }), (0, 3));
}
