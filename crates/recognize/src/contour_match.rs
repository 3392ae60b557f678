//! Which parts an object looks like by its outline, and how they would lie (section 5.2 of the paper).
//!
//! In: the outline and the inner edges of one object, put on the table. Out: guesses of poses, by part: the rotation of
//! least total cost (eq 16), found coarse to fine, and a least-squares motion over the points that correspond.

use std::f64::consts::TAU;

use samsod_camera::Camera;
use samsod_shadow::ObjectRegion;

use crate::edge_model::{EdgeModel, extent, sampled};
use crate::gradient::Gradient;
use crate::pose_fit::{LocalView, Pose};
use crate::shape_context::{DIRECTIONS, ShapeContexts, along, rigid};

/// Every so many points of the object are looked at for all rotations,
const FIRST_STRIDE: usize = 6;
/// and then for the best so many of them
const SECOND_ROTATIONS: usize = 4;
/// every so many.
const SECOND_STRIDE: usize = 2;
/// Rotations whose points are assigned one to one.
const ASSIGNED: usize = 2;
/// when they cost no more than so many times the cheapest.
const MOST_OF_LEAST: f32 = 1.4;
/// Rounds of the weighted least squares.
const ROUNDS: usize = 5;
/// An inner edge has this share of the strongest gradient of the object, or more.
const INNER_SHARE: f32 = 0.3;
/// and is so far from its outline, px.
const INNER_DEPTH_PX: i32 = 4;
/// Points of an object's outline that are kept before they are thinned.
const OUTLINE_POINTS: usize = 256;

/// A pose that the outline suggests.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct ContourGuess {
    pub(crate) pose: Pose,
    /// Mean chi-square cost of the points that correspond, in [0, 1].
    pub(crate) cost: f32,
}

/// An object as shape contexts see it.
#[derive(Debug)]
pub(crate) struct Contour {
    /// Where its points lie in the frame, px.
    pixels: Vec<[f32; 2]>,
    /// And what they see of each other, on the table.
    contexts: ShapeContexts,
    /// Centroid of the mask on the table, mm.
    pub(crate) place_mm: [f64; 2],
    /// Area of the mask on the table, mm^2.
    area_mm2: f32,
    /// Standard deviations of its outline there, along its longest axis and across, mm.
    extent_mm: [f32; 2],
}

impl Contour {
    /// Of an object; `None` where the camera does not see the table there.
    pub(crate) fn of(object: &ObjectRegion, gradient: &Gradient, camera: &Camera) -> Option<Self> {
        // Not the holes of the mask: many are no holes of the part, and those that are have inner edges.
        let outline = along(&object.outline, OUTLINE_POINTS);
        let inner = inner_edges(object, gradient);
        let pixels = sampled(&outline, &inner);
        let centroid = object.centroid.map(f64::from);
        let [x, y, _] = camera.world_from_image(centroid, 0.0).ok()?;
        let local = LocalView::new(camera, x, y, 1.0)?;
        let on_table = |p: &[f32; 2]| {
            let [px, py] = local.world_from_image(p.map(f64::from), 0.0);
            [(px - x) as f32, (py - y) as f32]
        };
        let extent_mm = extent(&outline.iter().map(on_table).collect::<Vec<_>>());
        let contexts = ShapeContexts::of(pixels.iter().map(on_table).collect());
        let area_mm2 = object.area as f32 / local.px_per_mm().powi(2).max(1e-6);
        Some(Self { pixels, contexts, place_mm: [x, y], area_mm2, extent_mm })
    }

    /// How far area and extent are from those of a part, as logarithms of their ratios; 0 where they are the same. What
    /// is near is looked at first.
    pub(crate) fn distance(&self, model: &EdgeModel, height_mm: f64, camera: &Camera) -> f32 {
        let [x_mm, y_mm] = self.place_mm;
        let mut least = f32::INFINITY;
        // The silhouette of a high part depends on the side that it shows.
        for yaw_rad in [0.0, 0.25 * TAU, 0.5 * TAU, 0.75 * TAU] {
            let view = model.view(Pose { x_mm, y_mm, yaw_rad }.towards(camera, height_mm / 2.0));
            // The mask is lifted to the table, the view to half the height.
            let camera_mm = camera.world_from_camera().translation.z as f32;
            let scale = (camera_mm / (camera_mm - 0.5 * height_mm as f32)).clamp(1.0, 2.0);
            let ratio = |own: f32, theirs: f32| (own.max(1e-3) / theirs.max(1e-3)).ln().abs();
            let distance = ratio(self.area_mm2, view.area_mm2 * scale * scale)
                + ratio(self.extent_mm[0], view.extent_mm[0] * scale)
                + ratio(self.extent_mm[1], view.extent_mm[1] * scale);
            least = least.min(distance);
        }
        least
    }

    /// Poses of a part, the likeliest first.
    pub(crate) fn guesses(
        &self,
        model: &EdgeModel,
        height_mm: f64,
        symmetry: u32,
        camera: &Camera,
    ) -> Vec<ContourGuess> {
        let [x_mm, y_mm] = self.place_mm;
        let rotations = match symmetry {
            0 => 1,
            n => DIRECTIONS.div_ceil(n as usize),
        };
        let view_at = |k: usize| {
            let pose = Pose { x_mm, y_mm, yaw_rad: k as f64 / DIRECTIONS as f64 * TAU };
            model.view(pose.towards(camera, height_mm / 2.0))
        };
        let mut costs: Vec<(usize, f32)> = (0..rotations)
            .map(|k| (k, self.contexts.least_cost(&view_at(k).contexts.turned(k), FIRST_STRIDE)))
            .collect();
        costs.sort_by(|a, b| a.1.total_cmp(&b.1));
        costs.truncate(SECOND_ROTATIONS);
        for (k, cost) in &mut costs {
            *cost = self.contexts.least_cost(&view_at(*k).contexts.turned(*k), SECOND_STRIDE);
        }
        costs.sort_by(|a, b| a.1.total_cmp(&b.1));
        costs.truncate(ASSIGNED);
        let most = MOST_OF_LEAST * costs.first().map_or(0.0, |(_, cost)| *cost);
        costs.retain(|(_, cost)| *cost <= most);
        let Some(local) = LocalView::new(camera, x_mm, y_mm, height_mm) else { return Vec::new() };
        let mut guesses: Vec<ContourGuess> = costs
            .into_iter()
            .filter_map(|(k, _)| {
                let contexts = &view_at(k).contexts;
                let (columns, cost) = self.contexts.assign(&contexts.turned(k))?;
                // The contexts of the part lie at half its height, and so does what is seen of it.
                let mut pairs: Vec<([f32; 2], [f32; 2], f32)> = columns
                    .iter()
                    .zip(&self.pixels)
                    .map(|(&j, pixel)| {
                        let [px, py] = local.world_from_image(pixel.map(f64::from), 0.5 * height_mm as f32);
                        (contexts.points()[j], [(px - x_mm) as f32, (py - y_mm) as f32], 1.0)
                    })
                    .collect();
                let (yaw_rad, offset) = robust_rigid(&mut pairs)?;
                Some(ContourGuess { pose: Pose { x_mm: x_mm + offset[0], y_mm: y_mm + offset[1], yaw_rad }, cost })
            })
            .collect();
        guesses.sort_by(|a, b| a.cost.total_cmp(&b.cost));
        guesses
    }
}

/// Least squares that forget the pairs farthest apart.
fn robust_rigid(pairs: &mut [([f32; 2], [f32; 2], f32)]) -> Option<(f64, [f64; 2])> {
    let mut motion = rigid(pairs)?;
    for _ in 0..ROUNDS {
        let (sin, cos) = (motion.0.sin() as f32, motion.0.cos() as f32);
        let [tx, ty] = motion.1.map(|t| t as f32);
        let residual = |(a, b, _): &([f32; 2], [f32; 2], f32)| {
            (cos * a[0] - sin * a[1] + tx - b[0]).hypot(sin * a[0] + cos * a[1] + ty - b[1])
        };
        let mut residuals: Vec<f32> = pairs.iter().map(residual).collect();
        let reach = {
            let mut sorted = residuals.clone();
            let middle = sorted.len() / 2;
            2.5 * *sorted.select_nth_unstable_by(middle, f32::total_cmp).1 + 1e-3
        };
        for (pair, residual) in pairs.iter_mut().zip(residuals.drain(..)) {
            let ratio = (residual / reach).min(1.0);
            let inside = 1.0 - ratio * ratio;
            pair.2 = inside * inside;
        }
        motion = rigid(pairs)?;
    }
    Some(motion)
}

/// Pixels on clear edges inside an object, in the order of rows.
fn inner_edges(object: &ObjectRegion, gradient: &Gradient) -> Vec<[f32; 2]> {
    let b = object.mask.bbox();
    let inside = |x: i32, y: i32| x >= 0 && y >= 0 && object.mask.contains(x as u32, y as u32);
    let faintest = 3.0 * gradient.noise + 2.0;
    let mut found = Vec::new();
    for y in b.y as i32..=b.bottom() as i32 {
        for x in b.x as i32..=b.right() as i32 {
            let d = INNER_DEPTH_PX;
            let (column, row) = (x - gradient.left, y - gradient.top);
            // Most pixels are on no edge, which is told sooner than whether they are inside.
            if column < 0 || row < 0 || !gradient.exceeds(column as usize, row as usize, faintest) {
                continue;
            }
            if !inside(x, y) || ![(d, 0), (-d, 0), (0, d), (0, -d)].iter().all(|(dx, dy)| inside(x + dx, y + dy)) {
                continue;
            }
            if let Some((_, _, magnitude)) = gradient.ridge(column as usize, row as usize) {
                found.push((magnitude, [x as f32, y as f32]));
            }
        }
    }
    let strongest = found.iter().map(|edge| edge.0).fold(0.0, f32::max);
    let least = (INNER_SHARE * strongest).max(faintest);
    found.into_iter().filter(|edge| edge.0 >= least).map(|edge| edge.1).collect()
}
