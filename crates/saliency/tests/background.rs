//! The variants that are not the paper's, through the public API.

#![allow(clippy::unwrap_used, clippy::expect_used, reason = "helpers of tests fail by panicking, too")]

mod support;

use proptest::prelude::*;
use samsod_saliency::salient_regions;
use samsod_saliency::{Method, Saliency, SaliencyMap, SaliencyParamError, SaliencyParams, Scales, Threshold, Variant};
use samsod_segment::{Partition, RgbView, SegmentParams, Segmenter};
use support::{Picture, largest_difference, pictures};

fn map_of(partition: &Partition, variant: Variant) -> SaliencyMap {
    let params = SaliencyParams { variant, ..SaliencyParams::default() };
    Saliency::new(params).expect("in range").compute(partition).expect("has pixels")
}

/// S of every label; they must be the same on all its pixels.
fn by_label(picture: &Picture, variant: Variant) -> Vec<f32> {
    let partition = picture.partition();
    let map = map_of(&partition, variant);
    let mut values = vec![None; partition.len()];
    for (&label, &value) in picture.labels.iter().zip(map.values()) {
        assert_eq!(*values[label as usize].get_or_insert(value), value, "label {label}");
    }
    values.into_iter().map(|value| value.expect("every label occurs")).collect()
}

/// A label image with rectangles (x, y, width, height) over label 0; rectangle k is label k + 1.
fn rectangles(width: usize, height: usize, boxes: &[[usize; 4]], colours: &[[u8; 3]]) -> Picture {
    let label = |i: usize| {
        let (x, y) = (i % width, i / width);
        let inside = |b: &[usize; 4]| x >= b[0] && x < b[0] + b[2] && y >= b[1] && y < b[1] + b[3];
        boxes.iter().rposition(inside).map_or(0, |k| k as u32 + 1)
    };
    let labels: Vec<u32> = (0..width * height).map(label).collect();
    Picture::new(width, &labels, colours)
}

const GREY: [u8; 3] = [120, 120, 120];
const RED: [u8; 3] = [200, 40, 40];
const BLUE: [u8; 3] = [40, 60, 200];

#[test]
fn objects_are_above_one_half_and_the_background_below() {
    let picture = rectangles(120, 80, &[[20, 20, 24, 30], [70, 30, 30, 24]], &[GREY, RED, BLUE]);
    for variant in [Variant::Background, Variant::Centred] {
        let s = by_label(&picture, variant);
        assert!(s[0] < 0.2 && s[1] > 0.5 && s[2] > 0.5, "{variant:?}: {s:?}");
        let regions =
            salient_regions(&map_of(&picture.partition(), variant), &picture.partition(), Threshold::Value(0.5));
        let found: Vec<Vec<u32>> = regions.expect("in range").into_iter().map(|r| r.partitions).collect();
        assert_eq!(found, [vec![1], vec![2]], "{variant:?}");
    }
}

#[test]
fn shading_is_background_and_an_object_on_it_is_not() {
    // Stripes that grow lighter by some 2 Delta E, from the left side to the right, and a red square on them.
    let (width, height) = (120, 60);
    let label = |i: usize| {
        let (x, y) = (i % width, i / width);
        if (50..70).contains(&x) && (20..40).contains(&y) { 12 } else { x as u32 / 10 }
    };
    let labels: Vec<u32> = (0..width * height).map(label).collect();
    let mut colours: Vec<[u8; 3]> = (0..12).map(|k| [90 + 5 * k; 3]).collect();
    colours.push(RED);
    let s = by_label(&Picture::new(width, &labels, &colours), Variant::Background);
    let lightest = s[..12].iter().copied().fold(0.0, f32::max);
    assert!(lightest < 0.3 && s[12] > 0.9, "{s:?}");
}

#[test]
fn an_object_that_touches_a_side_stands_out_by_its_colour() {
    let s = by_label(&rectangles(120, 80, &[[0, 25, 30, 30]], &[GREY, RED]), Variant::Background);
    assert!(s[1] > 0.5 && s[0] < 0.5, "{s:?}");
}

#[test]
fn the_centre_is_preferred_only_where_it_is_asked_for() {
    // Two squares alike, one in the middle and one in a corner, but off the border.
    let picture = rectangles(160, 160, &[[70, 70, 20, 20], [8, 8, 20, 20]], &[GREY, RED, RED]);
    let plain = by_label(&picture, Variant::Background);
    assert!((plain[1] - plain[2]).abs() < 1e-6, "{plain:?}");
    let centred = by_label(&picture, Variant::Centred);
    assert!(centred[1] > centred[2] + 0.01, "{centred:?}");
}

#[test]
fn where_nothing_differs_nothing_is_salient() {
    let one = rectangles(20, 20, &[], &[GREY]);
    let alike = rectangles(20, 20, &[[5, 5, 6, 6]], &[GREY, GREY]);
    for variant in Variant::ALL {
        for picture in [&one, &alike] {
            let map = map_of(&picture.partition(), variant);
            assert!(map.values().iter().all(|&v| v == 0.0), "{variant:?}");
        }
    }
}

#[test]
fn averaged_is_the_mean_of_the_papers_map() {
    let picture = rectangles(60, 40, &[[10, 8, 15, 15], [35, 15, 12, 12]], &[GREY, RED, BLUE]);
    let partition = picture.partition();
    let paper = map_of(&partition, Variant::Paper);
    let averaged = by_label(&picture, Variant::Averaged);
    for (label, object) in partition.objects().iter().enumerate() {
        let pixels = picture.labels.iter().zip(paper.values()).filter(|(l, _)| **l as usize == label);
        let mean = pixels.map(|(_, v)| f64::from(*v)).sum::<f64>() / f64::from(object.area);
        assert!((f64::from(averaged[label]) - mean).abs() < 1e-6, "label {label}");
    }
}

#[test]
fn the_default_is_the_papers_since_cells_rely_on_it() {
    assert_eq!(SaliencyParams::default().variant, Variant::Paper);
}

#[test]
fn scales_of_a_variant_without_any_are_refused() {
    for variant in [Variant::Background, Variant::Centred] {
        let params = SaliencyParams { variant, method: Method::Fast, scales: Scales::ObjectSizes(vec![30.0]) };
        let error = Saliency::new(params).unwrap_err();
        assert_eq!(error, SaliencyParamError::NoScales { variant });
        let name = variant.name();
        assert_eq!(
            error.to_string(),
            format!("variant \"{name}\" has no scales; allowed with scales are \"paper\" and \"averaged\"")
        );
    }
}

#[test]
fn parameters_of_a_photo_are_in_range_at_any_size() {
    for (width, height) in [(1, 1), (3, 200), (256, 171), (4000, 3000), (16_384, 16_384)] {
        let params = SegmentParams::photo(width, height);
        params.check().expect("in range");
    }
    // One pixel is an image, too.
    let pixels = [7u8, 8, 9];
    let view = RgbView::from_raw(1, 1, pixels.as_slice()).unwrap();
    let partition = Segmenter::new(SegmentParams::photo(1, 1)).unwrap().segment(&view).unwrap();
    assert_eq!(map_of(&partition, Variant::Background).values(), [0.0]);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn in_range_and_the_same_seen_in_a_mirror(picture in pictures(1..=40, 12)) {
        let (width, height) = (picture.width, picture.height);
        let mirrored = picture.rearranged(width, height, |x, y| (width - 1 - x, y));
        let turned = picture.rearranged(height, width, |x, y| (y, x));
        for variant in [Variant::Background, Variant::Centred] {
            let map = map_of(&picture.partition(), variant);
            prop_assert!(map.values().iter().all(|v| (0.0..=1.0).contains(v)));
            // Sums in another order may move a value over the edge of a bin of the histogram, and the middle of the curve
            // with it.
            let back = |other: &SaliencyMap, from: &dyn Fn(usize, usize) -> usize| -> Vec<f32> {
                (0..width * height).map(|i| other.values()[from(i % width, i / width)]).collect()
            };
            let seen = map_of(&mirrored.partition(), variant);
            let seen = back(&seen, &|x, y| y * width + width - 1 - x);
            prop_assert!(largest_difference(map.values(), &seen) < 0.02);
            let seen = map_of(&turned.partition(), variant);
            let seen = back(&seen, &|x, y| x * height + y);
            prop_assert!(largest_difference(map.values(), &seen) < 0.02);
        }
    }
}
