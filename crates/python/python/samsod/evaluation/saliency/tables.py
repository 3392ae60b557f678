"""Tables of the evaluation of saliency: a row an image, and summaries in the layout of the paper's tables."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from samsod.evaluation.data import DataError
from samsod.evaluation.saliency.averages import MEASURES, SWEEP_MEASURES, Averages, best_methods
from samsod.evaluation.saliency.pairs import Problem
from samsod.evaluation.saliency.scoring import Score

#: Columns of the table of images, in the order of the fields of `Score`; its curves stand in the sweep table.
COLUMNS = (
    "image",
    "method",
    "width",
    "height",
    "threshold",
    "precision",
    "recall",
    "f",
    "best_threshold",
    "best_f",
    "mae",
    "shuffled_f",
    "shuffled_auc",
    "ms",
)


def write_csv(path: Path, scores: Sequence[Score]) -> None:
    """Writes a line an image and method; what there is not is empty."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        writer.writerows([getattr(score, column) for column in COLUMNS] for score in scores)


def write_parquet(path: Path, scores: Sequence[Score]) -> None:
    """Writes the same as Parquet; what there is not is null.

    Raises:
        DataError: pyarrow is not installed.
    """
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError as error:
        raise DataError(f"{error}; Parquet needs pyarrow: pip install 'samsod[evaluation]'") from error
    kinds = {"image": pyarrow.string(), "method": pyarrow.string()}
    kinds |= dict.fromkeys(("width", "height", "threshold", "best_threshold"), pyarrow.int32())
    schema = pyarrow.schema([(column, kinds.get(column, pyarrow.float64())) for column in COLUMNS])
    columns: dict[str, list[Any]] = {column: [getattr(score, column) for score in scores] for column in COLUMNS}
    parquet.write_table(pyarrow.table(columns, schema=schema), path)


def write_sweeps(path: Path, averages: Mapping[str, Averages]) -> None:
    """Writes mean precision, recall and F of every method and threshold."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["method", "threshold", "precision", "recall", "f"])
        for method, a in averages.items():
            curves = zip(a.precisions, a.recalls, a.fs, strict=True)
            writer.writerows([method, at, *(f"{value:.6f}" for value in values)] for at, values in enumerate(curves))


def write_problems(path: Path, problems: Sequence[Problem]) -> None:
    """Writes a line a problem."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["kind", "name", "detail", "not_measured"])
        writer.writerows([p.kind, p.name, p.detail, int(p.lost)] for p in problems)


def markdown(database: str, averages: Mapping[str, Averages]) -> str:
    """Table 1: a row a measure, a column a method, the best in bold; below it what the sweeps tell."""
    lines = ["| database | measure | " + " | ".join(averages) + " |", "|---" * (len(averages) + 2) + "|"]
    for number, measure in enumerate((*MEASURES, *SWEEP_MEASURES)):
        best = best_methods(measure, averages)
        cells = [_cell(measure.value(a), method in best, "**{}**") for method, a in averages.items()]
        lines.append(f"| {_piped(database) if number == 0 else ''} | {measure.name} | " + " | ".join(cells) + " |")
    counts = [str(a.images) for a in averages.values()]
    lines.append("| | images | " + " | ".join(counts) + " |")
    return "\n".join(lines)


def latex(database: str, averages: Mapping[str, Averages]) -> str:
    """Table 1 as LaTeX (booktabs)."""
    columns = "ll" + "r" * len(averages)
    head = " & ".join(["Database", "Measure", *(_escaped(method) for method in averages)])
    lines = [f"\\begin{{tabular}}{{{columns}}}", "\\toprule", head + " \\\\", "\\midrule"]
    for number, measure in enumerate(MEASURES):
        best = best_methods(measure, averages)
        cells = [_cell(measure.value(a), method in best, "\\textbf{{{}}}") for method, a in averages.items()]
        lines.append(" & ".join([_escaped(database) if number == 0 else "", measure.name, *cells]) + " \\\\")
    return "\n".join([*lines, "\\bottomrule", "\\end{tabular}", ""])


def _cell(value: float | None, best: bool, emphasis: str) -> str:
    if value is None:
        return "-"
    text = f"{value:.4f}"
    return emphasis.format(text) if best else text


def _piped(text: str) -> str:
    return text.replace("|", "\\|")


def _escaped(text: str) -> str:
    """Text whose characters mean nothing to LaTeX."""
    special = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
    special |= {character: "\\" + character for character in "&%$#_{}"}
    return "".join(special.get(character, character) for character in text)
