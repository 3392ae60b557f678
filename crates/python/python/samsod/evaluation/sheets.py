"""Contact sheets, one PNG a scene: frame | partitions | saliency | regions, or truth | objects | paper's objects."""

from __future__ import annotations

from collections.abc import Container, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw
from scipy import ndimage

from samsod.evaluation import metrics
from samsod.evaluation.cell import Inspection, SceneScore
from samsod.evaluation.data import SceneData, SceneInfo
from samsod.evaluation.objects import ObjectScore, Separated, ShadowCount, mask_centroid, shadow_labels

Picture = npt.NDArray[np.uint8]

TRUE_PART = (0, 255, 0)
TRUE_SHADOW = (80, 160, 255)
REGION = (255, 220, 0)
MISSED = (255, 0, 0)
SPURIOUS = (255, 0, 255)
OBJECT = (255, 220, 0)
SHADOW = (80, 160, 255)
BEFORE = (255, 60, 60)

#: Background saliency lies at thousandths: a linear scale would show black.
GAMMA = 0.4


def borders(labels: npt.NDArray[np.integer]) -> npt.NDArray[np.bool_]:
    """Pixels whose right or lower neighbour has another label, bool (H, W)."""
    edge = np.zeros(labels.shape, dtype=np.bool_)
    edge[:, :-1] |= labels[:, :-1] != labels[:, 1:]
    edge[:-1, :] |= labels[:-1, :] != labels[1:, :]
    return edge


def outline(picture: Picture, mask: npt.NDArray[np.bool_], colour: tuple[int, int, int], width: int = 2) -> None:
    """Draws the inner border of a mask into a picture (H, W, 3), in place; `width` in pixels."""
    inner = ndimage.binary_erosion(mask, iterations=width, border_value=0)
    picture[mask & ~inner] = colour


def saliency_picture(saliency: npt.NDArray[np.floating]) -> Picture:
    """Grey picture (H, W, 3) of a saliency map, stretched to its maximum and gamma-lifted."""
    top = float(saliency.max(initial=0.0))
    grey = (saliency / top if top > 0 else np.zeros_like(saliency)) ** GAMMA
    return np.repeat((grey * 255).round().astype(np.uint8)[:, :, None], 3, axis=2)


def partition_picture(labels: npt.NDArray[np.integer], means: npt.NDArray[np.floating]) -> Picture:
    """Partitions in their mean colours with black borders, (H, W, 3)."""
    colours = np.clip(means.round(), 0, 255).astype(np.uint8)
    picture: Picture = colours[labels]
    picture[borders(labels)] = (0, 0, 0)
    return picture


def region_picture(rgb: Picture, regions: npt.NDArray[np.integer], spurious: Container[int] = ()) -> Picture:
    """The frame, darkened outside the regions, and their outlines; the spurious ones in their own colour."""
    # Two pixels or more when a frame of any size is shown some 500 pixels wide.
    width = max(2, rgb.shape[1] // 250)
    picture: Picture = rgb // 2
    inside = regions > 0
    picture[inside] = rgb[inside]
    for number in np.unique(regions[inside]):
        outline(picture, regions == number, SPURIOUS if number in spurious else REGION, width)
    return picture


def panels(data: SceneData, result: Inspection, score: SceneScore) -> list[Picture]:
    """The four panels of a scene with known truth, each uint8 (H, W, 3)."""
    frame = data.rgb.copy()
    outline(frame, data.shadow, TRUE_SHADOW, 1)
    for part in np.unique(data.parts[data.parts > 0]):
        outline(frame, data.parts == part, TRUE_PART)
    image = metrics.region_image(result.labels, result.regions)
    regions = region_picture(data.rgb, image, set(metrics.spurious_regions(image, data.truth)))
    for part in score.missed_ids:
        outline(regions, data.parts == part, MISSED, 3)
    return [frame, partition_picture(result.labels, result.means), saliency_picture(result.saliency), regions]


def side_by_side(pictures: Sequence[Picture], panel_width: int, top: int = 0) -> Image.Image:
    """Panels in a row, each `panel_width` pixels wide, below a dark strip of `top` pixels."""
    height = round(pictures[0].shape[0] * panel_width / pictures[0].shape[1])
    sheet = Image.new("RGB", (len(pictures) * panel_width, height + top), (24, 24, 24))
    for column, picture in enumerate(pictures):
        panel = Image.fromarray(picture).resize((panel_width, height), Image.Resampling.LANCZOS)
        sheet.paste(panel, (column * panel_width, top))
    return sheet


def write_stages(path: Path, rgb: Picture, result: Inspection, panel_width: int) -> None:
    """Writes a picture of the stages of any frame: frame | partitions | saliency | regions.

    Args:
        path: PNG file.
        rgb: uint8 (H, W, 3).
        result: what the chain says of it.
        panel_width: width of one panel in pixels; the height follows.
    """
    regions = region_picture(rgb, metrics.region_image(result.labels, result.regions))
    row = [rgb, partition_picture(result.labels, result.means), saliency_picture(result.saliency), regions]
    side_by_side(row, panel_width).save(path, optimize=True)


def write_sheet(path: Path, data: SceneData, result: Inspection, score: SceneScore, panel_width: int = 720) -> None:
    """Writes the contact sheet of a scene.

    Args:
        path: PNG file.
        panel_width: width of one panel in pixels; the height follows.
    """
    sheet = side_by_side(panels(data, result, score), panel_width, top=22)
    draw = ImageDraw.Draw(sheet)
    head = (
        f"{score.scene}  {score.table}, {score.lighting}, {score.scenario}: {score.found} of {score.parts} found, "
        f"{score.cut} cut, {score.spurious} spurious, IoU {score.iou:.3f} (bound {score.bound_iou:.3f})"
    )
    draw.text((6, 5), head, fill=(255, 255, 255))
    draw.text((panel_width + 6, 5), f"{score.partitions} partitions", fill=(255, 255, 255))
    draw.text((2 * panel_width + 6, 5), f"saliency, largest {result.saliency.max():.3f}", fill=(255, 255, 255))
    legend = (
        f"{score.regions} regions (yellow), spurious (magenta), missed parts (red): {', '.join(score.missed_parts)}"
    )
    draw.text((3 * panel_width + 6, 5), legend, fill=(255, 255, 255))
    sheet.save(path, optimize=True)


def tint(picture: Picture, mask: npt.NDArray[np.bool_], colour: tuple[int, int, int]) -> None:
    """Mixes a colour in equal parts into the pixels of a mask of a picture (H, W, 3), in place."""
    picture[mask] = (picture[mask].astype(np.uint16) + np.array(colour, dtype=np.uint16)) // 2


def cross(picture: Picture, place: tuple[float, float], colour: tuple[int, int, int]) -> None:
    """Draws a cross at (x, y) into a picture (H, W, 3), in place."""
    width = picture.shape[1]
    x, y = round(place[0]), round(place[1])
    arm = max(4, width // 130)
    for rows, columns in (
        (slice(y - 1, y + 2), slice(x - arm, x + arm + 1)),
        (slice(y - arm, y + arm + 1), slice(x - 1, x + 2)),
    ):
        picture[max(rows.start, 0) : max(rows.stop, 0), max(columns.start, 0) : max(columns.stop, 0)] = colour


def object_picture(rgb: Picture, regions: npt.NDArray[np.integer], objects: Sequence[Separated]) -> Picture:
    """Shadows tinted, outlines of the objects and of the salient regions, centroids of the objects.

    Args:
        rgb: uint8 (H, W, 3).
        regions: 0 outside, k + 1 in salient region k (H, W).
        objects: objects cut from them.
    """
    picture = rgb.copy()
    tint(picture, shadow_labels(regions, objects), SHADOW)
    picture[borders(regions)] = BEFORE
    for separated in objects:
        outline(picture, separated.mask, OBJECT)
        cross(picture, separated.centroid, OBJECT)
    return picture


def truth_picture(data: SceneData, centroids: Sequence[tuple[float, float]]) -> Picture:
    """True shadows tinted, outlines and centroids of the true parts, centroids of the salient regions."""
    picture = data.rgb.copy()
    tint(picture, data.shadow, SHADOW)
    for part in np.unique(data.parts[data.parts > 0]):
        visible = data.parts == part
        outline(picture, visible, TRUE_PART)
        cross(picture, mask_centroid(visible), TRUE_PART)
    for centroid in centroids:
        cross(picture, centroid, BEFORE)
    return picture


def write_object_sheet(
    path: Path, data: SceneData, result: Inspection, info: SceneInfo, score: ObjectScore, panel_width: int = 960
) -> None:
    """Writes the contact sheet of the objects of a scene: truth | objects by evidence | by the paper's rule.

    Args:
        path: PNG file.
        panel_width: width of one panel in pixels; the height follows.
    """
    regions = metrics.region_image(result.labels, result.regions)
    row = [
        truth_picture(data, result.centroids),
        object_picture(data.rgb, regions, result.objects),
        object_picture(data.rgb, regions, result.paper_objects),
    ]
    sheet = side_by_side(row, panel_width, top=22)
    draw = ImageDraw.Draw(sheet)
    detected = [part for part in score.parts if part.detected]
    texts = (
        f"{info.name}  {info.table}, {info.lighting}, {info.scenario}: truth (green, blue), places before (red cross)",
        f"objects (yellow), shadow (blue), regions (red): {_figures([part.iou for part in detected], score.shadow)}",
        f"by the paper's rule: {_figures([part.paper_iou for part in detected], score.paper_shadow)}",
    )
    for column, text in enumerate(texts):
        draw.text((column * panel_width + 6, 5), text, fill=(255, 255, 255))
    sheet.save(path, optimize=True)


def _figures(ious: Sequence[float | None], count: ShadowCount) -> str:
    known = [iou for iou in ious if iou is not None]
    mean = f"{np.mean(known):.3f}" if known else "-"
    recall = f"{100 * count.shadow_found_px / count.shadow_px:.1f} %" if count.shadow_px else "-"
    loss = f"{100 * count.object_lost_px / count.object_px:.1f} %" if count.object_px else "-"
    return f"mean IoU {mean}, shadow recall {recall}, object loss {loss}"
