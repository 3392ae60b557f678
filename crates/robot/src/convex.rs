//! Convex polygons in the plane of the table: outlines of parts seen from above, and the fingers of a gripper.

use glam::DVec2;
use serde::{Deserialize, Serialize};

/// A convex polygon, mm, its corners counter-clockwise.
///
/// ```
/// use samsod_robot::Convex;
/// let square = Convex::rectangle([0.0, 0.0], [10.0, 10.0], 0.0);
/// let beside = square.moved([14.0, 0.0], 0.0);
/// assert!((square.gap_mm(&beside) - 4.0).abs() < 1e-9);
/// assert!(square.gap_mm(&square.moved([3.0, 0.0], 0.5)) < 0.0);
/// ```
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(from = "Vec<[f64; 2]>", into = "Vec<[f64; 2]>")]
pub struct Convex {
    corners_mm: Vec<[f64; 2]>,
}

/// Whatever the order of the points: it is their hull.
impl From<Vec<[f64; 2]>> for Convex {
    fn from(points: Vec<[f64; 2]>) -> Self {
        Self::hull(&points)
    }
}

impl From<Convex> for Vec<[f64; 2]> {
    fn from(convex: Convex) -> Self {
        convex.corners_mm
    }
}

impl Convex {
    /// The convex hull of points (x, y), mm. Points that are no numbers are left out.
    pub fn hull(points: &[[f64; 2]]) -> Self {
        let mut points: Vec<DVec2> = points.iter().map(|&p| DVec2::from(p)).filter(|p| p.is_finite()).collect();
        points.sort_by(|a, b| a.x.total_cmp(&b.x).then(a.y.total_cmp(&b.y)));
        points.dedup();
        if points.len() < 3 {
            return Self { corners_mm: points.into_iter().map(DVec2::into).collect() };
        }
        // The lower chain from left to right, then the upper one back: each keeps turning left.
        let chain = |points: &mut dyn Iterator<Item = DVec2>| {
            let mut chain: Vec<DVec2> = Vec::new();
            for point in points {
                while let [.., a, b] = chain[..]
                    && (b - a).perp_dot(point - a) <= 0.0
                {
                    chain.pop();
                }
                chain.push(point);
            }
            chain.pop();
            chain
        };
        let mut corners = chain(&mut points.iter().copied());
        corners.extend(chain(&mut points.iter().rev().copied()));
        Self { corners_mm: corners.into_iter().map(DVec2::into).collect() }
    }

    /// A rectangle about its centre, its first side turned by `yaw_rad` from the x axis.
    pub fn rectangle(centre_mm: [f64; 2], sides_mm: [f64; 2], yaw_rad: f64) -> Self {
        let [a, b] = sides_mm.map(|side| side / 2.0);
        Self { corners_mm: vec![[-a, -b], [a, -b], [a, b], [-a, b]] }.moved(centre_mm, yaw_rad)
    }

    /// The same turned by `yaw_rad` about the origin, then moved by (x, y).
    pub fn moved(&self, [x_mm, y_mm]: [f64; 2], yaw_rad: f64) -> Self {
        let (turn, by) = (DVec2::from_angle(yaw_rad), DVec2::new(x_mm, y_mm));
        Self { corners_mm: self.corners_mm.iter().map(|&p| (turn.rotate(p.into()) + by).into()).collect() }
    }

    /// The corners (x, y), mm, counter-clockwise.
    pub fn corners_mm(&self) -> &[[f64; 2]] {
        &self.corners_mm
    }

    /// Least and greatest coordinate along a direction, mm; `None` without corners.
    pub fn extent_mm(&self, direction_rad: f64) -> Option<[f64; 2]> {
        let along = DVec2::from_angle(direction_rad);
        let at = self.corners_mm.iter().map(|&p| DVec2::from(p).dot(along));
        at.fold(None, |range: Option<[f64; 2]>, v| {
            Some(range.map_or([v, v], |[least, most]| [least.min(v), most.max(v)]))
        })
    }

    /// Distance to another, mm: never more than the true one. Below 0 when they overlap; infinite when one has no corners.
    ///
    /// Two convex polygons are apart exactly if a line along one of their sides parts them; the widest such gap is taken.
    pub fn gap_mm(&self, other: &Self) -> f64 {
        if self.corners_mm.is_empty() || other.corners_mm.is_empty() {
            return f64::INFINITY;
        }
        self.gap_along_sides(other).max(other.gap_along_sides(self))
    }

    fn gap_along_sides(&self, other: &Self) -> f64 {
        let corners = &self.corners_mm;
        let mut widest = f64::NEG_INFINITY;
        for (i, &from) in corners.iter().enumerate() {
            let (from, to) = (DVec2::from(from), DVec2::from(corners[(i + 1) % corners.len()]));
            // A single point has no side: any direction will do.
            let out = if from == to { DVec2::X } else { -(to - from).perp().normalize() };
            let nearest = other.corners_mm.iter().map(|&p| (DVec2::from(p) - from).dot(out));
            widest = widest.max(nearest.fold(f64::INFINITY, f64::min));
        }
        widest
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn a_hull_has_the_outer_points_counter_clockwise() {
        let hull =
            Convex::hull(&[[0.0, 0.0], [4.0, 0.0], [2.0, 1.0], [4.0, 3.0], [0.0, 3.0], [2.0, 0.0], [f64::NAN, 1.0]]);
        assert_eq!(hull.corners_mm(), &[[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [0.0, 3.0]]);
        assert_eq!(hull.extent_mm(0.0), Some([0.0, 4.0]));
        assert_eq!(Convex::hull(&[]).extent_mm(0.0), None);
        // From a file they may come in any order, and the first once more at the end.
        let clockwise: Convex = serde_json::from_str("[[0,0],[0,3],[4,3],[4,0],[0,0]]").unwrap();
        assert_eq!(clockwise, hull);
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 256, failure_persistence: None, ..ProptestConfig::default() })]

        /// Against a grid of points in both: slow and plain.
        #[test]
        fn overlap_is_a_common_point_and_a_gap_is_no_longer_than_the_shortest_way(
            x in -30.0..30.0f64, y in -30.0..30.0f64, yaw in 0.0..3.0f64, other_yaw in 0.0..3.0f64,
        ) {
            let (a, b) = ([20.0, 8.0], [12.0, 16.0]);
            let first = Convex::rectangle([0.0, 0.0], a, yaw);
            let second = Convex::rectangle([x, y], b, other_yaw);
            let points = |centre: [f64; 2], sides: [f64; 2], yaw: f64| {
                let turn = DVec2::from_angle(yaw);
                (0..=40).flat_map(move |i| (0..=40).map(move |k| {
                    let at = DVec2::new((f64::from(i) / 40.0 - 0.5) * sides[0], (f64::from(k) / 40.0 - 0.5) * sides[1]);
                    turn.rotate(at) + DVec2::from(centre)
                }))
            };
            let seconds: Vec<DVec2> = points([x, y], b, other_yaw).collect();
            let shortest = points([0.0, 0.0], a, yaw)
                .flat_map(|p| seconds.iter().map(move |q| p.distance(*q)))
                .fold(f64::INFINITY, f64::min);
            let gap = first.gap_mm(&second);
            prop_assert!(gap <= shortest + 1e-9, "gap {gap}, yet two points are {shortest} apart");
            // Grid points are up to half a millimetre from the true nearest ones.
            prop_assert!(gap > 0.0 || shortest < 0.6, "overlap {gap}, yet no two points are nearer than {shortest}");
            prop_assert!((gap - second.gap_mm(&first)).abs() < 1e-9);
        }
    }
}
