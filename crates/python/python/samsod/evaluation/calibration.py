"""Runs ``samsod calibrate`` on photographs of a chessboard and compares what it finds with the true camera.

    calib/images/*.jpg    the photographs
    calib/calib.json      {"K_true": 3 rows of 3, "dist_true": [k1, k2, p1, p2, k3],
                           "pattern_inner_corners": [9, 6], "square_mm": 20.0}

In `summary.json` as "calibration":

    {"images": number with a board, "images_given": number, "reprojection_px": mean error,
     "intrinsics": {"fx" | "fy" | "cx" | "cy": {"true_px", "found_px", "error_percent"}},
     "worst_percent": largest of these errors,
     "distortion": {"true": [k1, k2, p1, p2, k3], "found": the same}}
"""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from samsod.evaluation.data import DataError, read_json
from samsod.evaluation.tables import Column, markdown_table

NAMES = ("fx", "fy", "cx", "cy")
LENS = ("k1", "k2", "p1", "p2", "k3")
#: What `samsod calibrate` writes that is kept: the camera, and what is left at every corner (its default name).
CAMERA_FILE = "camera.toml"
RESIDUALS_FILE = "residuals.png"
#: Longest time that a calibration may take, in s.
PATIENCE_S = 600


class CalibrationError(Exception):
    """``samsod calibrate`` failed, or what it wrote is no camera file; the message says how."""


@dataclass(frozen=True)
class Board:
    """Photographs of a chessboard and the camera that took them.

    Attributes:
        images: folder of the photographs.
        count: number of photographs.
        columns, rows: inner corners.
        square_mm: side of a square.
        intrinsics: true fx, fy, cx, cy in px.
        distortion: true k1, k2, p1, p2, k3.
    """

    images: Path
    count: int
    columns: int
    rows: int
    square_mm: float
    intrinsics: tuple[float, ...]
    distortion: tuple[float, ...]


@dataclass(frozen=True)
class Calibration:
    """What the calibration found beside the truth.

    Attributes:
        board: the truth.
        images: photographs in which the board was found.
        reprojection_px: mean distance of the corners found from those computed.
        intrinsics: fx, fy, cx, cy in px.
        distortion: k1, k2, p1, p2, k3.
    """

    board: Board
    images: int
    reprojection_px: float
    intrinsics: tuple[float, ...]
    distortion: tuple[float, ...]

    @property
    def errors_percent(self) -> tuple[float, ...]:
        """|found - true| / true of fx, fy, cx and cy, in percent."""
        pairs = zip(self.intrinsics, self.board.intrinsics, strict=True)
        return tuple(100.0 * abs(found - true) / abs(true) for found, true in pairs)

    def summary(self) -> dict[str, Any]:
        """The group "calibration" of `summary.json`."""
        rows = zip(NAMES, self.board.intrinsics, self.intrinsics, self.errors_percent, strict=True)
        return {
            "images": self.images,
            "images_given": self.board.count,
            "reprojection_px": self.reprojection_px,
            "intrinsics": {
                name: {"true_px": true, "found_px": found, "error_percent": error} for name, true, found, error in rows
            },
            "worst_percent": max(self.errors_percent),
            "distortion": {"true": list(self.board.distortion), "found": list(self.distortion)},
        }

    def report(self) -> str:
        """The table of the report."""
        truth = (*self.board.intrinsics, *self.board.distortion)
        found = (*self.intrinsics, *self.distortion)
        errors: tuple[float | None, ...] = (*self.errors_percent, *(None for _ in LENS))
        columns: Sequence[Column[tuple[float, float, float | None]]] = (
            Column("true", lambda row: row[0], "{:.4f}"),
            Column("found", lambda row: row[1], "{:.4f}"),
            Column("error %", lambda row: row[2], "{:.3f}"),
        )
        heads = (*(f"{name}, px" for name in NAMES), *LENS)
        return (
            f"The board was found in {self.images} of {self.board.count} photographs; mean reprojection error "
            f"{self.reprojection_px:.3f} px, largest error of an intrinsic {max(self.errors_percent):.3f} %.\n\n"
            + markdown_table("quantity", columns, list(zip(heads, zip(truth, found, errors, strict=True), strict=True)))
        )


def find_board(split: Path) -> Board | None:
    """The folder calib/ in a folder of scenes, beside it or one above.

    Raises:
        DataError: its calib.json is not in the format above, or there are no photographs.
    """
    split = split.resolve()
    for folder in (split, *list(split.parents)[:2]):
        if (folder / "calib" / "calib.json").is_file():
            return _read_board(folder / "calib")
    return None


def _read_board(folder: Path) -> Board:
    path = folder / "calib.json"
    truth = read_json(path)
    try:
        matrix = np.array(truth["K_true"], dtype=np.float64)
        lens = np.array(truth["dist_true"], dtype=np.float64)
        if matrix.shape != (3, 3) or lens.shape != (5,):
            raise ValueError(f"K_true of shape {matrix.shape} and dist_true of shape {lens.shape}")
        columns, rows = (int(n) for n in truth["pattern_inner_corners"])
        square_mm = float(truth["square_mm"])
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"{path}: not the truth of a calibration ({error!r})") from error
    images = folder / "images"
    count = sum(file.suffix.lower() in (".jpg", ".jpeg", ".png") for file in images.glob("*"))
    if not count:
        raise DataError(f"{images}: no photographs (.jpg, .png) of the board")
    return Board(
        images=images,
        count=count,
        columns=columns,
        rows=rows,
        square_mm=square_mm,
        intrinsics=tuple(float(v) for v in (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])),
        distortion=tuple(float(v) for v in lens),
    )


def find_program(given: Path | None) -> Path | None:
    """The program ``samsod``: the one given, that of the checkout this package lies in, or that on the PATH.

    Raises:
        DataError: the one given is no program.
    """
    if given is not None:
        found = shutil.which(given if given.parent != Path() else Path.cwd() / given)
        if found is None:
            raise DataError(f"{given}: no such program; `make build` makes target/release/samsod")
        return Path(found)
    for folder in Path(__file__).resolve().parents:
        built = folder / "target" / "release" / "samsod"
        if (folder / "Cargo.toml").is_file() and os.access(built, os.X_OK):
            return built
    on_path = shutil.which("samsod")
    return Path(on_path) if on_path else None


def calibrate(program: Path, board: Board, out: Path) -> Calibration:
    """Runs the program and keeps its camera file and its picture of the residuals in `out`.

    Args:
        program: ``samsod``.
        board: photographs and truth.
        out: an existing folder.

    Raises:
        CalibrationError: the program failed or wrote something else than a camera file.
    """
    with tempfile.TemporaryDirectory(prefix=".calibrate-", dir=out) as name:
        # In a folder of its own, so that nothing it writes lands where the user stands.
        scratch = Path(name).resolve()
        pattern = f"{board.columns}x{board.rows}"
        options = ["--pattern", pattern, "--square-mm", f"{board.square_mm:g}", "--out", str(scratch / CAMERA_FILE)]
        command = [str(program.resolve()), "calibrate", str(board.images), *options]
        try:
            done = subprocess.run(command, cwd=scratch, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise CalibrationError(f"{program} calibrate: {error}") from error
        if done.returncode != 0:
            said = done.stderr.strip() or done.stdout.strip() or "it said nothing"
            raise CalibrationError(f"{program} calibrate ended with code {done.returncode}: {said}")
        calibration = read_camera(scratch / CAMERA_FILE, board)
        for kept in (CAMERA_FILE, RESIDUALS_FILE):
            if (scratch / kept).is_file():
                (scratch / kept).replace(out / kept)
    return calibration


def read_camera(file: Path, board: Board) -> Calibration:
    """Reads what ``samsod calibrate`` wrote.

    Raises:
        CalibrationError: the file is missing or not a camera file.
    """
    try:
        camera = tomllib.loads(file.read_text(encoding="utf-8"))
        intrinsics, record = camera["intrinsics"], camera["calibration"]
        return Calibration(
            board=board,
            images=int(record["images"]),
            reprojection_px=float(record["mean_reprojection_error_px"]),
            intrinsics=tuple(float(intrinsics[f"{name}_px"]) for name in NAMES),
            distortion=tuple(float(intrinsics[name]) for name in LENS),
        )
    except (OSError, tomllib.TOMLDecodeError, KeyError, TypeError, ValueError) as error:
        raise CalibrationError(f"{file.name} of samsod calibrate is no camera file: {error!r}") from error
