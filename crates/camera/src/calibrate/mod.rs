//! Calibrating a camera from pictures of a board, with OpenCV.
//!
//! [`find_views`] finds the board in image files, [`calibrate`] solves for the intrinsics, [`board_pose`] and
//! [`world_from_camera`] for the pose over the table from a board that lies on it; [`check_on_table`] measures, in mm,
//! how well a camera does on a board laid elsewhere. [`residual_picture`] and [`corner_picture`] draw.

mod board;
mod check;
mod find;
mod picture;
mod solve;
#[cfg(test)]
mod tests;

use std::path::PathBuf;

pub use board::{Board, Dictionary, Markers};
pub use check::{Spread, TableCheck, check_on_board, check_on_table};
pub use find::{Corner, View, find_corners, find_view, find_views, image_files};
pub use picture::{corner_picture, residual_picture};
pub use solve::{BoardPose, Calibration, board_pose, calibrate, world_from_camera};

use crate::intrinsics::IntrinsicsError;
use crate::projection::ProjectionError;

/// Fewest images from which a camera is calibrated.
pub const LEAST_VIEWS: usize = 4;
/// Fewest corners of a board in an image.
pub const LEAST_CORNERS: usize = 6;

/// Why there is no calibration.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CalibrateError {
    /// The description of the board is impossible.
    #[error("{what} is {value}; allowed: {allowed}")]
    Board {
        /// What is wrong.
        what: &'static str,
        /// Its value.
        value: String,
        /// What is allowed.
        allowed: String,
    },
    /// A file or folder cannot be read.
    #[error("cannot read {}: {source}", path.display())]
    Read {
        /// The file or folder.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The folder has no images.
    #[error("{} has no PNG or JPEG files", path.display())]
    NoImages {
        /// The folder.
        path: PathBuf,
    },
    /// The file is no image, or a broken one.
    #[error("{} is no PNG or JPEG image that can be read: {source}", path.display())]
    NoImage {
        /// The file.
        path: PathBuf,
        /// What the decoder said.
        source: image::ImageError,
    },
    /// The board was not found in an image.
    #[error("{}: not found: {board}", path.display())]
    NoBoard {
        /// The file.
        path: PathBuf,
        /// What was looked for.
        board: String,
    },
    /// The board was found in too few images.
    #[error("found {board} in {found} images; at least {LEAST_VIEWS} are needed, ten to twenty are good")]
    TooFewViews {
        /// How many.
        found: usize,
        /// What was looked for.
        board: String,
    },
    /// The images are not of one camera.
    #[error(
        "images of different sizes: {} has {first_px:?} px and {} {other_px:?}; all must come from one camera as they are",
        first.display(), other.display()
    )]
    Sizes {
        /// A file.
        first: PathBuf,
        /// Its size, px.
        first_px: [u32; 2],
        /// Another.
        other: PathBuf,
        /// Its size, px.
        other_px: [u32; 2],
    },
    /// The solution is no camera.
    #[error("the solution is no camera: {reason}; is the pattern right, and does the board fill the images, tilted?")]
    Impossible {
        /// Why not.
        reason: String,
    },
    /// The solution has impossible numbers.
    #[error("the solution is no camera: {0}; photograph the board up to the corners of the image, tilted")]
    Intrinsics(#[from] IntrinsicsError),
    /// A corner cannot be mapped.
    #[error("{}: {source}", path.display())]
    Projection {
        /// The image.
        path: PathBuf,
        /// Why not.
        source: ProjectionError,
    },
    /// OpenCV failed.
    #[error("OpenCV: {0}")]
    OpenCv(#[from] opencv::Error),
}
