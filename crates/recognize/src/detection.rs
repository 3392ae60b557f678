//! What the recognition says about one object.

use samsod_shadow::{Mask, ObjectRegion};

use crate::Method;

/// One object, recognised or not.
#[derive(Debug, Clone, PartialEq)]
pub struct Detection {
    /// Index of the salient region it lies in; of a conventional search over the whole frame, 0.
    pub region: usize,
    /// Indices of the object regions that it covers, in increasing order. Several when the separation of shadows had
    /// broken the part; one object region is covered by several detections where parts touch. Empty for a conventional
    /// search.
    pub objects: Vec<usize>,
    /// Name of the part in the catalogue; `None` is an unknown object.
    pub name: Option<String>,
    /// What told its pose: [`Method::Sift`] where features did, or features or lettering its turn; else [`Method::Shape`], and its
    /// angle is within the symmetry of the outline.
    pub method: Method,
    /// How well it fits, in [0, 1]; of an unknown object that of the part that came closest, 0 where none was
    /// tried.
    pub score: f32,
    /// Score less that of the next best part of another name (0 without any), in [0, 1].
    pub margin: f32,
    /// Where it is seen. Of an unknown object, the centroid and the longest axis of its mask.
    pub image: ImagePose,
    /// Where it lies, when the camera is known and the object is.
    pub world: Option<WorldPose>,
    /// Pixels of the part as its pose explains them; of an unknown object, those of its object region.
    pub mask: Mask,
}

impl Detection {
    /// An object that is no part of the catalogue.
    pub(crate) fn unknown(object: &ObjectRegion, index: usize, score: f32, margin: f32, method: Method) -> Self {
        Self {
            region: object.region,
            objects: vec![index],
            name: None,
            method,
            score,
            margin,
            image: ImagePose { origin_px: object.centroid.map(f64::from), angle_rad: f64::from(object.axis_rad) },
            world: None,
            mask: Mask::clone(&object.mask),
        }
    }
}

/// Pose in the image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ImagePose {
    /// Pixel (u, v) at which the origin of the part is seen at the height of the part; centres at integers.
    pub origin_px: [f64; 2],
    /// Direction of the part's x axis there, radians in (-pi, pi], counter-clockwise on the screen from image right.
    pub angle_rad: f64,
}

/// Pose on the table.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WorldPose {
    /// Origin of the part on the table, mm.
    pub x_mm: f64,
    /// As `x_mm`.
    pub y_mm: f64,
    /// Rotation about world z, radians in (-pi, pi], counter-clockwise seen from above. Of a part of n-fold symmetry one
    /// of n values that are the same, in (-pi/n, pi/n]; 0 of a part that looks the same at any angle.
    pub yaw_rad: f64,
    /// Height of the part over the table, mm.
    pub height_mm: f64,
}
