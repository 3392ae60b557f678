"""Scenes, templates and models small enough to be made on the spot."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

#: A camera 900 mm above the table that looks straight down; 10 px on the table are 9 mm.
CAMERA: dict[str, Any] = {
    "K": [[1000.0, 0.0, 60.0], [0.0, 1000.0, 45.0], [0.0, 0.0, 1.0]],
    "dist": [0.0, 0.0, 0.0, 0.0, 0.0],
    "T_world_camera": [[1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 900.0], [0.0, 0.0, 0.0, 1.0]],
}
TABLE, RED = (120, 150, 200), (200, 60, 40)
HEIGHT_MM = 8.0


def write_scene(folder: Path, name: str, parts: int, poses: bool = False) -> None:
    """A blue table with `parts` red squares in a row, each with a shadow on its right; `poses`: say how they lie."""
    rgb = np.full((90, 120, 3), TABLE, dtype=np.uint8)
    mask = np.zeros((90, 120), dtype=np.uint8)
    shadow = np.zeros((90, 120), dtype=np.uint8)
    instances: list[dict[str, Any]] = []
    for k in range(parts):
        mask[30:50, 15 + 40 * k : 35 + 40 * k] = k + 1
        shadow[30:50, 35 + 40 * k : 41 + 40 * k] = 255
        instances.append({"id": k + 1, "part": f"square_{k}"})
        if poses:
            place = {"x_mm": 0.9 * (24.5 + 40 * k - 60.0), "y_mm": -0.9 * (39.5 - 45.0), "yaw_deg": 0.0}
            orders = {"shape_symmetry_order": 4, "appearance_symmetry_order": 4}
            instances[-1].update(height_mm=HEIGHT_MM, textured=k == 0, **place, **orders)
    rgb[shadow > 0] = (75, 95, 128)
    rgb[mask > 0] = RED
    for kind in ("images", "masks", "shadows", "gt"):
        (folder / kind).mkdir(parents=True, exist_ok=True)
    Image.fromarray(rgb).save(folder / "images" / f"{name}.jpg", quality=95)
    Image.fromarray(mask).save(folder / "masks" / f"{name}.png")
    Image.fromarray(shadow).save(folder / "shadows" / f"{name}.png")
    (folder / "gt" / f"{name}.json").write_text(json.dumps({"instances": instances, **CAMERA}))


def write_templates(root: Path, names: list[str]) -> None:
    """Templates and models of the squares, cut from the middle of a frame of the same camera."""
    templates, parts = root / "templates", root / "parts"
    templates.mkdir(exist_ok=True)
    parts.mkdir(exist_ok=True)
    rgb = np.full((40, 40, 3), TABLE, dtype=np.uint8)
    mask = np.zeros((40, 40), dtype=np.uint8)
    mask[10:30, 10:30] = 255
    rgb[mask > 0] = RED
    for name in names:
        Image.fromarray(rgb).save(templates / f"{name}.png")
        Image.fromarray(mask).save(templates / f"{name}_mask.png")
        template = {"crop_xy": [40, 25], "origin_px": [19.5, 19.5], "yaw_deg": 0.0, **CAMERA}
        (templates / f"{name}.json").write_text(json.dumps(template))
        part = {
            "height_mm": HEIGHT_MM,
            "grasp_width_mm": 18.0,
            "shape_symmetry_order": 4,
            "appearance_symmetry_order": 4,
        }
        (parts / f"{name}.json").write_text(json.dumps(part))
        write_box(parts / f"{name}.stl", 18.0, HEIGHT_MM)


def write_box(path: Path, side_mm: float, height_mm: float) -> None:
    """A binary STL of a square box that stands on the table."""
    half = side_mm / 2
    x, y, z = [-half, half], [-half, half], [0.0, height_mm]
    corner = [(x[i & 1], y[i >> 1 & 1], z[i >> 2]) for i in range(8)]
    faces = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    triangles = [t for a, b, c, d in faces for t in ((a, b, c), (a, c, d))]
    with path.open("wb") as file:
        file.write(b"\0" * 80 + struct.pack("<I", len(triangles)))
        for triangle in triangles:
            points = [coordinate for k in triangle for coordinate in corner[k]]
            file.write(struct.pack("<12fH", 0.0, 0.0, 0.0, *points, 0))
