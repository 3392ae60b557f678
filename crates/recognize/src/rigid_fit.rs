//! Least-squares rigid motions of the plane, robust against outliers.
//!
//! In: pairs of points, mm. Out: rotation and translation. Closed form for one set of weights; O(n) an iteration.

/// Rotation by `angle_rad`, then translation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Rigid {
    /// Counter-clockwise in right-handed axes, rad, in (-pi, pi].
    pub(crate) angle_rad: f64,
    /// Where the origin comes to lie.
    pub(crate) at: [f64; 2],
}

/// A point and where it was found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Pair {
    pub(crate) from: [f64; 2],
    pub(crate) to: [f64; 2],
}

/// Iterations of [`Rigid::robust`]: the tolerance halves in each of the first ones.
const ROUNDS: usize = 10;

impl Rigid {
    /// The image of a point.
    pub(crate) fn apply(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        let (sin, cos) = self.angle_rad.sin_cos();
        [cos * x - sin * y + self.at[0], sin * x + cos * y + self.at[1]]
    }

    /// Distance of a pair from this motion.
    pub(crate) fn residual(&self, pair: &Pair) -> f64 {
        let [x, y] = self.apply(pair.from);
        (x - pair.to[0]).hypot(y - pair.to[1])
    }

    /// The motion that fits the pairs best in the weighted least-squares sense, and the scale that a similarity would
    /// have; `None` when fewer than two different points have weight.
    pub(crate) fn fit(pairs: &[Pair], weights: &[f64]) -> Option<(Self, f64)> {
        let weighted = || pairs.iter().zip(weights);
        let total: f64 = weights.iter().sum();
        let mean = |of: fn(&Pair) -> [f64; 2]| {
            let sum = |axis: usize| weighted().map(|(pair, w)| w * of(pair)[axis]).sum::<f64>();
            [sum(0) / total, sum(1) / total]
        };
        let (from, to) = (mean(|pair| pair.from), mean(|pair| pair.to));
        let (mut dot, mut cross, mut square) = (0.0, 0.0, 0.0);
        for (pair, w) in weighted() {
            let [ax, ay] = [pair.from[0] - from[0], pair.from[1] - from[1]];
            let [bx, by] = [pair.to[0] - to[0], pair.to[1] - to[1]];
            dot += w * (ax * bx + ay * by);
            cross += w * (ax * by - ay * bx);
            square += w * (ax * ax + ay * ay);
        }
        let scale = dot.hypot(cross) / square;
        let is_fit = total > 0.0 && square > 1e-12 * total && scale.is_finite() && scale > 1e-9;
        if !is_fit {
            return None;
        }
        let angle_rad = cross.atan2(dot);
        let turned = Self { angle_rad, at: [0.0; 2] }.apply(from);
        Some((Self { angle_rad, at: [to[0] - turned[0], to[1] - turned[1]] }, scale))
    }

    /// The motion that most pairs agree on to about `tolerance`, from a first guess that may be off by
    /// `first_tolerance`, and the scale of the similarity through those pairs.
    ///
    /// Tukey's biweight on residuals: pairs beyond the tolerance have no weight.
    pub(crate) fn robust(pairs: &[Pair], guess: Self, first_tolerance: f64, tolerance: f64) -> Option<(Self, f64)> {
        let mut within = first_tolerance.max(tolerance);
        let (mut motion, mut scale) = (guess, 1.0);
        let mut weights = vec![0.0; pairs.len()];
        for _ in 0..ROUNDS {
            for (weight, pair) in weights.iter_mut().zip(pairs) {
                let share = motion.residual(pair) / within;
                *weight = if share < 1.0 { (1.0 - share * share).powi(2) } else { 0.0 };
            }
            (motion, scale) = Self::fit(pairs, &weights)?;
            within = (within / 2.0).max(tolerance);
        }
        Some((motion, scale))
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn pairs(motion: &Rigid, points: &[[f64; 2]]) -> Vec<Pair> {
        points.iter().map(|&from| Pair { from, to: motion.apply(from) }).collect()
    }

    fn turn(a: f64, b: f64) -> f64 {
        (a - b).sin().atan2((a - b).cos()).abs()
    }

    proptest! {
        #[test]
        fn exact_pairs_give_the_exact_motion(
            angle_rad in -3.1f64..3.1,
            at in prop::array::uniform2(-500.0f64..500.0),
            points in prop::collection::vec(prop::array::uniform2(-50.0f64..50.0), 3..20),
        ) {
            let motion = Rigid { angle_rad, at };
            let pairs = pairs(&motion, &points);
            let (found, scale) = Rigid::fit(&pairs, &vec![1.0; pairs.len()]).unwrap();
            prop_assert!(turn(found.angle_rad, angle_rad) < 1e-6 && (scale - 1.0).abs() < 1e-6);
            prop_assert!(pairs.iter().all(|pair| found.residual(pair) < 1e-6));
        }
    }

    #[test]
    fn outliers_have_no_say() {
        let motion = Rigid { angle_rad: 2.0, at: [30.0, -70.0] };
        let points: Vec<[f64; 2]> = (0..20).map(|i| [f64::from(i % 5) * 9.0, f64::from(i / 5) * 7.0]).collect();
        let mut pairs = pairs(&motion, &points);
        for (i, pair) in pairs.iter_mut().enumerate().take(7) {
            pair.to[0] += 5.0 + i as f64;
        }
        let guess = Rigid { angle_rad: 2.1, at: [32.0, -72.0] };
        let (found, scale) = Rigid::robust(&pairs, guess, 8.0, 1.5).unwrap();
        assert!(turn(found.angle_rad, 2.0) < 1e-9 && (scale - 1.0).abs() < 1e-9, "{found:?}");
        assert!((found.at[0] - 30.0).abs() < 1e-9 && (found.at[1] + 70.0).abs() < 1e-9, "{found:?}");
    }

    #[test]
    fn the_scale_is_that_of_the_similarity() {
        let pairs = [[0.0, 0.0], [1.0, 0.0], [0.0, 2.0]].map(|from| Pair { from, to: from.map(|c| 1.25 * c) });
        assert!((Rigid::fit(&pairs, &[1.0; 3]).unwrap().1 - 1.25).abs() < 1e-12);
    }

    #[test]
    fn too_few_points_have_no_motion() {
        let one = Pair { from: [1.0, 2.0], to: [3.0, 4.0] };
        let guess = Rigid { angle_rad: 0.0, at: [2.0, 2.0] };
        assert_eq!(Rigid::fit(&[], &[]), None);
        assert_eq!(Rigid::fit(&[one], &[1.0]), None);
        assert_eq!(Rigid::fit(&[one; 5], &[1.0; 5]), None);
        assert_eq!(Rigid::robust(&[one; 5], guess, 5.0, 1.0), None);
        let far = Pair { from: [9.0, 0.0], to: [900.0, 0.0] };
        assert_eq!(Rigid::robust(&[one, far], guess, 5.0, 1.0), None);
    }
}
