//! Where a part lies in the picture that it is taught from, by its shape.
//!
//! In: the shape, the mask of the part and the camera. Out: the origin of the part on the table, and its yaw. The
//! silhouette is laid over the mask at all angles; the best is fitted to the edges of the picture. Of the turns after
//! which an outline is the same, one is taken: it then is what the part's angle means.

use std::f64::consts::TAU;

use image::{GrayImage, RgbImage};
use samsod_camera::Camera;

use crate::Mesh;
use crate::edge_model::EdgeModel;
use crate::gradient::Gradient;
use crate::pose_fit::{Fitter, Pose};

/// Angles that are tried.
const TURNS: usize = 120;
/// The best of them, that are fitted.
const FITTED: usize = 6;

/// Lays the silhouette of a shape over a mask.
///
/// # Arguments
/// * `image`, `mask` - the picture of the part, cut from the frame, and more than 127 where it is the part
/// * `camera` - that took the frame
/// * `crop_px` - where the picture lay in the frame
///
/// # Returns
/// Origin (x, y), mm, and yaw in (-pi, pi], rad; `None` when the shape cannot be laid over the mask.
pub(crate) fn align_mesh(
    mesh: &Mesh,
    image: &RgbImage,
    mask: &GrayImage,
    camera: &Camera,
    crop_px: [u32; 2],
) -> Option<([f64; 2], f64)> {
    let height_mm = f64::from(mesh.height_mm());
    let [u, v] = centroid(mask)?;
    let in_frame = |[u, v]: [f64; 2]| [u + f64::from(crop_px[0]), v + f64::from(crop_px[1])];
    let at = |pixel: [f64; 2]| camera.world_from_image(in_frame(pixel), height_mm / 2.0).ok();
    let (center, beside) = (at([u, v])?, at([u + 1.0, v])?);
    let mm_per_px = (beside[0] - center[0]).hypot(beside[1] - center[1]) as f32;
    let model = EdgeModel::of_mesh(mesh, &[], mm_per_px.max(1e-3));
    // The centroid of what is seen of the part, in its own axes, lies on that of the mask.
    let points = |pose: &Pose| {
        let view = model.view(pose.towards(camera, height_mm / 2.0));
        let pixels = view.surface.iter().filter_map(|p| camera.image_from_world(pose.world_from_part(*p)).ok());
        pixels.map(|[u, v]| [u - f64::from(crop_px[0]), v - f64::from(crop_px[1])]).collect::<Vec<_>>()
    };
    let mean = |pixels: &[[f64; 2]]| {
        let n = pixels.len().max(1) as f64;
        [0, 1].map(|i| pixels.iter().map(|p| p[i]).sum::<f64>() / n)
    };
    let share_inside = |pixels: &[[f64; 2]]| {
        let inside = |p: &&[f64; 2]| {
            let [x, y] = p.map(f64::round);
            let within = x >= 0.0 && y >= 0.0 && x < f64::from(mask.width()) && y < f64::from(mask.height());
            within && mask.get_pixel(x as u32, y as u32).0[0] > 127
        };
        pixels.iter().filter(inside).count() as f64 / pixels.len().max(1) as f64
    };
    let mut laid: Vec<(f64, Pose)> = (0..TURNS)
        .filter_map(|k| {
            let yaw_rad = k as f64 / TURNS as f64 * TAU;
            let first = Pose { x_mm: center[0], y_mm: center[1], yaw_rad };
            let [mu, mv] = mean(&points(&first));
            let moved = at([2.0 * u - mu, 2.0 * v - mv])?;
            let pose = Pose { x_mm: moved[0], y_mm: moved[1], yaw_rad };
            Some((share_inside(&points(&pose)), pose))
        })
        .collect();
    laid.sort_by(|a, b| b.0.total_cmp(&a.0));
    let mut gradient = Gradient::of_image(image);
    (gradient.left, gradient.top) = (crop_px[0] as i32, crop_px[1] as i32);
    let mut fitter = Fitter::default();
    let fits = laid.iter().take(FITTED).filter_map(|(_, pose)| fitter.fit(&model, height_mm, camera, &gradient, *pose));
    let best = fits.max_by(|a, b| (a.outline + a.hits).total_cmp(&(b.outline + b.hits)))?;
    let (sin, cos) = best.pose.yaw_rad.sin_cos();
    Some(([best.pose.x_mm, best.pose.y_mm], sin.atan2(cos)))
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Catalogue;
    use std::path::Path;

    #[test]
    fn bundled_parts_are_laid_where_they_lie() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/data/parts");
        let catalogue = Catalogue::read(&folder).unwrap();
        for name in ["asym_plate", "u_channel", "l_bracket"] {
            let part = catalogue.part(name).unwrap();
            let t = &part.template;
            let mesh = part.mesh.as_ref().unwrap();
            let ([x, y], yaw) = align_mesh(mesh, &t.image, &t.mask, &t.camera, t.crop_px).unwrap();
            // The yaw itself, not a turn more or less: all of them lie at about 0.
            let turn = yaw - t.yaw_rad;
            let off = (x - t.origin_mm[0]).hypot(y - t.origin_mm[1]);
            assert!(off < 0.3 && turn.abs() < 0.01, "{name}: {off} mm, {} deg", turn.to_degrees());
        }
    }
}
