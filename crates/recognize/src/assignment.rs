//! The one-to-one assignment of least total cost.
//!
//! In: costs of n rows and n columns. Out: the column of every row. Shortest augmenting paths after a reduction of the
//! columns (R. Jonker and A. Volgenant, 1987). At most n^3 steps; of similar shapes, whose points nearly agree already, it
//! takes a few n^2.

/// No row or column.
const NONE: u32 = u32::MAX;

/// For every row of a square of `n` x `n` costs, row by row, its column; `None` when there are not as many costs, or one is
/// not finite.
pub(crate) fn assign(costs: &[f32], n: usize) -> Option<Vec<usize>> {
    if n == 0 || n >= NONE as usize || n.checked_mul(n) != Some(costs.len()) || !costs.iter().all(|c| c.is_finite()) {
        return None;
    }
    #[cfg(target_arch = "x86_64")]
    if std::arch::is_x86_feature_detected!("avx2") {
        // SAFETY: the processor was just found to have AVX2, the only feature the function asks for.
        return unsafe { assign_avx2(costs, n) };
    }
    assign_portable(costs, n)
}

/// [`assign_portable`] in registers of eight; the same operations in the same order.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn assign_avx2(costs: &[f32], n: usize) -> Option<Vec<usize>> {
    assign_portable(costs, n)
}

#[inline(always)]
fn assign_portable(costs: &[f32], n: usize) -> Option<Vec<usize>> {
    let row = |i: usize| &costs[i * n..(i + 1) * n];
    // Prices of the columns: the least of each, which the row that has it takes when it has none yet.
    let (mut prices, mut cheapest) = (row(0).to_vec(), vec![0u32; n]);
    for i in 1..n {
        for ((price, cheapest), &cost) in prices.iter_mut().zip(&mut cheapest).zip(row(i)) {
            (*price, *cheapest) = if cost < *price { (cost, i as u32) } else { (*price, *cheapest) };
        }
    }
    let (mut row_of, mut column_of) = (vec![NONE; n], vec![NONE; n]);
    for j in (0..n).rev() {
        let i = cheapest[j] as usize;
        if column_of[i] == NONE {
            (column_of[i], row_of[j]) = (j as u32, i as u32);
        }
    }
    // Lengths of the shortest paths to the columns, infinite for those that are done; from which row they come; and the
    // lengths that those that are done had.
    let (mut open, mut from, mut lengths) = (vec![0.0f32; n], vec![0u32; n], vec![0.0f32; n]);
    let mut is_done = vec![0.0f32; n];
    let mut done: Vec<usize> = Vec::with_capacity(n);
    for start in 0..n {
        if column_of[start] != NONE {
            continue;
        }
        open.fill(f32::INFINITY);
        is_done.fill(0.0);
        done.clear();
        // `base`: what a step from the row has to be longer by than its cost less the price.
        let (mut i, mut base) = (start, 0.0f32);
        let (end, shortest) = loop {
            relax(row(i), &prices, &is_done, base, i as u32, &mut open, &mut from);
            let (j, least) = least_of(&open)?;
            if row_of[j] == NONE {
                break (j, least);
            }
            (lengths[j], open[j], is_done[j]) = (least, f32::INFINITY, f32::INFINITY);
            done.push(j);
            i = row_of[j] as usize;
            base = least - (row(i)[j] - prices[j]);
        };
        for &j in &done {
            prices[j] += lengths[j] - shortest;
        }
        // Back along the path every row takes the column that it came from.
        let mut j = end;
        loop {
            let i = from[j];
            row_of[j] = i;
            let next = std::mem::replace(&mut column_of[i as usize], j as u32);
            if i as usize == start || next == NONE {
                break;
            }
            j = next as usize;
        }
    }
    Some(column_of.into_iter().map(|j| j as usize).collect())
}

/// Shortens the paths to the columns by way of a row; those to columns that are done stay infinite.
#[inline(always)]
fn relax(costs: &[f32], prices: &[f32], is_done: &[f32], base: f32, row: u32, open: &mut [f32], from: &mut [u32]) {
    let n = costs.len();
    let (prices, is_done, open, from) = (&prices[..n], &is_done[..n], &mut open[..n], &mut from[..n]);
    for j in 0..n {
        let length = base + costs[j] - prices[j] + is_done[j];
        let is_shorter = length < open[j];
        open[j] = if is_shorter { length } else { open[j] };
        from[j] = if is_shorter { row } else { from[j] };
    }
}

/// The first of the least numbers; `None` when all are infinite.
#[inline(always)]
fn least_of(numbers: &[f32]) -> Option<(usize, f32)> {
    // Eight at a time.
    let (chunks, rest) = numbers.as_chunks::<8>();
    let mut least = [f32::INFINITY; 8];
    for chunk in chunks {
        for lane in 0..8 {
            least[lane] = if chunk[lane] < least[lane] { chunk[lane] } else { least[lane] };
        }
    }
    let least = least.iter().chain(rest).copied().fold(f32::INFINITY, f32::min);
    let at = numbers.iter().position(|number| *number == least)?;
    (least < f32::INFINITY).then_some((at, least))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn total(costs: &[f32], n: usize, columns: &[usize]) -> f64 {
        columns.iter().enumerate().map(|(i, &j)| f64::from(costs[i * n + j])).sum()
    }

    /// The least total over all permutations.
    fn least(costs: &[f32], n: usize, row: usize, taken: &mut Vec<bool>) -> f64 {
        if row == n {
            return 0.0;
        }
        let mut best = f64::INFINITY;
        for j in 0..n {
            if !std::mem::replace(&mut taken[j], true) {
                best = best.min(f64::from(costs[row * n + j]) + least(costs, n, row + 1, taken));
                taken[j] = false;
            }
        }
        best
    }

    proptest! {
        #[test]
        fn no_permutation_costs_less(n in 1usize..7, values in prop::collection::vec(0.0f32..1.0, 36)) {
            let costs = &values[..n * n];
            let columns = assign(costs, n).unwrap();
            let mut sorted = columns.clone();
            sorted.sort_unstable();
            prop_assert_eq!(sorted, (0..n).collect::<Vec<_>>());
            let expected = least(costs, n, 0, &mut vec![false; n]);
            prop_assert!((total(costs, n, &columns) - expected).abs() < 1e-5);
        }

        #[test]
        fn large_ones_of_few_values_end_and_cost_no_more_than_others_do(
            values in prop::collection::vec(0u8..4, 64 * 64),
            swaps in prop::collection::vec((0usize..64, 0usize..64), 200),
        ) {
            let costs: Vec<f32> = values.iter().map(|v| f32::from(*v) / 3.0).collect();
            let columns = assign(&costs, 64).unwrap();
            let least = total(&costs, 64, &columns);
            for (a, b) in swaps {
                let mut other = columns.clone();
                other.swap(a, b);
                prop_assert!(total(&costs, 64, &other) >= least - 1e-4);
            }
        }
    }

    #[test]
    fn points_of_one_shape_are_assigned_to_themselves() {
        let n = 64;
        // Each point is like its neighbours.
        let costs: Vec<f32> = (0..n * n).map(|k| ((k / n) as f32 - (k % n) as f32).abs() / 64.0).collect();
        assert_eq!(assign(&costs, n), Some((0..n).collect()));
        let turned: Vec<f32> = (0..n * n).map(|k| costs[k / n * n + (k % n + 5) % n]).collect();
        assert_eq!(assign(&turned, n), Some((0..n).map(|i| (i + n - 5) % n).collect()));
    }

    #[test]
    fn what_is_no_square_of_numbers_has_none() {
        assert_eq!(assign(&[], 0), None);
        assert_eq!(assign(&[1.0; 5], 2), None);
        assert_eq!(assign(&[1.0, f32::NAN, 0.0, 2.0], 2), None);
        assert_eq!(assign(&[0.3], 1), Some(vec![0]));
    }
}
