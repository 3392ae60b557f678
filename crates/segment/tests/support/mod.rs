//! Generated pictures, and slow checks of partitions that share nothing with the code under test.

#![allow(dead_code, reason = "each test program uses its part")]
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "helpers of tests fail by panicking, too")]

use std::collections::BTreeSet;

use proptest::prelude::*;
use samsod_segment::{Partition, RgbView, SegmentParams, Segmenter};

/// A picture that owns its pixels.
#[derive(Clone, PartialEq)]
pub(crate) struct Picture {
    pub(crate) width: u32,
    pub(crate) height: u32,
    pub(crate) rgb: Vec<[u8; 3]>,
}

impl std::fmt::Debug for Picture {
    /// The size only: a failing case prints the shapes it was drawn from.
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Picture {} x {}", self.width, self.height)
    }
}

impl Picture {
    pub(crate) fn flat(width: u32, height: u32, colour: [u8; 3]) -> Self {
        Self { width, height, rgb: vec![colour; width as usize * height as usize] }
    }

    pub(crate) fn view(&self) -> RgbView<'_> {
        RgbView::from_raw(self.width, self.height, self.rgb.as_flattened()).expect("three bytes a pixel")
    }

    /// Paints every pixel for which `inside(x, y)` holds.
    pub(crate) fn paint(&mut self, colour: [u8; 3], inside: impl Fn(i64, i64) -> bool) {
        let width = i64::from(self.width);
        for (i, px) in (0..).zip(&mut self.rgb) {
            if inside(i % width, i / width) {
                *px = colour;
            }
        }
    }

    /// Adds Gaussian noise of the same standard deviation to every channel.
    pub(crate) fn add_noise(&mut self, sigma: f64, seed: u64) {
        let mut dice = Dice(seed);
        for c in self.rgb.as_flattened_mut() {
            *c = (f64::from(*c) + sigma * dice.normal()).round().clamp(0.0, 255.0) as u8;
        }
    }
}

/// SplitMix64: small, and the same everywhere.
pub(crate) struct Dice(pub(crate) u64);

impl Dice {
    pub(crate) fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// From 0 to 1.
    pub(crate) fn unit(&mut self) -> f64 {
        (self.next() >> 11) as f64 / (1u64 << 53) as f64
    }

    /// A whole number in 0..n.
    pub(crate) fn below(&mut self, n: u32) -> i64 {
        (self.unit() * f64::from(n)) as i64
    }

    /// Normally distributed: twelve uniform numbers have variance 1.
    pub(crate) fn normal(&mut self) -> f64 {
        (0..12).map(|_| self.unit()).sum::<f64>() - 6.0
    }
}

pub(crate) fn segmenter(params: SegmentParams) -> Segmenter {
    Segmenter::new(params).expect("parameters in range")
}

/// Segments with the default parameters.
pub(crate) fn segment(picture: &Picture) -> Partition {
    segmenter(SegmentParams::default()).segment(&picture.view()).expect("accepted")
}

/// A rectangle or ellipse, its place and size in thousandths of the picture.
#[derive(Debug, Clone)]
struct Shape {
    ellipse: bool,
    middle: [i64; 2],
    half: [i64; 2],
    colour: [u8; 3],
}

fn shape() -> impl Strategy<Value = Shape> {
    (any::<bool>(), [0..1000i64, 0..1000], [10..500i64, 10..500], any::<[u8; 3]>())
        .prop_map(|(ellipse, middle, half, colour)| Shape { ellipse, middle, half, colour })
}

/// Pictures of up to 90 px a side: rectangles and ellipses on a flat ground, plus noise.
pub(crate) fn pictures() -> impl Strategy<Value = Picture> {
    (1..=90u32, 1..=90u32, any::<[u8; 3]>(), prop::collection::vec(shape(), 0..7), 0.0..12.0f64, any::<u64>()).prop_map(
        |(width, height, ground, shapes, sigma, seed)| {
            let mut picture = Picture::flat(width, height, ground);
            for shape in shapes {
                let extent = [i64::from(width), i64::from(height)];
                // Offsets in thousandths of the half axis, so that whole numbers decide what is inside.
                let offset = |at: i64, axis: usize| (at * 1000 - shape.middle[axis] * extent[axis]) * 1000;
                let half = |axis: usize| shape.half[axis] * extent[axis];
                picture.paint(shape.colour, |x, y| {
                    let (u, v) = (offset(x, 0) / half(0), offset(y, 1) / half(1));
                    if shape.ellipse { u * u + v * v <= 1_000_000 } else { u.abs() <= 1000 && v.abs() <= 1000 }
                });
            }
            // Half of the pictures are flat: ties are where order could matter.
            if sigma > 6.0 {
                picture.add_noise(sigma - 6.0, seed);
            }
            picture
        },
    )
}

/// Parameters over their whole ranges.
pub(crate) fn params() -> impl Strategy<Value = SegmentParams> {
    let bandwidth = prop::option::of(prop::sample::select(vec![1.0f32, 2.5, 5.0, 7.9, 8.0, 20.0, 1000.0]));
    let range = prop::sample::select(vec![1.0f32, 4.0, 16.0, 255.0]);
    let gain = prop::sample::select(vec![0.0f32, 3.0, 10.0]);
    let min_area = prop::option::of(prop_oneof![0..=80u32, Just(u32::MAX)]);
    let light = prop::sample::select(vec![0.5f32, 0.78, 1.0]);
    (bandwidth, range, gain, min_area, light).prop_map(
        |(spatial_bandwidth_px, range_bandwidth, texture_gain, min_area_px, penumbra_light)| SegmentParams {
            spatial_bandwidth_px,
            range_bandwidth,
            texture_gain,
            min_area_px,
            penumbra_light,
        },
    )
}

/// Number of 4-connected components of equal label, by flood fill.
pub(crate) fn components(labels: &[u32], width: usize) -> usize {
    let mut seen = vec![false; labels.len()];
    let mut stack = Vec::new();
    let mut count = 0;
    for start in 0..labels.len() {
        if seen[start] {
            continue;
        }
        count += 1;
        seen[start] = true;
        stack.push(start);
        while let Some(i) = stack.pop() {
            for j in four_neighbours(i, width, labels.len()) {
                if !seen[j] && labels[j] == labels[i] {
                    seen[j] = true;
                    stack.push(j);
                }
            }
        }
    }
    count
}

fn four_neighbours(i: usize, width: usize, pixels: usize) -> Vec<usize> {
    let mut all = Vec::new();
    if !i.is_multiple_of(width) {
        all.push(i - 1);
    }
    if i % width + 1 < width {
        all.push(i + 1);
    }
    if i >= width {
        all.push(i - width);
    }
    if i + width < pixels {
        all.push(i + width);
    }
    all
}

/// Asserts that labels are dense and that everything a partition says of them is what a direct count finds.
pub(crate) fn assert_agrees_with_direct_count(partition: &Partition, picture: &Picture) {
    let (width, height) = (picture.width as usize, picture.height as usize);
    assert_eq!((partition.width(), partition.height()), (picture.width, picture.height));
    let labels = partition.labels();
    assert_eq!(labels.len(), width * height);
    let used: BTreeSet<u32> = labels.iter().copied().collect();
    assert!(used.iter().copied().eq(0..partition.len() as u32), "labels {used:?} of {} partitions", partition.len());
    let area_sum: usize = partition.objects().iter().map(|o| o.area as usize).sum();
    assert_eq!(area_sum, width * height, "areas sum to H x W");

    for (label, object) in (0u32..).zip(partition.objects()) {
        let pixels: Vec<usize> = (0..labels.len()).filter(|&i| labels[i] == label).collect();
        let n = pixels.len() as f64;
        assert_eq!(object.area as usize, pixels.len(), "area of {label}");
        for c in 0..3 {
            let mean = pixels.iter().map(|&i| f64::from(picture.rgb[i][c])).sum::<f64>() / n;
            assert!((mean - f64::from(object.mean[c])).abs() < 1e-4, "mean of {label}: {mean}, {:?}", object.mean);
        }
        let (xs, ys) = (|| pixels.iter().map(|&i| i % width), || pixels.iter().map(|&i| i / width));
        let centroid = [xs().sum::<usize>() as f64 / n, ys().sum::<usize>() as f64 / n];
        for (direct, told) in centroid.iter().zip(object.centroid) {
            assert!(
                (direct - f64::from(told)).abs() < 1e-3,
                "centroid of {label}: {centroid:?}, {:?}",
                object.centroid
            );
        }
        let (left, right) = (xs().min().unwrap(), xs().max().unwrap());
        let (top, bottom) = (ys().min().unwrap(), ys().max().unwrap());
        let b = object.bbox;
        assert_eq!(
            [left, top, right - left + 1, bottom - top + 1],
            [b.x, b.y, b.width, b.height].map(|v| v as usize),
            "box of {label}"
        );
        assert_eq!([right, bottom], [b.right(), b.bottom()].map(|v| v as usize), "box of {label}");
        let neighbours: BTreeSet<u32> = pixels
            .iter()
            .flat_map(|&i| four_neighbours(i, width, labels.len()))
            .map(|j| labels[j])
            .filter(|&other| other != label)
            .collect();
        assert!(neighbours.iter().eq(partition.neighbours(label)), "neighbours of {label}");
    }
    assert!(partition.neighbours(partition.len() as u32).is_empty(), "an unknown label has no neighbours");

    assert_eq!(partition.runs().rows().len(), height);
    for (y, line) in labels.chunks_exact(width).enumerate() {
        let runs = partition.runs().row(y);
        let unrolled: Vec<u32> =
            runs.iter().flat_map(|run| std::iter::repeat_n(run.label, (run.end - run.start) as usize)).collect();
        assert_eq!(unrolled, line, "runs of row {y}");
        assert!(runs.windows(2).all(|w| w[0].end == w[1].start && w[0].label != w[1].label), "runs of row {y}");
    }
}
