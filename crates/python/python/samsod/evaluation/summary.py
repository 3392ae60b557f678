"""Figures of groups of scenes, and `summary.json`.

    {"scenes": n,
     "detection": {"parts", "found", "rate", "spurious_per_scene"},
     "objects": {"iou", "iou_paper_side", "shadow_recall", "object_loss", "missing",
                 "iou_recognised", "shadow_recall_recognised", "object_loss_recognised", "missing_recognised"},
     "recognition": {"shape", "sift_textured", "best", "false_names", "false_names_by_method": {method}},
     "angle_deg": {"shape", "sift"},
     "place_mm": {"before": {"x", "y"}, "after": {"x", "y"}, "recognised": {"x", "y"}, "part": {"x", "y"}},
     "timings_ms": {stage: median},
     "by": {"table" | "lighting" | "scenario": {value: the same groups}},
     "calibration": see `samsod.evaluation.calibration`, or null}

The overall figures and those by table and by lighting leave the oblique scenes out; under `by` they are the scenario
"oblique". Rates are shares in 0..1. `iou` and `iou_paper_side` are means over detected parts, `place_mm` mean
absolute errors over the detected parts that have the place; `missing` counts the detected parts without an object
(IoU 0, no place after). `shadow_recall` and `object_loss` weigh every pixel alike. All these are of the separation
alone, which knows no catalogue; those with `recognised` are the same of the objects after the parts that "best"
recognised have settled them.

Recognition rates are shares of the detected parts that are in the catalogue (`sift_textured`: those of them that are
textured) which got the right name; `false_names` the share of the detected parts that are not in it which got any, by
the method "best". `angle_deg` are mean errors of the parts with the right name, modulo their symmetry, and
`place_mm.part` mean absolute errors of the origins of those named by "best".

Times are medians over scenes; that of the stage "recognize" is the time of "best". A figure that nothing was measured
for is null.
"""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from samsod.evaluation.cell import SceneScore
from samsod.evaluation.objects import ObjectScore, PartScore, ShadowCount
from samsod.evaluation.recognition import METHODS, RecognitionScore
from samsod.evaluation.recognition_figures import RecognitionFigures
from samsod.evaluation.spread import Spread, absolute, mean, mean_of, share
from samsod.evaluation.tables import group_by

GROUPS = ("table", "lighting", "scenario")


@dataclass(frozen=True)
class Measured:
    """One scene: its regions, its objects, the time of every stage of the chain in ms, and what its objects are.

    The times are without that of the recognition, which is measured for each method; it is None without a catalogue,
    and so are the objects after recognition, `settled`.
    """

    score: SceneScore
    objects: ObjectScore
    timings_ms: dict[str, float]
    recognition: RecognitionScore | None = None
    settled: ObjectScore | None = None

    @property
    def table(self) -> str:
        """Kind of table."""
        return self.score.table

    @property
    def lighting(self) -> str:
        """Kind of light."""
        return self.score.lighting

    @property
    def scenario(self) -> str:
        """Kind of scene."""
        return self.score.scenario

    @property
    def oblique(self) -> bool:
        """Whether the camera looks at a slant."""
        return self.score.oblique


@dataclass(frozen=True)
class PartFigures:
    """Figures of a set of parts; absolute errors of places in mm.

    Attributes:
        parts: all with a visible pixel.
        found: those detected.
        merged: those detected whose region also covers another part.
        missing: those detected without an object.
        iou, paper_iou: mean over those detected.
        before_x, before_y, after_x, after_y: over those detected that have the place.
    """

    parts: int
    found: int
    merged: int
    missing: int
    iou: float | None
    paper_iou: float | None
    before_x: Spread | None
    before_y: Spread | None
    after_x: Spread | None
    after_y: Spread | None

    @staticmethod
    def of(parts: Sequence[PartScore]) -> PartFigures:
        """The figures of some parts."""
        before = [part.before_mm for part in parts if part.before_mm is not None]
        after = [part.after_mm for part in parts if part.after_mm is not None]
        return PartFigures(
            parts=len(parts),
            found=sum(part.detected for part in parts),
            merged=sum(part.merged for part in parts),
            missing=sum(part.lacks_object for part in parts),
            iou=mean([part.iou for part in parts if part.iou is not None]),
            paper_iou=mean([part.paper_iou for part in parts if part.paper_iou is not None]),
            before_x=Spread.of(absolute(before, 0)),
            before_y=Spread.of(absolute(before, 1)),
            after_x=Spread.of(absolute(after, 0)),
            after_y=Spread.of(absolute(after, 1)),
        )


@dataclass(frozen=True)
class Figures:
    """Figures of a group of scenes; rates in 0..1, times in ms.

    Attributes:
        scenes: how many.
        spurious: regions a scene that touch neither part nor cast shadow.
        of_parts: what is counted over parts.
        shadow_recall, object_loss: shares of true pixels inside salient regions that are labelled shadow.
        paper_shadow_recall, paper_object_loss: the same with `object_side` "paper".
        timings_ms: median of every stage; that of the recognition None when it was not measured.
        recognition: names, angles and places of the parts; None when they were not measured.
        settled: what is counted over parts, of the objects after recognition; None when they were not measured.
        settled_shadow_recall, settled_object_loss: the shares after recognition.
    """

    scenes: int
    spurious: float | None
    of_parts: PartFigures
    shadow_recall: float | None
    object_loss: float | None
    paper_shadow_recall: float | None
    paper_object_loss: float | None
    timings_ms: dict[str, float | None]
    recognition: RecognitionFigures | None
    settled: PartFigures | None = None
    settled_shadow_recall: float | None = None
    settled_object_loss: float | None = None

    @staticmethod
    def of(scenes: Sequence[Measured]) -> Figures:
        """The figures of some scenes."""
        shadow = total(scene.objects.shadow for scene in scenes)
        paper = total(scene.objects.paper_shadow for scene in scenes)
        named = recognised(scenes)
        settled = [scene.settled for scene in scenes if scene.settled is not None]
        settled_shadow = total(score.shadow for score in settled)
        recognition = RecognitionFigures.of(named) if named else None
        timings_ms: dict[str, float | None] = {
            stage: statistics.median(scene.timings_ms[stage] for scene in scenes)
            for stage in (scenes[0].timings_ms if scenes else {})
        }
        if scenes:
            timings_ms["recognize"] = recognition.methods["best"].ms if recognition else None
        return Figures(
            scenes=len(scenes),
            spurious=mean([float(scene.score.spurious) for scene in scenes]),
            of_parts=PartFigures.of([part for scene in scenes for part in scene.objects.parts]),
            shadow_recall=share(shadow.shadow_found_px, shadow.shadow_px),
            object_loss=share(shadow.object_lost_px, shadow.object_px),
            paper_shadow_recall=share(paper.shadow_found_px, paper.shadow_px),
            paper_object_loss=share(paper.object_lost_px, paper.object_px),
            timings_ms=timings_ms,
            recognition=recognition,
            settled=PartFigures.of([part for score in settled for part in score.parts]) if settled else None,
            settled_shadow_recall=share(settled_shadow.shadow_found_px, settled_shadow.shadow_px),
            settled_object_loss=share(settled_shadow.object_lost_px, settled_shadow.object_px),
        )

    def groups(self) -> dict[str, Any]:
        """The groups of `summary.json`."""
        parts = self.of_parts
        settled = PartFigures.of([]) if self.settled is None else self.settled
        naming = RecognitionFigures.of([]) if self.recognition is None else self.recognition
        best = naming.methods["best"]
        return {
            "scenes": self.scenes,
            "detection": {
                "parts": parts.parts,
                "found": parts.found,
                "rate": share(parts.found, parts.parts),
                "spurious_per_scene": self.spurious,
            },
            "objects": {
                "iou": parts.iou,
                "iou_paper_side": parts.paper_iou,
                "shadow_recall": self.shadow_recall,
                "object_loss": self.object_loss,
                "missing": parts.missing,
                "iou_recognised": settled.iou,
                "shadow_recall_recognised": self.settled_shadow_recall,
                "object_loss_recognised": self.settled_object_loss,
                "missing_recognised": None if self.settled is None else settled.missing,
            },
            "recognition": {
                "shape": naming.methods["shape"].rate,
                "sift_textured": naming.sift_textured.rate,
                "best": best.rate,
                "false_names": best.false_name_rate,
                "false_names_by_method": {method: naming.methods[method].false_name_rate for method in METHODS},
            },
            "angle_deg": {method: mean_of(naming.methods[method].angle) for method in ("shape", "sift")},
            "place_mm": {
                "before": {"x": mean_of(parts.before_x), "y": mean_of(parts.before_y)},
                "after": {"x": mean_of(parts.after_x), "y": mean_of(parts.after_y)},
                "recognised": {"x": mean_of(settled.after_x), "y": mean_of(settled.after_y)},
                "part": {"x": mean_of(best.x), "y": mean_of(best.y)},
            },
            "timings_ms": self.timings_ms,
        }


def total(counts: Iterable[ShadowCount]) -> ShadowCount:
    """Sum of pixel counts."""
    rows = [(c.shadow_px, c.shadow_found_px, c.object_px, c.object_lost_px) for c in counts]
    return ShadowCount(*(sum(column) for column in zip(*rows, strict=True))) if rows else ShadowCount(0, 0, 0, 0)


def recognised(scenes: Sequence[Measured]) -> list[RecognitionScore]:
    """The recognition of the scenes for which it was measured."""
    return [scene.recognition for scene in scenes if scene.recognition is not None]


def upright(scenes: Sequence[Measured]) -> list[Measured]:
    """The scenes that are not oblique."""
    return [scene for scene in scenes if not scene.oblique]


def grouped(scenes: Sequence[Measured], key: str) -> list[tuple[str, list[Measured]]]:
    """Scenes by table, lighting or scenario; the oblique ones only as a scenario of their own."""
    return group_by(scenes if key == "scenario" else upright(scenes), key)


def summary(scenes: Sequence[Measured]) -> dict[str, Any]:
    """The content of `summary.json`, but for the calibration."""
    return {
        **Figures.of(upright(scenes)).groups(),
        "by": {key: {value: Figures.of(group).groups() for value, group in grouped(scenes, key)} for key in GROUPS},
    }
