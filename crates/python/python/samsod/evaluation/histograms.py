"""Histograms of the errors of places, as figures 13 (x) and 14 (y) of the paper: before and after separation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

#: Bars of a histogram. Larger errors stand in a last bar of their own, so that one merged region does not flatten it.
BARS = 40
#: Share of the errors before separation that the axis reaches: centroids of merged regions lie anywhere.
BEFORE_SHARE = 0.75
#: The same of the errors after it.
AFTER_SHARE = 0.9


def write_histograms(path: Path, axis: str, before: Sequence[float], after: Sequence[float]) -> None:
    """Writes one figure with two histograms over the same axis.

    Args:
        path: PNG file.
        axis: "x" or "y".
        before: absolute errors in mm of the centroids of salient regions.
        after: the same of the centroids of object masks.
    """
    figure = Figure(figsize=(9.6, 3.9), dpi=110, layout="constrained")
    plots = figure.subplots(1, 2, sharex=True, sharey=True)
    top = reach(before, after)
    edges = np.linspace(0.0, top, BARS + 1)
    width = edges[1]
    for plot, errors, title, colour in (
        (plots[0], before, f"(a) before shadow separation, {axis}", "#c05020"),
        (plots[1], after, f"(b) after shadow separation, {axis}", "#2060a0"),
    ):
        values = np.asarray(errors, dtype=np.float64)
        counts, _ = np.histogram(values, edges)
        beyond = int(np.count_nonzero(values > top))
        plot.bar(edges[:-1], counts, width=width, align="edge", color=colour, edgecolor="white", linewidth=0.6)
        if beyond:
            plot.bar(top + width, beyond, width=width, align="edge", color=colour, alpha=0.5, hatch="//")
            text = f"{beyond} above {top:g}, up to {values.max():.1f}"
            plot.annotate(text, (top + 1.5 * width, beyond), (-2, 4), textcoords="offset points", ha="right")
        if len(values):
            mean = float(values.mean())
            if mean <= top:
                plot.axvline(mean, color="black", linestyle="--", linewidth=1.2)
            title += f"\n{len(values)} parts, mean {mean:.2f} mm (dashed), median {np.median(values):.2f} mm"
        else:
            plot.text(0.5, 0.5, "no part with a place", transform=plot.transAxes, ha="center", va="center")
        plot.set_title(title, fontsize="medium")
        plot.margins(y=0.12)
        plot.set_xlabel(f"|error| along {axis}, mm")
        plot.grid(axis="y", alpha=0.3)
        plot.set_axisbelow(True)
    plots[0].set_ylabel("parts")
    figure.savefig(path)


def reach(before: Sequence[float], after: Sequence[float]) -> float:
    """End of the axis in mm: a round number above most of the errors, 1 or more."""
    ends = [
        float(np.quantile(errors, share))
        for errors, share in ((before, BEFORE_SHARE), (after, AFTER_SHARE))
        if len(errors)
    ]
    return float(max(1, math.ceil(max(ends, default=1.0))))
