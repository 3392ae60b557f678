"""Objects without their shadows: arrays, measures and errors of the bindings."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from conftest import Frame

import samsod

TABLE = (150, 170, 200)
SHADE = (75, 85, 100)


@pytest.fixture
def shaded() -> tuple[Frame, samsod.Partition, Any, list[samsod.SalientRegion]]:
    """A red plate of 30 x 20 pixels with a hole on a blue table; its shadow of 8 x 20 pixels to the right."""
    rgb = np.full((60, 90, 3), TABLE, dtype=np.uint8)
    labels = np.zeros((60, 90), dtype=np.uint32)
    values = np.full((60, 90), 0.01, dtype=np.float32)
    for label, columns, colour, saliency in (
        (1, slice(20, 50), (210, 40, 30), 0.8),
        (2, slice(50, 58), SHADE, 0.3),
    ):
        rgb[20:40, columns] = colour
        labels[20:40, columns] = label
        values[20:40, columns] = saliency
    rgb[28:32, 30:34] = TABLE
    labels[28:32, 30:34] = 0
    partition = samsod.Partition.from_labels(rgb, labels)
    regions = samsod.salient_regions(values, partition, 0.1)
    assert [region.partitions for region in regions] == [[1, 2]]
    return rgb, partition, values, regions


def test_an_object_and_its_shadow(shaded: Any) -> None:
    rgb, partition, values, regions = shaded
    objects = samsod.separate_shadows(rgb, partition, values, regions, object_side="paper")
    assert len(objects) == 1
    part = objects[0]
    assert part.region == 0
    assert part.mask.dtype == np.bool_
    assert np.array_equal(part.mask, partition.labels == 1)
    assert np.array_equal(part.shadow, partition.labels == 2)
    assert part.area == 30 * 20 - 16
    assert part.bbox == (20, 20, 30, 20)
    rows, columns = np.nonzero(part.mask)
    assert part.centroid == pytest.approx((columns.mean(), rows.mean()), abs=1e-3)
    assert part.box == pytest.approx((34.5, 29.5, 30.0, 20.0, 0.0))
    assert abs(part.axis_deg) < 1.0
    assert repr(part).startswith("<samsod.ObjectRegion: 584 px at (")


def test_outlines(shaded: Any) -> None:
    rgb, partition, values, regions = shaded
    part = samsod.separate_shadows(rgb, partition, values, regions, object_side="paper")[0]
    assert part.outline.dtype == np.int32
    assert part.outline.shape == (2 * (30 + 20) - 4, 2)
    assert part.outline[:2].tolist() == [[20, 20], [21, 20]]
    # Around a hole of 4 x 4 pixels lie 16 that share an edge with it.
    assert [hole.shape for hole in part.holes] == [(16, 2)]
    for points in (part.outline, *part.holes):
        assert part.mask[points[:, 1], points[:, 0]].all()
        steps = np.abs(np.diff(points, axis=0, append=points[:1]))
        assert steps.max() == 1


def test_the_default_is_evidence(shaded: Any) -> None:
    rgb, partition, values, regions = shaded
    default = samsod.separate_shadows(rgb, partition, values, regions)
    evidence = samsod.separate_shadows(rgb, partition, values, regions, "evidence")
    assert [np.packbits(o.mask).tobytes() for o in default] == [np.packbits(o.mask).tobytes() for o in evidence]


def test_small_objects_are_none(shaded: Any) -> None:
    rgb, partition, values, regions = shaded
    assert samsod.separate_shadows(rgb, partition, values, regions, "paper", min_object_area_px=585) == []
    assert len(samsod.separate_shadows(rgb, partition, values, regions, "paper", min_object_area_px=584)) == 1


def test_no_regions_no_objects(shaded: Any) -> None:
    rgb, partition, values, _ = shaded
    assert samsod.separate_shadows(rgb, partition, values, []) == []


def test_arguments_that_are_refused(shaded: Any) -> None:
    rgb, partition, values, regions = shaded
    with pytest.raises(ValueError, match="rgb has 90 x 59 pixels and partition 90 x 60"):
        samsod.separate_shadows(rgb[:-1], partition, values, regions)
    with pytest.raises(ValueError, match="saliency has 89 x 60 pixels and partition 90 x 60"):
        samsod.separate_shadows(rgb, partition, np.zeros((60, 89), dtype=np.float32), regions)
    side: Any = "bright"
    with pytest.raises(ValueError, match='object_side = "bright"; allowed are "evidence" and "paper"'):
        samsod.separate_shadows(rgb, partition, values, regions, side)
    for area in (0, -1, 2**32):
        with pytest.raises(ValueError, match=f"min_object_area_px = {area}; allowed are 1 to"):
            samsod.separate_shadows(rgb, partition, values, regions, min_object_area_px=area)
    with pytest.raises(ValueError, match="partition 1 belongs to the regions 0 and 1"):
        samsod.separate_shadows(rgb, partition, values, regions * 2)
    other = samsod.Partition.from_labels(rgb, partition.labels.copy())
    with pytest.raises(ValueError, match=r"regions\[0\] is a region of another partition"):
        samsod.separate_shadows(rgb, other, values, regions)
    nothing: Any = None
    with pytest.raises(TypeError):
        samsod.separate_shadows(rgb, partition, values, [nothing])
    with pytest.raises(TypeError, match="rgb: expected"):
        samsod.separate_shadows(nothing, partition, values, regions)


@pytest.mark.parametrize("side", ["paper", "evidence"])
def test_a_scene_has_the_objects_of_its_regions(frame: Frame, side: Any) -> None:
    scene = samsod.Cell({"shadow": {"object_side": side}}).inspect(frame)
    objects = samsod.separate_shadows(frame, scene.partition, scene.saliency, scene.regions, side)
    assert scene.objects
    assert [o.region for o in scene.objects] == [o.region for o in objects]
    taken = np.zeros(frame.shape[:2], dtype=np.int64)
    for a, b in zip(scene.objects, objects, strict=True):
        assert np.array_equal(a.mask, b.mask)
        assert np.array_equal(a.shadow, b.shadow)
        assert a.area == a.mask.sum()
        taken += a.mask
        taken += a.shadow
    assert taken.max() == 1
