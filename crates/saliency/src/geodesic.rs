//! How far a partition is from the border of the image on the way of least colour change (Wei et al., geodesic saliency).
//!
//! Background reaches the border without a strong edge; an object is surrounded by one. A step from a partition to its
//! neighbour costs their distance in L*a*b* less what noise and shading make.

use std::cmp::{Ordering, Reverse};
use std::collections::BinaryHeap;

use samsod_segment::Partition;

use crate::lab::distance;

/// Steps up to this Delta E are free: otherwise many small ones, as of a sky that grows darker, add up to an edge.
const FREE_STEP: f32 = 3.0;

/// A label and its cost so far; ordered by cost, then label, so that the result does not depend on the heap.
#[derive(PartialEq)]
struct Reached {
    cost: f32,
    label: u32,
}

impl Eq for Reached {}

impl Ord for Reached {
    fn cmp(&self, other: &Self) -> Ordering {
        self.cost.total_cmp(&other.cost).then(self.label.cmp(&other.label))
    }
}

impl PartialOrd for Reached {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

/// The cost of the cheapest way from every partition to one that has pixels on the border, in Delta E.
///
/// `colours` are L*a*b* and `border_px` the pixels on the border, one a label.
pub(crate) fn border_distance(partition: &Partition, colours: &[[f32; 3]], border_px: &[u32]) -> Vec<f32> {
    let mut costs = vec![f32::INFINITY; colours.len()];
    let mut heap = BinaryHeap::new();
    for (label, _) in (0u32..).zip(border_px).filter(|(_, px)| **px > 0) {
        costs[label as usize] = 0.0;
        heap.push(Reverse(Reached { cost: 0.0, label }));
    }
    while let Some(Reverse(Reached { cost, label })) = heap.pop() {
        let from = label as usize;
        if cost > costs[from] {
            continue;
        }
        for &next in partition.neighbours(label) {
            let to = next as usize;
            let reached = cost + (distance(colours[from], colours[to]) - FREE_STEP).max(0.0);
            if reached < costs[to] {
                costs[to] = reached;
                heap.push(Reverse(Reached { cost: reached, label: next }));
            }
        }
    }
    costs
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "helpers of tests fail by panicking, too")]

    use samsod_segment::{Partition, RgbView};

    use super::border_distance;

    /// Rings of one pixel about a centre: label 0 is the border.
    fn rings(colours: &[[f32; 3]]) -> Vec<f32> {
        let side = 2 * colours.len() - 1;
        let ring = |i: usize| {
            let (x, y) = (i % side, i / side);
            x.min(y).min(side - 1 - x).min(side - 1 - y) as u32
        };
        let labels: Vec<u32> = (0..side * side).map(ring).collect();
        let pixels = vec![0u8; side * side * 3];
        let view = RgbView::from_raw(side as u32, side as u32, pixels.as_slice()).unwrap();
        let partition = Partition::from_labels(&view, labels).unwrap();
        let border: Vec<u32> = (0..colours.len()).map(|label| u32::from(label == 0)).collect();
        border_distance(&partition, colours, &border)
    }

    #[test]
    fn steps_add_up_but_for_what_is_free() {
        // Steps of 13, 2 and 23 on the way in: the second is free, 3 of each of the others are.
        let light = [[0.0, 0.0, 0.0], [13.0, 0.0, 0.0], [15.0, 0.0, 0.0], [38.0, 0.0, 0.0]];
        assert_eq!(rings(&light), [0.0, 10.0, 10.0, 30.0]);
        // A way out and back in is no shorter: what has the border's colour but lies behind an edge is cut off.
        assert_eq!(rings(&[[50.0, 0.0, 0.0], [20.0, 0.0, 0.0], [50.0, 0.0, 0.0]]), [0.0, 27.0, 54.0]);
    }
}
