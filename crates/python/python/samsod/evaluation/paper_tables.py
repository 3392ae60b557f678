"""Tables 4 to 9 of the paper, ours beside theirs."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from samsod.evaluation import paper
from samsod.evaluation.paper import Places, Recognised, Row, Times
from samsod.evaluation.recognition_figures import MethodFigures, RecognitionFigures
from samsod.evaluation.spread import Spread, mean, percent, text
from samsod.evaluation.summary import Measured, PartFigures, grouped, recognised, upright
from samsod.evaluation.tables import Column, group_by, markdown_table


@dataclass(frozen=True)
class Line:
    """One line of a table: a set or an object of the paper, or a group of our parts. None where nothing was measured.

    Attributes:
        before, after: places, x and y in mm.
        found: detection rate in %.
        part: places of the origins of the parts named by the method "best", which the paper has not.
        sift, shape, conventional_sift, conventional_shape: angles in degrees, rates in %, places.
    """

    before: Places | None
    after: Places | None
    found: float | None
    part: Places | None
    sift: Recognised | None
    shape: Recognised | None
    conventional_sift: Recognised | None
    conventional_shape: Recognised | None

    @staticmethod
    def of_paper(row: Row) -> Line:
        """A line of the paper, in which all objects were detected."""
        return Line(
            row.before, row.after, 100.0, None, row.sift, row.shape, row.conventional_sift, row.conventional_shape
        )

    @staticmethod
    def of_ours(parts: PartFigures, naming: RecognitionFigures) -> Line:
        """A line of ours; SIFT is counted over textured parts."""
        best = naming.methods["best"]
        return Line(
            before=_places(parts.before_x, parts.before_y),
            after=_places(parts.after_x, parts.after_y),
            found=100.0 * parts.found / parts.parts if parts.parts else None,
            part=_places(best.x, best.y),
            sift=_recognised(naming.sift_textured),
            shape=_recognised(naming.methods["shape"]),
            conventional_sift=_recognised(naming.conventional_sift_textured),
            conventional_shape=_recognised(naming.methods["conventional_shape"]),
        )


def _places(x: Spread | None, y: Spread | None) -> Places | None:
    return None if x is None or y is None else Places(x, y)


def _recognised(figures: MethodFigures) -> Recognised | None:
    """None of a method that was not run, or had no part to recognise."""
    rate = percent(figures.rate)
    return None if rate is None else Recognised(figures.angle, rate, _places(figures.x, figures.y))


def _place_columns(head: str, of: Callable[[Line], Places | None]) -> tuple[Column[Line], ...]:
    def spread(line: Line, axis: str) -> str | None:
        places = of(line)
        return None if places is None else str(getattr(places, axis))

    return (
        Column(f"{head} x, mm", lambda line: spread(line, "x")),
        Column(f"{head} y, mm", lambda line: spread(line, "y")),
    )


def _method_columns(head: str, of: Callable[[Line], Recognised | None]) -> tuple[Column[Line], ...]:
    def angle(line: Line) -> str | None:
        found = of(line)
        return None if found is None else text(found.angle)

    def rate(line: Line) -> float | None:
        found = of(line)
        return None if found is None else found.rate

    return Column(f"{head} angle, °", angle), Column(f"{head} rate, %", rate, "{:.1f}")


def _whole_columns(head: str, of: Callable[[Line], Recognised | None]) -> tuple[Column[Line], ...]:
    """A conventional method: places, a detection rate that it has not, angle and rate."""

    def places(line: Line) -> Places | None:
        found = of(line)
        return None if found is None else found.places

    detection: Column[Line] = Column(f"{head} detection, %", lambda line: "NA")
    return (*_place_columns(head, places), detection, *_method_columns(head, of))


FOUND: Column[Line] = Column("detection, %", lambda line: line.found, "{:.1f}")
BEFORE = _place_columns("saliency", lambda line: line.before)
AFTER = _place_columns("+ shadow", lambda line: line.after)
ORIGIN = _place_columns("origin by recognition", lambda line: line.part)
SIFT = _method_columns("SIFT", lambda line: line.sift)
SHAPE = _method_columns("shape", lambda line: line.shape)
WHOLE_SIFT = _whole_columns("SIFT", lambda line: line.conventional_sift)
WHOLE_SHAPE = _whole_columns("shape", lambda line: line.conventional_shape)

NOTES = """\
Rows "paper" are the paper's, under the numbers of its tables; all others are ours, without the oblique scenes but for
the scenario of that name. The paper gives places in cm in tables 4 and 6 to 8, and in mm in its tables A.1 and A.2:
here all are in mm. The angles of its table 5 are headed "(%)", those of its tables 6 to 8 "(deg)": they are taken for
degrees. Its sets are pictures of several objects, placed five times each; its objects are six parts, placed 20 times.
Errors are mean ± standard deviation.

Our places by saliency and shadow are centroids against those of the visible masks; by recognition, in the conventional
methods too, they are those of the parts' origins. SIFT counts textured parts only. The conventional methods detect
nothing beforehand (NA): their rates are over all parts, in the catalogue, of the scenes that they were run on."""


def paper_tables(scenes: Sequence[Measured]) -> str:
    """All tables as Markdown."""
    straight = upright(scenes)
    sets = [(f"paper, {row.name}", Line.of_paper(row)) for row in paper.SETS]
    sets += [(name, _line(group)) for name, group in grouped(scenes, "scenario")]
    sets += [("all but oblique", _line(straight))] if straight else []
    objects = [(f"paper, {row.name}", Line.of_paper(row)) for row in paper.OBJECTS]
    objects += part_lines(straight)
    # The columns of every table are in the order of the paper.
    return "\n".join(
        [
            NOTES,
            "\n### Table 4: places, by sets\n",
            markdown_table("objects", (*BEFORE, *AFTER, FOUND), sets),
            "\n### Table 5: recognition in salient regions, by sets\n",
            markdown_table("objects", (*SIFT, *SHAPE), sets),
            "\n### Table 6: the conventional methods, by sets\n",
            markdown_table("objects", (*WHOLE_SIFT, *WHOLE_SHAPE), sets),
            "\n### Table 7: places and recognition, by objects\n",
            markdown_table("part", (*BEFORE, *AFTER, FOUND, *SHAPE, *SIFT, *ORIGIN), objects),
            "\n### Table 8: the conventional methods, by objects\n",
            markdown_table("part", (*WHOLE_SHAPE, *WHOLE_SIFT), objects),
            "\n### Table 9: times in ms a pixel\n",
            _times(straight),
        ]
    )


def _line(scenes: Sequence[Measured]) -> Line:
    parts = [part for scene in scenes for part in scene.objects.parts]
    return Line.of_ours(PartFigures.of(parts), RecognitionFigures.of(recognised(scenes)))


def part_lines(scenes: Sequence[Measured]) -> list[tuple[str, Line]]:
    """A line for every kind of part in some scenes."""
    parts = [part for scene in scenes for part in scene.objects.parts]
    naming = recognised(scenes)
    return [
        (name, Line.of_ours(PartFigures.of(group), RecognitionFigures.of(naming, part=name)))
        for name, group in group_by(parts, "part")
    ]


def times(scenes: Sequence[Measured]) -> Times:
    """Means over some scenes in ms a pixel, as the paper's; those of the conventional methods where they were run."""

    def a_pixel(ms: Callable[[Measured], float | None]) -> float | None:
        values = [(ms(scene), scene.recognition) for scene in scenes]
        return mean([value / named.pixels for value, named in values if value is not None and named is not None])

    def method(name: str) -> Callable[[Measured], float | None]:
        def ms(scene: Measured) -> float | None:
            score = scene.recognition.methods.get(name) if scene.recognition else None
            return None if score is None else score.ms

        return ms

    return Times(
        saliency=a_pixel(lambda scene: sum(scene.timings_ms[stage] for stage in ("segment", "saliency", "regions"))),
        shadow=a_pixel(lambda scene: scene.timings_ms["shadow"]),
        sift=a_pixel(method("sift")),
        shape=a_pixel(method("shape")),
        conventional_sift=a_pixel(method("conventional_sift")),
        conventional_shape=a_pixel(method("conventional_shape")),
    )


TIME_COLUMNS: tuple[Column[Times], ...] = (
    Column("saliency", lambda t: t.saliency, "{:.3g}"),
    Column("shadow", lambda t: t.shadow, "{:.3g}"),
    Column("SIFT", lambda t: t.sift, "{:.3g}"),
    Column("shape", lambda t: t.shape, "{:.3g}"),
    Column("total with SIFT", lambda t: t.with_sift, "{:.3g}"),
    Column("total with shape", lambda t: t.with_shape, "{:.3g}"),
    Column("conventional SIFT", lambda t: t.conventional_sift, "{:.3g}"),
    Column("conventional shape", lambda t: t.conventional_shape, "{:.3g}"),
    Column("SIFT, ours : conventional", lambda t: t.sift_ratio, "{:.3g}"),
    Column("shape, ours : conventional", lambda t: t.shape_ratio, "{:.3g}"),
)


def _times(scenes: Sequence[Measured]) -> str:
    """Table 9; ratios compare times of the same scenes."""
    both = [s for s in scenes if s.recognition and "conventional_shape" in s.recognition.methods]
    rows = [("paper", paper.TIMES)]
    if both:
        rows.append((f"{len(both)} scenes with conventional methods", times(both)))
    others = [scene for scene in scenes if scene not in both]
    if others:
        rows.append((f"{len(others)} other scenes", times(others)))
    pixels = [scene.recognition.pixels for scene in scenes if scene.recognition]
    size = f"Means over scenes of {statistics.median(pixels):.0f} pixels; " if pixels else "Means over scenes; "
    note = (
        "\n\nAt 1 ms a pixel a frame of 1078 x 958 takes 17 minutes. "
        + size
        + "saliency: segmentation, saliency and regions. The paper's machine was an Intel i5 at 3.3 GHz with Matlab."
    )
    return markdown_table("", TIME_COLUMNS, rows) + note
