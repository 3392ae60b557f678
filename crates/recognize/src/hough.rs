//! Hough clustering of feature matches over (x, y, scale, angle) (section 5.1 of the paper, after Lowe 2004).
//!
//! In: one vote a match, where it puts the part. Out: the members of the fullest cells, fullest first. A vote counts in
//! the two nearest cells of every dimension, so that a pose at the border of a cell loses none. O(n log n) time and
//! O(n) memory in the number of votes, whatever the range of the poses: only cells that have a vote exist.

use std::f64::consts::TAU;

/// Where one match puts the part.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Vote {
    /// Position of a fixed point of the part, mm.
    pub(crate) at: [f64; 2],
    /// Natural logarithm of the scale.
    pub(crate) ln_scale: f64,
    /// Yaw of the part, rad.
    pub(crate) angle_rad: f64,
}

/// Sizes of the cells.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Cells {
    /// Side of a cell along x and y, mm.
    pub(crate) side_mm: f64,
    /// Width along the logarithm of the scale.
    pub(crate) ln_scale: f64,
    /// Number of cells round the circle, at least 2.
    pub(crate) angles: u32,
}

/// Cells x, y, scale, angle.
type Cell = [i64; 4];

/// The members (indices of votes, increasing) of up to `most` clusters of at least `least` votes, largest first.
///
/// A cluster is a cell and every vote within one cell width of the mean of the cell's votes. No vote is in two clusters.
/// Votes that are not finite are in none.
pub(crate) fn clusters(votes: &[Vote], cells: &Cells, least: usize, most: usize) -> Vec<Vec<usize>> {
    let mut entries: Vec<(Cell, usize)> = Vec::with_capacity(votes.len() * 16);
    for (index, vote) in votes.iter().enumerate() {
        if [vote.at[0], vote.at[1], vote.ln_scale, vote.angle_rad].iter().all(|value| value.is_finite()) {
            cells.of(vote, |cell| entries.push((cell, index)));
        }
    }
    entries.sort_unstable();
    let mut full: Vec<&[(Cell, usize)]> = entries.chunk_by(|a, b| a.0 == b.0).filter(|c| c.len() >= least).collect();
    // Equal counts in the order of the cells: the same votes give the same clusters.
    full.sort_by_key(|cell| std::cmp::Reverse(cell.len()));
    let mut taken = vec![false; votes.len()];
    let mut found: Vec<Vec<usize>> = Vec::new();
    for cell in full {
        if found.len() == most {
            break;
        }
        let members: Vec<Vote> = cell.iter().filter(|(_, i)| !taken[*i]).map(|(_, i)| votes[*i]).collect();
        // The cells around a cluster hold the same votes as it.
        if members.len() < least {
            continue;
        }
        let center = mean(&members);
        let is_member = |i: &usize| !taken[*i] && cells.within(&votes[*i], &center);
        let cluster: Vec<usize> = (0..votes.len()).filter(is_member).collect();
        if cluster.len() >= least {
            cluster.iter().for_each(|&i| taken[i] = true);
            found.push(cluster);
        }
    }
    found.sort_by_key(|cluster| std::cmp::Reverse(cluster.len()));
    found
}

/// Mean of votes that are close to each other.
pub(crate) fn mean(votes: &[Vote]) -> Vote {
    let n = votes.len().max(1) as f64;
    let sum = |of: fn(&Vote) -> f64| votes.iter().map(of).sum::<f64>();
    Vote {
        at: [sum(|v| v.at[0]) / n, sum(|v| v.at[1]) / n],
        ln_scale: sum(|v| v.ln_scale) / n,
        angle_rad: sum(|v| v.angle_rad.sin()).atan2(sum(|v| v.angle_rad.cos())),
    }
}

impl Cells {
    /// The 16 cells of a vote.
    fn of(&self, vote: &Vote, mut put: impl FnMut(Cell)) {
        let angles = i64::from(self.angles.max(2));
        let pair = |value: f64| {
            // Cell k is centred at k + 1/2; the nearest two of a value begin at that of value - 1/2.
            let first = (value - 0.5).floor().clamp(-1e15, 1e15) as i64;
            [first, first + 1]
        };
        let [x, y] = vote.at.map(|c| pair(c / self.side_mm));
        let scale = pair(vote.ln_scale / self.ln_scale);
        let angle = pair(vote.angle_rad / TAU * angles as f64).map(|cell| cell.rem_euclid(angles));
        for x in x {
            for y in y {
                for s in scale {
                    angle.iter().for_each(|&a| put([x, y, s, a]));
                }
            }
        }
    }

    /// Whether a vote is within one cell width of a pose.
    fn within(&self, vote: &Vote, center: &Vote) -> bool {
        let turn = (vote.angle_rad - center.angle_rad + TAU / 2.0).rem_euclid(TAU) - TAU / 2.0;
        (vote.at[0] - center.at[0]).hypot(vote.at[1] - center.at[1]) <= self.side_mm
            && (vote.ln_scale - center.ln_scale).abs() <= self.ln_scale
            && turn.abs() <= TAU / f64::from(self.angles.max(2))
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const CELLS: Cells = Cells { side_mm: 10.0, ln_scale: 0.7, angles: 12 };

    /// A fixed sequence of numbers in [0, 1).
    pub(crate) fn noise(state: &mut u64) -> f64 {
        *state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (*state >> 11) as f64 / (1u64 << 53) as f64
    }

    fn anywhere(state: &mut u64) -> Vote {
        let at = [noise(state) * 400.0 - 200.0, noise(state) * 400.0 - 200.0];
        Vote { at, ln_scale: noise(state) * 3.0 - 1.5, angle_rad: noise(state) * TAU - TAU / 2.0 }
    }

    fn near(pose: &Vote, state: &mut u64) -> Vote {
        let mut off = |most: f64| (noise(state) - 0.5) * 2.0 * most;
        Vote {
            at: [pose.at[0] + off(3.0), pose.at[1] + off(3.0)],
            ln_scale: pose.ln_scale + off(0.2),
            angle_rad: pose.angle_rad + off(0.15),
        }
    }

    proptest! {
        #[test]
        fn a_cluster_is_found_among_twenty_times_as_many_outliers(seed in 0u64..1000) {
            let mut state = seed;
            let pose = anywhere(&mut state);
            let mut votes: Vec<Vote> = (0..200).map(|_| anywhere(&mut state)).collect();
            votes.extend((0..10).map(|_| near(&pose, &mut state)));
            let found = clusters(&votes, &CELLS, 5, 3);
            prop_assert!((200..210).all(|i| found[0].contains(&i)), "{found:?}");
            prop_assert!(found[0].len() <= 13, "{} outliers", found[0].len() - 10);
        }

        #[test]
        fn no_vote_is_in_two_clusters(seed in 0u64..200, n in 0usize..120) {
            let mut state = seed;
            let votes: Vec<Vote> = (0..n).map(|_| anywhere(&mut state)).collect();
            let mut all: Vec<usize> = clusters(&votes, &CELLS, 1, usize::MAX).concat();
            let count = all.len();
            all.sort_unstable();
            all.dedup();
            prop_assert_eq!(all.len(), count);
            prop_assert_eq!(count, n);
        }
    }

    #[test]
    fn two_poses_are_two_clusters_and_the_larger_comes_first() {
        let mut state = 1;
        let first = Vote { at: [10.0, 10.0], ln_scale: 0.0, angle_rad: 3.1 };
        let second = Vote { at: [10.0, 10.0], ln_scale: 0.0, angle_rad: -1.0 };
        let mut votes: Vec<Vote> = (0..6).map(|_| near(&first, &mut state)).collect();
        votes.extend((0..9).map(|_| near(&second, &mut state)));
        let found = clusters(&votes, &CELLS, 4, 8);
        assert_eq!(found, [(6..15).collect::<Vec<_>>(), (0..6).collect()]);
        assert_eq!(clusters(&votes, &CELLS, 7, 8).len(), 1);
        assert_eq!(clusters(&votes, &CELLS, 4, 1).len(), 1);
    }

    #[test]
    fn angles_are_round() {
        let vote = |angle_rad| Vote { at: [0.0; 2], ln_scale: 0.0, angle_rad };
        let votes = [vote(3.12), vote(-3.12), vote(3.0), vote(-3.0 + TAU)];
        assert_eq!(clusters(&votes, &CELLS, 4, 1), [[0, 1, 2, 3]]);
        assert!((mean(&votes).angle_rad.abs() - TAU / 2.0).abs() < 1e-6);
    }

    #[test]
    fn nothing_and_what_is_not_finite_is_no_cluster() {
        assert!(clusters(&[], &CELLS, 1, 5).is_empty());
        let votes = [Vote { at: [f64::NAN, 0.0], ln_scale: 0.0, angle_rad: 0.0 }; 9];
        assert!(clusters(&votes, &CELLS, 1, 5).is_empty());
        let votes = [Vote { at: [f64::MAX, 0.0], ln_scale: f64::MIN, angle_rad: 1e300 }; 9];
        assert!(clusters(&votes, &CELLS, 1, 5).len() <= 1);
    }
}
