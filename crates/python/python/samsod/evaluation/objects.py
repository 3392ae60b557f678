"""Measures object masks, shadow masks and places on the table against the truth of a scene.

A part is *detected* when one salient region covers at least half of its visible pixels; the region that covers most
of it is its region. Its *object* is the object, of any region, that shares most pixels with it. The *IoU* of a
detected part is that of its object's mask and its visible mask, 0 when it has no object.

*Shadow recall* is the share of the true cast-shadow pixels inside salient regions that are labelled shadow, *object
loss* the share of the true object pixels inside salient regions that are. Labelled shadow is every pixel of an
object's shadow mask and every pixel of a salient region without objects.

The *place before* separation is the centroid of the part's region, the *place after* that of its object's mask, the
true place that of its visible mask. All three go through the true camera to the table plane z = 0: what a part's height
adds by parallax is the same in all of them. Two parts in one region share its centroid. A detected part without
an object has no place after; such parts are counted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from samsod.evaluation import metrics
from samsod.evaluation.data import SceneData, SceneInfo

#: Share of a part's visible pixels that makes it detected.
DETECTED_SHARE = 0.5

Place = tuple[float, float]


class Separated(Protocol):
    """An object cut from its shadow: what the scores read of `samsod.ObjectRegion`."""

    @property
    def mask(self) -> npt.NDArray[np.bool_]:
        """Pixels of the object, bool (H, W)."""
        ...

    @property
    def shadow(self) -> npt.NDArray[np.bool_]:
        """Pixels of its cast shadow, bool (H, W)."""
        ...

    @property
    def centroid(self) -> Place:
        """Centroid of the mask (x, y) in px."""
        ...

    @property
    def region(self) -> int:
        """Index of its salient region."""
        ...


@dataclass(frozen=True)
class FoundObject:
    """An object with its masks read once: every access to those of `samsod.ObjectRegion` may paint them anew."""

    mask: npt.NDArray[np.bool_]
    shadow: npt.NDArray[np.bool_]
    centroid: Place
    region: int

    @staticmethod
    def of(separated: Separated) -> FoundObject:
        """A copy of what the scores read of it."""
        return FoundObject(separated.mask, separated.shadow, separated.centroid, separated.region)


class TableCamera(Protocol):
    """What the scores need of `samsod.Camera`."""

    def world_from_image(self, points: npt.NDArray[np.float64], height_mm: float = 0.0) -> npt.NDArray[np.float64]:
        """World points (N, 3) in mm, on the plane at `height_mm`, of image points (N, 2) in px."""
        ...


@dataclass(frozen=True)
class PartScore:
    """The figures of one part of one scene.

    Attributes:
        scene, scenario, table, lighting: of the scene.
        id: of the part in the scene.
        part: its name.
        area_px: visible pixels.
        coverage: share of them that the best single region covers.
        merged: whether that region covers half or more of another part, too.
        iou, paper_iou: of the object's mask and the visible mask with `object_side` "evidence" and "paper"; None for a
            part that is not detected.
        has_object, paper_has_object: whether some object shares a pixel with it.
        true_mm: true place on the table.
        before_mm, after_mm: place found less true place, in mm along world x and y; None when there is none.
    """

    scene: str
    scenario: str
    table: str
    lighting: str
    id: int
    part: str
    area_px: int
    coverage: float
    merged: bool
    iou: float | None
    paper_iou: float | None
    has_object: bool
    paper_has_object: bool
    true_mm: Place
    before_mm: Place | None
    after_mm: Place | None

    @property
    def detected(self) -> bool:
        """Whether one salient region covers at least half of the visible pixels."""
        return self.coverage >= DETECTED_SHARE

    @property
    def lacks_object(self) -> bool:
        """Whether it is detected and yet no object shares a pixel with it."""
        return self.detected and not self.has_object


@dataclass(frozen=True)
class ShadowCount:
    """True pixels inside the salient regions of one scene, and how many of them are labelled shadow.

    Attributes:
        shadow_px: true cast-shadow pixels in salient regions.
        shadow_found_px: those of them labelled shadow.
        object_px: true object pixels in salient regions.
        object_lost_px: those of them labelled shadow.
    """

    shadow_px: int
    shadow_found_px: int
    object_px: int
    object_lost_px: int


@dataclass(frozen=True)
class ObjectScore:
    """Objects and shadows of one scene.

    Attributes:
        parts: every part with a visible pixel, by id.
        shadow, paper_shadow: pixel counts with `object_side` "evidence" and "paper".
    """

    parts: list[PartScore]
    shadow: ShadowCount
    paper_shadow: ShadowCount

    @property
    def mean_iou(self) -> float:
        """Mean over the detected parts; 1 without any."""
        ious = [part.iou for part in self.parts if part.iou is not None]
        return float(np.mean(ious)) if ious else 1.0


def object_overlaps(parts: metrics.LabelImage, objects: Sequence[Separated]) -> npt.NDArray[np.int64]:
    """Pixels that every part shares with every object's mask.

    Args:
        parts: 0 on the table, k on part k (H, W).
        objects: objects with masks (H, W).

    Returns:
        int64 (largest id + 1, number of objects).
    """
    rows = int(parts.max(initial=0)) + 1
    table = np.zeros((rows, len(objects)), dtype=np.int64)
    for column, separated in enumerate(objects):
        if separated.mask.shape != parts.shape:
            raise ValueError(f"object mask of shape {separated.mask.shape} in an image of shape {parts.shape}")
        table[:, column] = np.bincount(parts[separated.mask], minlength=rows)
    return table


def own_objects(table: npt.NDArray[np.int64]) -> list[int | None]:
    """The object of every row of `object_overlaps`: that with the largest overlap, the first of equals, or None."""
    if table.shape[1] == 0:
        return [None] * len(table)
    best = table.argmax(axis=1)
    return [int(column) if table[row, column] > 0 else None for row, column in enumerate(best)]


def shadow_labels(regions: metrics.LabelImage, objects: Sequence[Separated]) -> metrics.Mask:
    """Pixels labelled shadow: all shadow masks, and the salient regions without objects.

    Args:
        regions: 0 outside, k + 1 in salient region k (H, W).
        objects: the objects cut from these regions.

    Returns:
        bool (H, W).
    """
    with_object = np.zeros(int(regions.max(initial=0)) + 1, dtype=np.bool_)
    # Entry 0 stands for the pixels outside all regions.
    with_object[[0, *(separated.region + 1 for separated in objects)]] = True
    labelled: metrics.Mask = ~with_object[regions]
    for separated in objects:
        labelled |= separated.shadow
    return labelled


def count_shadow(data: SceneData, salient: metrics.Mask, labelled: metrics.Mask) -> ShadowCount:
    """Counts true shadow and object pixels inside the salient regions, and those labelled shadow; masks (H, W)."""
    shadow = data.shadow & salient
    solid = (data.parts > 0) & salient
    return ShadowCount(
        shadow_px=int(np.count_nonzero(shadow)),
        shadow_found_px=int(np.count_nonzero(shadow & labelled)),
        object_px=int(np.count_nonzero(solid)),
        object_lost_px=int(np.count_nonzero(solid & labelled)),
    )


def mask_centroid(mask: metrics.Mask) -> Place:
    """Mean (x, y) in px of the pixels of a mask (H, W) that has one; pixel centres are at integers."""
    rows, columns = np.nonzero(mask)
    return float(columns.mean()), float(rows.mean())


def score_objects(
    info: SceneInfo,
    data: SceneData,
    camera: TableCamera,
    regions: metrics.LabelImage,
    centroids: Sequence[Place],
    objects: Sequence[Separated],
    paper: Sequence[Separated],
) -> ObjectScore:
    """Compares the objects of one scene with the truth.

    Args:
        info: the scene.
        data: its truth.
        camera: the true camera of these pixels.
        regions: 0 outside, k + 1 in salient region k (H, W).
        centroids: centroid (x, y) in px of each salient region.
        objects: what the separation says with `object_side` "evidence".
        paper: the same with "paper".
    """
    region_table = metrics.overlaps(data.parts, regions)
    area = region_table.sum(axis=1)
    ids = [part for part in range(1, len(area)) if area[part] > 0]
    # Best region of each part, and the share of the part that each region covers.
    shares = region_table[:, 1:] / np.maximum(area, 1)[:, None]
    covered = (shares[ids] >= DETECTED_SHARE).sum(axis=0)
    own = own_objects(object_overlaps(data.parts, objects))
    paper_own = own_objects(object_overlaps(data.parts, paper))

    def place(point: Place) -> Place:
        x, y, _ = camera.world_from_image(np.array([point], dtype=np.float64))[0]
        return float(x), float(y)

    scores = []
    for part in ids:
        visible = data.parts == part
        best = int(shares[part].argmax()) if shares.shape[1] else None
        coverage = float(shares[part, best]) if best is not None else 0.0
        detected = best is not None and coverage >= DETECTED_SHARE
        mine, paper_mine = own[part], paper_own[part]
        true = place(mask_centroid(visible))
        before = place(centroids[best]) if detected and best is not None else None
        after = place(objects[mine].centroid) if detected and mine is not None else None
        scores.append(
            PartScore(
                scene=info.name,
                scenario=info.scenario,
                table=info.table,
                lighting=info.lighting,
                id=part,
                part=data.names.get(part, f"#{part}"),
                area_px=int(area[part]),
                coverage=coverage,
                merged=bool(detected and covered[best] > 1),
                iou=_object_iou(visible, objects, mine) if detected else None,
                paper_iou=_object_iou(visible, paper, paper_mine) if detected else None,
                has_object=mine is not None,
                paper_has_object=paper_mine is not None,
                true_mm=true,
                before_mm=_difference(before, true),
                after_mm=_difference(after, true),
            )
        )
    salient = regions > 0
    return ObjectScore(
        parts=scores,
        shadow=count_shadow(data, salient, shadow_labels(regions, objects)),
        paper_shadow=count_shadow(data, salient, shadow_labels(regions, paper)),
    )


def _object_iou(visible: metrics.Mask, objects: Sequence[Separated], own: int | None) -> float:
    return 0.0 if own is None else metrics.iou(objects[own].mask, visible)


def _difference(found: Place | None, true: Place) -> Place | None:
    return None if found is None else (found[0] - true[0], found[1] - true[1])
