//! What is refused: the message names the value and what is allowed.

#![allow(clippy::expect_used, reason = "helpers of tests fail by panicking, too")]

mod support;

use samsod_segment::{
    LabelError, MAX_SIDE_PX, Partition, RgbView, SegmentError, SegmentParamError, SegmentParams, Segmenter,
};

use support::{Picture, assert_agrees_with_direct_count, segment, segmenter};

fn param_error(params: SegmentParams) -> SegmentParamError {
    Segmenter::new(params).expect_err("out of range")
}

#[test]
fn images_without_pixels_are_refused() {
    for (width, height) in [(0, 0), (0, 7), (7, 0)] {
        let image = RgbView::from_raw(width, height, [].as_slice()).unwrap();
        let error = segmenter(SegmentParams::default()).segment(&image).unwrap_err();
        assert_eq!(error, SegmentError::Size { width, height });
        let message = error.to_string();
        assert!(message.contains(&format!("{width} x {height}")) && message.contains("1 to 16384"), "{message}");
    }
}

#[test]
fn images_with_a_side_too_long_are_refused() {
    for (width, height) in [(MAX_SIDE_PX + 1, 1), (1, MAX_SIDE_PX + 1)] {
        let picture = Picture::flat(width, height, [9; 3]);
        let error = segmenter(SegmentParams::default()).segment(&picture.view()).unwrap_err();
        let message = error.to_string();
        assert!(message.contains("16385") && message.contains("1 to 16384"), "{message}");
    }
    let longest = Picture::flat(MAX_SIDE_PX, 1, [9; 3]);
    assert_eq!(segment(&longest).len(), 1);
}

#[test]
fn a_refused_image_leaves_partition_and_segmenter_usable() {
    let picture = Picture::flat(12, 9, [50; 3]);
    let mut segmenter = segmenter(SegmentParams::default());
    let mut partition = segmenter.segment(&picture.view()).unwrap();
    let before = partition.clone();
    let empty = RgbView::from_raw(0, 3, [].as_slice()).unwrap();
    segmenter.segment_into(&empty, &mut partition).unwrap_err();
    assert!(partition == before, "unchanged");
    segmenter.segment_into(&picture.view(), &mut partition).unwrap();
    assert!(partition == before);
}

#[test]
fn parameters_out_of_range_are_refused_by_name() {
    let default = SegmentParams::default;
    let spatial = |value| SegmentParams { spatial_bandwidth_px: Some(value), ..default() };
    let range = |value| SegmentParams { range_bandwidth: value, ..default() };
    let gain = |value| SegmentParams { texture_gain: value, ..default() };
    let light = |value| SegmentParams { penumbra_light: value, ..default() };
    let cases = [
        (spatial(f32::NAN), "spatial_bandwidth_px", "NaN", "1 to 1000"),
        (spatial(-3.5), "spatial_bandwidth_px", "-3.5", "1 to 1000"),
        (spatial(0.0), "spatial_bandwidth_px", "0", "1 to 1000"),
        (spatial(f32::INFINITY), "spatial_bandwidth_px", "inf", "1 to 1000"),
        (range(f32::NAN), "range_bandwidth", "NaN", "1 to 255"),
        (range(-4.0), "range_bandwidth", "-4", "1 to 255"),
        (range(0.0), "range_bandwidth", "0", "1 to 255"),
        (range(256.0), "range_bandwidth", "256", "1 to 255"),
        (gain(f32::NAN), "texture_gain", "NaN", "0 to 10"),
        (gain(-0.5), "texture_gain", "-0.5", "0 to 10"),
        (gain(10.5), "texture_gain", "10.5", "0 to 10"),
        (light(f32::NAN), "penumbra_light", "NaN", "0.5 to 1"),
        (light(0.49), "penumbra_light", "0.49", "0.5 to 1"),
        (light(1.01), "penumbra_light", "1.01", "0.5 to 1"),
    ];
    for (params, name, value, allowed) in cases {
        let error = param_error(params);
        assert_eq!(error.name, name);
        assert_eq!(error.to_string(), format!("{name} = {value}; allowed are {allowed}"));
    }
}

#[test]
fn parameters_at_their_bounds_are_accepted() {
    let picture = Picture::flat(20, 10, [70; 3]);
    for spatial in [1.0, 1000.0] {
        for range_bandwidth in [1.0, 255.0] {
            for texture_gain in [0.0, 10.0] {
                for (min_area_px, penumbra_light) in [(Some(0), 0.5), (Some(u32::MAX), 1.0)] {
                    let params = SegmentParams {
                        spatial_bandwidth_px: Some(spatial),
                        range_bandwidth,
                        texture_gain,
                        min_area_px,
                        penumbra_light,
                    };
                    assert_eq!(segmenter(params).segment(&picture.view()).unwrap().len(), 1);
                }
            }
        }
    }
}

/// The label image of the documentation of [`Partition`].
#[test]
fn a_label_literal() {
    #[rustfmt::skip]
    let labels = vec![
        0, 0, 0, 1,
        0, 2, 2, 1,
        0, 0, 2, 1,
    ];
    let mut picture = Picture::flat(4, 3, [10, 20, 30]);
    picture.rgb[2] = [16, 20, 30];
    let partition = Partition::from_labels(&picture.view(), labels).unwrap();
    assert_agrees_with_direct_count(&partition, &picture);
    assert_eq!(partition.objects().iter().map(|o| o.area).collect::<Vec<_>>(), [6, 3, 3]);
    assert_eq!(partition.neighbours(2), [0, 1]);
    assert_eq!(partition.objects()[0].mean, [11.0, 20.0, 30.0]);
    assert_eq!(partition.objects()[1].centroid, [3.0, 1.0]);
}

#[test]
fn labels_need_not_be_connected() {
    let picture = Picture::flat(5, 1, [1; 3]);
    let partition = Partition::from_labels(&picture.view(), vec![0, 1, 0, 1, 0]).unwrap();
    assert_agrees_with_direct_count(&partition, &picture);
    assert_eq!(partition.objects()[0].area, 3);
    assert_eq!(partition.objects()[0].bbox.width, 5);
    assert_eq!(partition.objects()[1].centroid, [2.0, 0.0]);
}

#[test]
fn labels_must_be_as_many_as_pixels() {
    let picture = Picture::flat(3, 2, [1; 3]);
    for count in [0, 5, 7] {
        let error = Partition::from_labels(&picture.view(), vec![0; count]).unwrap_err();
        assert_eq!(error, LabelError::Size { labels: count, width: 3, height: 2, pixels: 6 });
        let message = error.to_string();
        assert!(message.contains(&format!("{count} labels")) && message.contains("3 x 2 = 6"), "{message}");
    }
}

#[test]
fn labels_must_be_dense() {
    let picture = Picture::flat(2, 2, [1; 3]);
    let error_of = |labels: [u32; 4]| Partition::from_labels(&picture.view(), labels.to_vec()).unwrap_err();
    let cases = [
        ([0, 2, 2, 0], 1, 2),
        ([1, 1, 1, 1], 0, 1),
        // A stray value must not cost memory for as many labels.
        ([0, 1, u32::MAX, 0], 2, u32::MAX),
        ([0, 1, 2, u32::MAX], 3, u32::MAX),
        ([4, 1, 2, 3], 0, 4),
    ];
    for (labels, missing, largest) in cases {
        let error = error_of(labels);
        assert_eq!(error, LabelError::NotDense { missing, largest }, "{labels:?}");
        let message = error.to_string();
        assert!(message.contains(&format!("label {missing} ")) && message.contains(&largest.to_string()), "{message}");
    }
}

#[test]
fn no_pixels_are_an_empty_partition() {
    let image = RgbView::from_raw(0, 3, [].as_slice()).unwrap();
    let partition = Partition::from_labels(&image, Vec::new()).unwrap();
    assert!(partition.is_empty() && partition.labels().is_empty() && partition.neighbours(0).is_empty());
    assert_eq!(partition.height(), 3);
}
