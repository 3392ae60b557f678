//! Shape context (reference 86 of the paper; section 5.2, eq 16).
//!
//! In: points on the edges of a shape, in a plane, any unit. Out: for every point the histogram of where the others lie
//! as seen from it, 5 rings (by the logarithm of the distance) times 12 directions; the chi-square cost between
//! histograms, and the rotation and the one-to-one correspondence of least total cost between two shapes.
//!
//! Directions are those of the plane, not of the tangent: a turn by 30 degrees is a cyclic shift of the directions, so
//! that the search over all rotations needs the histograms once. Cost: n^2 for n points.

use std::f32::consts::TAU;

use lapjv::{Matrix, lapjv};
use serde::{Deserialize, Serialize};

/// Rings of a histogram.
pub(crate) const RINGS: usize = 5;
/// Directions of a histogram, and rotations that are tried.
pub(crate) const DIRECTIONS: usize = 12;
/// Radius of the innermost ring and of the outermost, in mean distances of two points.
const INNERMOST: f32 = 0.125;
const OUTERMOST: f32 = 2.0;
/// Values of a histogram, padded to whole SIMD registers.
const LENGTH: usize = 64;

/// Points of a shape and what each sees of the others.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct ShapeContexts {
    points: Vec<[f32; 2]>,
    /// Shares of the other points by direction, then ring: [`DIRECTIONS`] x [`RINGS`] values a point.
    histograms: Vec<f32>,
}

impl ShapeContexts {
    /// Describes a shape; points beyond the outermost ring are in none.
    pub(crate) fn of(points: Vec<[f32; 2]>) -> Self {
        let n = points.len();
        let mut histograms = vec![0.0; n * LENGTH];
        if n < 2 {
            return Self { points, histograms };
        }
        let mut total = 0.0f64;
        for (i, a) in points.iter().enumerate() {
            total += points[..i].iter().map(|b| f64::from((a[0] - b[0]).hypot(a[1] - b[1]))).sum::<f64>();
        }
        let mean = (total / (n * (n - 1) / 2) as f64) as f32;
        if mean.is_nan() || mean <= 0.0 {
            return Self { points, histograms };
        }
        let ring_step = (OUTERMOST / INNERMOST).ln() / (RINGS - 1) as f32;
        let share = 1.0 / (n - 1) as f32;
        for (i, a) in points.iter().enumerate() {
            for (j, b) in points.iter().enumerate() {
                let (dx, dy) = (b[0] - a[0], b[1] - a[1]);
                let distance = dx.hypot(dy) / mean;
                if i == j || distance >= OUTERMOST {
                    continue;
                }
                // Shared between the two nearest rings and directions: a turn by half a direction then costs little.
                let ring = ((distance / INNERMOST).ln() / ring_step + 0.5).clamp(0.0, (RINGS - 1) as f32);
                let direction = dy.atan2(dx).rem_euclid(TAU) / TAU * DIRECTIONS as f32;
                let (inner, first) = (ring as usize, direction as usize);
                let (outward, onward) = (ring - inner as f32, direction - first as f32);
                let mut add = |direction: usize, ring: usize, part: f32| {
                    let bin = direction % DIRECTIONS * RINGS + ring.min(RINGS - 1);
                    histograms[i * LENGTH + bin] += part * share;
                };
                add(first, inner, (1.0 - onward) * (1.0 - outward));
                add(first, inner + 1, (1.0 - onward) * outward);
                add(first + 1, inner, onward * (1.0 - outward));
                add(first + 1, inner + 1, onward * outward);
            }
        }
        Self { points, histograms }
    }

    /// The points.
    pub(crate) fn points(&self) -> &[[f32; 2]] {
        &self.points
    }

    /// The histograms after a turn by `steps` twelfths of a circle, counter-clockwise from x to y.
    pub(crate) fn turned(&self, steps: usize) -> Turned {
        let shift = steps % DIRECTIONS * RINGS;
        let used = DIRECTIONS * RINGS;
        let mut histograms = vec![0.0; self.histograms.len()];
        for (to, from) in histograms.chunks_exact_mut(LENGTH).zip(self.histograms.chunks_exact(LENGTH)) {
            to[shift..used].copy_from_slice(&from[..used - shift]);
            to[..shift].copy_from_slice(&from[used - shift..used]);
        }
        Turned { histograms }
    }

    /// Mean over every `stride`-th point of the least cost to any point of a turned shape: what a full assignment
    /// cannot go below, a bound at a fraction of its price.
    pub(crate) fn least_cost(&self, other: &Turned, stride: usize) -> f32 {
        let own = self.histograms.chunks_exact(LENGTH).step_by(stride.max(1));
        let rows: Vec<f32> = costs(own.filter_map(|chunk| chunk.first_chunk()), other);
        let count = other.len();
        if count == 0 || rows.is_empty() {
            return f32::INFINITY;
        }
        let least = rows.chunks_exact(count).map(|row| row.iter().copied().fold(f32::INFINITY, f32::min));
        least.sum::<f32>() / (rows.len() / count) as f32
    }

    /// The one-to-one correspondence of least total cost (TC of eq 16) with a turned shape: for every point of this
    /// shape, that of the other, and the mean cost. `None` when the numbers of points differ or there are none.
    pub(crate) fn assign(&self, other: &Turned) -> Option<(Vec<usize>, f32)> {
        let n = self.points.len();
        if n == 0 || other.len() != n {
            return None;
        }
        let own = self.histograms.chunks_exact(LENGTH).filter_map(|chunk| chunk.first_chunk());
        let costs: Vec<f64> = costs(own, other).into_iter().map(f64::from).collect();
        let matrix = Matrix::from_shape_vec((n, n), costs).ok()?;
        let (columns, _) = lapjv(&matrix).ok()?;
        let total: f64 = columns.iter().enumerate().map(|(i, &j)| matrix[(i, j)]).sum();
        Some((columns, (total / n as f64) as f32))
    }
}

/// Histograms of a shape after a turn.
#[derive(Debug, Clone)]
pub(crate) struct Turned {
    histograms: Vec<f32>,
}

impl Turned {
    fn len(&self) -> usize {
        self.histograms.len() / LENGTH
    }

    fn iter(&self) -> impl Iterator<Item = &[f32; LENGTH]> {
        self.histograms.chunks_exact(LENGTH).filter_map(|chunk| chunk.first_chunk())
    }
}

/// Chi-square distances, in [0, 1], of some histograms to all of a turned shape, row by row.
fn costs<'a>(own: impl Iterator<Item = &'a [f32; LENGTH]>, other: &Turned) -> Vec<f32> {
    #[cfg(target_arch = "x86_64")]
    if std::arch::is_x86_feature_detected!("avx2") {
        // SAFETY: the processor was just found to have AVX2, the only feature the function asks for.
        return unsafe { costs_avx2(own, other) };
    }
    costs_of(own, other)
}

/// [`costs`] in registers of eight; the same operations in the same order.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn costs_avx2<'a>(own: impl Iterator<Item = &'a [f32; LENGTH]>, other: &Turned) -> Vec<f32> {
    costs_of(own, other)
}

#[inline(always)]
fn costs_of<'a>(own: impl Iterator<Item = &'a [f32; LENGTH]>, other: &Turned) -> Vec<f32> {
    let mut all = Vec::with_capacity(other.len() * other.len());
    for a in own {
        for b in other.iter() {
            // Eight running sums, which compilers put into one register.
            let mut sums = [0.0f32; 8];
            for (a, b) in a.chunks_exact(8).zip(b.chunks_exact(8)) {
                for lane in 0..8 {
                    let difference = a[lane] - b[lane];
                    sums[lane] += difference * difference / (a[lane] + b[lane] + 1e-9);
                }
            }
            all.push(0.5 * sums.iter().sum::<f32>());
        }
    }
    all
}

/// A point, the point that it belongs on, and the weight of that.
pub(crate) type Weighed = ([f32; 2], [f32; 2], f32);

/// The rotation (rad) and translation that take points onto others with least squares, by weights: `to = R from + t`.
/// `None` where all points are one.
pub(crate) fn rigid(pairs: &[Weighed]) -> Option<(f64, [f64; 2])> {
    let weight: f64 = pairs.iter().map(|pair| f64::from(pair.2)).sum();
    if weight.is_nan() || weight <= 0.0 {
        return None;
    }
    let mean = |pick: fn(&Weighed) -> [f32; 2]| {
        [0, 1].map(|i| pairs.iter().map(|pair| f64::from(pick(pair)[i]) * f64::from(pair.2)).sum::<f64>() / weight)
    };
    let (from, to) = (mean(|pair| pair.0), mean(|pair| pair.1));
    let (mut cos, mut sin) = (0.0, 0.0);
    for (a, b, w) in pairs {
        let a = [0, 1].map(|i| f64::from(a[i]) - from[i]);
        let b = [0, 1].map(|i| f64::from(b[i]) - to[i]);
        cos += f64::from(*w) * (a[0] * b[0] + a[1] * b[1]);
        sin += f64::from(*w) * (a[0] * b[1] - a[1] * b[0]);
    }
    if cos.hypot(sin) < 1e-9 {
        return None;
    }
    let angle = sin.atan2(cos);
    let (s, c) = angle.sin_cos();
    Some((angle, [to[0] - c * from[0] + s * from[1], to[1] - s * from[0] - c * from[1]]))
}

/// `count` points at even distances along a closed line of pixels.
pub(crate) fn along(line: &[[i32; 2]], count: usize) -> Vec<[f32; 2]> {
    let step = |a: [i32; 2], b: [i32; 2]| ((a[0] - b[0]) as f32).hypot((a[1] - b[1]) as f32);
    let next_of = |i: usize| line[(i + 1) % line.len()];
    let total: f32 = (0..line.len()).map(|i| step(line[i], next_of(i))).sum();
    let mut points = Vec::with_capacity(count);
    if total <= 0.0 {
        return points;
    }
    let spacing = total / count as f32;
    let (mut next, mut passed) = (0.5 * spacing, 0.0);
    for (i, &a) in line.iter().enumerate() {
        let (b, length) = (next_of(i), step(a, next_of(i)));
        while next < passed + length && points.len() < count {
            let t = (next - passed) / length;
            points.push([0, 1].map(|k| a[k] as f32 + t * (b[k] - a[k]) as f32));
            next += spacing;
        }
        passed += length;
    }
    points
}
