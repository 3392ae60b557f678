//! Judges a piece by its signs: regression trees, whose leaves add up to the log-odds of a part.
//!
//! How signs go together (a soft rim counts less under a dome, a tone less on a grey table) is more than constants chosen by
//! hand can hold. The trees were fitted by `samsod.evaluation.judgement` to the pieces of rendered scenes; they know how
//! parts and shadows differ on tables, and nothing of any part. `docs/vision.md` says on what, and what they give on tables
//! that they have not seen.

use crate::signs::{SIGNS, Signs};

/// Questions from the root to a leaf.
const DEPTH: usize = 5;
const LEAVES: usize = 1 << DEPTH;

/// After so many trees the rest is not asked
const FEW_TREES: usize = 20;
/// where the log-odds are beyond these: of 20 000 pieces of scenes left out they changed sides for none.
const NO_DOUBT: f32 = 1.5;

/// A balanced tree.
struct Tree {
    /// Question `k` is followed by `2 k + 1`, or by `2 k + 2` where the sign of this number is above the bound.
    questions: [(u8, f32); LEAVES - 1],
    /// Log-odds.
    leaves: [f32; LEAVES],
}

/// What was fitted.
struct Forest {
    /// Log-odds of a part before any question.
    start: f32,
    trees: &'static [Tree],
}

/// As `samsod.evaluation.judgement` wrote it.
static FOREST: Forest = include!("judgement.in");

/// Room for the signs: a power of two, so that no number of a sign needs a check.
const ROOM: usize = SIGNS.next_power_of_two();

/// Log-odds that a piece with these signs is part.
pub(crate) fn log_odds(signs: &Signs) -> f32 {
    sum(&FOREST, signs)
}

fn sum(forest: &Forest, signs: &Signs) -> f32 {
    let mut room = [0.0; ROOM];
    room[..SIGNS].copy_from_slice(signs);
    let of_tree = |tree: &Tree| leaf(tree, &room);
    let (few, others) = forest.trees.split_at(FEW_TREES.min(forest.trees.len()));
    let odds = forest.start + few.iter().map(of_tree).sum::<f32>();
    if odds.abs() > NO_DOUBT { odds } else { odds + others.iter().map(of_tree).sum::<f32>() }
}

/// What a tree says. Numbers are cut to the sizes of the arrays, which changes none but spares the checks of them.
#[inline(always)]
fn leaf(tree: &Tree, signs: &[f32; ROOM]) -> f32 {
    let mut k = 0;
    for _ in 0..DEPTH {
        let (sign, bound) = tree.questions[k.min(LEAVES - 2)];
        k = 2 * k + 1 + usize::from(signs[usize::from(sign) % ROOM] > bound);
    }
    tree.leaves[(k + 1) % LEAVES]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::signs::PIECE_SIGNS;

    /// Asks the sign of this number at the root, then the next one, and so on; leaves are numbered from the left.
    static TREE: Tree = {
        let mut questions = [(0, 0.5); LEAVES - 1];
        let mut leaves = [0.0; LEAVES];
        let mut k = 0;
        while k < LEAVES - 1 {
            questions[k].0 = (k + 1).ilog2() as u8;
            k += 1;
        }
        while k < 2 * LEAVES - 1 {
            leaves[k - (LEAVES - 1)] = (k - (LEAVES - 1)) as f32;
            k += 1;
        }
        Tree { questions, leaves }
    };

    #[test]
    fn answers_lead_to_a_leaf_and_leaves_add_up() {
        let forest = |trees| Forest { start: 0.25, trees };
        for leaf in 0..LEAVES {
            let mut signs = [0.0; SIGNS];
            for (k, sign) in signs[..DEPTH].iter_mut().enumerate() {
                *sign = (leaf >> (DEPTH - 1 - k) & 1) as f32;
            }
            assert_eq!(sum(&forest(std::slice::from_ref(&TREE)), &signs), 0.25 + leaf as f32);
        }
        // A value at the bound is not above it.
        assert_eq!(sum(&forest(std::slice::from_ref(&TREE)), &[0.5; SIGNS]), 0.25);
        assert_eq!(sum(&forest(&[]), &[1.0; SIGNS]), 0.25);
    }

    #[test]
    fn every_question_is_about_a_sign() {
        let asked: Vec<usize> =
            FOREST.trees.iter().flat_map(|tree| tree.questions).map(|(sign, _)| usize::from(sign)).collect();
        assert!(asked.iter().all(|&sign| sign < PIECE_SIGNS.len()));
        let finite = |tree: &Tree| tree.leaves.iter().all(|leaf| leaf.is_finite());
        assert!(FOREST.trees.iter().all(finite));
    }
}
