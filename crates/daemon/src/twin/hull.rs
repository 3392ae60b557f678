//! Convex outlines on the table: the hull of points, and how far two outlines are apart.

/// Corners nearer than this to the line of their neighbours are left out, mm.
const FLAT_MM: f64 = 0.01;

/// Convex hull of points, counter-clockwise, without corners that are none. Fewer than three points when all lie on a line.
pub(super) fn convex_hull(points: impl Iterator<Item = [f64; 2]>) -> Vec<[f64; 2]> {
    let mut points: Vec<[f64; 2]> = points.filter(|p| p.iter().all(|c| c.is_finite())).collect();
    points.sort_by(|a, b| a[0].total_cmp(&b[0]).then(a[1].total_cmp(&b[1])));
    points.dedup();
    let chain = |points: &mut dyn Iterator<Item = &[f64; 2]>| {
        let mut chain: Vec<[f64; 2]> = Vec::new();
        for &point in points {
            while let [.., a, b] = chain[..] {
                let height = cross(a, b, point) / distance(a, point).max(FLAT_MM);
                if height > FLAT_MM {
                    break;
                }
                chain.pop();
            }
            chain.push(point);
        }
        chain
    };
    let mut hull = chain(&mut points.iter());
    let upper = chain(&mut points.iter().rev());
    // The ends of either chain are the starts of the other.
    hull.pop();
    hull.extend(upper.iter().take(upper.len().saturating_sub(1)));
    hull
}

/// Distance of two convex outlines, each counter-clockwise; 0 when they touch or overlap, infinite when one has no corner.
pub(super) fn hull_distance(first: &[[f64; 2]], second: &[[f64; 2]]) -> f64 {
    if first.is_empty() || second.is_empty() {
        return f64::INFINITY;
    }
    if !(separates(first, second) || separates(second, first)) {
        return 0.0;
    }
    to_edges(first, second).min(to_edges(second, first))
}

/// Whether all of `other` lies outside of an edge of `hull`.
fn separates(hull: &[[f64; 2]], other: &[[f64; 2]]) -> bool {
    edges(hull).any(|[a, b]| other.iter().all(|&point| cross(a, b, point) < 0.0))
}

/// Least distance of a corner from an edge of another.
fn to_edges(corners: &[[f64; 2]], hull: &[[f64; 2]]) -> f64 {
    let from = |&point: &[f64; 2]| edges(hull).map(|edge| to_edge(point, edge)).fold(f64::INFINITY, f64::min);
    corners.iter().map(from).fold(f64::INFINITY, f64::min)
}

fn to_edge(point: [f64; 2], [a, b]: [[f64; 2]; 2]) -> f64 {
    let along = [b[0] - a[0], b[1] - a[1]];
    let length_2 = along[0] * along[0] + along[1] * along[1];
    let at = ((point[0] - a[0]) * along[0] + (point[1] - a[1]) * along[1]) / length_2;
    // A point for an edge has no direction.
    let at = if at.is_finite() { at.clamp(0.0, 1.0) } else { 0.0 };
    distance(point, [a[0] + at * along[0], a[1] + at * along[1]])
}

fn edges(hull: &[[f64; 2]]) -> impl Iterator<Item = [[f64; 2]; 2]> + '_ {
    (0..hull.len()).map(|i| [hull[i], hull[(i + 1) % hull.len()]])
}

/// Above 0 when `point` lies left of the line from `a` to `b`.
fn cross(a: [f64; 2], b: [f64; 2], point: [f64; 2]) -> f64 {
    (b[0] - a[0]) * (point[1] - a[1]) - (b[1] - a[1]) * (point[0] - a[0])
}

pub(super) fn distance(a: [f64; 2], b: [f64; 2]) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

#[cfg(test)]
mod tests {
    use super::*;

    const SQUARE: [[f64; 2]; 4] = [[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0]];

    fn moved([dx, dy]: [f64; 2]) -> Vec<[f64; 2]> {
        SQUARE.iter().map(|[x, y]| [x + dx, y + dy]).collect()
    }

    #[test]
    fn a_hull_has_the_corners_and_nothing_else() {
        let inside = [[5.0, 5.0], [5.0, 0.0], [5.0, 0.001], [10.0, 3.0], [0.0, 0.0]];
        let hull = convex_hull(SQUARE.into_iter().chain(inside));
        assert_eq!(hull, SQUARE);
        assert!(convex_hull([[1.0, 1.0], [2.0, 2.0], [3.0, 3.0]].into_iter()).len() < 3);
        assert!(convex_hull(std::iter::empty()).is_empty());
    }

    #[test]
    fn distances_are_those_of_the_nearest_edges_and_corners() {
        for (by, expected) in [([13.0, 4.0], 3.0), ([13.0, 14.0], 5.0), ([-10.5, 0.0], 0.5), ([4.0, -12.0], 2.0)] {
            let other = moved(by);
            assert!((hull_distance(&SQUARE, &other) - expected).abs() < 1e-12, "{by:?}");
            assert!((hull_distance(&other, &SQUARE) - expected).abs() < 1e-12, "{by:?}");
        }
        // A corner before an edge that no edge of the other faces.
        let diamond = [[12.0, 5.0], [17.0, 0.0], [22.0, 5.0], [17.0, 10.0]];
        assert!((hull_distance(&SQUARE, &diamond) - 2.0).abs() < 1e-12);
    }

    #[test]
    fn what_overlaps_or_lies_inside_is_not_apart() {
        assert_eq!(hull_distance(&SQUARE, &moved([5.0, 5.0])), 0.0);
        let inside = [[4.0, 4.0], [6.0, 4.0], [5.0, 6.0]];
        assert_eq!((hull_distance(&SQUARE, &inside), hull_distance(&inside, &SQUARE)), (0.0, 0.0));
        // Crossed bars: no corner of one is in the other.
        let (lying, standing) = (
            [[-10.0, 4.0], [20.0, 4.0], [20.0, 6.0], [-10.0, 6.0]],
            [[4.0, -10.0], [6.0, -10.0], [6.0, 20.0], [4.0, 20.0]],
        );
        assert_eq!(hull_distance(&lying, &standing), 0.0);
    }
}
