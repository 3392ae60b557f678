"""Saliency on robot-cell scenes: the verb `saliency-cell`.

What the paper's figures show before and after shadows are separated, as masks: the salient regions, which is S > 0 made
robust, against parts with their cast shadows; and the objects cut from them against the parts alone. Beside them maps
at twice their mean, against parts with shadows: that of the cell (`fast`) and that of still photos.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from tqdm import tqdm

import samsod
from samsod.evaluation import metrics
from samsod.evaluation.catalogue import find_sources, read_sources, write_catalogue
from samsod.evaluation.chain import true_camera
from samsod.evaluation.data import SceneData, SceneInfo, find_split, list_scenes, load_scene
from samsod.evaluation.output import OutputFolder
from samsod.evaluation.saliency.metrics import Counts, Sweep, adaptive_threshold, f_measure, levels
from samsod.evaluation.spread import mean
from samsod.evaluation.tables import Column, markdown_table

FILE = "saliency-cell.md"


@dataclass(frozen=True)
class CellScene:
    """F of one scene.

    Attributes:
        oblique: whether it is seen at a slant.
        before: of the salient regions against parts and cast shadows.
        bound: of the partitions that lie mostly on part or shadow, which no choice of partitions can better by much.
        after: of the objects against the parts.
        settled: the same after recognition; None without templates.
        fast, background: of the maps at twice the mean, against parts and cast shadows.
    """

    oblique: bool
    before: float
    bound: float
    after: float
    settled: float | None
    fast: float
    background: float


def mask_f(found: metrics.Mask, truth: metrics.Mask) -> float:
    """Eq 17 of a mask."""
    return f_measure(*metrics.precision_recall(found, truth))


def map_f(saliency: np.ndarray[tuple[int, ...], np.dtype[np.float32]], truth: metrics.Mask) -> float:
    """Eq 17 of a map at twice its mean."""
    of = levels(saliency)
    return float(Sweep.of(Counts.of(of, truth), Counts.of(of, ~truth)).f[adaptive_threshold(of)])


def _union(objects: Sequence[samsod.ObjectRegion], shape: tuple[int, ...]) -> metrics.Mask:
    mask = np.zeros(shape, dtype=np.bool_)
    for found in objects:
        mask |= found.mask
    return mask


def score_cell_scene(
    cell: samsod.Cell, recognizer: samsod.Recognizer | None, info: SceneInfo, data: SceneData
) -> CellScene:
    """Measures one scene; without a recogniser nothing is settled."""
    scene = cell.inspect(data.rgb)
    regions = metrics.region_image(scene.partition.labels, [region.partitions for region in scene.regions])
    settled = None
    if recognizer is not None:
        camera = true_camera(info, data)
        said = recognizer.recognize(data.rgb, scene.objects, camera, partition=scene.partition, regions=scene.regions)
        objects, _ = samsod.settle_objects(scene.objects, said)
        settled = mask_f(_union(objects, data.parts.shape), data.parts > 0)
    best = metrics.majority_partitions(scene.partition.labels, data.truth)
    return CellScene(
        oblique=info.oblique,
        before=mask_f(regions > 0, data.truth),
        bound=mask_f(best, data.truth),
        after=mask_f(_union(scene.objects, data.parts.shape), data.parts > 0),
        settled=settled,
        fast=map_f(scene.saliency, data.truth),
        background=map_f(samsod.saliency(data.rgb), data.truth),
    )


def _mean(value: Callable[[CellScene], float]) -> Callable[[Sequence[CellScene]], float]:
    return lambda scenes: statistics.fmean(value(scene) for scene in scenes)


COLUMNS: tuple[Column[Sequence[CellScene]], ...] = (
    Column("scenes", len, "{}"),
    Column("F of regions, parts and shadows", _mean(lambda scene: scene.before), "{:.3f}"),
    Column("bound of the partitions", _mean(lambda scene: scene.bound), "{:.3f}"),
    Column("F of objects, parts", _mean(lambda scene: scene.after), "{:.3f}"),
    Column("after recognition", lambda scenes: mean([s.settled for s in scenes if s.settled is not None]), "{:.3f}"),
    Column("F of the map `fast`", _mean(lambda scene: scene.fast), "{:.3f}"),
    Column("F of the map `background`", _mean(lambda scene: scene.background), "{:.3f}"),
)


def run_saliency_cell(arguments: argparse.Namespace) -> int:
    """The verb `saliency-cell`."""
    folder = find_split(arguments.dir, arguments.split)
    scenes = list_scenes(folder)
    sources = find_sources(folder)
    cell = samsod.Cell()
    out = OutputFolder(arguments.out, [FILE]) if arguments.out else None
    measured = []
    with TemporaryDirectory(prefix="samsod-catalogue-") as parts:
        recognizer = None
        if sources is not None:
            first = load_scene(scenes[0], 1.0).parts
            templates = read_sources(*sources, (first.shape[1], first.shape[0]))
            recognizer = samsod.Recognizer(write_catalogue(Path(parts), templates), "best")
        for info in tqdm(scenes, unit="scene", file=sys.stderr, mininterval=0.1 if sys.stderr.isatty() else 10.0):
            measured.append(score_cell_scene(cell, recognizer, info, load_scene(info, arguments.scale)))
    views = [("not oblique", False), ("oblique", True)]
    groups = [(name, [scene for scene in measured if scene.oblique == oblique]) for name, oblique in views]
    text = markdown_table("view", COLUMNS, [(name, of) for name, of in groups if of]) + "\n"
    if out:
        (out / FILE).write_text(text, encoding="utf-8")
    print(text)
    return 0
