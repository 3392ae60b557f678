"""Measures of salient regions against known parts and shadows: pure functions on label images.

A label image is an integer array (H, W) in which 0 means "nothing" and k > 0 is object k. Salient regions never
overlap, so one label image holds them all.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import numpy.typing as npt

LabelImage = npt.NDArray[np.integer]
Mask = npt.NDArray[np.bool_]


def _same_shape(first: npt.NDArray[np.generic], second: npt.NDArray[np.generic]) -> None:
    if first.shape != second.shape:
        raise ValueError(f"arrays of shape {first.shape} and {second.shape}; both must have the same shape")


def overlaps(first: LabelImage, second: LabelImage) -> npt.NDArray[np.int64]:
    """Counts the pixels of every pair of labels.

    Args:
        first: labels (H, W), not negative.
        second: labels (H, W), not negative.

    Returns:
        int64 (max of first + 1, max of second + 1): entry (i, k) is the number of pixels with labels i and k.
    """
    _same_shape(first, second)
    rows = int(first.max(initial=0)) + 1
    columns = int(second.max(initial=0)) + 1
    joint = first.astype(np.int64).ravel() * columns + second.astype(np.int64).ravel()
    return np.bincount(joint, minlength=rows * columns).reshape(rows, columns)


def region_image(labels: npt.NDArray[np.unsignedinteger], regions: Sequence[Iterable[int]]) -> npt.NDArray[np.int32]:
    """Paints regions, given as sets of partitions, into one label image.

    Args:
        labels: partition of every pixel (H, W), dense from 0.
        regions: the partitions of each region; no partition may be in two.

    Returns:
        int32 (H, W): 0 outside, k + 1 in region k.
    """
    lut = np.zeros(int(labels.max(initial=0)) + 1, dtype=np.int32)
    for number, partitions in enumerate(regions, start=1):
        lut[np.fromiter(partitions, dtype=np.int64)] = number
    image: npt.NDArray[np.int32] = lut[labels]
    return image


def part_coverage(parts: LabelImage, regions: LabelImage) -> dict[int, float]:
    """Share of every part's visible pixels that the best single region covers.

    Args:
        parts: 0 on the table, k on part k (H, W).
        regions: 0 outside, k in region k (H, W).

    Returns:
        for each part that has a pixel, a value in [0, 1].
    """
    table = overlaps(parts, regions)
    area = table.sum(axis=1)
    best = table[:, 1:].max(axis=1, initial=0)
    return {part: float(best[part] / area[part]) for part in range(1, len(area)) if area[part] > 0}


def merged_parts(parts: LabelImage, regions: LabelImage, least: float = 0.5) -> int:
    """Number of parts that share their covering region with another part.

    A region covers a part when it holds at least `least` of the part's pixels.
    """
    table = overlaps(parts, regions)
    area = np.maximum(table.sum(axis=1, keepdims=True), 1)
    covers = table[1:, 1:] / area[1:] >= least
    in_region = covers.sum(axis=0)
    return int(in_region[in_region > 1].sum())


def spurious_regions(regions: LabelImage, truth: Mask) -> list[int]:
    """Regions that touch no true pixel.

    Args:
        regions: 0 outside, k in region k (H, W).
        truth: part or cast shadow (H, W).

    Returns:
        the labels of those regions, ascending.
    """
    table = overlaps(regions, truth.astype(np.uint8))
    on_truth = table[:, 1] if table.shape[1] > 1 else np.zeros(len(table), dtype=np.int64)
    return [region for region in range(1, len(table)) if table[region].sum() > 0 and on_truth[region] == 0]


def iou(first: Mask, second: Mask) -> float:
    """Intersection over union of two masks (H, W); 1 when both are empty."""
    _same_shape(first, second)
    union = int(np.count_nonzero(first | second))
    return int(np.count_nonzero(first & second)) / union if union else 1.0


def precision_recall(found: Mask, truth: Mask) -> tuple[float, float]:
    """Share of the found pixels that are true and share of the true pixels found; 1 where there is none."""
    _same_shape(found, truth)
    both = int(np.count_nonzero(found & truth))
    found_pixels, true_pixels = int(np.count_nonzero(found)), int(np.count_nonzero(truth))
    return (both / found_pixels if found_pixels else 1.0), (both / true_pixels if true_pixels else 1.0)


def majority_partitions(labels: npt.NDArray[np.unsignedinteger], truth: Mask) -> Mask:
    """The best that region selection could do with a segmentation: partitions mostly on true pixels.

    Args:
        labels: partition of every pixel (H, W), dense from 0.
        truth: part or cast shadow (H, W).

    Returns:
        bool (H, W): pixels of the partitions of which more than half is true.
    """
    table = overlaps(labels, truth.astype(np.uint8))
    if table.shape[1] < 2:
        return np.zeros(labels.shape, dtype=np.bool_)
    chosen: Mask = table[:, 1] * 2 > table.sum(axis=1)
    picked: Mask = chosen[labels]
    return picked


def covered_share(parts: LabelImage, mask: Mask) -> dict[int, float]:
    """Share of every part's visible pixels inside a mask."""
    table = overlaps(parts, mask.astype(np.uint8))
    inside = table[:, 1] if table.shape[1] > 1 else np.zeros(len(table), dtype=np.int64)
    area = table.sum(axis=1)
    return {part: float(inside[part] / area[part]) for part in range(1, len(area)) if area[part] > 0}


def mean_absolute_difference(first: npt.NDArray[np.floating], second: npt.NDArray[np.floating]) -> float:
    """Mean of |first - second| over all pixels, in the unit of the arrays."""
    _same_shape(first, second)
    return float(np.mean(np.abs(first.astype(np.float64) - second.astype(np.float64)))) if first.size else 0.0
