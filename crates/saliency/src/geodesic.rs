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
