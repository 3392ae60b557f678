//! The rigid motion between two sets of points: where the robot stands, from points that it has touched.
//!
//! In: the same points in two frames, mm. Out: the rotation and translation with the least sum of squared distances, by
//! the singular values of their covariance (Kabsch 1976; Umeyama 1991, eqs 39 to 43, with scale 1).

use nalgebra::{Isometry3, Matrix3, Point3, Rotation3, Translation3, UnitQuaternion, Vector3};

/// Fewest points.
pub const LEAST_POINTS: usize = 3;
/// Least spread of the points across their best line, as a share of that along it: below it they do not say how the
/// table is turned about that line.
pub const LEAST_SPREAD: f64 = 0.05;

/// Largest coordinate, mm: a kilometre.
pub const MOST_COORDINATE_MM: f64 = 1e6;

/// A rigid motion and how well it fits.
#[derive(Debug, Clone, PartialEq)]
pub struct RigidFit {
    /// The motion from the first frame to the second, mm.
    pub second_from_first: Isometry3<f64>,
    /// Distance that is left at each point, mm.
    pub residuals_mm: Vec<f64>,
    /// Root of the mean square of these, mm.
    pub rms_mm: f64,
}

/// Why points do not tell a rigid motion.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum RigidFitError {
    /// Too few points.
    #[error("{points} points; at least {LEAST_POINTS} are needed")]
    TooFew {
        /// How many.
        points: usize,
    },
    /// The two lists do not belong together.
    #[error("{first} points in one frame and {second} in the other; both need the same points in the same order")]
    Unequal {
        /// Points in the first frame.
        first: usize,
        /// Points in the second.
        second: usize,
    },
    /// A coordinate is NaN or impossibly far away.
    #[error("point {index} is {point_mm:?} mm; allowed: coordinates up to {MOST_COORDINATE_MM} mm")]
    Coordinate {
        /// Which, from 0.
        index: usize,
        /// Its coordinates.
        point_mm: [f64; 3],
    },
    /// The points lie on one line, or on one spot.
    #[error(
        "the points lie almost on a line: they spread {across_mm:.2} mm across it and {along_mm:.2} mm along it; \
         allowed: at least {LEAST_SPREAD} of the length across, so choose a wider triangle"
    )]
    Collinear {
        /// Root of the mean square distance from the best line, mm.
        across_mm: f64,
        /// And along it.
        along_mm: f64,
    },
    /// The points fit only if left and right are exchanged, or the table is turned upside down.
    #[error(
        "the points are mirrored: they fit only with the table upside down; are two points exchanged, or has an axis \
         the wrong sign?"
    )]
    Mirrored,
}

/// Fits the motion that takes `first_mm` to `second_mm`, both right-handed with z up: the table is not turned over.
///
/// # Errors
/// [`RigidFitError`]: fewer than three points, lists of different length, coordinates that are not finite or beyond
/// [`MOST_COORDINATE_MM`], points on a line, mirrored points. Points of one plane fit their mirror image as well when the
/// plane is turned over; that is told by z, which points up in both frames.
pub fn fit_rigid(first_mm: &[[f64; 3]], second_mm: &[[f64; 3]]) -> Result<RigidFit, RigidFitError> {
    if first_mm.len() != second_mm.len() {
        return Err(RigidFitError::Unequal { first: first_mm.len(), second: second_mm.len() });
    }
    if first_mm.len() < LEAST_POINTS {
        return Err(RigidFitError::TooFew { points: first_mm.len() });
    }
    for points in [first_mm, second_mm] {
        let in_reach = |c: &f64| c.abs() <= MOST_COORDINATE_MM;
        if let Some(index) = points.iter().position(|p| !p.iter().all(in_reach)) {
            return Err(RigidFitError::Coordinate { index, point_mm: points[index] });
        }
    }
    let (first_centre, first) = centred(first_mm);
    let (second_centre, second) = centred(second_mm);
    let flatness = spread(&first)?.max(spread(&second)?);

    let covariance: Matrix3<f64> = second.iter().zip(&first).map(|(b, a)| b * a.transpose()).sum();
    let nalgebra::SVD { u: Some(u), v_t: Some(v_t), .. } = covariance.svd(true, true) else {
        return Err(RigidFitError::Mirrored);
    };
    let sign = (u * v_t).determinant().signum();
    if sign < 0.0 && flatness > LEAST_SPREAD {
        return Err(RigidFitError::Mirrored);
    }
    let rotation = u * Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, sign)) * v_t;
    if rotation[(2, 2)] < 0.0 {
        return Err(RigidFitError::Mirrored);
    }
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rotation));
    let translation = Translation3::from(second_centre - rotation * first_centre);
    let motion = Isometry3::from_parts(translation, rotation);
    let distance = |(a, b): (&[f64; 3], &[f64; 3])| (motion * Point3::from(*a) - Point3::from(*b)).norm();
    let residuals_mm: Vec<f64> = first_mm.iter().zip(second_mm).map(distance).collect();
    let rms_mm = (residuals_mm.iter().map(|r| r * r).sum::<f64>() / residuals_mm.len() as f64).sqrt();
    Ok(RigidFit { second_from_first: motion, residuals_mm, rms_mm })
}

/// The centre of the points, and the points about it.
fn centred(points_mm: &[[f64; 3]]) -> (Vector3<f64>, Vec<Vector3<f64>>) {
    let centre = points_mm.iter().map(|&p| Vector3::from(p)).sum::<Vector3<f64>>() / points_mm.len() as f64;
    (centre, points_mm.iter().map(|&p| Vector3::from(p) - centre).collect())
}

/// Spread out of the best plane as a share of that along the best line.
fn spread(centred: &[Vector3<f64>]) -> Result<f64, RigidFitError> {
    let scatter: Matrix3<f64> = centred.iter().map(|p| p * p.transpose()).sum();
    let mut spreads = (scatter / centred.len() as f64).symmetric_eigenvalues().map(|v| v.max(0.0).sqrt());
    spreads.as_mut_slice().sort_by(f64::total_cmp);
    let (out_of_plane, across_mm, along_mm) = (spreads[0], spreads[1], spreads[2]);
    // `<=`: one spot has 0 in both.
    if across_mm <= LEAST_SPREAD * along_mm {
        return Err(RigidFitError::Collinear { across_mm, along_mm });
    }
    Ok(out_of_plane / along_mm)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const TOUCHED: [[f64; 3]; 4] = [[0.0, 0.0, 3.0], [160.0, 0.0, 3.0], [160.0, 100.0, 3.0], [0.0, 100.0, 3.0]];

    fn moved(points: &[[f64; 3]], motion: &Isometry3<f64>) -> Vec<[f64; 3]> {
        points.iter().map(|&p| (motion * Point3::from(p)).coords.into()).collect()
    }

    #[test]
    fn too_few_on_a_line_mirrored_and_not_finite_are_refused() {
        let message = |a: &[[f64; 3]], b: &[[f64; 3]]| fit_rigid(a, b).unwrap_err().to_string();
        assert_eq!(message(&TOUCHED[..2], &TOUCHED[..2]), "2 points; at least 3 are needed");
        assert!(message(&TOUCHED, &TOUCHED[..3]).contains("4 points in one frame and 3 in the other"));
        let mut broken = TOUCHED;
        broken[2][1] = f64::NAN;
        assert!(message(&TOUCHED, &broken).starts_with("point 2 is [160.0, NaN, 3.0] mm"));
        broken[2][1] = 1e300;
        assert!(message(&broken, &TOUCHED).contains("allowed: coordinates up to 1000000 mm"));
        let line = [[0.0, 0.0, 0.0], [100.0, 2.0, 0.0], [200.0, 0.0, 0.0]];
        assert!(
            message(&line, &line).contains("almost on a line: they spread 0.94 mm across it and 81.65 mm along it")
        );
        let spot = [[5.0, 5.0, 5.0]; 4];
        assert!(message(&spot, &spot).contains("almost on a line"));
        // An axis with the wrong sign: on the table, and with a point above it.
        let mirror = |points: &[[f64; 3]]| points.iter().map(|&[x, y, z]| [x, -y, z]).collect::<Vec<_>>();
        assert_eq!(fit_rigid(&TOUCHED, &mirror(&TOUCHED)).unwrap_err(), RigidFitError::Mirrored);
        let mut high = TOUCHED;
        high[2][2] = 80.0;
        assert_eq!(fit_rigid(&high, &mirror(&high)).unwrap_err(), RigidFitError::Mirrored);
    }

    #[test]
    fn the_residual_names_the_point_that_was_missed() {
        let motion = Isometry3::new(Vector3::new(400.0, -100.0, 20.0), Vector3::new(0.01, 0.0, 1.5));
        let mut base = moved(&TOUCHED, &motion);
        base[1][0] += 4.0;
        let fit = fit_rigid(&TOUCHED, &base).unwrap();
        let worst = (0..4).max_by(|&a, &b| fit.residuals_mm[a].total_cmp(&fit.residuals_mm[b]));
        assert_eq!(worst, Some(1), "{fit:?}");
        assert!((0.5..3.0).contains(&fit.rms_mm), "{fit:?}");
    }

    proptest! {
        #[test]
        fn the_motion_is_found(
            x in -900.0f64..900.0, y in -900.0f64..900.0, z in -900.0f64..900.0,
            tilt_x in -1.0f64..1.0, tilt_y in -1.0f64..1.0, yaw in -3.1f64..3.1, high in prop::bool::ANY,
        ) {
            let rotation = UnitQuaternion::from_euler_angles(tilt_x, tilt_y, yaw);
            let motion = Isometry3::from_parts(Translation3::new(x, y, z), rotation);
            let mut points = TOUCHED.to_vec();
            points[0][2] = if high { 120.0 } else { 3.0 };
            let fit = fit_rigid(&points, &moved(&points, &motion)).unwrap();
            prop_assert!(fit.rms_mm < 1e-9, "{fit:?}");
            prop_assert!((fit.second_from_first.to_homogeneous() - motion.to_homogeneous()).amax() < 1e-9);
        }
    }
}
