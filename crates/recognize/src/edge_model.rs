//! The edges of a part as cameras see them from above.
//!
//! In: the [`Mesh`] of a part, or its template where there is none. Out: an [`EdgeModel`]: for a grid of directions to
//! the camera, points on the edges that are visible from there: on the outline, where the mesh hides the table, and
//! inside of it, where the template shows edges on the surface of the mesh. Points are in the frame of the part, so that
//! a pose and a camera take them to the image with parallax. A depth image tells what is hidden.

use std::collections::HashSet;
use std::f32::consts::{PI, TAU};

use nalgebra::{UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

use crate::catalogue::Part;
use crate::flat_edges::{flat_edges, part_from_template};
use crate::lettering::Lettering;
use crate::mesh::Mesh;
use crate::ring_letters::ring_letters;
use crate::shape_context::ShapeContexts;
use crate::template_edges::{TemplateEdge, template_edges};

/// Between the rings of directions, rad from the vertical.
const TILT_STEP: f32 = 8.0 * PI / 180.0;
/// Rings beside the vertical; beyond the last the picture from above says little.
const RINGS: usize = 5;
/// Directions of a ring.
const AZIMUTHS: usize = 12;
/// Pixels of the depth image for one of the camera.
const DEPTH_SCALE: f32 = 2.0;
/// but its diagonal has at most so many.
const MOST_DEPTH_PX: f32 = 1200.0;
/// Half the window over which the direction of an outline is taken, in pixels of the depth image: two of the camera, so
/// that what it cannot resolve (threads, knurls) has no direction of its own.
const OUTLINE_WINDOW: isize = 4;
/// Points of the outline, and inside of it, that are kept for a view.
const OUTLINE_POINTS: f32 = 140.0;
const INNER_POINTS: f32 = 100.0;

/// Turns of a circle that are looked at for an outline that nearly repeats,
const TURNS: usize = 120;
/// and so many of which make it nearly round:
const ROUND_TURNS: usize = 4;
/// those where this share of it lies on itself,
const ALIKE_SHARE: f32 = 0.8;
/// to a distance of this share of the radius of the part.
const ALIKE_SHARE_OF_RADIUS: f32 = 0.05;
/// Turns that are looked at for teeth,
const TOOTH_TURNS: usize = 1440;
/// which come to lie on each other to about this share of the radius
const TOOTH_SHARE_OF_RADIUS: f32 = 0.025;
/// in so much of the outline,
const LEAST_TOOTH_SHARE: f32 = 0.7;
/// and between teeth in so much less.
const TOOTH_CONTRAST: f32 = 0.25;
/// Contrast of lettering, sRGB levels a pixel: less is shading, which comes from where the light does.
const LETTERING: f32 = 14.0;
/// Points that tell such turns apart, at most,
const MARKS: usize = 160;
/// and at least,
const LEAST_MARKS: usize = 12;
/// and how far they must come to lie from any edge, mm, about.
const MARK_MM: f32 = 1.0;
/// Points that stand for the area of a part.
pub(crate) const SURFACE_POINTS: f32 = 80.0;
/// Points that a shape is matched by (section 5.2), and those of them inside.
pub(crate) const SHAPE_POINTS: usize = 64;
pub(crate) const SHAPE_INNER_POINTS: usize = 16;

/// A point on an edge of a part.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(crate) struct EdgePoint {
    /// In the frame of the part, mm.
    pub(crate) position: [f32; 3],
    /// Direction of the edge there, of length 1.
    pub(crate) tangent: [f32; 3],
    /// Whether the table is on its other side.
    pub(crate) outline: bool,
    /// Whether that is the table around the part, not what a hole shows.
    pub(crate) outer: bool,
}

/// What is seen from one direction.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct ViewEdges {
    pub(crate) points: Vec<EdgePoint>,
    /// Points spread over all that is seen of the part, mm.
    pub(crate) surface: Vec<[f32; 3]>,
    /// Area of the silhouette on the horizontal plane of half the height of the part, mm^2.
    pub(crate) area_mm2: f32,
    /// Standard deviations of the outer outline there along its longest axis and across, mm.
    pub(crate) extent_mm: [f32; 2],
    /// Shape contexts of some of the points, put on the horizontal plane of half the height of the part along the
    /// direction: as a camera there sees them, in the axes of the part, mm.
    pub(crate) contexts: ShapeContexts,
}

impl ViewEdges {
    /// `area_mm2` is that across the direction.
    pub(crate) fn new(
        points: Vec<EdgePoint>,
        surface: Vec<[f32; 3]>,
        area_mm2: f32,
        direction: [f32; 3],
        height_mm: f32,
    ) -> Self {
        let flat = |p: &EdgePoint| {
            let slope = (p.position[2] - 0.5 * height_mm) / direction[2].max(0.1);
            [p.position[0] - slope * direction[0], p.position[1] - slope * direction[1]]
        };
        let of = |outer: bool| points.iter().filter(move |p| p.outer == outer).map(flat).collect::<Vec<_>>();
        let outer = of(true);
        let extent_mm = extent(&outer);
        let contexts = ShapeContexts::of(sampled(&outer, &of(false)));
        Self { points, surface, area_mm2: area_mm2 / direction[2].max(0.1), extent_mm, contexts }
    }
}

/// Standard deviations of some points along their longest axis and across it.
pub(crate) fn extent(points: &[[f32; 2]]) -> [f32; 2] {
    let n = points.len().max(1) as f32;
    let mean = [0, 1].map(|i| points.iter().map(|p| p[i]).sum::<f32>() / n);
    let product = |i: usize, j: usize| points.iter().map(|p| (p[i] - mean[i]) * (p[j] - mean[j])).sum::<f32>() / n;
    let (xx, xy, yy) = (product(0, 0), product(0, 1), product(1, 1));
    let (half, root) = ((xx + yy) / 2.0, ((xx - yy) / 2.0).hypot(xy));
    [(half + root).sqrt(), (half - root).max(0.0).sqrt()]
}

/// [`SHAPE_POINTS`] points of an outline and of what is inside, evenly; fewer only where there is no outline.
pub(crate) fn sampled(outline: &[[f32; 2]], inner: &[[f32; 2]]) -> Vec<[f32; 2]> {
    let every = |points: &[[f32; 2]], count: usize| -> Vec<[f32; 2]> {
        (0..count.min(points.len() * count)).map(|i| points[(2 * i + 1) * points.len() / (2 * count)]).collect()
    };
    let inner_count = SHAPE_INNER_POINTS.min(inner.len());
    let mut points = every(outline, SHAPE_POINTS - inner_count);
    points.extend(every(inner, inner_count));
    points
}

/// The edges of a part from all directions.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct EdgeModel {
    /// From above, then ring by ring; or one that serves for all.
    views: Vec<ViewEdges>,
    /// Greatest distance of a point from the z axis, mm.
    pub(crate) radius_mm: f32,
    /// Turns, rad, after which the outline is nearly the same, so that only what is inside tells them apart; without 0.
    pub(crate) look_alike_turns: Vec<f32>,
    /// Points inside, seen from above, that such turns move off all edges: what tells the turns apart.
    pub(crate) marks: Vec<EdgePoint>,
    /// Edges of the lettering of a round part.
    pub(crate) letters: Vec<EdgePoint>,
    /// What is written on a part whose outline repeats and whose picture does not.
    pub(crate) lettering: Option<Lettering>,
}

impl EdgeModel {
    /// Of a part with or without a mesh.
    pub(crate) fn of(part: &Part) -> Self {
        match &part.mesh {
            Some(mesh) => {
                let edges = template_edges(part, mesh);
                let letters = ring_letters(part, &level_edges(&edges));
                let model = Self::of_mesh(mesh, &edges, 1.0 / px_per_mm(part));
                Self { letters, lettering: Lettering::of(part, mesh), ..model }
            }
            None => {
                let view = flat_edges(part);
                let inner: Vec<EdgePoint> = view.points.iter().filter(|p| !p.outline).copied().collect();
                Self::new(vec![view], &inner)
            }
        }
    }

    /// `level` are edges inside on level surfaces, the strongest first.
    fn new(views: Vec<ViewEdges>, level: &[EdgePoint]) -> Self {
        let radius = |p: &EdgePoint| p.position[0].hypot(p.position[1]);
        let radius_mm = views.iter().flat_map(|view| &view.points).map(radius).fold(0.0, f32::max);
        let look_alike_turns = views.first().map_or_else(Vec::new, |view| look_alike_turns(view, radius_mm));
        let marks = views.first().map_or_else(Vec::new, |view| marks(view, level, &look_alike_turns));
        Self { views, radius_mm, look_alike_turns, marks, letters: Vec::new(), lettering: None }
    }

    /// Of a mesh, for a camera one of whose pixels sees so many millimetres of it.
    pub(crate) fn of_mesh(mesh: &Mesh, inner: &[TemplateEdge], mm_per_px: f32) -> Self {
        use rayon::prelude::*;
        let directions: Vec<Vector3<f32>> = directions().collect();
        let level = level_edges(inner);
        let views = directions.par_iter().map(|direction| seen_from(mesh, inner, *direction, mm_per_px)).collect();
        Self::new(views, &level)
    }

    /// What is seen from a direction (towards the camera, in the frame of the part; of any length).
    pub(crate) fn view(&self, towards_camera: [f64; 3]) -> &ViewEdges {
        let [x, y, z] = towards_camera.map(|c| c as f32);
        let tilt = x.hypot(y).atan2(z);
        let ring = ((tilt / TILT_STEP).round().max(0.0) as usize).min(RINGS);
        let index = if ring == 0 {
            0
        } else {
            let turn = (y.atan2(x).rem_euclid(TAU) / TAU * AZIMUTHS as f32).round() as usize % AZIMUTHS;
            1 + (ring - 1) * AZIMUTHS + turn
        };
        &self.views[index.min(self.views.len() - 1)]
    }
}

/// Edges of the strength of lettering on level surfaces, in their order.
fn level_edges(edges: &[TemplateEdge]) -> Vec<EdgePoint> {
    let edge = |e: &TemplateEdge| EdgePoint {
        position: e.position.into(),
        tangent: e.tangent.into(),
        outline: false,
        outer: false,
    };
    edges.iter().filter(|e| e.level && e.strength >= LETTERING).map(edge).collect()
}

/// Of the edges inside, given the strongest first, those that most of the turns move to where none is.
fn marks(view: &ViewEdges, inner: &[EdgePoint], turns: &[f32]) -> Vec<EdgePoint> {
    if turns.is_empty() {
        return Vec::new();
    }
    let cell = |x: f32, y: f32| [(x / MARK_MM).round() as i32, (y / MARK_MM).round() as i32];
    let direction = |x: f32, y: f32| (y.atan2(x).rem_euclid(PI) / PI * 4.0) as i32 % 4;
    let edges: HashSet<([i32; 2], i32)> = inner
        .iter()
        .chain(&view.points)
        .map(|p| (cell(p.position[0], p.position[1]), direction(p.tangent[0], p.tangent[1])))
        .collect();
    let moves_off = |p: &EdgePoint| {
        let off = |turn: &&f32| {
            let (sin, cos) = turn.sin_cos();
            let turned = |[x, y, _]: [f32; 3]| (cos * x - sin * y, sin * x + cos * y);
            let ((x, y), (tx, ty)) = (turned(p.position), turned(p.tangent));
            let [column, row] = cell(x, y);
            let along = direction(tx, ty);
            let near = (-1..=1).flat_map(|dx| (-1..=1).map(move |dy| [column + dx, row + dy]));
            !near.into_iter().any(|cell| (-1..=1).any(|k| edges.contains(&(cell, (along + k).rem_euclid(4)))))
        };
        2 * turns.iter().filter(off).count() > turns.len()
    };
    // One for a cell and direction, so that they are spread.
    let mut taken = HashSet::new();
    let mut spread =
        |p: &&EdgePoint| taken.insert((cell(p.position[0], p.position[1]), direction(p.tangent[0], p.tangent[1])));
    let marks: Vec<EdgePoint> =
        inner.iter().filter(|p| moves_off(p)).filter(|p| spread(p)).take(MARKS).copied().collect();
    if marks.len() < LEAST_MARKS { Vec::new() } else { marks }
}

/// The turns after which most of an outline lies on itself.
fn look_alike_turns(view: &ViewEdges, radius_mm: f32) -> Vec<f32> {
    let outline: Vec<[f32; 2]> =
        view.points.iter().filter(|p| p.outline).map(|p| [p.position[0], p.position[1]]).collect();
    let near = (ALIKE_SHARE_OF_RADIUS * radius_mm).powi(2);
    let share = |turn: f32| {
        let (sin, cos) = turn.sin_cos();
        let on_itself = |p: &&[f32; 2]| {
            let (x, y) = (cos * p[0] - sin * p[1], sin * p[0] + cos * p[1]);
            outline.iter().any(|q| (q[0] - x).powi(2) + (q[1] - y).powi(2) <= near)
        };
        outline.iter().filter(on_itself).count() as f32 / outline.len().max(1) as f32
    };
    let shares: Vec<f32> = (0..TURNS).map(|k| share(k as f32 / TURNS as f32 * TAU)).collect();
    let alike = |k: usize| {
        let (before, after) = (shares[(k + TURNS - 1) % TURNS], shares[(k + 1) % TURNS]);
        // Turns so small are found by the fit.
        let far = (4..=TURNS - 4).contains(&k);
        far && shares[k] >= ALIKE_SHARE && shares[k] >= before && shares[k] >= after
    };
    let alike: Vec<usize> = (0..TURNS).filter(|&k| alike(k)).collect();
    // Turns beside each other that are equally alike are one.
    let found: Vec<usize> = alike.chunk_by(|a, b| b - a <= 2).map(|group| group[group.len() / 2]).collect();
    // A nearly round part may lie at any angle when its outline has been fitted, but for its teeth.
    if found.len() >= ROUND_TURNS {
        let teeth = tooth_turns(view, radius_mm);
        if !teeth.is_empty() {
            return teeth;
        }
    }
    let turns = if found.len() >= ROUND_TURNS { (1..TURNS).collect() } else { found };
    turns.into_iter().map(|k| k as f32 / TURNS as f32 * TAU).collect()
}

/// The turns that bring the outer outline of a part with teeth onto itself, without 0; none of a part without.
fn tooth_turns(view: &ViewEdges, radius_mm: f32) -> Vec<f32> {
    let outer: Vec<[f32; 2]> = view.points.iter().filter(|p| p.outer).map(|p| [p.position[0], p.position[1]]).collect();
    let near = (TOOTH_SHARE_OF_RADIUS * radius_mm).powi(2);
    let share = |turn: f32| {
        let (sin, cos) = turn.sin_cos();
        let least = |p: &[f32; 2]| {
            let (x, y) = (cos * p[0] - sin * p[1], sin * p[0] + cos * p[1]);
            let squares = outer.iter().map(|q| (q[0] - x).powi(2) + (q[1] - y).powi(2));
            (-squares.fold(f32::MAX, f32::min) / near).exp()
        };
        outer.iter().map(least).sum::<f32>() / outer.len().max(1) as f32
    };
    let at = |k: usize| (k % TOOTH_TURNS) as f32 / TOOTH_TURNS as f32 * TAU;
    let shares: Vec<f32> = (0..TOOTH_TURNS).map(|k| share(at(k))).collect();
    let (least, most) = shares[TOOTH_TURNS / 60..TOOTH_TURNS - TOOTH_TURNS / 60]
        .iter()
        .fold((1.0f32, 0.0f32), |(l, m), s| (l.min(*s), m.max(*s)));
    if most < LEAST_TOOTH_SHARE || most - least < TOOTH_CONTRAST {
        return Vec::new();
    }
    let middle = 0.5 * (least + most);
    let is_peak = |k: &usize| {
        let window = (1..=TOOTH_TURNS / 90).flat_map(|d| [k + TOOTH_TURNS - d, k + d]);
        shares[*k] >= middle && window.into_iter().all(|j| shares[j % TOOTH_TURNS] <= shares[*k])
    };
    (1..TOOTH_TURNS).filter(is_peak).map(at).collect()
}

/// Pixels of the template a millimetre, at the height of the part.
fn px_per_mm(part: &Part) -> f32 {
    let center = [f64::from(part.template.mask.width()) / 2.0, f64::from(part.template.mask.height()) / 2.0];
    match (part_from_template(part, center), part_from_template(part, [center[0] + 1.0, center[1]])) {
        (Some(a), Some(b)) => (1.0 / (a[0] - b[0]).hypot(a[1] - b[1]).max(1e-3)) as f32,
        _ => 1.0,
    }
}

/// The directions of the views, in their order.
fn directions() -> impl Iterator<Item = Vector3<f32>> {
    let ring = |ring: usize| {
        let (sin, cos) = (ring as f32 * TILT_STEP).sin_cos();
        (0..AZIMUTHS).map(move |k| {
            let azimuth = k as f32 / AZIMUTHS as f32 * TAU;
            Vector3::new(sin * azimuth.cos(), sin * azimuth.sin(), cos)
        })
    };
    std::iter::once(Vector3::z()).chain((1..=RINGS).flat_map(ring))
}

fn seen_from(mesh: &Mesh, inner: &[TemplateEdge], direction: Vector3<f32>, mm_per_px: f32) -> ViewEdges {
    let extent = |axis: usize| {
        let all = mesh.vertices().iter().map(|v| v[axis]);
        all.clone().fold(f32::MIN, f32::max) - all.fold(f32::MAX, f32::min)
    };
    let diagonal = extent(0).hypot(extent(1)).hypot(extent(2));
    let depth = DepthImage::render(mesh, direction, (mm_per_px / DEPTH_SCALE).max(diagonal / MOST_DEPTH_PX));
    let mut points = Vec::new();
    depth.outline().thin(&depth, OUTLINE_POINTS, true, &mut points);
    let around = depth.around();
    for point in &mut points {
        point.outer = depth.is_beside(&around, Vector3::from(point.position));
    }
    let mut visible = Samples::default();
    for edge in inner.iter().filter(|edge| depth.sees_inside(edge.position, mm_per_px)) {
        visible.push(edge.position, edge.tangent, mm_per_px);
    }
    visible.thin(&depth, INNER_POINTS, false, &mut points);
    ViewEdges::new(points, depth.surface(), depth.area_mm2(), direction.into(), mesh.height_mm())
}

/// Points along edges, dense.
#[derive(Debug, Default)]
struct Samples {
    /// Position, direction, and length that it stands for, mm.
    points: Vec<(Vector3<f32>, Vector3<f32>, f32)>,
}

impl Samples {
    fn push(&mut self, position: Vector3<f32>, tangent: Vector3<f32>, length: f32) {
        self.points.push((position, tangent, length));
    }

    /// Keeps about `count` of them, evenly: one for every cell and direction.
    fn thin(&self, depth: &DepthImage, count: f32, outline: bool, points: &mut Vec<EdgePoint>) {
        let length: f32 = self.points.iter().map(|point| point.2).sum();
        let spacing = (length / count).max(depth.mm_per_px);
        let mut taken = HashSet::new();
        for (position, tangent, _) in &self.points {
            let [x, y] = depth.across(*position).map(|c| (c / spacing).floor() as i32);
            let along = depth.across(*tangent);
            let turn = (along[1].atan2(along[0]).rem_euclid(PI) / PI * 4.0) as i32 % 4;
            if taken.insert([x, y, turn]) {
                points.push(EdgePoint {
                    position: (*position).into(),
                    tangent: (*tangent).into(),
                    outline,
                    outer: false,
                });
            }
        }
    }
}

/// Depth towards the camera along parallel rays.
#[derive(Debug)]
struct DepthImage {
    turn: UnitQuaternion<f32>,
    mm_per_px: f32,
    origin: [f32; 2],
    width: usize,
    height: usize,
    /// Coordinate along the direction; `-inf` where nothing is.
    depth: Vec<f32>,
}

impl DepthImage {
    fn render(mesh: &Mesh, direction: Vector3<f32>, mm_per_px: f32) -> Self {
        // The shortest turn keeps image right near the x axis of the part.
        let turn = UnitQuaternion::rotation_between(&direction, &Vector3::z()).unwrap_or_else(UnitQuaternion::identity);
        let turned: Vec<Vector3<f32>> = mesh.vertices().iter().map(|v| turn * Vector3::from(*v)).collect();
        let (mut low, mut high) = ([f32::MAX; 2], [f32::MIN; 2]);
        for v in &turned {
            for axis in 0..2 {
                low[axis] = low[axis].min(v[axis]);
                high[axis] = high[axis].max(v[axis]);
            }
        }
        let margin = 3.0 * mm_per_px;
        let origin = low.map(|c| c - margin);
        let side = |axis: usize| ((high[axis] - low[axis] + 2.0 * margin) / mm_per_px).ceil() as usize + 1;
        let (width, height) = (side(0), side(1));
        let mut depth = vec![f32::NEG_INFINITY; width * height];
        let to_px = |v: &Vector3<f32>| [(v.x - origin[0]) / mm_per_px, (v.y - origin[1]) / mm_per_px, v.z];
        for t in mesh.triangles() {
            let corners = t.map(|i| to_px(&turned[i as usize]));
            fill_triangle(corners, width, height, |index, z| {
                let cell: &mut f32 = &mut depth[index];
                *cell = cell.max(z);
            });
        }
        Self { turn, mm_per_px, origin, width, height, depth }
    }

    /// A point across the direction, mm.
    fn across(&self, position: Vector3<f32>) -> [f32; 2] {
        let p = self.turn * position;
        [p.x, p.y]
    }

    /// Whether a point is seen, with the part around it for a pixel of the camera.
    fn sees_inside(&self, position: Vector3<f32>, camera_mm_per_px: f32) -> bool {
        let p = self.turn * position;
        let column = ((p.x - self.origin[0]) / self.mm_per_px).round() as isize;
        let row = ((p.y - self.origin[1]) / self.mm_per_px).round() as isize;
        let at = |x: isize, y: isize| self.get(x, y).unwrap_or(f32::NEG_INFINITY);
        let around = (-1..=1).flat_map(|dy| (-1..=1).map(move |dx| (column + dx, row + dy)));
        // Something much nearer all around hides it.
        let farthest = around.map(|(x, y)| at(x, y)).fold(f32::INFINITY, f32::min);
        let reach = (camera_mm_per_px / self.mm_per_px).ceil() as isize;
        let table = [(reach, 0), (-reach, 0), (0, reach), (0, -reach), (0, 0)]
            .iter()
            .any(|(dx, dy)| at(column + dx, row + dy) == f32::NEG_INFINITY);
        !table && farthest <= p.z + 2.0 * self.mm_per_px
    }

    fn get(&self, x: isize, y: isize) -> Option<f32> {
        let inside = x >= 0 && y >= 0 && (x as usize) < self.width && (y as usize) < self.height;
        inside.then(|| self.depth[y as usize * self.width + x as usize])
    }

    /// The border to the table, where it is seen: points of the part.
    fn outline(&self) -> Samples {
        let mut samples = Samples::default();
        let back = self.turn.inverse();
        let on_part = |x: isize, y: isize| self.get(x, y).is_some_and(f32::is_finite);
        for y in 0..self.height as isize {
            for x in 0..self.width as isize {
                if !on_part(x, y) || [(1, 0), (-1, 0), (0, 1), (0, -1)].iter().all(|(dx, dy)| on_part(x + dx, y + dy)) {
                    continue;
                }
                let mut normal = [0.0f32; 2];
                for dy in -OUTLINE_WINDOW..=OUTLINE_WINDOW {
                    for dx in -OUTLINE_WINDOW..=OUTLINE_WINDOW {
                        if dx * dx + dy * dy <= OUTLINE_WINDOW * OUTLINE_WINDOW && on_part(x + dx, y + dy) {
                            normal[0] -= dx as f32;
                            normal[1] -= dy as f32;
                        }
                    }
                }
                let norm = normal[0].hypot(normal[1]);
                if norm < 1.0 {
                    continue;
                }
                let [nx, ny] = normal.map(|c| c / norm);
                // The border lies half a pixel outside of the centres of its pixels.
                let px = x as f32 + 0.5 * nx;
                let py = y as f32 + 0.5 * ny;
                let z = self.depth[y as usize * self.width + x as usize];
                let (u, v) = (self.origin[0] + px * self.mm_per_px, self.origin[1] + py * self.mm_per_px);
                let tangent = Vector3::new(-ny, nx, 0.0);
                // Of a line at 45 degrees there are fewer pixels than it is long.
                let length = self.mm_per_px / nx.abs().max(ny.abs());
                samples.push(back * Vector3::new(u, v, z), back * tangent, length);
            }
        }
        samples
    }

    /// The pixels of the table around the part: those that the border of the image reaches.
    fn around(&self) -> Vec<bool> {
        let mut reached = vec![false; self.depth.len()];
        let mut open = vec![0usize];
        while let Some(i) = open.pop() {
            if std::mem::replace(&mut reached[i], true) {
                continue;
            }
            let (x, y) = (i % self.width, i / self.width);
            let beside = [
                (x > 0).then(|| i - 1),
                (x + 1 < self.width).then_some(i + 1),
                (y > 0).then(|| i - self.width),
                (y + 1 < self.height).then_some(i + self.width),
            ];
            open.extend(beside.into_iter().flatten().filter(|&j| !reached[j] && self.depth[j] == f32::NEG_INFINITY));
        }
        reached
    }

    /// Whether one of some pixels lies beside a point.
    fn is_beside(&self, pixels: &[bool], position: Vector3<f32>) -> bool {
        let [x, y] = self.across(position);
        let column = ((x - self.origin[0]) / self.mm_per_px).round() as isize;
        let row = ((y - self.origin[1]) / self.mm_per_px).round() as isize;
        (-2..=2).flat_map(|dy| (-2..=2).map(move |dx| (column + dx, row + dy))).any(|(x, y)| {
            let inside = x >= 0 && y >= 0 && (x as usize) < self.width && (y as usize) < self.height;
            inside && pixels[y as usize * self.width + x as usize]
        })
    }

    /// About [`SURFACE_POINTS`] points of the part on a square grid.
    fn surface(&self) -> Vec<[f32; 3]> {
        let back = self.turn.inverse();
        let pixels = self.depth.iter().filter(|z| z.is_finite()).count();
        let step = ((pixels as f32 / SURFACE_POINTS).sqrt() as usize).max(1);
        let mut points = Vec::new();
        for y in (step / 2..self.height).step_by(step) {
            for x in (step / 2..self.width).step_by(step) {
                let z = self.depth[y * self.width + x];
                if z.is_finite() {
                    let at =
                        [self.origin[0] + x as f32 * self.mm_per_px, self.origin[1] + y as f32 * self.mm_per_px, z];
                    points.push((back * Vector3::from(at)).into());
                }
            }
        }
        points
    }

    fn area_mm2(&self) -> f32 {
        self.depth.iter().filter(|z| z.is_finite()).count() as f32 * self.mm_per_px * self.mm_per_px
    }
}

/// Calls `set` for every pixel whose centre lies in a triangle, with the third coordinate there.
pub(crate) fn fill_triangle(corners: [[f32; 3]; 3], width: usize, height: usize, mut set: impl FnMut(usize, f32)) {
    let [a, b, c] = corners;
    // First and last pixel along an axis; conversions to integers saturate.
    let extent = |axis: usize, most: usize| {
        let least = a[axis].min(b[axis]).min(c[axis]);
        let last = a[axis].max(b[axis]).max(c[axis]);
        let whole = least as i32;
        let first = whole.saturating_add(i32::from(least > whole as f32)).max(0);
        (first, if last < 0.0 { -1 } else { (last as i32).min(most as i32 - 1) })
    };
    // Most triangles of a fine mesh lie between the pixels.
    let ((left, right), (top, bottom)) = (extent(0, width), extent(1, height));
    if left > right || top > bottom {
        return;
    }
    let double_area = (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1]);
    // NaN is no area, either.
    if !(double_area.abs() >= 1e-9 && double_area.is_finite()) {
        return;
    }
    let scale = 1.0 / double_area;
    // Weights of a and b at the first pixel, and how they change from pixel to pixel.
    let (x, y) = (left as f32, top as f32);
    let mut row_a = ((b[0] - x) * (c[1] - y) - (c[0] - x) * (b[1] - y)) * scale;
    let mut row_b = ((c[0] - x) * (a[1] - y) - (a[0] - x) * (c[1] - y)) * scale;
    let (a_by_x, a_by_y) = ((b[1] - c[1]) * scale, (c[0] - b[0]) * scale);
    let (b_by_x, b_by_y) = ((c[1] - a[1]) * scale, (a[0] - c[0]) * scale);
    let slopes = [a_by_x, b_by_x, -a_by_x - b_by_x];
    let inverses = slopes.map(|slope| 1.0 / slope);
    let columns = (right - left) as f32;
    for y in top as usize..=bottom as usize {
        // Of a long thin triangle few pixels of a row are inside: from where to where no weight is negative, and one more to
        // either side, for what rounding does.
        let (mut first, mut last) = (0.0f32, columns);
        for ((weight, slope), inverse) in [row_a, row_b, 1.0 - row_a - row_b].into_iter().zip(slopes).zip(inverses) {
            let zero = -weight * inverse;
            if slope > 0.0 {
                first = first.max(zero - 1.0);
            } else if slope < 0.0 {
                last = last.min(zero + 1.0);
            } else if weight < -1e-5 {
                last = -1.0;
            }
        }
        if first <= last {
            for k in first as i32..=last as i32 {
                let (weight_a, weight_b) = (row_a + k as f32 * a_by_x, row_b + k as f32 * b_by_x);
                let weight_c = 1.0 - weight_a - weight_b;
                if weight_a >= -1e-5 && weight_b >= -1e-5 && weight_c >= -1e-5 {
                    let x = (left + k) as usize;
                    set(y * width + x, weight_a * a[2] + weight_b * b[2] + weight_c * c[2]);
                }
            }
        }
        row_a += a_by_y;
        row_b += b_by_y;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_parts::{Block, FLAT_L, mesh};

    const BOX: [Block; 1] = [[[-30.0, -20.0, 0.0], [30.0, 20.0, 20.0]]];
    /// A pixel of the depth image is half of this.
    const MM_PER_PX: f32 = 0.5;

    fn model(blocks: &[Block]) -> EdgeModel {
        EdgeModel::of_mesh(&mesh(blocks), &[], MM_PER_PX)
    }

    fn mean(values: impl Iterator<Item = f32> + Clone) -> f32 {
        values.clone().sum::<f32>() / values.count() as f32
    }

    #[test]
    fn a_box_from_above_has_the_four_edges_of_its_top() {
        let model = model(&BOX);
        let view = model.view([0.0, 0.0, 500.0]);
        let on = |axis: usize, at: f32| {
            let points: Vec<&EdgePoint> = view.points.iter().filter(|p| (p.position[axis] - at).abs() < 0.6).collect();
            // All along the edge.
            let other = points.iter().map(|p| p.position[1 - axis]);
            let length = other.clone().fold(f32::MIN, f32::max) - other.fold(f32::MAX, f32::min);
            assert!(length > [38.0, 58.0][axis], "{length} mm of the edge at {at}");
            let place = mean(points.iter().map(|p| p.position[axis]));
            assert!((place - at).abs() < 0.15, "{place} for {at}");
            let mid = |p: &&&EdgePoint| p.position[1 - axis].abs() < [17.0, 27.0][axis];
            assert!(points.iter().filter(mid).all(|p| p.tangent[1 - axis].abs() > 0.99), "{points:?}");
            points.len()
        };
        let found = on(0, -30.0) + on(0, 30.0) + on(1, -20.0) + on(1, 20.0);
        assert!(found >= view.points.len() && view.points.len() > 60, "{found} of {}", view.points.len());
        assert!(view.points.iter().all(|p| p.outline && p.outer && (p.position[2] - 20.0).abs() < 1e-3));
        assert!((model.radius_mm - 1300.0f32.sqrt()).abs() < 0.4, "{}", model.radius_mm);
        assert!((view.area_mm2 - 2400.0).abs() < 0.02 * 2400.0, "{}", view.area_mm2);
        assert!(view.surface.iter().all(|p| p[0].abs() <= 30.0 && p[1].abs() <= 20.0 && (p[2] - 20.0).abs() < 1e-3));
        assert!((40..160).contains(&view.surface.len()), "{}", view.surface.len());
    }

    #[test]
    fn a_tilted_view_ends_at_the_top_on_the_far_side_and_at_the_table_on_the_near_one() {
        // 24 degrees from the vertical, the camera on the side of +x: one of the directions of the grid.
        let tilt = 3.0 * TILT_STEP;
        let model = model(&BOX);
        let view = model.view([f64::from(tilt.sin()), 0.0, f64::from(tilt.cos())]);
        // Between the corners, whose pixels have both neighbours.
        let of =
            |x: f32| view.points.iter().filter(move |p| (p.position[0] - x).abs() < 1.0 && p.position[1].abs() < 17.0);
        let far = mean(of(-30.0).map(|p| p.position[2]));
        let near = mean(of(30.0).map(|p| p.position[2]));
        assert!(of(-30.0).count() > 8 && (far - 20.0).abs() < 0.5, "{far}");
        assert!(of(30.0).count() > 8 && near.abs() < 1.0, "{near}");
        // As a camera there sees it, 20 mm more of height are tan(24 degrees) * 20 mm more of length on the table.
        let expected = (60.0 + 20.0 * tilt.tan()) * 40.0;
        assert!((view.area_mm2 - expected).abs() < 0.02 * expected, "{} for {expected}", view.area_mm2);
        // From the other side, the other way round.
        let view = model.view([-f64::from(tilt.sin()), 0.0, f64::from(tilt.cos())]);
        let low = view.points.iter().filter(|p| (p.position[0] + 30.0).abs() < 1.0 && p.position[1].abs() < 17.0);
        assert!(mean(low.map(|p| p.position[2])).abs() < 1.0);
    }

    #[test]
    fn the_nearest_direction_of_the_grid_is_taken() {
        let model = model(&BOX);
        let at = |tilt_deg: f64, azimuth_deg: f64| {
            let ((st, ct), (sa, ca)) = (tilt_deg.to_radians().sin_cos(), azimuth_deg.to_radians().sin_cos());
            let view = model.view([700.0 * st * ca, 700.0 * st * sa, 700.0 * ct]);
            model.views.iter().position(|other| std::ptr::eq(other, view)).unwrap()
        };
        assert_eq!((at(0.0, 0.0), at(3.9, 123.0), at(4.1, 0.0)), (0, 0, 1));
        assert_eq!((at(8.0, 14.0), at(8.0, 16.0), at(8.0, -14.0), at(8.0, 346.0)), (1, 2, 1, 1));
        // Beyond the last ring, and from below, the last serves.
        assert_eq!((at(41.0, 0.0), at(80.0, 0.0), at(170.0, 0.0)), (49, 49, 49));
        assert_eq!(model.views.len(), 61);
    }

    #[test]
    fn the_rim_of_a_hole_is_outline_but_not_outer() {
        let frame: [Block; 4] = [
            [[-30.0, -30.0, 0.0], [30.0, -10.0, 6.0]],
            [[-30.0, 10.0, 0.0], [30.0, 30.0, 6.0]],
            [[-30.0, -10.0, 0.0], [-10.0, 10.0, 6.0]],
            [[10.0, -10.0, 0.0], [30.0, 10.0, 6.0]],
        ];
        let model = model(&frame);
        let view = model.view([0.0, 0.0, 1.0]);
        for p in &view.points {
            let [x, y, _] = p.position;
            let inner = x.abs().max(y.abs()) < 20.0;
            assert!(p.outline && p.outer != inner, "{p:?}");
        }
        assert!(view.points.iter().filter(|p| !p.outer).count() > 20);
        assert!((view.area_mm2 - 3200.0).abs() < 64.0, "{}", view.area_mm2);
    }

    #[test]
    fn turns_that_look_alike_are_those_of_the_outline() {
        let turns = |blocks: &[Block]| {
            // Those beside each other, which are equally alike, are one.
            let turns = model(blocks).look_alike_turns;
            let groups = turns.chunk_by(|a, b| b - a < 0.1);
            groups.map(|g| mean(g.iter().copied()).to_degrees().round() as i32).collect::<Vec<_>>()
        };
        assert_eq!(turns(&BOX), [180]);
        assert_eq!(turns(&[[[-20.0, -20.0, 0.0], [20.0, 20.0, 5.0]]]), [90, 180, 270]);
        assert!(turns(&FLAT_L).is_empty());
    }

    #[test]
    fn a_part_with_teeth_may_lie_at_their_turns_only() {
        let outline = |teeth: f32| -> Vec<EdgePoint> {
            let point = |k: usize| {
                let angle = k as f32 / 720.0 * TAU;
                let radius = 30.0 + 3.0 * (teeth * angle).sin();
                EdgePoint {
                    position: [radius * angle.cos(), radius * angle.sin(), 5.0],
                    tangent: [-angle.sin(), angle.cos(), 0.0],
                    outline: true,
                    outer: true,
                }
            };
            (0..720).map(point).collect()
        };
        let turns = |teeth: f32| {
            let view = ViewEdges::new(outline(teeth), Vec::new(), 2800.0, [0.0, 0.0, 1.0], 5.0);
            tooth_turns(&view, 33.0).iter().map(|turn| turn.to_degrees().round() as i32).collect::<Vec<_>>()
        };
        assert_eq!(turns(12.0), (1..12).map(|k| 30 * k).collect::<Vec<_>>());
        assert!(turns(0.0).is_empty(), "a disc may lie at any turn");
    }

    #[test]
    fn points_for_matching_are_those_asked_for() {
        let line: Vec<[f32; 2]> = (0..500).map(|i| [i as f32, 0.0]).collect();
        let few = [[0.0, 1.0], [0.0, 2.0]];
        assert_eq!(sampled(&line, &[]).len(), SHAPE_POINTS);
        assert_eq!(sampled(&line, &line).len(), SHAPE_POINTS);
        assert_eq!(sampled(&line, &few)[SHAPE_POINTS - 2..], few);
        assert_eq!(sampled(&[[1.0, 1.0]], &[]).len(), SHAPE_POINTS);
        assert!(sampled(&[], &[]).is_empty());
        let spread = extent(&[[-3.0, -3.0], [3.0, 3.0], [-1.0, 1.0], [1.0, -1.0]]);
        assert!((spread[0] - 3.0).abs() < 1e-5 && (spread[1] - 1.0).abs() < 1e-5, "{spread:?}");
        assert_eq!(extent(&[]), [0.0, 0.0]);
    }

    #[test]
    fn a_long_thin_triangle_fills_the_pixels_that_lie_in_it() {
        for corners in [
            [[1.0, 0.5], [90.3, 47.2], [88.0, 49.9]],
            [[0.2, 40.0], [97.0, 0.0], [0.0, 41.5]],
            [[-30.0, 20.0], [150.0, 24.0], [150.0, 26.5]],
            [[50.0, -9.0], [50.0, 70.0], [52.5, 70.0]],
        ] {
            let mut filled = std::collections::BTreeSet::new();
            fill_triangle(corners.map(|[x, y]| [x, y, 1.0]), 100, 50, |index, _| assert!(filled.insert(index)));
            let [a, b, c] = corners.map(|p| p.map(f64::from));
            let side =
                |a: [f64; 2], b: [f64; 2], x: f64, y: f64| (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0]);
            for i in 0..5000 {
                let (x, y) = ((i % 100) as f64, (i / 100) as f64);
                let sides = [side(a, b, x, y), side(b, c, x, y), side(c, a, x, y)];
                let least = sides.iter().fold(f64::INFINITY, |least, s| least.min(s.abs()));
                let inside = sides.iter().all(|s| *s > 0.0) || sides.iter().all(|s| *s < 0.0);
                // On its sides either is right.
                assert!(least < 0.05 || inside == filled.contains(&i), "{x} {y} of {corners:?}");
            }
            assert!(filled.len() > 20, "{corners:?}");
        }
    }

    #[test]
    fn triangles_without_area_or_far_away_fill_nothing() {
        let mut filled = 0;
        let mut fill = |corners: [[f32; 2]; 3]| {
            fill_triangle(corners.map(|[x, y]| [x, y, 1.0]), 9, 9, |_, _| filled += 1);
        };
        fill([[1.0, 1.0], [1.0, 1.0], [5.0, 5.0]]);
        fill([[1.0, 1.0], [3.0, 3.0], [5.0, 5.0]]);
        fill([[-9.0, -9.0], [-2.0, -9.0], [-2.0, -3.0]]);
        fill([[20.0, 1.0], [30.0, 1.0], [20.0, 8.0]]);
        fill([[f32::NAN, 1.0], [3.0, 1.0], [3.0, 8.0]]);
        fill([[f32::INFINITY, 1.0], [3.0, 1.0], [3.0, 8.0]]);
        assert_eq!(filled, 0);
        // Far larger than the picture.
        fill_triangle([[-1e4, -1e4, 0.0], [3e4, -1e4, 0.0], [-1e4, 3e4, 0.0]], 9, 9, |_, _| filled += 1);
        assert_eq!(filled, 81);
    }
}
