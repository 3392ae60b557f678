//! Recognition of parts inside the object regions (sections 5.1 and 5.2 of the paper).
//!
//! In: a frame, its [`ObjectRegion`](samsod_shadow::ObjectRegion)s, a [`Catalogue`] of parts, the camera. Out: one
//! [`Detection`] a part: its name, its score, its margin to the next best, its pose in the image and on the table.

mod align;
mod catalogue;
mod detection;
mod mesh;
mod params;
mod part_file;
mod recognizer;
mod symmetry;
mod teach;

pub use catalogue::{
    Catalogue, CatalogueError, Grasp, MASK_FILE, MODEL_FILE, PART_FILE, Part, TEMPLATE_FILE, Template,
};
pub use detection::{Detection, ImagePose, WorldPose};
pub use mesh::{Mesh, MeshError};
pub use params::{Method, RecognizeParamError, RecognizeParams, SiftParams};
pub use part_file::Symmetry;
pub use recognizer::{RecognizeError, Recognizer};
pub use teach::{Lesson, TeachError, teach};
