//! The lens model of OpenCV on the normalised image plane: radial k1, k2, k3 and tangential p1, p2.
//!
//! In: a ray (x, y) = (X/Z, Y/Z) of the ideal pinhole. Out: where the lens puts it, and back. With r^2 = x^2 + y^2
//! (OpenCV 4.6, documentation of module calib3d, "Detailed Description"):
//!
//! ```text
//! R   = 1 + k1 r^2 + k2 r^4 + k3 r^6
//! x'' = x R + 2 p1 x y + p2 (r^2 + 2 x^2)
//! y'' = y R + p1 (r^2 + 2 y^2) + 2 p2 x y
//! ```

/// Newton steps before the inverse is given up; from a good start it takes three to five.
const MAX_STEPS: usize = 50;
/// Where the determinant of the Jacobian falls below this, the lens is about to fold: it is 1 on the optical axis.
pub(crate) const LEAST_DETERMINANT: f64 = 0.01;

/// Coefficients of the lens.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Lens {
    pub(crate) k1: f64,
    pub(crate) k2: f64,
    pub(crate) p1: f64,
    pub(crate) p2: f64,
    pub(crate) k3: f64,
}

/// The Jacobian of the lens, which is symmetric: d x''/d x, d x''/d y = d y''/d x, d y''/d y.
#[derive(Debug, Clone, Copy)]
struct Jacobian {
    xx: f64,
    xy: f64,
    yy: f64,
}

impl Lens {
    /// Whether all coefficients are zero.
    pub(crate) fn is_ideal(&self) -> bool {
        [self.k1, self.k2, self.p1, self.p2, self.k3].iter().all(|&c| c == 0.0)
    }

    /// Where the lens puts a ray.
    pub(crate) fn distort(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3));
        [
            x * radial + 2.0 * self.p1 * x * y + self.p2 * (r2 + 2.0 * x * x),
            y * radial + self.p1 * (r2 + 2.0 * y * y) + 2.0 * self.p2 * x * y,
        ]
    }

    fn jacobian(&self, [x, y]: [f64; 2]) -> Jacobian {
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3));
        let slope = self.k1 + r2 * (2.0 * self.k2 + r2 * 3.0 * self.k3);
        Jacobian {
            xx: radial + 2.0 * x * x * slope + 2.0 * self.p1 * y + 6.0 * self.p2 * x,
            xy: 2.0 * x * y * slope + 2.0 * self.p1 * x + 2.0 * self.p2 * y,
            yy: radial + 2.0 * y * y * slope + 6.0 * self.p1 * y + 2.0 * self.p2 * x,
        }
    }

    /// Determinant of the Jacobian at a ray; 1 on the axis, 0 where the lens folds.
    pub(crate) fn determinant(&self, ray: [f64; 2]) -> f64 {
        let j = self.jacobian(ray);
        j.xx * j.yy - j.xy * j.xy
    }

    /// The ray that the lens puts at `target`, by Newton's method from `start`.
    ///
    /// `None` if it does not converge to `tolerance`, or to a ray behind a fold of the lens.
    pub(crate) fn undistort_from(&self, start: [f64; 2], target: [f64; 2], tolerance: f64) -> Option<[f64; 2]> {
        let mut ray = start;
        let mut error = f64::INFINITY;
        for _ in 0..MAX_STEPS {
            let [x, y] = self.distort(ray);
            let (dx, dy) = (target[0] - x, target[1] - y);
            let last = error;
            error = dx.hypot(dy);
            // One more step after the tolerance is met costs little and gives all digits.
            if error == 0.0 || (error <= tolerance && last <= tolerance) {
                break;
            }
            let j = self.jacobian(ray);
            let determinant = j.xx * j.yy - j.xy * j.xy;
            let step = [(j.yy * dx - j.xy * dy) / determinant, (j.xx * dy - j.xy * dx) / determinant];
            if !(step[0].is_finite() && step[1].is_finite()) {
                return None;
            }
            ray = [ray[0] + step[0], ray[1] + step[1]];
        }
        (error <= tolerance && self.determinant(ray) > LEAST_DETERMINANT).then_some(ray)
    }

    /// The ray that the lens puts at `target`, followed from the axis outwards in `steps` steps so that it stays on
    /// this side of every fold. Calls `visit` with each ray on the way.
    pub(crate) fn follow(
        &self,
        target: [f64; 2],
        steps: u32,
        tolerance: f64,
        mut visit: impl FnMut([f64; 2]),
    ) -> Option<[f64; 2]> {
        let mut ray = [0.0; 2];
        for step in 1..=steps {
            let share = f64::from(step) / f64::from(steps);
            ray = self.undistort_from(ray, target.map(|t| t * share), tolerance)?;
            visit(ray);
        }
        Some(ray)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LENS: Lens = Lens { k1: -0.28, k2: 0.09, p1: 0.002, p2: -0.0015, k3: 0.01 };

    #[test]
    fn the_jacobian_is_the_derivative() {
        let (ray, h) = ([0.31, -0.22], 1e-6);
        let j = LENS.jacobian(ray);
        let slope = |dx: f64, dy: f64| {
            let a = LENS.distort([ray[0] + dx, ray[1] + dy]);
            let b = LENS.distort([ray[0] - dx, ray[1] - dy]);
            [(a[0] - b[0]) / (2.0 * h), (a[1] - b[1]) / (2.0 * h)]
        };
        let (by_x, by_y) = (slope(h, 0.0), slope(0.0, h));
        for (computed, expected) in [(j.xx, by_x[0]), (j.xy, by_x[1]), (j.xy, by_y[0]), (j.yy, by_y[1])] {
            assert!((computed - expected).abs() < 1e-8, "{computed} {expected}");
        }
    }

    #[test]
    fn a_ray_behind_the_fold_is_not_given() {
        // r (1 - 0.5 r^2) grows up to r = 0.816 and is 0.544 there; 0.6 is reached by no ray before the fold.
        let lens = Lens { k1: -0.5, k2: 0.0, p1: 0.0, p2: 0.0, k3: 0.0 };
        assert!(lens.follow([0.6, 0.0], 16, 1e-12, |_| {}).is_none());
        let [x, _] = lens.follow([0.5, 0.0], 16, 1e-12, |_| {}).unwrap();
        assert!(x < 0.816 && (x * (1.0 - 0.5 * x * x) - 0.5).abs() < 1e-12, "{x}");
        // A start behind the fold leads to the other ray of the same pixel, which is refused.
        assert!(lens.undistort_from([1.2, 0.0], [0.5, 0.0], 1e-12).is_none());
    }
}
