//! Outlines with as few corners as they need: Douglas and Peucker's algorithm on closed lines.
//!
//! Input: a closed line, one point a pixel. Output: some of its points, such that none of the others lies farther than a
//! tolerance from the line through them. O(n log n) for an outline of a compact thing, O(n^2) at worst.

/// See the module documentation; the last point joins the first.
pub(crate) fn simplified(points: &[[f64; 2]], tolerance_px: f64) -> Vec<[f64; 2]> {
    if points.len() < 4 {
        return points.to_vec();
    }
    // Two points that are far apart part the closed line into two open ones.
    let far = |from: [f64; 2]| {
        let distance = |point: &[f64; 2]| (point[0] - from[0]).hypot(point[1] - from[1]);
        let most = points.iter().enumerate().max_by(|(_, a), (_, b)| distance(a).total_cmp(&distance(b)));
        most.map_or(0, |(index, _)| index)
    };
    let first = far(points[0]);
    let mut line: Vec<[f64; 2]> = points[first..].iter().chain(&points[..=first]).copied().collect();
    let from = line[0];
    let middle = (1..line.len() - 1).max_by(|&a, &b| {
        let distance = |i: usize| (line[i][0] - from[0]).hypot(line[i][1] - from[1]);
        distance(a).total_cmp(&distance(b))
    });
    let middle = middle.unwrap_or(0);
    let mut keep = vec![false; line.len()];
    keep[0] = true;
    keep[middle] = true;
    let mut open = vec![(0, middle), (middle, line.len() - 1)];
    while let Some((start, end)) = open.pop() {
        let distance = |i: usize| from_segment(line[i], line[start], line[end]);
        let farthest = (start + 1..end).max_by(|&a, &b| distance(a).total_cmp(&distance(b)));
        if let Some(at) = farthest.filter(|&at| distance(at) > tolerance_px) {
            keep[at] = true;
            open.extend([(start, at), (at, end)]);
        }
    }
    let mut kept = keep.into_iter();
    line.retain(|_| kept.next().unwrap_or(false));
    line
}

/// Distance of a point from a line between two others.
fn from_segment([x, y]: [f64; 2], [ax, ay]: [f64; 2], [bx, by]: [f64; 2]) -> f64 {
    let (dx, dy) = (bx - ax, by - ay);
    let square = dx * dx + dy * dy;
    let share = if square > 0.0 { (((x - ax) * dx + (y - ay) * dy) / square).clamp(0.0, 1.0) } else { 0.0 };
    (x - ax - share * dx).hypot(y - ay - share * dy)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_square_keeps_its_corners_and_a_circle_its_shape() {
        let side = 20;
        let square: Vec<[f64; 2]> = (0..side)
            .map(|i| [i, 0])
            .chain((0..side).map(|i| [side, i]))
            .chain((0..side).map(|i| [side - i, side]))
            .chain((0..side).map(|i| [0, side - i]))
            .map(|point| point.map(f64::from))
            .collect();
        let mut corners = simplified(&square, 0.8);
        corners.sort_by(|a, b| a[0].total_cmp(&b[0]).then(a[1].total_cmp(&b[1])));
        assert_eq!(corners, [[0.0, 0.0], [0.0, 20.0], [20.0, 0.0], [20.0, 20.0]]);

        let circle: Vec<[f64; 2]> =
            (0..360).map(|i| f64::from(i).to_radians()).map(|angle| [50.0 * angle.cos(), 50.0 * angle.sin()]).collect();
        let line = simplified(&circle, 0.8);
        assert!((8..60).contains(&line.len()), "{} corners", line.len());
        for &point in &circle {
            let ends = line.iter().zip(line.iter().cycle().skip(1));
            let nearest = ends.map(|(&a, &b)| from_segment(point, a, b)).fold(f64::INFINITY, f64::min);
            assert!(nearest <= 0.8 + 1e-9, "{nearest} px off at {point:?}");
        }
    }

    #[test]
    fn few_points_and_equal_ones_stay_a_line() {
        for points in [&[][..], &[[3.0, 4.0]], &[[1.0, 1.0], [2.0, 2.0]], &[[5.0, 5.0]; 9]] {
            let line = simplified(points, 0.8);
            assert!(!line.is_empty() || points.is_empty());
            assert!(line.iter().all(|point| points.contains(point)));
        }
    }
}
