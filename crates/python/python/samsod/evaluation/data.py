"""Reads folders of scenes with known truth.

    SPLIT/index.json            {"scenes": [{"scene": "0001", "scenario": .., "table": .., "lighting": ..}, ..]}
    SPLIT/images/0001.jpg       8-bit RGB
    SPLIT/masks/0001.png        8-bit part ids, 0 = table
    SPLIT/shadows/0001.png      8-bit, more than 127 = cast shadow on the table
    SPLIT/gt/0001.json          {"instances": [{"id": 1, "part": "flange"}, ..], "K": 3 rows of 3,
                                "dist": [k1, k2, p1, p2, k3], "T_world_camera": 4 rows of 4}

Recognition needs templates beside the scenes (`samsod.evaluation.catalogue`), and of every instance "x_mm", "y_mm",
"yaw_deg", "height_mm", "textured", "shape_symmetry_order" and "appearance_symmetry_order" (`TruePart`).

Only the files and fields named here are used. Pixel centres are at integers; K is in px and `T_world_camera`, from
camera axes (x right, y down, z forward) to a world whose plane z = 0 is the table, in mm.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image, UnidentifiedImageError

FORMAT = "expected a folder of scenes (index.json, images/, masks/, shadows/, gt/) or the folder above such folders"


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

    @property
    def files(self) -> dict[str, Path]:
        """The files of the scene by the folder that they lie in."""
        suffixes = {"images": "jpg", "masks": "png", "shadows": "png", "gt": "json"}
        return {kind: self.folder / kind / f"{self.name}.{suffix}" for kind, suffix in suffixes.items()}


@dataclass(frozen=True)
class TrueCamera:
    """The camera that a scene was rendered with.

    Attributes:
        matrix: K, float64 (3, 3), in px.
        distortion: k1 k2 p1 p2 k3 of OpenCV's model, float64 (5,).
        world_from_camera: pose, float64 (4, 4), in mm.
    """

    matrix: npt.NDArray[np.float64]
    distortion: npt.NDArray[np.float64]
    world_from_camera: npt.NDArray[np.float64]

    def resized(self, x: float, y: float) -> TrueCamera:
        """The camera whose image is `x` times as wide and `y` times as high; pixel centres stay at integers."""
        # Edges of pixels, which lie half a pixel off the centres, are what a change of size multiplies.
        scale = np.array([[x, 0.0, 0.5 * x - 0.5], [0.0, y, 0.5 * y - 0.5], [0.0, 0.0, 1.0]])
        return TrueCamera(scale @ self.matrix, self.distortion, self.world_from_camera)


@dataclass(frozen=True)
class TruePart:
    """How a part of a scene lies, and what it looks like.

    Attributes:
        x_mm, y_mm: its origin on the table.
        yaw_deg: rotation about world z, counter-clockwise seen from above.
        height_mm: height over the table.
        textured: whether it has lettering or other marks that local features can tell.
        shape_order, appearance_order: a turn by 360 / n degrees gives the same outline, the same picture; 0: any does.
    """

    x_mm: float
    y_mm: float
    yaw_deg: float
    height_mm: float
    textured: bool
    shape_order: int
    appearance_order: int

    @staticmethod
    def of(instance: Mapping[str, Any]) -> TruePart:
        """From an instance of gt/.

        Raises:
            KeyError: it lacks a key.
            ValueError, TypeError: a value is not a number.
        """
        numbers = {key: float(instance[key]) for key in ("x_mm", "y_mm", "yaw_deg", "height_mm")}
        for key, value in numbers.items():
            if not math.isfinite(value):
                raise ValueError(f"{key} is {value}; expected a finite number")
        shape, appearance = (int(instance[f"{kind}_symmetry_order"]) for kind in ("shape", "appearance"))
        if min(shape, appearance) < 0:
            raise ValueError(f"symmetry orders {shape} and {appearance}; allowed are 0 and more")
        return TruePart(**numbers, textured=bool(instance["textured"]), shape_order=shape, appearance_order=appearance)


@dataclass(frozen=True)
class SceneData:
    """Pixels and truth of one scene.

    Attributes:
        rgb: uint8 (H, W, 3).
        parts: uint8 (H, W); 0 = table, k = part with id k.
        shadow: bool (H, W); cast shadow on the table.
        names: part name of each id.
        camera: the true camera of these pixels; None for a picture without truth.
        poses: how the part of each id lies; without those that gt/ says less of.
    """

    rgb: npt.NDArray[np.uint8]
    parts: npt.NDArray[np.uint8]
    shadow: npt.NDArray[np.bool_]
    names: dict[int, str] = field(default_factory=dict)
    camera: TrueCamera | None = None
    poses: dict[int, TruePart] = field(default_factory=dict)

    @property
    def truth(self) -> npt.NDArray[np.bool_]:
        """Part or cast shadow, bool (H, W)."""
        mask: npt.NDArray[np.bool_] = (self.parts > 0) | self.shadow
        return mask


def read_json(path: Path) -> Any:
    """Reads a JSON file.

    Raises:
        DataError: it is missing, not readable or not JSON.
    """
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


def find_split(data: Path, split: str | None = None) -> Path:
    """The folder of scenes that is meant by a path.

    Args:
        data: a folder of scenes, or the folder above several.
        split: name of the folder of scenes; None takes `data` itself, "dev", or the only one there is.

    Raises:
        DataError: there is no such folder, or it is not clear which is meant.
    """
    if not data.is_dir():
        raise DataError(f"{data}: {'not a folder' if data.exists() else 'no such folder'}; {FORMAT}")
    if (data / "index.json").is_file() and split in (None, data.resolve().name):
        return data
    splits = sorted(path.parent.name for path in data.glob("*/index.json"))
    if not splits:
        if (data / "index.json").is_file():
            raise DataError(f"{data}: a folder of scenes itself, without a split {split!r}")
        raise DataError(f"{data}: no index.json in it nor in a folder of it; {FORMAT}")
    if split is None:
        if "dev" not in splits and len(splits) > 1:
            raise DataError(f"{data}: has the splits {', '.join(splits)}; choose one with --split or give its folder")
        split = "dev" if "dev" in splits else splits[0]
    if split not in splits:
        raise DataError(f"{data}: no split {split!r}; it has {', '.join(splits)}")
    return data / split


def list_scenes(folder: Path) -> list[SceneInfo]:
    """Lists the scenes of a folder in their order.

    Args:
        folder: the folder of scenes, which holds index.json.

    Raises:
        DataError: the index is missing, not in the format above, or names a scene that lacks a file.
    """
    path = folder / "index.json"
    index = read_json(path)
    try:
        scenes = [
            SceneInfo(str(s["scene"]), folder, str(s["scenario"]), str(s["table"]), str(s["lighting"]))
            for s in index["scenes"]
        ]
    except (KeyError, TypeError) as error:
        raise DataError(f"{path}: not an index of scenes ({error!r})") from error
    if not scenes:
        raise DataError(f"{path}: no scenes")
    # Now rather than after half an hour.
    for info in scenes:
        for file in info.files.values():
            if not file.is_file():
                raise DataError(f"{file}: no such file, but {path} lists the scene {info.name!r}")
    return scenes


def load_scene(info: SceneInfo, scale: float = 1.0) -> SceneData:
    """Reads the pixels and the truth of one scene.

    Args:
        info: the scene.
        scale: factor on both sides, in (0, 1]; colours are averaged, labels taken from the nearest pixel.

    Raises:
        DataError: a file is missing, not readable, or its size differs from the image's.
    """
    files = info.files
    rgb = read_pixels(files["images"], "RGB")
    truth = {}
    for kind in ("masks", "shadows"):
        truth[kind] = read_pixels(files[kind], "L")
        if truth[kind].shape != rgb.shape[:2]:
            size = truth[kind].shape[::-1]
            raise DataError(f"{files[kind]}: size {size} differs from the image's {rgb.shape[1::-1]}")
    names, poses, camera = _read_truth(files["gt"])
    parts, shadow = truth["masks"], truth["shadows"]
    if scale != 1.0:
        height, width = rgb.shape[:2]
        rgb, parts, shadow = (
            _resized(pixels, scale, filter)
            for pixels, filter in ((rgb, Image.Resampling.BOX), (parts, _NEAREST), (shadow, _NEAREST))
        )
        camera = camera.resized(rgb.shape[1] / width, rgb.shape[0] / height)
    return SceneData(rgb=rgb, parts=parts, shadow=shadow > 127, names=names, camera=camera, poses=poses)


def _read_truth(path: Path) -> tuple[dict[int, str], dict[int, TruePart], TrueCamera]:
    """Part names and poses by id and the camera, from a file of gt/."""
    truth = read_json(path)
    try:
        names = {int(i["id"]): str(i["part"]) for i in truth["instances"]}
        # Scenes made for regions and objects alone know no poses.
        poses = {int(i["id"]): TruePart.of(i) for i in truth["instances"] if "yaw_deg" in i}
        camera = TrueCamera(
            matrix=read_numbers(truth, "K", (3, 3)),
            distortion=read_numbers(truth, "dist", (5,)),
            world_from_camera=read_numbers(truth, "T_world_camera", (4, 4)),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"{path}: not the truth of a scene ({error!r})") from error
    return names, poses, camera


def read_numbers(record: Mapping[str, Any], key: str, shape: tuple[int, ...]) -> npt.NDArray[np.float64]:
    """The entry of a JSON record as an array.

    Raises:
        KeyError: there is none.
        ValueError, TypeError: it has another shape, or holds what is not a finite number.
    """
    numbers = np.array(record[key], dtype=np.float64)
    if numbers.shape != shape or not np.isfinite(numbers).all():
        raise ValueError(f"{key} has shape {numbers.shape}; expected {shape}, finite")
    return numbers


_NEAREST = Image.Resampling.NEAREST


def _resized(pixels: npt.NDArray[np.uint8], scale: float, filter: Image.Resampling) -> npt.NDArray[np.uint8]:
    size = tuple(max(1, round(side * scale)) for side in pixels.shape[1::-1])
    return np.asarray(Image.fromarray(pixels).resize((size[0], size[1]), filter))
