//! Which turns leave a part as it is: found when a part is taught, and kept in its `part.toml`.
//!
//! In: the picture of a part, its mask, and its shape if there is one. Out: the [`Symmetry`] about the z axis of the part.
//!
//! * **Outline.** The mask, or the silhouette of the shape from above, is turned about its centroid. What is left between
//!   the outline and the turned one, as a mean distance in pixels, must be no more than turning pixels costs. All
//!   multiples of the turn must pass: a small turn alone changes a nearly round part too little.
//! * **Picture.** Around every pixel the picture and the turned one are correlated in a small window. Lettering and marks
//!   that have no counterpart correlate with nothing; shading that merely changes its strength, as under one lamp,
//!   still does. A plain surface says nothing and passes.
//!
//! The centroid of a shape must lie on the z axis: a turn about another axis moves the origin of the part.

use image::{GrayImage, RgbImage};

use crate::Mesh;
use crate::part_file::Symmetry;

/// Highest order that is looked for.
const MAX_ORDER: u32 = 24;
/// Turns of something round; none is a turn of a regular polygon.
const ROUND_TURNS: u32 = 11;
const ROUND_STEP_DEG: f64 = 31.7;
/// Greatest mean distance between a mask and its turned self, px. Round parts have up to 0.22 in masks without noise, a
/// gear with a keyway 0.29.
const MASK_TOLERANCE_PX: f64 = 0.25;
/// Radius at which the silhouette of a shape is drawn, px, and the distance that is allowed there: circles of 32 segments
/// stay below it.
const SILHOUETTE_RADIUS_PX: f64 = 200.0;
const SILHOUETTE_TOLERANCE_PX: f64 = 0.5;
/// Greatest distance of the centroid of a silhouette from the z axis, as a share of its radius.
const MAX_OFF_AXIS: f64 = 0.02;
/// Half the side of a window of the picture, px.
const HALF_WINDOW: i64 = 3;
/// Pixels of a window that must lie on the part for it to say anything: half of them.
const LEAST_WINDOW: f64 = 25.0;
/// Standard deviation of grey levels in a window from which on it shows something.
const LEAST_DEVIATION: f64 = 8.0;
/// A window is like its counterpart when their correlation, of either sign, is at least this.
const LEAST_CORRELATION: f64 = 0.5;
/// Share of the part on which windows may be unlike: up to 0.017 on bundled parts that look the same, 0.06 to 0.09 on a
/// round one with lettering.
const MAX_UNLIKE: f64 = 0.03;

/// Finds the symmetry of a part.
///
/// # Arguments
/// * `image`, `mask` - its picture, and more than 127 where it is the part
/// * `mesh` - its shape; without it the outline is that of the mask
/// * `origin_px` - pixel of the picture at which the origin of the part is seen
pub(crate) fn find_symmetry(image: &RgbImage, mask: &GrayImage, mesh: Option<&Mesh>, origin_px: [f64; 2]) -> Symmetry {
    let seen = Plane::of_mask(mask);
    let shape_order = match mesh {
        Some(mesh) => silhouette(mesh).map_or(1, |outline| outline_order(&outline, SILHOUETTE_TOLERANCE_PX)),
        None => outline_order(&seen, MASK_TOLERANCE_PX),
    };
    let grey = Plane {
        width: image.width() as usize,
        height: image.height() as usize,
        values: image.pixels().map(|p| p.0.iter().map(|&c| f32::from(c)).sum::<f32>() / 3.0).collect(),
    };
    let picture = Picture { grey: grey.smooth(), inside: seen, centre: origin_px };
    let appearance_order = order(
        |n| shape_order == 0 || (shape_order.is_multiple_of(n)),
        shape_order == 0,
        |turn_rad| picture.is_like_itself(turn_rad),
    );
    Symmetry { shape_order, appearance_order }
}

/// The highest order among those allowed of which every turn passes; 0 when any turn does, 1 when none.
fn order(allowed: impl Fn(u32) -> bool, may_be_round: bool, passes: impl Fn(f64) -> bool) -> u32 {
    let round = || (1..=ROUND_TURNS).all(|k| passes((f64::from(k) * ROUND_STEP_DEG).to_radians()));
    if may_be_round && round() {
        return 0;
    }
    // Turning the other way compares the same two pictures, so half of the turns suffice.
    let holds = |n: &u32| (1..=n / 2).all(|k| passes(std::f64::consts::TAU * f64::from(k) / f64::from(*n)));
    (2..=MAX_ORDER).rev().filter(|&n| allowed(n)).find(holds).unwrap_or(1)
}

fn outline_order(inside: &Plane, tolerance_px: f64) -> u32 {
    let perimeter = inside.perimeter();
    let Some(centre) = inside.centroid().filter(|_| perimeter > 0.0) else { return 1 };
    let soft = inside.smooth();
    order(|_| true, true, |turn_rad| soft.difference(centre, turn_rad) / perimeter <= tolerance_px)
}

/// The silhouette of a shape from above, its centroid in the middle; `None` when that is off the z axis.
fn silhouette(mesh: &Mesh) -> Option<Plane> {
    let flat: Vec<[f64; 2]> = mesh.vertices().iter().map(|v| [f64::from(v[0]), f64::from(v[1])]).collect();
    let radius = |about: [f64; 2]| flat.iter().map(|p| (p[0] - about[0]).hypot(p[1] - about[1])).fold(0.0, f64::max);
    let radius_mm = radius([0.0; 2]);
    let scale = SILHOUETTE_RADIUS_PX / radius_mm;
    // A pixel of margin on every side, and one for the blur.
    let half = SILHOUETTE_RADIUS_PX.ceil() + 4.0;
    let side = 2 * half as usize + 1;
    let mut plane = Plane { width: side, height: side, values: vec![0.0; side * side] };
    for triangle in mesh.triangles() {
        plane.fill(triangle.map(|i| flat[i as usize].map(|c| half + c * scale)));
    }
    let [x, y] = plane.centroid()?;
    ((x - half).hypot(y - half) <= MAX_OFF_AXIS * SILHOUETTE_RADIUS_PX).then_some(plane)
}

/// One value a pixel, row by row.
struct Plane {
    width: usize,
    height: usize,
    values: Vec<f32>,
}

impl Plane {
    /// 1 inside, 0 outside, with a margin for what is turned out of the box.
    fn of_mask(mask: &GrayImage) -> Self {
        let values = mask.iter().map(|&value| if value > 127 { 1.0 } else { 0.0 }).collect();
        Self { width: mask.width() as usize, height: mask.height() as usize, values }
    }

    fn at(&self, x: i64, y: i64) -> f32 {
        match (usize::try_from(x), usize::try_from(y)) {
            (Ok(x), Ok(y)) if x < self.width && y < self.height => self.values[y * self.width + x],
            _ => 0.0,
        }
    }

    /// Bilinear, 0 outside.
    fn between(&self, x: f64, y: f64) -> f32 {
        let (left, top) = (x.floor(), y.floor());
        let (dx, dy) = ((x - left) as f32, (y - top) as f32);
        let (left, top) = (left as i64, top as i64);
        let row = |y| self.at(left, y) * (1.0 - dx) + self.at(left + 1, y) * dx;
        row(top) * (1.0 - dy) + row(top + 1) * dy
    }

    /// Sets the pixels whose centres lie in a triangle, its edges included.
    fn fill(&mut self, corners: [[f64; 2]; 3]) {
        let [a, b, c] = corners;
        let side = |p: [f64; 2], q: [f64; 2], x: f64, y: f64| (q[0] - p[0]) * (y - p[1]) - (q[1] - p[1]) * (x - p[0]);
        let area = side(a, b, c[0], c[1]);
        if area == 0.0 {
            return;
        }
        let range = |axis: usize, size: usize| {
            let least = corners.iter().map(|p| p[axis]).fold(f64::INFINITY, f64::min).ceil().max(0.0);
            let most = corners.iter().map(|p| p[axis]).fold(f64::NEG_INFINITY, f64::max).floor();
            least as usize..((most + 1.0).max(0.0) as usize).min(size)
        };
        for y in range(1, self.height) {
            for x in range(0, self.width) {
                let (px, py) = (x as f64, y as f64);
                let inside = [(a, b), (b, c), (c, a)].iter().all(|&(p, q)| side(p, q, px, py) * area >= 0.0);
                if inside {
                    self.values[y * self.width + x] = 1.0;
                }
            }
        }
    }

    fn centroid(&self) -> Option<[f64; 2]> {
        let mut sums = [0.0; 3];
        for (i, &value) in self.values.iter().enumerate() {
            let value = f64::from(value);
            sums[0] += value * (i % self.width) as f64;
            sums[1] += value * (i / self.width) as f64;
            sums[2] += value;
        }
        (sums[2] > 0.0).then(|| [sums[0] / sums[2], sums[1] / sums[2]])
    }

    /// Length of the outlines, px: edges of pixels, of which a slanted line has 4 / pi times as many in the mean.
    fn perimeter(&self) -> f64 {
        let (width, height) = (self.width as i64, self.height as i64);
        let edges: f32 = (0..height)
            .flat_map(|y| (0..width).map(move |x| (x, y)))
            .map(|(x, y)| {
                let own = self.at(x, y);
                // The border of the picture counts too.
                let first = if x == 0 { own } else { 0.0 } + if y == 0 { own } else { 0.0 };
                first + (own - self.at(x + 1, y)).abs() + (own - self.at(x, y + 1)).abs()
            })
            .sum();
        f64::from(edges) * std::f64::consts::FRAC_PI_4
    }

    /// Blurred by a standard deviation of one pixel: turning pixels costs less then.
    fn smooth(&self) -> Self {
        let pass = |from: &Self, step: [i64; 2]| {
            let value = |i: usize| {
                let (x, y) = ((i % from.width) as i64, (i / from.width) as i64);
                // At the border of the picture the outermost pixel goes on.
                let at = |sign: i64| {
                    let x = (x + sign * step[0]).clamp(0, from.width as i64 - 1);
                    let y = (y + sign * step[1]).clamp(0, from.height as i64 - 1);
                    from.at(x, y)
                };
                (at(-1) + 2.0 * at(0) + at(1)) / 4.0
            };
            let values = (0..from.values.len()).map(value).collect();
            Self { width: from.width, height: from.height, values }
        };
        let once = pass(&pass(self, [1, 0]), [0, 1]);
        pass(&pass(&once, [1, 0]), [0, 1])
    }

    /// Sum of the differences to itself turned about a point.
    fn difference(&self, centre: [f64; 2], turn_rad: f64) -> f64 {
        let turned = Turn::new(centre, turn_rad);
        let difference = |(i, &own): (usize, &f32)| {
            let [x, y] = turned.source((i % self.width) as f64, (i / self.width) as f64);
            f64::from((own - self.between(x, y)).abs())
        };
        self.values.iter().enumerate().map(difference).sum()
    }
}

/// Where the pixels of a turned picture come from.
struct Turn {
    centre: [f64; 2],
    sin_cos: (f64, f64),
}

impl Turn {
    fn new(centre: [f64; 2], turn_rad: f64) -> Self {
        Self { centre, sin_cos: turn_rad.sin_cos() }
    }

    fn source(&self, x: f64, y: f64) -> [f64; 2] {
        let (sin, cos) = self.sin_cos;
        let (dx, dy) = (x - self.centre[0], y - self.centre[1]);
        [self.centre[0] + dx * cos - dy * sin, self.centre[1] + dx * sin + dy * cos]
    }
}

/// The grey picture of a part.
struct Picture {
    grey: Plane,
    inside: Plane,
    centre: [f64; 2],
}

impl Picture {
    fn is_like_itself(&self, turn_rad: f64) -> bool {
        let turn = Turn::new(self.centre, turn_rad);
        let (width, height) = (self.grey.width as i64, self.grey.height as i64);
        let source = |x: i64, y: i64| turn.source(x as f64, y as f64);
        let pixels = || (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
        let turned: Vec<f32> = pixels().map(|(x, y)| source(x, y)).map(|[x, y]| self.grey.between(x, y)).collect();
        let turned = Plane { width: self.grey.width, height: self.grey.height, values: turned };
        // Both must be well inside: at the outline the table shows, and the side of the part.
        let well_inside = |plane: &Plane, x: f64, y: f64| {
            let reach = 2.0;
            [[0.0, 0.0], [-reach, 0.0], [reach, 0.0], [0.0, -reach], [0.0, reach]]
                .iter()
                .all(|[dx, dy]| plane.between(x + dx, y + dy) > 0.99)
        };
        let both: Vec<bool> = pixels()
            .map(|(x, y)| {
                let [sx, sy] = source(x, y);
                well_inside(&self.inside, x as f64, y as f64) && well_inside(&self.inside, sx, sy)
            })
            .collect();
        // Large parts are looked at on every second or third pixel.
        let area = both.iter().filter(|&&inside| inside).count();
        let step = ((area as f64 / 40_000.0).sqrt() as usize).max(1);
        let (mut looked_at, mut unlike) = (0usize, 0usize);
        for y in (0..self.grey.height).step_by(step) {
            for x in (0..self.grey.width).step_by(step) {
                if both[y * self.grey.width + x] {
                    looked_at += 1;
                    unlike += usize::from(self.window_is_unlike(&turned, &both, [x as i64, y as i64]));
                }
            }
        }
        unlike as f64 <= MAX_UNLIKE * looked_at as f64
    }

    /// Whether a window shows something that its counterpart, up to a pixel away, does not.
    fn window_is_unlike(&self, turned: &Plane, both: &[bool], [x, y]: [i64; 2]) -> bool {
        let width = self.grey.width as i64;
        let inside = |x: i64, y: i64| {
            (0..width).contains(&x) && (0..self.grey.height as i64).contains(&y) && both[(y * width + x) as usize]
        };
        let mut shows = false;
        for (shift_x, shift_y) in (-1..=1).flat_map(|dy| (-1..=1).map(move |dx| (dx, dy))) {
            let mut sums = Moments::default();
            for dy in -HALF_WINDOW..=HALF_WINDOW {
                for dx in -HALF_WINDOW..=HALF_WINDOW {
                    let (x, y) = (x + dx, y + dy);
                    if inside(x, y) && inside(x + shift_x, y + shift_y) {
                        sums.add(self.grey.at(x, y).into(), turned.at(x + shift_x, y + shift_y).into());
                    }
                }
            }
            if sums.count < LEAST_WINDOW {
                continue;
            }
            let [own, other, joint] = sums.covariances();
            shows |= own.max(other) > LEAST_DEVIATION * LEAST_DEVIATION;
            // A plain window has a variance of rounding only; 1 keeps it from being like anything.
            if joint.abs() >= LEAST_CORRELATION * (own.max(1.0) * other.max(1.0)).sqrt() {
                return false;
            }
        }
        shows
    }
}

/// Sums over a window of two pictures.
#[derive(Default)]
struct Moments {
    count: f64,
    sums: [f64; 2],
    squares: [f64; 2],
    products: f64,
}

impl Moments {
    fn add(&mut self, a: f64, b: f64) {
        self.count += 1.0;
        self.sums[0] += a;
        self.sums[1] += b;
        self.squares[0] += a * a;
        self.squares[1] += b * b;
        self.products += a * b;
    }

    /// Variance of the one, of the other, and their covariance.
    fn covariances(&self) -> [f64; 3] {
        let n = self.count.max(1.0);
        let [a, b] = self.sums.map(|sum| sum / n);
        [self.squares[0] / n - a * a, self.squares[1] / n - b * b, self.products / n - a * b]
    }
}

#[cfg(test)]
mod tests;
