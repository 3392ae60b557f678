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

/// Trees have eight leaves, or so many times more.
const MOST_EIGHTHS: usize = 4;

/// A balanced tree, of three or five questions from the root to a leaf.
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
    use std::slice;

    use super::*;

    /// Asks the sign of this number at the root, then the next one, and so on; leaves are numbered from the left.
    const fn counting<const QUESTIONS: usize, const LEAVES: usize>() -> Tree<QUESTIONS, LEAVES> {
        let mut questions = [(0, 50); QUESTIONS];
        let mut leaves = [0; LEAVES];
        let mut k = 0;
        while k < QUESTIONS {
            questions[k].0 = (k + 1).ilog2() as u8;
            k += 1;
        }
        while k < QUESTIONS + LEAVES {
            leaves[k - QUESTIONS] = (k - QUESTIONS) as i16;
            k += 1;
        }
        Tree { questions, leaves }
    }

    static LARGE: Tree<31, 32> = counting();
    static SMALL: Tree<7, 8> = counting();

    /// Signs of 0 to 1 in hundredths.
    fn forest<const QUESTIONS: usize, const LEAVES: usize>(
        trees: &'static [Tree<QUESTIONS, LEAVES>],
    ) -> Forest<5, 8, QUESTIONS, LEAVES> {
        Forest { unit: 0.5, middles: [0.0; 5], steps: [100.0; 5], trees }
    }

    fn odds_of<const QUESTIONS: usize, const LEAVES: usize>(
        trees: &'static [Tree<QUESTIONS, LEAVES>],
        rows: &[[f32; 5]],
    ) -> Vec<f32> {
        let mut odds = vec![9.0];
        forest(trees).log_odds(rows, &mut odds);
        odds
    }

    /// Rows whose answers lead to one leaf after the other, if this is the number of questions up to one.
    fn rows_to_every_leaf(depth: usize) -> Vec<[f32; 5]> {
        let answers =
            |leaf: usize| std::array::from_fn(|k| if k < depth { (leaf >> (depth - 1 - k) & 1) as f32 } else { 0.0 });
        (0..1 << depth).map(answers).collect()
    }

    #[test]
    fn answers_lead_to_a_leaf_and_leaves_add_up() {
        let rows = rows_to_every_leaf(5);
        let expected: Vec<f32> = (0..32).map(|leaf| 0.5 * leaf as f32).collect();
        let one = slice::from_ref(&LARGE);
        assert_eq!(odds_of(one, &rows), expected);
        // Any number of rows, not only whole registers.
        assert_eq!(odds_of(one, &rows[..21]), expected[..21]);
        assert_eq!(odds_of(slice::from_ref(&SMALL), &rows_to_every_leaf(3)), expected[..8]);
        // A value at the bound is not above it, one a step farther is.
        assert_eq!(odds_of(one, &[[0.5; 5], [0.51; 5]]), [0.0, 15.5]);
        static TWO: [Tree<7, 8>; 2] = [counting(), counting()];
        assert_eq!(odds_of(&TWO, &[[1.0; 5], [0.0; 5]]), [7.0, 0.0]);
        assert_eq!(odds_of::<31, 32>(&[], &rows[..2]), [0.0, 0.0]);
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
        let columns: [[f32; LANES]; 5] =
            std::array::from_fn(|sign| std::array::from_fn(|lane| ((sign * 5 + lane * 3) % 7) as f32 / 7.0));
        let (large, small) = (forest(slice::from_ref(&LARGE)), forest(slice::from_ref(&SMALL)));
        assert_eq!(large.sum(&columns), large.sum_leaves(&columns));
        assert_eq!(small.sum(&columns), small.sum_leaves(&columns));
    }
}
