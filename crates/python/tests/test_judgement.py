"""Pieces, their signs, other judgements of them, and the fitting of trees."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Frame

import samsod
from samsod.evaluation.judgement import FRINGE_TREES, TREES, in_other_light, written
from samsod.evaluation.trees import Forest, fit

FITTED = Path(__file__).parents[3] / "crates/shadow/src"


def test_pieces_of_a_frame(frame: Frame) -> None:
    scene = samsod.Cell().inspect(frame)
    labels, signs = samsod.describe_pieces(frame, scene.partition, scene.saliency, scene.regions)
    assert labels.dtype == np.int32
    assert labels.shape == frame.shape[:2]
    assert signs.dtype == np.float32
    assert signs.shape[1] == len(samsod.PIECE_SIGNS)
    assert np.array_equal(np.unique(labels), np.arange(-1, len(signs)))
    assert np.isfinite(signs).all()
    # The logarithm of its pixels is a sign of a piece.
    pixels = np.bincount(labels[labels >= 0])
    assert np.exp(signs[:, samsod.PIECE_SIGNS.index("pixels")]) == pytest.approx(pixels, rel=1e-4)


def test_another_judgement(frame: Frame) -> None:
    scene = samsod.Cell().inspect(frame)
    seen: Any = (frame, scene.partition, scene.saliency, scene.regions)
    labels, signs = samsod.describe_pieces(*seen)
    nothing = np.zeros(len(signs), dtype=np.float32)
    assert samsod.separate_shadows(*seen, parts=nothing) == []
    largest = max(scene.objects, key=lambda each: each.area)
    inside = np.bincount(labels[labels >= 0], weights=largest.mask[labels >= 0]) / np.bincount(labels[labels >= 0])
    only = samsod.separate_shadows(*seen, parts=(inside > 0.5).astype(np.float32))
    assert len(only) == 1
    assert np.count_nonzero(only[0].mask & largest.mask) > 0.95 * largest.area
    for wrong in (nothing[1:], np.full_like(nothing, np.nan), np.full_like(nothing, 1.5)):
        with pytest.raises(ValueError, match=f"probabilities for {len(signs)} pieces"):
            samsod.separate_shadows(*seen, parts=wrong)
    with pytest.raises(ValueError, match=r'object_side = "paper" with parts; allowed is "evidence"'):
        samsod.separate_shadows(frame, scene.partition, scene.saliency, scene.regions, "paper", parts=nothing)
    doubles: Any = np.zeros(len(signs))
    with pytest.raises(TypeError, match="parts: expected a C-contiguous float32 array"):
        samsod.separate_shadows(*seen, parts=doubles)


def test_pixels_at_outlines(frame: Frame) -> None:
    scene = samsod.Cell().inspect(frame)
    seen = (frame, scene.partition, scene.saliency, scene.regions)
    labels, _ = samsod.describe_pieces(*seen)
    largest = max(scene.objects, key=lambda each: each.area)
    inside = np.bincount(labels[labels >= 0], weights=largest.mask[labels >= 0]) / np.bincount(labels[labels >= 0])
    only = (inside > 0.5).astype(np.float32)
    places, fringe = samsod.describe_fringe(*seen, only)
    assert places.dtype == np.uint32
    assert fringe.shape == (len(places), len(samsod.FRINGE_SIGNS))
    assert np.isfinite(fringe).all()
    # They lie at the outline: a pixel of the object and one that is none are near.
    on = np.zeros(labels.shape, bool)
    on[places[:, 1], places[:, 0]] = True
    x, y = np.asarray(largest.outline).T
    assert on[y, x].mean() > 0.9
    # As many as are said to show an object do.
    objects = np.ascontiguousarray(fringe[:, samsod.FRINGE_SIGNS.index("object")])
    as_pieces = samsod.separate_shadows(*seen, parts=only, fringe=objects)
    none = samsod.separate_shadows(*seen, parts=only, fringe=np.zeros_like(objects))
    every = samsod.separate_shadows(*seen, parts=only, fringe=np.ones_like(objects))
    areas = [max(each.area for each in found) for found in (none, as_pieces, every)]
    assert areas[0] < areas[1] < areas[2]
    with pytest.raises(ValueError, match=f"probabilities for {len(places)} pixels at outlines"):
        samsod.separate_shadows(*seen, parts=only, fringe=objects[1:])
    with pytest.raises(ValueError, match="fringe without parts; it belongs to them"):
        samsod.separate_shadows(*seen, fringe=objects)


def test_trees_learn_a_rule_of_two_signs() -> None:
    random = np.random.RandomState(3)
    rows = random.uniform(-1.0, 1.0, (4000, 5)).astype(np.float32)
    labels = ((rows[:, 1] > 0.2) != (rows[:, 3] > -0.1)).astype(np.float32)
    forest = fit(rows, labels, np.ones(len(rows), np.float32), 80, 5, 0.17)
    other = random.uniform(-1.0, 1.0, (2000, 5)).astype(np.float32)
    truth = (other[:, 1] > 0.2) != (other[:, 3] > -0.1)
    assert np.mean((forest.probabilities(other) > 0.5) == truth) > 0.97
    again = fit(rows, labels, np.ones(len(rows), np.float32), 80, 5, 0.17)
    assert np.array_equal(forest.leaves, again.leaves)
    assert np.array_equal(forest.bounds, again.bounds)
    # Rows that weigh nothing teach nothing.
    weights = np.where(rows[:, 0] > 0, 1.0, 0.0).astype(np.float32)
    flipped = np.where(rows[:, 0] > 0, labels, 1 - labels).astype(np.float32)
    half = fit(rows, flipped, weights, 80, 5, 0.17)
    assert np.mean((half.probabilities(other) > 0.5) == truth) > 0.95


@pytest.mark.parametrize("depth", [1, 3, 5])
def test_the_answers_lead_to_a_leaf(depth: int) -> None:
    columns = np.array([[int(np.log2(k + 1)) for k in range(2**depth - 1)]])
    leaves = np.arange(2**depth)[None] - 2**depth // 2
    # Signs of 0 and 1 in hundredths.
    middles, steps = np.zeros(depth, np.float32), np.full(depth, 100.0, np.float32)
    forest = Forest(0.25, middles, steps, columns, np.full(columns.shape, 50), leaves)
    rows = np.array([[leaf >> (depth - 1 - k) & 1 for k in range(depth)] for leaf in range(2**depth)], np.float32)
    odds = 0.25 * leaves[0]
    assert forest.probabilities(rows) == pytest.approx(1 / (1 + np.exp(-odds)), rel=1e-5)
    assert written(forest).count("Tree {") == 1


def test_what_is_built_in_is_what_was_fitted(frame: Frame) -> None:
    """The trees as they are written answer in Python as they do in the separation."""
    scene = samsod.Cell().inspect(frame)
    seen = (frame, scene.partition, scene.saliency, scene.regions)
    pieces = read(FITTED / "judgement.in").probabilities(samsod.describe_pieces(*seen)[1])
    outlines = read(FITTED / "fringe.in").probabilities(samsod.describe_fringe(*seen, pieces)[1])
    found = samsod.separate_shadows(*seen, parts=pieces, fringe=outlines)
    built_in = samsod.separate_shadows(*seen)
    assert len(found) == len(built_in) > 0
    assert all(np.array_equal(a.mask, b.mask) for a, b in zip(found, built_in, strict=True))


def read(path: Path) -> Forest:
    """The trees of a file that `written` wrote."""
    text = path.read_text(encoding="utf-8")

    def numbers(name: str) -> list[list[float]]:
        lists = re.findall(rf"{name}: \[([^\]]+)\]", text)
        return [[float(number) for number in re.findall(r"-?\d[\d.]*(?:e-?\d+)?", each)] for each in lists]

    leaves = np.array(numbers("leaves"), np.int64)
    questions = np.array(numbers("questions"), np.int64).reshape(len(leaves), -1, 2)
    unit = re.search(r"unit: ([^,]+),", text)
    assert unit is not None
    middles, steps = (np.array(numbers(name)[0], np.float32) for name in ("middles", "steps"))
    return Forest(float(unit[1]), middles, steps, questions[..., 0], questions[..., 1], leaves)


@pytest.mark.parametrize(("name", "trees"), [("judgement.in", TREES), ("fringe.in", FRINGE_TREES)])
def test_what_is_built_in_is_of_the_size_that_is_fitted(name: str, trees: tuple[int, int, float]) -> None:
    number, depth, _ = trees
    text = (FITTED / name).read_text(encoding="utf-8")
    assert text.startswith(f"// {number} trees;")
    assert read(FITTED / name).leaves.shape == (number, 2**depth)


def test_a_frame_in_other_light(frame: Frame) -> None:
    dim = in_other_light(frame, "side", 1)
    assert dim.dtype == np.uint8
    assert dim.shape == frame.shape
    assert dim.mean() < 0.75 * frame.mean()
    assert np.array_equal(dim, in_other_light(frame, "side", 1))
    # Noise grows: neighbours differ more, for their brightness.
    rough = [np.abs(np.diff(each.astype(float), axis=1)).mean() / each.mean() for each in (dim, frame)]
    assert rough[0] > rough[1]
    assert in_other_light(frame, "low", 1).mean() > frame.mean()
