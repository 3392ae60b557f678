"""Contact sheets of the recognition, one PNG a scene: what is there | what was recognised."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

import samsod
from samsod.evaluation.data import SceneData, SceneInfo
from samsod.evaluation.recognition import NamedPart, RecognitionScore
from samsod.evaluation.sheets import Picture, outline, side_by_side

TRUE = (0, 255, 0)
ABSENT = (0, 200, 255)
RIGHT = (0, 255, 0)
WRONG = (255, 60, 60)
UNKNOWN = (255, 220, 0)
STRAY = (255, 0, 255)
TOP_PX = 22
LINE_PX = 13
#: Length of the drawn x axis in px of the frame.
AXIS_PX = 28.0

Text = tuple[tuple[float, float], str, tuple[int, int, int]]


def write_recognition_sheet(
    path: Path,
    data: SceneData,
    info: SceneInfo,
    score: RecognitionScore,
    detections: Sequence[samsod.Detection],
    panel_width: int = 1078,
) -> None:
    """Writes the contact sheet of a scene.

    Args:
        path: PNG file.
        data: the scene.
        info: where it is from.
        score: its recognition.
        detections: what the method "best" says of it.
        panel_width: width of one panel in pixels; the height follows.
    """
    best = score.methods["best"]
    truth = data.rgb.copy()
    labels: list[Text] = []
    for part in best.parts:
        visible = data.parts == part.id
        colour = TRUE if part.known else ABSENT
        outline(truth, visible, colour)
        labels.append((_below(visible), f"{part.part} {data.poses[part.id].yaw_deg:.0f}°", colour))
    found = data.rgb.copy()
    names: list[Text] = []
    for detection in detections:
        colour = _colour(data, detection, best.parts)
        outline(found, detection.mask, colour)
        name = detection.name or "unknown"
        angle = "" if detection.yaw_deg is None else f" {detection.yaw_deg:.0f}°"
        if detection.name is not None:
            _axis(found, detection.origin_px, detection.angle_deg, colour)
        names.append(
            (
                _below(detection.mask, detection.origin_px),
                f"{name}{angle}\n{detection.score:.2f} {detection.method}",
                colour,
            )
        )

    sheet = side_by_side([truth, found], panel_width, top=TOP_PX)
    draw = ImageDraw.Draw(sheet)
    scale = panel_width / data.rgb.shape[1]
    for column, texts in enumerate((labels, names)):
        for (x, y), text, colour in texts:
            # A part at the lower edge has its name over it.
            y = min(scale * y, scale * data.rgb.shape[0] - 2 * LINE_PX)
            place = (column * panel_width + scale * x, TOP_PX + y)
            draw.multiline_text(
                place,
                text,
                fill=colour,
                font=ImageFont.load_default(LINE_PX),
                anchor="ma",
                align="center",
                stroke_width=1,
                stroke_fill=(0, 0, 0),
            )
    counts = {outcome: sum(part.outcome == outcome for part in best.parts) for outcome in OUTCOMES}
    head = f"{info.name}  {info.table}, {info.lighting}, {info.scenario}: truth (blue: not in the catalogue)"
    draw.text((6, 5), head, fill=(255, 255, 255))
    legend = (
        ", ".join(f"{count} {outcome}" for outcome, count in counts.items())
        + f", {len(best.spurious)} spurious (green right, red wrong, yellow unknown, magenta on no part)"
    )
    draw.text((panel_width + 6, 5), legend, fill=(255, 255, 255))
    sheet.save(path, optimize=True)


OUTCOMES = ("right", "wrong", "unknown", "nothing")


def _colour(data: SceneData, detection: samsod.Detection, parts: Sequence[NamedPart]) -> tuple[int, int, int]:
    """By what lies below most of its mask; good enough for a picture."""
    if detection.name is None:
        return UNKNOWN
    below = np.bincount(data.parts[detection.mask], minlength=1)
    if not below.any() or below.argmax() == 0:
        return STRAY
    under = int(below.argmax())
    right = any(part.id == under and part.known and part.part == detection.name for part in parts)
    return RIGHT if right else WRONG


def _below(mask: npt.NDArray[np.bool_], otherwise: tuple[float, float] = (0.0, 0.0)) -> tuple[float, float]:
    """The place (x, y) of a name under a mask (H, W): the middle of its lower edge, or another place if it is empty."""
    rows, columns = np.nonzero(mask)
    if not len(rows):
        return otherwise
    return 0.5 * (float(columns.min()) + float(columns.max())), float(rows.max()) + 3.0


def _axis(picture: Picture, origin: tuple[float, float], angle_deg: float, colour: tuple[int, int, int]) -> None:
    """Draws the x axis of a part into a picture (H, W, 3), in place; its angle is counter-clockwise on the screen."""
    angle = np.radians(angle_deg)
    end = (origin[0] + AXIS_PX * np.cos(angle), origin[1] - AXIS_PX * np.sin(angle))
    canvas = Image.fromarray(picture)
    ImageDraw.Draw(canvas).line([origin, end], fill=colour, width=2)
    picture[:] = np.asarray(canvas)
