//! Why a point cannot be taken from one frame to another.

/// Why a pixel has no point, or a point no pixel.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ProjectionError {
    /// A coordinate is NaN or infinite.
    #[error("{what} {values:?} is not finite")]
    NotFinite {
        /// What was given.
        what: &'static str,
        /// Its coordinates.
        values: Vec<f64>,
    },
    /// The pixel is not one of the image.
    #[error("pixel ({u}, {v}) lies outside the image of {width_px} x {height_px} px")]
    OutsideImage {
        /// Column.
        u: f64,
        /// Row.
        v: f64,
        /// Width of the image, px.
        width_px: u32,
        /// Height of the image, px.
        height_px: u32,
    },
    /// The lens model does not reach so far.
    #[error("{what} ({}, {}) lies farther out than the lens model reaches", values[0], values[1])]
    OutsideLens {
        /// `"pixel"` or `"ray"`.
        what: &'static str,
        /// Its coordinates.
        values: [f64; 2],
    },
    /// The camera does not look that way.
    #[error("point ({}, {}, {}) mm does not lie in front of the camera", point_mm[0], point_mm[1], point_mm[2])]
    BehindCamera {
        /// The point in the world.
        point_mm: [f64; 3],
    },
    /// The ray of the pixel does not meet the plane.
    #[error("the plane z = {height_mm} mm is parallel to the ray of pixel ({u}, {v}) or behind the camera")]
    NoIntersection {
        /// Column.
        u: f64,
        /// Row.
        v: f64,
        /// Height of the plane over the table, mm.
        height_mm: f64,
    },
    /// Nobody has told where the robot stands.
    #[error("the camera has no base_from_world: touch points of the table with `samsod calibrate touch`")]
    NoBase,
}
