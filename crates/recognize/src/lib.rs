//! Recognition of parts inside the object regions (sections 5.1 and 5.2 of the paper).
//!
//! In: a frame, its [`ObjectRegion`](samsod_shadow::ObjectRegion)s, a [`Catalogue`] of parts, the camera. Out: one
//! [`Detection`] a part: its name, its score, its margin to the next best, its pose in the image and on the table.

mod cache;
mod catalogue;
mod coarse;
mod contour_match;
mod detection;
mod edge_model;
mod flat_edges;
mod gradient;
mod pose_fit;
mod mesh;
mod orientation_map;
mod params;
mod part_file;
mod recognizer;
mod region_pixels;
mod shape;
mod shape_context;
mod silhouette;
mod template_edges;

pub use catalogue::{
    Catalogue, CatalogueError, Grasp, MASK_FILE, MODEL_FILE, PART_FILE, Part, TEMPLATE_FILE, Template,
};
pub use detection::{Detection, ImagePose, WorldPose};
pub use mesh::{Mesh, MeshError};
pub use params::{Method, RecognizeParamError, RecognizeParams, SiftParams};
pub use part_file::Symmetry;
pub use recognizer::{RecognizeError, Recognizer};

/// Lab.
pub mod lab {
    use super::*;
    /// Lab.
    pub struct Row { pub part: String, pub x: f64, pub y: f64, pub yaw: f64, pub coarse: f32, pub outline: f32, pub inner: f32, pub pixels: [u32;3], pub gain: f32, pub hits: f32, pub score: f32, pub rival: Option<(String, f32, f32)> }
    /// Lab.
    pub struct Lab(shape::ShapeMatcher, Catalogue);
    impl Lab {
        /// Lab.
        pub fn new(c: Catalogue) -> Self { Lab(shape::ShapeMatcher::new(c.parts()), c) }
        /// Lab.
        pub fn run(&self, frame: &samsod_segment::RgbView<'_>, objects: &[samsod_shadow::ObjectRegion], camera: &samsod_camera::Camera) -> Vec<(usize, samsod_segment::BoundingBox, Vec<Row>)> {
            let regions = region_pixels::RegionPixels::of(objects, 16, frame.dimensions().into());
            use rayon::prelude::*; regions.par_iter().map(|r| {
                let c = self.0.candidates(self.1.parts(), camera, frame, objects, r);
                if std::env::var("LAB_ALL").is_ok() {
                    let rows = c.iter().map(|k| Row { part: self.1.parts()[k.part].name.clone(), x: k.fit.pose.x_mm, y: k.fit.pose.y_mm, yaw: k.fit.pose.yaw_rad, coarse: k.explained, outline: k.fit.outline, inner: k.fit.inner, pixels: k.pixels, gain: 0.0, hits: k.fit.hits, score: k.score(), rival: None }).collect();
                    return (r.region, r.bbox, rows);
                }
                let chosen = shape::select(&c);
                let rows = chosen.into_iter().filter(|(i, _)| c[*i].odds() > -2.0).map(|(i, rival)| { let k = &c[i]; Row { part: self.1.parts()[k.part].name.clone(), x: k.fit.pose.x_mm, y: k.fit.pose.y_mm, yaw: k.fit.pose.yaw_rad, coarse: k.explained, outline: k.fit.outline, inner: k.fit.inner, pixels: k.pixels, gain: k.odds(), hits: k.fit.hits, score: k.score(), rival: rival.map(|i| (self.1.parts()[c[i].part].name.clone(), c[i].odds(), c[i].score())) } }).collect();
                (r.region, r.bbox, rows)
            }).collect()
        }
    }
}
