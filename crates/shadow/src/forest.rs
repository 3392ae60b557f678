//! Regression trees whose leaves add up to log-odds: how what was fitted is asked.
//!
//! `samsod.evaluation.trees` fits them, and writes them as [`judgement`](crate::judgement) and [`fringe`](crate::fringe)
//! include them.

/// Questions from the root to a leaf.
pub(crate) const DEPTH: usize = 5;
pub(crate) const LEAVES: usize = 1 << DEPTH;

/// Every so many trees it is asked whether the rest could change anything.
const FEW_TREES: usize = 10;

/// A balanced tree.
pub(crate) struct Tree {
    /// Question `k` is followed by `2 k + 1`, or by `2 k + 2` where the sign of this number is above the bound.
    pub(crate) questions: [(u8, f32); LEAVES - 1],
    /// Log-odds.
    pub(crate) leaves: [f32; LEAVES],
}

/// What was fitted.
pub(crate) struct Forest {
    /// Log-odds before any question.
    pub(crate) start: f32,
    pub(crate) trees: &'static [Tree],
}

impl Forest {
    /// Log-odds of what has these signs; once they are beyond `no_doubt` either way, not all trees are asked. `ROOM` is a
    /// power of two, so that no number of a sign needs a check.
    pub(crate) fn log_odds<const ROOM: usize>(&self, signs: &[f32; ROOM], no_doubt: f32) -> f32 {
        const { assert!(ROOM.is_power_of_two()) };
        let mut odds = self.start;
        for few in self.trees.chunks(FEW_TREES) {
            odds += few.iter().map(|tree| leaf(tree, signs)).sum::<f32>();
            if odds.abs() > no_doubt {
                break;
            }
        }
        odds
    }
}

/// What a tree says. Numbers are cut to the sizes of the arrays, which changes none but spares the checks of them.
#[inline(always)]
fn leaf<const ROOM: usize>(tree: &Tree, signs: &[f32; ROOM]) -> f32 {
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
            let mut signs = [0.0; 8];
            for (k, sign) in signs[..DEPTH].iter_mut().enumerate() {
                *sign = (leaf >> (DEPTH - 1 - k) & 1) as f32;
            }
            assert_eq!(forest(std::slice::from_ref(&TREE)).log_odds(&signs, f32::INFINITY), 0.25 + leaf as f32);
        }
        // A value at the bound is not above it.
        assert_eq!(forest(std::slice::from_ref(&TREE)).log_odds(&[0.5; 8], 1.0), 0.25);
        assert_eq!(forest(&[]).log_odds(&[1.0; 8], 1.0), 0.25);
    }
}
