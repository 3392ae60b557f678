"""`samsod.Catalogue` and `samsod.Recognizer`: what they say, take and refuse."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Frame
from made_up import CAMERA, write_templates
from PIL import Image

import samsod
from samsod.evaluation.catalogue import read_sources, write_catalogue

NAMES = ["square_0", "square_1", "square_2"]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_templates(tmp_path, NAMES)
    write_catalogue(tmp_path / "catalogue", read_sources(tmp_path / "templates", tmp_path / "parts", (120, 90)))
    return tmp_path / "catalogue"


@pytest.fixture
def catalogue(folder: Path) -> samsod.Catalogue:
    return samsod.Catalogue(folder)


@pytest.fixture
def square() -> Frame:
    """A red square of the size of the template on its table."""
    rgb = np.full((90, 120, 3), (120, 150, 200), dtype=np.uint8)
    rgb[35:55, 50:70] = (200, 60, 40)
    return rgb


def camera(width: int = 120, height: int = 90, placed: bool = True) -> samsod.Camera:
    pose = np.array(CAMERA["T_world_camera"]) if placed else None
    return samsod.Camera(np.array(CAMERA["K"]), np.zeros(5), (width, height), world_from_camera=pose)


def test_parts(folder: Path, catalogue: samsod.Catalogue) -> None:
    assert len(catalogue) == 3
    assert [part.name for part in catalogue.parts] == NAMES
    part = catalogue.parts[0]
    assert part.folder == folder / "square_0"
    assert (part.height_mm, part.grasp_width_mm, part.grasp_offset_mm, part.grasp_angle_deg) == (
        8.0,
        18.0,
        (0.0, 0.0),
        0.0,
    )
    assert (part.shape_symmetry, part.appearance_symmetry, part.has_model) == (4, 4, True)
    assert part.template.shape == (40, 40, 3)
    assert part.template.dtype == np.uint8
    assert part.template_mask.shape == (40, 40)
    assert part.template_mask.dtype == np.bool_
    assert repr(part) == "<samsod.Part: square_0, 8 mm high>"
    assert repr(catalogue) == "<samsod.Catalogue: square_0, square_1, square_2>"
    assert [part.name for part in samsod.Catalogue(str(folder)).parts] == NAMES


def test_optional_keys_of_a_part(folder: Path) -> None:
    file = folder / "square_0" / "part.toml"
    file.write_text("grasp_offset_mm = [1.0, -2.0]\ngrasp_angle_deg = 90\n" + file.read_text())
    (folder / "square_0" / "model.stl").unlink()
    part = samsod.Catalogue(folder).parts[0]
    assert part.grasp_offset_mm == (1.0, -2.0)
    assert part.grasp_angle_deg == pytest.approx(90.0)
    assert not part.has_model


def test_without_parts(catalogue: samsod.Catalogue) -> None:
    rest = catalogue.without(["square_1", "nobody"])
    assert [part.name for part in rest.parts] == ["square_0", "square_2"]
    assert len(catalogue) == 3
    assert len(catalogue.without(NAMES)) == 0
    name: Any = "square_1"
    with pytest.raises(TypeError, match="names"):
        catalogue.without(name)


def test_catalogues_that_are_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="nowhere"):
        samsod.Catalogue(tmp_path / "nowhere")
    with pytest.raises(NotADirectoryError, match=r"part\.toml"):
        samsod.Catalogue(folder / "square_0" / "part.toml")
    with pytest.raises(ValueError, match=r"parts: no part in it \(a folder with part\.toml\)"):
        samsod.Catalogue(tmp_path / "parts")
    number: Any = 3
    with pytest.raises(TypeError):
        samsod.Catalogue(number)
    shutil.copytree(folder / "square_0", folder / "twin")
    with pytest.raises(ValueError, match="both are named square_0"):
        samsod.Catalogue(folder)
    shutil.rmtree(folder / "twin")

    part = folder / "square_0"
    text = (part / "part.toml").read_text()
    for old, new, message in (
        ("height_mm = 8.0", "height_mm = 0.0", "height_mm is 0; allowed: 0.01 to 5000"),
        ("height_mm = 8.0", "", "missing field `height_mm`"),
        ("shape_order = 4", "shape_order = 361", "shape_order is 361; allowed: 0 to 360"),
        ("[symmetry]", "[symmetri]", "unknown field `symmetri`"),
    ):
        (part / "part.toml").write_text(text.replace(old, new))
        with pytest.raises(ValueError, match=rf"(?s)square_0/part\.toml: .*{message}"):
            samsod.Catalogue(folder)
    (part / "part.toml").write_text(text)
    Image.new("L", (7, 7), 255).save(part / "mask.png")
    with pytest.raises(ValueError, match=r"mask\.png: 7 x 7 px, but template\.png beside it has 40 x 40 px"):
        samsod.Catalogue(folder)
    (part / "mask.png").unlink()
    with pytest.raises(FileNotFoundError, match=r"square_0/mask\.png"):
        samsod.Catalogue(folder)


def test_parameters_of_a_recogniser(catalogue: samsod.Catalogue) -> None:
    recognizer = samsod.Recognizer(catalogue)
    assert recognizer.params["method"] == "best"
    assert recognizer.params["sift"]["contrast_threshold"] == 0.02
    assert len(recognizer.catalogue) == 3
    assert repr(recognizer) == "<samsod.Recognizer: best, 3 parts>"
    sift = {"ratio": 1.2, "contrast_threshold": 0.0123456789}
    other = samsod.Recognizer(catalogue, "shape", min_score=0.25, sift=sift)
    assert (other.params["method"], other.params["min_score"], other.params["sift"]["ratio"]) == ("shape", 0.25, 1.2)
    assert other.params["sift"]["contrast_threshold"] == 0.0123456789
    assert samsod.Recognizer(catalogue, **other.params).params == other.params


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ({"method": "guess"}, "unknown variant `guess`, expected one of `sift`, `shape`, `best`"),
        ({"min_score": 1.5}, "min_score = 1.5; allowed are 0 to 1"),
        ({"min_scor": 0.5}, "unknown field `min_scor`"),
        ({"sift": {"ratio": 0.5}}, "sift.ratio = 0.5; allowed are 1 to 100"),
        ({"sift": 3}, "invalid type"),
    ],
)
def test_parameters_that_are_refused(catalogue: samsod.Catalogue, params: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        samsod.Recognizer(catalogue, **params)
    with pytest.raises(ValueError, match=message):
        samsod.Cell({"recognize": params}, catalogue)


def test_catalogues_without_parts_and_cameras_without_a_pose(catalogue: samsod.Catalogue) -> None:
    nothing = catalogue.without(NAMES)
    with pytest.raises(ValueError, match="the catalogue has no part; recognition needs at least one"):
        samsod.Recognizer(nothing)
    with pytest.raises(ValueError, match="the catalogue has no part"):
        samsod.Cell(catalogue=nothing)
    lens = camera(placed=False)
    with pytest.raises(ValueError, match="the camera has no world_from_camera"):
        samsod.Recognizer(catalogue, camera=lens)
    with pytest.raises(ValueError, match="the camera has no world_from_camera"):
        samsod.Cell(camera=lens)
    path: Any = "parts"
    with pytest.raises(TypeError, match="catalogue"):
        samsod.Recognizer(path)
    with pytest.raises(TypeError, match="catalogue"):
        samsod.Cell(None, path)


def test_arguments_of_the_searches(catalogue: samsod.Catalogue, square: Frame) -> None:
    recognizer = samsod.Recognizer(catalogue, camera=camera())
    assert recognizer.recognize(square, []) == []
    lens = camera(placed=False)
    for search in (
        lambda rgb, **keywords: recognizer.recognize(rgb, [], **keywords),
        recognizer.conventional_sift,
        recognizer.conventional_shape,
    ):
        with pytest.raises(ValueError, match="the camera has no world_from_camera"):
            search(square, camera=lens)
        unsuitable: Any = square.astype(np.float32)
        with pytest.raises(TypeError, match=r"rgb: expected .* got float32"):
            search(unsuitable)
    other: Any = [3]
    with pytest.raises(TypeError):
        recognizer.recognize(square, other)


def test_objects_of_another_frame_are_refused(catalogue: samsod.Catalogue, square: Frame) -> None:
    objects = samsod.Cell().inspect(square).objects
    assert len(objects) == 1
    smaller = np.ascontiguousarray(square[:-1])
    with pytest.raises(ValueError, match=r"rgb has 120 x 89 pixels and the frame of objects\[0\] 120 x 90"):
        samsod.Recognizer(catalogue).recognize(smaller, objects)


def test_cells_with_a_catalogue_and_a_camera(catalogue: samsod.Catalogue, square: Frame) -> None:
    plain = samsod.Cell()
    assert (plain.catalogue, plain.camera) == (None, None)
    assert plain.inspect(square).detections == []
    mine = camera()
    cell = samsod.Cell({"recognize": {"method": "shape"}}, catalogue=catalogue, camera=mine)
    assert cell.params["recognize"]["method"] == "shape"
    assert cell.catalogue is not None
    assert len(cell.catalogue) == 3
    assert cell.camera is mine
    assert "detections>" in repr(cell.inspect(square))
    with pytest.raises(ValueError, match="the camera has no world_from_camera"):
        cell.inspect(square, camera=camera(placed=False))


def test_a_section_catalogue_is_the_daemons() -> None:
    assert samsod.Cell({"catalogue": {"folder": "parts"}}).params == samsod.Cell().params
