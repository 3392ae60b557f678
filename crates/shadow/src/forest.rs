//! Regression trees whose leaves add up to log-odds: how what was fitted is asked.
//!
//! `samsod.evaluation.trees` fits them, and `judgement` there writes them as [`judgement`](crate::judgement) and
//! [`fringe`](crate::fringe) include them. Everything is in whole numbers of 16 bits, in which they were fitted, too, so that
//! sixteen rows are asked at once: signs in steps of their range, leaves in units of log-odds.

use std::hint::black_box;

/// Rows that are asked side by side: a register of AVX2.
pub(crate) const LANES: usize = 16;
type Lanes = [i16; LANES];

/// Signs are cut to so many steps; no sign is above a bound of one more.
const FARTHEST: f32 = 32_766.0;

/// Trees have eight leaves or so many times more.
const MOST_EIGHTHS: usize = 4;

/// A balanced tree, of a power of two of leaves and one question less.
pub(crate) struct Tree<const QUESTIONS: usize, const LEAVES: usize> {
    /// Question `k` is followed by `2 k + 1`, or by `2 k + 2` where the sign of this number is above the bound, in steps.
    pub(crate) questions: [(u8, i16); QUESTIONS],
    /// Units of log-odds.
    pub(crate) leaves: [i16; LEAVES],
}

/// What was fitted to rows of `SIGNS` signs. `ROOM` is a power of two from their number up, so that no number of a sign
/// needs a check.
pub(crate) struct Forest<const SIGNS: usize, const ROOM: usize, const QUESTIONS: usize, const LEAVES: usize> {
    /// Log-odds that 1 of a leaf counts.
    pub(crate) unit: f32,
    /// A sign less this,
    pub(crate) middles: [f32; SIGNS],
    /// times this, is in steps.
    pub(crate) steps: [f32; SIGNS],
    pub(crate) trees: &'static [Tree<QUESTIONS, LEAVES>],
}

impl<const SIGNS: usize, const ROOM: usize, const QUESTIONS: usize, const LEAVES: usize>
    Forest<SIGNS, ROOM, QUESTIONS, LEAVES>
{
    /// Log-odds of each of some rows of signs.
    pub(crate) fn log_odds(&self, rows: &[[f32; SIGNS]], odds: &mut Vec<f32>) {
        odds.clear();
        let mut columns = [[0.0; LANES]; SIGNS];
        for rows in rows.chunks(LANES) {
            for (lane, row) in rows.iter().enumerate() {
                columns.iter_mut().zip(row).for_each(|(column, &sign)| column[lane] = sign);
            }
            odds.extend_from_slice(&self.log_odds_of(&columns)[..rows.len()]);
        }
    }

    /// Log-odds of [`LANES`] rows of signs, sign by sign.
    pub(crate) fn log_odds_of(&self, columns: &[[f32; LANES]; SIGNS]) -> [f32; LANES] {
        self.sum(columns).map(|sum| self.unit * sum as f32)
    }

    /// Sum of the leaves.
    fn sum(&self, columns: &[[f32; LANES]; SIGNS]) -> [i32; LANES] {
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2") {
            // SAFETY: the processor was just found to have AVX2, the only feature the function asks for.
            return unsafe { self.sum_avx2(columns) };
        }
        self.sum_leaves(columns)
    }

    /// [`Forest::sum_leaves`] in registers of sixteen; the same operations in the same order.
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn sum_avx2(&self, columns: &[[f32; LANES]; SIGNS]) -> [i32; LANES] {
        self.sum_leaves(columns)
    }

    /// All questions of a tree are asked, and of the two sides of each the one that its answer leads to is kept, from the
    /// leaves to the root: more choices than there are steps from the root, but for sixteen rows at once, and none waits for
    /// another.
    #[inline(always)]
    fn sum_leaves(&self, columns: &[[f32; LANES]; SIGNS]) -> [i32; LANES] {
        const { assert!(ROOM.is_power_of_two() && SIGNS <= ROOM) };
        const { assert!(QUESTIONS + 1 == LEAVES && (LEAVES == 8 || LEAVES == 8 * MOST_EIGHTHS)) };
        // Rows fill a register. Without the boxes the compiler would gather several signs, or several small trees, into one as
        // well, which takes more than twice the time.
        let mut signs = [[0; LANES]; ROOM];
        let scales = self.middles.iter().zip(&self.steps);
        for ((signs, column), (&middle, &step)) in signs.iter_mut().zip(columns).zip(scales) {
            let column = black_box(column);
            signs.iter_mut().zip(column).for_each(|(to, &sign)| *to = whole(sign, middle, step));
        }
        let mut sum = [0; LANES];
        for tree in self.trees {
            let tree = black_box(tree);
            let mut sides = [[0; LANES]; MOST_EIGHTHS];
            for (eighth, kept) in sides[..LEAVES / 8].iter_mut().enumerate() {
                *kept = tree.eighth(&signs, eighth);
            }
            let mut first = LEAVES / 16;
            while first > 0 {
                for k in 0..first {
                    sides[k] = choose(&signs, tree.questions[first - 1 + k], &sides[2 * k], &sides[2 * k + 1]);
                }
                first /= 2;
            }
            sum.iter_mut().zip(sides[0]).for_each(|(sum, leaf)| *sum += i32::from(leaf));
        }
        sum
    }
}

impl<const QUESTIONS: usize, const LEAVES: usize> Tree<QUESTIONS, LEAVES> {
    /// The leaf that rows come to in the part of the tree with eight of its leaves, `eighth` of them before. Written out, it
    /// stays in registers; of a loop over the levels it did not.
    #[inline(always)]
    fn eighth<const ROOM: usize>(&self, signs: &[Lanes; ROOM], eighth: usize) -> Lanes {
        let eighths = LEAVES / 8;
        let inner = |level: usize, k: usize| self.questions[level * eighths - 1 + level * eighth + k];
        let last = |k: usize| {
            let leaf = 8 * eighth + 2 * k;
            choose(signs, inner(4, k), &[self.leaves[leaf]; LANES], &[self.leaves[leaf + 1]; LANES])
        };
        let left = choose(signs, inner(2, 0), &last(0), &last(1));
        let right = choose(signs, inner(2, 1), &last(2), &last(3));
        choose(signs, inner(1, 0), &left, &right)
    }
}

/// A sign in steps; a larger one never has fewer. The sum with the constant has the step, rounded, in its lowest bits, which
/// takes two operations for a whole register; `as` is done number by number.
#[inline(always)]
fn whole(sign: f32, middle: f32, step: f32) -> i16 {
    const ROUNDING: f32 = (3 << 22) as f32;
    (((sign - middle) * step).clamp(-FARTHEST, FARTHEST) + ROUNDING).to_bits() as i16
}

/// `right` where the sign is above the bound, else `left`. Numbers of signs are cut to the columns, which changes none.
#[inline(always)]
fn choose<const ROOM: usize>(signs: &[Lanes; ROOM], (sign, bound): (u8, i16), left: &Lanes, right: &Lanes) -> Lanes {
    let signs = &signs[usize::from(sign) % ROOM];
    let mut kept = [0; LANES];
    for lane in 0..LANES {
        // By bits: of a plain `if` the compiler made jumps.
        let to_right = -i16::from(signs[lane] > bound);
        kept[lane] = left[lane] ^ (left[lane] ^ right[lane]) & to_right;
    }
    kept
}

#[cfg(test)]
mod tests {
    use super::*;

    const DEPTH: usize = 5;
    const LEAVES: usize = 1 << DEPTH;
    type TestTree = Tree<{ LEAVES - 1 }, LEAVES>;

    /// Asks the sign of this number at the root, then the next one, and so on; leaves are numbered from the left.
    static TREE: TestTree = {
        let mut questions = [(0, 50); LEAVES - 1];
        let mut leaves = [0; LEAVES];
        let mut k = 0;
        while k < LEAVES - 1 {
            questions[k].0 = (k + 1).ilog2() as u8;
            k += 1;
        }
        while k < 2 * LEAVES - 1 {
            leaves[k - (LEAVES - 1)] = (k - (LEAVES - 1)) as i16;
            k += 1;
        }
        Tree { questions, leaves }
    };

    /// Signs of 0 to 1 in hundredths.
    fn forest(trees: &'static [TestTree]) -> Forest<DEPTH, 8, { LEAVES - 1 }, LEAVES> {
        Forest { unit: 0.5, middles: [0.0; DEPTH], steps: [100.0; DEPTH], trees }
    }

    fn odds_of(trees: &'static [TestTree], rows: &[[f32; DEPTH]]) -> Vec<f32> {
        let mut odds = vec![9.0];
        forest(trees).log_odds(rows, &mut odds);
        odds
    }

    #[test]
    fn answers_lead_to_a_leaf_and_leaves_add_up() {
        let answers = |leaf: usize| std::array::from_fn(|k| (leaf >> (DEPTH - 1 - k) & 1) as f32);
        let rows: Vec<[f32; DEPTH]> = (0..LEAVES).map(answers).collect();
        let expected: Vec<f32> = (0..LEAVES).map(|leaf| 0.5 * leaf as f32).collect();
        let one = std::slice::from_ref(&TREE);
        assert_eq!(odds_of(one, &rows), expected);
        // Any number of rows, not only whole registers.
        assert_eq!(odds_of(one, &rows[..21]), expected[..21]);
        // A value at the bound is not above it, one a step farther is.
        assert_eq!(odds_of(one, &[[0.5; DEPTH], [0.51; DEPTH]]), [0.0, 15.5]);
        assert_eq!(odds_of(&[], &rows[..2]), [0.0, 0.0]);
    }

    #[test]
    fn steps_are_rounded_and_cut() {
        let of = |sign| whole(sign, 3.0, 100.0);
        assert_eq!([3.0, 3.004, 3.006, 2.994, 2.0].map(of), [0, 0, 1, -1, -100]);
        assert_eq!([1e9, f32::INFINITY, -1e9, f32::MIN].map(of), [32_766, 32_766, -32_766, -32_766]);
        let rising: Vec<i16> = (0..4000).map(|i| of(i as f32 * 0.2)).collect();
        assert!(rising.is_sorted());
    }

    #[test]
    fn registers_change_nothing() {
        let columns: [[f32; LANES]; DEPTH] =
            std::array::from_fn(|sign| std::array::from_fn(|lane| ((sign * 5 + lane * 3) % 7) as f32 / 7.0));
        let forest = forest(std::slice::from_ref(&TREE));
        assert_eq!(forest.sum(&columns), forest.sum_leaves(&columns));
    }
}
