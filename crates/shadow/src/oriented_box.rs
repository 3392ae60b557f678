//! The smallest rectangle round a mask, in any direction.
//!
//! One side of the smallest rectangle lies on an edge of the convex hull (Freeman and Shapira), so every edge is tried.
//! The pixels count as squares, corners included: an axis-parallel rectangle of 20 x 10 pixels has a box of 20 x 10.
//! `imageproc` offers the same with corners rounded to whole pixels, which costs a degree on a part of 50 px.

use std::f64::consts::{FRAC_PI_2, FRAC_PI_4, PI};

use serde::Serialize;

use crate::MaskRun;

/// A rectangle in any direction.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct OrientedBox {
    /// Centre (x, y), px, pixel centres at integers.
    pub center_px: [f32; 2],
    /// Longer side, px.
    pub length_px: f32,
    /// Shorter side, px.
    pub width_px: f32,
    /// Direction of the longer side, radians in (-pi/2, pi/2], counter-clockwise on the screen from image right; of a
    /// square, the side within (-pi/4, pi/4].
    pub angle_rad: f32,
}

/// Rectangles whose areas differ by less are as small as each other, relative.
const TIE: f64 = 1e-9;

impl OrientedBox {
    /// The smallest box round the pixels of some runs, sorted by row; `None` without a pixel.
    pub(crate) fn around(runs: &[MaskRun]) -> Option<Self> {
        let hull = convex_hull(&row_corners(runs));
        let edges = hull.iter().zip(hull.iter().cycle().skip(1));
        let mut best: Option<(f64, Self)> = None;
        for (a, b) in edges {
            let (dx, dy) = ((b[0] - a[0]) as f64, (b[1] - a[1]) as f64);
            let length = dx.hypot(dy);
            if length == 0.0 {
                continue;
            }
            let (area, candidate) = box_along([dx / length, dy / length], &hull);
            if best.is_none_or(|(smallest, _)| area < smallest * (1.0 - TIE)) {
                best = Some((area, candidate));
            }
        }
        best.map(|(_, found)| found)
    }
}

/// The box with a side along the unit vector `u`, and its area.
fn box_along(u: [f64; 2], hull: &[[i64; 2]]) -> (f64, OrientedBox) {
    let v = [-u[1], u[0]];
    let extent = |axis: [f64; 2]| {
        let along = hull.iter().map(|p| p[0] as f64 * axis[0] + p[1] as f64 * axis[1]);
        along.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), s| (low.min(s), high.max(s)))
    };
    let ((u0, u1), (v0, v1)) = (extent(u), extent(v));
    let (along, across) = (u1 - u0, v1 - v0);
    let (mid_u, mid_v) = ((u0 + u1) / 2.0, (v0 + v1) / 2.0);
    // Corners of pixels lie half a pixel from their centres.
    let center_px = [0, 1].map(|i| (mid_u * u[i] + mid_v * v[i] - 0.5) as f32);
    let square = (along - across).abs() <= TIE * along.max(across);
    let axis = if along >= across { u } else { v };
    // y grows downwards, so the sign turns to be counter-clockwise on the screen.
    let mut angle = (-axis[1]).atan2(axis[0]);
    let (half, whole) = if square { (FRAC_PI_4, FRAC_PI_2) } else { (FRAC_PI_2, PI) };
    while angle > half + TIE {
        angle -= whole;
    }
    while angle <= -half + TIE {
        angle += whole;
    }
    let found = OrientedBox {
        center_px,
        length_px: along.max(across) as f32,
        width_px: along.min(across) as f32,
        // Rounding to f32 must not leave the interval.
        angle_rad: (angle as f32).min(std::f32::consts::FRAC_PI_2),
    };
    (along * across, found)
}

/// The four corners of the extent of every row, whole numbers: pixel (x, y) is the square from (x, y) to
/// (x + 1, y + 1).
fn row_corners(runs: &[MaskRun]) -> Vec<[i64; 2]> {
    let mut corners = Vec::new();
    for row in runs.chunk_by(|a, b| a.y == b.y) {
        let y = i64::from(row[0].y);
        let start = row.iter().map(|run| i64::from(run.start)).min().unwrap_or_default();
        let end = row.iter().map(|run| i64::from(run.end)).max().unwrap_or_default();
        corners.extend([[start, y], [start, y + 1], [end, y], [end, y + 1]]);
    }
    corners
}

/// The corners of the convex hull in their order round it (Andrew's monotone chain).
fn convex_hull(points: &[[i64; 2]]) -> Vec<[i64; 2]> {
    let mut points = points.to_vec();
    points.sort_unstable();
    points.dedup();
    let half = |points: &mut dyn Iterator<Item = &[i64; 2]>| {
        let mut chain: Vec<[i64; 2]> = Vec::new();
        for &p in points {
            while let [.., a, b] = chain[..] {
                if (b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0]) > 0 {
                    break;
                }
                chain.pop();
            }
            chain.push(p);
        }
        chain.pop();
        chain
    };
    let mut hull = half(&mut points.iter());
    hull.extend(half(&mut points.iter().rev()));
    hull
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The runs of all pixels whose centre is inside.
    fn runs_of(width: u32, height: u32, inside: impl Fn(f64, f64) -> bool) -> Vec<MaskRun> {
        let pixels = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
        pixels
            .filter(|&(x, y)| inside(f64::from(x), f64::from(y)))
            .map(|(x, y)| MaskRun { y, start: x, end: x + 1 })
            .collect()
    }

    #[test]
    fn one_pixel_is_a_unit_square() {
        let found = OrientedBox::around(&[MaskRun { y: 4, start: 7, end: 8 }]).unwrap();
        assert_eq!(found, OrientedBox { center_px: [7.0, 4.0], length_px: 1.0, width_px: 1.0, angle_rad: 0.0 });
        assert_eq!(OrientedBox::around(&[]), None);
    }

    #[test]
    fn axis_parallel_rectangles_are_exact() {
        let lying = runs_of(40, 30, |x, y| (5.0..=24.0).contains(&x) && (3.0..=12.0).contains(&y));
        let found = OrientedBox::around(&lying).unwrap();
        assert_eq!(found, OrientedBox { center_px: [14.5, 7.5], length_px: 20.0, width_px: 10.0, angle_rad: 0.0 });
        let standing = runs_of(40, 30, |x, y| (5.0..=9.0).contains(&x) && (3.0..=22.0).contains(&y));
        let found = OrientedBox::around(&standing).unwrap();
        let up = std::f32::consts::FRAC_PI_2;
        assert_eq!(found, OrientedBox { center_px: [7.0, 12.5], length_px: 20.0, width_px: 5.0, angle_rad: up });
    }

    #[test]
    fn turned_rectangles_keep_their_direction_and_size() {
        for degrees in [-89, -60, -45, -17, -3, 3, 10, 30, 45, 71, 89] {
            let angle = f64::from(degrees).to_radians();
            // Counter-clockwise on the screen: y is down.
            let (ux, uy) = (angle.cos(), -angle.sin());
            let runs = runs_of(240, 240, |x, y| {
                let (dx, dy) = (x - 120.3, y - 119.6);
                (dx * ux + dy * uy).abs() <= 80.0 && (dy * ux - dx * uy).abs() <= 25.0
            });
            let found = OrientedBox::around(&runs).unwrap();
            let error = f64::from(found.angle_rad) - angle;
            assert!(error.abs() < 0.012, "{degrees} degrees: off by {} degrees", error.to_degrees());
            assert!((found.length_px - 160.0).abs() < 2.0, "{degrees} degrees: {found:?}");
            assert!((found.width_px - 50.0).abs() < 2.0, "{degrees} degrees: {found:?}");
            assert!((found.center_px[0] - 120.3).abs() < 0.8 && (found.center_px[1] - 119.6).abs() < 0.8, "{found:?}");
        }
    }

    #[test]
    fn a_diamond_is_a_turned_square() {
        let runs = runs_of(41, 41, |x, y| (x - 20.0).abs() + (y - 20.0).abs() <= 20.0);
        let found = OrientedBox::around(&runs).unwrap();
        assert!((found.angle_rad - std::f32::consts::FRAC_PI_4).abs() < 1e-4, "{found:?}");
        assert!((found.length_px - found.width_px).abs() < 1e-3, "{found:?}");
        assert_eq!(found.center_px, [20.0, 20.0]);
    }
}
