"""Makes a catalogue of parts, as samsod reads it, from the templates and models beside the scenes.

    templates/NAME.png          the part alone, cut from a frame
    templates/NAME_mask.png     8-bit, of the same size, more than 127 on the part
    templates/NAME.json         {"crop_xy": [x, y], "origin_px": [u, v], "yaw_deg": .., "K": 3 rows of 3,
                                 "dist": [k1, k2, p1, p2, k3], "T_world_camera": 4 rows of 4}
    parts/NAME.json             {"height_mm": .., "grasp_width_mm": .., "shape_symmetry_order": n,
                                 "appearance_symmetry_order": n}
    parts/NAME.stl              mm, z up, the table at z = 0

Both folders lie in the folder of the scenes, beside it or above. `crop_xy` is where the template lay in its frame,
which has the size of the scenes' frames; `origin_px` the pixel of the template at which the origin of the part is seen,
at its height; a symmetry of order n repeats at 360 / n degrees, 0 is round. Only the fields named here are used.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import samsod
from samsod.evaluation.data import DataError, TrueCamera, read_json, read_numbers, read_pixels
from samsod.evaluation.output import OutputFolder

#: Files of a part in the catalogue.
PART_FILES = ("part.toml", "template.png", "mask.png", "model.stl")


@dataclass(frozen=True)
class TemplateSource:
    """What the data say of one part.

    Attributes:
        name: its name.
        image, mask, model: files of its template and its shape.
        height_mm, grasp_width_mm: over the table, and of the gripper's opening.
        shape_order, appearance_order: a turn by 360 / n degrees gives the same outline, the same picture; 0: any does.
        crop_px: where the template lay in its frame.
        origin_px: pixel of the template at which the origin is seen, at the height of the part.
        yaw_deg: of the part in the template.
        camera: the camera that saw it.
        frame_size: width and height of that camera's frame in px.
    """

    name: str
    image: Path
    mask: Path
    model: Path
    height_mm: float
    grasp_width_mm: float
    shape_order: int
    appearance_order: int
    crop_px: tuple[int, int]
    origin_px: tuple[float, float]
    yaw_deg: float
    camera: TrueCamera
    frame_size: tuple[int, int]

    def part_file(self) -> str:
        """The content of part.toml."""
        matrix, lens = self.camera.matrix, self.camera.distortion
        intrinsics = {
            "width_px": self.frame_size[0],
            "height_px": self.frame_size[1],
            "fx_px": float(matrix[0, 0]),
            "fy_px": float(matrix[1, 1]),
            "cx_px": float(matrix[0, 2]),
            "cy_px": float(matrix[1, 2]),
            **dict(zip(("k1", "k2", "p1", "p2", "k3"), lens.tolist(), strict=True)),
        }
        sections: dict[str, dict[str, Any]] = {
            "": {"name": self.name, "height_mm": self.height_mm, "grasp_width_mm": self.grasp_width_mm},
            "symmetry": {"shape_order": self.shape_order, "appearance_order": self.appearance_order},
            "template": {
                "crop_px": list(self.crop_px),
                "origin_px": list(self.origin_px),
                "angle_deg": self.yaw_deg,
            },
            "camera": {"world_from_camera_mm": self.camera.world_from_camera.tolist()},
            "camera.intrinsics": intrinsics,
        }
        lines = []
        for section, values in sections.items():
            lines += [f"[{section}]"] if section else []
            # Numbers, lists of them and plain names are written alike in JSON and TOML.
            lines += [f"{key} = {json.dumps(value)}" for key, value in values.items()]
        return "\n".join(lines) + "\n"


def find_sources(scenes: Path) -> tuple[Path, Path] | None:
    """The folders of templates and of parts in the folder of the scenes, beside it or above; None without templates.

    Raises:
        DataError: there are templates, but no parts.
    """
    # Resolved, since "." has nothing above it.
    near = [scenes, scenes.resolve().parent, scenes.resolve().parent.parent]
    templates = next((folder / "templates" for folder in near if (folder / "templates").is_dir()), None)
    if templates is None:
        return None
    parts = next((folder / "parts" for folder in near if (folder / "parts").is_dir()), None)
    if parts is None:
        raise DataError(f"{templates.parent / 'parts'}: no such folder, but there is {templates}")
    return templates, parts


def read_sources(templates: Path, parts: Path, frame_size: tuple[int, int]) -> list[TemplateSource]:
    """Reads what the data say of every part, in the order of their names.

    Args:
        templates, parts: the two folders.
        frame_size: width and height in px of the frames that the templates were cut from.

    Raises:
        DataError: a file is missing or not in the format above, or there is no template.
    """
    # A model without a template is a template that was forgotten, and the other way round.
    names = {path.stem for path in templates.glob("*.json")} | {path.stem for path in parts.glob("*.stl")}
    if not names:
        raise DataError(f"{templates}: no template in it (NAME.png, NAME_mask.png, NAME.json)")
    return [_read_source(templates, parts, name, frame_size) for name in sorted(names)]


def _read_source(templates: Path, parts: Path, name: str, frame_size: tuple[int, int]) -> TemplateSource:
    image, mask, model = templates / f"{name}.png", templates / f"{name}_mask.png", parts / f"{name}.stl"
    for file in (image, mask, model):
        if not file.is_file():
            raise DataError(f"{file}: no such file; the part {name} needs a template, its mask and a model")
    template, part = read_json(templates / f"{name}.json"), read_json(parts / f"{name}.json")
    size, mask_size = (read_pixels(file, mode).shape[1::-1] for file, mode in ((image, "RGB"), (mask, "L")))
    if size != mask_size:
        raise DataError(f"{mask}: size {mask_size} differs from the template's {size}")
    try:
        camera = TrueCamera(
            matrix=read_numbers(template, "K", (3, 3)),
            distortion=read_numbers(template, "dist", (5,)),
            world_from_camera=read_numbers(template, "T_world_camera", (4, 4)),
        )
        crop = read_numbers(template, "crop_xy", (2,))
        origin = read_numbers(template, "origin_px", (2,))
        yaw_deg = float(template["yaw_deg"])
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"{templates / name}.json: not a template ({error!r})") from error
    try:
        return TemplateSource(
            name=name,
            image=image,
            mask=mask,
            model=model,
            height_mm=float(part["height_mm"]),
            grasp_width_mm=float(part["grasp_width_mm"]),
            shape_order=int(part["shape_symmetry_order"]),
            appearance_order=int(part["appearance_symmetry_order"]),
            crop_px=(int(crop[0]), int(crop[1])),
            origin_px=(float(origin[0]), float(origin[1])),
            yaw_deg=yaw_deg,
            camera=camera,
            frame_size=frame_size,
        )
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"{parts / name}.json: not a part ({error!r})") from error


def write_catalogue(folder: Path, sources: Sequence[TemplateSource]) -> samsod.Catalogue:
    """Writes a folder for each part, and reads them as a catalogue.

    What samsod computed of a part and keeps in its folder stays there: a second run is faster.

    Args:
        folder: made when it is missing. Only what an earlier run wrote is replaced; parts of an earlier run that are
            no more are no more in the catalogue either.
        sources: the parts.

    Raises:
        DataError: a file in the way was not written by the evaluation, a file cannot be written, or samsod refuses a
            part.
    """
    names = [source.name for source in sources]
    top = OutputFolder(folder, names)
    for name in top.names - set(names):
        if (folder / name).is_dir():
            OutputFolder(folder / name, ()).clear()
    for source in sources:
        part = OutputFolder(folder / source.name, PART_FILES)
        try:
            (part / "part.toml").write_text(source.part_file(), encoding="utf-8")
            shutil.copyfile(source.image, part / "template.png")
            shutil.copyfile(source.mask, part / "mask.png")
            shutil.copyfile(source.model, part / "model.stl")
        except OSError as error:
            raise DataError(f"{part.path}: cannot write the catalogue there: {error}") from error
    try:
        return samsod.Catalogue(folder)
    except (OSError, ValueError) as error:
        raise DataError(str(error)) from error
