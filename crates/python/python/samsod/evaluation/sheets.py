"""Contact sheets: one PNG a scene, frame | partitions | saliency | regions side by side."""

from __future__ import annotations

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


def panels(data: SceneData, result: Inspection, score: SceneScore) -> list[Picture]:
    """The four panels of a scene, each uint8 (H, W, 3)."""
    frame = data.rgb.copy()
    outline(frame, data.shadow, TRUE_SHADOW, 1)
    for part in np.unique(data.parts[data.parts > 0]):
        outline(frame, data.parts == part, TRUE_PART)

    colours = np.clip(result.means.round(), 0, 255).astype(np.uint8)
    partitions = colours[result.labels]
    partitions[borders(result.labels)] = (0, 0, 0)

    regions = (data.rgb // 2).astype(np.uint8)
    image = metrics.region_image(result.labels, result.regions)
    inside = image > 0
    regions[inside] = data.rgb[inside]
    spurious = set(metrics.spurious_regions(image, data.truth))
    for number in range(1, len(result.regions) + 1):
        outline(regions, image == number, SPURIOUS if number in spurious else REGION)
    for part in score.missed_ids:
        outline(regions, data.parts == part, MISSED, 3)
    return [frame, partitions, saliency_picture(result.saliency), regions]


def write_sheet(path: Path, data: SceneData, result: Inspection, score: SceneScore, panel_width: int = 720) -> None:
    """Writes the contact sheet of a scene.

    Args:
        path: PNG file.
        panel_width: width of one panel in pixels; the height follows.
    """
    height = round(data.rgb.shape[0] * panel_width / data.rgb.shape[1])
    caption = 22
    sheet = Image.new("RGB", (4 * panel_width, height + caption), (24, 24, 24))
    for column, picture in enumerate(panels(data, result, score)):
        panel = Image.fromarray(picture).resize((panel_width, height), Image.Resampling.LANCZOS)
        sheet.paste(panel, (column * panel_width, caption))
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
