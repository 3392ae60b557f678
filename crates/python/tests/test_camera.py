"""`samsod.Camera`: against the equations written out in NumPy, and its errors."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

import samsod

Floats = npt.NDArray[np.float64]

SIZE = (320, 240)
MATRIX = np.array([[400.0, 0.0, 161.5], [0.0, 404.0, 118.0], [0.0, 0.0, 1.0]])
DISTORTION = np.array([-0.2, 0.08, 0.001, -0.0007, -0.01])


def pose(x: float, y: float, z: float, tilt: float = 0.0, roll: float = 0.0) -> Floats:
    """A camera that looks down, tilted about its x axis, after a turn about z."""
    cosine, sine = np.cos(np.pi + tilt), np.sin(np.pi + tilt)
    about_x = np.array([[1, 0, 0], [0, cosine, -sine], [0, sine, cosine]])
    cosine, sine = np.cos(roll), np.sin(roll)
    about_z = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
    matrix = np.eye(4)
    matrix[:3, :3] = about_z @ about_x
    matrix[:3, 3] = x, y, z
    return matrix


def project(points: Floats, world_from_camera: Floats | None, distortion: Floats = DISTORTION) -> Floats:
    """OpenCV's model: world (or, without a pose, camera) to pixels."""
    if world_from_camera is not None:
        points = (points - world_from_camera[:3, 3]) @ world_from_camera[:3, :3]
    x, y = (points[:, :2] / points[:, 2:]).T
    k1, k2, p1, p2, k3 = distortion
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    pixels: Floats = np.stack([u, v], axis=1) * np.diag(MATRIX)[:2] + MATRIX[:2, 2]
    return pixels


PLACED = pose(10.0, -20.0, 500.0, tilt=0.2, roll=0.4)
TABLE = np.array([[0.0, 0.0, 0.0], [60.0, -40.0, 0.0], [-50.0, 30.0, 12.0], [20.0, 70.0, 12.0]])


def placed(**changes: Any) -> samsod.Camera:
    arguments: dict[str, Any] = {"world_from_camera": PLACED, **changes}
    return samsod.Camera(MATRIX, DISTORTION, SIZE, **arguments)


def test_properties_are_what_was_given() -> None:
    base = pose(400.0, 0.0, 20.0)
    camera = placed(base_from_world=base)
    assert np.array_equal(camera.matrix, MATRIX)
    assert np.array_equal(camera.distortion, DISTORTION)
    assert camera.size == SIZE
    assert camera.world_from_camera == pytest.approx(PLACED, abs=1e-12)
    assert camera.base_from_world == pytest.approx(base, abs=1e-12)
    assert "320 x 240 px" in repr(camera)
    bare = samsod.Camera(MATRIX, DISTORTION, SIZE)
    assert bare.world_from_camera is None
    assert bare.base_from_world is None


def test_points_go_to_the_image_and_back() -> None:
    camera = placed()
    pixels = camera.image_from_world(TABLE)
    assert pixels.dtype == np.float64
    assert pixels == pytest.approx(project(TABLE, PLACED), abs=1e-9)
    assert camera.world_from_image(pixels[:2].copy()) == pytest.approx(TABLE[:2], abs=1e-6)
    assert camera.world_from_image(pixels[2:].copy(), height_mm=12.0) == pytest.approx(TABLE[2:], abs=1e-6)
    assert camera.image_from_world(np.empty((0, 3))).shape == (0, 2)


def test_the_base_of_the_robot() -> None:
    base = pose(400.0, 0.0, 20.0, tilt=np.pi, roll=1.0)
    camera = placed(base_from_world=base)
    pixels = camera.image_from_world(TABLE)
    found = camera.base_from_image(pixels[:2].copy())
    assert found == pytest.approx(TABLE[:2] @ base[:3, :3].T + base[:3, 3], abs=1e-6)
    with pytest.raises(ValueError, match=r"points\[0\]: the camera has no base_from_world"):
        placed().base_from_image(pixels)


def test_undistorted_points_are_those_of_an_ideal_lens() -> None:
    rays = np.array([[0.0, 0.0, 1.0], [0.3, 0.2, 1.0], [-0.35, 0.25, 1.0], [0.1, -0.28, 1.0]])
    ideal = project(rays, None, np.zeros(5))
    found = samsod.Camera(MATRIX, DISTORTION, SIZE).undistort_points(project(rays, None))
    assert found == pytest.approx(ideal, abs=1e-6)


def test_an_undistorted_image_has_its_colours_at_the_undistorted_places() -> None:
    v, u = np.mgrid[: SIZE[1], : SIZE[0]].astype(float)
    # A ramp that bilinear interpolation leaves as it is.
    ramp = np.stack([u * 0.75, v, 250 - u * 0.5 - v * 0.25], axis=2)
    camera = samsod.Camera(MATRIX, DISTORTION, SIZE)
    flat = camera.undistort(np.round(ramp).astype(np.uint8))
    assert flat.shape == (SIZE[1], SIZE[0], 3)
    assert flat.dtype == np.uint8
    rays = np.stack([(u - MATRIX[0, 2]) / 400.0, (v - MATRIX[1, 2]) / 404.0, np.ones_like(u)], axis=2).reshape(-1, 3)
    at_u, at_v = project(rays, None).T.reshape(2, *u.shape)
    inside = (at_u > 0) & (at_u < SIZE[0] - 1) & (at_v > 0) & (at_v < SIZE[1] - 1)
    assert inside.mean() > 0.9
    expected = np.stack([at_u * 0.75, at_v, 250 - at_u * 0.5 - at_v * 0.25], axis=2)
    assert np.abs(flat[inside] - expected[inside]).max() <= 1.5
    with pytest.raises(ValueError, match="calibrated for another resolution"):
        camera.undistort(np.zeros((240, 240, 3), dtype=np.uint8))


def test_a_camera_file(tmp_path: Path) -> None:
    path = tmp_path / "camera.toml"
    rows = "\n".join(f"  {list(map(float, row))}," for row in PLACED)
    path.write_text(
        "[intrinsics]\nwidth_px = 320\nheight_px = 240\nfx_px = 400.0\nfy_px = 404.0\ncx_px = 161.5\ncy_px = 118.0\n"
        "k1 = -0.2\nk2 = 0.08\np1 = 0.001\np2 = -0.0007\nk3 = -0.01\n"
        f"[world]\nworld_from_camera_mm = [\n{rows}\n]\n"
    )
    for name in (path, str(path)):
        camera = samsod.Camera.from_file(name)
        assert camera.image_from_world(TABLE) == pytest.approx(project(TABLE, PLACED), abs=1e-9)
    path.write_text(path.read_text().replace("fx_px = 400.0", "fx_px = -400.0"))
    with pytest.raises(ValueError, match=r"camera\.toml: \[intrinsics\] fx_px is -400; allowed: 1 to"):
        samsod.Camera.from_file(path)
    with pytest.raises(FileNotFoundError, match=r"missing\.toml"):
        samsod.Camera.from_file(tmp_path / "missing.toml")


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"matrix": np.eye(4)}, ValueError, r"matrix: expected .*\(3, 3\), got shape \(4, 4\)"),
        ({"matrix": np.eye(3, dtype=np.float32)}, TypeError, "matrix: expected a C-contiguous float64 array"),
        ({"matrix": MATRIX + np.eye(3, k=-1)}, ValueError, r"matrix: expected \[\[fx, 0, cx\]"),
        ({"matrix": MATRIX * [[-1], [1], [1]]}, ValueError, "fx_px is -400; allowed: 1 to"),
        ({"distortion": np.zeros(4)}, ValueError, "distortion: expected .* got 4 numbers"),
        ({"distortion": np.array([-9.0, 0, 0, 0, 0])}, ValueError, "turns back on itself"),
        ({"size": (-1, 240)}, ValueError, "size: -1 pixels"),
        ({"size": (1, 240)}, ValueError, "width_px is 1; allowed: 2 to 16384"),
        ({"world_from_camera": np.ones((4, 4))}, ValueError, "world_from_camera: the last row is"),
        ({"world_from_camera": np.diag([1.0, 1, -1, 1])}, ValueError, "world_from_camera: .* is a reflection"),
        ({"base_from_world": np.diag([2.0, 1, 1, 1])}, ValueError, "base_from_world: .* is no rotation"),
        ({"base_from_world": [[1.0]]}, TypeError, "base_from_world: expected .* got list"),
    ],
)
def test_cameras_that_are_refused(change: dict[str, Any], error: type[Exception], message: str) -> None:
    arguments: dict[str, Any] = {"matrix": MATRIX, "distortion": DISTORTION, "size": SIZE, **change}
    with pytest.raises(error, match=message):
        samsod.Camera(**arguments)


def test_points_that_are_refused() -> None:
    camera = placed()
    bare = samsod.Camera(MATRIX, DISTORTION, SIZE)
    with pytest.raises(ValueError, match="no world_from_camera"):
        bare.world_from_image(np.zeros((1, 2)))
    with pytest.raises(ValueError, match=r"points\[1\]: pixel \(320, 5\) lies outside the image of 320 x 240 px"):
        camera.world_from_image(np.array([[5.0, 5.0], [320.0, 5.0]]))
    with pytest.raises(ValueError, match=r"points\[0\]: the plane z = 600 mm"):
        camera.world_from_image(np.array([[5.0, 5.0]]), height_mm=600.0)
    with pytest.raises(ValueError, match="not finite"):
        camera.undistort_points(np.array([[np.nan, 5.0]]))
    with pytest.raises(ValueError, match="does not lie in front of the camera"):
        camera.image_from_world(np.array([[0.0, 0.0, 900.0]]))
    with pytest.raises(ValueError, match=r"points: expected .*\(N, 3\), got shape \(1, 2\)"):
        camera.image_from_world(np.zeros((1, 2)))
    integers: Any = np.zeros((1, 2), dtype=np.int64)
    with pytest.raises(TypeError, match="got int64"):
        camera.world_from_image(integers)
    with pytest.raises(ValueError, match="ascontiguousarray"):
        camera.world_from_image(np.zeros((4, 4))[:, ::2])
