//! Pictures of the parts on the table, as the camera of the cell sees them.
//!
//! In: parts at poses, a picture of the bare table, the light. Out: sRGB levels with 8 bits behind the point, so that noise
//! comes before rounding. All is blended in linear light:
//!
//! 1. the table is darkened where parts keep light from it (`shadow`);
//! 2. the model of each part is drawn through the camera with a depth buffer, [`SAMPLES`] x [`SAMPLES`] points a pixel, in
//!    the colours of its template (`surface`), shaded by the light of this table instead of that of its template.
//!
//! Parts throw no shadows on each other, and none on themselves but those in their templates.

use image::RgbImage;
use samsod_camera::Camera;
use samsod_camera::nalgebra::Point3;

use super::light::{Lighting, linear_from_srgb, sky_on};
use super::noise::level_of;
use super::raster::fill;
use super::shadow;
use super::surface::{Surface, dot, unit};
use crate::place::PlanePose;

/// Points of a pixel along a side.
const SAMPLES: usize = 3;
/// Light that comes back into a shadow from the table around it.
const BOUNCE: f32 = 0.06;
/// Least and greatest change of the shade that a template shows; it knows nothing of highlights.
const RELIGHT: [f64; 2] = [0.4, 1.6];
/// The template's own light comes from above; what turns away so far got next to none of it.
const LEAST_SKY: f64 = 0.3;
/// Walls that no template shows get at least this share of the light on the table, as the table lights them.
const LEAST_LIGHT: f64 = 0.15;
/// Half the side of the square of the table that tells how bright it is about a part, px.
const AROUND_PX: usize = 120;
/// Greatest share by which uneven light makes a part brighter or darker.
const UNEVEN: [f64; 2] = [0.5, 2.0];
/// Steps of the curve from linear light to levels.
const CURVE_STEPS: usize = 1 << 14;

/// Fine levels of a picture: sRGB, 256 steps for one of 8 bits.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Picture {
    size: [u32; 2],
    levels: Vec<u16>,
}

impl Picture {
    /// Width and height, px.
    pub fn size_px(&self) -> [u32; 2] {
        self.size
    }

    /// Red, green, blue of each pixel, row by row, 0 to 65280.
    pub fn levels(&self) -> &[u16] {
        &self.levels
    }
}

/// A part at its place in the world.
#[derive(Debug)]
pub(super) struct Placed<'a> {
    pub(super) surface: &'a Surface,
    /// Its vertices, mm.
    pub(super) world: Vec<[f64; 3]>,
    /// Normals of its facets.
    pub(super) facet_normals: Vec<[f64; 3]>,
    sin: f64,
    cos: f64,
}

impl<'a> Placed<'a> {
    pub(super) fn new(surface: &'a Surface, pose: &PlanePose) -> Self {
        let (sin, cos) = pose.yaw_deg.to_radians().sin_cos();
        let turned = |[x, y, z]: [f64; 3]| [cos * x - sin * y, sin * x + cos * y, z];
        let moved = |v: &[f64; 3]| {
            let [x, y, z] = turned(*v);
            [x + pose.x_mm, y + pose.y_mm, z + pose.z_mm]
        };
        Self {
            surface,
            world: surface.vertices.iter().map(moved).collect(),
            facet_normals: surface.facets.iter().map(|facet| turned(facet.normal)).collect(),
            sin,
            cos,
        }
    }
}

/// The bare table, its camera and its light.
#[derive(Debug)]
pub(super) struct Renderer {
    camera: Camera,
    /// Linear light, row by row.
    table: Vec<[f32; 3]>,
    mean: f64,
    lighting: Lighting,
    directions: Vec<([f64; 3], f64)>,
    exposure: f64,
    curve: Vec<u16>,
}

impl Renderer {
    /// # Arguments
    /// * `background` - the bare table, of the size of the camera's images
    /// * `exposure` - brightness of parts, of that in their templates
    pub(super) fn new(camera: Camera, background: &RgbImage, lighting: Lighting, exposure: f64) -> Self {
        let light: Vec<f32> = (0..=255u8).map(|v| linear_from_srgb(f64::from(v) / 255.0) as f32).collect();
        let table: Vec<[f32; 3]> = background.pixels().map(|pixel| pixel.0.map(|v| light[v as usize])).collect();
        let mean = table.iter().map(brightness).sum::<f64>() / table.len().max(1) as f64;
        let curve = (0..=CURVE_STEPS).map(|i| level_of(i as f64 / CURVE_STEPS as f64)).collect();
        let directions = lighting.directions();
        Self { camera, table, mean, lighting, directions, exposure, curve }
    }

    fn size(&self) -> [usize; 2] {
        self.camera.intrinsics().size_px().map(|side| side as usize)
    }

    /// Draws parts on the table.
    pub(super) fn draw(&self, mut parts: Vec<Placed<'_>>) -> Picture {
        let covered = shadow::covered(&self.camera, &parts, &self.directions);
        let mut picture = self.table.clone();
        for (pixel, covered) in picture.iter_mut().zip(covered) {
            let left = 1.0 - covered.min(1.0) * (1.0 - BOUNCE);
            pixel.iter_mut().for_each(|c| *c *= left);
        }
        // What lies nearer hides what lies farther; parts do not run through each other.
        let eye = self.camera.world_from_camera();
        let nearest = |part: &Placed<'_>| {
            let depth = |v: &[f64; 3]| eye.inverse_transform_point(&Point3::from(*v)).z;
            part.world.iter().map(depth).fold(f64::INFINITY, f64::min)
        };
        parts.sort_by(|a, b| nearest(b).total_cmp(&nearest(a)));
        parts.iter().for_each(|part| self.draw_part(part, &mut picture));

        let level = |c: f32| self.curve[((c.clamp(0.0, 1.0) * CURVE_STEPS as f32) + 0.5) as usize];
        let levels = picture.iter().flat_map(|pixel| pixel.map(level)).collect();
        Picture { size: self.camera.intrinsics().size_px(), levels }
    }

    fn draw_part(&self, part: &Placed<'_>, picture: &mut [[f32; 3]]) {
        let [width, height] = self.size();
        let eye = self.camera.world_from_camera();
        // Pixel and depth of each vertex.
        let mut seen = Vec::with_capacity(part.world.len());
        let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
        for vertex in &part.world {
            // A part that reaches behind the camera is not drawn.
            let Ok(pixel) = self.camera.image_from_world(*vertex) else { return };
            seen.push((pixel, eye.inverse_transform_point(&Point3::from(*vertex)).z));
            for axis in 0..2 {
                low[axis] = low[axis].min(pixel[axis]);
                high[axis] = high[axis].max(pixel[axis]);
            }
        }
        let first = low.map(|c| c.floor().max(0.0));
        let last = [high[0].ceil().min(width as f64 - 1.0), high[1].ceil().min(height as f64 - 1.0)];
        if !(first[0] <= last[0] && first[1] <= last[1]) {
            return;
        }
        let [columns, rows] = [0, 1].map(|axis| (last[axis] - first[axis]) as usize + 1);
        let [fine_columns, fine_rows] = [columns * SAMPLES, rows * SAMPLES];
        let fine = |[u, v]: [f64; 2]| {
            [(u, first[0]), (v, first[1])].map(|(c, first)| (c - first + 0.5) * SAMPLES as f64 - 0.5)
        };

        // The nearest facet of each point, its inverse depth and the weights of its corners.
        let mut points: Vec<(f64, u32, [f32; 2])> = vec![(0.0, u32::MAX, [0.0; 2]); fine_columns * fine_rows];
        for (index, facet) in (0u32..).zip(&part.surface.facets) {
            let [a, b, c] = facet.corners.map(|i| seen[i]);
            let towards = {
                let [x, y, z] = part.world[facet.corners[0]];
                let at = eye.translation.vector;
                [at.x - x, at.y - y, at.z - z]
            };
            if dot(part.facet_normals[index as usize], towards) <= 0.0 {
                continue;
            }
            fill([fine(a.0), fine(b.0), fine(c.0)], fine_columns, fine_rows, |at, weights| {
                let by_depth = [weights[0] / a.1, weights[1] / b.1, weights[2] / c.1];
                let inverse = by_depth.iter().sum::<f64>();
                if inverse > points[at].0 {
                    points[at] = (inverse, index, [by_depth[0] / inverse, by_depth[1] / inverse].map(|w| w as f32));
                }
            });
        }

        let exposure = self.exposure * self.light_around([(low[0] + high[0]) / 2.0, (low[1] + high[1]) / 2.0]);
        for y in 0..rows {
            for x in 0..columns {
                let (mut sum, mut count) = ([0.0; 3], 0.0);
                for sample in 0..SAMPLES * SAMPLES {
                    let (dx, dy) = (sample % SAMPLES, sample / SAMPLES);
                    let (_, index, weights) = points[(y * SAMPLES + dy) * fine_columns + x * SAMPLES + dx];
                    let Some(facet) = part.surface.facets.get(index as usize) else { continue };
                    let [a, b] = weights.map(f64::from);
                    let weights = [a, b, 1.0 - a - b];
                    let mixed = |of: [[f64; 3]; 3]| {
                        [0, 1, 2].map(|i| weights[0] * of[0][i] + weights[1] * of[1][i] + weights[2] * of[2][i])
                    };
                    let point = mixed(facet.corners.map(|i| part.surface.vertices[i]));
                    let [nx, ny, nz] = unit(mixed(facet.corner_normals));
                    let normal = [part.cos * nx - part.sin * ny, part.sin * nx + part.cos * ny, nz];
                    let colour = part.surface.colour(point, facet);
                    let shade = if colour.is_seen {
                        (self.lighting.on(normal) / sky_on(normal).max(LEAST_SKY)).clamp(RELIGHT[0], RELIGHT[1])
                    } else {
                        self.lighting.on(normal).clamp(LEAST_LIGHT, 1.0)
                    };
                    (0..3).for_each(|i| sum[i] += colour.light[i] * shade * exposure);
                    count += 1.0;
                }
                if count > 0.0 {
                    let share = 1.0 / (SAMPLES * SAMPLES) as f64;
                    let pixel = &mut picture[(first[1] as usize + y) * width + first[0] as usize + x];
                    let left = 1.0 - count * share;
                    (0..3).for_each(|i| pixel[i] = (f64::from(pixel[i]) * left + sum[i] * share) as f32);
                }
            }
        }
    }

    /// How bright the table is about a pixel, of its mean: there parts are as much brighter or darker.
    fn light_around(&self, [u, v]: [f64; 2]) -> f64 {
        let [width, height] = self.size();
        let range = |c: f64, side: usize| {
            let centre = c.clamp(0.0, side as f64 - 1.0) as usize;
            centre.saturating_sub(AROUND_PX)..(centre + AROUND_PX).min(side)
        };
        let columns = range(u, width);
        let (mut sum, mut count) = (0.0, 0usize);
        for y in range(v, height) {
            let row = &self.table[y * width..][columns.clone()];
            sum += row.iter().map(brightness).sum::<f64>();
            count += row.len();
        }
        let share = sum / count.max(1) as f64 / self.mean.max(f64::MIN_POSITIVE);
        share.clamp(UNEVEN[0], UNEVEN[1])
    }
}

/// Linear luminance.
fn brightness(light: &[f32; 3]) -> f64 {
    f64::from(0.2126 * light[0] + 0.7152 * light[1] + 0.0722 * light[2])
}
