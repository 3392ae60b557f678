//! Recognition of parts inside the object regions (sections 5.1 and 5.2 of the paper).
//!
//! In: a frame, its [`ObjectRegion`](samsod_shadow::ObjectRegion)s, a [`Catalogue`] of parts, the camera. Out: one
//! [`Detection`] a part: its name, its score, its margin to the next best, its pose in the image and on the table.
//!
//! By shape (`shape`), one file each:
//!
//! 1. `edge_model`: what cameras see of the mesh of a part from all directions: its outline, and on its surface what its
//!    template shows (`template_edges`; `flat_edges` without a mesh). Once for a part, kept beside it (`cache`).
//! 2. `region_pixels`, `gradient`: the pixels of a salient region and the edges in it.
//! 3. `contour_match`: for every object the parts of about its size, by shape context (`shape_context`), with a pose.
//! 4. `coarse`: where that leaves a doubt, a search for the edges of every part at all places and angles in the region.
//! 5. `pose_fit`: every guess is fitted to the edges of the frame; `candidate` weighs how well that went, and
//!    how the colours agree (`tint`), and chooses.
//!
//! Turns that an outline does not tell, by what one of two turns has alone (`pose_fit`, `uncovered`) and by what is written on a
//! part: `ring_letters` of round ones, `lettering` of those whose outline repeats.
//!
//! By local features (`sift`): `sift_features`, `sift_part`, `hough`, `rigid_fit`, `homography`.
//!
//! `recognizer` asks both and decides; `settle` then gives the objects of the frame the pixels of their parts. Regions are worked on side by side; results do not depend on the number of threads.

mod align;
mod cache;
mod candidate;
mod catalogue;
mod coarse;
mod contour_match;
mod detection;
mod edge_lanes;
mod edge_model;
mod flat_edges;
mod gradient;
mod homography;
mod hough;
mod leftover;
mod lettering;
mod mesh;
mod orientation_map;
mod params;
mod part_file;
mod pose_fit;
mod recognizer;
mod region_pixels;
mod rigid_fit;
mod ring_letters;
mod settle;
mod shape;
mod shape_context;
mod sift;
mod sift_features;
mod sift_part;
mod silhouette;
mod symmetry;
mod teach;
mod template_edges;
#[cfg(test)]
mod test_parts;
mod tint;
mod uncovered;

pub use catalogue::{
    Catalogue, CatalogueError, Grasp, MASK_FILE, MODEL_FILE, PART_FILE, Part, TEMPLATE_FILE, Template,
};
pub use detection::{Detection, ImagePose, WorldPose};
pub use mesh::{Mesh, MeshError};
pub use params::{Method, RecognizeParamError, RecognizeParams, SiftParams};
pub use part_file::Symmetry;
pub use recognizer::{RecognizeError, Recognizer};
pub use settle::settle;
pub use teach::{Lesson, TeachError, teach};
