//! RANSAC homographies of feature matches (section 5.1 of the paper), and which of them can be views of a part.
//!
//! In: pairs of points in units of the same length. Out: the homography and the pairs that agree with it, or none. RANSAC stops after 2000 draws;
//! time is linear in the number of pairs.

use nalgebra::{Matrix3, SMatrix, SVector, Vector3};
use opencv::calib3d;
use opencv::core::{Mat, Point2f, Vector};
use opencv::prelude::*;

use crate::RecognizeError;

/// How far the scales of a homography may be from 1. Beyond, it is seen from so low, or so sheared, that no camera over a
/// table sees it so; few points leave it some freedom.
const MAX_STRETCH: f64 = 1.6;
/// Points that spread across by less than this share of their spread along lie on a line.
const LINE: f64 = 0.1;

/// What became of the search for a homography.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Found {
    /// There is none: fewer than four points, points on a line, not finite, or nothing that agrees.
    Degenerate,
    /// It mirrors, or shears, or its scale is not 1.
    NoView,
    /// It can be a view.
    View {
        /// The second points from the first.
        homography: Matrix3<f64>,
        /// Which pairs agree with it.
        agree: Vec<bool>,
    },
}

/// The homography of scale 1 on which most pairs agree to `tolerance`.
///
/// # Errors
/// OpenCV failed; of degenerate points it does not come to that.
pub(crate) fn ransac(from: &[[f64; 2]], to: &[[f64; 2]], tolerance: f64) -> Result<Found, RecognizeError> {
    let is_finite = |points: &[[f64; 2]]| points.iter().flatten().all(|c| c.is_finite());
    if from.len() < 4 || from.len() != to.len() || !is_finite(from) || !is_finite(to) {
        return Ok(Found::Degenerate);
    }
    let points = |points: &[[f64; 2]]| -> Vector<Point2f> {
        points.iter().map(|&[x, y]| Point2f::new(x as f32, y as f32)).collect()
    };
    let mut agree = Mat::default();
    let matrix =
        calib3d::find_homography(&points(from), &points(to), &mut agree, calib3d::RANSAC, tolerance).map_err(failed)?;
    // Of points on a line OpenCV makes an empty matrix.
    if matrix.empty() || agree.empty() {
        return Ok(Found::Degenerate);
    }
    let homography = Matrix3::from_row_iterator(matrix.data_typed::<f64>().map_err(failed)?.iter().copied());
    let agree: Vec<bool> = agree.data_typed::<u8>().map_err(failed)?.iter().map(|&bit| bit != 0).collect();
    let members: Vec<&[f64; 2]> =
        from.iter().zip(&agree).filter(|(_, agrees)| **agrees).map(|(point, _)| point).collect();
    if members.len() < 4 || is_line(&members) || !homography.iter().all(|value| value.is_finite()) {
        return Ok(Found::Degenerate);
    }
    if is_view(&homography, mean(&members)) { Ok(Found::View { homography, agree }) } else { Ok(Found::NoView) }
}

fn mean(points: &[&[f64; 2]]) -> [f64; 2] {
    [0, 1].map(|axis| points.iter().map(|point| point[axis]).sum::<f64>() / points.len() as f64)
}

/// Whether points spread so little across their longest axis that their homography is a guess.
fn is_line(points: &[&[f64; 2]]) -> bool {
    let center = mean(points);
    let sum = |of: fn(f64, f64) -> f64| points.iter().map(|p| of(p[0] - center[0], p[1] - center[1])).sum::<f64>();
    let (xx, yy, xy) = (sum(|x, _| x * x), sum(|_, y| y * y), sum(|x, y| x * y));
    let (half, apart) = ((xx + yy) / 2.0, ((xx - yy) / 2.0).hypot(xy));
    half - apart < LINE * LINE * (half + apart)
}

/// An error of OpenCV as one of the recognition.
pub(crate) fn failed(error: opencv::Error) -> RecognizeError {
    RecognizeError::OpenCv(error.to_string())
}

/// Whether a homography neither mirrors nor shears near a point, and leaves lengths about what they are.
fn is_view(homography: &Matrix3<f64>, [x, y]: [f64; 2]) -> bool {
    let at = homography * Vector3::new(x, y, 1.0);
    if at.z.abs() < 1e-9 {
        return false;
    }
    // Rows of the derivative of (u, v) by (x, y).
    let row = |i: usize, value: f64| [0, 1].map(|j| (homography[(i, j)] - value * homography[(2, j)]) / at.z);
    let ([a, b], [c, d]) = (row(0, at.x / at.z), row(1, at.y / at.z));
    // A 2 x 2 matrix is a similarity plus a mirrored one; its singular values are the sum and difference of their scales.
    let (kept, mirrored) = ((a + d).hypot(c - b) / 2.0, (a - d).hypot(c + b) / 2.0);
    kept - mirrored > 1.0 / MAX_STRETCH && kept + mirrored < MAX_STRETCH
}

/// The homography through four pairs of points, of which no three lie on a line; `None` when they do.
pub(crate) fn through(from: &[[f64; 2]; 4], to: &[[f64; 2]; 4]) -> Option<Matrix3<f64>> {
    let mut left = SMatrix::<f64, 8, 8>::zeros();
    let mut right = SVector::<f64, 8>::zeros();
    for (i, ([x, y], [u, v])) in from.iter().zip(to).enumerate() {
        left.row_mut(2 * i).copy_from_slice(&[*x, *y, 1.0, 0.0, 0.0, 0.0, -u * x, -u * y]);
        left.row_mut(2 * i + 1).copy_from_slice(&[0.0, 0.0, 0.0, *x, *y, 1.0, -v * x, -v * y]);
        (right[2 * i], right[2 * i + 1]) = (*u, *v);
    }
    let h = left.full_piv_lu().solve(&right)?;
    let homography = Matrix3::new(h[0], h[1], h[2], h[3], h[4], h[5], h[6], h[7], 1.0);
    homography.iter().all(|value| value.is_finite()).then_some(homography)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Some points that are on no line, and where a tilted view puts them.
    fn view(n: usize) -> (Vec<[f64; 2]>, Vec<[f64; 2]>) {
        let from: Vec<[f64; 2]> = (0..n).map(|i| [(i * 37 % 61) as f64, (i * 23 % 47) as f64]).collect();
        let (sin, cos) = 0.7f64.sin_cos();
        let to = |&[x, y]: &[f64; 2]| {
            let w = 1.0 + 2e-4 * x;
            [(cos * x - sin * y + 300.0) / w, (sin * x + cos * y - 40.0) / w]
        };
        let seen = from.iter().map(to).collect();
        (from, seen)
    }

    fn members(found: Found) -> Vec<usize> {
        let Found::View { agree, .. } = found else { panic!("{found:?}") };
        (0..agree.len()).filter(|&i| agree[i]).collect()
    }

    #[test]
    fn what_agrees_is_told_from_what_does_not() {
        let (from, mut to) = view(20);
        for i in [3, 8, 9, 15] {
            to[i][0] += 9.0 + i as f64;
        }
        let expected: Vec<usize> = (0..20).filter(|i| ![3, 8, 9, 15].contains(i)).collect();
        assert_eq!(members(ransac(&from, &to, 1.0).unwrap()), expected);
    }

    #[test]
    fn a_thousand_pairs_are_no_more_than_four() {
        let (from, to) = view(4);
        assert_eq!(members(ransac(&from, &to, 1.0).unwrap()).len(), 4);
        let (from, to) = view(5000);
        assert_eq!(members(ransac(&from, &to, 1.0).unwrap()).len(), 5000);
    }

    #[test]
    fn degenerate_points_have_none_and_are_no_error() {
        let degenerate = |from: &[[f64; 2]], to: &[[f64; 2]]| assert_eq!(ransac(from, to, 1.0), Ok(Found::Degenerate));
        let (from, to) = view(3);
        degenerate(&[], &[]);
        degenerate(&from, &to);
        let line: Vec<[f64; 2]> = (0..30).map(|i| [f64::from(i), 2.0 * f64::from(i)]).collect();
        degenerate(&line, &line);
        let lettering: Vec<[f64; 2]> = (0..30).map(|i| [f64::from(i), f64::from(i % 2)]).collect();
        degenerate(&lettering, &lettering);
        degenerate(&[[5.0, 6.0]; 9], &[[1.0, 2.0]; 9]);
        let (from, mut to) = view(9);
        to[4][1] = f64::NAN;
        degenerate(&from, &to);
        degenerate(&from, &to[..8]);
    }

    #[test]
    fn mirrors_shears_and_other_scales_are_no_views() {
        let (from, _) = view(12);
        let no_view = |to: fn(&[f64; 2]) -> [f64; 2]| {
            let to: Vec<[f64; 2]> = from.iter().map(to).collect();
            assert_eq!(ransac(&from, &to, 1.0), Ok(Found::NoView));
        };
        no_view(|[x, y]| [-x, *y]);
        no_view(|[x, y]| [x + y, *y]);
        no_view(|[x, y]| [2.0 * x, 2.0 * y]);
        no_view(|[x, y]| [*x, 0.5 * y]);
    }

    #[test]
    fn four_corners_have_one() {
        let (from, to) =
            ([[0.0, 0.0], [9.0, 0.0], [9.0, 5.0], [0.0, 5.0]], [[1.0, 1.0], [8.0, 2.0], [9.0, 7.0], [0.0, 6.0]]);
        let homography = through(&from, &to).unwrap();
        for ([x, y], [u, v]) in from.iter().zip(&to) {
            let at = homography * Vector3::new(*x, *y, 1.0);
            assert!((at.x / at.z - u).abs() < 1e-9 && (at.y / at.z - v).abs() < 1e-9);
        }
        assert_eq!(through(&[[0.0; 2]; 4], &to), None);
        assert_eq!(through(&from, &[[f64::NAN; 2]; 4]), None);
    }
}
