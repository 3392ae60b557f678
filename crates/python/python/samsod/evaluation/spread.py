"""Means, deviations and shares of what may be nothing."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Spread:
    """Mean and standard deviation (of the sample; 0 for one value) of some values."""

    mean: float
    deviation: float

    @staticmethod
    def of(values: Sequence[float]) -> Spread | None:
        """None without values."""
        if not values:
            return None
        return Spread(statistics.fmean(values), statistics.stdev(values) if len(values) > 1 else 0.0)

    def __str__(self) -> str:
        return f"{self.mean:.2f} ± {self.deviation:.2f}"


def mean(values: Sequence[float]) -> float | None:
    """None without values."""
    return statistics.fmean(values) if values else None


def mean_of(spread: Spread | None) -> float | None:
    """The mean of a spread that may be none."""
    return None if spread is None else spread.mean


def share(part: int, whole: int) -> float | None:
    """In [0, 1]; None of nothing."""
    return part / whole if whole else None


def percent(of_one: float | None) -> float | None:
    """A share in percent."""
    return None if of_one is None else 100.0 * of_one


def text(spread: Spread | None) -> str | None:
    """Mean and deviation as they stand in a table."""
    return None if spread is None else str(spread)


def absolute(differences: Iterable[tuple[float, float]], axis: int) -> list[float]:
    """Absolute differences along x (0) or y (1)."""
    return [abs(difference[axis]) for difference in differences]
