//! From corners in images to the intrinsics of a camera and the pose of a board.

use nalgebra::{Isometry3, Point3, Translation3, Vector3};
use opencv::calib3d;
use opencv::core::{Mat, Point2f, Point3f, Size, TermCriteria, TermCriteria_Type, Vec3d, Vector, no_array};
use opencv::prelude::*;

use super::board::Board;
use super::find::View;
use super::{CalibrateError, LEAST_VIEWS};
use crate::intrinsics::{IntrinsicParams, Intrinsics};

/// Largest mean reprojection error of a solution that can be meant, px: beyond it another board was photographed.
const MOST_ERROR_PX: f64 = 5.0;
/// Largest standard deviation of a focal length, as a share of it.
const MOST_FOCAL_DEVIATION: f64 = 0.05;
/// Least angle between the two boards that differ most, degrees: of parallel boards, a near one looks like a long lens.
const LEAST_TURN_DEG: f64 = 5.0;
/// fx / fy of a lens that exists, least and most.
const ASPECT: (f64, f64) = (0.5, 2.0);

/// The intrinsics of a camera, and how well they explain the images.
#[derive(Debug, Clone, PartialEq)]
pub struct Calibration {
    /// Focal lengths, principal point and lens.
    pub intrinsics: Intrinsics,
    /// Standard deviations of fx, fy, cx and cy, px, from the scatter of the corners.
    pub deviations_px: [f64; 4],
    /// The board in each image, in the order of the views.
    pub views: Vec<BoardPose>,
    /// Mean distance between the corners found and those computed, over all corners, px.
    pub mean_error_px: f64,
}

/// Where a board was, and how well that explains its corners.
#[derive(Debug, Clone, PartialEq)]
pub struct BoardPose {
    /// The pose, mm.
    pub camera_from_board: Isometry3<f64>,
    /// Corner found less corner computed, px, in the order of the view.
    pub residuals_px: Vec<[f64; 2]>,
    /// Mean length of these.
    pub mean_error_px: f64,
    /// Greatest length of these.
    pub max_error_px: f64,
}

/// Solves for the intrinsics of the camera that took the views (OpenCV's `calibrateCamera`: Zhang 2000 for a start,
/// then Levenberg-Marquardt on all corners, poses and five coefficients of the lens).
///
/// # Errors
/// [`CalibrateError::TooFewViews`], [`CalibrateError::Sizes`]; [`CalibrateError::Impossible`] and
/// [`CalibrateError::Intrinsics`] for a result that is no camera.
pub fn calibrate(views: &[View], board: &Board) -> Result<Calibration, CalibrateError> {
    let Some(first) = views.first().filter(|_| views.len() >= LEAST_VIEWS) else {
        return Err(CalibrateError::TooFewViews { found: views.len(), board: board.to_string() });
    };
    if let Some(other) = views.iter().find(|view| view.size_px != first.size_px) {
        return Err(CalibrateError::Sizes {
            first: first.path.clone(),
            first_px: first.size_px,
            other: other.path.clone(),
            other_px: other.size_px,
        });
    }
    let [width_px, height_px] = first.size_px;
    let mut board_points = Vector::<Vector<Point3f>>::new();
    let mut image_points = Vector::<Vector<Point2f>>::new();
    for view in views {
        board_points.push(board_corners(view, board));
        image_points.push(image_corners(view));
    }
    let (mut matrix, mut lens) = (Mat::default(), Mat::default());
    let (mut rotations, mut translations) = (Vector::<Mat>::new(), Vector::<Mat>::new());
    let mut deviations = Mat::default();
    calib3d::calibrate_camera_extended(
        &board_points,
        &image_points,
        Size::new(width_px as i32, height_px as i32),
        &mut matrix,
        &mut lens,
        &mut rotations,
        &mut translations,
        &mut deviations,
        &mut no_array(),
        &mut no_array(),
        0,
        until_settled()?,
    )?;
    let (matrix, lens) = (numbers(&matrix)?, numbers(&lens)?);
    let (&[fx_px, _, cx_px, _, fy_px, cy_px, ..], &[k1, k2, p1, p2, k3, ..]) = (&matrix[..], &lens[..]) else {
        return Err(impossible(format!("{} and {} numbers of camera and lens", matrix.len(), lens.len())));
    };
    let intrinsics =
        Intrinsics::new(IntrinsicParams { width_px, height_px, fx_px, fy_px, cx_px, cy_px, k1, k2, p1, p2, k3 })?;
    let deviations_px = match numbers(&deviations)?[..] {
        [fx, fy, cx, cy, ..] => [fx, fy, cx, cy],
        _ => return Err(impossible("no standard deviations".to_owned())),
    };
    let mut poses = Vec::new();
    for ((view, rotation), translation) in views.iter().zip(rotations.iter()).zip(translations.iter()) {
        poses.push(BoardPose::new(&intrinsics, pose(&rotation, &translation)?, view, board)?);
    }
    let lengths = || poses.iter().flat_map(|pose| &pose.residuals_px).map(|r| r[0].hypot(r[1]));
    let mean_error_px = lengths().sum::<f64>() / lengths().count().max(1) as f64;
    // NaN is in no range.
    if !(0.0..=MOST_ERROR_PX).contains(&mean_error_px) {
        return Err(impossible(format!("the mean reprojection error is {mean_error_px:.1} px")));
    }
    let normals: Vec<_> = poses.iter().map(|pose| pose.camera_from_board.rotation * Vector3::z()).collect();
    let pairs = normals.iter().enumerate().flat_map(|(i, a)| normals[..i].iter().map(move |b| a.angle(b)));
    let turn_deg = pairs.fold(0.0, f64::max).to_degrees();
    if turn_deg < LEAST_TURN_DEG {
        return Err(impossible(format!(
            "the board is tilted alike in all images, by {turn_deg:.1} deg between the two that differ most; at least \
             {LEAST_TURN_DEG} are needed"
        )));
    }
    if !(ASPECT.0..=ASPECT.1).contains(&(fx_px / fy_px)) {
        return Err(impossible(format!("the focal lengths are {fx_px:.0} and {fy_px:.0} px")));
    }
    let focal_px = [fx_px, fy_px];
    if !focal_px.iter().zip(deviations_px).all(|(focal, deviation)| deviation <= MOST_FOCAL_DEVIATION * focal) {
        let [dx, dy, ..] = deviations_px;
        return Err(impossible(format!(
            "the images leave the focal lengths open, {fx_px:.0} +- {dx:.0} and {fy_px:.0} +- {dy:.0} px"
        )));
    }
    Ok(Calibration { intrinsics, deviations_px, views: poses, mean_error_px })
}

/// The pose of the board in one image of a known camera (IPPE for a start: Collins and Bartoli 2014, then
/// Levenberg-Marquardt on the corners).
///
/// # Errors
/// [`CalibrateError::Impossible`] for corners of which no pose can be told, as on a line.
pub fn board_pose(intrinsics: &Intrinsics, view: &View, board: &Board) -> Result<BoardPose, CalibrateError> {
    let expected = intrinsics.size_px();
    if view.size_px != expected {
        return Err(impossible(format!(
            "{} has {:?} px and the camera {expected:?}",
            view.path.display(),
            view.size_px
        )));
    }
    let p = intrinsics.params();
    let matrix = Mat::from_slice_2d(&[[p.fx_px, 0.0, p.cx_px], [0.0, p.fy_px, p.cy_px], [0.0, 0.0, 1.0]])?;
    let lens = [p.k1, p.k2, p.p1, p.p2, p.k3];
    let lens = Mat::from_slice(&lens)?;
    let (corners, found) = (board_corners(view, board), image_corners(view));
    let (mut rotation, mut translation) = (Mat::default(), Mat::default());
    let flags = calib3d::SOLVEPNP_IPPE;
    let solved = calib3d::solve_pnp(&corners, &found, &matrix, &lens, &mut rotation, &mut translation, false, flags)?;
    if !solved {
        return Err(impossible(format!("no pose of the board explains {}", view.path.display())));
    }
    let criteria = until_settled()?;
    calib3d::solve_pnp_refine_lm(&corners, &found, &matrix, &lens, &mut rotation, &mut translation, criteria)?;
    BoardPose::new(intrinsics, pose(&rotation, &translation)?, view, board)
}

/// The pose of the camera in the world of a board that lies on the table: origin in corner 0, x and y along the board,
/// z = 0 on the table and so `-board_thickness_mm` below the printed side.
pub fn world_from_camera(board: &BoardPose, board_thickness_mm: f64) -> Isometry3<f64> {
    Translation3::new(0.0, 0.0, board_thickness_mm) * board.camera_from_board.inverse()
}

impl BoardPose {
    fn new(
        intrinsics: &Intrinsics,
        camera_from_board: Isometry3<f64>,
        view: &View,
        board: &Board,
    ) -> Result<Self, CalibrateError> {
        let mut residuals_px = Vec::new();
        for corner in &view.corners {
            let Some([x, y]) = board.corner_mm(corner.index) else {
                return Err(impossible(format!("the board has no corner {}", corner.index)));
            };
            let point = camera_from_board * Point3::new(x, y, 0.0);
            if point.z <= 0.0 {
                return Err(impossible(format!("the board of {} lies behind the camera", view.path.display())));
            }
            let [u, v] = intrinsics
                .image_from_ray([point.x / point.z, point.y / point.z])
                .map_err(|source| CalibrateError::Projection { path: view.path.clone(), source })?;
            residuals_px.push([corner.px[0] - u, corner.px[1] - v]);
        }
        let lengths = || residuals_px.iter().map(|r: &[f64; 2]| r[0].hypot(r[1]));
        let mean_error_px = lengths().sum::<f64>() / residuals_px.len().max(1) as f64;
        let max_error_px = lengths().fold(0.0, f64::max);
        Ok(Self { camera_from_board, residuals_px, mean_error_px, max_error_px })
    }
}

fn impossible(reason: String) -> CalibrateError {
    CalibrateError::Impossible { reason }
}

fn board_corners(view: &View, board: &Board) -> Vector<Point3f> {
    let corners = view.corners.iter().filter_map(|corner| board.corner_mm(corner.index));
    corners.map(|[x, y]| Point3f::new(x as f32, y as f32, 0.0)).collect()
}

fn image_corners(view: &View) -> Vector<Point2f> {
    view.corners.iter().map(|corner| Point2f::new(corner.px[0] as f32, corner.px[1] as f32)).collect()
}

fn until_settled() -> opencv::Result<TermCriteria> {
    TermCriteria::new(TermCriteria_Type::COUNT as i32 | TermCriteria_Type::EPS as i32, 200, 1e-12)
}

/// A matrix of doubles, row by row.
fn numbers(matrix: &Mat) -> opencv::Result<Vec<f64>> {
    Ok(matrix.data_typed::<f64>()?.to_vec())
}

/// The pose that OpenCV gives as a vector along the axis, as long as the angle, and a translation.
fn pose(rotation: &Mat, translation: &Mat) -> Result<Isometry3<f64>, CalibrateError> {
    let vector = |matrix: &Mat| -> Result<Vector3<f64>, CalibrateError> {
        let numbers = if matrix.channels() == 3 { matrix.at::<Vec3d>(0)?.0.to_vec() } else { numbers(matrix)? };
        match numbers[..] {
            [x, y, z] if x.is_finite() && y.is_finite() && z.is_finite() => Ok(Vector3::new(x, y, z)),
            _ => Err(impossible(format!("a pose of the board is {numbers:?}"))),
        }
    };
    Ok(Isometry3::new(vector(translation)?, vector(rotation)?))
}
