"""Reads folders of scenes with known truth.

    DIR/index.json              {"scenes": [{"scene": "0001", "scenario": .., "table": .., "lighting": ..}, ..]}
    DIR/images/0001.jpg         8-bit RGB
    DIR/masks/0001.png          8-bit part ids, 0 = table
    DIR/shadows/0001.png        8-bit, more than 127 = cast shadow on the table
    DIR/gt/0001.json            {"instances": [{"id": 1, "part": "flange"}, ..]}

Only the fields named here are used.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image, UnidentifiedImageError


class DataError(Exception):
    """A folder or file is not what the evaluation needs; the message names it."""


@dataclass(frozen=True)
class SceneInfo:
    """One scene of a split: where it lies and how it was made."""

    name: str
    folder: Path
    scenario: str
    table: str
    lighting: str

    @property
    def oblique(self) -> bool:
        """Whether the camera looks at a slant, which the chain's truth figures keep apart."""
        return self.scenario == "oblique"


@dataclass(frozen=True)
class SceneData:
    """Pixels and truth of one scene.

    Attributes:
        rgb: uint8 (H, W, 3).
        parts: uint8 (H, W); 0 = table, k = part with id k.
        shadow: bool (H, W); cast shadow on the table.
        names: part name of each id.
    """

    rgb: npt.NDArray[np.uint8]
    parts: npt.NDArray[np.uint8]
    shadow: npt.NDArray[np.bool_]
    names: dict[int, str] = field(default_factory=dict)

    @property
    def truth(self) -> npt.NDArray[np.bool_]:
        """Part or cast shadow, bool (H, W)."""
        mask: npt.NDArray[np.bool_] = (self.parts > 0) | self.shadow
        return mask


def _json(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise DataError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise DataError(f"{path}: {error}") from error


def read_pixels(path: Path, mode: str) -> npt.NDArray[np.uint8]:
    """Reads an image: uint8 (H, W, 3) in mode "RGB", (H, W) in mode "L".

    Raises:
        DataError: the file is missing, no image, or not grey although "L" was asked for.
    """
    try:
        with Image.open(path) as image:
            if mode == "L" and image.mode != "L":
                # Converting would turn the ids of a palette image into brightness.
                raise DataError(f"{path}: pixel mode {image.mode}; a mask must be 8-bit grey")
            return np.asarray(image.convert(mode), dtype=np.uint8)
    except FileNotFoundError:
        raise DataError(f"{path}: no such file") from None
    except UnidentifiedImageError:
        raise DataError(f"{path}: not an image") from None
    except OSError as error:
        raise DataError(f"{path}: {error}") from error


def list_scenes(root: Path, split: str) -> list[SceneInfo]:
    """Lists the scenes of a split in their order.

    Args:
        root: the data folder (or the folder of the split itself when it holds index.json).
        split: name of the split, such as "dev".

    Raises:
        DataError: the folder or its index is missing or not in the format above.
    """
    if not root.is_dir():
        raise DataError(f"{root}: no such folder")
    folder = root / split
    if not folder.is_dir():
        splits = sorted(path.parent.name for path in root.glob("*/index.json"))
        known = f"it has {', '.join(splits)}" if splits else "no folder in it has an index.json"
        raise DataError(f"{root}: no split {split!r}; {known}")
    index = _json(folder / "index.json")
    try:
        scenes = [
            SceneInfo(str(s["scene"]), folder, str(s["scenario"]), str(s["table"]), str(s["lighting"]))
            for s in index["scenes"]
        ]
    except (KeyError, TypeError) as error:
        raise DataError(f"{folder / 'index.json'}: not an index of scenes ({error!r})") from error
    if not scenes:
        raise DataError(f"{folder / 'index.json'}: no scenes")
    return scenes


def load_scene(info: SceneInfo, scale: float = 1.0) -> SceneData:
    """Reads the pixels and the truth of one scene.

    Args:
        info: the scene.
        scale: factor on both sides, in (0, 1]; colours are averaged, labels taken from the nearest pixel.

    Raises:
        DataError: a file is missing, not readable, or its size differs from the image's.
    """
    name = info.name
    rgb = read_pixels(info.folder / "images" / f"{name}.jpg", "RGB")
    truth = {}
    for kind in ("masks", "shadows"):
        path = info.folder / kind / f"{name}.png"
        truth[kind] = read_pixels(path, "L")
        if truth[kind].shape != rgb.shape[:2]:
            raise DataError(f"{path}: size {truth[kind].shape[::-1]} differs from the image's {rgb.shape[1::-1]}")
    path = info.folder / "gt" / f"{name}.json"
    try:
        names = {int(i["id"]): str(i["part"]) for i in _json(path)["instances"]}
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"{path}: not the truth of a scene ({error!r})") from error
    parts, shadow = truth["masks"], truth["shadows"]
    if scale != 1.0:
        rgb, parts, shadow = (
            _resized(pixels, scale, filter)
            for pixels, filter in ((rgb, Image.Resampling.BOX), (parts, _NEAREST), (shadow, _NEAREST))
        )
    return SceneData(rgb=rgb, parts=parts, shadow=shadow > 127, names=names)


_NEAREST = Image.Resampling.NEAREST


def _resized(pixels: npt.NDArray[np.uint8], scale: float, filter: Image.Resampling) -> npt.NDArray[np.uint8]:
    size = tuple(max(1, round(side * scale)) for side in pixels.shape[1::-1])
    return np.asarray(Image.fromarray(pixels).resize((size[0], size[1]), filter))
