//! From the image of a calibrated camera to the table and to the robot.
//!
//! [`Intrinsics`] hold focal lengths, principal point and lens; [`Camera`] adds where it hangs over the table and where
//! the robot stands, and maps points and directions between the frames. [`UndistortionMap`] takes the lens out of whole
//! images. [`CameraFile`] reads and writes `camera.toml`; [`fit_rigid`] finds the robot from points that it has touched.
//! With the feature `calibrate`, module `calibrate` finds boards in images and solves for the camera, with OpenCV.
//!
//! `a_from_b` maps coordinates of frame b to those of frame a. Lengths are mm, angles rad, pixel centres at integers.

mod camera;
mod file;
mod intrinsics;
mod lens;
mod pose;
mod projection;
mod rigid;
mod undistortion_map;

#[cfg(feature = "calibrate")]
pub mod calibrate;

pub use camera::Camera;
pub use file::{BaseRecord, CalibrationRecord, CameraFile, CameraFileError};
pub use image::RgbImage;
pub use intrinsics::{IntrinsicParams, Intrinsics, IntrinsicsError, MAX_SIDE_PX};
pub use nalgebra;
pub use pose::{PoseError, pose_from_rows, rows_from_pose};
pub use projection::ProjectionError;
pub use rigid::{LEAST_POINTS, LEAST_SPREAD, MOST_COORDINATE_MM, RigidFit, RigidFitError, fit_rigid};
pub use undistortion_map::{ImageSizeError, RgbView, UndistortionMap};
