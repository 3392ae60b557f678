"""The report on objects and places: Markdown, and one line of CSV for each part."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

from samsod.evaluation import cell
from samsod.evaluation.calibration import Calibration
from samsod.evaluation.objects import DETECTED_SHARE, PartScore
from samsod.evaluation.spread import Spread, mean_of, percent, text
from samsod.evaluation.summary import GROUPS, Figures, Measured, PartFigures, grouped, upright
from samsod.evaluation.tables import Column, group_by, markdown_table

#: Objects with a smaller IoU are listed.
POOR_IOU = 0.5


PART_COLUMNS: tuple[Column[PartFigures], ...] = (
    Column("parts", lambda p: p.parts),
    Column("found", lambda p: p.found),
    Column("merged", lambda p: p.merged),
    Column("no object", lambda p: p.missing),
    Column("IoU", lambda p: p.iou, "{:.3f}"),
    Column("paper", lambda p: p.paper_iou, "{:.3f}"),
)

PLACE_COLUMNS: tuple[Column[PartFigures], ...] = (
    Column("x before, mm", lambda p: text(p.before_x)),
    Column("y before", lambda p: text(p.before_y)),
    Column("x after", lambda p: text(p.after_x)),
    Column("y after", lambda p: text(p.after_y)),
)


def _of_parts(column: Column[PartFigures]) -> Column[Figures]:
    return Column(column.head, lambda figures: column.value(figures.of_parts), column.form)


COLUMNS: tuple[Column[Figures], ...] = (
    Column("scenes", lambda f: f.scenes),
    *(_of_parts(column) for column in PART_COLUMNS),
    Column("shadow recall %", lambda f: percent(f.shadow_recall), "{:.1f}"),
    Column("paper", lambda f: percent(f.paper_shadow_recall), "{:.1f}"),
    Column("object loss %", lambda f: percent(f.object_loss), "{:.1f}"),
    Column("paper", lambda f: percent(f.paper_object_loss), "{:.1f}"),
    *(_of_parts(column) for column in PLACE_COLUMNS),
)

LEGEND = f"""\
found: parts covered to {DETECTED_SHARE:.0%} or more by one salient region; merged: those whose region also covers
another part; no object: those that share no pixel with any object (IoU 0, no place after); IoU: object mask (the
object with the largest overlap) against visible mask, mean over found parts; shadow recall: true cast-shadow pixels
inside salient regions that are labelled shadow; object loss: true object pixels inside salient regions that are;
paper: the column before with `object_side = "paper"`; x, y: absolute error on the table plane z = 0, mean ± standard
deviation over found parts, before separation by the centroid of the salient region, after it by that of the object
mask.

The paper has 1.1 to 2.4 mm before and 0.4 to 1.5 mm after (tables 4 and 7, camera overhead), 2.2 to 4.4 and 2.1 to
4.3 mm seen at a slant (table A.1)."""


@dataclass(frozen=True)
class Bar:
    """A figure, what it must reach, and in which direction."""

    figure: str
    reached: float | None
    limit: float
    at_least: bool
    form: str

    @property
    def verdict(self) -> str:
        """Whether it is met; a dash when nothing was measured."""
        if self.reached is None:
            return "-"
        return "yes" if (self.reached >= self.limit if self.at_least else self.reached <= self.limit) else "no"


def bars(scenes: Sequence[Measured], calibration: Calibration | None) -> list[Bar]:
    """What the project asks of the rendered cell."""
    straight = Figures.of(upright(scenes))
    oblique = Figures.of([scene for scene in scenes if scene.oblique])
    parts, slant = straight.of_parts, oblique.of_parts
    # By table material: each has to keep the bar.
    tables = [Figures.of(group).of_parts for _, group in grouped(scenes, "table")]
    place = "place after separation, mean absolute error in"
    settled, known = straight.settled, "place of the mask after recognition, mean absolute error in"
    return [
        Bar("IoU of object masks", parts.iou, 0.90, True, "{:.3f}"),
        Bar("shadow recall, %", percent(straight.shadow_recall), 90.0, True, "{:.1f}"),
        Bar("object loss, %", percent(straight.object_loss), 3.0, False, "{:.2f}"),
        Bar(f"{place} x, mm", mean_of(parts.after_x), 0.4, False, "{:.2f}"),
        Bar(f"{place} y, mm", mean_of(parts.after_y), 0.4, False, "{:.2f}"),
        Bar(f"{place} x, mm, worst table", _worst([t.after_x for t in tables]), 0.4, False, "{:.2f}"),
        Bar(f"{place} y, mm, worst table", _worst([t.after_y for t in tables]), 0.4, False, "{:.2f}"),
        Bar(f"{place} x, mm, oblique scenes", mean_of(slant.after_x), 1.0, False, "{:.2f}"),
        Bar(f"{place} y, mm, oblique scenes", mean_of(slant.after_y), 1.0, False, "{:.2f}"),
        Bar("IoU of object masks after recognition", settled.iou if settled else None, 0.90, True, "{:.3f}"),
        Bar("shadow recall after recognition, %", percent(straight.settled_shadow_recall), 90.0, True, "{:.1f}"),
        Bar("object loss after recognition, %", percent(straight.settled_object_loss), 3.0, False, "{:.2f}"),
        Bar(f"{known} x, mm", mean_of(settled.after_x) if settled else None, 0.4, False, "{:.2f}"),
        Bar(f"{known} y, mm", mean_of(settled.after_y) if settled else None, 0.4, False, "{:.2f}"),
        Bar("shadow stage, median ms", straight.timings_ms.get("shadow"), 4.0, False, "{:.2f}"),
        Bar(
            "intrinsics, worst error, %", max(calibration.errors_percent) if calibration else None, 0.3, False, "{:.3f}"
        ),
        Bar("reprojection error, px", calibration.reprojection_px if calibration else None, 0.15, False, "{:.3f}"),
    ]


BAR_COLUMNS: tuple[Column[Bar], ...] = (
    Column("reached", lambda b: None if b.reached is None else b.form.format(b.reached)),
    Column("bar", lambda b: f"at {'least' if b.at_least else 'most'} {b.limit:g}"),
    Column("met", lambda b: b.verdict),
)


def report(scenes: Sequence[Measured], calibration: Calibration | str, recognition: str, title: str) -> str:
    """The whole report as Markdown.

    Args:
        scenes: all scenes.
        calibration: what was found, or why there is none.
        recognition: the sections on recognition.
        title: its head.
    """
    found = calibration if isinstance(calibration, Calibration) else None
    straight = upright(scenes)
    oblique = [scene for scene in scenes if scene.oblique]
    views = [(name, group) for name, group in (("not oblique", straight), ("oblique", oblique)) if group]
    # Overall figures are those of the scenes that are not oblique; without any there are none.
    lines = [f"# {title}\n"]
    lines += ["Scenes that are not oblique, where nothing else is said.\n"]
    lines += [markdown_table("figure", BAR_COLUMNS, [(bar.figure, bar) for bar in bars(scenes, found)]), ""]
    lines += [cell.report([scene.score for scene in scenes])]
    lines += ["## Objects and places\n", LEGEND, "", _table("view", views)]
    for key in GROUPS:
        groups = grouped(scenes, key)
        if groups:
            note = "" if key == "scenario" else " (without the oblique scenes)"
            lines += [f"\n### By {key}{note}\n", _table(key, groups)]
    lines += _after_recognition(views, scenes)
    parts = [part for scene in straight for part in scene.objects.parts]
    if parts:
        # A centroid of a region with several parts is that of none of them.
        found_parts = [part for part in parts if part.detected]
        shared = [("alone in their region", False), ("merged with others", True)]
        rows = [
            (name, PartFigures.of([part for part in found_parts if part.merged is value])) for name, value in shared
        ]
        lines += ["\n### By what else is in the region (without the oblique scenes)\n"]
        lines += [markdown_table("found parts", (*PART_COLUMNS, *PLACE_COLUMNS), rows)]
        rows = [(name, PartFigures.of(group)) for name, group in group_by(parts, "part")]
        lines += ["\n### By part (without the oblique scenes)\n"]
        lines += [markdown_table("part", (*PART_COLUMNS, *PLACE_COLUMNS), rows)]
    lines += [_poor(scenes), "", recognition, "\n## Times\n", _times(views), "\n## Calibration\n"]
    lines += [calibration.report() if isinstance(calibration, Calibration) else f"Not measured: {calibration}."]
    return "\n".join(lines) + "\n"


def _table(head: str, groups: Sequence[tuple[str, Sequence[Measured]]]) -> str:
    return markdown_table(head, COLUMNS, [(name, Figures.of(group)) for name, group in groups])


SETTLED_COLUMNS: tuple[Column[Figures], ...] = (
    Column("scenes", lambda f: f.scenes),
    Column("found", lambda f: f.settled.found if f.settled else None),
    Column("no object", lambda f: f.settled.missing if f.settled else None),
    Column("IoU before recognition", lambda f: f.of_parts.iou, "{:.3f}"),
    Column("IoU", lambda f: f.settled.iou if f.settled else None, "{:.3f}"),
    Column("shadow recall %", lambda f: percent(f.settled_shadow_recall), "{:.1f}"),
    Column("object loss %", lambda f: percent(f.settled_object_loss), "{:.1f}"),
    Column("x, mm", lambda f: text(f.settled.after_x) if f.settled else None),
    Column("y, mm", lambda f: text(f.settled.after_y) if f.settled else None),
)

SETTLED_LEGEND = """\
The same of the objects as the recognised parts settle them, by the method "best": the pixels of a recognised part are
those that its pose gives it."""


def _after_recognition(views: Sequence[tuple[str, Sequence[Measured]]], scenes: Sequence[Measured]) -> list[str]:
    """The tables of the objects after recognition, if that was measured."""
    if all(scene.settled is None for scene in scenes):
        return []
    lines = ["\n### Objects after recognition\n", SETTLED_LEGEND, ""]
    by: list[tuple[str, Sequence[tuple[str, Sequence[Measured]]]]] = [("view", views)]
    by += [(key, grouped(scenes, key)) for key in ("table", "lighting")]
    for head, groups in by:
        rows = [(name, Figures.of(group)) for name, group in groups]
        lines += [markdown_table(head, SETTLED_COLUMNS, rows), ""]
    return lines


def _times(views: Sequence[tuple[str, Sequence[Measured]]]) -> str:
    """Median times of the stages, one row a view."""
    rows = [(name, Figures.of(group).timings_ms) for name, group in views]
    stages = list(rows[0][1]) if rows else []

    def column(stage: str) -> Column[dict[str, float | None]]:
        return Column(f"{stage}, ms", lambda timings: timings.get(stage), "{:.2f}")

    return markdown_table("median over scenes", [column(stage) for stage in stages], rows)


def _poor(scenes: Sequence[Measured]) -> str:
    """The detected parts whose object is far off, worst first."""
    poor = [p for scene in scenes for p in scene.objects.parts if p.iou is not None and p.iou < POOR_IOU]
    head = f"\n### Parts with IoU below {POOR_IOU:g}\n\n"
    if not poor:
        return head + "None."
    poor.sort(key=lambda part: (part.iou or 0.0, part.scene, part.id))
    return head + "\n".join(
        f"- {p.scene} ({p.table}, {p.lighting}, {p.scenario}): {p.part}, id {p.id}, "
        + ("no object" if p.lacks_object else f"IoU {p.iou:.3f}")
        + (", merged" if p.merged else "")
        for p in poor
    )


def write_parts(path: Path, scenes: Sequence[Measured]) -> None:
    """Writes one line for each part; places are in mm and errors signed, empty where there is none."""
    # Places become two columns, one for each axis.
    pairs = {"true_mm": "true", "before_mm": "before_error", "after_mm": "after_error"}
    columns = [name for f in fields(PartScore) for name in _columns(f.name, pairs)]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [*columns, "detected"])
        writer.writeheader()
        for part in (part for scene in scenes for part in scene.objects.parts):
            row: dict[str, object] = {"detected": part.detected}
            for field in fields(PartScore):
                value = getattr(part, field.name)
                values = value if isinstance(value, tuple) else (value,)
                names = _columns(field.name, pairs)
                row.update(zip(names, values, strict=False))
            writer.writerow({k: f"{v:.5f}" if isinstance(v, float) else v for k, v in row.items()})


def _columns(field: str, pairs: dict[str, str]) -> list[str]:
    return [f"{pairs[field]}_{axis}_mm" for axis in "xy"] if field in pairs else [field]


def _worst(spreads: Sequence[Spread | None]) -> float | None:
    means = [spread.mean for spread in spreads if spread is not None]
    return max(means) if means else None
