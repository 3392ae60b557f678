"""``python -m samsod.evaluation``: measures the vision chain on scenes, and saliency on images, with known truth."""

from __future__ import annotations

import argparse
import datetime
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
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
from samsod.evaluation import recognition_report
from samsod.evaluation.calibration import Board, Calibration, CalibrationError, calibrate, find_board, find_program
from samsod.evaluation.catalogue import TemplateSource, find_sources, read_sources, write_catalogue
from samsod.evaluation.chain import inspect, measure, true_camera, with_method
from samsod.evaluation.data import (
    DataError,
    SceneData,
    SceneInfo,
    find_split,
    list_scenes,
    load_scene,
    read_pixels,
)
from samsod.evaluation.files import FILES, write_files
from samsod.evaluation.judgement import run as run_judgement
from samsod.evaluation.output import OutputFolder
from samsod.evaluation.recognition_figures import MethodFigures
from samsod.evaluation.recognizing import Recognition, check_left_out
from samsod.evaluation.report import report
from samsod.evaluation.saliency.command import add_verbs
from samsod.evaluation.summary import Measured


def run_cell(arguments: argparse.Namespace) -> int:
    """The verb `cell`."""
    folder = find_split(arguments.dir, arguments.split)
    scenes = list_scenes(folder)
    sources = read_catalogue_sources(folder, scenes, arguments.leave_out)
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
    first = load_scene(scenes[0], arguments.scale)
    # The first frame pays for the scratch memory of the stages.
    cell.inspect(first.rgb)
    # All that is given has been looked at: from here on files are written.
    out = OutputFolder(arguments.out, FILES) if arguments.out else None
    if out:
        out.clear()
    calibration = run_calibration(board, program, out)
    with catalogue_folder(out) as parts:
        recognition = None
        if sources:
            print(f"reading the templates of {len(sources)} parts", file=sys.stderr, flush=True)
            recognition = Recognition.of(write_catalogue(parts, sources), arguments.leave_out, cell)
            recognition.warm_up(cell, first, true_camera(scenes[0], first))
        measured = measure_all(arguments, cell, exact, recognition, scenes)

    title = f"Robot cell, {folder.resolve().name}, {datetime.date.today().isoformat()}"
    if arguments.scale != 1.0:
        title += f", frames reduced to {arguments.scale:g} of their size"
    why_not = None if sources else NO_TEMPLATES
    text = report(measured, calibration, recognition_report.report(measured, why_not, arguments.leave_out), title)
    print(text)
    if out:
        write_files(arguments, cell, recognition, out, scenes, measured, calibration, text)
        print(f"written to {out.path}", file=sys.stderr)
    if isinstance(calibration, FailedCalibration):
        print(f"error: {calibration}", file=sys.stderr)
        return 1
    return 0


NO_TEMPLATES = "there are no templates/ in the folder of the scenes, beside it or above"


def read_catalogue_sources(folder: Path, scenes: Sequence[SceneInfo], left_out: Sequence[str]) -> list[TemplateSource]:
    """What the data say of every part; nothing where there are no templates, which is said."""
    found = find_sources(folder)
    if found is None:
        if left_out:
            raise DataError(f"--leave-out {','.join(left_out)}: {NO_TEMPLATES}")
        print(f"recognition is not measured: {NO_TEMPLATES}", file=sys.stderr, flush=True)
        return []
    height, width = read_pixels(scenes[0].files["images"], "RGB").shape[:2]
    sources = read_sources(*found, (width, height))
    check_left_out({source.name for source in sources}, left_out)
    return sources


@contextmanager
def catalogue_folder(out: OutputFolder | None) -> Iterator[Path]:
    """The folder of the catalogue: in that of the results, where a second run finds what was computed, or for now."""
    if out:
        yield out.path / "catalogue"
        return
    with TemporaryDirectory(prefix="samsod-catalogue-") as folder:
        yield Path(folder)


def measure_all(
    arguments: argparse.Namespace,
    cell: samsod.Cell,
    exact: samsod.Cell | None,
    recognition: Recognition | None,
    scenes: Sequence[SceneInfo],
) -> list[Measured]:
    """Measures all scenes behind a progress bar."""
    measured: list[Measured] = []
    # A log is not a terminal: a line now and then is enough.
    interval = 0.1 if sys.stderr.isatty() else 10.0
    with tqdm(scenes, unit="scene", file=sys.stderr, mininterval=interval, dynamic_ncols=True) as bar:
        for number, info in enumerate(bar):
            data = load_scene(info, arguments.scale)
            conventional = arguments.conventional > 0 and number % arguments.conventional == 0
            measured.append(measure(cell, info, data, arguments.repeat, exact, recognition, conventional))
            last = measured[-1]
            text = f"{info.name}: found {last.score.found}/{last.score.parts}"
            if last.recognition:
                best = MethodFigures.of("best", [last.recognition.methods["best"]])
                text += f", named {best.right}/{best.parts}"
            bar.set_postfix_str(text, refresh=False)
    return measured


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


def threshold(text: str) -> str | float:
    """The argument of --threshold: a name or a number."""
    try:
        return float(text)
    except ValueError:
        return text


def names(text: str) -> list[str]:
    """The argument of --leave-out: names of parts."""
    return [name.strip() for name in text.split(",") if name.strip()]


def every(text: str) -> int:
    """The argument of --conventional."""
    return 1 if text == "all" else count(text)


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
    verb = verbs.add_parser("cell", help="regions, objects, names and places in robot-cell scenes against the truth")
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
    verb.add_argument(
        "--leave-out", metavar="NAME,..", type=names, default=[], help="parts to take from the catalogue: false names"
    )
    verb.add_argument(
        "--conventional",
        metavar="N",
        type=every,
        default=6,
        help="search the whole frame of every Nth scene by the conventional methods, too, which is slow: all or a "
        "number, 0 for none (default: 6)",
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
    verb = verbs.add_parser("judgement", help="fit what tells parts from shadows, and measure it on scenes left out")
    verb.set_defaults(run=run_judgement)
    verb.add_argument("dir", metavar="DIR", type=Path, help="folder of scenes, as for cell")
    verb.add_argument(
        "--out", metavar="DIR", type=Path, help="write judgement.in and fringe.in to this folder (crates/shadow/src)"
    )
    verb.add_argument("--no-validation", action="store_true", help="do not measure on scenes and tables left out")
    add_verbs(verbs)
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
