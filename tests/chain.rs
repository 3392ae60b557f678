//! The whole vision chain on the bundled frames, and its configuration.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "helpers of tests fail by panicking, too")]

use std::path::Path;

use image::RgbImage;
use samsod::recognize::{self, Catalogue, RecognizeParams, SiftParams};
use samsod::saliency::{Method, SaliencyParams, Scales, Threshold};
use samsod::segment::{RgbView, SegmentParams};
use samsod::shadow::{Mask, ObjectSide, ShadowParams};
use samsod::{Cell, CellParams, RegionParams, Scene};

fn load(name: &str) -> RgbImage {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/cell").join(name);
    image::open(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display())).into_rgb8()
}

fn view(image: &RgbImage) -> RgbView<'_> {
    RgbView::from_raw(image.width(), image.height(), image.as_raw().as_slice()).expect("packed")
}

fn default_cell() -> Cell {
    Cell::new(CellParams::default()).expect("defaults are in range")
}

fn flat(width: u32, height: u32, colour: [u8; 3]) -> RgbImage {
    RgbImage::from_pixel(width, height, image::Rgb(colour))
}

/// A dark box alone on a grey table, of some 3900 px, is no shadow, wherever its shadow is said to end.
#[test]
fn a_dark_box_alone_is_one_object_wherever_its_shadow_ends() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/teach/sensor_box.jpg");
    let picture = image::open(path).unwrap().into_rgb8();
    for penumbra_light in [0.75, 0.8, 0.9, 1.0] {
        let segment = SegmentParams { penumbra_light, ..SegmentParams::default() };
        let params = CellParams { segment, ..CellParams::default() };
        let scene = Cell::new(params).unwrap().inspect(&view(&picture)).unwrap();
        let areas: Vec<_> = scene.objects.iter().map(|object| object.area).collect();
        assert!(matches!(areas[..], [3300..=4300]), "light {penumbra_light}: objects of {areas:?} px");
    }
}

/// Number of the region that holds a pixel.
fn region_at(scene: &Scene, [x, y]: [u32; 2]) -> Option<usize> {
    let label = scene.partition.labels()[(y * scene.partition.width() + x) as usize];
    scene.regions.iter().position(|r| r.partitions.contains(&label))
}

/// What a frame shows.
struct Truth {
    frame: &'static str,
    /// The pixel deepest inside each part (a nut's centre is table).
    parts: &'static [(&'static str, [u32; 2])],
    /// Places with at least 120 px of bare, unshaded table around them.
    table: &'static [[u32; 2]],
    /// Regions of bare table that are tolerated.
    spurious: usize,
}

const TRUTHS: [Truth; 6] = [
    Truth {
        frame: "0001.jpg",
        parts: &[
            ("star knob", [376, 437]),
            ("spur gear", [986, 334]),
            ("flange", [171, 626]),
            ("bearing", [128, 464]),
            ("hex nut", [767, 319]),
            ("hex nut", [206, 280]),
            ("washer", [510, 75]),
        ],
        table: &[[672, 656], [552, 292], [376, 800], [840, 152], [132, 132]],
        spurious: 1,
    },
    Truth {
        frame: "0008.jpg",
        parts: &[
            ("u-channel", [879, 249]),
            ("l-bracket", [219, 359]),
            ("asymmetric plate", [320, 449]),
            ("star knob", [453, 612]),
            ("flange", [666, 640]),
            ("stepped shaft", [379, 675]),
            ("housing block", [318, 240]),
        ],
        table: &[[612, 400], [176, 764], [912, 548], [744, 132], [124, 124]],
        spurious: 1,
    },
    Truth {
        frame: "0010.jpg",
        parts: &[
            ("sensor box", [873, 669]),
            ("hex bolt", [87, 184]),
            ("t-piece", [637, 166]),
            ("socket screw", [620, 580]),
            ("dovetail plate", [265, 767]),
            ("wing nut", [395, 553]),
        ],
        table: &[[844, 412], [332, 312], [488, 784], [940, 132], [132, 528]],
        spurious: 1,
    },
    Truth {
        frame: "0022.jpg",
        parts: &[
            ("socket screw", [118, 407]),
            ("hex nut", [1023, 184]),
            ("u-channel", [955, 484]),
            ("stepped shaft", [930, 782]),
            ("dovetail plate", [769, 225]),
        ],
        table: &[[488, 596], [316, 228], [180, 768], [724, 804], [592, 128]],
        spurious: 1,
    },
    Truth {
        frame: "0032.jpg",
        parts: &[
            ("star knob", [304, 891]),
            ("sensor box", [807, 602]),
            ("flange", [416, 604]),
            ("dovetail plate", [605, 576]),
        ],
        table: &[[272, 272], [828, 248], [152, 724], [544, 136], [948, 512]],
        spurious: 1,
    },
    Truth {
        frame: "0039.jpg",
        parts: &[
            ("spur gear", [276, 553]),
            ("flange", [461, 534]),
            ("star knob", [301, 443]),
            ("u-channel", [500, 253]),
            ("stepped shaft", [384, 300]),
            ("t-piece", [303, 295]),
        ],
        table: &[[800, 680], [824, 248], [464, 764], [156, 736], [124, 424]],
        // Dark stains.
        spurious: 3,
    },
];

/// One cell for all frames, as in a running daemon.
#[test]
fn every_part_of_the_bundled_frames_is_in_a_salient_region_and_the_table_in_none() {
    let mut cell = default_cell();
    for truth in TRUTHS {
        let image = load(truth.frame);
        let scene = cell.inspect(&view(&image)).expect("a frame of a camera");
        let (frame, found) = (truth.frame, scene.regions.len());
        for (part, at) in truth.parts {
            assert!(region_at(&scene, *at).is_some(), "{frame}: {part} at {at:?} is in no region");
        }
        for at in truth.table {
            assert_eq!(region_at(&scene, *at), None, "{frame}: the table at {at:?} is salient");
        }
        // Parts that are close, or joined by a shadow, may share a region.
        let count = truth.parts.len();
        assert!((count - 2..=count + truth.spurious).contains(&found), "{frame}: {found} regions of {count} parts");
    }
}

/// Invariants that later stages rely on, on real frames.
#[test]
fn stages_of_a_scene_agree() {
    let image = load("0008.jpg");
    let scene = default_cell().inspect(&view(&image)).unwrap();
    let (width, height) = image.dimensions();
    assert_eq!((scene.partition.width(), scene.partition.height()), (width, height));
    assert_eq!((scene.saliency.width(), scene.saliency.height()), (width, height));
    assert!(scene.saliency.values().iter().all(|v| (0.0..=1.0).contains(v)));
    let mut owner = vec![false; (width * height) as usize];
    for region in &scene.regions {
        let mask = region.mask(&scene.partition);
        let inside: Vec<usize> = (0..owner.len()).filter(|&i| mask.as_raw()[i] != 0).collect();
        assert_eq!(inside.len(), region.area as usize);
        for i in inside {
            assert!(!std::mem::replace(&mut owner[i], true), "regions are disjoint");
        }
    }
    assert!(scene.regions.is_sorted_by(|a, b| a.area >= b.area), "largest first");
    assert!(!scene.objects.is_empty());
    let mut taken = vec![false; (width * height) as usize];
    for object in &scene.objects {
        assert!(object.region < scene.regions.len());
        assert_eq!(object.mask.area(), object.area);
        for run in object.mask.runs().chain(object.shadow.iter().flat_map(Mask::runs)) {
            for x in run.start..run.end {
                let i = (run.y * width + x) as usize;
                assert!(!std::mem::replace(&mut taken[i], true), "objects and shadows are disjoint");
                let region = region_at(&scene, [x, run.y]);
                assert!(region.is_none_or(|region| region == object.region), "never in another region");
            }
        }
    }
    assert!(scene.objects.is_sorted_by(|a, b| (a.region, b.area) <= (b.region, a.area)), "by region, largest first");
    assert!(scene.detections.is_empty(), "a cell without a catalogue names nothing");
    assert_eq!(scene.times.stages().map(|(name, _)| name), ["segment", "saliency", "regions", "shadow", "recognize"]);
    let times = scene.times;
    assert_eq!(times.total(), times.segment + times.saliency + times.regions + times.shadow + times.recognize);
}

/// Every object is accounted for: it is of a part, or unknown, and never both.
#[test]
fn with_a_catalogue_every_object_is_a_part_or_unknown() {
    let image = load("0032.jpg");
    let parts = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/parts");
    let mut cell = Cell::with_catalogue(CellParams::default(), Catalogue::read(&parts).unwrap()).unwrap();
    let mut scene = Scene::default();
    cell.inspect_into(&view(&image), &mut scene).unwrap();
    assert!(!scene.objects.is_empty());
    for (index, object) in scene.objects.iter().enumerate() {
        let of_object: Vec<_> = scene.detections.iter().filter(|d| d.objects.contains(&index)).collect();
        assert!(!of_object.is_empty(), "object {index} of {} px", object.area);
        assert!(of_object.iter().all(|detection| detection.region == object.region), "{of_object:?}");
        let unknown = of_object.iter().filter(|detection| detection.name.is_none()).count();
        assert!(unknown == 0 || of_object.len() == 1, "{of_object:?}");
    }
    let first = scene.detections.clone();
    let named = |name: &str| first.iter().filter(|detection| detection.name.as_deref() == Some(name)).count();
    assert_eq!(["star_knob", "sensor_box", "flange", "dovetail_plate"].map(named), [1; 4], "{first:?}");
    assert!(first.iter().all(|detection| detection.world.is_none()), "no camera was given");
    // A frame without objects leaves none of the earlier names, and the same frame has the same again.
    cell.inspect_into(&view(&flat(1078, 958, [90, 100, 110])), &mut scene).unwrap();
    assert_eq!(scene.detections, []);
    cell.inspect_into(&view(&image), &mut scene).unwrap();
    assert_eq!(scene.detections, first);
}

/// A stream reuses cell and scene: neither an earlier frame nor one of another size leaves anything behind.
#[test]
fn reused_cell_and_scene_give_identical_results() {
    let (first, second) = (load("0039.jpg"), load("0022.jpg"));
    let part = image::imageops::crop_imm(&second, 300, 100, 501, 333).to_image();
    let mut cell = default_cell();
    let mut scene = Scene::default();
    for image in [&first, &second, &part, &first] {
        cell.inspect_into(&view(image), &mut scene).unwrap();
        let fresh = default_cell().inspect(&view(image)).unwrap();
        assert!(scene.partition == fresh.partition);
        assert!(scene.saliency == fresh.saliency);
        assert_eq!(scene.regions, fresh.regions);
        assert_eq!(scene.objects, fresh.objects);
    }
}

#[test]
fn frames_with_nothing_on_them_have_no_regions() {
    let mut cell = default_cell();
    for (width, height) in [(1, 1), (1, 200), (200, 1), (2, 2), (320, 240)] {
        let scene = cell.inspect(&view(&flat(width, height, [90, 100, 110]))).unwrap();
        assert_eq!((scene.partition.len(), scene.regions.len()), (1, 0), "{width} x {height}");
        assert!(scene.objects.is_empty());
        assert!(scene.saliency.values().iter().all(|&s| s == 0.0));
    }
}

#[test]
fn a_frame_without_pixels_or_too_large_is_refused() {
    let mut cell = default_cell();
    for (width, height) in [(0, 5), (16_385, 1)] {
        let message = cell.inspect(&view(&flat(width, height, [9; 3]))).unwrap_err().to_string();
        assert_eq!(message, format!("segment: image of {width} x {height} px; both sides must be 1 to 16384"));
    }
    // The cell is as good as new.
    assert_eq!(cell.inspect(&view(&flat(30, 20, [9; 3]))).unwrap().partition.len(), 1);
}

#[test]
fn parameters_out_of_range_are_refused_with_their_stage() {
    let error = |params: CellParams| Cell::new(params).expect_err("out of range").to_string();
    let segment = SegmentParams { range_bandwidth: f32::NAN, ..SegmentParams::default() };
    let message = error(CellParams { segment, ..CellParams::default() });
    assert_eq!(message, "segment: range_bandwidth = NaN; allowed are 1 to 255");
    let saliency = SaliencyParams { scales: Scales::ObjectSizes(vec![-8.0]), ..SaliencyParams::default() };
    let message = error(CellParams { saliency, ..CellParams::default() });
    assert_eq!(message, "saliency: object_sizes_px = -8 px; allowed are 1 to 16384 px");
    let shadow = ShadowParams { min_object_area_px: Some(0), ..ShadowParams::default() };
    let message = error(CellParams { shadow, ..CellParams::default() });
    assert_eq!(message, "shadow: min_object_area_px = 0; allowed are 1 to 4294967295");
    let recognize = RecognizeParams { min_score: 2.0, ..RecognizeParams::default() };
    let message = error(CellParams { recognize, ..CellParams::default() });
    assert_eq!(message, "recognize: min_score = 2; allowed are 0 to 1");
    let regions = RegionParams { threshold: Threshold::Value(f32::NAN) };
    let message = error(CellParams { regions, ..CellParams::default() });
    assert_eq!(message, "regions: threshold = NaN; allowed are \"positive\", \"adaptive\" or a number from 0 to 1");
}

#[test]
fn parameters_survive_toml() {
    let pixels = Scales::Pixels { center_px: vec![0.7, 3.5], surround_px: vec![19.25] };
    let thresholds = [Threshold::Positive, Threshold::Adaptive, Threshold::Value(0.3)];
    for (scales, threshold) in
        [Scales::Generic, pixels, Scales::ObjectSizes(vec![40.0, 90.0])].into_iter().zip(thresholds)
    {
        let params = CellParams {
            segment: SegmentParams {
                spatial_bandwidth_px: Some(12.5),
                range_bandwidth: 5.1,
                texture_gain: 0.0,
                min_area_px: Some(77),
                penumbra_light: 0.9,
            },
            saliency: SaliencyParams { method: Method::Exact, scales, ..SaliencyParams::default() },
            regions: RegionParams { threshold },
            shadow: ShadowParams { object_side: ObjectSide::Paper, min_object_area_px: Some(9) },
            recognize: RecognizeParams {
                method: recognize::Method::Shape,
                min_score: 0.7,
                min_margin: 0.1,
                sift: SiftParams {
                    contrast_threshold: 0.03,
                    ratio: 1.25,
                    max_features: 500,
                    min_inliers: 8,
                    confirm: true,
                },
            },
        };
        let text = toml::to_string(&params).unwrap();
        assert_eq!(toml::from_str::<CellParams>(&text).unwrap(), params, "{text}");
    }
    let text = toml::to_string(&CellParams::default()).unwrap();
    assert_eq!(toml::from_str::<CellParams>(&text).unwrap(), CellParams::default(), "{text}");
    assert_eq!(toml::from_str::<CellParams>("").unwrap(), CellParams::default());
}

#[test]
fn parameters_as_a_user_writes_them() {
    let params: CellParams = toml::from_str(
        "[segment]\nmin_area_px = 200\n[saliency]\nmethod = \"exact\"\nscales = { object_sizes_px = [40, 90.5] }\n\
         [regions]\nthreshold = 0.02\n[shadow]\nobject_side = \"paper\"\nmin_object_area_px = 50\n\
         [recognize]\nmethod = \"sift\"\nsift = { ratio = 1.2 }",
    )
    .unwrap();
    assert_eq!(params.segment, SegmentParams { min_area_px: Some(200), ..SegmentParams::default() });
    assert_eq!(
        params.saliency,
        SaliencyParams {
            method: Method::Exact,
            scales: Scales::ObjectSizes(vec![40.0, 90.5]),
            ..SaliencyParams::default()
        }
    );
    assert_eq!(params.regions.threshold, Threshold::Value(0.02));
    assert_eq!(params.shadow, ShadowParams { object_side: ObjectSide::Paper, min_object_area_px: Some(50) });
    let sift = SiftParams { ratio: 1.2, ..SiftParams::default() };
    assert_eq!(
        params.recognize,
        RecognizeParams { method: recognize::Method::Sift, sift, ..RecognizeParams::default() }
    );
    let params: CellParams = toml::from_str("regions.threshold = 1").unwrap();
    assert_eq!(params.regions.threshold, Threshold::Value(1.0), "a whole number is a number");
    let params: CellParams =
        toml::from_str("saliency.scales = { pixels = { center_px = [2], surround_px = [8, 9] } }").unwrap();
    assert_eq!(params.saliency.scales, Scales::Pixels { center_px: vec![2.0], surround_px: vec![8.0, 9.0] });
}

#[test]
fn mistakes_in_a_configuration_are_named() {
    let cases: [(&str, &[&str]); 14] = [
        ("segmnt = {}", &["segmnt", "segment", "saliency", "regions", "shadow", "recognize"]),
        ("segment.bandwidth = 3", &["bandwidth", "spatial_bandwidth_px", "range_bandwidth"]),
        ("segment.range_bandwidth = \"wide\"", &["range_bandwidth", "wide"]),
        ("segment.min_area_px = -5", &["min_area_px", "-5"]),
        ("saliency.mode = \"fast\"", &["mode", "method", "scales"]),
        ("saliency.method = \"quick\"", &["quick", "fast", "exact"]),
        ("saliency.scales = \"fine\"", &["fine", "generic", "pixels", "object_sizes"]),
        ("regions.treshold = 0.1", &["treshold", "threshold"]),
        ("shadow.side = \"paper\"", &["side", "object_side", "min_object_area_px"]),
        ("shadow.object_side = \"bright\"", &["bright", "paper", "evidence"]),
        ("recognize.score = 0.5", &["score", "method", "min_score", "min_margin", "sift"]),
        ("recognize.method = \"surf\"", &["surf", "sift", "shape", "best"]),
        (
            "recognize.sift.octaves = 4",
            &["octaves", "contrast_threshold", "ratio", "max_features", "min_inliers", "confirm"],
        ),
        ("regions.threshold = \"positiv\"", &["threshold", "positiv", "\"positive\"", "\"adaptive\"", "0 to 1"]),
    ];
    for (text, named) in cases {
        let message = toml::from_str::<CellParams>(text).unwrap_err().to_string();
        for word in named {
            assert!(message.contains(word), "{text}: {word} is not in\n{message}");
        }
    }
    // A number that is written well but out of range is refused when the cell is made.
    let params: CellParams = toml::from_str("regions.threshold = 7").unwrap();
    let message = Cell::new(params).unwrap_err().to_string();
    assert!(message.contains("threshold = 7") && message.contains("from 0 to 1"), "{message}");
}

/// Who asks for finer partitions gets smaller objects, unless told otherwise.
#[test]
fn the_least_object_follows_from_the_segmentation() {
    let mut image = flat(320, 240, [90, 100, 110]);
    for (x, y) in (0..9).flat_map(|x| (0..6).map(move |y| (x, y))) {
        image.put_pixel(100 + x, 90 + y, image::Rgb([220, 40, 30]));
    }
    let objects = |text: &str| {
        let params: CellParams = toml::from_str(text).unwrap();
        let scene = Cell::new(params).unwrap().inspect(&view(&image)).unwrap();
        assert_eq!(scene.regions.len(), 1, "{text}");
        scene.objects.len()
    };
    assert_eq!(objects("segment.spatial_bandwidth_px = 3"), 1);
    // 54 pixels, and at most one more on each side where an edge without any blur lies between two.
    assert_eq!(objects("shadow.min_object_area_px = 90"), 0);
    assert_eq!(objects("segment.min_area_px = 4"), 1);
    assert_eq!(objects("segment.min_area_px = 4\nshadow.min_object_area_px = 90"), 0);
}
