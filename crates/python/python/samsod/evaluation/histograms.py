"""Histograms as figures 13 to 17 of the paper.

13 and 14: errors of places along x and y, before and after the separation of shadows; 15: errors of angles by SIFT and
by shape; 16 and 17: errors of the conventional methods, SIFT and shape.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

BEFORE, AFTER, ANGLE = "#c05020", "#2060a0", "#508040"
#: What a part lacks that is in no histogram, by the unit.
NOTHING = {"mm": "a place", "°": "an angle"}
#: Bars of a histogram. Larger errors stand in a last bar of their own, so that one merged region does not flatten it.
BARS = 40
#: Share of the errors before separation that the axis reaches: centroids of merged regions lie anywhere.
BEFORE_SHARE = 0.75
#: The same of the errors after it.
AFTER_SHARE = 0.9


@dataclass(frozen=True)
class Panel:
    """One histogram of a figure.

    Attributes:
        title: above it.
        errors: absolute errors.
        label: below its axis.
        unit: of the errors.
        top: end of the axis.
        colour: of the bars.
    """

    title: str
    errors: Sequence[float]
    label: str
    unit: str
    top: float
    colour: str


def write_histograms(path: Path, axis: str, before: Sequence[float], after: Sequence[float]) -> None:
    """Writes figure 13 or 14: two histograms over the same axes.

    Args:
        path: PNG file.
        axis: "x" or "y".
        before: absolute errors in mm of the centroids of salient regions.
        after: the same of the centroids of object masks.
    """
    top, label = reach(before, after), f"|error| along {axis}, mm"
    panels = (
        Panel(f"(a) before shadow separation, {axis}", before, label, "mm", top, BEFORE),
        Panel(f"(b) after shadow separation, {axis}", after, label, "mm", top, AFTER),
    )
    _write(path, panels, shared=True)


def write_angles(path: Path, sift: Sequence[float], shape: Sequence[float]) -> None:
    """Writes figure 15: angle errors in degrees of recognition in salient regions, by SIFT and by shape."""
    top, label = reach(sift, shape), "|error| of the angle, °"
    panels = (
        Panel("(a) SIFT at detected regions", sift, label, "°", top, BEFORE),
        Panel("(b) shape matching at detected regions", shape, label, "°", top, AFTER),
    )
    _write(path, panels, shared=True)


def write_conventional(path: Path, method: str, x: Sequence[float], y: Sequence[float], angle: Sequence[float]) -> None:
    """Writes figure 16 or 17: errors of a conventional method.

    Args:
        path: PNG file.
        method: as it stands in the titles.
        x, y: absolute errors in mm of the origins of the parts.
        angle: absolute errors in degrees.
    """
    top = reach(x, y)
    panels = (
        Panel(f"(a) {method}, x", x, "|error| along x, mm", "mm", top, AFTER),
        Panel(f"(b) {method}, y", y, "|error| along y, mm", "mm", top, AFTER),
        Panel(f"(c) {method}, angle", angle, "|error| of the angle, °", "°", reach(angle, angle), ANGLE),
    )
    _write(path, panels, shared=False)


def _write(path: Path, panels: Sequence[Panel], shared: bool) -> None:
    """Writes panels in a row; `shared`: all over the same axis."""
    figure = Figure(figsize=(4.8 * len(panels), 3.9), dpi=110, layout="constrained")
    plots = figure.subplots(1, len(panels), sharex=shared, sharey=True)
    for plot, panel in zip(plots, panels, strict=True):
        edges = np.linspace(0.0, panel.top, BARS + 1)
        width = edges[1]
        values = np.asarray(panel.errors, dtype=np.float64)
        counts, _ = np.histogram(values, edges)
        beyond = int(np.count_nonzero(values > panel.top))
        plot.bar(edges[:-1], counts, width=width, align="edge", color=panel.colour, edgecolor="white", linewidth=0.6)
        if beyond:
            plot.bar(panel.top + width, beyond, width=width, align="edge", color=panel.colour, alpha=0.5, hatch="//")
            text = f"{beyond} above {panel.top:g}, up to {values.max():.1f}"
            plot.annotate(text, (panel.top + 1.5 * width, beyond), (-2, 4), textcoords="offset points", ha="right")
        title = panel.title
        if len(values):
            mean, unit = float(values.mean()), panel.unit
            if mean <= panel.top:
                plot.axvline(mean, color="black", linestyle="--", linewidth=1.2)
            title += f"\n{len(values)} parts, mean {mean:.2f} {unit} (dashed), median {np.median(values):.2f} {unit}"
        else:
            text = f"no part with {NOTHING[panel.unit]}"
            plot.text(0.5, 0.5, text, transform=plot.transAxes, ha="center", va="center")
        plot.set_title(title, fontsize="medium")
        plot.margins(y=0.12)
        plot.set_xlabel(panel.label)
        plot.grid(axis="y", alpha=0.3)
        plot.set_axisbelow(True)
    plots[0].set_ylabel("parts")
    figure.savefig(path)


def reach(before: Sequence[float], after: Sequence[float]) -> float:
    """End of the axis: a whole number above most of the errors, 1 or more."""
    ends = [
        float(np.quantile(errors, share))
        for errors, share in ((before, BEFORE_SHARE), (after, AFTER_SHARE))
        if len(errors)
    ]
    return float(max(1, math.ceil(max(ends, default=1.0))))
