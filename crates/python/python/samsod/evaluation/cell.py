"""Measures the salient regions of robot-cell scenes against parts and cast shadows.

A part is *found* when one region covers at least half of its visible pixels, and *cut* when the partitions that lie
mostly on part or shadow do: no choice of regions can find a part that the segmentation has not cut from the table.
A region is *spurious* when it touches neither a part nor a cast shadow.
"""

from __future__ import annotations

import csv
import statistics
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path

import numpy as np
import numpy.typing as npt

import samsod
from samsod.evaluation import metrics
from samsod.evaluation.data import SceneData, SceneInfo
from samsod.evaluation.objects import DETECTED_SHARE, Separated
from samsod.evaluation.tables import Column, group_by, markdown_table


@dataclass(frozen=True)
class Inspection:
    """What the chain says of one frame.

    Attributes:
        labels: partition of every pixel, uint32 (H, W).
        means: mean colour of each partition, float32 (N, 3).
        saliency: float32 (H, W) in [0, 1].
        regions: the partitions of each salient region.
        timings_ms: wall-clock time of each stage.
        centroids: centroid (x, y) of each salient region, in px.
        objects: the objects cut from the regions, with `object_side` "evidence" (or as configured).
        native_objects: the same as `objects`, as the recognition takes them.
        native_partition, native_regions: of the cell, for the recognition in regions without an object.
        paper_objects: the same with `object_side` "paper".
        exact_difference: mean |S_fast - S_exact|, when measured.
        exact_same: whether both methods make the same partitions salient, when measured.
    """

    labels: npt.NDArray[np.uint32]
    means: npt.NDArray[np.float32]
    saliency: npt.NDArray[np.float32]
    regions: list[list[int]]
    timings_ms: dict[str, float]
    centroids: list[tuple[float, float]] = field(default_factory=list)
    objects: Sequence[Separated] = ()
    native_objects: Sequence[samsod.ObjectRegion] = ()
    native_partition: samsod.Partition | None = None
    native_regions: Sequence[samsod.SalientRegion] = ()
    paper_objects: Sequence[Separated] = ()
    exact_difference: float | None = None
    exact_same: bool | None = None


@dataclass(frozen=True)
class SceneScore:
    """The figures of one scene; counts unless the name says otherwise."""

    scene: str
    scenario: str
    table: str
    lighting: str
    parts: int
    found: int
    cut: int
    merged: int
    partitions: int
    regions: int
    spurious: int
    iou: float
    bound_iou: float
    precision: float
    recall: float
    segment_ms: float
    saliency_ms: float
    regions_ms: float
    shadow_ms: float
    exact_difference: float | None = None
    exact_same: bool | None = None
    missed_ids: list[int] = field(default_factory=list)
    missed_parts: list[str] = field(default_factory=list)

    @property
    def oblique(self) -> bool:
        """Whether the scene is seen at a slant."""
        return self.scenario == "oblique"

    @property
    def badness(self) -> float:
        """Order of the contact sheets: missed parts weigh most, then spurious regions, then overlap."""
        return 2.0 * (self.parts - self.found) + min(self.spurious, 20) * 0.5 + (1.0 - self.iou)


def score_scene(info: SceneInfo, data: SceneData, result: Inspection) -> SceneScore:
    """Compares the chain's result on one scene with the truth."""
    region_image = metrics.region_image(result.labels, result.regions)
    truth = data.truth
    best = metrics.majority_partitions(result.labels, truth)
    coverage = metrics.part_coverage(data.parts, region_image)
    cut = metrics.covered_share(data.parts, best)
    missed = [part for part, share in coverage.items() if share < DETECTED_SHARE]
    precision, recall = metrics.precision_recall(region_image > 0, truth)
    return SceneScore(
        scene=info.name,
        scenario=info.scenario,
        table=info.table,
        lighting=info.lighting,
        parts=len(coverage),
        found=len(coverage) - len(missed),
        cut=sum(share >= DETECTED_SHARE for share in cut.values()),
        merged=metrics.merged_parts(data.parts, region_image, DETECTED_SHARE),
        partitions=len(result.means),
        regions=len(result.regions),
        spurious=len(metrics.spurious_regions(region_image, truth)),
        iou=metrics.iou(region_image > 0, truth),
        bound_iou=metrics.iou(best, truth),
        precision=precision,
        recall=recall,
        segment_ms=result.timings_ms["segment"],
        saliency_ms=result.timings_ms["saliency"],
        regions_ms=result.timings_ms["regions"],
        shadow_ms=result.timings_ms["shadow"],
        exact_difference=result.exact_difference,
        exact_same=result.exact_same,
        missed_ids=missed,
        missed_parts=[data.names.get(part, f"#{part}") for part in missed],
    )


def _percent(part: int, whole: int) -> float:
    return 100.0 * part / whole if whole else 100.0


COLUMNS: tuple[Column[Sequence[SceneScore]], ...] = (
    Column("scenes", len, "{:.0f}"),
    Column("parts", lambda s: sum(x.parts for x in s), "{:.0f}"),
    Column("found %", lambda s: _percent(sum(x.found for x in s), sum(x.parts for x in s)), "{:.1f}"),
    Column("cut %", lambda s: _percent(sum(x.cut for x in s), sum(x.parts for x in s)), "{:.1f}"),
    Column("merged %", lambda s: _percent(sum(x.merged for x in s), sum(x.parts for x in s)), "{:.1f}"),
    Column("spurious", lambda s: statistics.fmean(x.spurious for x in s), "{:.2f}"),
    Column("IoU", lambda s: statistics.fmean(x.iou for x in s), "{:.3f}"),
    Column("bound IoU", lambda s: statistics.fmean(x.bound_iou for x in s), "{:.3f}"),
    Column("precision", lambda s: statistics.fmean(x.precision for x in s), "{:.3f}"),
    Column("recall", lambda s: statistics.fmean(x.recall for x in s), "{:.3f}"),
    Column("partitions", lambda s: statistics.fmean(x.partitions for x in s), "{:.0f}"),
    Column("segment ms", lambda s: statistics.median(x.segment_ms for x in s), "{:.1f}"),
    Column("saliency ms", lambda s: statistics.median(x.saliency_ms for x in s), "{:.1f}"),
    Column("regions ms", lambda s: statistics.median(x.regions_ms for x in s), "{:.2f}"),
    Column("shadow ms", lambda s: statistics.median(x.shadow_ms for x in s), "{:.2f}"),
)

LEGEND = f"""\
found: parts covered to {DETECTED_SHARE:.0%} or more by one salient region; cut: parts that the partitions lying
mostly on part or shadow cover so, the bound that the segmentation sets; merged: parts whose region also covers
another part; spurious: regions a scene that touch neither a part nor a cast shadow; IoU, precision and recall:
salient pixels against part-plus-shadow pixels, mean over scenes; bound IoU: the same for the partitions that lie
mostly on part or shadow; times: median over scenes."""


def table(head: str, groups: Iterable[tuple[str, Sequence[SceneScore]]]) -> str:
    """Formats one table, a row for each group that has scenes."""
    return markdown_table(head, COLUMNS, [(name, scores) for name, scores in groups if scores])


def _exact_section(scores: Sequence[SceneScore]) -> str:
    measured = [s for s in scores if s.exact_difference is not None]
    if not measured:
        return ""
    differences = [s.exact_difference or 0.0 for s in measured]
    same = sum(bool(s.exact_same) for s in measured)
    return (
        "\n### Fast against exact saliency\n\n"
        f"Mean absolute difference of S: {statistics.fmean(differences):.5f} (worst scene {max(differences):.5f}). "
        f"Same set of salient partitions in {same} of {len(measured)} scenes ({_percent(same, len(measured)):.1f} %).\n"
    )


def report(scores: Sequence[SceneScore]) -> str:
    """The tables of the salient regions as Markdown."""
    straight = [s for s in scores if not s.oblique]
    oblique = [s for s in scores if s.oblique]
    parts = ["## Salient regions\n", LEGEND, ""]
    parts.append(table("view", [("not oblique", straight), ("oblique", oblique)]))
    for key in ("table", "lighting", "scenario"):
        if straight:
            parts.append(f"\n### By {key} (without the oblique scenes)\n")
            parts.append(table(key, group_by(straight, key)))
    exact = _exact_section(scores)
    if exact:
        parts.append(exact)
    missed = [s for s in scores if s.missed_parts]
    if missed:
        parts.append("\n### Missed parts\n")
        parts += [f"- {s.scene} ({s.table}, {s.lighting}, {s.scenario}): {', '.join(s.missed_parts)}" for s in missed]
    return "\n".join(parts) + "\n"


def write_csv(scores: Sequence[SceneScore], path: Path) -> None:
    """Writes one line per scene; lists are joined by spaces."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [f.name for f in fields(SceneScore)])
        writer.writeheader()
        for score in scores:
            row = asdict(score)
            row["missed_ids"] = " ".join(map(str, score.missed_ids))
            row["missed_parts"] = " ".join(score.missed_parts)
            writer.writerow({k: f"{v:.5f}" if isinstance(v, float) else v for k, v in row.items()})
