//! Parts at poses, how likely they are, and which of them explain a region.

use std::collections::BTreeMap;

use crate::pose_fit::Fit;
use crate::silhouette::Silhouette;

/// Log-odds beyond which no other part is looked for.
pub(crate) const SURE: f32 = 3.0;
/// Log-odds of a score of one half.
const EVEN: f32 = -0.8;
/// Log-odds that halve the distance of a score to 0 or 1, about.
const SCALE: f32 = 2.0;
/// Candidates that share more than this of the smaller exclude each other.
pub(crate) const MOST_SHARED: f32 = 0.25;
/// Fits of one part that share more than this are of one place.
pub(crate) const SAME_PLACE: f32 = 0.75;
/// Log-odds of features that agree: their score times this.
const FEATURE_ODDS: f32 = 5.6;
/// Log-odds of the points inside, beyond those of any part, where one part is turned this way or that.
const TURN_ODDS: f32 = 5.4;
/// Log-odds against a part of another tint: their distance times this. A part in another paint can still be found.
const TINT_ODDS: f32 = 9.2;

/// Log-odds against a part where the separation found none.
const BARE_ODDS: f32 = 0.8;

/// A part at a pose.
#[derive(Debug, Clone)]
pub(crate) struct Candidate {
    /// Index in the catalogue.
    pub(crate) part: usize,
    pub(crate) fit: Fit,
    pub(crate) silhouette: Silhouette,
    /// Pixels of the silhouette, and those of them that are object, and outside of the region.
    pub(crate) pixels: [u32; 3],
    /// Pixels of each object, by its code.
    pub(crate) of_objects: BTreeMap<u8, u32>,
    /// Share that the silhouette has of the objects that lie in it by a third or more; `None` where there are no objects.
    pub(crate) explained: Option<f32>,
    /// Score of local features that agree with the pose, in [0, 1].
    pub(crate) features: f32,
    /// How far the tint of the silhouette is from that of the template, in [0, 1].
    pub(crate) tint: f32,
}

impl Candidate {
    /// Log-odds that it is right.
    ///
    /// The weights are those of a logistic regression over what was chosen in rendered scenes: right ones of the whole
    /// catalogue, wrong ones of catalogues without the part; `docs/vision.md` has the figures.
    pub(crate) fn odds(&self) -> f32 {
        let Fit { outline, inner, hits, .. } = self.fit;
        let features = FEATURE_ODDS * self.features;
        let [all, object, outside] = self.pixels.map(|n| n as f32);
        let Some(explained) = self.explained else {
            let edges = 4.5 * outline + 8.1 * inner + 6.5 * hits - 7.4 + features;
            // The conventional search, which knows no regions, has edges only.
            return if outside < all { edges - TINT_ODDS * self.tint - BARE_ODDS } else { edges };
        };
        let all = all.max(1.0);
        let region = 3.2 * object / all - 2.5 * outside / all + 9.3 * explained;
        let edges = 2.9 * outline + 5.8 * inner + 6.1 * hits;
        edges + region + 0.05 * all.ln() - TINT_ODDS * self.tint - 15.3 + features
    }

    /// Log-odds among poses of one part in one place, which differ by a turn: most of it is told by what is inside.
    fn turn_odds(&self) -> f32 {
        self.odds() + TURN_ODDS * self.fit.inner
    }

    /// In [0, 1]; 0.5 where a named part is right and an unknown one passes for it about equally rarely.
    pub(crate) fn score(&self) -> f32 {
        1.0 / (1.0 + (-(self.odds() - EVEN) / SCALE).exp())
    }

    /// What is chosen first: the likelier, but of two likely ones that which explains more. A small part finds its edges
    /// in many a large one.
    fn rank(&self) -> f32 {
        // Half the log-odds: of two poses of one part, both likely, the likelier must still win.
        let likely = 1.0 / (1.0 + (-0.5 * self.odds()).exp());
        likely.powi(4) * (self.pixels[0] as f32).sqrt()
    }

    /// Object pixels that it explains, weighed by how likely it is.
    fn worth(&self) -> f32 {
        self.score() * self.pixels[1] as f32
    }

    /// Whether it has most of two objects or more.
    pub(crate) fn is_joined(&self) -> bool {
        self.of_objects.len() > 1 && self.explained.is_some_and(|explained| explained >= MOST_EXPLAINED)
    }

    /// Pixels that it shares with another, as a share of the smaller.
    pub(crate) fn overlap(&self, other: &Self) -> f32 {
        let both = self.silhouette.shared_pixels(&other.silhouette);
        let weight = self.silhouette.step * self.silhouette.step;
        let (a_pixels, b_pixels) = (self.pixels[0] / weight, other.pixels[0] / weight);
        both as f32 / a_pixels.min(b_pixels).max(1) as f32
    }
}

/// Share of its objects that a part has whose pieces they are.
const MOST_EXPLAINED: f32 = 0.8;
/// A part in pieces that pass for others is worth this much more than they.
const JOINED_LEAD: f32 = 1.2;

/// A candidate that was chosen.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Choice {
    /// Its index.
    pub(crate) index: usize,
    /// The likeliest candidate of another part in its place.
    pub(crate) rival: Option<usize>,
}

/// The candidates that together explain a region, the first choice first: none overlaps another by much.
pub(crate) fn choose(candidates: &[Candidate]) -> Vec<Choice> {
    let mut order: Vec<(usize, f32)> = candidates.iter().map(Candidate::rank).enumerate().collect();
    order.sort_by(|a, b| b.1.total_cmp(&a.1));
    let chosen = choose_in(&order, candidates);
    // Pieces of a part may each pass for a small one, where the part explains them all.
    let in_pieces = order.iter().copied().find(|&(index, _)| joins(index, &chosen, candidates));
    let Some(first) = in_pieces else { return chosen };
    let is_first = |(index, _): &(usize, f32)| *index == first.0;
    let order: Vec<(usize, f32)> = std::iter::once(first).chain(order.into_iter().filter(|o| !is_first(o))).collect();
    choose_in(&order, candidates)
}

/// Whether a candidate explains more than all those together that were chosen in its place, several and none of them sure.
fn joins(index: usize, chosen: &[Choice], candidates: &[Candidate]) -> bool {
    let candidate = &candidates[index];
    if !candidate.is_joined() || candidate.odds() < EVEN || chosen.iter().any(|choice| choice.index == index) {
        return false;
    }
    let others = chosen.iter().map(|choice| &candidates[choice.index]);
    let others: Vec<&Candidate> = others.filter(|other| candidate.overlap(other) > MOST_SHARED).collect();
    let worth: f32 = others.iter().map(|other| other.worth()).sum();
    let is_small = |other: &&Candidate| other.odds() < SURE && other.pixels[0] < candidate.pixels[0];
    others.len() > 1 && others.iter().all(is_small) && candidate.worth() > JOINED_LEAD * worth
}

/// The candidates, in an order, none of which overlaps one before it by much.
fn choose_in(order: &[(usize, f32)], candidates: &[Candidate]) -> Vec<Choice> {
    let mut chosen: Vec<Choice> = Vec::new();
    for &(index, _) in order {
        let is_free = |c: &Candidate| chosen.iter().all(|choice| c.overlap(&candidates[choice.index]) <= MOST_SHARED);
        if !is_free(&candidates[index]) {
            continue;
        }
        // Of fits of one part in one place the likeliest: where all are likely, their ranks differ by a few pixels only.
        let alike = |other: &Candidate| {
            other.part == candidates[index].part && other.overlap(&candidates[index]) > SAME_PLACE && is_free(other)
        };
        let same = candidates.iter().enumerate().filter(|(_, other)| alike(other));
        let index = same.max_by(|a, b| a.1.turn_odds().total_cmp(&b.1.turn_odds())).map_or(index, |(i, _)| i);
        let candidate = &candidates[index];
        let rivals = candidates.iter().enumerate();
        let rival = rivals
            .filter(|(_, other)| other.part != candidate.part && candidate.overlap(other) > MOST_SHARED)
            .max_by(|a, b| a.1.odds().total_cmp(&b.1.odds()))
            .map(|(i, _)| i);
        chosen.push(Choice { index, rival });
    }
    chosen
}

#[cfg(test)]
mod tests {
    use samsod_segment::BoundingBox;

    use super::*;
    use crate::pose_fit::Pose;

    /// A rectangle, all of which is object, that fits so well; it explains a share of the object.
    fn candidate(part: usize, [x, y, width, height]: [u32; 4], quality: f32, explained: f32) -> Candidate {
        let pixels = width * height;
        Candidate {
            part,
            fit: Fit {
                pose: Pose { x_mm: 0.0, y_mm: 0.0, yaw_rad: 0.0 },
                outline: quality,
                inner: quality,
                hits: quality,
            },
            silhouette: Silhouette {
                bbox: BoundingBox { x, y, width, height },
                step: 1,
                bits: vec![1; pixels as usize],
            },
            pixels: [pixels, pixels, 0],
            of_objects: BTreeMap::from([(2, pixels)]),
            explained: Some(explained),
            features: 0.0,
            tint: 0.0,
        }
    }

    fn chosen(candidates: &[Candidate]) -> Vec<usize> {
        choose(candidates).iter().map(|choice| choice.index).collect()
    }

    #[test]
    fn a_small_part_in_a_large_one_does_not_win_over_it() {
        let large = candidate(0, [100, 100, 100, 60], 0.7, 1.0);
        // It lies on edges of the large one and fits them a little better.
        let small = candidate(1, [110, 110, 30, 20], 0.75, 600.0 / 6000.0);
        assert_eq!(chosen(&[small.clone(), large.clone()]), [1]);
        // But it wins over a large one that fits nothing.
        let wrong = candidate(0, [100, 100, 100, 60], 0.05, 0.5);
        let right = candidate(1, [110, 110, 30, 20], 0.75, 1.0);
        assert_eq!(chosen(&[wrong, right])[0], 1);
    }

    #[test]
    fn a_part_in_pieces_wins_over_what_they_pass_for() {
        let mut whole = candidate(0, [100, 100, 120, 40], 0.27, 0.97);
        whole.of_objects = BTreeMap::from([(2, 1500), (3, 1500)]);
        whole.pixels[1] = 3000;
        let [mut left, mut right] =
            [candidate(1, [100, 105, 40, 25], 0.45, 0.8), candidate(2, [170, 105, 40, 25], 0.45, 0.8)];
        left.pixels[1] = 900;
        right.pixels[1] = 900;
        assert_eq!(chosen(&[left.clone(), right.clone(), whole.clone()]), [2]);
        // Not over a single one, not over a sure one, and not where it has one object only.
        assert_eq!(chosen(&[left.clone(), whole.clone()])[0], 0);
        let sure = candidate(2, [170, 105, 40, 25], 0.9, 1.0);
        assert!(sure.odds() >= SURE && left.odds() < SURE && left.rank() > whole.rank());
        assert!(!chosen(&[left.clone(), sure, whole.clone()]).contains(&2));
        whole.of_objects = BTreeMap::from([(2, 3000)]);
        assert!(!chosen(&[left, right, whole]).contains(&2));
    }

    #[test]
    fn two_parts_side_by_side_are_both_chosen() {
        let left = candidate(0, [100, 100, 60, 60], 0.7, 0.5);
        let right = candidate(1, [158, 100, 60, 60], 0.6, 0.5);
        let mut both = chosen(&[left.clone(), right.clone()]);
        both.sort_unstable();
        assert_eq!(both, [0, 1]);
        assert!(choose(&[left, right]).iter().all(|choice| choice.rival.is_none()));
        assert!(choose(&[]).is_empty());
    }

    #[test]
    fn of_fits_of_one_part_the_likeliest_is_taken_not_the_one_with_a_few_pixels_more() {
        let better = candidate(0, [100, 100, 100, 60], 0.9, 1.0);
        let worse = candidate(0, [100, 100, 101, 61], 0.7, 1.0);
        assert_eq!(chosen(&[worse, better]), [1]);
    }

    #[test]
    fn the_rival_is_the_likeliest_other_part_in_the_same_place() {
        let all = [
            candidate(0, [0, 0, 50, 50], 0.8, 1.0),
            candidate(1, [2, 2, 50, 50], 0.3, 0.9),
            candidate(2, [1, 1, 50, 50], 0.5, 0.9),
            candidate(0, [3, 3, 50, 50], 0.7, 1.0),
            candidate(3, [300, 0, 50, 50], 0.7, 1.0),
        ];
        let mut found = choose(&all);
        found.sort_by_key(|choice| choice.index);
        assert_eq!(found, [Choice { index: 0, rival: Some(2) }, Choice { index: 4, rival: None }]);
    }

    #[test]
    fn what_speaks_for_a_part_raises_its_score() {
        let base = candidate(0, [0, 0, 40, 40], 0.5, 0.8);
        let better = |change: fn(&mut Candidate)| {
            let mut other = base.clone();
            change(&mut other);
            assert!(other.score() > base.score(), "{other:?}");
            assert!((0.0..=1.0).contains(&other.score()));
        };
        better(|c| c.fit.inner = 0.8);
        better(|c| c.fit.hits = 0.8);
        better(|c| c.explained = Some(1.0));
        better(|c| c.features = 0.5);
        let worse = |change: fn(&mut Candidate)| {
            let mut other = base.clone();
            change(&mut other);
            assert!(other.score() < base.score(), "{other:?}");
        };
        worse(|c| c.pixels = [1600, 800, 800]);
        worse(|c| c.tint = 0.2);
        // A part seen by nobody, as numbers and not as NaN.
        let mut nothing = candidate(0, [0, 0, 0, 0], 0.0, 0.0);
        assert!(nothing.score() < 0.05, "{}", nothing.score());
        nothing.explained = None;
        assert!(nothing.score() < 0.05 && nothing.overlap(&base) == 0.0, "{}", nothing.score());
    }

    #[test]
    fn overlap_is_a_share_of_the_smaller() {
        let (large, small) = (candidate(0, [0, 0, 40, 40], 0.5, 1.0), candidate(1, [30, 0, 20, 20], 0.5, 1.0));
        assert!((large.overlap(&small) - 0.5).abs() < 1e-6 && (small.overlap(&large) - 0.5).abs() < 1e-6);
    }
}
