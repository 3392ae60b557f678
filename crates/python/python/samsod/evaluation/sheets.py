"""Contact sheets: one PNG a scene, frame | partitions | saliency | regions side by side."""

from __future__ import annotations

from collections.abc import Container, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw
from scipy import ndimage

from samsod.evaluation import metrics
from samsod.evaluation.cell import Inspection, SceneScore
from samsod.evaluation.data import SceneData

Picture = npt.NDArray[np.uint8]

TRUE_PART = (0, 255, 0)
TRUE_SHADOW = (80, 160, 255)
REGION = (255, 220, 0)
MISSED = (255, 0, 0)
SPURIOUS = (255, 0, 255)

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
