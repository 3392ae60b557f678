"""Rates and errors of the recognition over groups of scenes and parts."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from samsod.evaluation.recognition import CONVENTIONAL, METHODS, MethodScore, NamedPart, RecognitionScore
from samsod.evaluation.spread import Spread, absolute, share


@dataclass(frozen=True)
class MethodFigures:
    """What one method reaches.

    Attributes:
        scenes: in how many it was run.
        parts: those that count: in the catalogue, and detected unless the method is a conventional one.
        right, wrong, unknown, nothing: how many of them had that outcome.
        others: detected parts that are not in the catalogue.
        false_names: those of them that got a name.
        angle: angle errors of the right ones in degrees.
        x, y: absolute place errors of the right ones in mm.
        spurious, doubles: named detections on no part, and on parts that have another one.
        ms: median time over scenes.
    """

    scenes: int
    parts: int
    right: int
    wrong: int
    unknown: int
    nothing: int
    others: int
    false_names: int
    angle: Spread | None
    x: Spread | None
    y: Spread | None
    spurious: int
    doubles: int
    ms: float | None

    @property
    def rate(self) -> float | None:
        """Share of the parts that got the right name, in [0, 1]."""
        return share(self.right, self.parts)

    @property
    def false_name_rate(self) -> float | None:
        """Share of the parts that are not in the catalogue that got a name, in [0, 1]."""
        return share(self.false_names, self.others)

    @staticmethod
    def of(
        method: str, scores: Sequence[MethodScore], part: str | None = None, textured: bool = False
    ) -> MethodFigures:
        """The figures of some scenes.

        Args:
            method: one of `METHODS` or `CONVENTIONAL`.
            scores: of that method.
            part: only parts, and detections, of this name.
            textured: only textured parts.
        """
        parts = counted(method, scores, part, textured)
        counts = [named for named in parts if named.known]
        others = [named for named in parts if not named.known]
        errors = [named.error_mm for named in counts if named.error_mm is not None]

        def strays(kind: str) -> int:
            return sum(part in (None, stray.called) for score in scores for stray in getattr(score, kind))

        return MethodFigures(
            scenes=len(scores),
            parts=len(counts),
            right=sum(named.outcome == "right" for named in counts),
            wrong=sum(named.outcome == "wrong" for named in counts),
            unknown=sum(named.outcome == "unknown" for named in counts),
            nothing=sum(named.outcome == "nothing" for named in counts),
            others=len(others),
            false_names=sum(named.outcome == "wrong" for named in others),
            angle=Spread.of([named.angle_error_deg for named in counts if named.angle_error_deg is not None]),
            x=Spread.of(absolute(errors, 0)),
            y=Spread.of(absolute(errors, 1)),
            spurious=strays("spurious"),
            doubles=strays("doubles"),
            ms=statistics.median(score.ms for score in scores) if scores else None,
        )


@dataclass(frozen=True)
class RecognitionFigures:
    """What the methods reach.

    Attributes:
        methods: all of `METHODS` and `CONVENTIONAL`; the latter of the scenes in which they were run.
        sift_textured, conventional_sift_textured: SIFT over textured parts alone.
    """

    methods: Mapping[str, MethodFigures]
    sift_textured: MethodFigures
    conventional_sift_textured: MethodFigures

    @staticmethod
    def of(scenes: Sequence[RecognitionScore], part: str | None = None) -> RecognitionFigures:
        """The figures of some scenes; with `part` of the parts, and detections, of that name only."""
        by_method = {method: scores_of(scenes, method) for method in (*METHODS, *CONVENTIONAL)}
        figures = {method: MethodFigures.of(method, scores, part) for method, scores in by_method.items()}
        sift, conventional = (
            MethodFigures.of(method, by_method[method], part, textured=True) for method in ("sift", "conventional_sift")
        )
        return RecognitionFigures(figures, sift, conventional)


def scores_of(scenes: Sequence[RecognitionScore], method: str) -> list[MethodScore]:
    """The scores of one method, of the scenes in which it was run."""
    return [scene.methods[method] for scene in scenes if method in scene.methods]


def counted(
    method: str, scores: Sequence[MethodScore], part: str | None = None, textured: bool = False
) -> list[NamedPart]:
    """The parts that count: the detected ones; all for the conventional methods, which detect nothing beforehand."""
    return [
        named
        for score in scores
        for named in score.parts
        if (named.detected or method in CONVENTIONAL)
        and part in (None, named.part)
        and (named.textured or not textured)
    ]
