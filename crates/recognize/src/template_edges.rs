//! What the picture of a part shows inside of its outline, on the surface of its mesh.
//!
//! In: a part with a mesh. Out: points in the frame of the part on the edges that its template shows: creases that are
//! visible, holes, lettering. Which of the mesh's own edges a camera sees depends on material and light; the picture
//! knows.

use nalgebra::Vector3;

use crate::catalogue::{Part, Template};
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

/// What every pixel of a template shows of the mesh.
#[derive(Debug)]
pub(crate) struct TemplateSurface<'a> {
    template: &'a Template,
    pose: Pose,
    width: i32,
    height: i32,
    /// Height of what a pixel shows, mm; `-inf` beside the part.
    heights: Vec<f32>,
}

impl<'a> TemplateSurface<'a> {
    /// Of a part; `None` where the camera of the template does not see its mesh.
    pub(crate) fn of(part: &'a Part, mesh: &Mesh) -> Option<Self> {
        let template = &part.template;
        let (width, height) = template.mask.dimensions();
        let pose = Pose { x_mm: template.origin_mm[0], y_mm: template.origin_mm[1], yaw_rad: template.yaw_rad };
        let mut surface = Self { template, pose, width: width as i32, height: height as i32, heights: Vec::new() };
        let mut heights = vec![f32::NEG_INFINITY; width as usize * height as usize];
        let mut corners = Vec::with_capacity(mesh.vertices().len());
        for vertex in mesh.vertices() {
            let [u, v] = surface.pixel(vertex.map(f64::from))?;
            corners.push([u as f32, v as f32, vertex[2]]);
        }
        for triangle in mesh.triangles() {
            let corners = triangle.map(|i| corners[i as usize]);
            fill_triangle(corners, width as usize, height as usize, |index, z| heights[index] = heights[index].max(z));
        }
        surface.heights = heights;
        Some(surface)
    }

    /// The pixel of the template that a point in the frame of the part (mm) is seen at, hidden or not.
    pub(crate) fn pixel(&self, [x, y, z]: [f64; 3]) -> Option<[f64; 2]> {
        let (sin, cos) = self.pose.yaw_rad.sin_cos();
        let at = [self.pose.x_mm + cos * x - sin * y, self.pose.y_mm + sin * x + cos * y, z];
        let [u, v] = self.template.camera.image_from_world(at).ok()?;
        let crop = self.template.crop_px.map(f64::from);
        Some([u - crop[0], v - crop[1]])
    }

    /// The point in the frame of the part that a pixel shows, mm; `None` beside the part.
    pub(crate) fn position(&self, index: usize) -> Option<[f32; 3]> {
        let z = *self.heights.get(index).filter(|z| z.is_finite())?;
        let (x, y) = (index as i32 % self.width, index as i32 / self.width);
        self.lift(x as f32, y as f32, z).map(Into::into)
    }

    /// Whether a pixel shows a level surface: lettering rather than a step.
    pub(crate) fn is_level(&self, index: usize) -> bool {
        let (x, y) = (index as i32 % self.width, index as i32 / self.width);
        let around = (-1..=1).flat_map(|dy| (-1..=1).map(move |dx| (x + dx, y + dy)));
        let (mut low, mut high) = (f32::INFINITY, f32::NEG_INFINITY);
        for (x, y) in around {
            let z = self.at(x, y);
            (low, high) = (low.min(z), high.max(z));
        }
        high - low <= LEVEL_MM
    }

    fn at(&self, x: i32, y: i32) -> f32 {
        let within = x >= 0 && y >= 0 && x < self.width && y < self.height;
        if within { self.heights[y as usize * self.width as usize + x as usize] } else { f32::NEG_INFINITY }
    }

    fn lift(&self, u: f32, v: f32, z: f32) -> Option<Vector3<f32>> {
        let crop = self.template.crop_px.map(f64::from);
        let pixel = [f64::from(u) + crop[0], f64::from(v) + crop[1]];
        let [x, y, _] = self.template.camera.world_from_image(pixel, f64::from(z)).ok()?;
        let (sin, cos) = self.pose.yaw_rad.sin_cos();
        let (dx, dy) = (x - self.pose.x_mm, y - self.pose.y_mm);
        Some(Vector3::new((cos * dx + sin * dy) as f32, (cos * dy - sin * dx) as f32, z))
    }
}

/// The edges, the strongest first.
pub(crate) fn template_edges(part: &Part, mesh: &Mesh) -> Vec<TemplateEdge> {
    let template = &part.template;
    let Some(surface) = TemplateSurface::of(part, mesh) else { return Vec::new() };
    let gradient = Gradient::of_image(&template.image);
    let least = LEAST_GRADIENT.max(NOISE_RATIO * gradient.noise.min(LEAST_GRADIENT));
    let on_part = |x: i32, y: i32| surface.at(x, y).is_finite();
    let mut edges = Vec::new();
    for y in 0..surface.height {
        for x in 0..surface.width {
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
            let heights_around = around.map(|(x, y)| surface.at(x, y)).filter(|z| z.is_finite());
            let z = heights_around.clone().fold(f32::NEG_INFINITY, f32::max);
            let level = z - heights_around.fold(f32::INFINITY, f32::min) <= LEVEL_MM;
            let (Some(position), Some(ahead)) =
                (surface.lift(x as f32, y as f32, z), surface.lift(x as f32 - ny, y as f32 + nx, z))
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
