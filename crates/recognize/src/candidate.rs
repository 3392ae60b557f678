//! Parts at poses, how likely they are, and which of them explain a region.

use std::collections::BTreeMap;

use crate::pose_fit::Fit;
use crate::silhouette::Silhouette;

/// Log-odds beyond which no other part is looked for.
pub(crate) const SURE: f32 = 3.0;
/// Log-odds of a score of one half.
const EVEN: f32 = 0.8;
/// Log-odds that halve the distance of a score to 0 or 1, about.
const SCALE: f32 = 2.0;
/// Candidates that share more than this of the smaller exclude each other.
const MOST_SHARED: f32 = 0.25;
/// Log-odds of features that agree: their score times this.
const FEATURE_ODDS: f32 = 5.0;

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
}

impl Candidate {
    /// Log-odds that it is right.
    ///
    /// The weights are those of a logistic regression over all candidates of rendered scenes, right ones (name, place to
    /// 2.5 mm, angle to 6 degrees) and wrong ones counting alike; `docs/vision.md` has the figures.
    pub(crate) fn odds(&self) -> f32 {
        let Fit { outline, inner, hits, .. } = self.fit;
        let features = FEATURE_ODDS * self.features;
        let Some(explained) = self.explained else { return 4.5 * outline + 8.1 * inner + 6.5 * hits - 5.8 + features };
        let [all, object, outside] = self.pixels.map(|n| n as f32);
        let all = all.max(1.0);
        let region = 2.6 * object / all - 6.1 * outside / all + 9.2 * explained;
        11.2 * inner + 6.3 * hits + region + 0.1 * all.ln() - 15.2 + features
    }

    /// In [0, 1]; 0.5 where a named part is right and an unknown one passes for it about equally rarely.
    pub(crate) fn score(&self) -> f32 {
        1.0 / (1.0 + (-(self.odds() - EVEN) / SCALE).exp())
    }

    /// What is chosen first: the likelier, but of two likely ones that which explains more. A small part finds its edges
    /// in many a large one.
    fn rank(&self) -> f32 {
        let likely = 1.0 / (1.0 + (-self.odds()).exp());
        likely.powi(4) * (self.pixels[0] as f32).sqrt()
    }

    /// Pixels that it shares with another, as a share of the smaller.
    pub(crate) fn overlap(&self, other: &Self) -> f32 {
        let both = self.silhouette.shared_pixels(&other.silhouette);
        let weight = self.silhouette.step * self.silhouette.step;
        let (a_pixels, b_pixels) = (self.pixels[0] / weight, other.pixels[0] / weight);
        both as f32 / a_pixels.min(b_pixels).max(1) as f32
    }
}

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
    let mut chosen: Vec<Choice> = Vec::new();
    for &(index, _) in &order {
        let candidate = &candidates[index];
        if chosen.iter().any(|choice| candidate.overlap(&candidates[choice.index]) > MOST_SHARED) {
            continue;
        }
        let rivals = candidates.iter().enumerate();
        let rival = rivals
            .filter(|(_, other)| other.part != candidate.part && candidate.overlap(other) > MOST_SHARED)
            .max_by(|a, b| a.1.odds().total_cmp(&b.1.odds()))
            .map(|(i, _)| i);
        chosen.push(Choice { index, rival });
    }
    chosen
}
