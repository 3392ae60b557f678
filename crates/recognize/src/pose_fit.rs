//! The pose of a part that brings its edges onto those of the frame, and how well they agree.
//!
//! In: the [`EdgeModel`] of a part, a camera, the [`Gradient`] of a piece of the frame and a first guess of the pose. For
//! every point of the model the strongest edge along its normal is looked for; the three numbers of the pose (x, y, yaw
//! on the table) follow by least squares on the distances along the normals, reweighted, within ever shorter reach.

use nalgebra::{Matrix3, Vector3};
use samsod_camera::Camera;

use crate::edge_model::{EdgeModel, EdgePoint};
use crate::gradient::Gradient;

/// How far edges are looked for along the normals, px, step by step.
const REACH_PX: [f32; 7] = [9.0, 7.0, 5.0, 4.0, 3.0, 2.5, 2.5];
/// The same of a quick fit.
const QUICK_REACH_PX: [f32; 3] = [9.0, 6.0, 4.0];
/// It takes every so many points,
const QUICK_STRIDE: usize = 2;
/// and every so many for what it is worth.
const QUICK_SCORE_STRIDE: usize = 2;
/// Of the steps of a whole fit so many last ones take every point through the camera; those before take every second along straight
/// lines.
const EXACT_STEPS: usize = 2;
/// More of the last step, at most,
const MORE_STEPS: usize = 8;
/// until a step moves the farthest point of a part by less, mm.
const SETTLED_MM: f64 = 0.02;
/// Between the places that are looked at, px,
const STEP_PX: f32 = 1.0;
/// and how many there are to a side at most.
const MOST_STEPS: usize = 10;
/// Edges as far as this compete with that of a point, px.
const RIVAL_PX: f32 = 5.0;
/// and one this near is its own, px.
const HIT_PX: f32 = 1.5;
/// An edge this far from where it should be counts 1 / e, px.
const TOLERANCE_PX: f32 = 1.3;
/// Points of two outlines no farther apart than this, px, and of about one direction, are the same;
const LIKE_PX: f32 = 2.5;
const LIKE_COSINE: f32 = 0.7;
/// fewer that are not tell nothing,
const LEAST_LONE: usize = 4;
/// and so many all that they can.
const ENOUGH_LONE: usize = 16;
/// Edges with a sign are looked for here and so far to either side, px.
const SIGNED_STEP_PX: f32 = 0.75;

/// Where a part lies on the table.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Pose {
    pub(crate) x_mm: f64,
    pub(crate) y_mm: f64,
    pub(crate) yaw_rad: f64,
}

impl Pose {
    /// A point of the part in the world, mm.
    pub(crate) fn world_from_part(&self, [x, y, z]: [f32; 3]) -> [f64; 3] {
        let (sin, cos) = self.yaw_rad.sin_cos();
        let (x, y) = (f64::from(x), f64::from(y));
        [self.x_mm + cos * x - sin * y, self.y_mm + sin * x + cos * y, f64::from(z)]
    }

    /// The direction to the camera in the axes of the part, from a height over its origin.
    pub(crate) fn towards(&self, camera: &Camera, height_mm: f64) -> [f64; 3] {
        let at = camera.world_from_camera().translation.vector;
        let (dx, dy) = (at.x - self.x_mm, at.y - self.y_mm);
        let (sin, cos) = self.yaw_rad.sin_cos();
        [cos * dx + sin * dy, cos * dy - sin * dx, at.z - height_mm]
    }
}

/// A pose and how well it explains what is seen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Fit {
    pub(crate) pose: Pose,
    /// Share of the points of the outline that lie on edges, in [0, 1].
    pub(crate) outline: f32,
    /// Share of the points inside that do; that of the outline where there are none.
    pub(crate) inner: f32,
    /// Share of the points of the outline whose strongest edge within [`RIVAL_PX`] lies on them, beyond what chance
    /// gives; it does not ask how strong. In [0, 1].
    pub(crate) hits: f32,
}

/// The camera around a place on the table, by straight lines: derivatives of (u, v) by x and by y of the world at two
/// heights, between which they are interpolated, and by z.
#[derive(Debug, Clone, Copy)]
pub(crate) struct LocalView {
    place: [f64; 2],
    origin: [f64; 2],
    low: [[f32; 2]; 2],
    high: [[f32; 2]; 2],
    rise: [f32; 2],
    height: f32,
}

impl LocalView {
    /// At a place on the table, for parts of a height; `None` where the camera does not see it.
    pub(crate) fn new(camera: &Camera, x: f64, y: f64, height_mm: f64) -> Option<Self> {
        let height_mm = height_mm.max(1.0);
        let at = |dx: f64, dy: f64, z: f64| camera.image_from_world([x + dx, y + dy, z]).ok();
        let slope = |z: f64| {
            let (right, left, up, down) = (at(1.0, 0.0, z)?, at(-1.0, 0.0, z)?, at(0.0, 1.0, z)?, at(0.0, -1.0, z)?);
            let half = |a: [f64; 2], b: [f64; 2]| [0, 1].map(|i| ((a[i] - b[i]) / 2.0) as f32);
            Some([half(right, left), half(up, down)])
        };
        let (origin, top) = (at(0.0, 0.0, 0.0)?, at(0.0, 0.0, height_mm)?);
        let rise = [0, 1].map(|i| ((top[i] - origin[i]) / height_mm) as f32);
        let (low, high) = (slope(0.0)?, slope(height_mm)?);
        Some(Self { place: [x, y], origin, low, high, rise, height: height_mm as f32 })
    }

    /// Derivatives of (u, v) by world x and by world y at a height.
    pub(crate) fn slopes(&self, z: f32) -> [[f32; 2]; 2] {
        let t = z / self.height;
        [0, 1].map(|axis| [0, 1].map(|i| self.low[axis][i] + t * (self.high[axis][i] - self.low[axis][i])))
    }

    /// Pixels from the origin of the place to a point so far from it, mm.
    pub(crate) fn image_offset(&self, [x, y, z]: [f32; 3]) -> [f32; 2] {
        let [by_x, by_y] = self.slopes(z);
        [0, 1].map(|i| by_x[i] * x + by_y[i] * y + self.rise[i] * z)
    }

    /// The point of the world at a height that is seen at a pixel, mm.
    pub(crate) fn world_from_image(&self, [u, v]: [f64; 2], z: f32) -> [f64; 2] {
        let [[a, c], [b, d]] = self.slopes(z).map(|s| s.map(f64::from));
        let [rise_u, rise_v] = self.rise.map(|r| f64::from(r * z));
        let (du, dv) = (u - self.origin[0] - rise_u, v - self.origin[1] - rise_v);
        let det = a * d - b * c;
        [self.place[0] + (d * du - b * dv) / det, self.place[1] + (a * dv - c * du) / det]
    }

    /// The pixel of the place itself.
    pub(crate) fn origin(&self) -> [f64; 2] {
        self.origin
    }

    /// Pixels a millimetre at the upper height.
    pub(crate) fn px_per_mm(&self) -> f32 {
        (self.high[0][0] * self.high[1][1] - self.high[0][1] * self.high[1][0]).abs().sqrt()
    }
}

/// A point of the model in the image.
#[derive(Debug, Clone, Copy)]
struct Projected {
    at: [f32; 2],
    normal: [f32; 2],
    /// Derivatives of the position by x, y (px / mm) and yaw (px / rad).
    slopes: [[f32; 2]; 3],
    outline: bool,
}

/// Every `stride`-th point of a model as a pose puts it into the image: through the camera (`exact`), or along straight
/// lines.
fn project(
    model: &EdgeModel,
    height_mm: f64,
    camera: &Camera,
    pose: &Pose,
    exact: bool,
    stride: usize,
    points: &mut Vec<Projected>,
) -> Option<()> {
    let view = model.view(pose.towards(camera, height_mm / 2.0));
    project_points(&view.points, height_mm, camera, pose, exact, stride, points)
}

/// [`project`] for points of a part of some height.
fn project_points(
    edges: &[EdgePoint],
    height_mm: f64,
    camera: &Camera,
    pose: &Pose,
    exact: bool,
    stride: usize,
    points: &mut Vec<Projected>,
) -> Option<()> {
    points.clear();
    let local = LocalView::new(camera, pose.x_mm, pose.y_mm, height_mm)?;
    let (sin, cos) = (pose.yaw_rad.sin() as f32, pose.yaw_rad.cos() as f32);
    let turned = |[x, y, z]: [f32; 3]| [cos * x - sin * y, sin * x + cos * y, z];
    let origin = local.origin().map(|c| c as f32);
    for point in edges.iter().step_by(stride) {
        let offset = turned(point.position);
        let along = local.image_offset(offset);
        let at = if exact {
            let Ok(at) = camera.image_from_world(pose.world_from_part(point.position)) else { continue };
            at.map(|c| c as f32)
        } else {
            [0, 1].map(|i| origin[i] + along[i])
        };
        let ahead = local.image_offset(turned(std::array::from_fn(|i| point.position[i] + point.tangent[i])));
        let (tu, tv) = (ahead[0] - along[0], ahead[1] - along[1]);
        let norm = tu.hypot(tv);
        if norm < 1e-3 {
            continue;
        }
        let [by_x, by_y] = local.slopes(point.position[2]);
        let by_yaw = [0, 1].map(|i| -offset[1] * by_x[i] + offset[0] * by_y[i]);
        points.push(Projected {
            at,
            normal: [-tv / norm, tu / norm],
            slopes: [by_x, by_y, by_yaw],
            outline: point.outline,
        });
    }
    Some(())
}

/// How far along the normals edges are looked for.
#[derive(Debug, Clone)]
struct Reach {
    steps: usize,
    /// Weights of the places from the point outwards: e^-(distance / tolerance)^2.
    weights: [f32; MOST_STEPS + 1],
}

impl Reach {
    fn new(reach_px: f32, tolerance_px: f32) -> Self {
        let weight = |k: usize| {
            let ratio = k as f32 * STEP_PX / tolerance_px;
            (-ratio * ratio).exp()
        };
        Self { steps: ((reach_px / STEP_PX).round() as usize).min(MOST_STEPS), weights: std::array::from_fn(weight) }
    }

    /// How much there is of an edge at a point, in [0, 1].
    fn share(&self, gradient: &Gradient, point: &Projected, tolerance_px: f32) -> f32 {
        self.edge(gradient, point).map_or(0.0, |(offset, response)| {
            let ratio = offset / tolerance_px;
            response * (-ratio * ratio).exp()
        })
    }

    /// The edge along the normal of a point: offset, px, and response in [0, 1]; `None` where the frame ends.
    fn edge(&self, gradient: &Gradient, point: &Projected) -> Option<(f32, f32)> {
        let radius = (self.steps + 1) as f32 * STEP_PX;
        if !gradient.holds(point.at[0], point.at[1], radius) {
            return None;
        }
        let at = |k: i32| {
            let offset = k as f32 * STEP_PX;
            [point.at[0] + offset * point.normal[0], point.at[1] + offset * point.normal[1]]
        };
        let (mut best, mut most, mut response) = (0, -1.0, 0.0);
        for k in -(self.steps as i32)..=self.steps as i32 {
            let [u, v] = at(k);
            let here = gradient.response_across(u, v, point.normal);
            let weighed = here * self.weights[k.unsigned_abs() as usize];
            if weighed > most {
                (best, most, response) = (k, weighed, here);
            }
        }
        // Between the places by a parabola through the gradient across.
        let across = |k: i32| {
            let [u, v] = at(k);
            let (dx, dy) = gradient.at(u, v)?;
            Some((dx * point.normal[0] + dy * point.normal[1]).abs())
        };
        let mut offset = best as f32 * STEP_PX;
        if let (Some(before), Some(here), Some(after)) = (across(best - 1), across(best), across(best + 1)) {
            let bend = before - 2.0 * here + after;
            if bend < -1e-6 {
                offset += (0.5 * (before - after) / bend).clamp(-0.5, 0.5) * STEP_PX;
            }
        }
        Some((offset, response))
    }
}

/// Scratch memory of one thread.
#[derive(Debug, Default)]
pub(crate) struct Fitter {
    points: Vec<Projected>,
}

impl Fitter {
    /// Improves a pose and says how well it fits; `None` when the camera does not see the part.
    pub(crate) fn fit(
        &mut self,
        model: &EdgeModel,
        height_mm: f64,
        camera: &Camera,
        gradient: &Gradient,
        guess: Pose,
    ) -> Option<Fit> {
        let mut pose = guess;
        let last = REACH_PX.len() - 1;
        for i in 0..=last + MORE_STEPS {
            let (reach, exact) = (REACH_PX[i.min(last)], i + EXACT_STEPS > last);
            project(model, height_mm, camera, &pose, exact, if exact { 1 } else { 2 }, &mut self.points)?;
            let step = self.step(gradient, reach, f64::from(model.radius_mm))?;
            pose.x_mm += step[0];
            pose.y_mm += step[1];
            pose.yaw_rad += step[2];
            // A fit that came from far has not arrived with the last reach.
            if i >= last && step[0].hypot(step[1]) + step[2].abs() * f64::from(model.radius_mm) < SETTLED_MM {
                break;
            }
        }
        self.score(model, height_mm, camera, gradient, pose)
    }

    /// A rough [`Self::fit`] at a tenth of its price: the pose and its shares of points on edges, of the outline and
    /// inside.
    pub(crate) fn quick(
        &mut self,
        model: &EdgeModel,
        height_mm: f64,
        camera: &Camera,
        gradient: &Gradient,
        guess: Pose,
    ) -> Option<(Pose, [f32; 2])> {
        let mut pose = guess;
        for reach in QUICK_REACH_PX {
            project(model, height_mm, camera, &pose, false, QUICK_STRIDE, &mut self.points)?;
            let step = self.step(gradient, reach, f64::from(model.radius_mm))?;
            pose.x_mm += step[0];
            pose.y_mm += step[1];
            pose.yaw_rad += step[2];
        }
        let shares = self.edge_shares(model, height_mm, camera, gradient, pose)?;
        Some((pose, shares))
    }

    /// Least squares over the distances along the normals.
    fn step(&self, gradient: &Gradient, reach_px: f32, radius_mm: f64) -> Option<Vector3<f64>> {
        let mut normal = Matrix3::<f64>::zeros();
        let mut right = Vector3::<f64>::zeros();
        let along = Reach::new(reach_px, 0.7 * reach_px);
        for point in &self.points {
            let Some((offset, strength)) = along.edge(gradient, point) else { continue };
            let ratio = offset / (reach_px + 1.0);
            let robust = 1.0 - ratio * ratio;
            let weight = f64::from(strength * robust * robust);
            let row: Vector3<f64> = Vector3::from_fn(|i, _| {
                f64::from(point.slopes[i][0] * point.normal[0] + point.slopes[i][1] * point.normal[1])
            });
            normal += weight * row * row.transpose();
            right += weight * f64::from(offset) * row;
        }
        // A round part has no yaw, a bar hardly a place along itself: a faint wish to stay. One pixel is as much along
        // the table as at the end of the part.
        let wish = 1e-3 * (normal[(0, 0)] + normal[(1, 1)]) + 1e-9;
        for i in 0..3 {
            normal[(i, i)] += if i < 2 { wish } else { wish * radius_mm * radius_mm };
        }
        let step = normal.cholesky()?.solve(&right);
        step.iter().all(|c| c.is_finite()).then_some(step)
    }

    /// How well a pose fits as it is.
    pub(crate) fn score(
        &mut self,
        model: &EdgeModel,
        height_mm: f64,
        camera: &Camera,
        gradient: &Gradient,
        pose: Pose,
    ) -> Option<Fit> {
        project(model, height_mm, camera, &pose, true, 1, &mut self.points)?;
        let [outline, inner] = self.shares(gradient)?;
        let (mut hits, mut count) = (0u32, 0u32);
        let rivals = Reach::new(RIVAL_PX, 3.0 * RIVAL_PX);
        for point in self.points.iter().filter(|point| point.outline) {
            count += 1;
            if rivals.edge(gradient, point).is_some_and(|(offset, _)| offset.abs() <= HIT_PX) {
                hits += 1;
            }
        }
        let chance = (2.0 * HIT_PX + 1.0) / (2.0 * RIVAL_PX + 1.0);
        let hits = ((hits as f32 / count.max(1) as f32 - chance) / (1.0 - chance)).max(0.0);
        Some(Fit { pose, outline, inner, hits })
    }

    /// The shares of the points on edges that a pose gives as it is: of the outline, and inside.
    pub(crate) fn edge_shares(
        &mut self,
        model: &EdgeModel,
        height_mm: f64,
        camera: &Camera,
        gradient: &Gradient,
        pose: Pose,
    ) -> Option<[f32; 2]> {
        project(model, height_mm, camera, &pose, false, QUICK_SCORE_STRIDE, &mut self.points)?;
        self.shares(gradient)
    }

    /// The share on edges of the points that tell the turns of a part apart whose outline hardly does.
    pub(crate) fn mark_share(
        &mut self,
        model: &EdgeModel,
        height_mm: f64,
        camera: &Camera,
        gradient: &Gradient,
        pose: &Pose,
    ) -> Option<f32> {
        project_points(&model.marks, height_mm, camera, pose, true, 1, &mut self.points)?;
        let along = Reach::new(2.0 * TOLERANCE_PX, TOLERANCE_PX);
        Some(
            self.points.iter().map(|point| along.share(gradient, point, TOLERANCE_PX)).sum::<f32>()
                / self.points.len().max(1) as f32,
        )
    }

    /// How much more a second pose has on edges than a first, of the points of the outline of which the other has no like, in
    /// [-1, 1]; 0 where one of them has hardly any. The teeth of a gear are the same at many turns, its keyway is not.
    pub(crate) fn lone_lead(
        &mut self,
        model: &EdgeModel,
        height_mm: f64,
        camera: &Camera,
        gradient: &Gradient,
        poses: [&Pose; 2],
    ) -> Option<f32> {
        let mut outlines = [Vec::new(), Vec::new()];
        for (outline, pose) in outlines.iter_mut().zip(poses) {
            project(model, height_mm, camera, pose, true, 1, &mut self.points)?;
            outline.extend(self.points.iter().filter(|point| point.outline).copied());
        }
        // A part beside glare is fitted less well than others.
        let along = Reach::new(3.0 * TOLERANCE_PX, 2.0 * TOLERANCE_PX);
        let share = |own: &[Projected], other: &[Projected]| {
            let is_lone = |point: &&Projected| {
                !other.iter().any(|other| {
                    let across = point.normal[0] * other.normal[0] + point.normal[1] * other.normal[1];
                    (point.at[0] - other.at[0]).hypot(point.at[1] - other.at[1]) <= LIKE_PX
                        && across.abs() >= LIKE_COSINE
                })
            };
            let lone: Vec<f32> =
                own.iter().filter(is_lone).map(|point| along.share(gradient, point, 2.0 * TOLERANCE_PX)).collect();
            let mean = lone.iter().sum::<f32>() / lone.len().max(1) as f32;
            (mean, lone.len())
        };
        let (first, second) = (share(&outlines[0], &outlines[1]), share(&outlines[1], &outlines[0]));
        let count = first.1.min(second.1);
        let weight = if count < LEAST_LONE { 0.0 } else { (count as f32 / ENOUGH_LONE as f32).min(1.0) };
        Some(weight * (second.0 - first.0))
    }

    /// How well the frame shows some edges of the template at a pose, light where they are light: the mean cosine between
    /// their gradients and those of the frame, which counts less where that is faint; in [-1, 1].
    pub(crate) fn signed_share(
        &mut self,
        edges: &[EdgePoint],
        height_mm: f64,
        camera: &Camera,
        gradient: &Gradient,
        pose: &Pose,
    ) -> Option<f32> {
        project_points(edges, height_mm, camera, pose, true, 1, &mut self.points)?;
        let faint = 2.0 * gradient.noise + 1.0;
        let agreement = |point: &Projected| {
            let at = |k: i32| {
                let offset = SIGNED_STEP_PX * k as f32;
                let [u, v] = [0, 1].map(|i| point.at[i] + offset * point.normal[i]);
                // The normal points to where the template is darker.
                let (dx, dy) = gradient.at(u, v)?;
                Some(-(dx * point.normal[0] + dy * point.normal[1]) / (dx.hypot(dy) + faint))
            };
            (-1..=1).filter_map(at).max_by(f32::total_cmp).unwrap_or(0.0)
        };
        Some(self.points.iter().map(agreement).sum::<f32>() / self.points.len().max(1) as f32)
    }

    fn shares(&self, gradient: &Gradient) -> Option<[f32; 2]> {
        let (mut sums, mut counts) = ([0.0f32; 2], [0u32; 2]);
        let along = Reach::new(2.0 * TOLERANCE_PX, TOLERANCE_PX);
        for point in &self.points {
            let kind = usize::from(!point.outline);
            counts[kind] += 1;
            if let Some((offset, strength)) = along.edge(gradient, point) {
                let ratio = offset / TOLERANCE_PX;
                sums[kind] += strength * (-ratio * ratio).exp();
            }
        }
        if counts[0] == 0 {
            return None;
        }
        let outline = sums[0] / counts[0] as f32;
        Some([outline, if counts[1] == 0 { outline } else { sums[1] / counts[1] as f32 }])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_parts::{Block, FLAT_L, overhead, paint, part, table, tilted};

    /// The outline of a model is known to half a pixel of its depth image, a quarter of one of the camera.
    const MOST_PX: f64 = 0.25;
    const MOST_DEG: f64 = 0.2;

    /// Of a painted part, from a guess 3 px and 3 degrees away: what is left, px and degrees, and the fit.
    fn left_over(blocks: &[Block], with_mesh: bool, camera: &Camera, pose: Pose) -> (f64, f64, Fit) {
        let part = part("part", blocks, with_mesh);
        let model = EdgeModel::of(&part);
        let mut image = table();
        paint(&mut image, blocks, camera, &pose);
        let gradient = Gradient::of_image(&image);
        let local = LocalView::new(camera, pose.x_mm, pose.y_mm, part.height_mm).unwrap();
        let px_per_mm = f64::from(local.px_per_mm());
        let guess = Pose {
            x_mm: pose.x_mm + 1.8 / px_per_mm,
            y_mm: pose.y_mm - 2.4 / px_per_mm,
            yaw_rad: pose.yaw_rad + 3.0f64.to_radians(),
        };
        let fit = Fitter::default().fit(&model, part.height_mm, camera, &gradient, guess).unwrap();
        let off = (fit.pose.x_mm - pose.x_mm).hypot(fit.pose.y_mm - pose.y_mm) * px_per_mm;
        (off, (fit.pose.yaw_rad - pose.yaw_rad).to_degrees().abs(), fit)
    }

    #[test]
    fn a_painted_part_is_found_to_a_fraction_of_a_pixel_and_of_a_degree() {
        for yaw_deg in [0.0f64, 20.0, 77.0, 151.0, -122.0, -45.0] {
            for (x_mm, y_mm) in [(0.3, -0.2), (40.0, 25.0), (-55.0, 10.0)] {
                let pose = Pose { x_mm, y_mm, yaw_rad: yaw_deg.to_radians() };
                let (px, deg, fit) = left_over(&FLAT_L, true, &overhead(), pose);
                assert!(px < MOST_PX && deg < MOST_DEG, "{px} px, {deg} deg at {pose:?}");
                assert!(fit.outline > 0.8 && fit.hits > 0.9, "{fit:?}");
                assert_eq!(fit.inner, fit.outline, "it has no edges inside");
            }
        }
    }

    #[test]
    fn a_tilted_camera_with_distortion_is_as_exact() {
        for yaw_deg in [10.0f64, 100.0, -160.0] {
            for (x_mm, y_mm) in [(0.0, 0.0), (60.0, 40.0), (-60.0, -45.0)] {
                let pose = Pose { x_mm, y_mm, yaw_rad: yaw_deg.to_radians() };
                let (px, deg, _) = left_over(&FLAT_L, true, &tilted(), pose);
                assert!(px < MOST_PX && deg < MOST_DEG, "{px} px, {deg} deg at {pose:?}");
            }
        }
    }

    #[test]
    fn a_part_without_a_mesh_is_found_as_exactly_as_its_mask_is() {
        for yaw_deg in [0.0f64, 65.0, -130.0] {
            let pose = Pose { x_mm: 25.0, y_mm: -15.0, yaw_rad: yaw_deg.to_radians() };
            let (px, deg, _) = left_over(&FLAT_L, false, &overhead(), pose);
            assert!(px < 0.3 && deg < 0.2, "{px} px, {deg} deg at {pose:?}");
        }
    }

    #[test]
    fn a_high_part_is_found_where_it_stands_off_the_axis_of_the_camera() {
        // Its top lies 2 to 4 mm beside its foot in the picture.
        let high: Vec<Block> = FLAT_L.iter().map(|[low, [x, y, _]]| [*low, [*x, *y, 25.0]]).collect();
        for (x_mm, y_mm) in [(50.0, 30.0), (-70.0, 20.0), (0.0, -60.0)] {
            let pose = Pose { x_mm, y_mm, yaw_rad: 0.6 };
            let (px, deg, _) = left_over(&high, true, &overhead(), pose);
            assert!(px < 0.8 && deg < 0.8, "{px} px, {deg} deg at {pose:?}");
        }
    }

    #[test]
    fn nothing_is_found_on_a_bare_table() {
        let part = part("part", &FLAT_L, true);
        let (model, gradient) = (EdgeModel::of(&part), Gradient::of_image(&table()));
        let pose = Pose { x_mm: 5.0, y_mm: 5.0, yaw_rad: 0.3 };
        let fit = Fitter::default().fit(&model, 4.0, &overhead(), &gradient, pose);
        assert!(fit.is_none_or(|fit| fit.outline < 0.05 && fit.inner < 0.05), "{fit:?}");
        // Nor far outside of the frame.
        let pose = Pose { x_mm: 4000.0, y_mm: 0.0, yaw_rad: 0.0 };
        let fit = Fitter::default().fit(&model, 4.0, &overhead(), &gradient, pose);
        assert!(fit.is_none_or(|fit| fit.outline == 0.0), "{fit:?}");
    }

    #[test]
    fn straight_lines_near_a_place_are_those_of_the_camera() {
        for camera in [overhead(), tilted()] {
            let local = LocalView::new(&camera, 40.0, -30.0, 25.0).unwrap();
            for [x, y, z] in [[0.0, 0.0, 0.0], [8.0, -5.0, 0.0], [-6.0, 7.0, 25.0], [3.0, 9.0, 12.0]] {
                let exact = camera.image_from_world([40.0 + x, -30.0 + y, z]).unwrap();
                let [du, dv] = local.image_offset([x as f32, y as f32, z as f32]).map(f64::from);
                let near = [local.origin()[0] + du, local.origin()[1] + dv];
                let off = (exact[0] - near[0]).hypot(exact[1] - near[1]);
                assert!(off < 0.25, "{off} px at {x} {y} {z}");
                let [bx, by] = local.world_from_image(near, z as f32);
                assert!((bx - 40.0 - x).hypot(by + 30.0 - y) < 1e-3, "{bx} {by} for {x} {y} {z}");
            }
        }
        assert!(LocalView::new(&overhead(), f64::NAN, 0.0, 5.0).is_none());
    }

    #[test]
    fn the_direction_to_the_camera_is_in_the_axes_of_the_part() {
        let pose = Pose { x_mm: 100.0, y_mm: 0.0, yaw_rad: std::f64::consts::FRAC_PI_2 };
        let [x, y, z] = pose.towards(&overhead(), 10.0);
        // The camera is at (0, 0, 500): 100 mm towards -x of the world, which is +y of the part.
        assert!(x.abs() < 1e-9 && (y - 100.0).abs() < 1e-9 && (z - 490.0).abs() < 1e-9, "{x} {y} {z}");
    }

    #[test]
    fn a_notch_tells_turns_apart_that_look_alike() {
        // A square with a notch in the middle of its right side.
        let notched: [Block; 3] = [
            [[-30.0, -30.0, 0.0], [16.0, 30.0, 5.0]],
            [[16.0, -30.0, 0.0], [30.0, -8.0, 5.0]],
            [[16.0, 8.0, 0.0], [30.0, 30.0, 5.0]],
        ];
        let (part, camera) = (part("notched", &notched, true), overhead());
        let model = EdgeModel::of(&part);
        let pose = Pose { x_mm: 20.0, y_mm: -10.0, yaw_rad: 0.5 };
        let mut image = table();
        paint(&mut image, &notched, &camera, &pose);
        let gradient = Gradient::of_image(&image);
        let mut fitter = Fitter::default();
        for quarter in 1..4 {
            let turned = Pose { yaw_rad: pose.yaw_rad + f64::from(quarter) * std::f64::consts::FRAC_PI_2, ..pose };
            let lead = fitter.lone_lead(&model, 5.0, &camera, &gradient, [&turned, &pose]).unwrap();
            assert!(lead > 0.3, "{lead} at {quarter} quarters");
            assert_eq!(fitter.lone_lead(&model, 5.0, &camera, &gradient, [&pose, &turned]), Some(-lead));
        }
        assert_eq!(fitter.lone_lead(&model, 5.0, &camera, &gradient, [&pose, &pose]), Some(0.0));
    }
}
