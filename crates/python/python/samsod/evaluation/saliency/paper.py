"""The paper's own figures of saliency, to stand beside ours, and the tables that do so: table 2 and table A.3."""

from __future__ import annotations

from collections.abc import Mapping

from samsod.evaluation.saliency.averages import MEASURES, Averages
from samsod.evaluation.saliency.methods import SIGMA_SETS

#: Table A.3: (shuffled F-measure, sAUC, F-measure, MAE) of the three sets of scales.
SENSITIVITY: dict[str, tuple[tuple[float, ...], ...]] = {
    "SED2": ((0.7505, 0.7778, 0.7987, 0.0380), (0.7495, 0.7770, 0.7989, 0.0399), (0.7482, 0.7781, 0.7976, 0.0387)),
    "GIT": ((0.6088, 0.6836, 0.5380, 0.1721), (0.6071, 0.6842, 0.5284, 0.1769), (0.5935, 0.6811, 0.5377, 0.1736)),
}

#: Table 2: milliseconds a pixel on a CPU (Intel i5, 8 GB) of the methods that do not learn.
MS_PX: dict[str, float] = {
    "paper's own": 0.07,
    "SEG": 0.193,
    "HS": 0.013,
    "FT": 0.0003,
    "MB": 0.0005,
    "LPS": 0.005,
    "SMD": 0.006,
    "MIL": 0.375,
}


def sensitivity_table(database: str, averages: Mapping[str, Averages]) -> str:
    """Table A.3 with ours below the paper's.

    Args:
        database: name of the folder.
        averages: of the methods of `SIGMA_SETS`.
    """

    def braces(values: tuple[float, ...]) -> str:
        return "{" + ", ".join(f"{value:g}" for value in values) + "}"

    heads = [f"{braces(center)}/{braces(surround)}" for center, surround in SIGMA_SETS.values()]
    lines = ["| database | measure | " + " | ".join(heads) + " | spread |", "|---" * (len(heads) + 3) + "|"]

    def add(name: str, measure: str, values: list[float | None]) -> None:
        known = [value for value in values if value is not None]
        spread = f"{max(known) - min(known):.4f}" if known else "-"
        cells = ["-" if value is None else f"{value:.4f}" for value in values]
        lines.append(f"| {name} | {measure} | " + " | ".join([*cells, spread]) + " |")

    for row, measure in enumerate(MEASURES):
        values = [measure.value(averages[method]) if method in averages else None for method in SIGMA_SETS]
        add(database if row == 0 else "", measure.name, values)
    for name, sets in SENSITIVITY.items():
        for row, measure in enumerate(MEASURES):
            add(f"{name} (paper)" if row == 0 else "", measure.name, [values[row] for values in sets])
    return "\n".join([*lines, ""])


def speed_table(ms_px: Mapping[str, float], images: int, pixels: int) -> str:
    """Table 2: ours measured, the paper's beside it.

    Args:
        ms_px: milliseconds a pixel of our methods.
        images, pixels: that were timed.
    """
    lines = [
        f"Ours: {images} images of {pixels / images:.0f} px on average, one thread, processor time, the least of "
        "the runs of each. The paper's are of another machine and, its own, of MATLAB.",
        "",
        "| method | ms a pixel | ms an image of 256 x 256 px |",
        "|---|---|---|",
    ]
    lines += [f"| {method} | {ms:.6f} | {ms * 65536:.1f} |" for method, ms in ms_px.items()]
    lines += [f"| {method} (paper) | {ms:g} | {ms * 65536:.1f} |" for method, ms in MS_PX.items()]
    return "\n".join([*lines, ""])
