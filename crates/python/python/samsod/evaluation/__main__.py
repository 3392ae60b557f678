"""``python -m samsod.evaluation``: measures the vision chain on folders of scenes with known truth."""

from __future__ import annotations

import argparse
import datetime
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

try:
    import PIL  # noqa: F401
    import scipy  # noqa: F401
except ImportError as error:
    sys.exit(f"{error}; the evaluation needs Pillow and scipy: pip install 'samsod[evaluation]'")

import samsod
from samsod.evaluation import cell as cell_scores
from samsod.evaluation import metrics
from samsod.evaluation.cell import Inspection, SceneScore
from samsod.evaluation.data import DataError, SceneData, SceneInfo, list_scenes, load_scene, read_pixels


def inspect(cell: samsod.Cell, data: SceneData, repeat: int = 1, exact: samsod.Cell | None = None) -> Inspection:
    """Runs the chain on one scene; with `repeat` > 1 the times are medians.

    Args:
        cell: the chain to measure.
        data: the scene.
        repeat: number of runs.
        exact: the same chain with the exact saliency, to compare with.
    """
    scenes = [cell.inspect(data.rgb) for _ in range(repeat)]
    scene = scenes[-1]
    timings = {stage: float(np.median([s.timings_ms[stage] for s in scenes])) for stage in cell_scores.STAGES}
    difference, same = None, None
    if exact is not None:
        reference = exact.inspect(data.rgb)
        if not np.array_equal(reference.partition.labels, scene.partition.labels):
            raise ValueError("two runs of the segmentation differ; fast and exact saliency cannot be compared")
        difference = metrics.mean_absolute_difference(scene.saliency, reference.saliency)
        same = salient_partitions(scene) == salient_partitions(reference)
    return Inspection(
        labels=scene.partition.labels,
        means=scene.partition.means,
        saliency=scene.saliency,
        regions=[region.partitions for region in scene.regions],
        timings_ms=timings,
        exact_difference=difference,
        exact_same=same,
    )


def salient_partitions(scene: samsod.Scene) -> set[int]:
    """Labels of all partitions in salient regions."""
    return {label for region in scene.regions for label in region.partitions}


def with_method(cell: samsod.Cell, method: str) -> samsod.Cell:
    """The same cell with another way to evaluate the saliency."""
    params = cell.params
    return samsod.Cell({**params, "saliency": {**params.get("saliency", {}), "method": method}})


def run_cell(arguments: argparse.Namespace) -> int:
    """The verb `cell`."""
    scenes = list_scenes(arguments.dir, arguments.split)
    if arguments.scenes:
        known = {info.name: info for info in scenes}
        unknown = [name for name in arguments.scenes if name not in known]
        if unknown:
            raise DataError(f"{arguments.dir}: no scene {', '.join(unknown)} in split {arguments.split!r}")
        scenes = [known[name] for name in arguments.scenes]
    cell = samsod.Cell(cell_settings(arguments))
    exact = with_method(cell, "exact") if arguments.exact else None
    # The first frame pays for the scratch memory of the stages.
    cell.inspect(load_scene(scenes[0], arguments.scale).rgb)

    scores: list[SceneScore] = []
    start = time.monotonic()
    for number, info in enumerate(scenes, start=1):
        data = load_scene(info, arguments.scale)
        score = cell_scores.score_scene(info, data, inspect(cell, data, arguments.repeat, exact))
        scores.append(score)
        print(progress(number, len(scenes), score), file=sys.stderr, flush=True)
    print(f"{len(scenes)} scenes in {time.monotonic() - start:.1f} s", file=sys.stderr)

    title = f"Robot cell, split {arguments.split}, {datetime.date.today().isoformat()}"
    if arguments.scale != 1.0:
        title += f", frames reduced to {arguments.scale:g} of their size"
    text = cell_scores.report(scores, title)
    print(text)
    if arguments.out:
        write_files(arguments, cell, scenes, scores, text)
    return 0


def run_stages(arguments: argparse.Namespace) -> int:
    """The verb `stages`."""
    from samsod.evaluation.sheets import write_stages

    rgb = read_pixels(arguments.image, "RGB")
    data = SceneData(rgb=rgb, parts=np.zeros(rgb.shape[:2], np.uint8), shadow=np.zeros(rgb.shape[:2], np.bool_))
    result = inspect(samsod.Cell(cell_settings(arguments)), data)
    write_stages(arguments.out, rgb, result, arguments.width)
    print(f"{arguments.out}: {len(result.means)} partitions, {len(result.regions)} regions")
    return 0


def cell_settings(arguments: argparse.Namespace) -> Any:
    """The cell's parameters: a configuration file, or defaults, with a threshold given on the command line."""
    if arguments.config:
        if arguments.threshold is not None:
            raise DataError("--threshold and --config exclude each other; set regions.threshold in the file")
        return arguments.config
    return {} if arguments.threshold is None else {"regions": {"threshold": arguments.threshold}}


def progress(number: int, count: int, score: SceneScore) -> str:
    """One line a scene."""
    exact = "" if score.exact_difference is None else f"  exact {score.exact_difference:.5f} same {score.exact_same}"
    return (
        f"[{number:>{len(str(count))}}/{count}] {score.scene} {score.table:13} {score.lighting:7} {score.scenario:8}"
        f" found {score.found}/{score.parts} cut {score.cut} spurious {score.spurious} IoU {score.iou:.3f}"
        f" (bound {score.bound_iou:.3f}) partitions {score.partitions}"
        f"  {score.segment_ms:.0f}+{score.saliency_ms:.0f}+{score.regions_ms:.1f} ms{exact}"
    )


def write_files(
    arguments: argparse.Namespace,
    cell: samsod.Cell,
    scenes: Sequence[SceneInfo],
    scores: Sequence[SceneScore],
    text: str,
) -> None:
    """Writes evaluation.md, scenes.csv and the contact sheets of the worst scenes."""
    out: Path = arguments.out
    out.mkdir(parents=True, exist_ok=True)
    (out / "evaluation.md").write_text(text, encoding="utf-8")
    cell_scores.write_csv(scores, out / "scenes.csv")
    if arguments.sheets > 0:
        from samsod.evaluation.sheets import write_sheet

        worst = sorted(zip(scores, scenes, strict=True), key=lambda pair: -pair[0].badness)[: arguments.sheets]
        for rank, (score, info) in enumerate(worst, start=1):
            # Inspected again rather than kept: forty scenes would hold a gigabyte.
            data = load_scene(info, arguments.scale)
            write_sheet(out / f"worst-{rank:02}-{info.name}.png", data, inspect(cell, data), score)
    print(f"written to {out}", file=sys.stderr)


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
    verb = verbs.add_parser("cell", help="salient regions of robot-cell scenes against parts and shadows")
    verb.set_defaults(run=run_cell)
    verb.add_argument("dir", metavar="DIR", type=Path, help="folder with SPLIT/index.json, images, masks, shadows, gt")
    verb.add_argument("--split", default="dev", help="split to measure on (default: %(default)s)")
    verb.add_argument("--out", metavar="DIR", type=Path, help="write evaluation.md, scenes.csv and contact sheets here")
    verb.add_argument(
        "--sheets", metavar="N", type=count, default=0, help="contact sheets of the N worst scenes; needs --out"
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
    except (DataError, OSError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
