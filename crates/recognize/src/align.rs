//! Where a part lies in the picture that it is taught from, by its shape.
//!
//! In: the shape, the mask of the part and the camera. Out: the origin of the part on the table, and its yaw.

use image::{GrayImage, RgbImage};
use samsod_camera::Camera;

use crate::Mesh;

/// Lays the silhouette of a shape over a mask.
///
/// Provisional: the centroid of the mask, taken to the plane of the part's height, and no turn.
///
/// # Arguments
/// * `image`, `mask` - the picture of the part, cut from the frame, and more than 127 where it is the part
/// * `camera` - that took the frame
/// * `crop_px` - where the picture lay in the frame
///
/// # Returns
/// Origin (x, y), mm, and yaw, rad; `None` when the shape cannot be laid over the mask.
pub(crate) fn align_mesh(
    mesh: &Mesh,
    image: &RgbImage,
    mask: &GrayImage,
    camera: &Camera,
    crop_px: [u32; 2],
) -> Option<([f64; 2], f64)> {
    let _ = image;
    let [u, v] = centroid(mask)?;
    let pixel = [u + f64::from(crop_px[0]), v + f64::from(crop_px[1])];
    let [x_mm, y_mm, _] = camera.world_from_image(pixel, f64::from(mesh.height_mm())).ok()?;
    Some(([x_mm, y_mm], 0.0))
}

fn centroid(mask: &GrayImage) -> Option<[f64; 2]> {
    let (mut sums, mut count) = ([0.0; 2], 0.0);
    for (x, y, _) in mask.enumerate_pixels().filter(|(_, _, value)| value[0] > 127) {
        sums[0] += f64::from(x);
        sums[1] += f64::from(y);
        count += 1.0;
    }
    (count > 0.0).then(|| sums.map(|sum| sum / count))
}
