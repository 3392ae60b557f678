"""Scores of recognition on scenes small enough to work out by hand."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt
import pytest

from samsod.evaluation.data import DataError, SceneData, SceneInfo, TruePart
from samsod.evaluation.recognition import MethodScore, angle_error, match, score_method

INFO = SceneInfo("0001", Path("dev"), "generic", "grey", "side")
Mask = npt.NDArray[np.bool_]


class OnePixelEach:
    """A camera straight above that sees a pixel for every millimetre, whatever the height."""

    def image_from_world(self, points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        return points[:, :2]


@dataclass
class Found:
    """A detection."""

    name: str | None
    mask: Mask
    x_mm: float | None = None
    y_mm: float | None = None
    yaw_deg: float | None = None
    origin_px: tuple[float, float] = (1000.0, 1000.0)
    score: float = 0.75
    method: Literal["sift", "shape"] = "sift"


@dataclass
class Truth:
    """Squares of 10 px in a row, 20 px apart, in a picture of 20 x 100 px."""

    parts: npt.NDArray[np.uint8] = field(default_factory=lambda: np.zeros((20, 100), np.uint8))
    names: dict[int, str] = field(default_factory=dict)
    poses: dict[int, TruePart] = field(default_factory=dict)

    def add(self, name: str, yaw_deg: float = 0.0, shape: int = 1, appearance: int = 1, textured: bool = False) -> None:
        number = len(self.names) + 1
        self.parts[5:15, 20 * number - 15 : 20 * number - 5] = number
        self.names[number] = name
        self.poses[number] = TruePart(20.0 * number - 10.5, 9.5, yaw_deg, 5.0, textured, shape, appearance)

    def at(self, number: int, shift: int = 0) -> Mask:
        mask: Mask = np.roll(self.parts == number, shift, axis=1)
        return mask

    def score(
        self, *found: Found, method: str = "best", known: tuple[str, ...] = ("bolt", "nut", "rail")
    ) -> MethodScore:
        shape = self.parts.shape
        data = SceneData(
            np.zeros((*shape, 3), np.uint8), self.parts, np.zeros(shape, bool), self.names, None, self.poses
        )
        return score_method(INFO, data, OnePixelEach(), method, found, known, self.names, 3.0)


@pytest.fixture
def truth() -> Truth:
    scene = Truth()
    scene.add("bolt", yaw_deg=170.0, textured=True)
    scene.add("nut", yaw_deg=10.0, shape=6, appearance=6)
    scene.add("rail")
    scene.add("washer", shape=0, appearance=0)
    return scene


@pytest.mark.parametrize(
    ("found", "true", "order", "error"),
    [
        (10.0, 350.0, 1, 20.0),
        (-170.0, 170.0, 1, 20.0),
        (180.0, 0.0, 1, 180.0),
        (180.0, 0.0, 2, 0.0),
        (91.0, 0.0, 2, 89.0),
        (-59.0, 0.0, 6, 1.0),
        (30.0, 0.0, 6, 30.0),
        (0.0, 359.5, 360, 0.5),
    ],
)
def test_angle_errors_are_modulo_the_symmetry(found: float, true: float, order: int, error: float) -> None:
    assert angle_error(found, true, order) == pytest.approx(error)
    assert angle_error(true, found, order) == pytest.approx(error)


def test_what_is_round_has_no_angle() -> None:
    assert angle_error(10.0, 20.0, 0) is None


def test_outcomes(truth: Truth) -> None:
    score = truth.score(
        Found("bolt", truth.at(1), 10.0, 9.0, -175.0),
        Found("bolt", truth.at(2)),
        Found(None, truth.at(3)),
        known=("bolt", "nut", "rail", "washer"),
    )
    bolt, nut, rail, washer = score.parts
    assert (bolt.outcome, bolt.called, bolt.score, bolt.iou) == ("right", "bolt", 0.75, 1.0)
    assert bolt.angle_error_deg == pytest.approx(15.0)
    assert bolt.error_mm == pytest.approx((0.5, -0.5))
    assert (bolt.part, bolt.textured, bolt.detected, bolt.known) == ("bolt", True, True, True)
    assert (nut.outcome, nut.called, nut.angle_error_deg, nut.error_mm) == ("wrong", "bolt", None, None)
    assert (rail.outcome, rail.called, rail.iou) == ("unknown", None, 1.0)
    assert (washer.outcome, washer.called, washer.iou, washer.score) == ("nothing", None, None, None)
    assert (score.spurious, score.doubles, score.ms) == ([], [], 3.0)


def test_every_method_has_its_symmetry() -> None:
    scene = Truth()
    # A block with an outline that repeats at 180 degrees, and lettering that does not.
    scene.add("rail", yaw_deg=0.0, shape=2, appearance=1)
    scene.add("washer", shape=0, appearance=1)
    found = (Found("rail", scene.at(1), 0.0, 0.0, 178.0), Found("washer", scene.at(2), 0.0, 0.0, 5.0))
    known = ("rail", "washer")
    for method, errors in (
        ("shape", [2.0, None]),
        ("conventional_shape", [2.0, None]),
        ("sift", [178.0, 5.0]),
        ("best", [178.0, 5.0]),
        ("conventional_sift", [178.0, 5.0]),
    ):
        parts = scene.score(*found, method=method, known=known).parts
        assert [part.angle_error_deg for part in parts] == errors
        assert all(part.error_mm is not None for part in parts)
    # What features proposed and the outline told claims no more than the outline.
    by_outline = [replace(each, method="shape") for each in found]
    for method, errors in (("sift", [2.0, None]), ("best", [178.0, 5.0])):
        parts = scene.score(*by_outline, method=method, known=known).parts
        assert [part.angle_error_deg for part in parts] == errors


def test_left_out_parts_have_no_right_name(truth: Truth) -> None:
    # "washer" is not in the catalogue: whatever it is called is false; unknown is as it should be.
    called = truth.score(Found("nut", truth.at(4))).parts[3]
    assert (called.known, called.outcome, called.called) == (False, "wrong", "nut")
    unknown = truth.score(Found(None, truth.at(4))).parts[3]
    assert (unknown.known, unknown.outcome) == (False, "unknown")
    # A recogniser that knows the name nevertheless is no better.
    assert truth.score(Found("washer", truth.at(4))).parts[3].outcome == "wrong"


def test_the_largest_overlap_wins_whatever_the_order(truth: Truth) -> None:
    for found in ([("nut", 3), ("bolt", 1)], [("bolt", 1), ("nut", 3)]):
        score = truth.score(*(Found(name, truth.at(1, shift)) for name, shift in found))
        assert score.parts[0].called == "bolt"
        assert [stray.called for stray in score.doubles] == ["nut"]
        assert score.spurious == []


def test_one_detection_names_one_part(truth: Truth) -> None:
    # One mask over two parts: that with the larger IoU has it, the other has nothing.
    both = truth.at(1) | truth.at(2)
    both[:, 25:28] = False
    score = truth.score(Found("bolt", both))
    assert [part.outcome for part in score.parts[:2]] == ["right", "nothing"]


def test_masks_that_hardly_overlap_are_matched_by_their_origins(truth: Truth) -> None:
    # Half a part off: IoU 1/3 would still count, 8 px off does not.
    near = Found("bolt", truth.at(1, 8), 9.5, 9.5, 170.0, origin_px=(9.5 + 4.9, 9.5))
    part = truth.score(near).parts[0]
    assert (part.outcome, part.error_mm) == ("right", (0.0, 0.0))
    assert part.iou is not None
    assert part.iou < 0.3
    # The size of a part is the root of its area, 10 px: 5 px are allowed.
    far = Found("bolt", truth.at(1, 8), 9.5, 9.5, 170.0, origin_px=(9.5 + 5.1, 9.5))
    score = truth.score(far)
    assert score.parts[0].outcome == "nothing"
    # A fifth of it lies on the part.
    assert [stray.called for stray in score.spurious] == ["bolt"]
    # Unknown objects have no origin that could be near.
    assert truth.score(Found(None, truth.at(1, 8), origin_px=(9.5, 9.5))).parts[0].outcome == "nothing"


def test_names_on_the_bare_table_are_spurious(truth: Truth) -> None:
    table = np.zeros((20, 100), bool)
    table[:4, 90:] = True
    score = truth.score(Found("nut", table, origin_px=(94.5, 1.5)), Found(None, table), Found("rail", table & False))
    assert [(stray.called, stray.origin_px) for stray in score.spurious] == [
        ("nut", (94.5, 1.5)),
        ("rail", (1000.0, 1000.0)),
    ]
    assert {part.outcome for part in score.parts} == {"nothing"}


def test_hidden_parts_do_not_count(truth: Truth) -> None:
    truth.parts[truth.parts == 2] = 0
    assert [part.id for part in truth.score().parts] == [1, 3, 4]
    truth.parts[:] = 0
    empty = truth.score(Found("bolt", np.ones((20, 100), bool)))
    assert (empty.parts, len(empty.spurious)) == ([], 1)


def test_truth_without_poses_is_refused(truth: Truth) -> None:
    del truth.poses[3]
    with pytest.raises(DataError, match=r"gt/0001\.json: instance 3 has no yaw_deg"):
        truth.score()
    truth.poses[3] = truth.poses[1]
    with pytest.raises(ValueError, match=r"\(2, 2\) in an image of shape \(20, 100\)"):
        truth.score(Found("bolt", np.ones((2, 2), bool)))


def test_matching_is_one_to_one_and_overlap_comes_first() -> None:
    far = np.full((2, 2), np.inf)
    assert match(np.array([[0.9, 0.8], [0.85, 0.0]]), far) == {0: 0}
    assert match(np.array([[0.9, 0.8], [0.95, 0.0]]), far) == {1: 0, 0: 1}
    # The second part is nearest to a detection that the first overlaps.
    assert match(np.array([[0.3, 0.0], [0.0, 0.0]]), np.array([[1.0, 1.0], [0.0, 0.5]])) == {0: 0, 1: 1}
    assert match(np.zeros((0, 3)), np.zeros((0, 3))) == {}
