//! `part.toml`: what the catalogue knows about a part besides its pictures.
//!
//! ```toml
//! name = "flange"              # that of the folder
//! height_mm = 27.0             # over the table, as it lies
//! grasp_width_mm = 82.0        # opening of the gripper at the part, along the grasp's own y axis
//! grasp_offset_mm = [0.0, 0.0] # where the gripper closes, from the origin, in the axes of the part
//! grasp_angle_deg = 0.0        # direction of the gripper's x axis in the axes of the part
//!
//! [symmetry]
//! shape_order = 1              # a turn by 360 / n degrees gives the same outline; 0: any turn does
//! appearance_order = 1         # and the same picture
//!
//! [template]
//! crop_px = [438, 374]         # where template.png lay in the frame that it was cut from
//! origin_px = [103.2, 102.6]   # pixel (u, v) of template.png at which the origin is seen, at the part's height
//! angle_deg = 0.0              # yaw of the part in the template, about world z
//!
//! [camera]                     # that saw the template
//! world_from_camera_mm = [..]  # 4 rows of 4
//! [camera.intrinsics]          # as in camera.toml
//! ```

use samsod_camera::IntrinsicParams;
use serde::{Deserialize, Serialize};

/// The file; numbers are not yet checked.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct PartFile {
    pub(crate) name: String,
    pub(crate) height_mm: f64,
    pub(crate) grasp_width_mm: f64,
    #[serde(default)]
    pub(crate) grasp_offset_mm: [f64; 2],
    #[serde(default)]
    pub(crate) grasp_angle_deg: f64,
    pub(crate) symmetry: Symmetry,
    pub(crate) template: TemplateRecord,
    pub(crate) camera: CameraRecord,
}

/// Rotational symmetry about the z axis of the part, as seen from above.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Symmetry {
    /// A turn by 360 / n degrees gives the same outline; 0: any turn does, so that the outline has no angle.
    pub shape_order: u32,
    /// A turn by 360 / n degrees gives the same picture; 0: any turn does.
    pub appearance_order: u32,
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct TemplateRecord {
    pub(crate) crop_px: [u32; 2],
    pub(crate) origin_px: [f64; 2],
    pub(crate) angle_deg: f64,
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct CameraRecord {
    pub(crate) world_from_camera_mm: [[f64; 4]; 4],
    pub(crate) intrinsics: IntrinsicParams,
}
