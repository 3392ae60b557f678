//! Exact evaluation of the mask-weighted mean colour: every run of a label in the disc adds one product of a prefix
//! sum.
//!
//! Cost of a pixel and a scale: the number of runs in the disc of radius 3 sigma.

use samsod_segment::{Partition, ProtoObject};

/// The Gaussian of one scale, without its constant factor, which cancels in eq 12.
#[derive(Debug, Clone)]
pub(crate) struct Gaussian {
    /// Largest whole offset within 3 sigma.
    radius: i64,
    /// `half_width[|dy|]`: largest |dx| within the disc.
    half_width: Vec<i64>,
    /// `row[|dy|] = exp(-dy^2 / 2 sigma^2)`.
    row: Vec<f64>,
    /// `prefix[dx + radius]`: sum of `exp(-x^2 / 2 sigma^2)` over x from -radius to dx - 1.
    prefix: Vec<f64>,
}

impl Gaussian {
    pub(crate) fn new(sigma: f32) -> Self {
        let s = f64::from(sigma);
        let radius = (3.0 * s).floor() as i64;
        let g = |d: i64| (-((d * d) as f64) / (2.0 * s * s)).exp();
        let half_width = (0..=radius).map(|dy| (9.0 * s * s - (dy * dy) as f64).max(0.0).sqrt().floor() as i64);
        let mut sum = 0.0;
        let mut prefix = vec![0.0];
        for x in -radius..=radius {
            sum += g(x);
            prefix.push(sum);
        }
        Self { radius, half_width: half_width.collect(), row: (0..=radius).map(g).collect(), prefix }
    }
}

impl Gaussian {
    /// Largest whole offset within 3 sigma, px.
    pub(crate) fn radius_px(&self) -> usize {
        self.radius as usize
    }
}

/// Sums of one partition in the disc around a pixel.
#[derive(Debug, Clone, Copy, Default)]
struct InDisc {
    weight: f64,
    count: u64,
}

/// Reused memory: one slot a label, and the labels in use.
#[derive(Debug, Default)]
pub(crate) struct Scratch {
    slots: Vec<InDisc>,
    used: Vec<u32>,
}

impl Scratch {
    pub(crate) fn for_labels(count: usize) -> Self {
        Self { slots: vec![InDisc::default(); count], used: Vec::new() }
    }
}

/// Extent measure D_i of eq 9 for a centre pixel (x, y).
fn extent_measure(object: &ProtoObject, x: f64, y: f64, width_plus_height: f64) -> f64 {
    let b = &object.bbox;
    let far = |c: f64, low: u32, high: u32| (c - f64::from(low)).abs().max((c - f64::from(high)).abs());
    let t = far(x, b.x, b.right()) + far(y, b.y, b.bottom());
    1.0 - t / width_plus_height
}

/// The mask-weighted mean colour M_sigma at pixel (x, y), as if it lay in partition `center`.
pub(crate) fn mean_colour(
    partition: &Partition,
    gaussian: &Gaussian,
    (x, y): (i64, i64),
    center: u32,
    scratch: &mut Scratch,
) -> [f64; 3] {
    let r = gaussian.radius;
    let runs = partition.runs();
    let last_row = runs.rows().len() as i64 - 1;
    for row in (y - r).max(0)..=(y + r).min(last_row) {
        let dy = (row - y).unsigned_abs() as usize;
        let reach = gaussian.half_width[dy];
        let runs = runs.row(row as usize);
        let first = runs.partition_point(|run| i64::from(run.end) <= x - reach);
        for run in &runs[first..] {
            let (from, to) = (i64::from(run.start).max(x - reach), i64::from(run.end).min(x + reach + 1));
            if from >= to {
                break;
            }
            let slot = &mut scratch.slots[run.label as usize];
            if slot.count == 0 {
                scratch.used.push(run.label);
            }
            let phi = |column: i64| gaussian.prefix[(column - x + r) as usize];
            slot.weight += gaussian.row[dy] * (phi(to) - phi(from));
            slot.count += (to - from) as u64;
        }
    }
    let size = f64::from(partition.width()) + f64::from(partition.height());
    // In the order of labels, not of appearance: a permutation that keeps order changes nothing, and sums are stable.
    scratch.used.sort_unstable();
    let (mut colour, mut total) = ([0.0; 3], 0.0);
    let mut add = |label: u32, weight: f64| {
        let object = &partition.objects()[label as usize];
        let mass = weight * f64::from(object.area);
        for (c, m) in colour.iter_mut().zip(object.mean) {
            *c += mass * f64::from(m);
        }
        total += mass;
    };
    add(center, 1.0);
    for label in scratch.used.drain(..) {
        let slot = std::mem::take(&mut scratch.slots[label as usize]);
        if label != center {
            let object = &partition.objects()[label as usize];
            let d = extent_measure(object, x as f64, y as f64, size);
            add(label, slot.weight / slot.count as f64 * d);
        }
    }
    colour.map(|c| c / total)
}
