//! The normalised cut of a graph in two (Shi and Malik), by which the paper parts objects from the rest (section 4.1).
//!
//! In: a symmetric matrix W of affinities that are not negative; its diagonal is a node's affinity with itself. Out: two
//! sets of nodes A and B, and
//!
//! ```text
//! Ncut = cut(A, B) / assoc(A) + cut(A, B) / assoc(B)       in [0, 2]
//! cut(A, B) = sum of W_ij over i in A, j in B              assoc(A) = sum of W_ij over i in A, any j
//! ```
//!
//! The order of the nodes is that of the second smallest solution of `(D - W) y = lambda D y`, found as the eigenvector
//! z = D^1/2 y of `D^-1/2 (D - W) D^-1/2`; all n - 1 places to part that order are tried, in O(n^2) altogether.

use nalgebra::{DMatrix, DVector, SymmetricEigen};

/// A graph that cannot be cut.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum NcutError {
    /// The matrix is not square.
    #[error("affinities of {rows} x {columns}; the matrix must be square")]
    NotSquare {
        /// Number of rows.
        rows: usize,
        /// Number of columns.
        columns: usize,
    },
    /// An affinity is NaN, infinite or negative.
    #[error("affinity {value} of the nodes {row} and {column}; it must be finite and not negative")]
    Value {
        /// Row.
        row: usize,
        /// Column.
        column: usize,
        /// The affinity.
        value: f64,
    },
    /// The matrix is not symmetric.
    #[error("affinities {there} of the nodes {row} and {column}, and {back} the other way; they must be the same")]
    NotSymmetric {
        /// Row.
        row: usize,
        /// Column.
        column: usize,
        /// The affinity from row to column.
        there: f64,
        /// The affinity from column to row.
        back: f64,
    },
    /// The eigenvectors were not found within the allowed number of steps.
    #[error("no eigenvectors of {nodes} nodes after {steps} steps")]
    NoConvergence {
        /// Number of nodes.
        nodes: usize,
        /// Number of steps.
        steps: usize,
    },
}

/// A graph in two sets, none of them empty.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Cut {
    /// Whether a node is in set B; node 0 never is.
    pub(crate) in_b: Vec<bool>,
    /// The value of the cut, in [0, 2]: 0 between sets without any affinity, 1 where no cut is better than any other.
    pub(crate) ncut: f64,
}

/// Cuts that are better by less are as good as each other.
const TIE: f64 = 1e-12;

/// Cuts a graph; `None` for fewer than two nodes. Nodes without any affinity, even with themselves, become one set; of
/// several such nodes and no other, the first becomes the one set and the rest the other.
///
/// # Errors
/// [`NcutError`].
pub(crate) fn normalized_cut(affinities: &DMatrix<f64>) -> Result<Option<Cut>, NcutError> {
    check(affinities)?;
    let n = affinities.nrows();
    if n < 2 {
        return Ok(None);
    }
    let degrees: Vec<f64> = affinities.row_iter().map(|row| row.sum()).collect();
    let is_alone = |i: usize| degrees[i] <= 0.0;
    if (0..n).any(is_alone) {
        // The cut costs nothing, and there is no equation to solve: D has no inverse.
        let all = (0..n).all(is_alone);
        let in_b = (0..n).map(|i| if all { i > 0 } else { is_alone(i) != is_alone(0) }).collect();
        return Ok(Some(Cut { in_b, ncut: 0.0 }));
    }
    let order = second_order(affinities, &degrees)?;
    Ok(Some(sweep(affinities, &degrees, &order)))
}

fn check(affinities: &DMatrix<f64>) -> Result<(), NcutError> {
    let (rows, columns) = affinities.shape();
    if rows != columns {
        return Err(NcutError::NotSquare { rows, columns });
    }
    for row in 0..rows {
        for column in 0..=row {
            let (there, back) = (affinities[(row, column)], affinities[(column, row)]);
            for (row, column, value) in [(row, column, there), (column, row, back)] {
                // NaN is in no range. An eigen-solver would take it for a number.
                if !(0.0..=f64::MAX).contains(&value) {
                    return Err(NcutError::Value { row, column, value });
                }
            }
            if (there - back).abs() > 1e-9 * there.max(back) {
                return Err(NcutError::NotSymmetric { row, column, there, back });
            }
        }
    }
    Ok(())
}

/// The nodes by their entries in the second smallest solution of `(D - W) y = lambda D y`.
fn second_order(affinities: &DMatrix<f64>, degrees: &[f64]) -> Result<Vec<usize>, NcutError> {
    const STEPS: usize = 10_000;
    /// Eigenvalues lie in [0, 2]; this takes the trivial one beyond them.
    const SHIFT: f64 = 3.0;
    let n = degrees.len();
    let roots: Vec<f64> = degrees.iter().map(|d| d.sqrt()).collect();
    let total: f64 = degrees.iter().sum();
    // The smallest solution is known: y is constant, its value 0. Taken out, the smallest that is left is the wanted one; a
    // solver that is left to choose within the space of the value 0 of a graph in several pieces could return it twice
    // mixed.
    let matrix = DMatrix::from_fn(n, n, |i, j| {
        let diagonal = if i == j { 1.0 } else { 0.0 };
        diagonal - affinities[(i, j)] / (roots[i] * roots[j]) + SHIFT * roots[i] * roots[j] / total
    });
    let eigen = SymmetricEigen::try_new(matrix, f64::EPSILON, STEPS)
        .ok_or(NcutError::NoConvergence { nodes: n, steps: STEPS })?;
    // The solver does not sort.
    let smallest = (0..n).min_by(|&a, &b| eigen.eigenvalues[a].total_cmp(&eigen.eigenvalues[b])).unwrap_or(0);
    let y: DVector<f64> = DVector::from_fn(n, |i, _| eigen.eigenvectors[(i, smallest)] / roots[i]);
    let mut order: Vec<usize> = (0..n).collect();
    order.sort_by(|&a, &b| y[a].total_cmp(&y[b]));
    Ok(order)
}

/// The best of all places to part an order of the nodes; the first of equals.
fn sweep(affinities: &DMatrix<f64>, degrees: &[f64], order: &[usize]) -> Cut {
    let n = order.len();
    let total: f64 = degrees.iter().sum();
    let mut in_a = vec![false; n];
    let (mut cut, mut assoc) = (0f64, 0f64);
    let mut best = (f64::INFINITY, 1);
    for (i, &node) in order[..n - 1].iter().enumerate() {
        let to_a: f64 = (0..n).filter(|&other| in_a[other]).map(|other| affinities[(node, other)]).sum();
        let to_b = degrees[node] - to_a - affinities[(node, node)];
        in_a[node] = true;
        cut += to_b - to_a;
        assoc += degrees[node];
        // Sums leave rounding behind where nothing is cut.
        let cost = cut.max(0.0) / assoc + cut.max(0.0) / (total - assoc);
        if cost < best.0 - TIE {
            best = (cost, i + 1);
        }
    }
    let mut in_b = vec![true; n];
    for &node in &order[..best.1] {
        in_b[node] = false;
    }
    if in_b[0] {
        for side in &mut in_b {
            *side = !*side;
        }
    }
    Cut { in_b, ncut: best.0 }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn graph(n: usize, values: &[f64]) -> DMatrix<f64> {
        DMatrix::from_row_slice(n, n, values)
    }

    fn cut(n: usize, values: &[f64]) -> Cut {
        normalized_cut(&graph(n, values)).unwrap().unwrap()
    }

    /// Ncut of given sets, by its definition.
    fn value_of(w: &DMatrix<f64>, in_b: &[bool]) -> f64 {
        let n = in_b.len();
        let pairs = || (0..n).flat_map(|i| (0..n).map(move |j| (i, j)));
        let sum = |f: &dyn Fn(usize, usize) -> bool| -> f64 {
            pairs().filter(|&(i, j)| f(i, j)).map(|(i, j)| w[(i, j)]).sum()
        };
        let between = sum(&|i, j| !in_b[i] && in_b[j]);
        between / sum(&|i, _| !in_b[i]) + between / sum(&|i, _| in_b[i])
    }

    #[test]
    fn two_nodes_are_parted() {
        let found = cut(2, &[1.0, 0.25, 0.25, 1.0]);
        assert_eq!(found.in_b, [false, true]);
        // 0.25 / 1.25 on both sides.
        assert!((found.ncut - 0.4).abs() < 1e-12);
        let loops_left_out = cut(2, &[0.0, 0.25, 0.25, 0.0]);
        assert_eq!((loops_left_out.in_b, loops_left_out.ncut), (vec![false, true], 2.0));
    }

    #[test]
    fn fewer_than_two_nodes_cannot_be_cut() {
        assert_eq!(normalized_cut(&DMatrix::zeros(0, 0)), Ok(None));
        assert_eq!(normalized_cut(&graph(1, &[1.0])), Ok(None));
    }

    #[test]
    fn a_chain_by_hand() {
        // 0 - 1 = 2 = 3, with weights 1, 10, 10 and no loops: the weak link lies beside an end, where the cut costs
        // 1/1 + 1/41 = 1.024; in the middle, 10/12 + 10/30 = 1.167; at the other end, 10/10 + 10/32 = 1.3125.
        let found = cut(4, &[0., 1., 0., 0., 1., 0., 10., 0., 0., 10., 0., 10., 0., 0., 10., 0.]);
        assert_eq!(found.in_b, [false, true, true, true]);
        assert!((found.ncut - (1.0 + 1.0 / 41.0)).abs() < 1e-12);
    }

    #[test]
    fn two_clusters_are_found_whatever_the_order() {
        let member = [false, true, true, false, true, false, false];
        let w = DMatrix::from_fn(7, 7, |i, j| match (i == j, member[i] == member[j]) {
            (true, _) => 1.0,
            (_, true) => 0.8,
            _ => 0.05,
        });
        let found = normalized_cut(&w).unwrap().unwrap();
        assert_eq!(found.in_b, member);
        // Between: 12 * 0.05. A: 4 * (1 + 3 * 0.8 + 3 * 0.05), B: 3 * (1 + 2 * 0.8 + 4 * 0.05).
        assert!((found.ncut - (0.6 / 14.2 + 0.6 / 8.4)).abs() < 1e-12);
    }

    #[test]
    fn ties_are_decided_always_alike() {
        // Three equal clusters: any one of them is a best cut.
        let w = DMatrix::from_fn(6, 6, |i, j| match (i == j, i % 3 == j % 3) {
            (true, _) => 1.0,
            (_, true) => 0.9,
            _ => 0.1,
        });
        let first = normalized_cut(&w).unwrap().unwrap();
        for _ in 0..3 {
            assert_eq!(normalized_cut(&w).unwrap().unwrap(), first);
        }
        // Between: 8 * 0.1; one cluster 2 * 2.3, two 4 * 2.3.
        assert!((first.ncut - (0.8 / 4.6 + 0.8 / 9.2)).abs() < 1e-9);
        for i in 0..3 {
            assert_eq!(first.in_b[i], first.in_b[i + 3], "clusters stay whole");
        }
    }

    #[test]
    fn in_a_graph_of_equals_no_cut_is_better() {
        for n in [2, 3, 8, 48] {
            let found = normalized_cut(&DMatrix::from_element(n, n, 0.7)).unwrap().unwrap();
            assert!((found.ncut - 1.0).abs() < 1e-9, "{n} nodes: {}", found.ncut);
            assert!(found.in_b.contains(&true) && found.in_b.contains(&false));
        }
    }

    #[test]
    fn pieces_of_a_graph_are_not_broken() {
        // Three pieces of 2, 3 and 1 nodes, so the value 0 has three solutions.
        let piece = [0, 1, 0, 1, 2, 1];
        let w = DMatrix::from_fn(6, 6, |i, j| if piece[i] == piece[j] { 0.6 } else { 0.0 });
        let found = normalized_cut(&w).unwrap().unwrap();
        assert!(found.ncut < 1e-12, "{}", found.ncut);
        for i in 0..6 {
            for j in 0..6 {
                assert!(piece[i] != piece[j] || found.in_b[i] == found.in_b[j], "{:?}", found.in_b);
            }
        }
    }

    #[test]
    fn nodes_without_affinity_stand_apart() {
        let found = cut(3, &[0.0, 0.0, 0.0, 0.0, 1.0, 0.5, 0.0, 0.5, 1.0]);
        assert_eq!((found.in_b, found.ncut), (vec![false, true, true], 0.0));
        let found = cut(3, &[1.0, 0.5, 0.0, 0.5, 1.0, 0.0, 0.0, 0.0, 0.0]);
        assert_eq!((found.in_b, found.ncut), (vec![false, false, true], 0.0));
        let found = cut(3, &[0.0; 9]);
        assert_eq!((found.in_b, found.ncut), (vec![false, true, true], 0.0));
    }

    #[test]
    fn what_is_no_graph_is_refused() {
        let message = |w: DMatrix<f64>| normalized_cut(&w).unwrap_err().to_string();
        assert_eq!(message(DMatrix::zeros(2, 3)), "affinities of 2 x 3; the matrix must be square");
        assert_eq!(
            message(graph(2, &[1.0, f64::NAN, f64::NAN, 1.0])),
            "affinity NaN of the nodes 1 and 0; it must be finite and not negative"
        );
        assert!(message(graph(2, &[1.0, 0.5, f64::INFINITY, 1.0])).starts_with("affinity inf of the nodes 1 and 0"));
        assert!(message(graph(1, &[-0.5])).starts_with("affinity -0.5 of the nodes 0 and 0"));
        assert!(message(graph(2, &[1.0, 0.5, 0.25, 1.0])).starts_with("affinities 0.25 of the nodes 1 and 0, and 0.5"));
    }

    #[test]
    fn weights_of_any_size_are_cut_alike() {
        let w = graph(3, &[1.0, 0.9, 0.1, 0.9, 1.0, 0.2, 0.1, 0.2, 1.0]);
        let expected = normalized_cut(&w).unwrap().unwrap();
        assert_eq!(expected.in_b, [false, false, true]);
        for scale in [1e-12, 1e9] {
            let found = normalized_cut(&(&w * scale)).unwrap().unwrap();
            assert_eq!(found.in_b, expected.in_b);
            assert!((found.ncut - expected.ncut).abs() < 1e-9);
        }
    }

    proptest! {
        /// The value is that of the sets, within the bounds, and no worse than that of any single node.
        #[test]
        fn cuts_are_what_they_say(n in 2usize..9, seed in prop::collection::vec(0.0f64..1.0, 81)) {
            let w = DMatrix::from_fn(n, n, |i, j| if i == j { 1.0 } else { seed[i.min(j) * 9 + i.max(j)] });
            let found = normalized_cut(&w).unwrap().unwrap();
            prop_assert!(!found.in_b[0] && found.in_b.contains(&true));
            prop_assert!((found.ncut - value_of(&w, &found.in_b)).abs() < 1e-9);
            prop_assert!((0.0..=2.0).contains(&found.ncut));
        }
    }
}
