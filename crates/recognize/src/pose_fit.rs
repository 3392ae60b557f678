//! The pose of a part that brings its edges onto those of the frame, and how well they agree.
//!
//! In: the [`EdgeModel`] of a part, a camera, the [`Gradient`] of a piece of the frame and a first guess of the pose. For
//! every point of the model the strongest edge along its normal is looked for; the three numbers of the pose (x, y, yaw
//! on the table) follow by least squares on the distances along the normals, reweighted, within ever shorter reach.

use nalgebra::{Matrix3, Point3, Vector3};
use samsod_camera::Camera;

use crate::edge_lanes::{Block, Edges, LANES, Lanes, Reach, Wide, find_edges};
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

    /// [`Self::slopes`] at several heights.
    #[inline(always)]
    fn slopes_of(&self, z: Wide) -> [[Wide; 2]; 2] {
        let t = (1.0 / self.height) * z;
        let [[a, b], [c, d]] = self.low;
        let [[e, f], [g, h]] = self.high;
        [[Wide::of(a) + (e - a) * t, Wide::of(b) + (f - b) * t], [Wide::of(c) + (g - c) * t, Wide::of(d) + (h - d) * t]]
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

/// A camera around a part that lies at a pose, in single precision: what [`Camera::image_from_world`] says of its points
/// to a thousandth of a pixel, for the price of a few multiplications.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Projector {
    /// The camera from the part: rows, and the origin of the part.
    rows: [[f32; 3]; 3],
    at: [f32; 3],
    focal: [f32; 2],
    center: [f32; 2],
    /// k1, k2, k3 and p1, p2 of the lens,
    radial: [f32; 3],
    tangential: [f32; 2],
    /// of which rays longer than the root of this are outside.
    reach2: f32,
}

impl Projector {
    pub(crate) fn new(camera: &Camera, pose: &Pose) -> Self {
        let camera_from_world = camera.world_from_camera().inverse();
        let turn = camera_from_world.rotation.to_rotation_matrix();
        let (sin, cos) = pose.yaw_rad.sin_cos();
        let row = |i: usize| {
            let [x, y, z] = [0, 1, 2].map(|j| turn[(i, j)]);
            [cos * x + sin * y, cos * y - sin * x, z].map(|c| c as f32)
        };
        let at = camera_from_world.transform_point(&Point3::new(pose.x_mm, pose.y_mm, 0.0));
        let lens = camera.intrinsics().params();
        let reach = camera.intrinsics().longest_ray().min(1e9) as f32;
        Self {
            rows: [row(0), row(1), row(2)],
            at: [at.x, at.y, at.z].map(|c| c as f32),
            focal: [lens.fx_px, lens.fy_px].map(|c| c as f32),
            center: [lens.cx_px, lens.cy_px].map(|c| c as f32),
            radial: [lens.k1, lens.k2, lens.k3].map(|c| c as f32),
            tangential: [lens.p1, lens.p2].map(|c| c as f32),
            reach2: reach * reach,
        }
    }

    /// The pixels of points of the part, and 1 where the camera sees them, else 0.
    #[inline(always)]
    pub(crate) fn image_from_part(&self, [x, y, z]: [Wide; 3]) -> ([Wide; 2], Wide) {
        let [[ax, ay, az], [bx, by, bz], [cx, cy, cz]] = self.rows;
        let depth = cx * x + cy * y + cz * z + Wide::of(self.at[2]);
        let scale = depth.recip();
        let a = (ax * x + ay * y + az * z + Wide::of(self.at[0])) * scale;
        let b = (bx * x + by * y + bz * z + Wide::of(self.at[1])) * scale;
        let (aa, bb, ab) = (a * a, b * b, a * b);
        let r2 = aa + bb;
        let [k1, k2, k3] = self.radial;
        let radial = Wide::of(1.0) + r2 * (Wide::of(k1) + r2 * (Wide::of(k2) + k3 * r2));
        let [p1, p2] = self.tangential;
        let u = a * radial + (2.0 * p1) * ab + p2 * (r2 + 2.0 * aa);
        let v = b * radial + p1 * (r2 + 2.0 * bb) + (2.0 * p2) * ab;
        let at = [self.focal[0] * u + Wide::of(self.center[0]), self.focal[1] * v + Wide::of(self.center[1])];
        let is_seen = Wide::of(f32::MIN_POSITIVE).at_most(depth).only(r2.at_most(Wide::of(self.reach2)));
        (at, is_seen)
    }
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
    blocks: &mut Vec<Block>,
) -> Option<()> {
    let view = model.view(pose.towards(camera, height_mm / 2.0));
    project_points(&view.points, height_mm, camera, pose, exact, stride, blocks)
}

/// [`project`] for points of a part of some height.
fn project_points(
    edges: &[EdgePoint],
    height_mm: f64,
    camera: &Camera,
    pose: &Pose,
    exact: bool,
    stride: usize,
    blocks: &mut Vec<Block>,
) -> Option<()> {
    blocks.clear();
    let local = LocalView::new(camera, pose.x_mm, pose.y_mm, height_mm)?;
    let exact = exact.then(|| Projector::new(camera, pose));
    let view = PartView { local, exact, sin: pose.yaw_rad.sin() as f32, cos: pose.yaw_rad.cos() as f32 };
    #[cfg(target_arch = "x86_64")]
    if std::arch::is_x86_feature_detected!("avx2") {
        // SAFETY: the processor was just found to have AVX2, the only feature the function asks for.
        unsafe { put_avx2(&view, edges, stride, blocks) };
        return Some(());
    }
    put(&view, edges, stride, blocks);
    Some(())
}

/// How a part at a pose is seen.
#[derive(Debug, Clone, Copy)]
struct PartView {
    local: LocalView,
    /// For places that are more exact than along straight lines.
    exact: Option<Projector>,
    sin: f32,
    cos: f32,
}

/// [`put`] in registers of eight; the same operations in the same order.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn put_avx2(view: &PartView, edges: &[EdgePoint], stride: usize, blocks: &mut Vec<Block>) {
    put(view, edges, stride, blocks);
}

#[inline(always)]
fn put(view: &PartView, edges: &[EdgePoint], stride: usize, blocks: &mut Vec<Block>) {
    let mut chosen = edges.iter().step_by(stride);
    loop {
        let (mut positions, mut tangents) = ([[0.0; LANES]; 3], [[0.0; LANES]; 3]);
        let (mut outline, mut inner, mut count) = ([0.0; LANES], [0.0; LANES], 0);
        for (lane, point) in chosen.by_ref().take(LANES).enumerate() {
            for axis in 0..3 {
                positions[axis][lane] = point.position[axis];
                tangents[axis][lane] = point.tangent[axis];
            }
            (outline[lane], inner[lane]) = if point.outline { (1.0, 0.0) } else { (0.0, 1.0) };
            count += 1;
        }
        if count > 0 {
            blocks.push(view.block(&positions, &tangents, &outline, &inner));
        }
        if count < LANES {
            return;
        }
    }
}

impl PartView {
    /// Eight points of the part as they are seen; one that is not seen is none.
    #[inline(always)]
    fn block(&self, positions: &[Lanes; 3], tangents: &[Lanes; 3], outline: &Lanes, inner: &Lanes) -> Block {
        let local = &self.local;
        let (x, y, z) = (Wide(positions[0]), Wide(positions[1]), Wide(positions[2]));
        let (tx, ty, tz) = (Wide(tangents[0]), Wide(tangents[1]), Wide(tangents[2]));
        let (dx, dy) = (self.cos * x - self.sin * y, self.sin * x + self.cos * y);
        let (ax, ay, az) = (dx + self.cos * tx - self.sin * ty, dy + self.sin * tx + self.cos * ty, z + tz);
        let (here, ahead) = (local.slopes_of(z), local.slopes_of(az));
        let [rise_u, rise_v] = local.rise;
        let straight_u = here[0][0] * dx + here[1][0] * dy + rise_u * z;
        let straight_v = here[0][1] * dx + here[1][1] * dy + rise_v * z;
        let along_u = ahead[0][0] * ax + ahead[1][0] * ay + rise_u * az - straight_u;
        let along_v = ahead[0][1] * ax + ahead[1][1] * ay + rise_v * az - straight_v;
        let (at, is_seen) = match &self.exact {
            Some(projector) => projector.image_from_part([x, y, z]),
            None => {
                let origin = local.origin.map(|c| Wide::of(c as f32));
                ([origin[0] + straight_u, origin[1] + straight_v], Wide::of(1.0))
            }
        };
        let norm = (along_u * along_u + along_v * along_v).sqrt();
        // Of what is seen along itself there is no edge.
        let is_seen = is_seen.only(Wide::of(1e-3).at_most(norm));
        let length = norm.max(Wide::of(1e-3)).recip().only(is_seen);
        let (nu, nv) = (Wide::of(0.0) - along_v * length, along_u * length);
        let (nu, nv) = (nu.only(is_seen), nv.only(is_seen));
        let (yaw_u, yaw_v) = (here[1][0] * dx - here[0][0] * dy, here[1][1] * dx - here[0][1] * dy);
        let slopes = [
            here[0][0] * nu + here[0][1] * nv,
            here[1][0] * nu + here[1][1] * nv,
            (yaw_u * nu + yaw_v * nv).only(is_seen),
        ];
        let [at_u, at_v] = at;
        Block::new(
            [at_u.0, at_v.0],
            [nu.0, nv.0],
            [slopes[0].0, slopes[1].0, slopes[2].0],
            Wide(*outline).only(is_seen).0,
            Wide(*inner).only(is_seen).0,
        )
    }
}

/// e^-(x^2) to half a percent.
#[inline(always)]
fn bell(x: Wide) -> Wide {
    let mut power = (Wide::of(1.0) - (1.0 / 256.0) * (x * x)).max(Wide::of(0.0));
    for _ in 0..8 {
        power = power * power;
    }
    power
}

/// A point of an outline: where it is, px, across what, and how much there is of an edge.
#[derive(Debug, Clone, Copy)]
struct Rim {
    at: [f32; 2],
    across: [f32; 2],
    share: f32,
}

/// Scratch memory of one thread.
#[derive(Debug, Default)]
pub(crate) struct Fitter {
    points: Vec<Block>,
    edges: Vec<Edges>,
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
    fn step(&mut self, gradient: &Gradient, reach_px: f32, radius_mm: f64) -> Option<Vector3<f64>> {
        find_edges(gradient, &Reach::new(reach_px, 0.7 * reach_px), &self.points, &mut self.edges);
        // Sums of the products of the slopes, of which six differ, and of those with the offsets.
        let (mut products, mut offsets) = ([Wide::of(0.0); 6], [Wide::of(0.0); 3]);
        for (block, edges) in self.points.iter().zip(&self.edges) {
            let offset = Wide(edges.offset);
            let ratio = (1.0 / (reach_px + 1.0)) * offset;
            let robust = Wide::of(1.0) - ratio * ratio;
            let weight = Wide(edges.response) * robust * robust;
            let [x, y, yaw] = block.slopes.map(Wide);
            let (wx, wy, wyaw) = (weight * x, weight * y, weight * yaw);
            for (sum, product) in products.iter_mut().zip([wx * x, wx * y, wx * yaw, wy * y, wy * yaw, wyaw * yaw]) {
                *sum = *sum + product;
            }
            for (sum, weighed) in offsets.iter_mut().zip([wx, wy, wyaw]) {
                *sum = *sum + weighed * offset;
            }
        }
        let sum = |lanes: &Wide| lanes.0.iter().map(|&lane| f64::from(lane)).sum::<f64>();
        let [xx, xy, xt, yy, yt, tt] = products.each_ref().map(sum);
        let mut normal = Matrix3::new(xx, xy, xt, xy, yy, yt, xt, yt, tt);
        let right = Vector3::from(offsets.each_ref().map(sum));
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
        find_edges(gradient, &Reach::new(RIVAL_PX, 3.0 * RIVAL_PX), &self.points, &mut self.edges);
        let (mut hits, mut count) = (0.0f32, 0.0f32);
        for (block, edges) in self.points.iter().zip(&self.edges) {
            for lane in 0..LANES {
                let near = if edges.offset[lane].abs() <= HIT_PX { edges.held[lane] } else { 0.0 };
                hits += near * block.outline[lane];
                count += block.outline[lane];
            }
        }
        let chance = (2.0 * HIT_PX + 1.0) / (2.0 * RIVAL_PX + 1.0);
        let hits = ((hits / count.max(1.0) - chance) / (1.0 - chance)).max(0.0);
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
        let [sums, counts] = self.sums(gradient);
        Some((sums[0] + sums[1]) / (counts[0] + counts[1]).max(1.0))
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
        // A part beside glare is fitted less well than others.
        let tolerance_px = 2.0 * TOLERANCE_PX;
        let along = Reach::new(3.0 * TOLERANCE_PX, tolerance_px);
        let mut outlines: [Vec<Rim>; 2] = [Vec::new(), Vec::new()];
        for (outline, pose) in outlines.iter_mut().zip(poses) {
            project(model, height_mm, camera, pose, true, 1, &mut self.points)?;
            find_edges(gradient, &along, &self.points, &mut self.edges);
            for (block, edges) in self.points.iter().zip(&self.edges) {
                for lane in (0..LANES).filter(|&lane| block.outline[lane] > 0.0) {
                    let ratio = edges.offset[lane] / tolerance_px;
                    let (at, across) = block.point(lane);
                    outline.push(Rim { at, across, share: edges.response[lane] * (-ratio * ratio).exp() });
                }
            }
        }
        let share = |own: &[Rim], other: &[Rim]| {
            let is_lone = |rim: &&Rim| {
                !other.iter().any(|other| {
                    let [dx, dy] = [0, 1].map(|i| rim.at[i] - other.at[i]);
                    let cosine = rim.across[0] * other.across[0] + rim.across[1] * other.across[1];
                    dx * dx + dy * dy <= LIKE_PX * LIKE_PX && cosine.abs() >= LIKE_COSINE
                })
            };
            let lone: Vec<f32> = own.iter().filter(is_lone).map(|rim| rim.share).collect();
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
        let agreement = |(point, across): ([f32; 2], [f32; 2])| {
            let at = |k: i32| {
                let offset = SIGNED_STEP_PX * k as f32;
                let [u, v] = [0, 1].map(|i| point[i] + offset * across[i]);
                // The normal points to where the template is darker.
                let (dx, dy) = gradient.at(u, v)?;
                Some(-(dx * across[0] + dy * across[1]) / (dx.hypot(dy) + faint))
            };
            (-1..=1).filter_map(at).max_by(f32::total_cmp).unwrap_or(0.0)
        };
        let seen = self.points.iter().flat_map(|block| {
            (0..LANES).filter(|&lane| block.outline[lane] + block.inner[lane] > 0.0).map(|lane| block.point(lane))
        });
        let (sum, count) = seen.fold((0.0, 0u32), |(sum, count), point| (sum + agreement(point), count + 1));
        Some(sum / count.max(1) as f32)
    }

    fn shares(&mut self, gradient: &Gradient) -> Option<[f32; 2]> {
        let [sums, counts] = self.sums(gradient);
        if counts[0] <= 0.0 {
            return None;
        }
        let outline = sums[0] / counts[0];
        Some([outline, if counts[1] <= 0.0 { outline } else { sums[1] / counts[1] }])
    }

    /// What the points of the outline, and those inside, find of edges, and their numbers.
    fn sums(&mut self, gradient: &Gradient) -> [[f32; 2]; 2] {
        find_edges(gradient, &Reach::new(2.0 * TOLERANCE_PX, TOLERANCE_PX), &self.points, &mut self.edges);
        let (mut sums, mut counts) = ([Wide::of(0.0); 2], [Wide::of(0.0); 2]);
        for (block, edges) in self.points.iter().zip(&self.edges) {
            let found = Wide(edges.response) * bell((1.0 / TOLERANCE_PX) * Wide(edges.offset));
            for (kind, members) in [block.outline, block.inner].into_iter().enumerate() {
                sums[kind] = sums[kind] + Wide(members) * found;
                counts[kind] = counts[kind] + Wide(members);
            }
        }
        [sums.map(|lanes| lanes.0.iter().sum()), counts.map(|lanes| lanes.0.iter().sum())]
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
    fn single_precision_sees_points_where_the_camera_does() {
        let pose = Pose { x_mm: 55.0, y_mm: -38.0, yaw_rad: 2.2 };
        let points: Vec<[f32; 3]> = (0..64)
            .map(|i| [i % 4, i / 4 % 4, i / 16])
            .map(|[x, y, z]| [30.0 * x as f32 - 45.0, 20.0 * y as f32 - 31.0, 9.0 * z as f32])
            .collect();
        for camera in [overhead(), tilted()] {
            let projector = Projector::new(&camera, &pose);
            for points in points.chunks(LANES) {
                let of = |axis: usize| Wide(std::array::from_fn(|lane| points[lane][axis]));
                let ([Wide(u), Wide(v)], Wide(is_seen)) = projector.image_from_part([of(0), of(1), of(2)]);
                for (lane, point) in points.iter().enumerate() {
                    let exact = camera.image_from_world(pose.world_from_part(*point)).unwrap();
                    let off = (exact[0] - f64::from(u[lane])).hypot(exact[1] - f64::from(v[lane]));
                    assert!(off < 2e-3 && is_seen[lane] == 1.0, "{off} px at {point:?}");
                }
            }
            // What lies above the camera is behind it.
            let above = [Wide::of(0.0), Wide::of(0.0), Wide::of(5000.0)];
            assert_eq!(projector.image_from_part(above).1.0, [0.0; LANES]);
        }
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
