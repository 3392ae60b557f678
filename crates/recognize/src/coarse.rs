//! Where and how a part might lie in a region: its edges at all angles and places, coarsely.

use std::f64::consts::TAU;

use samsod_camera::Camera;

use crate::edge_model::EdgeModel;
use crate::gradient::Gradient;
use crate::orientation_map::{OrientationMap, bits_around};
use crate::pose_fit::{LocalView, Pose};

/// Points of the model that are looked up, about; a byte counts them.
const POINTS: usize = 48;
/// A turn between two angles that are tried moves the farthest point by so much, px.
const TURN_PX: f32 = 8.0;
/// Guesses that are kept.
const KEPT: usize = 6;

/// Columns and rows `[left, top, right, bottom]` of the frame, right and bottom exclusive, px.
pub(crate) type Window = [i32; 4];

/// A pose that may be right.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Guess {
    pub(crate) pose: Pose,
    /// Share of the points that find an edge, in [0, 1].
    pub(crate) share: f32,
}

/// A point of the model in cells from the origin.
#[derive(Debug, Clone, Copy)]
struct Offset {
    x: i32,
    y: i32,
    bits: u8,
}

/// Scratch memory of one thread.
#[derive(Debug, Default)]
pub(crate) struct CoarseSearch {
    offsets: Vec<Offset>,
    /// Points that find an edge, of every place.
    hits: Vec<u8>,
}

impl CoarseSearch {
    /// The best poses of a part whose outline lies within `window`.
    #[allow(clippy::too_many_arguments)]
    pub(crate) fn search(
        &mut self,
        model: &EdgeModel,
        height_mm: f64,
        symmetry: u32,
        camera: &Camera,
        gradient: &Gradient,
        map: &OrientationMap,
        window: Window,
    ) -> Vec<Guess> {
        let center = [0.5 * f64::from(window[0] + window[2]), 0.5 * f64::from(window[1] + window[3])];
        let mut guesses: Vec<Guess> = Vec::new();
        let Ok([x_mm, y_mm, _]) = camera.world_from_image(center, height_mm / 2.0) else { return guesses };
        let Some(local) = LocalView::new(camera, x_mm, y_mm, height_mm) else { return guesses };
        let radius_px = model.radius_mm * local.px_per_mm();
        let turns = (TAU as f32 * radius_px / TURN_PX).clamp(18.0, 90.0) as usize;
        let turns = match symmetry {
            0 => 1,
            n => turns.div_ceil(n as usize),
        };
        for k in 0..turns {
            let yaw_rad = k as f64 / turns as f64 * TAU / f64::from(symmetry.max(1));
            let pose = Pose { x_mm, y_mm, yaw_rad };
            let view = model.view(pose.towards(camera, height_mm / 2.0));
            let (sin, cos) = (yaw_rad.sin() as f32, yaw_rad.cos() as f32);
            let to_image = |[x, y, z]: [f32; 3]| local.image_offset([cos * x - sin * y, sin * x + cos * y, z]);
            self.offsets.clear();
            let step = (view.points.len() as f32 / POINTS as f32).max(1.0);
            let mut low = [f32::MAX; 2];
            let mut high = [f32::MIN; 2];
            for point in (0..).map(|i| (i as f32 * step) as usize).map_while(|i| view.points.get(i)) {
                let at = to_image(point.position);
                let ahead = to_image(std::array::from_fn(|i| point.position[i] + point.tangent[i]));
                for i in 0..2 {
                    low[i] = low[i].min(at[i]);
                    high[i] = high[i].max(at[i]);
                }
                let bits = bits_around(-(ahead[1] - at[1]), ahead[0] - at[0]);
                let cell = at.map(|c| (c / map.cell_px as f32).round() as i32);
                self.offsets.push(Offset { x: cell[0], y: cell[1], bits });
            }
            if self.offsets.is_empty() {
                continue;
            }
            self.at_all_places(map, gradient, window, low, high, |share, [u, v]| {
                let full = guesses.len() == KEPT;
                if full && share <= guesses[KEPT - 1].share {
                    return;
                }
                let [x_mm, y_mm] = local.world_from_image([f64::from(u), f64::from(v)], 0.0);
                let pose = Pose { x_mm, y_mm, yaw_rad };
                let near = |g: &Guess| {
                    let turn = (g.pose.yaw_rad - yaw_rad).rem_euclid(TAU);
                    turn.min(TAU - turn) < 0.2
                        && (g.pose.x_mm - pose.x_mm).hypot(g.pose.y_mm - pose.y_mm) * f64::from(local.px_per_mm()) < 9.0
                };
                if let Some(i) = guesses.iter().position(near) {
                    if guesses[i].share >= share {
                        return;
                    }
                    guesses.remove(i);
                } else if full {
                    guesses.pop();
                }
                let at = guesses.partition_point(|g| g.share >= share);
                guesses.insert(at, Guess { pose, share });
            });
        }
        guesses
    }

    /// Calls `found` with the share of points on edges and the place of the origin, px, for every place at which the
    /// part lies in the window.
    fn at_all_places(
        &mut self,
        map: &OrientationMap,
        gradient: &Gradient,
        window: Window,
        low: [f32; 2],
        high: [f32; 2],
        mut found: impl FnMut(f32, [i32; 2]),
    ) {
        let cell = map.cell_px as i32;
        // Places of the origin, in cells of the map, at which all points lie in the map and in the window.
        let range = |axis: usize, side: usize, corner: i32| {
            let least = (window[axis] - corner) as f32 - low[axis];
            let most = (window[axis + 2] - corner) as f32 - high[axis];
            let inside = [
                -self.offsets.iter().map(|o| if axis == 0 { o.x } else { o.y }).min().unwrap_or(0),
                side as i32 - 1 - self.offsets.iter().map(|o| if axis == 0 { o.x } else { o.y }).max().unwrap_or(0),
            ];
            let (mut first, mut last) = ((least / cell as f32).ceil() as i32, (most / cell as f32).floor() as i32);
            if first > last {
                // Longer than the window by less than a stride: in its middle.
                if first - last > 6 {
                    return None;
                }
                first = (first + last) / 2;
                last = first;
            }
            let (first, last) = (first.max(inside[0]), last.min(inside[1]));
            (first <= last).then_some((first, last))
        };
        let Some((left, right)) = range(0, map.width, gradient.left) else { return };
        let Some((top, bottom)) = range(1, map.height, gradient.top) else { return };
        let all = self.offsets.len() as f32;
        // Point by point for all places, from the first to the last as they lie in memory, many of which processors compare
        // at a time; what lies between the rows is not looked at.
        let width = map.width;
        let count = (bottom - top) as usize * width + (right - left + 1) as usize;
        self.hits.clear();
        self.hits.resize(count, 0);
        for offset in &self.offsets {
            let first = ((top + offset.y) * width as i32 + left + offset.x) as usize;
            let Some(cells) = map.bits.get(first..first + count) else { continue };
            self.hits.iter_mut().zip(cells).for_each(|(hits, cell)| *hits += u8::from(cell & offset.bits != 0));
        }
        for (y, row) in (top..).zip(self.hits.chunks(width)) {
            for (x, &hits) in (left..=right).zip(row) {
                found(f32::from(hits) / all, [gradient.left + x * cell, gradient.top + y * cell]);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_parts::{FLAT_L, overhead, paint, part, table};

    /// Of a turn: between 0 and half a circle.
    fn turn(a: f64, b: f64) -> f64 {
        let turn = (a - b).rem_euclid(TAU);
        turn.min(TAU - turn)
    }

    fn map_of(gradient: &Gradient) -> OrientationMap {
        let mut map = OrientationMap::default();
        map.fill(gradient, &vec![1; gradient.width * gradient.height], 4);
        map
    }

    #[test]
    fn a_painted_part_is_found_anywhere_at_any_angle() {
        let camera = overhead();
        let part = part("l", &FLAT_L, true);
        let model = EdgeModel::of(&part);
        let local = LocalView::new(&camera, 0.0, 0.0, 4.0).unwrap();
        for i in 0..24 {
            // Places and angles that repeat nothing of the grids of the search.
            let (x_mm, y_mm) = (f64::from(i * 37 % 150) - 75.3, f64::from(i * 53 % 110) - 54.8);
            let pose = Pose { x_mm, y_mm, yaw_rad: f64::from(i) * 0.77 };
            let mut image = table();
            paint(&mut image, &FLAT_L, &camera, &pose);
            let gradient = Gradient::of_image(&image);
            let map = map_of(&gradient);
            let window = [0, 0, image.width() as i32, image.height() as i32];
            let guesses = CoarseSearch::default().search(&model, 4.0, 1, &camera, &gradient, &map, window);
            assert!(guesses.len() <= KEPT && guesses.windows(2).all(|g| g[0].share >= g[1].share), "{guesses:?}");
            let near = |g: &&Guess| {
                let off = (g.pose.x_mm - x_mm).hypot(g.pose.y_mm - y_mm) * f64::from(local.px_per_mm());
                off < 8.0 && turn(g.pose.yaw_rad, pose.yaw_rad) < 0.2
            };
            assert!(guesses.iter().any(|g| near(&g) && g.share > 0.8), "{pose:?}: {guesses:?}");
        }
    }

    #[test]
    fn a_part_outside_of_the_window_is_not_found() {
        let camera = overhead();
        let part = part("l", &FLAT_L, true);
        let model = EdgeModel::of(&part);
        let pose = Pose { x_mm: -60.0, y_mm: 30.0, yaw_rad: 0.4 };
        let mut image = table();
        paint(&mut image, &FLAT_L, &camera, &pose);
        let gradient = Gradient::of_image(&image);
        let map = map_of(&gradient);
        let share = |window| {
            let guesses = CoarseSearch::default().search(&model, 4.0, 1, &camera, &gradient, &map, window);
            guesses.first().map(|guess| guess.share)
        };
        assert!(share([0, 0, 210, 200]).unwrap() > 0.8);
        assert!(share([240, 180, 420, 360]).unwrap_or(0.0) < 0.2);
        // Too small for it at any angle, empty, and outside of the frame.
        for window in [[100, 100, 130, 130], [100, 100, 100, 100], [900, 900, 1100, 1100], [-400, 0, -200, 200]] {
            assert_eq!(share(window), None, "{window:?}");
        }
    }

    #[test]
    fn a_symmetric_part_is_looked_for_at_the_angles_that_differ() {
        let camera = overhead();
        let square = [[[-20.0, -20.0, 0.0], [20.0, 20.0, 5.0]]];
        let part = part("square", &square, true);
        let model = EdgeModel::of(&part);
        let mut image = table();
        paint(&mut image, &square, &camera, &Pose { x_mm: 10.0, y_mm: 10.0, yaw_rad: 0.5 });
        let gradient = Gradient::of_image(&image);
        let map = map_of(&gradient);
        let guesses = CoarseSearch::default().search(&model, 5.0, 4, &camera, &gradient, &map, [0, 0, 420, 360]);
        assert!(guesses.iter().all(|g| (0.0..TAU / 4.0).contains(&g.pose.yaw_rad)), "{guesses:?}");
        assert!(guesses.iter().any(|g| (g.pose.yaw_rad - 0.5).abs() < 0.2 && g.share > 0.8), "{guesses:?}");
    }
}
