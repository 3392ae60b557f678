"""Measures what recognition says of a scene against the truth.

Detections, unknown ones too, and true parts are matched one to one. First by IoU of their masks, the largest first, as
long as it is `LEAST_IOU` or more; then, of what is left, named detections whose origin is seen within half the size of
a part (the root of its visible area) from where the part's is, the nearest first.

A part is *in the catalogue* when the recogniser knows its name. What became of a part is its outcome: *right*, *wrong*
(a detection of another name), *unknown* (an unknown object) or *nothing* (no detection). Of a part that is not in the
catalogue every name is wrong: a *false name*.

The *angle error* of a right part is the difference of its yaw to the true one, modulo 360 / n degrees for a part of
n-fold symmetry: of the outline for the methods that compare outlines and for what "sift" says that the outline told
(its detections of the method "shape"), of the picture for the others. A part that looks the same at any angle has none.
The *place error* is the place of its origin in the world less the true one.

A named detection that matches no part is *spurious* when less than half of its mask lies on parts, else one too many:
a *double*.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
import numpy.typing as npt

from samsod.evaluation import metrics
from samsod.evaluation.data import DataError, SceneData, SceneInfo, TruePart
from samsod.evaluation.objects import Place

#: Least IoU of two masks that are taken for the same part.
LEAST_IOU = 0.3

Outcome = Literal["right", "wrong", "unknown", "nothing"]

#: The methods of recognition among the objects, then the conventional ones over the whole frame.
METHODS: tuple[Literal["shape"], Literal["sift"], Literal["best"]] = ("shape", "sift", "best")
CONVENTIONAL = ("conventional_shape", "conventional_sift")
#: Methods that compare outlines; the others see the picture.
OUTLINE_METHODS = frozenset({"shape", "conventional_shape"})


class Detected(Protocol):
    """What the scores read of `samsod.Detection`."""

    @property
    def name(self) -> str | None:
        """Name of the part; None is an unknown object."""
        ...

    @property
    def score(self) -> float:
        """How well it fits, in [0, 1]."""
        ...

    @property
    def method(self) -> Literal["sift", "shape"]:
        """What told its pose."""
        ...

    @property
    def x_mm(self) -> float | None:
        """World x of its origin."""
        ...

    @property
    def y_mm(self) -> float | None:
        """World y of its origin."""
        ...

    @property
    def yaw_deg(self) -> float | None:
        """Rotation about world z."""
        ...

    @property
    def origin_px(self) -> tuple[float, float]:
        """Pixel (x, y) at which its origin is seen at its height."""
        ...

    @property
    def mask(self) -> npt.NDArray[np.bool_]:
        """Its pixels, bool (H, W)."""
        ...


class SeeingCamera(Protocol):
    """What the scores need of `samsod.Camera`."""

    def image_from_world(self, points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Pixels (N, 2) at which world points (N, 3) in mm are seen."""
        ...


@dataclass(frozen=True)
class NamedPart:
    """What one method said of one part.

    Attributes:
        scene, scenario, table, lighting: of the scene.
        id: of the part in the scene.
        part: its name.
        textured: whether it has marks that local features can tell.
        detected: whether a salient region covers half of it.
        known: whether it is in the catalogue.
        outcome: what became of it.
        called: name of its detection; None when that is unknown or there is none.
        score: of its detection.
        iou: of the mask of its detection with the visible mask.
        angle_error_deg: of a right part, 0 or more; None for one that looks the same at any angle.
        error_mm: of a right part, place found less true place along world x and y.
    """

    scene: str
    scenario: str
    table: str
    lighting: str
    id: int
    part: str
    textured: bool
    detected: bool
    known: bool
    outcome: Outcome
    called: str | None = None
    score: float | None = None
    iou: float | None = None
    angle_error_deg: float | None = None
    error_mm: Place | None = None


@dataclass(frozen=True)
class Stray:
    """A named detection that matches no part."""

    scene: str
    called: str
    score: float
    origin_px: Place


@dataclass(frozen=True)
class MethodScore:
    """What one method said of one scene.

    Attributes:
        parts: every part with a visible pixel, by id.
        spurious: named detections on no part.
        doubles: named detections on parts that have another one.
        ms: wall-clock time.
    """

    parts: list[NamedPart]
    spurious: list[Stray]
    doubles: list[Stray]
    ms: float


@dataclass(frozen=True)
class RecognitionScore:
    """Recognition in one scene.

    Attributes:
        methods: by the names in `METHODS` and, where they were run, `CONVENTIONAL`.
        pixels: of the frame.
    """

    methods: Mapping[str, MethodScore]
    pixels: int

    @property
    def badness(self) -> float:
        """Order of the contact sheets: wrong names weigh most, then spurious ones, then parts without a name."""
        best = self.methods["best"]
        parts = [part for part in best.parts if part.detected]
        wrong = sum(part.outcome == "wrong" for part in parts)
        without = sum(part.known and part.outcome in ("unknown", "nothing") for part in parts)
        return 2.0 * wrong + 1.5 * len(best.spurious) + without


def angle_error(found_deg: float, true_deg: float, order: int) -> float | None:
    """Smallest difference of two angles of a part of n-fold symmetry, in degrees, 0 to 180 / n; None for order 0."""
    if order == 0:
        return None
    period = 360.0 / order
    difference = (found_deg - true_deg) % period
    return min(difference, period - difference)


def match(ious: npt.NDArray[np.float64], distances: npt.NDArray[np.float64]) -> dict[int, int]:
    """Matches parts and detections one to one.

    Args:
        ious: IoU of every part (rows) with every detection (columns).
        distances: distance of their origins as a share of what is allowed; above 1 is too far.

    Returns:
        the detection of every part that has one.
    """
    pairs = [(-ious[i, k], int(i), int(k)) for i, k in np.argwhere(ious >= LEAST_IOU)]
    # After all pairs that overlap: these sort by a number above 0.
    pairs += [(1.0 + distances[i, k], int(i), int(k)) for i, k in np.argwhere(distances <= 1.0)]
    matched: dict[int, int] = {}
    taken: set[int] = set()
    for _, part, detection in sorted(pairs):
        if part not in matched and detection not in taken:
            matched[part] = detection
            taken.add(detection)
    return matched


def score_method(
    info: SceneInfo,
    data: SceneData,
    camera: SeeingCamera,
    method: str,
    detections: Sequence[Detected],
    known: Iterable[str],
    detected: Iterable[int],
    ms: float,
) -> MethodScore:
    """Compares the detections of one method in one scene with the truth.

    Args:
        info: the scene.
        data: its truth.
        camera: the true camera of these pixels.
        method: one of `METHODS` or `CONVENTIONAL`.
        detections: what it says.
        known: names of the parts in the catalogue.
        detected: ids of the parts that a salient region covers to a half.
        ms: the time that it took.

    Raises:
        DataError: the truth does not say how a part lies.
    """
    known, detected = frozenset(known), frozenset(detected)
    area = np.bincount(data.parts.ravel())
    ids = [part for part in range(1, len(area)) if area[part] > 0]
    poses = [_pose(info, data, part) for part in ids]
    overlap, covered = _overlaps(data.parts, [found.mask for found in detections])
    union = area[ids][:, None] + covered[None, :] - overlap[ids]
    ious = overlap[ids] / np.maximum(union, 1)
    matched = match(ious, _distances(camera, poses, area[ids], detections))

    scores = []
    for row, (part, pose) in enumerate(zip(ids, poses, strict=True)):
        name = data.names.get(part, f"#{part}")
        column = matched.get(row)
        found = None if column is None else detections[column]
        right = found is not None and found.name == name and name in known
        by_edges = method == "sift" and found is not None and found.method == "shape"
        by_outline = method in OUTLINE_METHODS or by_edges
        order = pose.shape_order if by_outline else pose.appearance_order
        angle = place = None
        if right and found is not None:
            if found.yaw_deg is not None:
                angle = angle_error(found.yaw_deg, pose.yaw_deg, order)
            if found.x_mm is not None and found.y_mm is not None:
                place = (found.x_mm - pose.x_mm, found.y_mm - pose.y_mm)
        scores.append(
            NamedPart(
                scene=info.name,
                scenario=info.scenario,
                table=info.table,
                lighting=info.lighting,
                id=part,
                part=name,
                textured=pose.textured,
                detected=part in detected,
                known=name in known,
                outcome=_outcome(found, right),
                called=None if found is None else found.name,
                score=None if found is None else float(found.score),
                iou=None if column is None else float(ious[row, column]),
                angle_error_deg=angle,
                error_mm=place,
            )
        )
    spurious: list[Stray] = []
    doubles: list[Stray] = []
    for column in sorted(set(range(len(detections))) - set(matched.values())):
        found = detections[column]
        if found.name is not None:
            on_parts = 2 * int(overlap[1:, column].sum()) >= max(int(covered[column]), 1)
            stray = Stray(info.name, found.name, float(found.score), found.origin_px)
            (doubles if on_parts else spurious).append(stray)
    return MethodScore(scores, spurious, doubles, ms)


def _outcome(found: Detected | None, right: bool) -> Outcome:
    if found is None:
        return "nothing"
    if found.name is None:
        return "unknown"
    return "right" if right else "wrong"


def _pose(info: SceneInfo, data: SceneData, part: int) -> TruePart:
    try:
        return data.poses[part]
    except KeyError:
        raise DataError(f"{info.files['gt']}: instance {part} has no yaw_deg; recognition is measured by it") from None


def _overlaps(
    parts: metrics.LabelImage, masks: Sequence[metrics.Mask]
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Pixels that every label shares with every mask, int64 (largest label + 1, N), and those of every mask, (N,)."""
    rows = int(parts.max(initial=0)) + 1
    overlap = np.zeros((rows, len(masks)), dtype=np.int64)
    for column, mask in enumerate(masks):
        if mask.shape != parts.shape:
            raise ValueError(f"mask of a detection of shape {mask.shape} in an image of shape {parts.shape}")
        overlap[:, column] = np.bincount(parts[mask], minlength=rows)
    return overlap, overlap.sum(axis=0)


def _distances(
    camera: SeeingCamera, poses: Sequence[TruePart], areas: npt.NDArray[np.int64], detections: Sequence[Detected]
) -> npt.NDArray[np.float64]:
    """Distances of the origins of parts and detections in the image by half the size of the part; unknown ones: inf."""
    distances = np.full((len(poses), len(detections)), np.inf)
    if not len(distances):
        return distances
    true = camera.image_from_world(np.array([(pose.x_mm, pose.y_mm, pose.height_mm) for pose in poses]))
    for column, found in enumerate(detections):
        if found.name is not None:
            distances[:, column] = np.hypot(*(true - np.array(found.origin_px)).T) / (0.5 * np.sqrt(areas))
    return distances
