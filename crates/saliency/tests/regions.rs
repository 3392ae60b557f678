//! Salient regions: their pixels, measures, order and thresholds.

#![allow(clippy::unwrap_used, reason = "helpers of tests fail by panicking, too")]

mod support;

use std::collections::BTreeSet;

use proptest::prelude::*;
use samsod_saliency::{
    Method, RegionError, SaliencyMap, SalientRegion, Scales, Threshold, salient_regions, salient_regions_into,
};
use samsod_segment::Partition;

use support::{Dice, Picture, map_of, pictures};

const GREY: [u8; 3] = [128; 3];

fn flat(width: usize, labels: &[u32]) -> Partition {
    let count = labels.iter().max().map_or(0, |l| *l as usize + 1);
    Picture::new(width, labels, &vec![GREY; count]).partition()
}

/// A map that is constant on every partition.
fn map_by_label(partition: &Partition, of_label: &[f32]) -> SaliencyMap {
    let values = partition.labels().iter().map(|&l| of_label[l as usize]).collect();
    SaliencyMap::from_values(partition.width(), partition.height(), values).unwrap()
}

fn lists(regions: &[SalientRegion]) -> Vec<&[u32]> {
    regions.iter().map(|r| r.partitions.as_slice()).collect()
}

/// Table 0, a part of partitions 1 and 3, a part of partition 2:
#[rustfmt::skip]
const LITERAL: [u32; 24] = [
    0, 0, 0, 0, 0, 0,
    0, 1, 1, 0, 2, 0,
    0, 3, 3, 0, 2, 0,
    0, 3, 0, 0, 0, 0,
];

#[test]
fn a_literal_of_6_by_4() {
    let partition = flat(6, &LITERAL);
    let map = map_by_label(&partition, &[0.0, 0.9, 0.6, 0.4]);
    let regions = salient_regions(&map, &partition, Threshold::Positive).unwrap();
    assert_eq!(lists(&regions), [[1, 3].as_slice(), &[2]]);

    let first = &regions[0];
    assert_eq!(first.area, 5);
    assert_eq!((first.bbox.x, first.bbox.y, first.bbox.width, first.bbox.height), (1, 1, 2, 3));
    assert_eq!(first.centroid, [1.4, 1.8]);
    assert!((first.mean_saliency - (2.0 * 0.9 + 3.0 * 0.4) / 5.0).abs() < 1e-6);
    #[rustfmt::skip]
    let mask = [
        0,   0,   0, 0, 0, 0,
        0, 255, 255, 0, 0, 0,
        0, 255, 255, 0, 0, 0,
        0, 255,   0, 0, 0, 0,
    ];
    assert_eq!(first.mask(&partition).as_raw(), &mask);
    // A column of two pixels: its axis points up.
    assert!((regions[1].axis_rad - std::f32::consts::FRAC_PI_2).abs() < 1e-6, "{}", regions[1].axis_rad);

    // Above 0.5 partition 3 drops out; partition 1 is now as large as 2 and has the smaller label.
    let regions = salient_regions(&map, &partition, Threshold::Value(0.5)).unwrap();
    assert_eq!(lists(&regions), [[1].as_slice(), &[2]]);
    // Twice the mean of the image, 2 * (2 * 0.9 + 2 * 0.6 + 3 * 0.4) / 24 = 0.35.
    let regions = salient_regions(&map, &partition, Threshold::Adaptive).unwrap();
    assert_eq!(lists(&regions), [[1, 3].as_slice(), &[2]]);
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 48, failure_persistence: None, ..ProptestConfig::default() })]

    /// Masks are unions of partitions, disjoint and connected; every measure is what a direct sum finds.
    #[test]
    fn regions_are_what_a_direct_count_finds(
        picture in pictures(1..=50, 30),
        seed in any::<u64>(),
        threshold in 0.0..1.0f32,
    ) {
        let partition = picture.partition();
        let mut dice = Dice(seed);
        let values: Vec<f32> = (0..picture.labels.len()).map(|_| dice.below(1000) as f32 / 999.0).collect();
        // Noise on a level of its own for every partition.
        let level: Vec<f32> = (0..partition.len()).map(|_| dice.below(1000) as f32 / 999.0).collect();
        let values: Vec<f32> =
            values.iter().zip(&picture.labels).map(|(v, &l)| 0.2 * v + 0.8 * level[l as usize]).collect();
        let map = SaliencyMap::from_values(picture.width as u32, picture.height as u32, values.clone()).unwrap();
        let mean_of = |inside: &dyn Fn(u32) -> bool| {
            let in_it: Vec<f64> =
                values.iter().zip(&picture.labels).filter(|&(_, &l)| inside(l)).map(|(v, _)| f64::from(*v)).collect();
            in_it.iter().sum::<f64>() / in_it.len() as f64
        };
        let means: Vec<f64> = (0..partition.len() as u32).map(|label| mean_of(&|l| l == label)).collect();

        let regions = salient_regions(&map, &partition, Threshold::Value(threshold)).unwrap();
        let mut seen = BTreeSet::new();
        let mut last_area = u32::MAX;
        for region in &regions {
            prop_assert!(region.area <= last_area, "largest first");
            last_area = region.area;
            prop_assert!(region.partitions.is_sorted());
            for &label in &region.partitions {
                prop_assert!(seen.insert(label), "partition {} is in two regions", label);
            }
            let mask = region.mask(&partition);
            prop_assert_eq!(mask.dimensions(), (partition.width(), partition.height()));
            let inside: Vec<usize> = (0..values.len()).filter(|&i| mask.as_raw()[i] == 255).collect();
            prop_assert!(mask.as_raw().iter().all(|v| [0, 255].contains(v)));
            prop_assert!(
                (0..values.len()).all(|i| (mask.as_raw()[i] == 255) == region.partitions.contains(&picture.labels[i])),
                "the mask is the union of the partitions"
            );
            prop_assert_eq!(region.area as usize, inside.len());
            let n = inside.len() as f64;
            let xs = || inside.iter().map(|i| i % picture.width);
            let ys = || inside.iter().map(|i| i / picture.width);
            let b = region.bbox;
            prop_assert_eq!(
                (b.x, b.y, b.right(), b.bottom()),
                (xs().min().unwrap() as u32, ys().min().unwrap() as u32, xs().max().unwrap() as u32, ys().max().unwrap() as u32)
            );
            prop_assert!((xs().sum::<usize>() as f64 / n - f64::from(region.centroid[0])).abs() < 1e-3);
            prop_assert!((ys().sum::<usize>() as f64 / n - f64::from(region.centroid[1])).abs() < 1e-3);
            let mean = mean_of(&|l| region.partitions.contains(&l));
            prop_assert!((mean - f64::from(region.mean_saliency)).abs() < 1e-5, "{} {}", mean, region.mean_saliency);
            let half_turn = std::f32::consts::FRAC_PI_2;
            prop_assert!(region.axis_rad > -half_turn && region.axis_rad <= half_turn, "axis {}", region.axis_rad);
            // Whether or not its partitions are connected, a region hangs together by their neighbourhood.
            let mut reached = BTreeSet::from([region.partitions[0]]);
            let mut stack = vec![region.partitions[0]];
            while let Some(label) = stack.pop() {
                let next = partition.neighbours(label).iter().filter(|n| region.partitions.contains(n));
                stack.extend(next.filter(|n| reached.insert(**n)));
            }
            prop_assert_eq!(reached.len(), region.partitions.len(), "connected");
        }
        // Every partition above the threshold is in a region, none below; rounding decides within 1e-5 of it.
        for (label, mean) in (0..).zip(&means) {
            let margin = mean - f64::from(threshold);
            prop_assert!(margin.abs() < 1e-5 || seen.contains(&label) == (margin > 0.0), "partition {}", label);
        }
        // Regions that touch would be one.
        for a in &regions {
            let touched = a.partitions.iter().flat_map(|&l| partition.neighbours(l));
            let other = touched.filter(|n| seen.contains(*n) && !a.partitions.contains(n)).count();
            prop_assert_eq!(other, 0, "regions do not touch");
        }
    }

    /// A region of connected partitions is 4-connected in its pixels, by flood fill.
    #[test]
    fn regions_of_connected_partitions_are_connected(picture in pictures(1..=50, 20), threshold in 0.0..0.6f32) {
        // On a lattice the pixels nearest to a seed can fall apart: every component gets a label of its own.
        let labels = split(&picture.labels, picture.width);
        let partition = Picture { labels, ..picture }.partition();
        let map = map_of(&partition, Method::Fast, &Scales::Generic);
        for threshold in [Threshold::Value(threshold), Threshold::Positive, Threshold::Adaptive] {
            for region in salient_regions(&map, &partition, threshold).unwrap() {
                let mask = region.mask(&partition);
                let values: Vec<u32> = mask.as_raw().iter().map(|&v| u32::from(v)).collect();
                let parts = split(&values, partition.width() as usize);
                let of_region: BTreeSet<u32> =
                    parts.iter().zip(&values).filter(|(_, v)| **v > 0).map(|(p, _)| *p).collect();
                prop_assert_eq!(of_region.len(), 1);
            }
        }
    }
}

/// Gives every 4-connected component of equal label a label of its own, dense, by flood fill.
fn split(labels: &[u32], width: usize) -> Vec<u32> {
    let mut out = vec![u32::MAX; labels.len()];
    let mut count = 0;
    let mut stack = Vec::new();
    for start in 0..labels.len() {
        if out[start] != u32::MAX {
            continue;
        }
        out[start] = count;
        stack.push(start);
        while let Some(i) = stack.pop() {
            let beside = [(!i.is_multiple_of(width)).then(|| i - 1), (i % width + 1 < width).then_some(i + 1)];
            let above_below = [i.checked_sub(width), (i + width < labels.len()).then_some(i + width)];
            for j in beside.into_iter().chain(above_below).flatten() {
                if out[j] == u32::MAX && labels[j] == labels[i] {
                    out[j] = count;
                    stack.push(j);
                }
            }
        }
        count += 1;
    }
    out
}

/// The axis of a bar of 81 x 11 px, drawn at an angle counter-clockwise on the screen.
fn axis_of_bar(degrees: f64) -> f64 {
    let (sin, cos) = degrees.to_radians().sin_cos();
    let labels: Vec<u32> = (0..121 * 111)
        .map(|i| {
            // Upwards on the screen is against the rows.
            let (right, up) = (f64::from(i % 121 - 60), -f64::from(i / 121 - 55));
            let (along, across) = (right * cos + up * sin, up * cos - right * sin);
            u32::from(along.abs() <= 40.0 + 1e-9 && across.abs() <= 5.0 + 1e-9)
        })
        .collect();
    let partition = flat(121, &labels);
    let map = map_by_label(&partition, &[0.0, 1.0]);
    let regions = salient_regions(&map, &partition, Threshold::Positive).unwrap();
    assert_eq!(lists(&regions), [[1]]);
    f64::from(regions[0].axis_rad).to_degrees()
}

#[test]
fn the_axis_turns_counter_clockwise_on_the_screen() {
    for degrees in [0.0, 30.0, -45.0, 45.0, 80.0, -80.0, 90.0] {
        let axis = axis_of_bar(degrees);
        assert!((axis - degrees).abs() < 0.5, "bar at {degrees} degrees has its axis at {axis}");
    }
}

#[test]
fn a_square_has_no_axis() {
    let labels: Vec<u32> =
        (0..20 * 20).map(|i| u32::from((5..12).contains(&(i % 20)) && (5..12).contains(&(i / 20)))).collect();
    let partition = flat(20, &labels);
    let regions = salient_regions(&map_by_label(&partition, &[0.0, 0.5]), &partition, Threshold::Positive).unwrap();
    assert_eq!(regions[0].axis_rad, 0.0);
}

#[test]
fn a_value_must_be_exceeded() {
    let partition = flat(6, &LITERAL);
    let map = map_by_label(&partition, &[0.0, 0.75, 0.5, 0.25]);
    let count = |value| salient_regions(&map, &partition, Threshold::Value(value)).unwrap().len();
    assert_eq!(count(0.5), 1, "0.5 does not exceed 0.5");
    assert_eq!(count(0.49), 2);
    assert_eq!(count(1.0), 0);
    // Everything but the table, whose saliency is 0.
    assert_eq!(count(0.0), 2);
}

#[test]
fn the_table_is_never_salient_by_the_positive_threshold() {
    let partition = flat(6, &LITERAL);
    // Twice as salient as the parts, as a table can be between many parts.
    let map = map_by_label(&partition, &[0.4, 0.3, 0.5, 0.3]);
    let regions = salient_regions(&map, &partition, Threshold::Positive).unwrap();
    assert_eq!(lists(&regions), [[1, 3].as_slice(), &[2]]);
    // Where nothing is salient there is no region, with any word.
    let nothing = map_by_label(&partition, &[0.0; 4]);
    for threshold in [Threshold::Positive, Threshold::Adaptive, Threshold::Value(0.0)] {
        assert_eq!(salient_regions(&nothing, &partition, threshold).unwrap(), []);
    }
}

#[test]
fn touching_corners_do_not_join_regions() {
    #[rustfmt::skip]
    let labels = [
        0, 0, 0, 0, 0,
        0, 1, 0, 0, 0,
        0, 0, 2, 0, 0,
        0, 0, 0, 0, 0,
    ];
    let partition = flat(5, &labels);
    let regions =
        salient_regions(&map_by_label(&partition, &[0.0, 0.5, 0.5]), &partition, Threshold::Positive).unwrap();
    assert_eq!(lists(&regions), [[1], [2]]);
}

#[test]
fn a_map_of_another_size_is_refused() {
    let partition = flat(6, &LITERAL);
    let map = SaliencyMap::from_values(4, 6, vec![0.5; 24]).unwrap();
    let mut regions = Vec::new();
    let error = salient_regions_into(&map, &partition, Threshold::Positive, &mut regions).unwrap_err();
    assert_eq!(error, RegionError::Size { map_width: 4, map_height: 6, width: 6, height: 4 });
    assert_eq!(error.to_string(), "saliency map of 4 x 6 px for a partition of 6 x 4 px");
}

#[test]
fn a_threshold_out_of_range_is_refused() {
    let partition = flat(6, &LITERAL);
    let map = map_by_label(&partition, &[0.0, 0.9, 0.6, 0.4]);
    let mut regions = salient_regions(&map, &partition, Threshold::Positive).unwrap();
    let before = regions.clone();
    for (value, shown) in [(f32::NAN, "NaN"), (-0.5, "-0.5"), (1.5, "1.5")] {
        let error = salient_regions_into(&map, &partition, Threshold::Value(value), &mut regions).unwrap_err();
        let wanted = format!("threshold = {shown}; allowed are \"positive\", \"adaptive\" or a number from 0 to 1");
        assert_eq!(error.to_string(), wanted);
        assert_eq!(regions, before, "unchanged");
    }
}

#[test]
fn reused_regions_hold_nothing_of_before() {
    let partition = flat(6, &LITERAL);
    let mut regions = Vec::new();
    for levels in [[0.0, 0.9, 0.6, 0.4], [0.0, 0.0, 0.6, 0.0], [0.0; 4]] {
        let map = map_by_label(&partition, &levels);
        salient_regions_into(&map, &partition, Threshold::Positive, &mut regions).unwrap();
        assert_eq!(regions, salient_regions(&map, &partition, Threshold::Positive).unwrap());
    }
    assert!(regions.is_empty());
}
