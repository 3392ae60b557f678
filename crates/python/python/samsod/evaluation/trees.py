"""Boosted regression trees of one depth, for log-odds: LightGBM fits them, and they are written down as balanced trees.

A balanced tree asks as many questions of every row as it is deep, whatever the answers were, so that it is evaluated
without branches (crates/shadow/src/forest.rs). Deterministic for a seed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from samsod.evaluation.data import DataError

# Every tree sees a share of the rows, and every question a share of the signs that are drawn for its tree.
SHARES = {"bagging_fraction": 0.6, "bagging_freq": 1, "feature_fraction": 0.4, "feature_fraction_bynode": 0.4}
BINS = 63
# Weight of the leaf's odds of zero, and the least curvature in a leaf, rows of mean weight.
SHRINK, LEAST_CURVATURE = 5.0, 100.0

Floats = npt.NDArray[np.float32]
Whole = npt.NDArray[np.int64]


# Signs are measured in steps, of which those of all but a thousandth of the rows take so many either way; a leaf is at
# most as many units of log-odds. Signs are cut a little farther out.
FARTHEST_STEP = 32_000
FARTHEST = 32_766
NO_BOUND = 32_767


@dataclass(frozen=True)
class Forest:
    """Trees whose leaves add up to log-odds, in whole numbers.

    Attributes:
        unit: log-odds that 1 of a leaf counts.
        middles: float32 (columns,); a value less this,
        steps: float32 (columns,), times this is in steps.
        columns: int64 (trees, 2**depth - 1), what each question asks; question k is followed by 2 k + 1 and 2 k + 2.
        bounds: int64 like `columns`; a value of more steps goes to 2 k + 2.
        leaves: int64 (trees, 2**depth), units of log-odds.
    """

    unit: float
    middles: Floats
    steps: Floats
    columns: Whole
    bounds: Whole
    leaves: Whole

    def probabilities(self, rows: Floats) -> Floats:
        """One value in [0, 1] for every row (n, columns)."""
        whole = in_steps(rows, self.middles, self.steps)
        units = np.zeros(len(rows), np.int64)
        index = np.arange(len(rows))
        for columns, bounds, leaves in zip(self.columns, self.bounds, self.leaves, strict=True):
            node = np.zeros(len(rows), np.int64)
            for _ in range(len(leaves).bit_length() - 1):
                node = 2 * node + 1 + (whole[index, columns[node]] > bounds[node])
            units += leaves[node - len(columns)]
        odds = self.unit * units
        probabilities: Floats = (1.0 / (1.0 + np.exp(-np.clip(odds, -30.0, 30.0)))).astype(np.float32)
        return probabilities


def in_steps(rows: Floats, middles: Floats, steps: Floats) -> Floats:
    """Rows in whole steps, as crates/shadow/src/forest.rs counts them."""
    whole: Floats = np.rint(np.clip((rows - middles) * steps, -FARTHEST, FARTHEST)).astype(np.float32)
    return whole


def fit(rows: Floats, labels: Floats, weights: Floats, trees: int, depth: int, rate: float, seed: int = 1) -> Forest:
    """Fits trees.

    Args:
        rows: float32 (n, columns).
        labels: (n,) in [0, 1].
        weights: (n,), not negative.
        trees: their number.
        depth: questions from the root of each to a leaf.
        rate: share of its step that every tree goes.
        seed: of the shares of rows and columns.

    Raises:
        DataError: LightGBM is not there.
    """
    try:
        # Only who fits needs it.
        import lightgbm
    except (ImportError, OSError) as error:
        raise DataError(f"{error}; fitting needs LightGBM and libgomp: pip install 'samsod[fit]'") from error
    low, high = np.quantile(rows, [0.0005, 0.9995], axis=0).astype(np.float32)
    middles = ((low + high) / 2).astype(np.float32)
    steps = (FARTHEST_STEP / np.maximum((high - low) / 2, 1e-6)).astype(np.float32)
    parameters = {
        "objective": "cross_entropy",
        "max_depth": depth,
        "num_leaves": 2**depth,
        "learning_rate": rate,
        "max_bin": BINS,
        "lambda_l2": SHRINK,
        "min_sum_hessian_in_leaf": min(LEAST_CURVATURE, len(rows) / 100),
        "seed": seed,
        "deterministic": True,
        "force_row_wise": True,
        "verbose": -1,
        **SHARES,
    }
    # The mean weight is 1, so that a weight is a number of rows.
    data = lightgbm.Dataset(
        in_steps(rows, middles, steps), labels, weight=weights / weights.mean(), params={"max_bin": BINS, "verbose": -1}
    )
    fitted = [each["tree_structure"] for each in lightgbm.train(parameters, data, trees).dump_model()["tree_info"]]
    columns = np.zeros((len(fitted), 2**depth - 1), np.int64)
    bounds = np.full(columns.shape, NO_BOUND, np.int64)
    leaves = np.zeros((len(fitted), 2**depth))
    for tree, root in enumerate(fitted):
        balance(root, 0, columns[tree], bounds[tree], leaves[tree])
    unit = float(max(np.abs(leaves).max(), 1e-9) / FARTHEST_STEP)
    return Forest(unit, middles, steps, columns, bounds, np.rint(leaves / unit).astype(np.int64))


def balance(node: dict[str, Any], k: int, columns: Whole, bounds: Whole, leaves: npt.NDArray[np.float64]) -> None:
    """Writes a node, and what is below it, at place `k` of a tree; below a leaf all go left."""
    if k >= len(columns):
        leaves[k - len(columns)] = node["leaf_value"]
    elif "split_feature" not in node:
        balance(node, 2 * k + 1, columns, bounds, leaves)
    else:
        # Values are whole numbers: more than a bound is more than what is left of it without its fraction.
        columns[k], bounds[k] = node["split_feature"], int(np.floor(node["threshold"]))
        balance(node["left_child"], 2 * k + 1, columns, bounds, leaves)
        balance(node["right_child"], 2 * k + 2, columns, bounds, leaves)
