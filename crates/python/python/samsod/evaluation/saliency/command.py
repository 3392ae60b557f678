"""The verbs `saliency`, `sensitivity`, `speed` and `saliency-cell` of `python -m samsod.evaluation`."""

from __future__ import annotations

import argparse
import datetime
import json
import math
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from samsod.evaluation.data import DataError
from samsod.evaluation.output import OutputFolder
from samsod.evaluation.saliency import paper, tables
from samsod.evaluation.saliency.averages import Averages
from samsod.evaluation.saliency.cell_scenes import run_saliency_cell
from samsod.evaluation.saliency.methods import DEFAULT, METHODS, SIGMA_SETS, check_methods
from samsod.evaluation.saliency.pairs import Pairs, Problem, counted, find_pairs
from samsod.evaluation.saliency.running import PROGRESS, available_processes, one_thread, read_progress, run_jobs
from samsod.evaluation.saliency.scoring import Result, Score, Settings, by_method, make_jobs

#: Pictures of the verb `saliency`, each written as every kind.
PICTURES = ("curves", "histograms", "stages", "sheet-worst", "sheet-middle", "sheet-best")
KINDS = ("png", "svg")
#: Files of the verb `saliency` but for the pictures.
FILES = (
    PROGRESS,
    "images.csv",
    "images.parquet",
    "sweeps.csv",
    "problems.csv",
    "saliency.md",
    "table1.tex",
    "summary.json",
)


def add_verbs(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Adds the verbs to the command line."""
    verb = verbs.add_parser("saliency", help="saliency maps of images against masks: table 1, curves, contact sheets")
    verb.set_defaults(run=run_saliency)
    _add_folders(verb)
    verb.add_argument(
        "--run",
        dest="methods",
        metavar="METHOD,..",
        type=listed,
        default=DEFAULT,
        help=f"methods to run: {', '.join(METHODS)}",
    )
    verb.add_argument("--stages", metavar="IMAGE", type=Path, help="image of the figure of stages (default: the first)")
    verb.add_argument("--no-pictures", action="store_true", help="tables only; drawing takes some seconds")
    _add_running(verb)

    verb = verbs.add_parser("sensitivity", help="the three sets of scales of table A.3")
    verb.set_defaults(run=run_sensitivity)
    _add_folders(verb, maps=False)
    _add_running(verb)

    verb = verbs.add_parser("speed", help="table 2: time a pixel of methods, one image at a time")
    verb.set_defaults(run=run_speed)
    verb.add_argument("--images", metavar="DIR", type=Path, required=True, help="folder of images")
    verb.add_argument("--out", metavar="DIR", type=Path, help="write speed.md here")
    verb.add_argument(
        "--run",
        dest="methods",
        metavar="METHOD,..",
        type=listed,
        default=("background", "paper", "fast"),
        help="methods to time",
    )
    verb.add_argument("--size", metavar="PX", type=at_least(8), help="bring the longer side to this many pixels")
    verb.add_argument("--limit", metavar="N", type=at_least(1), default=50, help="at most so many images (default: 50)")
    verb.add_argument("--repeat", metavar="N", type=at_least(1), default=3, help="runs an image; the least time counts")

    verb = verbs.add_parser("saliency-cell", help="F of regions, objects and maps on robot-cell scenes")
    verb.set_defaults(run=run_saliency_cell)
    verb.add_argument("dir", metavar="DIR", type=Path, help="folder of scenes, or the one above")
    verb.add_argument("--split", help="folder of scenes in DIR (default: DIR itself, dev, or the only one)")
    verb.add_argument("--out", metavar="DIR", type=Path, help="write saliency-cell.md here")
    verb.add_argument(
        "--scale", metavar="S", type=share, default=1.0, help="factor on the size of the frames, in (0, 1]"
    )


def _add_folders(verb: argparse.ArgumentParser, maps: bool = True) -> None:
    verb.add_argument("--images", metavar="DIR", type=Path, required=True, help="folder of images")
    verb.add_argument("--masks", metavar="DIR", type=Path, required=True, help="folder of masks of the same names")
    if maps:
        verb.add_argument(
            "--maps",
            metavar="METHOD=DIR",
            type=method_folder,
            action="append",
            default=[],
            help="maps of another method; may be given several times",
        )
    verb.add_argument("--out", metavar="DIR", type=Path, required=True, help="write results here")
    verb.add_argument("--name", help="name of the database in the tables (default: the folder above the images)")


def _add_running(verb: argparse.ArgumentParser) -> None:
    verb.add_argument(
        "--size", metavar="PX", type=at_least(8), help="bring the longer side of everything to this many pixels"
    )
    verb.add_argument(
        "--others", metavar="N", type=at_least(1), default=10, help="images in a negative reference (default: 10)"
    )
    verb.add_argument("--seed", metavar="N", type=at_least(0), default=0, help="chooses them (default: 0)")
    verb.add_argument("--jobs", metavar="N", type=at_least(1), help="processes (default: one a core)")
    verb.add_argument("--cluster", metavar="ADDRESS", help="address of a Dask scheduler whose workers do the work")
    verb.add_argument("--fresh", action="store_true", help="measure everything anew, whatever is in --out")


def listed(text: str) -> tuple[str, ...]:
    """The argument of --run."""
    names = tuple(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))
    if not names:
        raise argparse.ArgumentTypeError(f"{text!r}; give at least one method")
    return names


def method_folder(text: str) -> tuple[str, Path]:
    """The argument of --maps."""
    method, separator, folder = text.partition("=")
    if not separator or not method.strip() or not folder:
        raise argparse.ArgumentTypeError(f"{text!r}; expected METHOD=DIR")
    if method.strip() in METHODS:
        raise argparse.ArgumentTypeError(f"{text!r}: {method.strip()} is a method that is run; choose another name")
    return method.strip(), Path(folder)


def share(text: str) -> float:
    """The argument of --scale."""
    value = float(text)
    if not 0.0 < value <= 1.0:
        raise argparse.ArgumentTypeError(f"{value}; must be above 0 and at most 1")
    return value


def at_least(least: int) -> Any:
    """A whole number from `least` on."""

    def number(text: str) -> int:
        value = int(text)
        if value < least:
            raise argparse.ArgumentTypeError(f"{value}; must be {least} or more")
        return value

    return number


def database_name(arguments: argparse.Namespace) -> str:
    """What the tables call the folder."""
    if arguments.name:
        return str(arguments.name)
    images = arguments.images.resolve()
    return str(images.parent.name if images.name == "images" else images.name)


def measure(arguments: argparse.Namespace, found: Pairs, methods: Sequence[str], out: OutputFolder) -> list[Result]:
    """Measures a folder; the results of earlier runs in the output folder are taken where they hold."""
    settings = Settings(tuple(methods), arguments.size, arguments.others, arguments.seed)
    done = {} if arguments.fresh else read_progress(out / PROGRESS)
    # Results are read before they are removed, so that no picture of an earlier run stays.
    out.clear()
    processes = arguments.jobs or available_processes()
    start = time.perf_counter()
    jobs = make_jobs(found.pairs, settings)
    taken = sum(job.key in done for job in jobs)
    results = run_jobs(jobs, done, out / PROGRESS, processes, arguments.cluster)
    seconds = time.perf_counter() - start
    if taken < len(jobs):
        rate = (len(jobs) - taken) / max(seconds, 1e-9)
        print(f"measured {len(jobs) - taken} images in {seconds:.1f} s, {rate:.1f} a second", file=sys.stderr)
    if taken:
        print(f"{taken} images were measured by an earlier run", file=sys.stderr)
    return results


def all_problems(found: Pairs, results: Sequence[Result]) -> list[Problem]:
    """Those of the folders and those of the files."""
    return [*found.problems, *(problem for result in results for problem in result.problems)]


def averages_of(scores: Mapping[str, Sequence[Score]]) -> dict[str, Averages]:
    """The averages of every method that has a score.

    Raises:
        DataError: none has.
    """
    averages = {method: a for method, of in scores.items() if (a := Averages.of(of)) is not None}
    if not averages:
        raise DataError("no image could be measured; see the problems above")
    return averages


def run_saliency(arguments: argparse.Namespace) -> int:
    """The verb `saliency`."""
    maps = dict(arguments.maps)
    if len(maps) < len(arguments.maps):
        raise DataError("--maps: a method is given twice")
    check_methods(arguments.methods)
    found = find_pairs(arguments.images, arguments.masks, maps)
    out = OutputFolder(arguments.out, [*FILES, *(f"{stem}.{kind}" for stem in PICTURES for kind in KINDS)])
    results = measure(arguments, found, arguments.methods, out)
    problems = all_problems(found, results)
    _print_problems(problems)
    tables.write_problems(out / "problems.csv", problems)
    methods = [*arguments.methods, *maps]
    scores = by_method(results, methods)
    averages = averages_of(scores)
    database = database_name(arguments)
    text = report(database, arguments, found, averages, problems)
    every = [score for of in scores.values() for score in of]
    tables.write_csv(out / "images.csv", every)
    tables.write_parquet(out / "images.parquet", every)
    tables.write_sweeps(out / "sweeps.csv", averages)
    (out / "saliency.md").write_text(text, encoding="utf-8")
    (out / "table1.tex").write_text(tables.latex(database, averages), encoding="utf-8")
    (out / "summary.json").write_text(summary(database, arguments, found, averages, problems), encoding="utf-8")

    if not arguments.no_pictures:
        _draw(arguments, out, found, scores, averages)
    print(text)
    print(f"written to {out.path}", file=sys.stderr)
    return 0


def _draw(
    arguments: argparse.Namespace,
    out: OutputFolder,
    found: Pairs,
    scores: Mapping[str, Sequence[Score]],
    averages: Mapping[str, Averages],
) -> None:
    """All pictures; the sheets are of the images where the first method is worst, middling and best."""
    # Here, since drawing takes a second to load.
    from samsod.evaluation.saliency import figures

    def files(stem: str) -> list[Path]:
        return [out / f"{stem}.{kind}" for kind in KINDS]

    figures.write_curves(files("curves"), averages)
    figures.write_histograms(files("histograms"), scores)
    first = next(iter(averages))
    pairs = {pair.name: pair for pair in found.pairs}
    for part, rows in figures.chosen_rows(pairs, scores, first).items():
        figures.write_sheet(files(f"sheet-{part}"), rows, arguments.size)
    stages: Path = arguments.stages or pairs[scores[first][0].image].image
    figures.write_stages(files("stages"), stages, arguments.size)


def _print_problems(problems: Sequence[Problem]) -> None:
    for line in counted(problems):
        print(f"warning: {line}", file=sys.stderr)


def report(
    database: str,
    arguments: argparse.Namespace,
    found: Pairs,
    averages: Mapping[str, Averages],
    problems: Sequence[Problem],
) -> str:
    """The report in Markdown."""
    size = f"longer side brought to {arguments.size} px" if arguments.size else "full size"
    lines = [
        f"# Saliency, {database}, {datetime.date.today().isoformat()}",
        "",
        f"{found.images} images, {len(found.pairs)} with a mask, {size}; negative references of up to "
        f"{arguments.others} other images, seed {arguments.seed}.",
        "",
        tables.markdown(database, averages),
        "",
        "F-measure: at twice the mean (eq 17); best F: at the best of 256 thresholds, of each image or one for all.",
        "",
        "## Problems",
        "",
    ]
    lines += [f"- {line}" for line in counted(problems)] or ["None."]
    return "\n".join([*lines, ""])


def summary(
    database: str,
    arguments: argparse.Namespace,
    found: Pairs,
    averages: Mapping[str, Averages],
    problems: Sequence[Problem],
) -> str:
    """The figures for machines."""
    fields = ["images", "shuffled_f", "shuffled_auc", "f", "mae", "best_f", "sweep_f", "sweep_threshold"]
    fields += ["precision", "recall", "ns_px"]
    kinds = {problem.kind for problem in problems}
    figures = {
        "database": database,
        "images": found.images,
        "size_px": arguments.size,
        "others": arguments.others,
        "seed": arguments.seed,
        "problems": {kind: sum(problem.kind == kind for problem in problems) for kind in sorted(kinds)},
        "methods": {method: {field: getattr(a, field) for field in fields} for method, a in averages.items()},
    }
    return json.dumps(figures, indent=1, allow_nan=False, ensure_ascii=False) + "\n"


def run_sensitivity(arguments: argparse.Namespace) -> int:
    """The verb `sensitivity`."""
    found = find_pairs(arguments.images, arguments.masks, {})
    out = OutputFolder(arguments.out, [PROGRESS, "sensitivity.md"])
    results = measure(arguments, found, tuple(SIGMA_SETS), out)
    problems = all_problems(found, results)
    _print_problems(problems)
    averages = averages_of(by_method(results, tuple(SIGMA_SETS)))
    text = paper.sensitivity_table(database_name(arguments), averages)
    (out / "sensitivity.md").write_text(text, encoding="utf-8")
    print(text)
    return 0


def run_speed(arguments: argparse.Namespace) -> int:
    """The verb `speed`."""
    from samsod.evaluation.saliency.pairs import Folder, Unreadable, read_image

    check_methods(arguments.methods)
    folder = Folder.read(arguments.images, "image")
    out = OutputFolder(arguments.out, ["speed.md"]) if arguments.out else None
    # One core, as the paper's figures are of code that uses one.
    one_thread()
    pictures: list[npt.NDArray[np.uint8]] = []
    problems = list(folder.problems)
    for name, path in folder.files.items():
        if len(pictures) == arguments.limit:
            break
        try:
            pictures.append(read_image(path, arguments.size)[0])
        except Unreadable as error:
            problems.append(Problem(error.kind, name, error.detail))
    _print_problems(problems)
    if not pictures:
        raise DataError(f"{arguments.images}: no image could be read")
    pixels = sum(rgb.shape[0] * rgb.shape[1] for rgb in pictures)
    ms_px: dict[str, float] = {}
    for method in arguments.methods:
        total = 0.0
        for rgb in pictures:
            least = math.inf
            for _ in range(arguments.repeat):
                # Processor time: on one thread it is what a clock shows on a machine that does nothing else.
                start = time.process_time()
                METHODS[method](rgb)
                least = min(least, time.process_time() - start)
            total += least
        ms_px[method] = 1000.0 * total / pixels
    text = paper.speed_table(ms_px, len(pictures), pixels)
    if out:
        (out / "speed.md").write_text(text, encoding="utf-8")
    print(text)
    return 0
