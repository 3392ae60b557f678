"""The measures on arrays small enough to work out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from samsod.evaluation import metrics

# Two parts on a 6 x 4 table, a shadow right of part 1.
PARTS = np.array(
    [
        [0, 0, 0, 0, 0, 0],
        [0, 1, 1, 0, 0, 0],
        [0, 1, 1, 0, 2, 2],
        [0, 0, 0, 0, 2, 2],
    ],
    dtype=np.uint8,
)
SHADOW = np.zeros((4, 6), dtype=bool)
SHADOW[1:3, 3] = True
TRUTH = (PARTS > 0) | SHADOW
# Partition 0 is the table, 1 covers part 1 and its shadow, 2 the right column of part 2, 3 a corner of the table.
LABELS = np.array(
    [
        [3, 0, 0, 0, 0, 0],
        [0, 1, 1, 1, 0, 0],
        [0, 1, 1, 1, 0, 2],
        [0, 0, 0, 0, 0, 2],
    ],
    dtype=np.uint32,
)


def test_overlaps_counts_every_pair() -> None:
    table = metrics.overlaps(PARTS, LABELS)
    assert table.tolist() == [[13, 2, 0, 1], [0, 4, 0, 0], [2, 0, 2, 0]]
    assert table.sum() == PARTS.size


def test_overlaps_refuses_other_shapes() -> None:
    with pytest.raises(ValueError, match=r"\(4, 6\) and \(6, 4\)"):
        metrics.overlaps(PARTS, LABELS.T)


def test_region_image_numbers_regions_from_one() -> None:
    image = metrics.region_image(LABELS, [[1], [2, 3]])
    assert image.tolist() == [[2, 0, 0, 0, 0, 0], [0, 1, 1, 1, 0, 0], [0, 1, 1, 1, 0, 2], [0, 0, 0, 0, 0, 2]]
    assert not metrics.region_image(LABELS, []).any()


def test_coverage_is_that_of_the_best_single_region() -> None:
    image = metrics.region_image(LABELS, [[1], [2], [3]])
    assert metrics.part_coverage(PARTS, image) == {1: 1.0, 2: 0.5}
    # Two regions that halve part 1 cover it to a half, not wholly.
    halves = np.where(PARTS == 1, np.where(np.arange(6) == 1, 1, 2), 0)
    assert metrics.part_coverage(PARTS, halves) == {1: 0.5, 2: 0.0}


def test_coverage_without_regions_and_without_parts() -> None:
    nothing = np.zeros_like(PARTS)
    assert metrics.part_coverage(PARTS, nothing) == {1: 0.0, 2: 0.0}
    assert metrics.part_coverage(nothing, PARTS) == {}
    # Ids need not be dense: a part that is wholly hidden has no pixel and no entry.
    assert metrics.part_coverage(np.where(PARTS == 2, 5, 0), PARTS) == {5: 1.0}


def test_spurious_regions_touch_neither_part_nor_shadow() -> None:
    image = metrics.region_image(LABELS, [[1], [2], [3]])
    assert metrics.spurious_regions(image, TRUTH) == [3]
    # One pixel of shadow is enough not to be spurious.
    on_shadow = np.zeros_like(PARTS)
    on_shadow[0:2, 3] = 1
    assert metrics.spurious_regions(on_shadow, TRUTH) == []
    assert metrics.spurious_regions(on_shadow, PARTS > 0) == [1]
    assert metrics.spurious_regions(np.zeros_like(PARTS), TRUTH) == []
    assert metrics.spurious_regions(on_shadow, np.zeros_like(TRUTH)) == [1]


def test_merged_parts_share_a_region() -> None:
    everything = np.ones_like(PARTS)
    assert metrics.merged_parts(PARTS, everything) == 2
    assert metrics.merged_parts(PARTS, metrics.region_image(LABELS, [[1], [2]])) == 0
    assert metrics.merged_parts(PARTS, np.zeros_like(PARTS)) == 0


def test_iou_precision_and_recall() -> None:
    found = LABELS > 0
    # 10 true pixels, 9 found, 8 in both.
    assert metrics.iou(found, TRUTH) == pytest.approx(8 / 11)
    assert metrics.precision_recall(found, TRUTH) == pytest.approx((8 / 9, 8 / 10))
    nothing = np.zeros_like(found)
    assert metrics.iou(nothing, nothing) == 1.0
    assert metrics.iou(nothing, TRUTH) == 0.0
    assert metrics.precision_recall(nothing, TRUTH) == (1.0, 0.0)
    assert metrics.precision_recall(found, nothing) == (0.0, 1.0)


def test_majority_partitions_are_the_bound_of_a_segmentation() -> None:
    best = metrics.majority_partitions(LABELS, TRUTH)
    assert np.array_equal(best, (LABELS == 1) | (LABELS == 2))
    assert metrics.covered_share(PARTS, best) == {1: 1.0, 2: 0.5}
    # A partition of which exactly half is true is not mostly true.
    half = np.zeros((1, 2), dtype=np.uint32)
    assert not metrics.majority_partitions(half, np.array([[True, False]])).any()
    assert not metrics.majority_partitions(LABELS, np.zeros_like(TRUTH)).any()
    assert metrics.covered_share(PARTS, np.zeros_like(TRUTH)) == {1: 0.0, 2: 0.0}


def test_mean_absolute_difference() -> None:
    first = np.array([[0.0, 0.5], [1.0, 0.25]], dtype=np.float32)
    second = np.array([[0.5, 0.5], [0.0, 0.5]], dtype=np.float32)
    assert metrics.mean_absolute_difference(first, second) == pytest.approx(1.75 / 4)
    assert metrics.mean_absolute_difference(np.empty((0, 0)), np.empty((0, 0))) == 0.0
