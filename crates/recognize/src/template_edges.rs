//! What the picture of a part shows inside of its outline, on the surface of its mesh.
//!
//! In: a part with a mesh. Out: points in the frame of the part on the edges that its template shows: creases that are
//! visible, holes, lettering. Which of the mesh's own edges a camera sees depends on material and light; the picture
//! knows.

use nalgebra::Vector3;

use crate::catalogue::Part;
use crate::edge_model::fill_triangle;
use crate::gradient::Gradient;
use crate::mesh::Mesh;
use crate::pose_fit::Pose;

/// Edges weaker than this are shading, sRGB levels a pixel,
const LEAST_GRADIENT: f32 = 5.0;
/// and so many times the gradient of noise.
const NOISE_RATIO: f32 = 3.0;
/// Heights within 3 x 3 pixels that differ by no more are level, mm.
const LEVEL_MM: f32 = 0.3;
/// Pixels from the outline that belong to it.
const DEPTH_PX: i32 = 3;

/// A point on an edge of the picture.
#[derive(Debug, Clone, Copy)]
pub(crate) struct TemplateEdge {
    /// In the frame of the part, mm.
    pub(crate) position: Vector3<f32>,
    /// Direction of the edge, of length 1.
    pub(crate) tangent: Vector3<f32>,
    /// Gradient across it, sRGB levels a pixel.
    pub(crate) strength: f32,
    /// Whether the surface is level around it: lettering rather than a step.
    pub(crate) level: bool,
}

/// The edges, the strongest first.
pub(crate) fn template_edges(part: &Part, mesh: &Mesh) -> Vec<TemplateEdge> {
    let template = &part.template;
    let (width, height) = template.mask.dimensions();
    let pose = Pose { x_mm: template.origin_mm[0], y_mm: template.origin_mm[1], yaw_rad: template.yaw_rad };
    let crop = template.crop_px.map(f64::from);
    // Height of what every pixel shows.
    let mut heights = vec![f32::NEG_INFINITY; width as usize * height as usize];
    let mut corners = Vec::with_capacity(mesh.vertices().len());
    for vertex in mesh.vertices() {
        let Ok([u, v]) = template.camera.image_from_world(pose.world_from_part(*vertex)) else { return Vec::new() };
        corners.push([(u - crop[0]) as f32, (v - crop[1]) as f32, vertex[2]]);
    }
    for triangle in mesh.triangles() {
        let corners = triangle.map(|i| corners[i as usize]);
        fill_triangle(corners, width as usize, height as usize, |index, z| heights[index] = heights[index].max(z));
    }
    let (sin, cos) = (pose.yaw_rad.sin(), pose.yaw_rad.cos());
    let lift = |u: f32, v: f32, z: f32| -> Option<Vector3<f32>> {
        let pixel = [f64::from(u) + crop[0], f64::from(v) + crop[1]];
        let [x, y, _] = template.camera.world_from_image(pixel, f64::from(z)).ok()?;
        let (dx, dy) = (x - pose.x_mm, y - pose.y_mm);
        Some(Vector3::new((cos * dx + sin * dy) as f32, (cos * dy - sin * dx) as f32, z))
    };
    let gradient = Gradient::of_image(&template.image);
    let least = LEAST_GRADIENT.max(NOISE_RATIO * gradient.noise.min(LEAST_GRADIENT));
    let on_part = |x: i32, y: i32| {
        let within = x >= 0 && y >= 0 && x < width as i32 && y < height as i32;
        within && heights[y as usize * width as usize + x as usize].is_finite()
    };
    let mut edges = Vec::new();
    for y in 0..height as i32 {
        for x in 0..width as i32 {
            let d = DEPTH_PX;
            if !on_part(x, y) || ![(d, 0), (-d, 0), (0, d), (0, -d)].iter().all(|(dx, dy)| on_part(x + dx, y + dy)) {
                continue;
            }
            let Some((nx, ny, strength)) = gradient.ridge(x as usize, y as usize) else { continue };
            if strength < least {
                continue;
            }
            // At a step the edge is that of the upper side.
            let around = (-1..=1).flat_map(|dy| (-1..=1).map(move |dx| (x + dx, y + dy)));
            let heights_around =
                around.filter(|&(x, y)| on_part(x, y)).map(|(x, y)| heights[y as usize * width as usize + x as usize]);
            let z = heights_around.clone().fold(f32::NEG_INFINITY, f32::max);
            let level = z - heights_around.fold(f32::INFINITY, f32::min) <= LEVEL_MM;
            let (Some(position), Some(ahead)) = (lift(x as f32, y as f32, z), lift(x as f32 - ny, y as f32 + nx, z))
            else {
                continue;
            };
            let Some(tangent) = (ahead - position).try_normalize(1e-6) else { continue };
            edges.push(TemplateEdge { position, tangent, strength, level });
        }
    }
    edges.sort_by(|a, b| b.strength.total_cmp(&a.strength));
    edges
}
