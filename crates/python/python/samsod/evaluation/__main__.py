"""``python -m samsod.evaluation``: measures the vision chain on folders of scenes with known truth."""

from __future__ import annotations

import argparse
import datetime
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

try:
    import matplotlib  # noqa: F401
    import PIL  # noqa: F401
    import scipy  # noqa: F401
    from tqdm import tqdm
except ImportError as error:
    sys.exit(f"{error}; the evaluation needs Pillow, scipy, matplotlib and tqdm: pip install 'samsod[evaluation]'")

import samsod
from samsod.evaluation import cell as cell_scores
from samsod.evaluation.calibration import (
    CAMERA_FILE,
    RESIDUALS_FILE,
    Board,
    Calibration,
    CalibrationError,
    calibrate,
    find_board,
    find_program,
)
from samsod.evaluation.chain import inspect, measure, with_method
from samsod.evaluation.data import (
    DataError,
    SceneData,
    SceneInfo,
    find_split,
    list_scenes,
    load_scene,
    read_pixels,
)
from samsod.evaluation.output import OutputFolder
from samsod.evaluation.report import report, write_parts
from samsod.evaluation.summary import Measured, absolute, summary, upright

#: What `cell --out` writes, but for the contact sheets.
FILES = (
    "evaluation.md",
    "summary.json",
    "scenes.csv",
    "parts.csv",
    "error-x.png",
    "error-y.png",
    CAMERA_FILE,
    RESIDUALS_FILE,
)


def run_cell(arguments: argparse.Namespace) -> int:
    """The verb `cell`."""
    folder = find_split(arguments.dir, arguments.split)
    scenes = list_scenes(folder)
    if arguments.scenes:
        known = {info.name: info for info in scenes}
        unknown = [name for name in arguments.scenes if name not in known]
        if unknown:
            raise DataError(f"{folder}: no scene {', '.join(unknown)}")
        scenes = [known[name] for name in arguments.scenes]
    board = find_board(folder)
    program = find_program(arguments.samsod)
    cell = make_cell(arguments)
    exact = with_method(cell, "exact") if arguments.exact else None
    # The first frame pays for the scratch memory of the stages.
    cell.inspect(load_scene(scenes[0], arguments.scale).rgb)
    # All that is given has been looked at: from here on files are written.
    out = OutputFolder(arguments.out, FILES) if arguments.out else None
    if out:
        out.clear()
    calibration = run_calibration(board, program, out)

    measured: list[Measured] = []
    # A log is not a terminal: a line now and then is enough.
    interval = 0.1 if sys.stderr.isatty() else 10.0
    with tqdm(scenes, unit="scene", file=sys.stderr, mininterval=interval, dynamic_ncols=True) as bar:
        for info in bar:
            data = load_scene(info, arguments.scale)
            measured.append(measure(cell, info, data, arguments.repeat, exact))
            last = measured[-1].score
            bar.set_postfix_str(f"{info.name}: found {last.found}/{last.parts}", refresh=False)

    title = f"Robot cell, {folder.resolve().name}, {datetime.date.today().isoformat()}"
    if arguments.scale != 1.0:
        title += f", frames reduced to {arguments.scale:g} of their size"
    text = report(measured, calibration, title)
    print(text)
    if out:
        write_files(arguments, cell, out, scenes, measured, calibration, text)
    if isinstance(calibration, FailedCalibration):
        print(f"error: {calibration}", file=sys.stderr)
        return 1
    return 0


class FailedCalibration(str):
    """Why a calibration that was tried gave nothing."""


def run_calibration(board: Board | None, program: Path | None, out: OutputFolder | None) -> Calibration | str:
    """Calibrates from the photographs beside the scenes; returns why not when it cannot be done."""
    if board is None:
        return "there is no calib/calib.json in the folder of the scenes, beside it or above"
    if out is None:
        return "it needs --out"
    if program is None:
        return "the program samsod was not found; `make build` makes it, --samsod names it"
    print(f"calibrating from {board.count} photographs", file=sys.stderr, flush=True)
    try:
        return calibrate(program, board, out.path)
    except CalibrationError as error:
        return FailedCalibration(error)


def run_stages(arguments: argparse.Namespace) -> int:
    """The verb `stages`."""
    from samsod.evaluation.sheets import write_stages

    rgb = read_pixels(arguments.image, "RGB")
    data = SceneData(rgb=rgb, parts=np.zeros(rgb.shape[:2], np.uint8), shadow=np.zeros(rgb.shape[:2], np.bool_))
    result = inspect(make_cell(arguments), data)
    write_stages(arguments.out, rgb, result, arguments.width)
    print(f"{arguments.out}: {len(result.means)} partitions, {len(result.regions)} regions")
    return 0


def make_cell(arguments: argparse.Namespace) -> samsod.Cell:
    """The cell of a configuration file, or with defaults and the threshold given on the command line."""
    settings: Any = {} if arguments.threshold is None else {"regions": {"threshold": arguments.threshold}}
    if arguments.config:
        if settings:
            raise DataError("--threshold and --config exclude each other; set regions.threshold in the file")
        settings = arguments.config
    try:
        return samsod.Cell(settings)
    except (OSError, ValueError) as error:
        raise DataError(str(error)) from error


def write_files(
    arguments: argparse.Namespace,
    cell: samsod.Cell,
    out: OutputFolder,
    scenes: Sequence[SceneInfo],
    measured: Sequence[Measured],
    calibration: Calibration | str,
    text: str,
) -> None:
    """Writes the report, the tables, the histograms and the contact sheets of the worst scenes."""
    # Here, since drawing takes a second to load.
    from samsod.evaluation.histograms import write_histograms
    from samsod.evaluation.sheets import write_object_sheet, write_sheet

    (out / "evaluation.md").write_text(text, encoding="utf-8")
    cell_scores.write_csv([scene.score for scene in measured], out / "scenes.csv")
    write_parts(out / "parts.csv", measured)
    parts = [part for scene in upright(measured) for part in scene.objects.parts]
    for axis, name in enumerate("xy"):
        before = absolute((part.before_mm for part in parts if part.before_mm is not None), axis)
        after = absolute((part.after_mm for part in parts if part.after_mm is not None), axis)
        write_histograms(out / f"error-{name}.png", name, before, after)
    figures = summary(measured)
    figures["calibration"] = calibration.summary() if isinstance(calibration, Calibration) else None
    (out / "summary.json").write_text(json.dumps(figures, indent=1, allow_nan=False) + "\n", encoding="utf-8")

    # Scenes are inspected again rather than kept: forty would hold gigabytes.
    pairs = list(zip(measured, scenes, strict=True))
    worst = sorted(pairs, key=lambda pair: -pair[0].score.badness)[: arguments.sheets]
    for rank, (scene, info) in enumerate(worst, start=1):
        name = f"worst-{rank:02}-{info.name}.png"
        out.claim([name])
        data = load_scene(info, arguments.scale)
        write_sheet(out / name, data, inspect(cell, data), scene.score)
    worst = sorted(pairs, key=lambda pair: pair[0].objects.mean_iou)[: arguments.sheets]
    for rank, (scene, info) in enumerate(worst, start=1):
        name = f"objects-{rank:02}-{info.name}.png"
        out.claim([name])
        data = load_scene(info, arguments.scale)
        write_object_sheet(out / name, data, inspect(cell, data, paper=True), info, scene.objects)
    print(f"written to {out.path}", file=sys.stderr)


def threshold(text: str) -> str | float:
    """The argument of --threshold: a name or a number."""
    try:
        return float(text)
    except ValueError:
        return text


def scale(text: str) -> float:
    """The argument of --scale."""
    value = float(text)
    if not 0.0 < value <= 1.0:
        raise argparse.ArgumentTypeError(f"{value}; must be above 0 and at most 1")
    return value


def count(text: str) -> int:
    """A whole number, at least 0."""
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"{value}; must be 0 or more")
    return value


def positive(text: str) -> int:
    """A whole number, at least 1."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{value}; must be 1 or more")
    return value


def parser() -> argparse.ArgumentParser:
    """The command line."""
    top = argparse.ArgumentParser(prog="python -m samsod.evaluation", description=__doc__)
    verbs = top.add_subparsers(dest="verb", required=True)
    verb = verbs.add_parser("cell", help="regions, objects and places in robot-cell scenes against the truth")
    verb.set_defaults(run=run_cell)
    verb.add_argument(
        "dir",
        metavar="DIR",
        type=Path,
        help="folder of scenes (index.json, images, masks, shadows, gt) or the one above",
    )
    verb.add_argument("--split", help="folder of scenes in DIR (default: DIR itself, dev, or the only one)")
    verb.add_argument(
        "--out", metavar="DIR", type=Path, help="write report, tables, histograms, summary.json and contact sheets here"
    )
    verb.add_argument(
        "--sheets", metavar="N", type=count, default=0, help="contact sheets of the N worst scenes; needs --out"
    )
    verb.add_argument(
        "--samsod",
        metavar="PATH",
        type=Path,
        help="program that calibrates (default: target/release/samsod, then PATH)",
    )
    add_settings(verb)
    verb.add_argument("--exact", action="store_true", help="compare the fast with the exact saliency (slow)")
    verb.add_argument("--repeat", metavar="N", type=positive, default=1, help="runs a scene; times are medians")
    verb.add_argument("--scale", type=scale, default=1.0, help="factor on the size of the frames, in (0, 1]")
    verb.add_argument("--scenes", metavar="NAME", nargs="+", help="only these scenes")

    verb = verbs.add_parser("stages", help="picture of one image: frame, partitions, saliency, regions")
    verb.set_defaults(run=run_stages)
    verb.add_argument("image", metavar="IMAGE", type=Path)
    verb.add_argument("--out", metavar="FILE", type=Path, required=True, help="PNG to write")
    verb.add_argument("--width", metavar="PX", type=positive, default=480, help="width of each of the four panels")
    add_settings(verb)
    return top


def add_settings(verb: argparse.ArgumentParser) -> None:
    """Options for the parameters of the cell."""
    verb.add_argument("--config", metavar="FILE", type=Path, help="configuration of the cell (TOML)")
    verb.add_argument("--threshold", type=threshold, help="positive, adaptive or a number in [0, 1]")


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    command = parser()
    arguments = command.parse_args(argv)
    if arguments.verb == "cell" and arguments.sheets and not arguments.out:
        command.error("--sheets needs --out")
    try:
        return int(arguments.run(arguments))
    except DataError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except (OSError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
