"""The comparison of a calibration with the truth, with a stand-in for the program samsod."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from PIL import Image

from samsod.evaluation.calibration import CalibrationError, calibrate, find_board, find_program
from samsod.evaluation.data import DataError
from samsod.evaluation.output import OutputFolder

CAMERA = """\
[intrinsics]
width_px = 100
height_px = 80
fx_px = 1001.0
fy_px = 999.5
cx_px = 50.0
cy_px = 40.2
k1 = -0.11
k2 = 0.1
p1 = 0.0
p2 = 0.0
k3 = 0.0

[calibration]
calibrated_at = "2026-01-31T12:00:00Z"
images = 2
mean_reprojection_error_px = 0.125
"""


@pytest.fixture
def split(tmp_path: Path) -> Path:
    """A folder of scenes, without scenes, beside a folder calib/ of three photographs."""
    images = tmp_path / "calib" / "images"
    images.mkdir(parents=True)
    for name in ("01.jpg", "02.JPG", "03.png"):
        Image.new("L", (100, 80)).save(images / name)
    truth = {
        "K_true": [[1000.0, 0.0, 50.0], [0.0, 1000.0, 40.0], [0.0, 0.0, 1.0]],
        "dist_true": [-0.118, 0.094, 0.0, 0.0, 0.0],
        "pattern_inner_corners": [9, 6],
        "square_mm": 20.0,
    }
    (tmp_path / "calib" / "calib.json").write_text(json.dumps(truth))
    (tmp_path / "dev").mkdir()
    return tmp_path / "dev"


def program(folder: Path, *lines: str) -> Path:
    """A shell script in place of samsod."""
    path = folder / "samsod"
    path.write_text("\n".join(("#!/bin/sh", *lines)) + "\n")
    path.chmod(0o755)
    return path


def test_calibration_beside_the_truth(split: Path, tmp_path: Path) -> None:
    board = find_board(split)
    assert board is not None
    # Beside the folder of the scenes, in it, or one above.
    assert find_board(tmp_path) == board
    assert (board.count, board.columns, board.rows, board.square_mm) == (3, 9, 6, 20.0)
    (tmp_path / "camera.toml").write_text(CAMERA)
    out = tmp_path / "out"
    out.mkdir()
    script = program(
        tmp_path,
        'test "$*" = "calibrate $2 --pattern 9x6 --square-mm 20 --out $8" || exit 3',
        f'cp "{tmp_path / "camera.toml"}" "$8"',
        "echo picture >residuals.png",
    )
    found = calibrate(script, board, out)
    assert found.errors_percent == pytest.approx((0.1, 0.05, 0.0, 0.5))
    assert found.summary() == {
        "images": 2,
        "images_given": 3,
        "reprojection_px": 0.125,
        "intrinsics": {
            "fx": {"true_px": 1000.0, "found_px": 1001.0, "error_percent": pytest.approx(0.1)},
            "fy": {"true_px": 1000.0, "found_px": 999.5, "error_percent": pytest.approx(0.05)},
            "cx": {"true_px": 50.0, "found_px": 50.0, "error_percent": 0.0},
            "cy": {"true_px": 40.0, "found_px": 40.2, "error_percent": pytest.approx(0.5)},
        },
        "worst_percent": pytest.approx(0.5),
        "distortion": {"true": [-0.118, 0.094, 0.0, 0.0, 0.0], "found": [-0.11, 0.1, 0.0, 0.0, 0.0]},
    }
    text = found.report()
    assert "2 of 3 photographs" in text
    assert "| fx, px | 1000.0000 | 1001.0000 | 0.100 |" in text
    assert "| k1 | -0.1180 | -0.1100 | - |" in text
    # What the program writes ends in the folder of the results, and nothing else stays there.
    assert sorted(path.name for path in out.iterdir()) == ["camera.toml", "residuals.png"]


def test_a_calibration_that_fails_says_why(split: Path, tmp_path: Path) -> None:
    board = find_board(split)
    assert board is not None
    with pytest.raises(CalibrationError, match=r"ended with code 1: no board in 03\.png"):
        calibrate(program(tmp_path, "echo no board in 03.png >&2", "exit 1"), board, tmp_path)
    with pytest.raises(CalibrationError, match="no camera file"):
        calibrate(program(tmp_path, "true"), board, tmp_path)
    with pytest.raises(CalibrationError, match=r"KeyError\('intrinsics'\)"):
        calibrate(program(tmp_path, 'echo >"$8"'), board, tmp_path)
    assert not (tmp_path / "camera.toml").exists()


def test_missing_pieces(split: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="nothing: no such program"):
        find_program(tmp_path / "nothing")
    assert find_program(program(tmp_path, "true")) == tmp_path / "samsod"
    truth = tmp_path / "calib" / "calib.json"
    for image in (tmp_path / "calib" / "images").iterdir():
        image.unlink()
    with pytest.raises(DataError, match="no photographs"):
        find_board(split)
    truth.write_text('{"K_true": [[1.0]]}')
    with pytest.raises(DataError, match="not the truth of a calibration"):
        find_board(split)
    truth.unlink()
    assert find_board(split) is None


def test_output_folder_keeps_to_its_own_files(tmp_path: Path) -> None:
    out = OutputFolder(tmp_path / "out", ["a.txt"])
    (out / "a.txt").write_text("first")
    with pytest.raises(ValueError, match=r"b\.txt was not claimed"):
        _ = out / "b.txt"
    (tmp_path / "outside.txt").write_text("mine")
    (tmp_path / "out" / "b.txt").write_text("mine")
    with pytest.raises(DataError, match=r"b\.txt: was not written by this evaluation"):
        out.claim(["b.txt"])
    # A list that names a path does not reach out of the folder.
    with (tmp_path / "out" / ".samsod-evaluation").open("a") as file:
        file.write("../outside.txt\n")
    OutputFolder(tmp_path / "out", ["a.txt"]).clear()
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [".samsod-evaluation", "b.txt"]
    assert (tmp_path / "outside.txt").read_text() == "mine"
