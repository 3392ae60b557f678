//! Regression trees whose leaves add up to log-odds: how what was fitted is asked.
//!
//! `samsod.evaluation.judgement` fits them, and writes them as [`judgement`](crate::judgement) and
//! [`fringe`](crate::fringe) include them. They are asked in whole numbers of 16 bits, of sixteen rows at once: every sign is
//! measured in steps of the range of the bounds that are asked of it, of which there are 64 thousand.

/// Questions from the root to a leaf.
pub(crate) const DEPTH: usize = 5;
pub(crate) const LEAVES: usize = 1 << DEPTH;

/// Rows that are asked side by side: a register of AVX2.
pub(crate) const LANES: usize = 16;
type Lanes = [i16; LANES];

/// Bounds lie between this and its negative; signs beyond are cut a little farther out.
const FARTHEST_BOUND: f32 = 32_000.0;
const FARTHEST: f32 = 32_766.0;

/// A balanced tree.
pub(crate) struct Tree {
    /// Question `k` is followed by `2 k + 1`, or by `2 k + 2` where the sign of this number is above the bound.
    pub(crate) questions: [(u8, f32); LEAVES - 1],
    /// Log-odds.
    pub(crate) leaves: [f32; LEAVES],
}

/// What was fitted.
pub(crate) struct Fitted {
    /// Log-odds before any question.
    pub(crate) start: f32,
    pub(crate) trees: &'static [Tree],
}

/// What was fitted, ready to be asked about rows of `SIGNS` signs. `ROOM` is a power of two from their number up, so that
/// no number of a sign needs a check.
pub(crate) struct Forest<const SIGNS: usize, const ROOM: usize> {
    start: f32,
    /// Log-odds that a whole leaf counts.
    unit: f32,
    /// A sign less the first, times the second, is in steps.
    middles: [f32; SIGNS],
    steps: [f32; SIGNS],
    trees: Vec<WholeTree>,
}

/// A [`Tree`] in whole numbers.
struct WholeTree {
    questions: [(u8, i16); LEAVES - 1],
    leaves: [i16; LEAVES],
}

impl<const SIGNS: usize, const ROOM: usize> Forest<SIGNS, ROOM> {
    pub(crate) fn new(fitted: &Fitted) -> Self {
        const { assert!(ROOM.is_power_of_two() && SIGNS <= ROOM) };
        let (mut least, mut most) = ([f32::INFINITY; SIGNS], [f32::NEG_INFINITY; SIGNS]);
        for &(sign, bound) in fitted.trees.iter().flat_map(|tree| &tree.questions) {
            // An infinite bound lets every sign go left.
            if let Some(least) = least.get_mut(usize::from(sign)).filter(|_| bound.is_finite()) {
                *least = least.min(bound);
                most[usize::from(sign)] = most[usize::from(sign)].max(bound);
            }
        }
        let is_asked = |sign: usize| least[sign] <= most[sign];
        let middles = std::array::from_fn(|k| if is_asked(k) { 0.5 * (least[k] + most[k]) } else { 0.0 });
        let steps = std::array::from_fn(|k| {
            // Of a single bound there is no range: its own size stands for it.
            let half = (0.5 * (most[k] - least[k])).max(1e-3 * middles[k].abs()).max(1e-6);
            if is_asked(k) { FARTHEST_BOUND / half } else { 0.0 }
        });
        let largest = fitted.trees.iter().flat_map(|tree| tree.leaves).map(f32::abs).fold(1e-9, f32::max);
        let unit = largest / FARTHEST_BOUND;
        let mut forest = Self { start: fitted.start, unit, middles, steps, trees: Vec::new() };
        let whole = |tree: &Tree| WholeTree {
            questions: tree.questions.map(|(sign, bound)| {
                let k = usize::from(sign);
                let bound = if bound.is_finite() && k < SIGNS { whole(bound, middles[k], steps[k]) } else { i16::MAX };
                (sign, bound)
            }),
            leaves: tree.leaves.map(|leaf| (leaf / unit).round() as i16),
        };
        forest.trees.extend(fitted.trees.iter().map(whole));
        forest
    }

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
        self.sum(columns).map(|sum| self.start + self.unit * sum as f32)
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
    /// leaves to the root: 31 choices instead of 5 steps, but for sixteen rows at once, and none waits for another.
    #[inline(always)]
    fn sum_leaves(&self, columns: &[[f32; LANES]; SIGNS]) -> [i32; LANES] {
        let mut signs = [[0; LANES]; ROOM];
        let scales = self.middles.iter().zip(&self.steps);
        for ((signs, column), (&middle, &step)) in signs.iter_mut().zip(columns).zip(scales) {
            signs.iter_mut().zip(column).for_each(|(to, &sign)| *to = whole(sign, middle, step));
        }
        let mut sum = [0; LANES];
        for tree in &self.trees {
            let mut sides = [[0; LANES]; LEAVES / 2];
            let (nodes, last) = tree.questions.split_at(LEAVES / 2 - 1);
            for ((kept, pair), &question) in sides.iter_mut().zip(tree.leaves.as_chunks::<2>().0).zip(last) {
                *kept = choose(&signs, question, &[pair[0]; LANES], &[pair[1]; LANES]);
            }
            for level in (0..DEPTH - 1).rev() {
                let count = 1 << level;
                for (k, &question) in nodes[count - 1..2 * count - 1].iter().enumerate() {
                    sides[k] = choose(&signs, question, &sides[2 * k], &sides[2 * k + 1]);
                }
            }
            sum.iter_mut().zip(sides[0]).for_each(|(sum, leaf)| *sum += i32::from(leaf));
        }
        sum
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

    fn odds_of<const SIGNS: usize>(trees: &'static [Tree], rows: &[[f32; SIGNS]]) -> Vec<f32> {
        let mut odds = vec![9.0];
        Forest::<SIGNS, 8>::new(&Fitted { start: 0.25, trees }).log_odds(rows, &mut odds);
        odds
    }

    fn assert_near(odds: &[f32], expected: &[f32]) {
        assert_eq!(odds.len(), expected.len());
        assert!(odds.iter().zip(expected).all(|(a, b)| (a - b).abs() < 2e-3), "{odds:?} instead of {expected:?}");
    }

    #[test]
    fn answers_lead_to_a_leaf_and_leaves_add_up() {
        let answers = |leaf: usize| std::array::from_fn(|k| (leaf >> (DEPTH - 1 - k) & 1) as f32);
        let rows: Vec<[f32; DEPTH]> = (0..LEAVES).map(answers).collect();
        let expected: Vec<f32> = (0..LEAVES).map(|leaf| 0.25 + leaf as f32).collect();
        let one = std::slice::from_ref(&TREE);
        assert_near(&odds_of(one, &rows), &expected);
        // Any number of rows, not only whole registers.
        assert_near(&odds_of(one, &rows[..21]), &expected[..21]);
        // A value at the bound is not above it.
        assert_near(&odds_of(one, &[[0.5; DEPTH]]), &[0.25]);
        assert_eq!(odds_of(&[], &rows[..2]), [0.25, 0.25]);
    }

    /// The first sign is asked whether it is above bounds that lie far apart and close together; the second never is.
    static BOUNDS: Tree = {
        let mut questions = [(1, f32::INFINITY); LEAVES - 1];
        questions[0] = (0, -3.0);
        questions[2] = (0, 4.0);
        questions[6] = (0, 4.001);
        let mut leaves = [0.0; LEAVES];
        leaves[LEAVES / 2] = 1.0;
        leaves[LEAVES / 2 + LEAVES / 4] = 2.0;
        leaves[LEAVES - LEAVES / 8] = -3.0;
        Tree { questions, leaves }
    };

    #[test]
    fn steps_tell_signs_apart_as_numbers_do() {
        let signs = [f32::MIN, -1e9, -3.1, -3.0, -2.99, 0.0, 4.0, 4.000_5, 4.001, 4.002, 1e9, f32::INFINITY];
        let expected = [0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 2.0, 2.0, -3.0, -3.0, -3.0];
        let rows = signs.map(|sign| [sign, f32::INFINITY]);
        assert_near(&odds_of(std::slice::from_ref(&BOUNDS), &rows), &expected.map(|leaf| 0.25 + leaf));
    }

    #[test]
    fn registers_change_nothing() {
        let columns: [[f32; LANES]; DEPTH] =
            std::array::from_fn(|sign| std::array::from_fn(|lane| ((sign * 5 + lane * 3) % 7) as f32 / 7.0));
        let forest = Forest::<DEPTH, 8>::new(&Fitted { start: 0.0, trees: std::slice::from_ref(&TREE) });
        assert_eq!(forest.sum(&columns), forest.sum_leaves(&columns));
    }
}
