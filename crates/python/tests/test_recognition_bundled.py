"""Recognition on a bundled frame with the bundled catalogue: seven parts on a blue belt under one lamp."""

from __future__ import annotations

import shutil
import threading

import numpy as np
import pytest
from conftest import FRAMES, Frame
from PIL import Image

import samsod
from samsod.evaluation.recognition import angle_error

PARTS = FRAMES.parent / "parts"
#: Frame 0008: x and y of the origin in mm and yaw in degrees.
TRUTH = {
    "u_channel": (185.93, 119.89, -137.19),
    "l_bracket": (-203.16, 62.37, -7.77),
    "asym_plate": (-114.52, 15.62, 46.71),
    "star_knob": (-47.26, -76.07, 136.59),
    "flange": (80.72, -112.44, -124.55),
    "stepped_shaft": (-83.81, -117.25, -51.39),
    "housing_block": (-123.60, 141.79, 91.98),
}
#: The camera of that frame, 900 mm exactly over the origin of the world; the parts were taught with the same.
CAMERA = samsod.Camera(
    np.array([[1600.0, 0.0, 541.2], [0.0, 1600.0, 476.6], [0.0, 0.0, 1.0]]),
    np.zeros(5),
    (1078, 958),
    world_from_camera=np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 900], [0, 0, 0, 1]]),
)


@pytest.fixture(scope="module")
def rgb() -> Frame:
    with Image.open(FRAMES / "0008.jpg") as image:
        return np.array(image)


@pytest.fixture(scope="module")
def catalogue(tmp_path_factory: pytest.TempPathFactory) -> samsod.Catalogue:
    # A copy: what is computed of the parts is kept beside them.
    return samsod.Catalogue(shutil.copytree(PARTS, tmp_path_factory.mktemp("catalogue") / "parts"))


@pytest.fixture(scope="module")
def separated(rgb: Frame) -> list[samsod.ObjectRegion]:
    """The objects as a cell without a catalogue leaves them."""
    return samsod.Cell().inspect(rgb).objects


@pytest.fixture(scope="module")
def scene(rgb: Frame, catalogue: samsod.Catalogue) -> samsod.Scene:
    return samsod.Cell(catalogue=catalogue, camera=CAMERA).inspect(rgb)


def named(detections: list[samsod.Detection]) -> dict[str, samsod.Detection]:
    """The detections with a name; the best of each name."""
    return {found.name: found for found in sorted(detections, key=lambda found: found.score) if found.name is not None}


def test_parts_are_named_and_placed(scene: samsod.Scene, catalogue: samsod.Catalogue) -> None:
    found = named(scene.detections)
    symmetry = {part.name: part.appearance_symmetry for part in catalogue.parts}
    right = 0
    for name in TRUTH.keys() & found.keys():
        x, y, yaw = TRUTH[name]
        detection = found[name]
        assert detection.x_mm is not None
        assert detection.y_mm is not None
        assert detection.yaw_deg is not None
        error = angle_error(detection.yaw_deg, yaw, symmetry[name])
        right += abs(detection.x_mm - x) < 3.0 and abs(detection.y_mm - y) < 3.0 and (error is None or error < 5.0)
    # One of the seven may fall to pieces in the decoder of the picture.
    assert right >= 6


def test_detections_are_consistent(scene: samsod.Scene, catalogue: samsod.Catalogue) -> None:
    names = {part.name: part.height_mm for part in catalogue.parts}
    assert scene.detections
    for found in scene.detections:
        assert found.mask.shape == (958, 1078)
        assert found.mask.any()
        assert 0.0 <= found.score <= 1.0
        assert 0.0 <= found.margin <= 1.0
        assert found.method in ("sift", "shape")
        assert -180.0 < found.angle_deg <= 180.0
        assert found.region < len(scene.regions)
        assert found.objects == sorted(set(found.objects))
        assert all(scene.objects[index].region == found.region for index in found.objects)
        if found.name is None:
            assert (found.x_mm, found.y_mm, found.yaw_deg, found.height_mm) == (None, None, None, None)
            continue
        assert found.height_mm == pytest.approx(names[found.name])
        assert found.x_mm is not None
        assert found.y_mm is not None
        seen = CAMERA.image_from_world(np.array([[found.x_mm, found.y_mm, names[found.name]]]))[0]
        assert found.origin_px == pytest.approx(seen, abs=0.01)
        assert repr(found).startswith(f"<samsod.Detection: {found.name}, score ")


def test_the_recogniser_says_what_the_cell_says(
    catalogue: samsod.Catalogue, rgb: Frame, scene: samsod.Scene, separated: list[samsod.ObjectRegion]
) -> None:
    recognizer = samsod.Recognizer(catalogue, camera=CAMERA)
    detections = recognizer.recognize(rgb, separated)
    assert len(named(detections)) >= 6
    objects, detections = samsod.settle_objects(separated, detections)
    assert [(found.name, found.x_mm, found.yaw_deg, found.objects) for found in detections] == [
        (found.name, found.x_mm, found.yaw_deg, found.objects) for found in scene.detections
    ]
    assert [(each.region, each.area, each.centroid) for each in objects] == [
        (each.region, each.area, each.centroid) for each in scene.objects
    ]


def test_a_recognised_part_is_one_object_with_the_pixels_of_its_pose(
    scene: samsod.Scene, separated: list[samsod.ObjectRegion]
) -> None:
    parts = [found for found in scene.detections if found.name is not None]
    for found in parts:
        (index,) = found.objects
        mask = scene.objects[index].mask
        # Parts do not overlap here.
        assert np.count_nonzero(mask & found.mask) == np.count_nonzero(mask | found.mask)
    assert len({found.objects[0] for found in parts}) == len(parts)
    # No pixel is of two objects, and no object is its own shadow.
    assert np.sum([each.mask for each in scene.objects], axis=0).max() == 1
    solid = np.any([each.mask for each in scene.objects], axis=0)
    assert not any(np.any(solid & each.shadow) for each in scene.objects)
    with pytest.raises(ValueError, match=r"detections\[0\] covers object \d+; there are 0, from 0"):
        samsod.settle_objects([], scene.detections)
    with pytest.raises(ValueError, match="min_object_area_px = 0; allowed are 1 to"):
        samsod.settle_objects(separated, [], min_object_area_px=0)
    assert samsod.settle_objects([], []) == ([], [])


def test_the_camera_of_the_call_is_the_one_that_counts(
    rgb: Frame, catalogue: samsod.Catalogue, scene: samsod.Scene
) -> None:
    # The same camera over another place of the world.
    pose = np.array(CAMERA.world_from_camera)
    pose[0, 3] = 1000.0
    moved = samsod.Camera(CAMERA.matrix, CAMERA.distortion, CAMERA.size, world_from_camera=pose)
    cell = samsod.Cell(catalogue=catalogue, camera=CAMERA)
    first, here = named(cell.inspect(rgb, camera=moved).detections), named(scene.detections)
    assert first.keys() == here.keys()
    assert len(here) >= 6
    for name, found in first.items():
        there, place = found.x_mm, here[name].x_mm
        assert there is not None
        assert place is not None
        assert there - place == pytest.approx(1000.0, abs=0.1)
    # And only in that call.
    again = named(cell.inspect(rgb).detections)
    assert {name: found.x_mm for name, found in again.items()} == {name: found.x_mm for name, found in here.items()}


def test_without_a_camera_there_is_no_place(rgb: Frame, catalogue: samsod.Catalogue, scene: samsod.Scene) -> None:
    found = named(samsod.Recognizer(catalogue).recognize(rgb, scene.objects))
    assert len(found) >= 6
    assert all((each.x_mm, each.y_mm, each.yaw_deg, each.height_mm) == (None,) * 4 for each in found.values())


def test_parts_that_were_left_out_are_unknown(rgb: Frame, catalogue: samsod.Catalogue, scene: samsod.Scene) -> None:
    rest = samsod.Recognizer(catalogue.without(["flange"]), camera=CAMERA)
    detections = rest.recognize(rgb, scene.objects)
    assert "flange" not in named(detections)
    assert len(named(detections)) >= 5
    x, y, _ = TRUTH["flange"]
    u, v = CAMERA.image_from_world(np.array([[x, y, 27.0]]))[0]
    (there,) = [found for found in detections if found.mask[round(v), round(u) + 35]]
    assert there.name is None


def test_sift_names_textured_parts(rgb: Frame, catalogue: samsod.Catalogue, scene: samsod.Scene) -> None:
    recognizer = samsod.Recognizer(catalogue, "sift", camera=CAMERA, sift={"confirm": False})
    by_features = named(recognizer.recognize(rgb, scene.objects))
    textured = {"asym_plate", "flange", "stepped_shaft", "housing_block"}
    assert len(by_features.keys() & textured) >= 2
    assert {found.method for found in by_features.values()} == {"sift"}
    # What features propose and edges confirm comes on top, and says so.
    confirmed = named(samsod.Recognizer(catalogue, "sift", camera=CAMERA).recognize(rgb, scene.objects))
    assert len(confirmed.keys() & textured) >= 3
    assert by_features.keys() <= confirmed.keys()
    assert {confirmed[name].method for name in by_features} == {"sift"}
    assert "shape" in {found.method for found in confirmed.values()}
    whole = recognizer.conventional_sift(rgb)
    assert len(named(whole).keys() & textured) >= 2
    assert all(found.objects == [] for found in whole)


def test_cameras_of_another_size_are_refused(rgb: Frame, catalogue: samsod.Catalogue) -> None:
    other = samsod.Camera(CAMERA.matrix, CAMERA.distortion, (1000, 900), world_from_camera=CAMERA.world_from_camera)
    recognizer = samsod.Recognizer(catalogue)
    for search in (
        lambda: recognizer.recognize(rgb, [], camera=other),
        lambda: recognizer.conventional_sift(rgb, camera=other),
        lambda: recognizer.conventional_shape(rgb, camera=other),
        lambda: samsod.Cell(catalogue=catalogue).inspect(rgb, camera=other),
    ):
        with pytest.raises(ValueError, match=r"frame of \[1078, 958\] px for a camera of \[1000, 900\] px"):
            search()


def test_one_recogniser_in_several_threads(
    rgb: Frame, catalogue: samsod.Catalogue, separated: list[samsod.ObjectRegion]
) -> None:
    recognizer = samsod.Recognizer(catalogue, camera=CAMERA)
    expected = [found.name for found in recognizer.recognize(rgb, separated)]
    assert expected
    same: list[bool] = []

    def run() -> None:
        same.append([found.name for found in recognizer.recognize(rgb, separated)] == expected)

    threads = [threading.Thread(target=run) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert same == [True] * 3
