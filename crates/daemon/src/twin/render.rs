//! Parts on the table, as the camera of the cell sees them.
//!
//! In: a part at its place, the picture of the bare table, the light. Out: a layer, from which `canvas` makes the picture. The
//! model of the part is drawn through the camera with a depth buffer, [`SAMPLES`] x [`SAMPLES`] points a pixel, in the colours
//! of its template (`surface`), shaded by the light of this table instead of that of its template; its shadow on the table is
//! that of `shadow`.
//!
//! Parts throw no shadows on each other, and none on themselves but those in their templates.

use image::RgbImage;
use samsod_camera::Camera;
use samsod_camera::nalgebra::Point3;

use super::canvas::{Layer, LayerKey};
use super::light::{Lighting, linear_from_srgb, sky_on};
use super::raster::fill;
use super::shadow::{SHADOW_MARGIN_PX, shadow};
use super::surface::{Surface, dot, unit};
use super::tile::{Area, Tile};
use crate::place::PlanePose;

/// Points of a pixel along a side.
const SAMPLES: usize = 3;
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

/// The camera and the light over the table.
#[derive(Debug)]
pub(super) struct Renderer {
    camera: Camera,
    /// Mean brightness of the table.
    mean: f64,
    lighting: Lighting,
    directions: Vec<([f64; 3], f64)>,
    /// Greatest length of a shadow, of the height that throws it.
    reach: f64,
    exposure: f64,
}

/// Linear light of a picture, row by row.
pub(super) fn linear(picture: &RgbImage) -> Vec<[f32; 3]> {
    let light: Vec<f32> = (0..=255u8).map(|v| linear_from_srgb(f64::from(v) / 255.0) as f32).collect();
    picture.pixels().map(|pixel| pixel.0.map(|v| light[v as usize])).collect()
}

impl Renderer {
    /// # Arguments
    /// * `table` - linear light of the bare table, of the size of the camera's images
    /// * `exposure` - brightness of parts, of that in their templates
    pub(super) fn new(camera: Camera, table: &[[f32; 3]], lighting: Lighting, exposure: f64) -> Self {
        let mean = table.iter().map(brightness).sum::<f64>() / table.len().max(1) as f64;
        let directions = lighting.directions();
        let length = |([x, y, z], _): &([f64; 3], f64)| x.hypot(*y) / z;
        let reach = directions.iter().map(length).fold(0.0, f64::max);
        Self { camera, mean, lighting, directions, reach, exposure }
    }

    pub(super) fn size(&self) -> [usize; 2] {
        self.camera.intrinsics().size_px().map(|side| side as usize)
    }

    /// Draws a part and its shadow. A part that reaches behind the camera has neither.
    ///
    /// # Arguments
    /// * `table` - linear light of the bare table, row by row
    pub(super) fn layer(&self, key: LayerKey, part: &Placed<'_>, table: &[[f32; 3]]) -> Layer {
        let eye = self.camera.world_from_camera();
        // Pixel and depth of each vertex.
        let see = |vertex: &[f64; 3]| -> Option<([f64; 2], f64)> {
            let pixel = self.camera.image_from_world(*vertex).ok()?;
            Some((pixel, eye.inverse_transform_point(&Point3::from(*vertex)).z))
        };
        let seen = if self.may_be_seen(part) { part.world.iter().map(see).collect::<Option<Vec<_>>>() } else { None };
        let Some(seen) = seen else {
            let (patch, shadow) = (Tile::new(Area::default(), [0.0; 4]), Tile::new(Area::default(), 0.0));
            return Layer { key, depth_mm: f64::INFINITY, patch, shadow };
        };
        let depth_mm = seen.iter().map(|(_, depth)| *depth).fold(f64::INFINITY, f64::min);
        let shadow = shadow(&self.camera, part, &self.directions);
        Layer { key, depth_mm, patch: self.patch(part, &seen, table), shadow }
    }

    /// Whether a part or its shadow may lie in view: what does not is not to be drawn at length.
    ///
    /// A box about both is looked at: without distortion, what lies between its corners is seen between them.
    fn may_be_seen(&self, part: &Placed<'_>) -> bool {
        let along = |axis: usize| part.world.iter().map(move |vertex| vertex[axis]);
        let [x, y, z] = [0, 1, 2]
            .map(|axis| [along(axis).fold(f64::INFINITY, f64::min), along(axis).fold(f64::NEG_INFINITY, f64::max)]);
        // What lies under the table throws its shadow upwards.
        let length = self.reach * z[0].abs().max(z[1].abs());
        let corner = |i: usize| {
            let x = if i & 1 == 0 { x[0] - length } else { x[1] + length };
            let y = if i & 2 == 0 { y[0] - length } else { y[1] + length };
            self.camera.image_from_world([x, y, if i & 4 == 0 { z[0].min(0.0) } else { z[1].max(0.0) }]).ok()
        };
        // Behind the camera, nothing is known by corners.
        let Some(corners) = (0..8).map(corner).collect::<Option<Vec<_>>>() else { return true };
        Area::about(corners.into_iter(), SHADOW_MARGIN_PX, self.size()) != Area::default()
    }

    /// The part itself: linear light times cover, and cover.
    fn patch(&self, part: &Placed<'_>, seen: &[([f64; 2], f64)], table: &[[f32; 3]]) -> Tile<[f32; 4]> {
        let eye = self.camera.world_from_camera();
        let area = Area::about(seen.iter().map(|(pixel, _)| *pixel), 0, self.size());
        let mut patch = Tile::new(area, [0.0f32; 4]);
        if patch.values.is_empty() {
            return patch;
        }
        let (columns, rows) = (patch.area.columns.len(), patch.area.rows.len());
        let [fine_columns, fine_rows] = [columns * SAMPLES, rows * SAMPLES];
        let fine = |pixel: [f64; 2]| patch.area.local(pixel).map(|c| (c + 0.5) * SAMPLES as f64 - 0.5);

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

        let exposure = self.exposure * self.light_around(middle(seen), table);
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
                    let [red, green, blue] = sum;
                    let mean = |c: f64| (c / (SAMPLES * SAMPLES) as f64) as f32;
                    patch.values[y * columns + x] = [red, green, blue, count].map(mean);
                }
            }
        }
        patch
    }

    /// How bright the table is about a pixel, of its mean: there parts are as much brighter or darker.
    fn light_around(&self, [u, v]: [f64; 2], table: &[[f32; 3]]) -> f64 {
        let [width, height] = self.size();
        let range = |c: f64, side: usize| {
            let centre = c.clamp(0.0, side as f64 - 1.0) as usize;
            centre.saturating_sub(AROUND_PX)..(centre + AROUND_PX).min(side)
        };
        let columns = range(u, width);
        let (mut sum, mut count) = (0.0, 0usize);
        for y in range(v, height) {
            let row = &table[y * width..][columns.clone()];
            sum += row.iter().map(brightness).sum::<f64>();
            count += row.len();
        }
        let share = sum / count.max(1) as f64 / self.mean.max(f64::MIN_POSITIVE);
        share.clamp(UNEVEN[0], UNEVEN[1])
    }
}

/// Middle of the box about a part, in the image or beside it.
fn middle(seen: &[([f64; 2], f64)]) -> [f64; 2] {
    [0, 1].map(|axis| {
        let along = || seen.iter().map(|(pixel, _)| pixel[axis]);
        (along().fold(f64::INFINITY, f64::min) + along().fold(f64::NEG_INFINITY, f64::max)) / 2.0
    })
}

/// Linear luminance.
fn brightness(light: &[f32; 3]) -> f64 {
    f64::from(0.2126 * light[0] + 0.7152 * light[1] + 0.0722 * light[2])
}
