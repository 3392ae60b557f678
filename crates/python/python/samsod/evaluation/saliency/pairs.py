"""Images with their masks and maps, paired by name, and everything that is wrong with them.

An image `a b.jpg` has the mask `a b.png` and, in the folder of a method, the map `a b.png`; the suffix may be any that
Pillow reads, and the name any that a file system takes. Nothing is skipped in silence: what cannot be used is a
`Problem` with the name of the file, and reports count them.
"""

from __future__ import annotations

import unicodedata
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image

from samsod.evaluation.data import DataError

#: What counts as an image, in lower case.
SUFFIXES = (".bmp", ".gif", ".jpeg", ".jpg", ".png", ".ppm", ".tif", ".tiff", ".webp")
#: Pixel modes of Pillow that are read: 8 bits a channel, palettes and bilevel. Of 16 bits "L" keeps the wrong 8.
MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "CMYK", "YCbCr")
#: A pixel of a mask above this is salient.
TRUTH_ABOVE = 127
#: Files of a problem that a report names; the rest are counted, and all stand in problems.csv.
NAMED = 5

Rgb = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Problem:
    """Something wrong with a file.

    Attributes:
        kind: what, in words that are the same for all such files; reports group by it.
        name: of the image that it concerns, without suffix, or of the file that belongs to none.
        detail: the file, and what there is to say of it.
        lost: whether the image is not measured for it: by any method, or by the method whose map it is.
    """

    kind: str
    name: str
    detail: str
    lost: bool = True


@dataclass(frozen=True)
class Pair:
    """An image and its files.

    Attributes:
        name: of the image, without suffix.
        image, mask: their files.
        maps: file of every method that has a map of it.
    """

    name: str
    image: Path
    mask: Path
    maps: Mapping[str, Path] = field(default_factory=dict)


@dataclass(frozen=True)
class Folder:
    """The files of one folder by their names without suffix, and what is wrong there."""

    path: Path
    files: Mapping[str, Path]
    problems: Sequence[Problem]

    @staticmethod
    def read(path: Path, what: str) -> Folder:
        """Lists the images of a folder; `what` they are stands in its problems.

        Raises:
            DataError: there is no such folder, or it holds no image.
        """
        if not path.is_dir():
            raise DataError(
                f"{path}: {'not a folder' if path.exists() else 'no such folder'}; {what}s are read from one"
            )
        try:
            entries = sorted(entry for entry in path.iterdir() if entry.is_file() and not entry.name.startswith("."))
        except OSError as error:
            raise DataError(f"{path}: {error}") from error
        files: dict[str, Path] = {}
        problems = []
        for entry in entries:
            name = key(entry)
            if entry.suffix.lower() not in SUFFIXES:
                problems.append(Problem(f"not an image among the {what}s", name, str(entry), lost=False))
            elif name in files:
                first = files[name].name
                problems.append(Problem(f"two {what}s of one name", name, f"{entry}: {first} is used", lost=False))
            else:
                files[name] = entry
        if not files:
            raise DataError(f"{path}: no {what} in it; expected files that end in {', '.join(SUFFIXES)}")
        return Folder(path, files, problems)


def key(path: Path) -> str:
    """The name that pairs a file: without suffix, composed, since file systems differ in how they store an umlaut."""
    return unicodedata.normalize("NFC", path.stem)


@dataclass(frozen=True)
class Pairs:
    """The images that can be measured, in the order of their names, and the problems found so far."""

    pairs: Sequence[Pair]
    problems: Sequence[Problem]
    images: int


def find_pairs(images: Path, masks: Path, maps: Mapping[str, Path]) -> Pairs:
    """Pairs the images of a folder with their masks and maps.

    Args:
        images: folder of images.
        masks: folder of masks.
        maps: folder of maps of every method.

    Raises:
        DataError: a folder is missing or empty, or no image has a mask.
    """
    image_folder, mask_folder = Folder.read(images, "image"), Folder.read(masks, "mask")
    map_folders = {method: Folder.read(path, "map") for method, path in maps.items()}
    problems = [*image_folder.problems, *mask_folder.problems]
    pairs = []
    for name, image in image_folder.files.items():
        mask = mask_folder.files.get(name)
        if mask is None:
            problems.append(Problem("image without a mask", name, f"{image}: no mask of its name in {masks}"))
            continue
        found = {method: folder.files[name] for method, folder in map_folders.items() if name in folder.files}
        pairs.append(Pair(name, image, mask, found))
        for method, folder in map_folders.items():
            if name not in folder.files:
                detail = f"{image}: no map of its name in {folder.path}"
                problems.append(Problem(f"image without a map of {method}", name, detail))
    problems += _extra(mask_folder, image_folder, "mask without an image")
    for method, folder in map_folders.items():
        problems += folder.problems
        problems += _extra(folder, image_folder, f"map of {method} without an image")
    if not pairs:
        raise DataError(f"{masks}: no mask has the name of one of the {len(image_folder.files)} images in {images}")
    return Pairs(pairs, problems, len(image_folder.files))


def _extra(folder: Folder, images: Folder, kind: str) -> list[Problem]:
    extra = [name for name in folder.files if name not in images.files]
    return [Problem(kind, name, str(folder.files[name]), lost=False) for name in extra]


class Unreadable(Exception):
    """A file that cannot be used: the kind of problem, and what there is to say of it."""

    def __init__(self, kind: str, detail: str) -> None:
        super().__init__(f"{kind}: {detail}")
        self.kind = kind
        self.detail = detail


def read_image(path: Path, side_px: int | None) -> tuple[Rgb, tuple[int, int]]:
    """An image as uint8 (H, W, 3), and the (width, height) that it has in the file.

    Args:
        path: the file.
        side_px: length that the longer side is brought to; None leaves the size.

    Raises:
        Unreadable: it is not an image.
    """
    with _opened(path, "unreadable image") as image:
        size = image.size
        rgb = image.convert("RGB")
        if side_px is not None:
            rgb = rgb.resize(scaled(size, side_px), Image.Resampling.BOX if max(size) > side_px else _SMOOTH)
        return np.ascontiguousarray(np.asarray(rgb, dtype=np.uint8)), size


@dataclass(frozen=True)
class ReadMask:
    """A mask, bool (H, W), and what is odd about its file: nothing, or a problem that does not cost the image."""

    salient: Mask
    grey_pixels: int


def read_mask(path: Path, image_size: tuple[int, int], size: tuple[int, int]) -> ReadMask:
    """The mask of an image.

    Args:
        path: its file.
        image_size: (width, height) that the image has in its file, which the mask must have, too.
        size: (width, height) that it is brought to.

    Raises:
        Unreadable: it is not an image, has another size, or no salient pixel.
    """
    with _opened(path, "unreadable mask") as image:
        if image.size != image_size:
            (width, height), (mask_width, mask_height) = image_size, image.size
            detail = f"{path}: {mask_width} x {mask_height} px for an image of {width} x {height} px"
            raise Unreadable("mask of another size", detail)
        # A palette holds colours: what they show counts, not their numbers.
        grey = image.convert("L")
        values = np.asarray(grey, dtype=np.uint8)
        between = int(np.count_nonzero((values != values.min()) & (values != values.max())))
        salient = values > TRUTH_ABOVE
        if image.size != size:
            bilevel = Image.fromarray(salient.astype(np.uint8) * 255)
            salient = np.asarray(bilevel.resize(size, Image.Resampling.BOX)) > TRUTH_ABOVE
    if not salient.any():
        detail = f"{path}: no pixel is above {TRUTH_ABOVE}; the largest is {values.max()}"
        raise Unreadable("mask without a salient pixel", detail)
    return ReadMask(salient, between)


def read_map(path: Path, size: tuple[int, int]) -> Rgb:
    """A map in grey, uint8 (H, W), brought to (width, height).

    Raises:
        Unreadable: it is not an image, or has another shape than the image, which no change of size explains.
    """
    with _opened(path, "unreadable map") as image:
        (width, height), (map_width, map_height) = size, image.size
        # Rounded sides of a reduced image are up to a pixel off.
        if abs(map_width * height - map_height * width) > width + height + map_width + map_height:
            detail = f"{path}: {map_width} x {map_height} px for an image of {width} x {height} px"
            raise Unreadable("map of another shape", detail)
        grey = image.convert("L")
        if grey.size != size:
            grey = grey.resize(size, Image.Resampling.BOX if map_width > width else _SMOOTH)
        return np.asarray(grey, dtype=np.uint8)


@lru_cache(maxsize=4096)
def reference_mask(path: Path, side_px: int) -> Mask | None:
    """A mask at a small size, for the negative references of other images; None where it cannot be used."""
    try:
        with _opened(path, "unreadable mask") as image:
            grey = image.convert("L").resize(scaled(image.size, side_px), Image.Resampling.BOX)
            return np.asarray(grey, dtype=np.uint8) > TRUTH_ABOVE
    except Unreadable:
        return None


def stretched(mask: Mask, size: tuple[int, int]) -> Mask:
    """A mask stretched to (width, height) by the nearest pixels."""
    picture = Image.fromarray(mask.astype(np.uint8)).resize(size, Image.Resampling.NEAREST)
    return np.asarray(picture, dtype=np.bool_)


def scaled(size: tuple[int, int], side_px: int) -> tuple[int, int]:
    """(width, height) with the longer side brought to `side_px`."""
    factor = side_px / max(size)
    return max(1, round(size[0] * factor)), max(1, round(size[1] * factor))


_SMOOTH = Image.Resampling.BILINEAR


def _opened(path: Path, kind: str) -> Image.Image:
    """An image whose pixels are in memory.

    Raises:
        Unreadable: the file is missing, is no image or is cut short.
    """
    try:
        with Image.open(path) as image:
            if image.mode not in MODES:
                raise Unreadable(kind, f"{path}: pixel mode {image.mode}; allowed are {', '.join(MODES)}")
            image.load()
            return image.copy()
    # Pillow's decoders raise SyntaxError for broken PNG and ValueError for some others.
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise Unreadable(kind, f"{path}: {error}") from error


def counted(problems: Sequence[Problem]) -> list[str]:
    """A line for every kind of problem: how often, and the names of some files."""
    lines = []
    for kind, count in sorted(Counter(problem.kind for problem in problems).items()):
        details = [problem.detail for problem in problems if problem.kind == kind]
        more = f"; and {count - NAMED} more" if count > NAMED else ""
        lines.append(f"{kind}: {count} ({'; '.join(details[:NAMED])}{more})")
    return lines
