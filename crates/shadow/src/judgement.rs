//! Judges a piece by its signs: regression trees, whose leaves add up to the log-odds of a part.
//!
//! How signs go together (a soft rim counts less under a dome, a tone less on a grey table) is more than constants chosen by
//! hand can hold. The trees were fitted by `samsod.evaluation.judgement` to the pieces of rendered scenes; they know how
//! parts and shadows differ on tables, and nothing of any part. `docs/vision.md` says on what, and what they give on tables
//! that they have not seen.

use crate::forest::{Forest, Tree};
use crate::signs::{SIGNS, Signs};

/// As `samsod.evaluation.judgement` wrote it.
static FOREST: Forest<SIGNS, { SIGNS.next_power_of_two() }, 31, 32> = include!("judgement.in");

/// Log-odds that pieces with these signs are part.
pub(crate) fn log_odds(pieces: &[Signs], odds: &mut Vec<f32>) {
    FOREST.log_odds(pieces, odds);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_question_is_about_a_sign() {
        let asked: Vec<usize> =
            FOREST.trees.iter().flat_map(|tree| tree.questions).map(|(sign, _)| usize::from(sign)).collect();
        assert!(asked.iter().all(|&sign| sign < SIGNS));
        assert!(FOREST.middles.iter().chain(&FOREST.steps).all(|scale| scale.is_finite()));
    }
}
