//! How well a camera measures: a board of known size, laid on the table elsewhere.

use nalgebra::{Isometry3, Rotation2, Vector2};

use super::CalibrateError;
use super::board::Board;
use super::find::View;
use super::solve::{BoardPose, board_pose};
use crate::camera::Camera;
use crate::intrinsics::Intrinsics;

/// Mean, root mean square and greatest of some errors.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Spread {
    /// Mean.
    pub mean: f64,
    /// Root of the mean square.
    pub rms: f64,
    /// Greatest.
    pub max: f64,
}

impl Spread {
    fn new(errors: &[f64]) -> Self {
        let count = errors.len().max(1) as f64;
        Self {
            mean: errors.iter().sum::<f64>() / count,
            rms: (errors.iter().map(|e| e * e).sum::<f64>() / count).sqrt(),
            max: errors.iter().copied().fold(0.0, f64::max),
        }
    }
}

/// What a board on the table says about a camera.
#[derive(Debug, Clone, PartialEq)]
pub struct TableCheck {
    /// Distance of each corner, measured on the plane, from its place on the board after the best rigid fit, mm.
    pub position_mm: Spread,
    /// Error of the distance of every pair of corners, mm.
    pub distance_mm: Spread,
    /// By how much lengths come out too long, as a share; the best fit over all corners.
    pub scale_error: f64,
    /// Distance of the corners found from those of the fitted board, px.
    pub reprojection_px: Spread,
    /// The board's pose in the world by its image alone.
    pub world_from_board: Isometry3<f64>,
}

impl TableCheck {
    /// Angle between the board and the table by the image alone, rad. Large if the board does not lie flat.
    pub fn tilt_rad(&self) -> f64 {
        let normal = self.world_from_board.rotation * nalgebra::Vector3::z();
        normal.z.clamp(-1.0, 1.0).acos()
    }
}

/// Measures a board that lies on the table with its printed side at `board_thickness_mm`.
///
/// The corners are taken from the image to the plane, then the board is fitted to them by a rotation and a translation in
/// the plane, without scale.
///
/// # Errors
/// A corner that the camera cannot map, an image of another size.
pub fn check_on_table(
    camera: &Camera,
    view: &View,
    board: &Board,
    board_thickness_mm: f64,
) -> Result<TableCheck, CalibrateError> {
    let seen = board_pose(camera.intrinsics(), view, board)?;
    let failed = |source| CalibrateError::Projection { path: view.path.clone(), source };
    let (mut measured, mut known) = (Vec::new(), Vec::new());
    for corner in &view.corners {
        let Some(place) = board.corner_mm(corner.index) else { continue };
        let [x, y, _] = camera.world_from_image(corner.px, board_thickness_mm).map_err(failed)?;
        measured.push(Vector2::new(x, y));
        known.push(Vector2::from(place));
    }
    let centre = |points: &[Vector2<f64>]| points.iter().sum::<Vector2<f64>>() / points.len().max(1) as f64;
    let (measured_centre, known_centre) = (centre(&measured), centre(&known));
    let (mut cosine, mut sine, mut square) = (0.0, 0.0, 0.0);
    for (m, k) in measured.iter().zip(&known) {
        let (m, k) = (m - measured_centre, k - known_centre);
        cosine += k.dot(&m);
        sine += k.perp(&m);
        square += k.norm_squared();
    }
    let turn = Rotation2::new(f64::atan2(sine, cosine));
    let fitted: Vec<_> = known.iter().map(|k| turn * (k - known_centre) + measured_centre).collect();
    let position: Vec<f64> = measured.iter().zip(&fitted).map(|(m, f)| (m - f).norm()).collect();
    let mut distance = Vec::new();
    for i in 0..measured.len() {
        for j in 0..i {
            distance.push(((measured[i] - measured[j]).norm() - (known[i] - known[j]).norm()).abs());
        }
    }
    let mut reprojection = Vec::new();
    for (corner, point) in view.corners.iter().zip(&fitted) {
        let [u, v] = camera.image_from_world([point.x, point.y, board_thickness_mm]).map_err(failed)?;
        reprojection.push((corner.px[0] - u).hypot(corner.px[1] - v));
    }
    Ok(TableCheck {
        position_mm: Spread::new(&position),
        distance_mm: Spread::new(&distance),
        scale_error: cosine.hypot(sine) / square - 1.0,
        reprojection_px: Spread::new(&reprojection),
        world_from_board: camera.world_from_camera() * seen.camera_from_board,
    })
}

/// Measures a board in any pose, on its own plane: the pose is solved from the same image, so only the intrinsics are
/// put to the test.
///
/// # Errors
/// Those of [`board_pose`] and [`check_on_table`].
pub fn check_on_board(
    intrinsics: &Intrinsics,
    view: &View,
    board: &Board,
) -> Result<(BoardPose, TableCheck), CalibrateError> {
    let pose = board_pose(intrinsics, view, board)?;
    let camera = Camera::new(*intrinsics, pose.camera_from_board.inverse(), None)
        .map_err(|source| CalibrateError::Projection { path: view.path.clone(), source })?;
    let check = check_on_table(&camera, view, board, 0.0)?;
    Ok((pose, check))
}
