//! The separation on scenes whose answer is known.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "helpers of tests fail by panicking, too")]

use proptest::prelude::*;
use samsod_saliency::{SaliencyMap, SalientRegion};
use samsod_segment::{BoundingBox, Partition, RgbView};
use samsod_shadow::{Mask, ObjectRegion, ObjectSide, ShadowError, ShadowParams, ShadowSeparator};

/// A frame, and which partition each pixel belongs to; 0 is the table.
struct Scene {
    width: u32,
    height: u32,
    labels: Vec<u32>,
    rgb: Vec<u8>,
    saliency: Vec<f32>,
}

impl Scene {
    fn new(width: u32, height: u32, table: [u8; 3]) -> Self {
        let n = (width * height) as usize;
        Self { width, height, labels: vec![0; n], rgb: table.repeat(n), saliency: vec![0.01; n] }
    }

    /// Paints a rectangle of columns x and rows y.
    fn paint(
        mut self,
        label: u32,
        [x0, x1]: [u32; 2],
        [y0, y1]: [u32; 2],
        colour: impl Fn(u32, u32) -> [u8; 3],
        saliency: f32,
    ) -> Self {
        for y in y0..y1 {
            for x in x0..x1 {
                let i = (y * self.width + x) as usize;
                self.labels[i] = label;
                self.rgb[i * 3..i * 3 + 3].copy_from_slice(&colour(x, y));
                self.saliency[i] = saliency;
            }
        }
        self
    }

    fn frame(&self) -> RgbView<'_> {
        RgbView::from_raw(self.width, self.height, &self.rgb[..]).unwrap()
    }

    fn partition(&self) -> Partition {
        Partition::from_labels(&self.frame(), self.labels.clone()).unwrap()
    }

    fn map(&self) -> SaliencyMap {
        SaliencyMap::from_values(self.width, self.height, self.saliency.clone()).unwrap()
    }

    fn separate(&self, regions: &[&[u32]]) -> Vec<ObjectRegion> {
        let regions: Vec<SalientRegion> = regions.iter().map(|labels| region(labels)).collect();
        separator(ObjectSide::Paper).separate(&self.frame(), &self.partition(), &self.map(), &regions).unwrap()
    }
}

fn separator(object_side: ObjectSide) -> ShadowSeparator {
    ShadowSeparator::new(ShadowParams { object_side, min_object_area_px: Some(4) }).unwrap()
}

/// Only the labels of a region are read.
fn region(labels: &[u32]) -> SalientRegion {
    let bbox = BoundingBox { x: 0, y: 0, width: 1, height: 1 };
    SalientRegion { partitions: labels.to_vec(), area: 0, bbox, centroid: [0.0; 2], axis_rad: 0.0, mean_saliency: 0.0 }
}

fn bbox(mask: &Mask) -> [u32; 4] {
    let b = mask.bbox();
    [b.x, b.y, b.width, b.height]
}

const TABLE: [u8; 3] = [150, 170, 200];
/// The table at half of the light.
const SHADE: [u8; 3] = [75, 85, 100];
const RED: [u8; 3] = [210, 40, 30];

/// A red part of two partitions on a blue table; its shadow, of two partitions, to the right.
fn part_with_shadow() -> Scene {
    Scene::new(90, 60, TABLE)
        .paint(1, [20, 30], [20, 40], |_, y| [RED[0] - (y % 3) as u8, RED[1], RED[2]], 0.8)
        .paint(2, [30, 40], [20, 40], |x, _| [RED[0] / 2, RED[1] / 2 - (x % 2) as u8, RED[2] / 2], 0.6)
        .paint(3, [40, 46], [20, 40], |_, _| SHADE, 0.4)
        .paint(4, [46, 50], [22, 40], |_, _| [105, 119, 140], 0.3)
}

#[test]
fn a_coloured_part_is_parted_from_its_shadow() {
    let found = part_with_shadow().separate(&[&[1, 2, 3, 4]]);
    let [part] = &found[..] else { panic!("{} objects", found.len()) };
    assert_eq!((part.region, part.area), (0, 400));
    assert_eq!(bbox(&part.mask), [20, 20, 20, 20]);
    assert_eq!(part.centroid, [29.5, 29.5]);
    let shadow = part.shadow.as_ref().unwrap();
    assert_eq!((bbox(shadow), shadow.area()), ([40, 20, 10, 20], 6 * 20 + 4 * 18));
}

#[test]
fn evidence_is_the_default_and_keeps_the_whole_part() {
    assert_eq!(ShadowParams::default().object_side, ObjectSide::Evidence);
    let scene = part_with_shadow();
    let found = separator(ObjectSide::default())
        .separate(&scene.frame(), &scene.partition(), &scene.map(), &[region(&[1, 2, 3, 4])])
        .unwrap();
    let [part] = &found[..] else { panic!("{} objects", found.len()) };
    let kept = (20..40).flat_map(|y| (20..40).map(move |x| (x, y))).filter(|&(x, y)| part.mask.contains(x, y)).count();
    assert!(kept >= 390, "{kept} of 400 pixels");
    // The shadow has the hard edge of a part, so some of it may pass for one; shadows of lamps are tested below.
    assert!(part.area < 580, "{}", part.area);
}

/// Light without a lamp's edge: what the box blur of a half-plane or a disc would be, `width` px wide.
fn step(inside_px: f32, width: f32) -> f32 {
    let t = (inside_px / width + 0.5).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

/// What stands on the table: a rectangle round `center`, px, and how far the shadow lies to the right and below.
#[derive(Clone, Copy)]
struct Part {
    center: [f32; 2],
    half: [f32; 2],
    color: [f32; 3],
    shadow: [f32; 2],
}

impl Part {
    fn new(center: [f32; 2], half: [f32; 2], color: [f32; 3]) -> Self {
        // Edges between pixels.
        Self { center: center.map(|c| c + 0.5), half, color, shadow: [14.0, 9.0] }
    }

    /// How far inside of the part, moved by `by`, a pixel lies; below 0 outside.
    fn inside(&self, x: f32, y: f32, by: [f32; 2]) -> f32 {
        let [cx, cy] = [self.center[0] + by[0], self.center[1] + by[1]];
        (self.half[0] - (x - cx).abs()).min(self.half[1] - (y - cy).abs())
    }

    /// Share of the light that its shadow takes: swept from the part, where it is sharp, to its end, where it is soft.
    fn shade(&self, x: f32, y: f32) -> f32 {
        let sweep = (0..=8).map(|k| k as f32 / 8.0);
        sweep.map(|t| step(self.inside(x, y, self.shadow.map(|s| t * s)), EDGE_PX + 8.0 * t)).fold(0.0, f32::max)
    }
}

/// A photograph of parts with soft shadows, what it shows, and its partition: 1 and 2 are part and shadow of the first
/// part, 3 and 4 of the second. Light is linear, as the shadows are.
struct Photo {
    scene: Scene,
    part: Vec<bool>,
    shadow: Vec<bool>,
}

const LIGHT_IN_SHADOW: f32 = 0.45;
/// Width of the edge of a part, px.
const EDGE_PX: f32 = 1.5;

fn photo([width, height]: [u32; 2], table: [f32; 3], parts: &[Part]) -> Photo {
    let mut scene = Scene::new(width, height, [0; 3]);
    let n = (width * height) as usize;
    let (mut part, mut shadow) = (vec![false; n], vec![false; n]);
    let mut seed = 0x2545_F491u32;
    for i in 0..n {
        let (x, y) = ((i as u32 % width) as f32, (i as u32 / width) as f32);
        let shade = parts.iter().map(|p| p.shade(x, y)).fold(0.0, f32::max);
        let light = (1.0 - 0.0005 * x) * (1.0 - (1.0 - LIGHT_IN_SHADOW) * shade);
        let mut color = table.map(|c| c * light);
        for (k, p) in (0..).zip(parts) {
            let share = step(p.inside(x, y, [0.0; 2]), EDGE_PX);
            color = std::array::from_fn(|c| color[c] * (1.0 - share) + p.color[c] * (1.0 - 0.0005 * x) * share);
            // The partitions end where light is down by a fifth, and a pixel beside the true edge.
            if p.shade(x, y) > 0.35 && scene.labels[i] == 0 {
                scene.labels[i] = 2 * k + 2;
            }
            if p.inside(x, y, [-1.0, 0.0]) > 0.0 {
                scene.labels[i] = 2 * k + 1;
            }
            part[i] |= share > 0.5;
        }
        shadow[i] = !part[i] && shade > 0.1;
        for (level, color) in scene.rgb[3 * i..3 * i + 3].iter_mut().zip(color) {
            seed ^= seed << 13;
            seed ^= seed >> 17;
            seed ^= seed << 5;
            let noise = (seed >> 8) as f32 / (1 << 24) as f32 * 5.0 - 2.5;
            *level = (srgb(color) + noise).round().clamp(0.0, 255.0) as u8;
        }
    }
    Photo { scene, part, shadow }
}

fn srgb(linear: f32) -> f32 {
    255.0 * if linear <= 0.003_130_8 { 12.92 * linear } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 }
}

/// Intersection over union.
fn iou(found: &[bool], truth: &[bool]) -> f32 {
    let count = |f: fn(bool, bool) -> bool| found.iter().zip(truth).filter(|(a, b)| f(**a, **b)).count() as f32;
    count(|a, b| a && b) / count(|a, b| a || b)
}

impl Scene {
    fn evidence(&self, regions: &[&[u32]]) -> Vec<ObjectRegion> {
        let regions: Vec<SalientRegion> = regions.iter().map(|labels| region(labels)).collect();
        let params = ShadowParams { min_object_area_px: Some(60), ..ShadowParams::default() };
        let mut separator = ShadowSeparator::new(params).unwrap();
        separator.separate(&self.frame(), &self.partition(), &self.map(), &regions).unwrap()
    }

    /// The pixels of some masks.
    fn pixels<'a>(&self, masks: impl IntoIterator<Item = &'a Mask>) -> Vec<bool> {
        let mut all = vec![false; self.labels.len()];
        for run in masks.into_iter().flat_map(Mask::runs) {
            let row = (run.y * self.width) as usize;
            all[row + run.start as usize..row + run.end as usize].fill(true);
        }
        all
    }
}

impl Photo {
    /// Intersection over union of the parts and of the shadows, and the share of the shadows that was found.
    fn scores(&self, found: &[ObjectRegion]) -> (f32, f32, f32) {
        let scene = &self.scene;
        let part = iou(&scene.pixels(found.iter().map(|o| &o.mask)), &self.part);
        let shadow = scene.pixels(found.iter().filter_map(|o| o.shadow.as_ref()));
        let hits: Vec<bool> = shadow.iter().zip(&self.shadow).map(|(a, b)| *a && *b).collect();
        (part, iou(&shadow, &self.shadow), iou(&hits, &self.shadow))
    }
}

const BLUE_TABLE: [f32; 3] = [0.12, 0.2, 0.42];
const GREY_TABLE: [f32; 3] = [0.36; 3];
const ORANGE: [f32; 3] = [0.5, 0.16, 0.03];
/// Little darker than the table in shadow, by twenty sRGB levels.
const GREY: [f32; 3] = [0.12; 3];

/// Three parts in regions of their own.
fn three(color: [f32; 3]) -> [Part; 3] {
    [
        Part::new([45.0, 45.0], [22.0, 16.0], color),
        Part::new([150.0, 50.0], [18.0, 24.0], color),
        Part::new([90.0, 130.0], [30.0, 14.0], color),
    ]
}

const THREE: [&[u32]; 3] = [&[1, 2], &[3, 4], &[5, 6]];

#[test]
fn evidence_finds_coloured_parts_and_their_soft_shadows() {
    let photo = photo([220, 180], BLUE_TABLE, &three(ORANGE));
    let found = photo.scene.evidence(&THREE);
    assert_eq!(found.iter().map(|o| o.region).collect::<Vec<_>>(), [0, 1, 2]);
    let (part, shadow, share) = photo.scores(&found);
    println!("coloured: parts {part}, shadows {shadow}, {share} of them found");
    assert!(part > 0.95 && shadow > 0.85 && share > 0.9, "parts {part}, shadows {shadow}, {share} of them found");
}

#[test]
fn evidence_finds_grey_parts_on_a_grey_table_beside_shadows_as_dark() {
    let photo = photo([220, 180], GREY_TABLE, &three(GREY));
    let found = photo.scene.evidence(&THREE);
    let (part, shadow, share) = photo.scores(&found);
    println!("grey: parts {part}, shadows {shadow}, {share} of them found");
    assert_eq!(found.iter().map(|o| o.region).collect::<Vec<_>>(), [0, 1, 2]);
    assert!(part > 0.95 && share > 0.9, "parts {part}, shadows {shadow}, {share} of them found");
}

#[test]
fn the_table_in_a_ring_is_no_object() {
    for (table, color) in [(BLUE_TABLE, ORANGE), (GREY_TABLE, [0.05; 3])] {
        let mut photo = photo([160, 120], table, &[Part::new([70.0, 55.0], [30.0, 26.0], color)]);
        // A hole of 24 x 24 px through which the lit table shows; the partition does not know it.
        let mut hole = vec![false; photo.part.len()];
        for (x, y) in (43..67).flat_map(|y| (58..82).map(move |x| (x, y))) {
            let i = y * 160 + x;
            (hole[i], photo.part[i]) = (true, false);
            // As it is at the top of the same column.
            let bare = 3 * ((y - 43) % 10 * 160 + x);
            photo.scene.rgb.copy_within(bare..bare + 3, 3 * i);
        }
        let found = photo.scene.evidence(&[&[1, 2]]);
        let [ring] = &found[..] else { panic!("{} objects", found.len()) };
        let taken = photo.scene.pixels([&ring.mask]).iter().zip(&hole).filter(|(a, b)| **a && **b).count();
        assert_eq!(ring.holes.len(), 1);
        assert!(taken < 60, "{taken} of 576 pixels of the hole");
        let (part, ..) = photo.scores(&found);
        println!("ring: part {part}, {taken} px of the hole");
        assert!(part > 0.9, "{part}");
    }
}

#[test]
fn a_region_of_shadow_alone_beside_proper_ones() {
    for (name, table, color) in [("coloured", BLUE_TABLE, ORANGE), ("grey", GREY_TABLE, GREY)] {
        let mut photo = photo([220, 180], table, &three(color));
        // The shadow of something out of sight: soft on all sides, as dark as the others.
        for (x, y) in (100..170).flat_map(|y| (140..215).map(move |x| (x, y))) {
            let i = y * 220 + x;
            let shade = step(20.0 - (x as f32 - 182.0).hypot(y as f32 - 140.0), 8.0);
            if photo.scene.labels[i] == 0 && shade > 0.05 {
                let light = 1.0 - (1.0 - LIGHT_IN_SHADOW) * shade;
                for (level, linear) in photo.scene.rgb[3 * i..3 * i + 3].iter_mut().zip(table) {
                    let lit = srgb(linear * (1.0 - 0.0005 * x as f32) * light);
                    *level = (lit + ((x * 7 + y * 3) % 5) as f32 - 2.0) as u8;
                }
                if shade > 0.35 {
                    photo.scene.labels[i] = 7;
                }
            }
        }
        let found = photo.scene.evidence(&[THREE[0], THREE[1], THREE[2], &[7]]);
        let alone: Vec<u32> = found.iter().filter(|o| o.region == 3).map(|o| o.area).collect();
        println!("{name}: objects in the region of shadow {alone:?}");
        assert!(alone.is_empty(), "{name}: {alone:?}");
        assert_eq!(found.iter().filter(|o| o.region < 3).count(), 3);
    }
}

#[test]
fn evidence_parts_two_that_a_soft_shadow_joins() {
    let (a, b) = (Part::new([50.0, 50.0], [20.0, 22.0], ORANGE), Part::new([108.0, 54.0], [20.0, 20.0], ORANGE));
    let photo = photo([180, 110], BLUE_TABLE, &[Part { shadow: [30.0, 6.0], ..a }, b]);
    let found = photo.scene.evidence(&[&[1, 2, 3, 4]]);
    assert_eq!(found.len(), 2, "{:?}", found.iter().map(|o| bbox(&o.mask)).collect::<Vec<_>>());
    let (part, shadow, share) = photo.scores(&found);
    println!("joined: parts {part}, shadows {shadow}, {share} of them found");
    assert!(part > 0.95 && shadow > 0.85 && share > 0.9, "parts {part}, shadows {shadow}, {share} of them found");
}

#[test]
fn evidence_does_not_depend_on_the_number_of_threads() {
    let photo = photo([220, 180], GREY_TABLE, &three(GREY));
    let on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| photo.scene.evidence(&THREE))
    };
    let one = on(1);
    assert!(!one.is_empty());
    for threads in [2, 4, 4, 4] {
        assert_eq!(on(threads), one, "{threads} threads");
    }
}

#[test]
fn evidence_remembers_nothing_of_the_frame_before() {
    let photos = [
        photo([220, 180], GREY_TABLE, &three(GREY)),
        photo([120, 100], BLUE_TABLE, &[Part::new([45.0, 45.0], [22.0, 16.0], ORANGE)]),
    ];
    let one: [&[u32]; 1] = [&[1, 2]];
    let params = ShadowParams { min_object_area_px: Some(60), ..ShadowParams::default() };
    let mut separator = ShadowSeparator::new(params).unwrap();
    for (scene, regions) in
        [(&photos[0], &THREE[..]), (&photos[1], &one), (&photos[0], &one), (&photos[1], &[]), (&photos[0], &THREE)]
    {
        let scene = &scene.scene;
        let seen: Vec<SalientRegion> = regions.iter().map(|labels| region(labels)).collect();
        let found = separator.separate(&scene.frame(), &scene.partition(), &scene.map(), &seen).unwrap();
        assert_eq!(found, scene.evidence(regions));
    }
}

#[test]
fn evidence_stands_frames_without_any_information() {
    let sizes = [[1, 1], [2, 1], [1, 2], [1, 40], [40, 1], [2, 30], [3, 3], [17, 16], [64, 48]];
    for ([width, height], color) in sizes.into_iter().flat_map(|size| [0, 1, 128, 255].map(|v| (size, [v; 3]))) {
        // One region as large as the frame: no table is left.
        let whole = Scene::new(width, height, color).evidence(&[&[0]]);
        assert!(whole.iter().all(|o| o.area <= width * height));
        if width * height > 1 {
            let lines =
                [([0, 1], [0, height]), ([width - 1, width], [0, height]), ([0, width], [height / 2, height / 2 + 1])];
            for (columns, rows) in lines {
                let scene = Scene::new(width, height, color).paint(1, columns, rows, |_, _| [255 - color[0]; 3], 0.5);
                if scene.labels.contains(&0) {
                    scene.evidence(&[&[1]]);
                    scene.evidence(&[&[1], &[0]]);
                    scene.evidence(&[&[0], &[1]]);
                    scene.evidence(&[&[0, 1]]);
                }
            }
        }
    }
    // A part on a saturated table is found still.
    let scene = Scene::new(80, 60, [255; 3]).paint(1, [20, 50], [20, 40], |_, _| [255, 0, 0], 0.9);
    assert_eq!(scene.evidence(&[&[1]]).iter().map(|o| bbox(&o.mask)).collect::<Vec<_>>(), [[20, 20, 30, 20]]);
}

#[test]
fn the_paper_takes_the_more_salient_side() {
    // As printed, also where it is the shadow: a bright table makes dark shadows stand out.
    let mut scene = part_with_shadow();
    for (s, &label) in scene.saliency.iter_mut().zip(&scene.labels) {
        *s = if label >= 3 { 0.9 } else { 0.1 };
    }
    let found = scene.separate(&[&[1, 2, 3, 4]]);
    assert_eq!(bbox(&found[0].mask), [40, 20, 10, 20]);
}

#[test]
fn a_region_of_one_partition_is_all_object() {
    let found = part_with_shadow().separate(&[&[3]]);
    let [only] = &found[..] else { panic!("{} objects", found.len()) };
    assert_eq!((only.area, only.shadow.clone()), (120, None));
}

#[test]
fn parts_joined_by_a_shadow_are_two_objects() {
    let scene = Scene::new(100, 40, TABLE)
        .paint(1, [10, 30], [10, 30], |_, _| RED, 0.8)
        .paint(2, [30, 50], [12, 28], |_, _| SHADE, 0.3)
        .paint(3, [50, 60], [10, 30], |_, _| RED, 0.7);
    let found = scene.separate(&[&[1, 2, 3]]);
    let boxes: Vec<_> = found.iter().map(|o| (o.region, bbox(&o.mask))).collect();
    assert_eq!(boxes, [(0, [10, 10, 20, 20]), (0, [50, 10, 10, 20])]);
    let shadows: Vec<_> = found.iter().map(|o| bbox(o.shadow.as_ref().unwrap())).collect();
    assert_eq!(shadows, [[30, 12, 10, 16], [40, 12, 10, 16]]);
}

#[test]
fn regions_at_the_border_of_the_frame() {
    let scene = Scene::new(30, 20, TABLE)
        .paint(1, [0, 10], [0, 20], |_, _| RED, 0.8)
        .paint(2, [10, 14], [0, 20], |_, _| SHADE, 0.3)
        .paint(3, [24, 30], [15, 20], |_, _| RED, 0.8);
    let found = scene.separate(&[&[1, 2], &[3]]);
    let boxes: Vec<_> = found.iter().map(|o| (o.region, bbox(&o.mask))).collect();
    assert_eq!(boxes, [(0, [0, 0, 10, 20]), (1, [24, 15, 6, 5])]);
    // A region as large as the frame.
    let whole = Scene::new(9, 7, RED).paint(0, [0, 9], [0, 7], |_, _| RED, 0.5).separate(&[&[0]]);
    assert_eq!((bbox(&whole[0].mask), whole[0].outline.len()), ([0, 0, 9, 7], 28));
}

#[test]
fn where_hues_tell_nothing_all_is_object() {
    let grey = |value: u8| move |_: u32, _: u32| [value; 3];
    let scene = Scene::new(60, 40, [200; 3]).paint(1, [10, 20], [10, 30], grey(120), 0.8).paint(
        2,
        [20, 30],
        [10, 30],
        grey(60),
        0.4,
    );
    let found = scene.separate(&[&[1, 2]]);
    assert_eq!((found.len(), found[0].area), (1, 400));
    // The same hue everywhere, at full saturation.
    let scene = Scene::new(60, 40, [255, 0, 0]).paint(1, [10, 20], [10, 30], |_, _| [255, 0, 0], 0.8).paint(
        2,
        [20, 30],
        [10, 30],
        |_, _| [128, 0, 0],
        0.4,
    );
    let found = scene.separate(&[&[1, 2]]);
    assert_eq!((found.len(), found[0].area), (1, 400));
}

#[test]
fn saturated_colours_are_parted() {
    let scene = Scene::new(60, 40, [0, 255, 0]).paint(1, [10, 20], [10, 30], |_, _| [255, 0, 255], 0.8).paint(
        2,
        [20, 30],
        [10, 30],
        |_, _| [0, 100, 0],
        0.4,
    );
    let found = scene.separate(&[&[1, 2]]);
    assert_eq!((found.len(), bbox(&found[0].mask)), (1, [10, 10, 10, 20]));
}

#[test]
fn a_grey_part_is_parted_from_a_coloured_shadow() {
    // A partition without hue is like no partition that has one.
    let scene = Scene::new(60, 40, TABLE).paint(1, [10, 20], [10, 30], |_, _| [90; 3], 0.8).paint(
        2,
        [20, 30],
        [10, 30],
        |_, _| SHADE,
        0.4,
    );
    assert_eq!(bbox(&scene.separate(&[&[1, 2]])[0].mask), [10, 10, 10, 20]);
}

#[test]
fn hundreds_of_partitions_are_parted() {
    // 400 partitions of 4 x 4 px, the left half red and the right half blue, each of several hues.
    let mut scene = Scene::new(100, 80, TABLE);
    for i in 0..400u32 {
        let (x, y) = (i % 20 * 4 + 10, i / 20 * 4);
        let is_red = (i % 20) < 10;
        let colour = move |x: u32, y: u32| {
            let green = ((x + y + i) % 5 * 8) as u8;
            if is_red { [200, green, 0] } else { [0, green, 200] }
        };
        scene = scene.paint(i + 1, [x, x + 4], [y, y + 4], colour, if is_red { 0.9 } else { 0.2 });
    }
    let labels: Vec<u32> = (1..=400).collect();
    let found = scene.separate(&[&labels]);
    assert_eq!(found.iter().map(|o| bbox(&o.mask)).collect::<Vec<_>>(), [[10, 0, 40, 80]]);
}

#[test]
fn frames_and_regions_without_anything() {
    let empty = Scene::new(0, 0, TABLE);
    assert!(empty.separate(&[]).is_empty());
    let scene = part_with_shadow();
    assert!(scene.separate(&[]).is_empty());
    let found = scene.separate(&[&[], &[1], &[]]);
    assert_eq!(found.iter().map(|o| o.region).collect::<Vec<_>>(), [1]);
}

#[test]
fn wrong_sizes_are_named() {
    let scene = part_with_shadow();
    let (partition, map) = (scene.partition(), scene.map());
    let other = Scene::new(30, 20, TABLE);
    let mut separator = separator(ObjectSide::Paper);
    let mut message = |frame: &RgbView<'_>, partition: &Partition, map: &SaliencyMap| {
        separator.separate(frame, partition, map, &[]).unwrap_err().to_string()
    };
    assert_eq!(message(&other.frame(), &partition, &map), "frame of 30 x 20 px for a partition of 90 x 60 px");
    assert_eq!(
        message(&scene.frame(), &partition, &other.map()),
        "saliency map of 30 x 20 px for a partition of 90 x 60 px"
    );
    assert_eq!(message(&scene.frame(), &other.partition(), &map), "frame of 90 x 60 px for a partition of 30 x 20 px");
}

#[test]
fn regions_of_another_partition_are_refused() {
    let scene = part_with_shadow();
    let mut separator = separator(ObjectSide::Paper);
    let mut objects = scene.separate(&[&[1]]);
    let before = objects.clone();
    let mut separate = |regions: &[SalientRegion]| {
        separator.separate_into(&scene.frame(), &scene.partition(), &scene.map(), regions, &mut objects).unwrap_err()
    };
    let error = separate(&[region(&[1]), region(&[5])]);
    assert_eq!(error, ShadowError::Label { region: 1, label: 5, count: 5 });
    assert_eq!(error.to_string(), "region 1 has the partition 5; there are 5, from 0");
    let error = separate(&[region(&[1, 2]), region(&[2])]);
    assert_eq!(error, ShadowError::Shared { label: 2, first: 0, second: 1 });
    assert_eq!(objects, before, "left as it was");
}

#[test]
fn parameters_are_checked_and_read_from_their_names() {
    let error = ShadowSeparator::new(ShadowParams { min_object_area_px: Some(0), ..ShadowParams::default() });
    assert_eq!(error.unwrap_err().to_string(), "min_object_area_px = 0; allowed are 1 to 4294967295");
}

#[test]
fn a_separator_is_reused_for_other_frames() {
    let first = part_with_shadow();
    let second = Scene::new(30, 20, TABLE).paint(1, [3, 12], [4, 9], |_, _| RED, 0.8);
    let mut separator = separator(ObjectSide::Paper);
    let mut objects = Vec::new();
    for (scene, labels) in [(&first, &[1, 2, 3, 4][..]), (&second, &[1]), (&first, &[1, 2, 3, 4]), (&second, &[])] {
        let regions = if labels.is_empty() { Vec::new() } else { vec![region(labels)] };
        separator.separate_into(&scene.frame(), &scene.partition(), &scene.map(), &regions, &mut objects).unwrap();
        let labels: Vec<&[u32]> = if labels.is_empty() { Vec::new() } else { vec![labels] };
        assert_eq!(objects, scene.separate(&labels));
    }
}

proptest! {
    /// Random partitions in random regions: nothing panics, and masks are disjoint and within their region.
    #[test]
    fn objects_lie_in_their_regions(
        labels in prop::collection::vec(0u32..8, 14 * 11),
        colours in prop::collection::vec(any::<[u8; 3]>(), 8),
        region_of in prop::collection::vec(0usize..4, 8),
        side in prop::bool::ANY,
    ) {
        let mut scene = Scene::new(14, 11, TABLE);
        // Dense labels.
        let mut used: Vec<u32> = labels.clone();
        used.sort_unstable();
        used.dedup();
        for (i, label) in labels.iter().enumerate() {
            let dense = used.binary_search(label).unwrap();
            scene.labels[i] = dense as u32;
            scene.rgb[i * 3..i * 3 + 3].copy_from_slice(&colours[dense]);
            scene.saliency[i] = (i % 11) as f32 / 11.0;
        }
        let regions: Vec<SalientRegion> = (0..3)
            .map(|r| region(&(0..used.len()).filter(|&l| region_of[l] == r).map(|l| l as u32).collect::<Vec<_>>()))
            .collect();
        let side = if side { ObjectSide::Paper } else { ObjectSide::Evidence };
        let params = ShadowParams { object_side: side, min_object_area_px: Some(1) };
        let found = ShadowSeparator::new(params)
            .unwrap()
            .separate(&scene.frame(), &scene.partition(), &scene.map(), &regions)
            .unwrap();
        let mut owners = vec![0; 14 * 11];
        for object in &found {
            prop_assert!(object.mask.area() == object.area && object.area > 0);
            for run in object.mask.runs().chain(object.shadow.iter().flat_map(Mask::runs)) {
                for x in run.start..run.end {
                    let i = (run.y * 14 + x) as usize;
                    owners[i] += 1;
                    let region = region_of[scene.labels[i] as usize];
                    prop_assert!(region == object.region || region == 3, "pixel of region {}", region);
                }
            }
        }
        prop_assert!(owners.iter().all(|&n| n <= 1));
    }

    /// Random frames, of any colours: nothing panics, and objects reach no further than 4 px beyond their region, and
    /// into no other.
    #[test]
    fn evidence_stands_any_frame(
        width in 1u32..40,
        height in 1u32..30,
        bytes in prop::collection::vec(prop::sample::select(vec![0u8, 3, 90, 128, 200, 254, 255]), 40 * 30 * 3),
        cells in prop::collection::vec(0u32..4, 9),
        cell in 2u32..16,
    ) {
        let mut scene = Scene::new(width, height, [0; 3]);
        scene.rgb = bytes[..scene.rgb.len()].to_vec();
        for (i, label) in (0..).zip(&mut scene.labels) {
            *label = cells[((i % width) / cell % 3 + (i / width) / cell % 3 * 3) as usize];
        }
        let mut used = scene.labels.clone();
        used.sort_unstable();
        used.dedup();
        scene.labels.iter_mut().for_each(|label| *label = used.binary_search(label).unwrap() as u32);
        // The last partition, where there are several, is the table.
        let labels: Vec<[u32; 1]> = (0..(used.len() as u32 - 1).max(1)).map(|label| [label]).collect();
        let regions: Vec<&[u32]> = labels.iter().map(|label| &label[..]).collect();
        let params = ShadowParams { min_object_area_px: Some(1), ..ShadowParams::default() };
        let seen: Vec<SalientRegion> = regions.iter().map(|labels| region(labels)).collect();
        let found =
            ShadowSeparator::new(params).unwrap().separate(&scene.frame(), &scene.partition(), &scene.map(), &seen).unwrap();
        for object in &found {
            prop_assert!(object.centroid.iter().all(|c| c.is_finite()));
            for run in object.mask.runs().chain(object.shadow.iter().flat_map(Mask::runs)) {
                for x in run.start..run.end {
                    let label = |x: u32, y: u32| scene.labels[(y * width + x) as usize] as usize;
                    let here = label(x, run.y);
                    let mut near = (run.y.saturating_sub(4)..height.min(run.y + 5))
                        .flat_map(|y| (x.saturating_sub(4)..width.min(x + 5)).map(move |x| (x, y)));
                    prop_assert!(here == object.region || here >= regions.len());
                    prop_assert!(near.any(|(x, y)| label(x, y) == object.region));
                }
            }
        }
    }
}
