"""The report on recognition: rates, angles, places and failures in Markdown; one line of CSV a part and method."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

from samsod.evaluation.paper_tables import paper_tables
from samsod.evaluation.recognition import CONVENTIONAL, LEAST_IOU, METHODS, NamedPart, RecognitionScore, Stray
from samsod.evaluation.recognition_figures import MethodFigures, RecognitionFigures, counted, scores_of
from samsod.evaluation.spread import percent, text
from samsod.evaluation.summary import GROUPS, Measured, grouped, recognised, upright
from samsod.evaluation.tables import Column, group_by, markdown_table

LEGEND = f"""\
parts: those in the catalogue that a salient region covers to a half; right, wrong, unknown, nothing: whether their
detection by the method "best" has the right name, another, none, or they have no detection; shape, SIFT: right names
by these methods alone, SIFT among textured parts; spurious: named detections of "best" on no part; doubles: on a part
that has another one; angle: mean ± standard deviation over right parts, modulo their symmetry; x, y: absolute errors of
the origins of the parts that "best" named rightly, on the table; false names: parts that are not in the catalogue, and
how many of them "best" gave a name.

A detection belongs to the part with whose visible mask its mask has the largest IoU, {LEAST_IOU:g} or more, one to one,
and failing that to the nearest whose origin is no farther from its own than half the part's size."""

Row = RecognitionFigures

COLUMNS: tuple[Column[Row], ...] = (
    Column("parts", lambda f: f.methods["best"].parts),
    Column("right %", lambda f: percent(f.methods["best"].rate), "{:.1f}"),
    Column("wrong", lambda f: f.methods["best"].wrong),
    Column("unknown", lambda f: f.methods["best"].unknown),
    Column("nothing", lambda f: f.methods["best"].nothing),
    Column("shape %", lambda f: percent(f.methods["shape"].rate), "{:.1f}"),
    Column("SIFT %", lambda f: percent(f.sift_textured.rate), "{:.1f}"),
    Column("spurious", lambda f: f.methods["best"].spurious),
    Column("doubles", lambda f: f.methods["best"].doubles),
    Column("angle by shape, °", lambda f: text(f.methods["shape"].angle)),
    Column("by SIFT", lambda f: text(f.methods["sift"].angle)),
    Column("by best", lambda f: text(f.methods["best"].angle)),
    Column("x, mm", lambda f: text(f.methods["best"].x)),
    Column("y, mm", lambda f: text(f.methods["best"].y)),
    Column("false names", lambda f: _of(f.methods["best"].false_names, f.methods["best"].others)),
)

METHOD_COLUMNS: tuple[Column[MethodFigures], ...] = (
    Column("scenes", lambda m: m.scenes),
    Column("parts", lambda m: m.parts),
    Column("right %", lambda m: percent(m.rate), "{:.1f}"),
    Column("wrong", lambda m: m.wrong),
    Column("unknown", lambda m: m.unknown),
    Column("nothing", lambda m: m.nothing),
    Column("spurious", lambda m: m.spurious),
    Column("doubles", lambda m: m.doubles),
    Column("angle, °", lambda m: text(m.angle)),
    Column("x, mm", lambda m: text(m.x)),
    Column("y, mm", lambda m: text(m.y)),
    Column("false names", lambda m: _of(m.false_names, m.others)),
    Column("median, ms", lambda m: m.ms, "{:.1f}"),
)


def _of(part: int, whole: int) -> str | None:
    return f"{part} of {whole}" if whole else None


def report(scenes: Sequence[Measured], why_not: str | None, left_out: Sequence[str]) -> str:
    """The sections on recognition and beside the paper.

    Args:
        scenes: all scenes.
        why_not: why nothing was recognised; None when it was.
        left_out: parts that were taken from the catalogue.
    """
    if why_not is not None:
        return f"## Recognition\n\nNot measured: {why_not}."
    lines = ["## Recognition\n", LEGEND, ""]
    if left_out:
        lines += [f"Left out of the catalogue: {', '.join(left_out)}.\n"]
    straight, oblique = upright(scenes), [scene for scene in scenes if scene.oblique]
    views = [(name, group) for name, group in (("not oblique", straight), ("oblique", oblique)) if group]
    lines += [_table("view", views)]
    for name, group in views:
        lines += [f"\n### By method, {name}\n", _methods(recognised(group))]
    for key in GROUPS:
        groups = grouped(scenes, key)
        if groups:
            note = "" if key == "scenario" else " (without the oblique scenes)"
            lines += [f"\n### Recognition by {key}{note}\n", _table(key, groups)]
    naming = recognised(straight)
    if naming:
        names = group_by([part for score in scores_of(naming, "best") for part in score.parts], "part")
        rows = [(name, RecognitionFigures.of(naming, part=name)) for name, _ in names]
        lines += ["\n### Recognition by part (without the oblique scenes)\n", markdown_table("part", COLUMNS, rows)]
    lines += [_failures(recognised(scenes)), "\n## Beside the paper\n", paper_tables(scenes)]
    return "\n".join(lines)


def _table(head: str, groups: Sequence[tuple[str, Sequence[Measured]]]) -> str:
    rows = [(name, RecognitionFigures.of(recognised(group))) for name, group in groups]
    return markdown_table(head, COLUMNS, rows)


def _methods(scenes: Sequence[RecognitionScore]) -> str:
    figures = RecognitionFigures.of(scenes)
    rows = [(method.replace("_", " "), figures.methods[method]) for method in (*METHODS, *CONVENTIONAL)]
    rows.insert(2, ("sift, textured parts", figures.sift_textured))
    rows.append(("conventional sift, textured parts", figures.conventional_sift_textured))
    return markdown_table("method", METHOD_COLUMNS, [row for row in rows if row[1].scenes])


def _failures(scenes: Sequence[RecognitionScore]) -> str:
    """What "best" did not name, what it named wrongly, and what it saw where nothing is."""
    scores = scores_of(scenes, "best")
    parts = counted("best", scores)
    missed = [part for part in parts if part.known and part.outcome in ("unknown", "nothing")]
    wrong = [part for part in parts if part.known and part.outcome == "wrong"]
    false = [part for part in parts if not part.known and part.outcome == "wrong"]
    strays = [stray for score in scores for stray in (*score.spurious, *score.doubles)]
    sections = (
        ("Parts without a name", [f"{_head(p)}: {p.outcome}{_score(p)}" for p in missed]),
        ("Parts with a wrong name", [f"{_head(p)}: called {p.called}{_score(p)}" for p in wrong]),
        ("Names of parts that are not in the catalogue", [f"{_head(p)}: called {p.called}{_score(p)}" for p in false]),
        ("Spurious and double detections", [_stray(stray) for stray in strays]),
    )
    return "\n".join(
        f'\n### {head} (method "best", all scenes)\n\n' + ("\n".join(f"- {line}" for line in lines) or "None.")
        for head, lines in sections
    )


def _head(part: NamedPart) -> str:
    return f"{part.scene} ({part.table}, {part.lighting}, {part.scenario}): {part.part}, id {part.id}"


def _score(part: NamedPart) -> str:
    return "" if part.score is None else f", score {part.score:.3f}, IoU {part.iou or 0.0:.2f}"


def _stray(stray: Stray) -> str:
    x, y = stray.origin_px
    return f"{stray.scene}: {stray.called} at ({x:.0f}, {y:.0f}), score {stray.score:.3f}"


def write_named(path: Path, scenes: Sequence[RecognitionScore]) -> None:
    """Writes one line for each part and method; errors are signed, empty where there is none."""
    names = [field.name for field in fields(NamedPart) if field.name != "error_mm"]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, ["method", *names, "error_x_mm", "error_y_mm"])
        writer.writeheader()
        for method, part in ((m, p) for scene in scenes for m, score in scene.methods.items() for p in score.parts):
            row: dict[str, object] = {"method": method, **{name: getattr(part, name) for name in names}}
            if part.error_mm is not None:
                row["error_x_mm"], row["error_y_mm"] = part.error_mm
            writer.writerow({k: f"{v:.5f}" if isinstance(v, float) else v for k, v in row.items()})
