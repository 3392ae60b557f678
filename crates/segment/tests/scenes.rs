//! Generated tables and parts: what must be one partition, and what must stay apart.

#![allow(clippy::unwrap_used, reason = "helpers of tests fail by panicking")]

mod support;

use samsod_segment::{Partition, SegmentParams, Segmenter};

use support::{Dice, Picture, assert_agrees_with_direct_count, segment};

const GREEN: [u8; 3] = [40, 110, 80];
const GREY: [u8; 3] = [120, 118, 115];
const RED: [u8; 3] = [190, 40, 30];

/// Whether a pixel lies in a disc.
fn disc(x0: i64, y0: i64, radius: i64) -> impl Fn(i64, i64) -> bool {
    move |x, y| (x - x0) * (x - x0) + (y - y0) * (y - y0) <= radius * radius
}

fn label_at(partition: &Partition, x: u32, y: u32) -> u32 {
    partition.labels()[(y * partition.width() + x) as usize]
}

/// Asserts that the picture is one table and one disc, with 4 per cent of the area for pixels of its edge.
fn assert_table_and_disc(picture: &Picture, (x, y): (u32, u32), radius: f64) {
    let partition = segment(picture);
    assert_eq!(partition.len(), 2, "areas {:?}", partition.objects().iter().map(|o| o.area).collect::<Vec<_>>());
    let (table, part) = (label_at(&partition, 0, 0), label_at(&partition, x, y));
    assert_ne!(table, part);
    let part = &partition.objects()[part as usize];
    let area = std::f64::consts::PI * radius * radius;
    let ratio = f64::from(part.area) / area;
    assert!((0.96..=1.04).contains(&ratio), "disc of {area:.0} px was cut with {} px", part.area);
    let shift = (f64::from(part.centroid[0]) - f64::from(x)).hypot(f64::from(part.centroid[1]) - f64::from(y));
    assert!(shift < 1.0, "disc moved by {shift} px");
}

#[test]
fn fine_ruled_lines_belong_to_the_table() {
    // Lines of 1 px, 20 px apart, every fifth of 2 px, on a mat; a disc stands on them.
    let mut picture = Picture::flat(640, 480, GREEN);
    picture.paint([150, 170, 110], |x, y| x % 20 == 9 || y % 20 == 9 || x % 100 == 10 || y % 100 == 10);
    picture.paint(RED, disc(330, 210, 40));
    picture.add_noise(2.0, 1);
    assert_table_and_disc(&picture, (330, 210), 40.0);
}

#[test]
fn speckles_belong_to_the_table() {
    let mut picture = Picture::flat(640, 480, GREY);
    let mut dice = Dice(7);
    for _ in 0..1500 {
        let (x, y, radius) = (dice.below(640), dice.below(480), dice.below(3));
        let shade = if dice.unit() < 0.5 { 70 } else { 175 };
        picture.paint([shade; 3], disc(x, y, radius));
    }
    picture.paint(RED, disc(200, 300, 45));
    picture.add_noise(2.0, 2);
    assert_table_and_disc(&picture, (200, 300), 45.0);
}

/// Planks of one hue may fall into bands, which are tables; but no band is a part, and none takes some of the disc.
#[test]
fn grain_makes_no_parts() {
    let mut picture = Picture::flat(640, 480, [0; 3]);
    let mut dice = Dice(11);
    let rows: Vec<f64> = (0..490).map(|_| dice.normal()).collect();
    for y in 0..480 {
        for x in 0..640 {
            // A row of grain is 3 px wide and sinks slowly from left to right.
            let at = y + x / 160;
            let grain = 1.0 + 0.08 * (rows[at] + rows[at + 1] + rows[at + 2]) / 3.0;
            picture.rgb[y * 640 + x] = [150.0, 110.0, 75.0].map(|c: f64| (c * grain).round() as u8);
        }
    }
    picture.paint([60, 70, 160], disc(420, 260, 50));
    let partition = segment(&picture);
    let part = label_at(&partition, 420, 260);
    for (label, object) in (0..).zip(partition.objects()) {
        if label != part {
            assert_eq!((object.bbox.x, object.bbox.width), (0, 640), "a band runs from side to side: {object:?}");
        }
    }
    let area = f64::from(partition.objects()[part as usize].area);
    assert!((0.96..=1.04).contains(&(area / (std::f64::consts::PI * 2500.0))), "disc of {area} px");
}

#[test]
fn noise_on_a_flat_table_is_one_partition() {
    for (width, height) in [(512, 455), (641, 479), (1078, 958)] {
        for seed in 0..4 {
            let mut picture = Picture::flat(width, height, GREY);
            picture.add_noise(6.0, seed);
            assert_eq!(segment(&picture).len(), 1, "{width} x {height}, seed {seed}");
        }
    }
}

/// Without reduction nothing averages the noise, and by default a speck of some pixels may be a part; the minimum area
/// says that it is not.
#[test]
fn noise_on_a_small_flat_table_is_one_partition_where_parts_are_larger_than_specks() {
    let params = SegmentParams { spatial_bandwidth_px: Some(4.0), min_area_px: Some(64), ..SegmentParams::default() };
    let mut segmenter = Segmenter::new(params).unwrap();
    for (width, height) in [(60, 40), (128, 96), (200, 150), (256, 228), (320, 240)] {
        for seed in 0..10 {
            let mut picture = Picture::flat(width, height, GREY);
            picture.add_noise(6.0, seed);
            assert_eq!(segmenter.segment(&picture.view()).unwrap().len(), 1, "seed {seed} of {width} x {height}");
        }
    }
}

#[test]
fn a_table_that_is_lit_unevenly_is_one_partition() {
    // Brightness falls by a third from left to right.
    let mut picture = Picture::flat(640, 480, GREY);
    for (i, px) in picture.rgb.iter_mut().enumerate() {
        *px = px.map(|c| (f64::from(c) * (1.0 - (i % 640) as f64 / 1920.0)).round() as u8);
    }
    picture.add_noise(2.0, 5);
    assert_eq!(segment(&picture).len(), 1);
}

#[test]
fn parts_of_equal_colour_stay_apart() {
    let mut picture = Picture::flat(320, 240, GREY);
    picture.paint(RED, |x, y| (60..120).contains(&x) && (80..140).contains(&y));
    picture.paint(RED, |x, y| (124..184).contains(&x) && (80..140).contains(&y));
    let partition = segment(&picture);
    assert_eq!(partition.len(), 3);
    let (left, right) = (label_at(&partition, 90, 110), label_at(&partition, 150, 110));
    assert_ne!(left, right);
    assert_eq!(partition.neighbours(left), [label_at(&partition, 0, 0)], "they touch the table, not each other");
    for (label, x) in [(left, 60), (right, 124)] {
        let object = &partition.objects()[label as usize];
        assert_eq!((object.area, object.bbox.x, object.bbox.width), (3600, x, 60));
    }
}

/// At every size the image is reduced by another factor; boundaries are decided at full resolution.
#[test]
fn flat_colours_are_cut_exactly_at_every_size() {
    for (width, height) in [(256, 200), (640, 480), (1078, 958), (1079, 957), (2156, 1916)] {
        let (w, h) = (i64::from(width), i64::from(height));
        let mut picture = Picture::flat(width, height, GREEN);
        let inside = |x: i64, y: i64| {
            let rectangle = (w / 5 + 1..w / 3).contains(&x) && (h / 4 + 1..h / 2 + 2).contains(&y);
            rectangle || x - y / 3 > w * 3 / 5
        };
        picture.paint(RED, inside);
        let partition = segment(&picture);
        assert_eq!(partition.len(), 3, "{width} x {height}");
        let table = label_at(&partition, 0, 0);
        let wrong =
            (0..).zip(partition.labels()).filter(|&(i, &label)| inside(i % w, i / w) == (label == table)).count();
        assert_eq!(wrong, 0, "pixels on the wrong side at {width} x {height}");
    }
}

#[test]
fn flat_colours_far_apart_are_cut_in_small_images() {
    for side in [24, 48, 64, 96, 128] {
        for tenths in [3, 5, 7] {
            let mut picture = Picture::flat(side, side, [20; 3]);
            let (middle, half) = (i64::from(side) / 2, i64::from(side) * tenths / 20);
            picture.paint([220; 3], |x, y| (x - middle).abs() <= half && (y - middle).abs() <= half);
            assert_eq!(segment(&picture).len(), 2, "a square of {tenths} tenths of {side} px");
        }
    }
}

#[test]
fn smallest_images() {
    for (width, height) in [(1, 1), (1, 2), (2, 1), (2, 2), (1, 90), (90, 1), (3, 70), (70, 4), (5, 5)] {
        let picture = Picture::flat(width, height, RED);
        let partition = segment(&picture);
        assert_eq!(partition.len(), 1, "{width} x {height}");
        assert_eq!(partition.objects()[0].mean, RED.map(f32::from));
        assert_agrees_with_direct_count(&partition, &picture);
    }
    // A line of two colours: either way it lies.
    for (width, height) in [(60, 1), (1, 60)] {
        let mut picture = Picture::flat(width, height, RED);
        picture.rgb[25..].fill(GREEN);
        let partition = segment(&picture);
        assert_eq!(partition.objects().iter().map(|o| o.area).collect::<Vec<_>>(), [25, 35], "{width} x {height}");
        assert_agrees_with_direct_count(&partition, &picture);
    }
    // Four pixels of four colours are below any minimum area: one partition.
    let picture = Picture { width: 2, height: 2, rgb: vec![RED, GREEN, GREY, [0; 3]] };
    assert_eq!(segment(&picture).labels(), [0; 4]);
}

#[test]
fn an_8k_image_is_one_table_and_one_part() {
    let mut picture = Picture::flat(7680, 4320, GREY);
    picture.paint(RED, |x, y| (3001..3501).contains(&x) && (2001..2501).contains(&y));
    let partition = segment(&picture);
    assert_eq!(partition.len(), 2);
    let part = &partition.objects()[label_at(&partition, 3250, 2250) as usize];
    assert_eq!(part.area, 500 * 500);
    assert_eq!((part.bbox.x, part.bbox.y, part.bbox.width, part.bbox.height), (3001, 2001, 500, 500));
    assert_eq!(part.centroid, [3250.5, 2250.5]);
    assert_eq!(part.mean, RED.map(f32::from));
}

/// A disc beside which its shadow lies: full for 40 px, then back to the light of the table over 80 px.
fn soft_shadow() -> Picture {
    let mut picture = Picture::flat(640, 480, GREY);
    let level = |light: f64| {
        let linear = |v: f64| if v <= 0.04045 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) };
        let of_linear = |l: f64| if l <= 0.003_130_8 { 12.92 * l } else { 1.055 * l.powf(1.0 / 2.4) - 0.055 };
        GREY.map(|c| (255.0 * of_linear(light * linear(f64::from(c) / 255.0))).round() as u8)
    };
    for y in 190..290 {
        for x in 300..460 {
            let light = 0.3 + 0.7 * (f64::from(x - 380) / 80.0).clamp(0.0, 1.0);
            picture.rgb[(y * 640 + x) as usize] = level(light);
        }
    }
    picture.paint(RED, disc(290, 240, 50));
    picture.add_noise(1.5, 5);
    picture
}

/// Columns of the middle row that are not table, right of the disc.
fn shadow_end(penumbra_light: f32) -> u32 {
    let params = SegmentParams { penumbra_light, ..SegmentParams::default() };
    let partition = Segmenter::new(params).unwrap().segment(&soft_shadow().view()).unwrap();
    let table = label_at(&partition, 0, 0);
    (340..640).find(|&x| label_at(&partition, x, 240) == table).unwrap()
}

#[test]
fn a_shadow_ends_where_the_table_has_the_light_that_is_asked_for() {
    for light in [0.6, 0.78, 0.9] {
        let end = f64::from(shadow_end(light));
        let expected = 380.0 + 80.0 * (f64::from(light) - 0.3) / 0.7;
        assert!((end - expected).abs() < 3.0, "light {light}: the shadow ends at {end}, expected {expected}");
    }
    assert!(shadow_end(1.0) > shadow_end(0.9), "without it the penumbra is no table");
}

#[test]
fn a_penumbra_is_table_that_fades_from_a_shadow() {
    let frame = soft_shadow();
    let partition = |penumbra_light| {
        let params = SegmentParams { penumbra_light, ..SegmentParams::default() };
        Segmenter::new(params).unwrap().segment(&frame.view()).unwrap()
    };
    let faded = partition(0.7);
    let (table, shadow) = (label_at(&faded, 0, 0), label_at(&faded, 420, 240));
    assert_ne!(table, shadow);
    // Light of 0.83 at column 440; all of the shadow's light from 0.7 on is table now.
    assert_eq!(label_at(&faded, 440, 240), table);
    assert_eq!(faded.fades_from(440, 240), Some(shadow));
    assert_eq!(
        (faded.fades_from(360, 240), faded.fades_from(600, 240), faded.fades_from(9999, 240)),
        (None, None, None)
    );
    let run = faded.penumbrae(240).find(|run| (run.start..run.end).contains(&440)).unwrap();
    assert_eq!(run.label, shadow);
    let bbox = faded.penumbra_box(shadow).unwrap();
    assert!(bbox.x <= run.start && bbox.right() + 1 >= run.end && bbox.right() < 470, "{bbox:?}");
    let whole = partition(1.0);
    assert_eq!((whole.fades_from(440, 240), whole.penumbrae(240).count()), (None, 0));
}

/// A plate of the table's own hue, a little darker, is no penumbra.
#[test]
fn a_part_of_the_tone_of_the_table_stays_whole() {
    let mut picture = Picture::flat(640, 480, GREY);
    picture.paint(GREY.map(|c| (f64::from(c) * 0.92) as u8), |x, y| (250..350).contains(&x) && (180..260).contains(&y));
    picture.add_noise(1.5, 6);
    let params = SegmentParams { penumbra_light: 0.8, ..SegmentParams::default() };
    let partition = Segmenter::new(params).unwrap().segment(&picture.view()).unwrap();
    assert_eq!(partition.len(), 2);
    let plate = &partition.objects()[label_at(&partition, 300, 220) as usize];
    assert!((7600..=8400).contains(&plate.area), "a plate of 8000 px was cut with {} px", plate.area);
}
