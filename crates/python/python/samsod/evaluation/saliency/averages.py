"""Averages of the scores of a database, as table 1 has them, and their sweeps."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from samsod.evaluation.saliency.metrics import Curve
from samsod.evaluation.saliency.scoring import Score
from samsod.evaluation.spread import mean


@dataclass(frozen=True)
class Averages:
    """Means over the images of a database.

    Attributes:
        images: how many.
        shuffled_f, shuffled_auc, f, mae: the measures of table 1.
        best_f: mean of the best F of each image.
        sweep_f, sweep_threshold: the largest mean F that one threshold reaches for all images, and that threshold.
        precision, recall: at twice the mean.
        ns_px: time of a map, nanoseconds a pixel; None for maps that were read.
        precisions, recalls, fs: mean curves over the thresholds 0 to 255.
    """

    images: int
    shuffled_f: float | None
    shuffled_auc: float | None
    f: float
    mae: float
    best_f: float
    sweep_f: float
    sweep_threshold: int
    precision: float
    recall: float
    ns_px: float | None
    precisions: Curve
    recalls: Curve
    fs: Curve

    @staticmethod
    def of(scores: Sequence[Score]) -> Averages | None:
        """None without scores."""
        if not scores:
            return None
        sweeps = [score.sweep for score in scores]
        fs = np.mean([sweep.f for sweep in sweeps], axis=0)
        at = int(np.argmax(fs))
        timed = [score for score in scores if score.ms is not None]
        pixels = sum(score.width * score.height for score in timed)
        return Averages(
            images=len(scores),
            shuffled_f=mean([score.shuffled_f for score in scores if score.shuffled_f is not None]),
            shuffled_auc=mean([score.shuffled_auc for score in scores if score.shuffled_auc is not None]),
            f=float(np.mean([score.f for score in scores])),
            mae=float(np.mean([score.mae for score in scores])),
            best_f=float(np.mean([score.best_f for score in scores])),
            sweep_f=float(fs[at]),
            sweep_threshold=at,
            precision=float(np.mean([score.precision for score in scores])),
            recall=float(np.mean([score.recall for score in scores])),
            ns_px=1e6 * sum(score.ms or 0.0 for score in timed) / pixels if pixels else None,
            precisions=np.mean([sweep.precision for sweep in sweeps], axis=0),
            recalls=np.mean([sweep.recall for sweep in sweeps], axis=0),
            fs=fs,
        )


@dataclass(frozen=True)
class Measure:
    """One measure: its name, its value, and which way is better."""

    name: str
    value: Callable[[Averages], float | None]
    larger_is_better: bool = True


#: The rows of table 1.
MEASURES = (
    Measure("shuffled F-measure", lambda a: a.shuffled_f),
    Measure("sAUC", lambda a: a.shuffled_auc),
    Measure("F-measure", lambda a: a.f),
    Measure("MAE", lambda a: a.mae, larger_is_better=False),
)
#: What the sweeps tell beside them.
SWEEP_MEASURES = (
    Measure("best F of each image", lambda a: a.best_f),
    Measure("best F of one threshold", lambda a: a.sweep_f),
)


def best_methods(measure: Measure, averages: Mapping[str, Averages]) -> set[str]:
    """The methods whose value, as printed, is the best."""
    values = {method: measure.value(a) for method, a in averages.items()}
    known = {method: round(value, 4) for method, value in values.items() if value is not None}
    if not known:
        return set()
    best = max(known.values()) if measure.larger_is_better else min(known.values())
    return {method for method, value in known.items() if value == best}
