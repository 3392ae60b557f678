"""The catalogue that the evaluation makes of templates and models."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_up import CAMERA, HEIGHT_MM, write_templates
from PIL import Image

from samsod.evaluation.catalogue import find_sources, read_sources, write_catalogue
from samsod.evaluation.data import DataError

FRAME = (120, 90)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    folder = tmp_path / "data"
    (folder / "dev").mkdir(parents=True)
    write_templates(folder, ["square_1", "square_0"])
    return folder


def edit(path: Path, **changes: Any) -> None:
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


def test_parts_are_those_of_the_data(root: Path, tmp_path: Path) -> None:
    edit(root / "parts" / "square_1.json", shape_symmetry_order=0, appearance_symmetry_order=3, grasp_width_mm=12.5)
    sources = read_sources(root / "templates", root / "parts", FRAME)
    catalogue = write_catalogue(tmp_path / "catalogue", sources)
    first, second = catalogue.parts
    assert (first.name, second.name) == ("square_0", "square_1")
    assert (first.height_mm, first.grasp_width_mm, first.has_model) == (HEIGHT_MM, 18.0, True)
    assert (first.shape_symmetry, first.appearance_symmetry) == (4, 4)
    assert (second.shape_symmetry, second.appearance_symmetry, second.grasp_width_mm) == (0, 3, 12.5)
    assert first.folder == tmp_path / "catalogue" / "square_0"
    with Image.open(root / "templates" / "square_0.png") as image:
        assert np.array_equal(first.template, np.asarray(image))
    assert first.template_mask.sum() == 400
    text = (first.folder / "part.toml").read_text()
    for line in (
        "crop_px = [40, 25]",
        "origin_px = [19.5, 19.5]",
        "width_px = 120",
        "height_px = 90",
        "fx_px = 1000.0",
    ):
        assert line in text.splitlines()
    assert f"world_from_camera_mm = {json.dumps(CAMERA['T_world_camera'])}" in text.splitlines()


def test_templates_lie_in_the_scenes_folder_beside_it_or_above(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    both = (root / "templates", root / "parts")
    for scenes in (root, root / "dev", root / "dev" / "some"):
        scenes.mkdir(exist_ok=True)
        assert find_sources(scenes) == both
    monkeypatch.chdir(root / "dev")
    assert find_sources(Path()) == (Path.cwd().parent / "templates", Path.cwd().parent / "parts")
    # Those in the folder itself come first.
    own = root / "dev" / "templates"
    own.mkdir()
    assert find_sources(root / "dev") == (own, root / "parts")
    shutil.rmtree(root / "parts")
    with pytest.raises(DataError, match=r"parts: no such folder, but there is .*templates"):
        find_sources(root / "dev")
    shutil.rmtree(root / "templates")
    own.rmdir()
    assert find_sources(root / "dev") is None


@pytest.mark.parametrize(
    "file",
    [
        "templates/square_0.png",
        "templates/square_0_mask.png",
        "templates/square_0.json",
        "parts/square_0.json",
        "parts/square_0.stl",
    ],
)
def test_missing_files_are_named(root: Path, file: str) -> None:
    (root / file).unlink()
    with pytest.raises(DataError, match=rf"{root / file}: no such file"):
        read_sources(root / "templates", root / "parts", FRAME)


def test_broken_files_are_named(root: Path, tmp_path: Path) -> None:
    def refused(file: str, message: str, **changes: Any) -> None:
        whole = (root / file).read_text()
        edit(root / file, **changes)
        with pytest.raises(DataError, match=rf"(?s){file}: .*{message}"):
            read_sources(root / "templates", root / "parts", FRAME)
        (root / file).write_text(whole)

    refused("templates/square_0.json", "crop_xy has shape", crop_xy=[1, 2, 3])
    refused("templates/square_0.json", "K has shape", K=None)
    refused("templates/square_0.json", "could not convert", yaw_deg="left")
    refused("parts/square_0.json", "float", height_mm=None)
    refused("parts/square_0.json", "invalid literal", shape_symmetry_order="round")
    Image.new("L", (7, 7)).save(root / "templates" / "square_0_mask.png")
    with pytest.raises(DataError, match=r"square_0_mask\.png: size \(7, 7\) differs from the template's \(40, 40\)"):
        read_sources(root / "templates", root / "parts", FRAME)
    for path in [*(root / "templates").iterdir(), *(root / "parts").iterdir()]:
        path.unlink()
    with pytest.raises(DataError, match="templates: no template in it"):
        read_sources(root / "templates", root / "parts", FRAME)


def test_what_samsod_refuses_is_a_fault_of_the_data(root: Path, tmp_path: Path) -> None:
    edit(root / "parts" / "square_0.json", height_mm=20.0)
    sources = read_sources(root / "templates", root / "parts", FRAME)
    with pytest.raises(DataError, match=r"square_0/part\.toml: height_mm is 20, but model\.stl beside it is 8 mm high"):
        write_catalogue(tmp_path / "catalogue", sources)


def test_a_second_catalogue_replaces_the_first_and_nothing_else(root: Path, tmp_path: Path) -> None:
    folder = tmp_path / "catalogue"
    sources = read_sources(root / "templates", root / "parts", FRAME)
    write_catalogue(folder, sources)
    (folder / "square_0" / "descriptors").write_text("computed")
    (folder / "square_1" / "descriptors").write_text("computed")
    # Another set of data: square_1 is gone, but what is not ours is not touched.
    assert [part.name for part in write_catalogue(folder, sources[:1]).parts] == ["square_0"]
    assert (folder / "square_0" / "descriptors").read_text() == "computed"
    assert (folder / "square_1" / "descriptors").read_text() == "computed"
    assert not (folder / "square_1" / "part.toml").exists()

    other = tmp_path / "other"
    (other / "square_0").mkdir(parents=True)
    (other / "square_0" / "part.toml").write_text("mine")
    with pytest.raises(DataError, match="square_0: was not written by this evaluation"):
        write_catalogue(other, sources)
    assert (other / "square_0" / "part.toml").read_text() == "mine"
