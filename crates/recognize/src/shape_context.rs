//! Shape context (reference 86 of the paper; section 5.2, eq 16).
//!
//! In: points on the edges of a shape, in a plane, any unit. Out: for every point the histogram of where the others lie
//! as seen from it, 5 rings (by the logarithm of the distance) times 12 directions; the chi-square cost between
//! histograms, and the rotation and the one-to-one correspondence of least total cost between two shapes.
//!
//! Directions are those of the plane, not of the tangent: a turn by 30 degrees is a cyclic shift of the directions, so
//! that the search over all rotations needs the histograms once. Cost: n^2 for n points.

use std::f32::consts::TAU;

use serde::{Deserialize, Serialize};

use lapjv::{Matrix, lapjv};

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
            total += points[..i]
                .iter()
                .map(|b| f64::from(((a[0] - b[0]).powi(2) + (a[1] - b[1]).powi(2)).sqrt()))
                .sum::<f64>();
        }
        let mean = (total / (n * (n - 1) / 2) as f64) as f32;
        if mean.is_nan() || mean <= 0.0 {
            return Self { points, histograms };
        }
        let ring_step = (OUTERMOST / INNERMOST).ln() / (RINGS - 1) as f32;
        let share = 1.0 / (n - 1) as f32;
        for (i, a) in points.iter().enumerate() {
            for (j, b) in points.iter().enumerate().skip(i + 1) {
                let (dx, dy) = (b[0] - a[0], b[1] - a[1]);
                let distance = (dx * dx + dy * dy).sqrt() / mean;
                if distance >= OUTERMOST {
                    continue;
                }
                // Shared between the two nearest rings and directions: a turn by half a direction then costs little.
                let ring = ((distance / INNERMOST).ln() / ring_step + 0.5).clamp(0.0, (RINGS - 1) as f32);
                let direction = dy.atan2(dx).rem_euclid(TAU) / TAU * DIRECTIONS as f32;
                let (inner, first) = (ring as usize, direction as usize);
                let (outward, onward) = (ring - inner as f32, direction - first as f32);
                let mut add = |point: usize, direction: usize, ring: usize, part: f32| {
                    let bin = direction % DIRECTIONS * RINGS + ring.min(RINGS - 1);
                    histograms[point * LENGTH + bin] += part * share;
                };
                // The other way round it is half a circle on.
                for (point, first) in [(i, first), (j, first + DIRECTIONS / 2)] {
                    add(point, first, inner, (1.0 - onward) * (1.0 - outward));
                    add(point, first, inner + 1, (1.0 - onward) * outward);
                    add(point, first + 1, inner, onward * (1.0 - outward));
                    add(point, first + 1, inner + 1, onward * outward);
                }
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
            for (a, b) in a.as_chunks::<16>().0.iter().zip(b.as_chunks::<16>().0) {
                for lane in 0..8 {
                    // Two quotients by one division: divisions are all that takes time here.
                    let (first, second) = (a[lane] - b[lane], a[lane + 8] - b[lane + 8]);
                    let (under, below) = (a[lane] + b[lane] + 1e-9, a[lane + 8] + b[lane + 8] + 1e-9);
                    sums[lane] += (first * first * below + second * second * under) / (under * below);
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

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// A flat L of 60 x 45 units with unlike arms, clockwise on the screen.
    const L: [[i32; 2]; 6] = [[0, 0], [60, 0], [60, 20], [18, 20], [18, 45], [0, 45]];
    const BAR: [[i32; 2]; 4] = [[0, 0], [80, 0], [80, 12], [0, 12]];

    fn rotated(points: &[[f32; 2]], angle: f32) -> Vec<[f32; 2]> {
        let (sin, cos) = angle.sin_cos();
        points.iter().map(|[x, y]| [cos * x - sin * y + 7.0, sin * x + cos * y - 30.0]).collect()
    }

    fn shape(corners: &[[i32; 2]]) -> Vec<[f32; 2]> {
        along(corners, 64)
    }

    /// The least cost over all turns.
    fn cost(of: &[[f32; 2]], to: &[[f32; 2]]) -> f32 {
        let (of, to) = (ShapeContexts::of(of.to_vec()), ShapeContexts::of(to.to_vec()));
        (0..DIRECTIONS).map(|k| of.assign(&to.turned(k)).unwrap().1).fold(f32::INFINITY, f32::min)
    }

    proptest! {
        #[test]
        fn a_turned_shape_is_the_same_at_its_turn(steps in 0usize..DIRECTIONS, scale in 0.01f32..100.0) {
            let points = shape(&L);
            let turned: Vec<_> = rotated(&points, steps as f32 / DIRECTIONS as f32 * TAU);
            let turned = ShapeContexts::of(turned.iter().map(|p| p.map(|c| scale * c)).collect());
            let contexts = ShapeContexts::of(points).turned(steps);
            let (columns, cost) = turned.assign(&contexts).unwrap();
            prop_assert!(cost < 1e-3, "{}", cost);
            prop_assert_eq!(columns, (0..64).collect::<Vec<_>>());
            prop_assert!(turned.least_cost(&contexts, 3) <= cost + 1e-6);
        }

        #[test]
        fn a_bound_never_exceeds_the_assignment(
            points in prop::collection::vec(prop::array::uniform2(-50.0f32..50.0), 12),
            others in prop::collection::vec(prop::array::uniform2(-50.0f32..50.0), 12),
            steps in 0usize..DIRECTIONS,
        ) {
            let (own, other) = (ShapeContexts::of(points), ShapeContexts::of(others).turned(steps));
            let (mut columns, cost) = own.assign(&other).unwrap();
            prop_assert!((0.0..=1.0).contains(&cost));
            prop_assert!(own.least_cost(&other, 1) <= cost + 1e-6);
            columns.sort_unstable();
            prop_assert_eq!(columns, (0..12).collect::<Vec<_>>());
        }

        #[test]
        fn a_motion_is_recovered(
            angle in -3.1f64..3.1,
            offset in prop::array::uniform2(-200.0f64..200.0),
            points in prop::collection::vec(prop::array::uniform2(-60.0f32..60.0), 8..40),
        ) {
            let (sin, cos) = angle.sin_cos();
            let moved = |p: &[f32; 2]| {
                let [x, y] = p.map(f64::from);
                [(cos * x - sin * y + offset[0]) as f32, (sin * x + cos * y + offset[1]) as f32]
            };
            let pairs: Vec<_> = points.iter().enumerate().map(|(i, p)| (*p, moved(p), 0.5 + i as f32)).collect();
            let (found, at) = rigid(&pairs).unwrap();
            prop_assert!((found - angle).abs() < 1e-5, "{} for {}", found, angle);
            prop_assert!((at[0] - offset[0]).hypot(at[1] - offset[1]) < 1e-3, "{:?} for {:?}", at, offset);
        }
    }

    #[test]
    fn another_shape_and_a_mirrored_one_cost_more() {
        let points = shape(&L);
        let own = cost(&rotated(&points, TAU / DIRECTIONS as f32), &points);
        // Between two of the turns that are tried, where a shape is least like itself.
        let between = cost(&rotated(&points, 0.5 * TAU / DIRECTIONS as f32), &points);
        let mirrored = cost(&points.iter().map(|[x, y]| [-x, *y]).collect::<Vec<_>>(), &points);
        let bar = cost(&shape(&BAR), &points);
        assert!(own < 1e-3 && between < 0.6 * mirrored && mirrored < bar, "{own} {between} {mirrored} {bar}");
    }

    #[test]
    fn points_without_weight_have_no_say_in_a_motion() {
        let pairs = [([0.0, 0.0], [5.0, 5.0], 1.0), ([2.0, 0.0], [5.0, 7.0], 1.0), ([1.0, 1.0], [99.0, -40.0], 0.0)];
        let (angle, at) = rigid(&pairs).unwrap();
        assert!((angle - std::f64::consts::FRAC_PI_2).abs() < 1e-9, "{angle}");
        assert!((at[0] - 5.0).abs() < 1e-9 && (at[1] - 5.0).abs() < 1e-9, "{at:?}");
    }

    #[test]
    fn points_that_are_one_or_none_have_no_motion() {
        let one = ([1.0, 2.0], [3.0, 4.0], 1.0);
        assert_eq!(rigid(&[]), None);
        assert_eq!(rigid(&[one; 2]), None);
        assert_eq!(rigid(&[([1.0, 2.0], [3.0, 4.0], 0.0), ([5.0, 2.0], [7.0, 4.0], 0.0)]), None);
    }

    #[test]
    fn a_closed_line_has_points_at_even_distances() {
        let points = along(&BAR, 46);
        assert_eq!(points.len(), 46);
        // 184 long: every 4, the first after 2.
        assert_eq!(points[..2], [[2.0, 0.0], [6.0, 0.0]]);
        assert_eq!(points[20..23], [[80.0, 2.0], [80.0, 6.0], [80.0, 10.0]]);
        assert_eq!(points[45], [0.0, 2.0]);
        // More points than the line has pixels.
        let points = along(&[[3, 3], [4, 3]], 8);
        assert_eq!(points.len(), 8);
        assert!(points.iter().all(|p| (3.0..=4.0).contains(&p[0]) && p[1] == 3.0), "{points:?}");
    }

    #[test]
    fn degenerate_shapes_are_no_error() {
        assert!(along(&[], 9).is_empty() && along(&[[4, 4]], 9).is_empty() && along(&[[4, 4]; 3], 9).is_empty());
        let none = ShapeContexts::of(Vec::new());
        assert_eq!(none.assign(&none.turned(3)), None);
        assert_eq!(none.least_cost(&none.turned(3), 1), f32::INFINITY);
        for points in [vec![[1.0, 2.0]], vec![[1.0, 2.0]; 2], vec![[1.0, 2.0]; 5]] {
            let n = points.len();
            let contexts = ShapeContexts::of(points);
            let (mut columns, cost) = contexts.assign(&contexts.turned(5)).unwrap();
            columns.sort_unstable();
            assert_eq!((columns, cost), ((0..n).collect(), 0.0));
        }
        let two = ShapeContexts::of(vec![[0.0, 0.0], [3.0, 0.0]]);
        assert_eq!(two.assign(&none.turned(0)), None);
        // Among many points, two that are one.
        let mut points = shape(&L);
        points[9] = points[8];
        let contexts = ShapeContexts::of(points);
        let (_, cost) = contexts.assign(&contexts.turned(0)).unwrap();
        assert!(cost.abs() < 1e-6, "{cost}");
    }
}
