//! Regression trees whose leaves add up to log-odds: how what was fitted is asked.
//!
//! `samsod.evaluation.trees` fits them, and writes them as [`judgement`](crate::judgement) and [`fringe`](crate::fringe)
//! include them.

/// Questions from the root to a leaf.
pub(crate) const DEPTH: usize = 5;
pub(crate) const LEAVES: usize = 1 << DEPTH;

/// Rows that are asked side by side: a register of AVX2.
const LANES: usize = 8;
type Lanes = [f32; LANES];

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
    /// Log-odds of each of some rows of signs. `ROOM` is a power of two from their number up, so that no number of a sign needs
    /// a check.
    pub(crate) fn log_odds<const SIGNS: usize, const ROOM: usize>(&self, rows: &[[f32; SIGNS]], odds: &mut Vec<f32>) {
        const { assert!(ROOM.is_power_of_two() && SIGNS <= ROOM) };
        odds.clear();
        odds.resize(rows.len(), self.start);
        for (rows, odds) in rows.chunks(LANES).zip(odds.chunks_mut(LANES)) {
            let mut columns = [[0.0; LANES]; ROOM];
            for (lane, row) in rows.iter().enumerate() {
                columns.iter_mut().zip(row).for_each(|(column, &sign)| column[lane] = sign);
            }
            odds.iter_mut().zip(self.sum(&columns)).for_each(|(odds, sum)| *odds += sum);
        }
    }

    /// Sum of the leaves.
    fn sum<const ROOM: usize>(&self, columns: &[Lanes; ROOM]) -> Lanes {
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2") {
            // SAFETY: the processor was just found to have AVX2, the only feature the function asks for.
            return unsafe { sum_avx2(self.trees, columns) };
        }
        sum_leaves(self.trees, columns)
    }
}

/// [`sum_leaves`] in registers of eight; the same operations in the same order.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn sum_avx2<const ROOM: usize>(trees: &[Tree], columns: &[Lanes; ROOM]) -> Lanes {
    sum_leaves(trees, columns)
}

/// All questions of a tree are asked, and of the two sides of each the one that its answer leads to is kept, from the leaves to
/// the root: 31 choices instead of 5 steps, but for eight rows at once, and none waits for another.
#[inline(always)]
fn sum_leaves<const ROOM: usize>(trees: &[Tree], columns: &[Lanes; ROOM]) -> Lanes {
    let mut sum = [0.0; LANES];
    for tree in trees {
        let mut sides = [[0.0; LANES]; LEAVES / 2];
        let (nodes, last) = tree.questions.split_at(LEAVES / 2 - 1);
        for ((kept, pair), &question) in sides.iter_mut().zip(tree.leaves.as_chunks::<2>().0).zip(last) {
            *kept = choose(columns, question, &[pair[0]; LANES], &[pair[1]; LANES]);
        }
        for level in (0..DEPTH - 1).rev() {
            let count = 1 << level;
            for (k, &question) in nodes[count - 1..2 * count - 1].iter().enumerate() {
                sides[k] = choose(columns, question, &sides[2 * k], &sides[2 * k + 1]);
            }
        }
        sum.iter_mut().zip(sides[0]).for_each(|(sum, leaf)| *sum += leaf);
    }
    sum
}

/// `right` where the sign is above the bound, else `left`. Numbers of signs are cut to the columns, which changes none.
#[inline(always)]
fn choose<const ROOM: usize>(columns: &[Lanes; ROOM], (sign, bound): (u8, f32), left: &Lanes, right: &Lanes) -> Lanes {
    let signs = &columns[usize::from(sign) % ROOM];
    let mut kept = [0.0; LANES];
    for lane in 0..LANES {
        // By bits: of a plain `if` the compiler made eight jumps.
        let to_right = u32::from(signs[lane] > bound).wrapping_neg();
        let (left, right) = (left[lane].to_bits(), right[lane].to_bits());
        kept[lane] = f32::from_bits(left ^ (left ^ right) & to_right);
    }
    kept
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
        let odds_of = |trees, rows: &[[f32; DEPTH]]| {
            let mut odds = vec![9.0];
            Forest { start: 0.25, trees }.log_odds::<DEPTH, 8>(rows, &mut odds);
            odds
        };
        let answers = |leaf: usize| std::array::from_fn(|k| (leaf >> (DEPTH - 1 - k) & 1) as f32);
        let rows: Vec<[f32; DEPTH]> = (0..LEAVES).map(answers).collect();
        let expected: Vec<f32> = (0..LEAVES).map(|leaf| 0.25 + leaf as f32).collect();
        assert_eq!(odds_of(std::slice::from_ref(&TREE), &rows), expected);
        // Any number of rows, not only whole registers.
        assert_eq!(odds_of(std::slice::from_ref(&TREE), &rows[..13]), expected[..13]);
        // A value at the bound is not above it.
        assert_eq!(odds_of(std::slice::from_ref(&TREE), &[[0.5; DEPTH]]), [0.25]);
        assert_eq!(odds_of(&[], &rows[..2]), [0.25, 0.25]);
    }

    #[test]
    fn registers_change_nothing() {
        let columns: [Lanes; 8] =
            std::array::from_fn(|sign| std::array::from_fn(|lane| ((sign * 5 + lane * 3) % 7) as f32 / 7.0));
        let forest = Forest { start: 0.0, trees: std::slice::from_ref(&TREE) };
        assert_eq!(forest.sum(&columns), sum_leaves(forest.trees, &columns));
    }
}
