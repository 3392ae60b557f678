//! Saliency by what is *not* background: the border of the image is background, and what is cut off from it by edges
//! (`geodesic`) or has none of its colours (`border_colour`) is salient.
//!
//! Still photos need it: their objects are larger than the centre-surround scales, and backgrounds vary. One value a
//! partition:
//!
//! 1. the distance to the border on the way of least colour change, stretched to [0, 1], plus half of the unlikeness to the
//!    colours of the border, stretched to [0, 1];
//! 2. with `centred` times the root of a Gaussian about the centre of the image, since photographers place it there;
//! 3. stretched to [0, 1] and put through a logistic curve whose middle is Otsu's threshold between the two groups of
//!    pixels: so S = 0.5 is the bound between what is background and what is not.

use samsod_segment::Partition;

use crate::border_colour::border_contrast;
use crate::geodesic::border_distance;
use crate::lab::lab_of;

/// Weight of the unlikeness to the colours of the border beside the distance.
const COLOUR_WEIGHT: f32 = 0.5;
/// Deviation of the Gaussian about the centre, as a share of each side.
const CENTRE_DEVIATION: f32 = 0.33;
/// Slope of the logistic curve.
const SLOPE: f32 = 15.0;
/// Bins of the histogram under Otsu's threshold.
const BINS: usize = 256;

/// S of every partition, one a label, in [0, 1]; 0 where nothing differs from the border.
pub(crate) fn partition_saliency(partition: &Partition, centred: bool) -> Vec<f32> {
    let colours: Vec<[f32; 3]> = partition.objects().iter().map(|o| lab_of(o.mean)).collect();
    let mut values = border_distance(partition, &colours, &border_pixels(partition));
    let mut contrast = border_contrast(partition, &colours);
    stretch(&mut values);
    stretch(&mut contrast);
    for (value, contrast) in values.iter_mut().zip(&contrast) {
        *value += COLOUR_WEIGHT * contrast;
    }
    if centred {
        for (value, weight) in values.iter_mut().zip(centre_weights(partition)) {
            *value *= weight.sqrt();
        }
    }
    if !stretch(&mut values) {
        return values;
    }
    let middle = otsu_threshold(&values, partition);
    for value in &mut values {
        *value = 1.0 / (1.0 + (-SLOPE * (*value - middle)).exp());
    }
    values
}

/// Pixels of every label on the border of the image, corners twice.
fn border_pixels(partition: &Partition) -> Vec<u32> {
    let mut border = vec![0; partition.len()];
    let (rows, width) = (partition.runs().rows(), partition.width());
    for (y, row) in rows.iter().enumerate() {
        let outer = y == 0 || y + 1 == rows.len();
        for run in row {
            let count = &mut border[run.label as usize];
            *count += u32::from(run.start == 0) + u32::from(run.end == width);
            if outer {
                *count += run.end - run.start;
            }
        }
    }
    border
}

/// Mean over every partition of a Gaussian about the centre of the image, in (0, 1].
fn centre_weights(partition: &Partition) -> Vec<f32> {
    let gaussian = |side: usize| -> Vec<f64> {
        let deviation = f64::from(CENTRE_DEVIATION) * side as f64;
        (0..side).map(|i| (i as f64 + 0.5 - side as f64 / 2.0) / deviation).map(|t| (-t * t / 2.0).exp()).collect()
    };
    let across = gaussian(partition.width() as usize);
    let down = gaussian(partition.height() as usize);
    // Sums of the columns before each, so that a run is one difference.
    let mut before = vec![0.0];
    for weight in &across {
        before.push(before.last().copied().unwrap_or(0.0) + weight);
    }
    let mut sums = vec![0.0; partition.len()];
    for (row, weight) in partition.runs().rows().iter().zip(&down) {
        for run in row {
            sums[run.label as usize] += weight * (before[run.end as usize] - before[run.start as usize]);
        }
    }
    sums.iter().zip(partition.objects()).map(|(sum, object)| (sum / f64::from(object.area)) as f32).collect()
}

/// Stretches values to [0, 1]; where all are alike they become 0 and nothing is left to stretch.
fn stretch(values: &mut [f32]) -> bool {
    // Distances are in Delta E, contrasts in shares of a range: less than this is rounding.
    const ROUNDING: f32 = 1e-4;
    let low = values.iter().copied().fold(f32::INFINITY, f32::min);
    let high = values.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    if high - low <= ROUNDING {
        values.fill(0.0);
        return false;
    }
    for value in values {
        *value = (*value - low) / (high - low);
    }
    true
}

/// The threshold that leaves the least variance within the two groups of pixels that it makes (Otsu).
fn otsu_threshold(values: &[f32], partition: &Partition) -> f32 {
    let centre = |bin: usize| (bin as f64 + 0.5) / BINS as f64;
    let mut histogram = vec![0.0; BINS];
    for (value, object) in values.iter().zip(partition.objects()) {
        histogram[((value * BINS as f32) as usize).min(BINS - 1)] += f64::from(object.area);
    }
    let pixels: f64 = histogram.iter().sum();
    let total: f64 = histogram.iter().enumerate().map(|(bin, n)| n * centre(bin)).sum();
    let (mut below, mut sum_below) = (0.0, 0.0);
    // Any threshold in a gap between two groups is as good: the middle of the gap is taken.
    let (mut best, mut first, mut last) = (-1.0, BINS / 2 - 1, BINS / 2 - 1);
    for (bin, n) in histogram.iter().enumerate() {
        below += n;
        sum_below += n * centre(bin);
        let above = pixels - below;
        if below <= 0.0 || above <= 0.0 {
            continue;
        }
        let difference = sum_below / below - (total - sum_below) / above;
        let between = below * above * difference * difference;
        if between > best {
            (best, first, last) = (between, bin, bin);
        } else if between == best {
            last = bin;
        }
    }
    // The bound of a bin to the next one.
    (first + last + 2) as f32 / (2 * BINS) as f32
}
