"""Runs samsod's vision chain on scenes and scores what it says."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

import samsod
from samsod.evaluation import metrics
from samsod.evaluation.cell import Inspection, score_scene
from samsod.evaluation.data import DataError, SceneData, SceneInfo
from samsod.evaluation.objects import FoundObject, Separated, score_objects
from samsod.evaluation.recognizing import Recognition
from samsod.evaluation.summary import Measured


def inspect(
    cell: samsod.Cell, data: SceneData, repeat: int = 1, exact: samsod.Cell | None = None, paper: bool = False
) -> Inspection:
    """Runs the chain on one scene; with `repeat` > 1 the times are medians.

    Args:
        cell: the chain to measure.
        data: the scene.
        repeat: number of runs.
        exact: the same chain with the exact saliency, to compare with.
        paper: separate the shadows of the same regions by the paper's rule, too.
    """
    scenes = [cell.inspect(data.rgb) for _ in range(repeat)]
    scene = scenes[-1]
    stages = scene.timings_ms
    timings = {stage: float(np.median([s.timings_ms[stage] for s in scenes])) for stage in stages}
    difference, same = None, None
    if exact is not None:
        reference = exact.inspect(data.rgb)
        if not np.array_equal(reference.partition.labels, scene.partition.labels):
            raise ValueError("two runs of the segmentation differ; fast and exact saliency cannot be compared")
        difference = metrics.mean_absolute_difference(scene.saliency, reference.saliency)
        same = salient_partitions(scene) == salient_partitions(reference)
    regions = scene.regions
    paper_objects: Sequence[Separated] = ()
    if paper:
        separated = samsod.separate_shadows(data.rgb, scene.partition, scene.saliency, regions, object_side="paper")
        paper_objects = [FoundObject.of(each) for each in separated]
    return Inspection(
        labels=scene.partition.labels,
        means=scene.partition.means,
        saliency=scene.saliency,
        regions=[region.partitions for region in regions],
        timings_ms=timings,
        centroids=[region.centroid for region in regions],
        objects=[FoundObject.of(each) for each in scene.objects],
        native_objects=scene.objects,
        native_partition=scene.partition,
        native_regions=regions,
        paper_objects=paper_objects,
        exact_difference=difference,
        exact_same=same,
    )


def measure(
    cell: samsod.Cell,
    info: SceneInfo,
    data: SceneData,
    repeat: int = 1,
    exact: samsod.Cell | None = None,
    recognition: Recognition | None = None,
    conventional: bool = False,
) -> Measured:
    """Runs the chain on one scene and compares everything with the truth.

    Args:
        cell, data, repeat, exact: as those of `inspect`.
        info: the scene.
        recognition: the methods that say what the objects are; None: that is not measured.
        conventional: run the conventional methods over the whole frame, too.

    Raises:
        DataError: the scene has no camera, one that no camera can be, or does not say how its parts lie.
    """
    result = inspect(cell, data, repeat, exact, paper=True)
    camera = true_camera(info, data)
    regions = metrics.region_image(result.labels, result.regions)
    objects = score_objects(info, data, camera, regions, result.centroids, result.objects, result.paper_objects)
    naming = after = None
    if recognition is not None:
        detected = [part.id for part in objects.parts if part.detected]
        naming, settled = recognition.measure(
            info,
            data,
            camera,
            result.native_objects,
            detected,
            repeat,
            conventional,
            partition=result.native_partition,
            regions=result.native_regions,
        )
        found = [FoundObject.of(each) for each in settled]
        after = score_objects(info, data, camera, regions, result.centroids, found, [])
    # The cell names nothing: its recognition is measured by itself.
    timings_ms = {stage: ms for stage, ms in result.timings_ms.items() if stage != "recognize"}
    return Measured(score_scene(info, data, result), objects, timings_ms, naming, after)


def true_camera(info: SceneInfo, data: SceneData) -> samsod.Camera:
    """The camera that a scene was rendered with.

    Raises:
        DataError: the scene has none, or one that no camera can be.
    """
    if data.camera is None:
        raise DataError(f"{info.files['gt']}: no camera")
    height, width = data.parts.shape
    try:
        return samsod.Camera(
            data.camera.matrix,
            data.camera.distortion,
            (width, height),
            world_from_camera=data.camera.world_from_camera,
        )
    except ValueError as error:
        raise DataError(f"{info.files['gt']}: {error}") from error


def salient_partitions(scene: samsod.Scene) -> set[int]:
    """Labels of all partitions in salient regions."""
    return {label for region in scene.regions for label in region.partitions}


def with_method(cell: samsod.Cell, method: str) -> samsod.Cell:
    """The same cell with another way to evaluate the saliency."""
    params: Mapping[str, Any] = cell.params
    return samsod.Cell({**params, "saliency": {**params.get("saliency", {}), "method": method}})
