"""Fits the judgement by which shadows are separated from parts, and measures it on scenes that it was not fitted to.

A piece is a row: its signs (`samsod.PIECE_SIGNS`), and the share of its pixels that show a part. Every scene is taken
more often: as a camera would see it in a third of the light, or a scene in low light in more; region by region, as if
nothing else lay on the table, for a cell is emptied part by part; and with regions whose shadows end elsewhere.

A second fit settles outlines: a pixel at the outline of what is judged part is a row (`samsod.FRINGE_SIGNS`), and
whether it shows a part. The pieces of a scene are judged there by trees that were not fitted to it, or outlines would
look better than they are.

Scenes are left out as a whole, with their copies, once in five groups and once table by table; what is then counted are
the masks that come out, not pieces.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import ndimage
from tqdm import tqdm

import samsod
from samsod.evaluation import metrics
from samsod.evaluation.chain import true_camera
from samsod.evaluation.data import DataError, SceneData, SceneInfo, find_split, list_scenes, load_scene
from samsod.evaluation.objects import FoundObject, ObjectScore, score_objects
from samsod.evaluation.trees import Floats, Forest, fit

GROUPS = 5
# Number, depth and rate of the trees for pieces,
TREES = (120, 5, 0.17)
# and for outlines: these have many more rows, so larger steps are as good, and small trees, which take half the time.
FRINGE_TREES = (96, 3, 0.3)
# Of the pixels at outlines every so many is a row: neighbours say the same.
FRINGE_EVERY = 3
# Weight of the rows of a copy.
COPY_WEIGHT = 0.5
# Of the rows of a copy this share, the lightest, is left out: small pieces tell little and are most of them.
COPY_LEFT_OUT = 0.4
# A camera in low light: factors on the exposure, electrons of a full pixel, gain, read noise in electrons.
DIMMED = (1.0 / 3.6, 1.0 / 2.2)
BRIGHTENED = 2.2
FULL_WELL, GAIN, READ_NOISE = 8500.0, 4.0, 8.0
# Where shadows end in copies, as shares of the table's light.
SHADOW_ENDS = (1.0, 0.9, 0.7)
# Demosaicing spreads the noise over neighbours, px.
NOISE_BLUR = 0.6


@dataclass(frozen=True)
class Rows:
    """The pieces of a frame.

    Attributes:
        signs: float32 (n, signs).
        parts: share of the pixels of each that show a part.
        weights: what each counts.
    """

    signs: Floats
    parts: Floats
    weights: Floats


@dataclass
class Described:
    """A scene, its pieces, and those of its copies: in other light, and region by region."""

    info: SceneInfo
    data: SceneData
    scene: samsod.Scene
    own: Rows
    copies: list[Rows]

    @property
    def seen(self) -> tuple[npt.NDArray[np.uint8], samsod.Partition, Floats, list[samsod.SalientRegion]]:
        """What the separation is given."""
        return self.data.rgb, self.scene.partition, self.scene.saliency, self.scene.regions


def in_other_light(rgb: npt.NDArray[np.uint8], lighting: str, seed: int) -> npt.NDArray[np.uint8]:
    """The frame in low light, with the noise of a gain of 4, or one of low light in more."""
    value = rgb / 255.0
    light = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    if lighting == "low":
        light = light * BRIGHTENED
    else:
        random = np.random.RandomState(seed)
        light = light * random.uniform(*DIMMED)
        noise = ndimage.gaussian_filter(random.normal(size=light.shape), (NOISE_BLUR, NOISE_BLUR, 0))
        deviation = np.sqrt(light * GAIN / FULL_WELL + (READ_NOISE / FULL_WELL) ** 2)
        light = light + deviation * noise / noise.std()
    light = np.clip(light, 0.0, 1.0)
    value = np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)
    return np.round(255.0 * value).astype(np.uint8)


def rows_of(
    rgb: npt.NDArray[np.uint8],
    parts: metrics.LabelImage,
    scene: samsod.Scene,
    regions: Sequence[samsod.SalientRegion],
) -> Rows:
    """The pieces of some regions of a frame."""
    labels, signs = samsod.describe_pieces(rgb, scene.partition, scene.saliency, regions)
    inside = labels >= 0
    pixels = np.bincount(labels[inside], minlength=len(signs))
    shown = np.bincount(labels[inside], weights=parts[inside] > 0, minlength=len(signs))
    share = shown / np.maximum(pixels, 1)
    # Pieces that show both tell little; large regions must not outweigh small parts.
    size = np.exp(signs[:, samsod.PIECE_SIGNS.index("region_pixels")])
    weights = pixels * np.abs(2.0 * share - 1.0) / np.sqrt(size)
    return Rows(signs, share.astype(np.float32), weights.astype(np.float32))


def describe(cell: samsod.Cell, others: Sequence[samsod.Cell], info: SceneInfo, seed: int) -> Described:
    """The pieces of a scene and of its copies; `others` let shadows end elsewhere."""
    data = load_scene(info)
    scene = cell.inspect(data.rgb)
    copy = in_other_light(data.rgb, info.lighting, seed)
    copied = cell.inspect(copy)
    copies = [rows_of(copy, data.parts, copied, copied.regions)]
    copies += [rows_of(data.rgb, data.parts, scene, [region]) for region in scene.regions]
    for other in others:
        elsewhere = other.inspect(data.rgb)
        copies.append(rows_of(data.rgb, data.parts, elsewhere, elsewhere.regions))
    return Described(info, data, scene, rows_of(data.rgb, data.parts, scene, scene.regions), copies)


def fit_to(scenes: Iterable[Described]) -> Forest:
    """The trees of these scenes and their copies."""
    rows: list[Rows] = []
    for described in scenes:
        rows.append(described.own)
        for copy in described.copies:
            if len(copy.weights):
                kept = copy.weights > np.quantile(copy.weights, COPY_LEFT_OUT)
                rows.append(Rows(copy.signs[kept], copy.parts[kept], COPY_WEIGHT * copy.weights[kept]))
    signs, parts = np.concatenate([r.signs for r in rows]), np.concatenate([r.parts for r in rows])
    return fit(signs, parts, np.concatenate([r.weights for r in rows]), *TREES)


def judged_left_out(scenes: Sequence[Described], groups: Sequence[Sequence[int]]) -> list[Floats]:
    """Probabilities of a part for the pieces of every scene, by trees that were fitted to the other groups."""
    judged: dict[int, Floats] = {}
    for group in tqdm(groups, unit="fit", file=sys.stderr):
        forest = fit_to(scene for i, scene in enumerate(scenes) if i not in group)
        judged |= {i: forest.probabilities(scenes[i].own.signs) for i in group}
    return [judged[i] for i in range(len(scenes))]


def settled_left_out(
    scenes: Sequence[Described], groups: Sequence[Sequence[int]], judged: Sequence[Floats], fringes: Sequence[Rows]
) -> list[ObjectScore]:
    """The scores of every scene, its outlines settled by trees that were fitted to those of the other groups."""
    scores: dict[int, ObjectScore] = {}
    for group in groups:
        forest = fit_fringe(rows for i, rows in enumerate(fringes) if i not in group)
        scores |= {i: score(scenes[i], judged[i], forest.probabilities(fringes[i].signs)) for i in group}
    return [scores[i] for i in range(len(scenes))]


def fringe_rows(described: Described, judged: Floats) -> Rows:
    """The pixels at the outlines of what is judged part."""
    places, signs = samsod.describe_fringe(*described.seen, judged)
    parts = (described.data.parts[places[:, 1], places[:, 0]] > 0).astype(np.float32)
    return Rows(signs, parts, np.ones(len(parts), np.float32))


def fit_fringe(rows: Iterable[Rows]) -> Forest:
    """The trees of these outlines."""
    kept = [(each.signs[::FRINGE_EVERY], each.parts[::FRINGE_EVERY]) for each in rows]
    signs, parts = np.concatenate([signs for signs, _ in kept]), np.concatenate([parts for _, parts in kept])
    return fit(signs, parts, np.ones(len(parts), np.float32), *FRINGE_TREES)


def score(described: Described, judged: Floats | None = None, fringe: Floats | None = None) -> ObjectScore:
    """The objects that probabilities of pieces and of outlines give, or what is built in, against the truth."""
    info, data, scene = described.info, described.data, described.scene
    objects = samsod.separate_shadows(*described.seen, parts=judged, fringe=fringe)
    regions = metrics.region_image(scene.partition.labels, [region.partitions for region in scene.regions])
    centroids = [region.centroid for region in scene.regions]
    found = [FoundObject.of(each) for each in objects]
    return score_objects(info, data, true_camera(info, data), regions, centroids, found, [])


def scored_by(described: Described, pieces: Forest, outlines: Forest) -> ObjectScore:
    """The score of a scene by these trees."""
    judged = pieces.probabilities(described.own.signs)
    return score(described, judged, outlines.probabilities(fringe_rows(described, judged).signs))


def line(name: str, scores: Sequence[ObjectScore]) -> str:
    """A line of the table."""
    parts = [part for each in scores for part in each.parts if part.iou is not None]
    errors = [np.abs(part.after_mm) for part in parts if part.after_mm is not None]
    shadow, shadow_found = sum(s.shadow.shadow_px for s in scores), sum(s.shadow.shadow_found_px for s in scores)
    solid, lost = sum(s.shadow.object_px for s in scores), sum(s.shadow.object_lost_px for s in scores)
    iou = np.mean([part.iou for part in parts]) if parts else np.nan
    found_share, lost_share = shadow_found / max(shadow, 1), lost / max(solid, 1)
    # Trees that find no object at all have no errors of places.
    x, y = np.mean(errors, axis=0) if errors else (np.nan, np.nan)
    return f"| {name} | {len(parts)} | {iou:.3f} | {found_share:.3f} | {lost_share:.3f} | {x:.2f} | {y:.2f} |"


def report(scenes: Sequence[Described], results: Mapping[str, Sequence[ObjectScore]]) -> str:
    """The table: IoU over detected parts, share of the shadow found and of the objects lost, errors of places."""
    lines = ["| judgement fitted to, scenes | parts | IoU | shadow found | object lost | x, mm | y, mm |"]
    lines.append("|---|---|---|---|---|---|---|")
    tables = sorted({scene.info.table for scene in scenes})
    for name, scores in results.items():
        pairs = list(zip(scenes, scores, strict=True))
        of = {
            "not oblique": [score for scene, score in pairs if not scene.info.oblique],
            "oblique": [score for scene, score in pairs if scene.info.oblique],
        }
        for table in tables:
            of[table] = [score for scene, score in pairs if scene.info.table == table and not scene.info.oblique]
        lines += [line(f"{name}, {which}", chosen) for which, chosen in of.items() if chosen]
    return "\n".join(lines)


def written(forest: Forest) -> str:
    """The trees as crates/shadow/src/judgement.in has them."""

    def numbers(values: Iterable[object]) -> str:
        return ", ".join(str(value) for value in values)

    lines = [
        f"// {len(forest.leaves)} trees; `python -m samsod.evaluation judgement` wrote them, see docs/vision.md.",
        "Forest {",
        # As few digits as tell them apart.
        f"    unit: {np.float32(forest.unit)!s},",
        f"    middles: [{numbers(forest.middles)}],",
        f"    steps: [{numbers(forest.steps)}],",
        "    trees: &[",
    ]
    for columns, bounds, leaves in zip(forest.columns, forest.bounds, forest.leaves, strict=True):
        questions = numbers(f"({c}, {b})" for c, b in zip(columns, bounds, strict=True))
        lines += [f"        Tree {{ questions: [{questions}],", f"            leaves: [{numbers(leaves)}] }},"]
    return "\n".join([*lines, "    ],", "}", ""])


def run(arguments: argparse.Namespace) -> int:
    """The verb `judgement`."""
    folder = find_split(arguments.dir, None)
    infos = list_scenes(folder)
    if len(infos) < GROUPS:
        raise DataError(f"{folder}: {len(infos)} scenes; {GROUPS} are needed")
    cell = samsod.Cell()
    others = [samsod.Cell({"segment": {"penumbra_light": light}}) for light in SHADOW_ENDS]
    progress = tqdm(infos, unit="scene", file=sys.stderr)
    scenes = [describe(cell, others, info, seed) for seed, info in enumerate(progress, 1)]
    results = {"built in": [score(scene) for scene in scenes]}
    order = np.random.RandomState(0).permutation(len(scenes))
    by_scene = [order[k::GROUPS].tolist() for k in range(GROUPS)]
    judged = judged_left_out(scenes, by_scene)
    fringes = [fringe_rows(scene, own) for scene, own in zip(scenes, judged, strict=True)]
    if not arguments.no_validation:
        results["other scenes"] = settled_left_out(scenes, by_scene, judged, fringes)
        tables = sorted({scene.info.table for scene in scenes})
        by_table = [[i for i, scene in enumerate(scenes) if scene.info.table == table] for table in tables]
        elsewhere = judged_left_out(scenes, by_table)
        outlines_elsewhere = [fringe_rows(scene, own) for scene, own in zip(scenes, elsewhere, strict=True)]
        results["other tables"] = settled_left_out(scenes, by_table, elsewhere, outlines_elsewhere)
    pieces, outlines = fit_to(scenes), fit_fringe(fringes)
    results["these scenes"] = [scored_by(scene, pieces, outlines) for scene in scenes]
    print(report(scenes, results))
    if arguments.out:
        for name, forest in (("judgement.in", pieces), ("fringe.in", outlines)):
            (arguments.out / name).write_text(written(forest), encoding="utf-8")
            print(f"written to {arguments.out / name}", file=sys.stderr)
    return 0
