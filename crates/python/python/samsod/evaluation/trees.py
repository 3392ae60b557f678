"""Gradient-boosted regression trees of one depth, for log-odds.

A tree asks `DEPTH` questions of every row, whatever the answers were, so that it is evaluated without branches
(crates/shadow/src/forest.rs). Fitting: logistic loss of soft labels, second-order steps, columns in bins of like
counts, a share of rows and of columns for every tree. Deterministic for a seed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

DEPTH = 5
LEAVES = 2**DEPTH
BINS = 64
RATE = 0.15
# Weight of the leaf's odds of zero, and least share of the curvature in either branch.
SHRINK = 5.0
LEAST_SHARE = 0.002
ROWS_SHARE = 0.6
COLUMNS_SHARE = 0.4

Floats = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Forest:
    """Trees whose leaves add up to log-odds.

    Attributes:
        start: log-odds before any question.
        columns: int64 (trees, LEAVES - 1), what each question asks; question k is followed by 2 k + 1 and 2 k + 2.
        bounds: float32 like `columns`; a value above goes to 2 k + 2.
        leaves: float32 (trees, LEAVES), log-odds.
    """

    start: float
    columns: npt.NDArray[np.int64]
    bounds: Floats
    leaves: Floats

    def probabilities(self, rows: Floats) -> Floats:
        """One value in [0, 1] for every row (n, columns)."""
        odds = np.full(len(rows), self.start)
        index = np.arange(len(rows))
        for columns, bounds, leaves in zip(self.columns, self.bounds, self.leaves, strict=True):
            node = np.zeros(len(rows), np.int64)
            for _ in range(DEPTH):
                node = 2 * node + 1 + (rows[index, columns[node]] > bounds[node])
            odds += leaves[node - (LEAVES - 1)]
        probabilities: Floats = (1.0 / (1.0 + np.exp(-np.clip(odds, -30.0, 30.0)))).astype(np.float32)
        return probabilities


def fit(rows: Floats, labels: Floats, weights: Floats, trees: int, rate: float = RATE, seed: int = 1) -> Forest:
    """Fits trees.

    Args:
        rows: float32 (n, columns).
        labels: (n,) in [0, 1].
        weights: (n,), not negative.
        trees: their number.
        rate: share of its step that every tree goes.
        seed: of the shares of rows and columns.
    """
    count, width = rows.shape
    weight = weights.astype(np.float64) / weights.mean()
    random = np.random.RandomState(seed)
    # Some thousand rows tell where the bounds of the bins lie.
    sample = rows[:: max(1, count // 50_000)]
    shares = np.linspace(0.0, 1.0, BINS + 1)[1:-1]
    edges = [np.unique(np.quantile(sample[:, j], shares, method="nearest")) for j in range(width)]
    # A value in bin b is at most edges[b].
    bins = np.stack([np.searchsorted(edges[j], rows[:, j]).astype(np.uint8) for j in range(width)])
    part = float((weight * labels).sum() / weight.sum())
    start = float(np.log(part / (1.0 - part)))
    odds = np.full(count, start)
    all_rows = np.arange(count)
    columns = np.zeros((trees, LEAVES - 1), np.int64)
    bounds = np.full((trees, LEAVES - 1), np.inf, np.float32)
    leaves = np.zeros((trees, LEAVES), np.float32)
    for tree in range(trees):
        probability = 1.0 / (1.0 + np.exp(-odds))
        chosen = np.nonzero(random.rand(count) < ROWS_SHARE)[0]
        asked = np.sort(random.choice(width, max(1, int(COLUMNS_SHARE * width)), replace=False))
        slope = (weight * (probability - labels))[chosen]
        curvature = (weight * probability * (1.0 - probability))[chosen]
        least = LEAST_SHARE * curvature.sum()
        node, leaf = np.zeros(len(chosen), np.int64), np.zeros(count, np.int64)
        for level in range(DEPTH):
            nodes = 2**level
            best_gain, best = np.full(nodes, 1e-9), np.full(nodes, -1)
            cut = np.full(nodes, BINS)
            for j in asked:
                key = node * BINS + bins[j, chosen]
                left = np.bincount(key, slope, nodes * BINS).reshape(nodes, BINS).cumsum(1)
                under = np.bincount(key, curvature, nodes * BINS).reshape(nodes, BINS).cumsum(1)
                right, over = left[:, -1:] - left, under[:, -1:] - under
                gain = left**2 / (under + SHRINK) + right**2 / (over + SHRINK)
                gain -= left[:, -1:] ** 2 / (under[:, -1:] + SHRINK)
                gain[(under <= least) | (over <= least)] = -1.0
                gain[:, len(edges[j]) :] = -1.0
                at = gain.argmax(1)
                value = gain[np.arange(nodes), at]
                better = value > best_gain
                best_gain[better], best[better], cut[better] = value[better], j, at[better]
            for k in np.nonzero(best >= 0)[0]:
                columns[tree, nodes - 1 + k] = best[k]
                bounds[tree, nodes - 1 + k] = edges[best[k]][cut[k]]
            # Without a question all go left.
            asks = np.maximum(best, 0)
            node = 2 * node + (bins[asks[node], chosen] > cut[node])
            leaf = 2 * leaf + (bins[asks[leaf], all_rows] > cut[leaf])
        sums = np.bincount(node, slope, LEAVES), np.bincount(node, curvature, LEAVES)
        leaves[tree] = -rate * sums[0] / (sums[1] + SHRINK)
        odds += leaves[tree][leaf]
    return Forest(start, columns, bounds, leaves)
