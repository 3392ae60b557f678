"""Measures of a saliency map against a binary truth (eqs 17 to 20), as functions of arrays.

Maps are compared as levels of 8 bits, 0 to 255, stretched from the least to the largest value: maps of other methods
come as such, and ours must not win by finer steps. The sweeps are over all 256 thresholds: at threshold t the pixels of
level t and above are salient.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Levels = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]
Curve = npt.NDArray[np.float64]

#: Thresholds of a sweep.
LEVELS = 256


def levels(saliency: npt.NDArray[np.number]) -> Levels:
    """A map of any range as levels: the least value 0, the largest 255; 0 everywhere where all are alike.

    Args:
        saliency: (H, W), finite.

    Raises:
        ValueError: a value is not finite, or there is none.
    """
    if saliency.size == 0:
        raise ValueError(f"a map of shape {saliency.shape} has no pixels")
    values = saliency.astype(np.float64)
    low, high = float(values.min()), float(values.max())
    if not np.isfinite(low) or not np.isfinite(high):
        raise ValueError("a map has values that are not finite")
    if high <= low:
        return np.zeros(saliency.shape, dtype=np.uint8)
    stretched: Levels = np.rint((values - low) / (high - low) * (LEVELS - 1)).astype(np.uint8)
    return stretched


def adaptive_threshold(saliency: Levels) -> int:
    """The level from which on pixels are salient: twice the mean (reference 92), at most the largest, at least 1."""
    twice = 2.0 * float(saliency.mean())
    return max(1, int(np.ceil(min(twice, float(saliency.max())))))


def f_measure(precision: float, recall: float) -> float:
    """Eq 17: their harmonic mean; 0 where both are 0."""
    return 2.0 * precision * recall / (precision + recall) if precision + recall > 0 else 0.0


def mean_absolute_error(saliency: Levels, truth: Mask) -> float:
    """Eq 20, in [0, 1]."""
    _same_shape(saliency, truth)
    return float(np.abs(saliency / (LEVELS - 1) - truth).mean())


@dataclass(frozen=True)
class Counts:
    """How many pixels of one mask have level t or more, for every threshold t: int64 (256,), falling."""

    at_least: npt.NDArray[np.int64]

    @staticmethod
    def of(saliency: Levels, mask: Mask) -> Counts:
        """Counts the pixels of `mask`, (H, W) as the map."""
        _same_shape(saliency, mask)
        histogram = np.bincount(saliency[mask], minlength=LEVELS)
        return Counts(np.cumsum(histogram[::-1])[::-1])

    @property
    def pixels(self) -> int:
        """All pixels of the mask."""
        return int(self.at_least[0])

    @property
    def rate(self) -> Curve:
        """Share of the mask at every threshold, float64 (256,): eq 18 for the truth, eq 19 for the negative reference.

        0 for a mask without pixels.
        """
        return self.at_least / max(self.pixels, 1)


@dataclass(frozen=True)
class Sweep:
    """Precision, recall and F at every threshold, each float64 (256,) in [0, 1]."""

    precision: Curve
    recall: Curve
    f: Curve

    @staticmethod
    def of(true: Counts, false: Counts) -> Sweep:
        """From the counts of the truth and of what is salient beside it.

        `false` are the other pixels of the image for the F-measure, those of the negative reference for the shuffled.
        Where no pixel is salient there is nothing wrong and nothing found: precision 1, recall 0.
        """
        found = true.at_least + false.at_least
        precision = np.where(found > 0, true.at_least / np.maximum(found, 1), 1.0)
        recall = true.rate
        both = precision + recall
        f = np.where(both > 0, 2.0 * precision * recall / np.where(both > 0, both, 1.0), 0.0)
        return Sweep(precision, recall, f)


def shuffled_auc(positive: Counts, negative: Counts) -> float | None:
    """Area under the curve of the rates of eqs 18 and 19, by trapezia: one half is chance.

    None where a reference has no pixels.
    """
    if positive.pixels == 0 or negative.pixels == 0:
        return None
    # From the threshold above all levels, where nothing is salient, down to 0, where everything is.
    true_rate = np.concatenate([[0.0], positive.rate[::-1]])
    false_rate = np.concatenate([[0.0], negative.rate[::-1]])
    return float(np.trapezoid(true_rate, false_rate))


def _same_shape(saliency: Levels, mask: Mask) -> None:
    if saliency.shape != mask.shape:
        raise ValueError(f"a map of shape {saliency.shape} and a mask of shape {mask.shape}; they must agree")
