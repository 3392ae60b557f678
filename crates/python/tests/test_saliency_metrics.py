"""Measures of saliency: examples worked out by hand, scikit-learn's AUC, and the shuffled ones written slowly."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import pytest
from sklearn.metrics import roc_auc_score

from samsod.evaluation.saliency.averages import Averages
from samsod.evaluation.saliency.metrics import (
    Counts,
    Sweep,
    adaptive_threshold,
    f_measure,
    levels,
    mean_absolute_error,
    shuffled_auc,
)
from samsod.evaluation.saliency.scoring import Result, Score, _score

Levels = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]

# Mean 60, so twice the mean is 120: the two pixels of 200 and 255 are salient, one of them rightly.
MAP = np.array([[0, 0, 255, 0], [200, 0, 25, 0]], dtype=np.uint8)
TRUTH = np.array([[0, 0, 1, 1], [0, 0, 1, 0]], dtype=bool)


def score(saliency: Levels, truth: Mask, negative: Mask) -> Score:
    return _score("a", "m", saliency, truth, negative, None)


def test_levels_stretch_any_range() -> None:
    assert levels(np.array([[-1.0, 0.0], [1.0, 3.0]])).tolist() == [[0, 64], [128, 255]]
    assert levels(np.full((2, 2), 7.5)).tolist() == [[0, 0], [0, 0]]
    assert levels(np.array([[10, 20]], dtype=np.uint8)).tolist() == [[0, 255]]


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_maps_that_are_not_finite_are_refused(value: float) -> None:
    with pytest.raises(ValueError, match="not finite"):
        levels(np.array([[0.0, value]]))
    with pytest.raises(ValueError, match="no pixels"):
        levels(np.zeros((0, 4)))


def test_adaptive_threshold_is_twice_the_mean_within_the_map() -> None:
    assert adaptive_threshold(MAP) == 120
    # Twice 255 is above everything: then the largest value is taken, or nothing would ever be salient.
    assert adaptive_threshold(np.full((2, 2), 255, dtype=np.uint8)) == 255
    # On a map of zeros nothing is salient, rather than everything.
    assert adaptive_threshold(np.zeros((2, 2), dtype=np.uint8)) == 1


def test_f_measure_by_hand() -> None:
    s = score(MAP, TRUTH, ~TRUTH)
    # One of two found is true, one of three true ones is found.
    assert s.precision == 0.5
    assert s.recall == pytest.approx(1 / 3)
    assert s.f == pytest.approx(2 * (1 / 2) * (1 / 3) / (1 / 2 + 1 / 3)) == pytest.approx(0.4)
    assert f_measure(0.0, 0.0) == 0.0


def test_mean_absolute_error_by_hand() -> None:
    # |1 - 1| + |0 - 1| + |200/255 - 0| + |25/255 - 1| over 8 pixels.
    assert mean_absolute_error(MAP, TRUTH) == pytest.approx((1 + 200 / 255 + 230 / 255) / 8)


def test_best_threshold_by_hand() -> None:
    # From 1 on: 2 of 3 salient are true and 2 of 3 true are found, F 2/3; from 0 on 3 of 8 and 3 of 3, F 6/11.
    s = score(MAP, TRUTH, ~TRUTH)
    assert s.best_f == pytest.approx(2 / 3)
    assert 1 <= s.best_threshold <= 25
    assert s.sweep.f[0] == pytest.approx(6 / 11)
    assert s.sweep.f[255] == pytest.approx(0.5)


def test_shuffled_by_hand() -> None:
    # The negative reference shares one true pixel, the brightest: it counts as true and as false.
    negative = np.array([[0, 0, 1, 0], [1, 1, 0, 0]], dtype=bool)
    s = score(MAP, TRUTH, negative)
    # At 120: TP 1 of 3; TPn 2 of 3. Precision 1 / (1 + 2), recall 1 / 3.
    assert s.shuffled_f == pytest.approx(1 / 3)
    # True pixels 255, 25, 0; negative ones 255, 200, 0. Of nine pairs the true one is larger in 2 and level in 2:
    # 255 is level with 255 and above 200 and 0 (2.5); 25 is above 0 (1); 0 is level with 0 (0.5).
    assert s.shuffled_auc == pytest.approx(4.0 / 9)


def test_without_a_negative_reference_nothing_is_shuffled() -> None:
    s = score(MAP, TRUTH, np.zeros_like(TRUTH))
    assert s.shuffled_f is None
    assert s.shuffled_auc is None
    averages = Averages.of([s])
    assert averages is not None
    assert averages.shuffled_f is None
    assert averages.f == pytest.approx(0.4)


def slow_shuffled(saliency: Levels, positive: Mask, negative: Mask) -> tuple[float, float]:
    """Eqs 18 and 19 as they stand: a binary map for every threshold, pixels counted one by one."""
    points = []
    for threshold in [256, *range(255, -1, -1)]:
        tp = p = tp_n = p_n = 0
        for value, in_positive, in_negative in zip(
            saliency.ravel().tolist(), positive.ravel().tolist(), negative.ravel().tolist(), strict=True
        ):
            salient = value >= threshold
            p += in_positive
            p_n += in_negative
            tp += in_positive and salient
            tp_n += in_negative and salient
        points.append((tp_n / p_n, tp / p))
    auc = sum((x1 - x0) * (y0 + y1) / 2 for (x0, y0), (x1, y1) in pairwise(points))
    mean = sum(saliency.ravel().tolist()) / saliency.size
    threshold = min(2 * mean, max(saliency.ravel().tolist()))
    salient_mask = [value >= threshold and value > 0 for value in saliency.ravel().tolist()]
    tp = sum(s and g for s, g in zip(salient_mask, positive.ravel().tolist(), strict=True))
    fpr = sum(s and n for s, n in zip(salient_mask, negative.ravel().tolist(), strict=True)) / int(negative.sum())
    fp = fpr * int(negative.sum())
    recall = tp / int(positive.sum())
    precision = tp / (tp + fp) if tp + fp else 1.0
    f = 2 * precision * recall / (precision + recall) if precision + recall else 0.0
    return f, auc


@pytest.mark.parametrize("seed", range(4))
def test_shuffled_as_the_slow_reference_has_it(seed: int) -> None:
    random = np.random.default_rng(seed)
    positive = random.random((9, 13)) < 0.3
    negative = random.random((9, 13)) < 0.5
    # Coarse maps have many ties.
    saliency = levels((positive * 0.4 + random.random((9, 13))).round(seed))
    f, auc = slow_shuffled(saliency, positive, negative)
    s = score(saliency, positive, negative)
    assert s.shuffled_f == pytest.approx(f, abs=1e-12)
    assert s.shuffled_auc == pytest.approx(auc, abs=1e-12)


@pytest.mark.parametrize("seed", range(6))
def test_auc_as_scikit_learn_has_it(seed: int) -> None:
    random = np.random.default_rng(100 + seed)
    positive = random.random((60, 80)) < 0.2
    negative = random.random((60, 80)) < 0.4
    saliency = levels((positive * 0.5 + random.random((60, 80))).round(1 + seed % 3))
    # A pixel of both references is in both samples.
    values = np.concatenate([saliency[positive], saliency[negative]])
    truth = np.concatenate([np.ones(positive.sum()), np.zeros(negative.sum())])
    expected = float(roc_auc_score(truth, values))
    assert shuffled_auc(Counts.of(saliency, positive), Counts.of(saliency, negative)) == pytest.approx(
        expected, abs=1e-6
    )
    # And beside the truth instead of a reference.
    expected = float(roc_auc_score(positive.ravel(), saliency.ravel()))
    assert shuffled_auc(Counts.of(saliency, positive), Counts.of(saliency, ~positive)) == pytest.approx(
        expected, abs=1e-6
    )


def test_a_perfect_map_and_its_opposite() -> None:
    perfect = levels(TRUTH)
    s = score(perfect, TRUTH, ~TRUTH)
    assert (s.f, s.best_f, s.mae, s.shuffled_f, s.shuffled_auc) == (1.0, 1.0, 0.0, 1.0, 1.0)
    s = score(levels(~TRUTH), TRUTH, ~TRUTH)
    assert (s.f, s.mae, s.shuffled_auc) == (0.0, 1.0, 0.0)


def test_sweep_where_nothing_is_salient() -> None:
    nothing = np.zeros((2, 4), dtype=np.uint8)
    sweep = Sweep.of(Counts.of(nothing, TRUTH), Counts.of(nothing, ~TRUTH))
    assert (sweep.precision[1], sweep.recall[1], sweep.f[1]) == (1.0, 0.0, 0.0)
    assert sweep.recall[0] == 1.0


def test_sizes_must_agree() -> None:
    with pytest.raises(ValueError, match=r"\(2, 4\) and a mask of shape \(4, 2\)"):
        Counts.of(MAP, TRUTH.T)
    with pytest.raises(ValueError, match=r"\(2, 4\) and a mask of shape \(4, 2\)"):
        mean_absolute_error(MAP, TRUTH.T)


def test_averages_are_over_images_not_pixels() -> None:
    small = score(levels(TRUTH), TRUTH, ~TRUTH)
    large_truth = np.tile(TRUTH, (10, 10))
    large = score(levels(~large_truth), large_truth, ~large_truth)
    averages = Averages.of([small, large])
    assert averages is not None
    assert (averages.images, averages.f, averages.mae) == (2, 0.5, 0.5)
    assert averages.fs[255] == pytest.approx(0.5)
    assert Averages.of([]) is None


def test_results_survive_the_way_through_text() -> None:
    result = Result("key", "näme", [score(MAP, TRUTH, ~TRUTH)], [])
    again = Result.from_json(result.to_json())
    assert again.to_json() == result.to_json()
    assert np.array_equal(again.scores[0].true, result.scores[0].true)
    assert again.scores[0].best_f == result.scores[0].best_f
