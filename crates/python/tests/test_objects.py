"""Scores of objects, shadows and places on arrays small enough to work out by hand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from samsod.evaluation import metrics, objects
from samsod.evaluation.cell import SceneScore
from samsod.evaluation.data import SceneData, SceneInfo
from samsod.evaluation.objects import FoundObject, ObjectScore, PartScore, ShadowCount, score_objects
from samsod.evaluation.spread import Spread
from samsod.evaluation.summary import Figures, Measured, PartFigures, summary, total

INFO = SceneInfo("0001", Path(), "generic", "grey", "side")
Mask = npt.NDArray[np.bool_]


class HalfMillimetres:
    """A camera straight above: half a millimetre a pixel, y up, whatever the height."""

    def world_from_image(self, points: npt.NDArray[np.float64], height_mm: float = 0.0) -> npt.NDArray[np.float64]:
        world = np.full((len(points), 3), height_mm)
        world[:, 0] = 0.5 * points[:, 0]
        world[:, 1] = -0.5 * points[:, 1]
        return world


def picture(*rows: str) -> npt.NDArray[np.uint8]:
    """Digits as labels, anything else as 0."""
    return np.array([[int(c) if c.isdigit() else 0 for c in row] for row in rows], dtype=np.uint8)


def separated(mask: Mask, shadow: Mask, region: int) -> FoundObject:
    return FoundObject(mask, shadow, objects.mask_centroid(mask), region)


# Part 1 with a shadow on its right, part 2 without one, part 3 of which no region covers a half.
PARTS = picture(
    "..........",
    ".11...22..",
    ".11...22..",
    "........33",
    "........33",
)
SHADOW = picture(
    "..........",
    "...11.....",
    "...11.....",
    "..........",
    "...11.....",
).astype(bool)
# Region 1 holds part 1 with its shadow, region 2 part 2 and a fourth of part 3, region 3 a shadow that nothing made.
REGIONS = picture(
    "..........",
    ".1111.22..",
    ".1111.22..",
    "........2.",
    "...33.....",
)
DATA = SceneData(np.zeros((5, 10, 3), np.uint8), PARTS, SHADOW, {1: "bolt", 2: "rail", 3: "nut"})
# The object of region 1 takes one column of shadow with it and leaves one pixel of the part to the shadow.
FIRST = picture(
    "..........",
    "..11......",
    ".111......",
    "..........",
    "..........",
).astype(bool)
FIRST_SHADOW = picture(
    "..........",
    ".1..1.....",
    "....1.....",
    "..........",
    "..........",
).astype(bool)
SECOND = (REGIONS == 2) & (PARTS == 2)
NOTHING = np.zeros_like(SHADOW)
CENTROIDS = [objects.mask_centroid(np.equal(REGIONS, number)) for number in (1, 2, 3)]
FOUND = [separated(FIRST, FIRST_SHADOW, 0), separated(SECOND, NOTHING, 1)]


def score(found: list[FoundObject], paper: list[FoundObject]) -> ObjectScore:
    return score_objects(INFO, DATA, HalfMillimetres(), REGIONS, CENTROIDS, found, paper)


def test_parts_with_their_objects() -> None:
    first, second, third = score(FOUND, []).parts
    assert (first.part, first.id, first.area_px, first.coverage) == ("bolt", 1, 4, 1.0)
    assert first.detected
    # Three of four pixels, and two that are shadow.
    assert first.iou == pytest.approx(3 / 6)
    assert second.iou == 1.0
    assert second.detected
    # One of four pixels in a region, and no object.
    assert third.coverage == 0.25
    assert (third.detected, third.lacks_object, third.iou, third.before_mm, third.after_mm) == (
        False,
        False,
        None,
        None,
        None,
    )


def test_places_before_and_after() -> None:
    first, second, _ = score(FOUND, []).parts
    # Centroid of the part (1.5, 1.5) px, of its region (2.5, 1.5), of its object ((2+3+1+2+3)/5, (2*1+3*2)/5).
    assert first.true_mm == pytest.approx((0.75, -0.75))
    assert first.before_mm == pytest.approx((0.5, 0.0))
    assert first.after_mm == pytest.approx((0.5 * (2.2 - 1.5), -0.5 * (1.6 - 1.5)))
    # Part 2 at (6.5, 1.5); a pixel of part 3 at (8, 3) draws the centroid of its region.
    assert second.before_mm == pytest.approx((0.5 * ((26 + 8) / 5 - 6.5), -0.5 * ((6 + 3) / 5 - 1.5)))
    assert second.after_mm == pytest.approx((0.0, 0.0))


def test_a_detected_part_without_object_is_counted() -> None:
    first, second, third = score(FOUND[:1], FOUND).parts
    assert second.detected
    assert second.lacks_object
    assert second.iou == 0.0
    assert second.paper_iou == 1.0
    assert second.before_mm is not None
    assert second.after_mm is None
    figures = PartFigures.of([first, second, third])
    assert (figures.parts, figures.found, figures.missing) == (3, 2, 1)
    assert figures.iou == pytest.approx((0.5 + 0.0) / 2)
    assert figures.after_x is not None
    # Only the first part has a place after.
    assert figures.after_x.mean == pytest.approx(0.35)
    assert figures.before_x is not None
    assert figures.before_x.mean == pytest.approx((0.5 + 0.15) / 2)


def test_shadow_and_object_pixels() -> None:
    result = score(FOUND, FOUND[:1])
    # Six pixels of shadow in regions: two labelled by the object's mask, two in the region without objects.
    # Nine pixels of parts in regions, one of them labelled shadow.
    assert result.shadow == ShadowCount(shadow_px=6, shadow_found_px=4, object_px=9, object_lost_px=1)
    # Without its object, region 2 is all shadow: four pixels of part 2 and one of part 3 are lost.
    assert result.paper_shadow == ShadowCount(shadow_px=6, shadow_found_px=4, object_px=9, object_lost_px=6)
    # Without any, everything is.
    assert score([], []).shadow == ShadowCount(shadow_px=6, shadow_found_px=6, object_px=9, object_lost_px=9)


def test_a_scene_without_regions() -> None:
    nothing = np.zeros_like(REGIONS)
    result = score_objects(INFO, DATA, HalfMillimetres(), nothing, [], [], [])
    assert [part.detected for part in result.parts] == [False] * 3
    assert result.shadow == ShadowCount(0, 0, 0, 0)
    assert result.mean_iou == 1.0


def test_the_object_with_the_largest_overlap_may_lie_in_any_region() -> None:
    # The object of the small neighbour holds one pixel of part 1, the other three.
    corner = np.zeros_like(NOTHING)
    corner[1, 1] = True
    rest = (PARTS == 1) & ~corner
    found = [separated(corner, NOTHING, 0), separated(rest, NOTHING, 2)]
    first = score(found, []).parts[0]
    assert first.iou == pytest.approx(3 / 4)
    assert objects.object_overlaps(PARTS, found).tolist() == [[0, 0], [1, 3], [0, 0], [0, 0]]
    assert objects.own_objects(objects.object_overlaps(PARTS, found)) == [None, 1, None, None]
    assert objects.own_objects(objects.object_overlaps(PARTS, [])) == [None] * 4
    with pytest.raises(ValueError, match=r"\(2, 2\) in an image of shape \(5, 10\)"):
        objects.object_overlaps(PARTS, [separated(np.ones((2, 2), bool), NOTHING, 0)])


def test_two_parts_in_one_region_are_merged_and_share_its_centroid() -> None:
    one = (REGIONS > 0).astype(np.uint8)
    both = separated((PARTS == 1) | (PARTS == 2), NOTHING, 0)
    first, second, third = score_objects(
        INFO, DATA, HalfMillimetres(), one, [objects.mask_centroid(one > 0)], [both], []
    ).parts
    assert (first.merged, second.merged, third.merged) == (True, True, False)
    assert (first.iou, second.iou) == (0.5, 0.5)
    assert first.before_mm is not None
    assert second.before_mm is not None
    assert first.before_mm[0] + first.true_mm[0] == pytest.approx(second.before_mm[0] + second.true_mm[0])


def test_shadow_labels_outside_of_regions_come_from_masks_alone() -> None:
    labelled = objects.shadow_labels(REGIONS, FOUND)
    assert np.array_equal(labelled, FIRST_SHADOW | (REGIONS == 3))
    assert not objects.shadow_labels(np.zeros_like(REGIONS), []).any()


def some_scene(scenario: str, table: str, detected: bool, shift: float, shadow_ms: float) -> Measured:
    """A scene with one part, whose object lies `shift` mm off in x and twice that in -y."""
    part = PartScore(
        scene="0001",
        scenario=scenario,
        table=table,
        lighting="side",
        id=1,
        part="bolt",
        area_px=100,
        coverage=1.0 if detected else 0.2,
        merged=False,
        iou=0.8 if detected else None,
        paper_iou=0.4 if detected else None,
        has_object=detected,
        paper_has_object=detected,
        true_mm=(1.0, 2.0),
        before_mm=(-2.0 * shift, 0.0) if detected else None,
        after_mm=(shift, -2.0 * shift) if detected else None,
    )
    count = ShadowCount(shadow_px=100, shadow_found_px=90, object_px=1000, object_lost_px=10 if detected else 30)
    scene = SceneScore(
        scene="0001",
        scenario=scenario,
        table=table,
        lighting="side",
        parts=1,
        found=int(detected),
        cut=1,
        merged=0,
        partitions=10,
        regions=1,
        spurious=int(not detected),
        iou=1.0,
        bound_iou=1.0,
        precision=1.0,
        recall=1.0,
        segment_ms=1.0,
        saliency_ms=1.0,
        regions_ms=1.0,
        shadow_ms=shadow_ms,
    )
    return Measured(scene, ObjectScore([part], count, count), {"segment": 1.0, "shadow": shadow_ms})


def test_summary_leaves_oblique_scenes_to_their_scenario() -> None:
    scenes = [
        some_scene("generic", "wood", True, 0.5, 1.0),
        some_scene("generic", "grey", False, 0.0, 3.0),
        some_scene("oblique", "grey", True, 1.0, 9.0),
    ]
    figures = summary(scenes)
    assert figures["scenes"] == 2
    assert figures["detection"] == {"parts": 2, "found": 1, "rate": 0.5, "spurious_per_scene": 0.5}
    assert figures["objects"] == {
        "iou": 0.8,
        "iou_paper_side": 0.4,
        "shadow_recall": 0.9,
        "object_loss": pytest.approx(40 / 2000),
        "missing": 0,
        "iou_recognised": None,
        "shadow_recall_recognised": None,
        "object_loss_recognised": None,
        "missing_recognised": None,
    }
    assert figures["place_mm"] == {
        "before": {"x": 1.0, "y": 0.0},
        "after": {"x": 0.5, "y": 1.0},
        "recognised": {"x": None, "y": None},
        "part": {"x": None, "y": None},
    }
    assert figures["timings_ms"] == {"segment": 1.0, "shadow": 2.0, "recognize": None}
    by = figures["by"]
    assert {key: list(values) for key, values in by.items()} == {
        "table": ["grey", "wood"],
        "lighting": ["side"],
        "scenario": ["generic", "oblique"],
    }
    # The table of the oblique scene has nothing detected but in that.
    assert by["table"]["grey"]["scenes"] == 1
    assert by["table"]["grey"]["objects"]["iou"] is None
    assert by["table"]["grey"]["place_mm"]["after"] == {"x": None, "y": None}
    assert by["scenario"]["oblique"]["place_mm"]["after"] == {"x": 1.0, "y": 2.0}
    assert by["scenario"]["oblique"]["timings_ms"]["shadow"] == 9.0


def test_objects_after_recognition_stand_beside_those_of_the_separation() -> None:
    before = some_scene("generic", "wood", True, 0.5, 1.0)
    part = replace(before.objects.parts[0], iou=0.95, after_mm=(-0.2, 0.1))
    after = ObjectScore([part], ShadowCount(1000, 970, 1000, 10), before.objects.paper_shadow)
    figures = summary([replace(before, settled=after)])
    alone = summary([before])
    recognised = {key: value for key, value in figures["objects"].items() if key.endswith("_recognised")}
    assert recognised == {
        "iou_recognised": 0.95,
        "shadow_recall_recognised": 0.97,
        "object_loss_recognised": 0.01,
        "missing_recognised": 0,
    }
    assert figures["place_mm"]["recognised"] == {"x": 0.2, "y": 0.1}
    for group in ("objects", "place_mm"):
        others = {key: value for key, value in figures[group].items() if "recognised" not in key}
        assert others == {key: value for key, value in alone[group].items() if "recognised" not in key}


def test_figures_without_scenes() -> None:
    figures = Figures.of([]).groups()
    assert figures["scenes"] == 0
    assert figures["detection"] == {"parts": 0, "found": 0, "rate": None, "spurious_per_scene": None}
    assert figures["timings_ms"] == {}
    assert total([]) == ShadowCount(0, 0, 0, 0)
    assert Spread.of([]) is None
    assert Spread.of([2.0]) == Spread(2.0, 0.0)
    assert str(Spread.of([1.0, 3.0])) == "2.00 ± 1.41"


def test_region_images_and_objects_count_from_different_numbers() -> None:
    # Region k has label k + 1 in the image and index k in an object: the first must not be mistaken for "outside".
    image = metrics.region_image(np.array([[0, 1]], dtype=np.uint32), [[1]])
    mask = np.array([[False, True]])
    assert not objects.shadow_labels(image, [separated(mask, ~mask & False, 0)]).any()
    assert objects.shadow_labels(image, []).tolist() == [[False, True]]
