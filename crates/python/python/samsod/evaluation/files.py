"""What `python -m samsod.evaluation cell --out` writes: report, tables, histograms, summary and contact sheets."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence

import samsod
from samsod.evaluation import cell as cell_scores
from samsod.evaluation.calibration import CAMERA_FILE, RESIDUALS_FILE, Calibration
from samsod.evaluation.chain import inspect, true_camera
from samsod.evaluation.data import SceneInfo, load_scene
from samsod.evaluation.output import OutputFolder
from samsod.evaluation.recognition_figures import counted, scores_of
from samsod.evaluation.recognition_report import write_named
from samsod.evaluation.recognizing import Recognition
from samsod.evaluation.report import write_parts
from samsod.evaluation.spread import absolute
from samsod.evaluation.summary import Measured, recognised, summary, upright

#: The files but for the contact sheets and the catalogue.
FILES = (
    "evaluation.md",
    "summary.json",
    "scenes.csv",
    "parts.csv",
    "recognition.csv",
    "error-x.png",
    "error-y.png",
    "error-angle.png",
    "conventional-sift.png",
    "conventional-shape.png",
    CAMERA_FILE,
    RESIDUALS_FILE,
)


def write_files(
    arguments: argparse.Namespace,
    cell: samsod.Cell,
    recognition: Recognition | None,
    out: OutputFolder,
    scenes: Sequence[SceneInfo],
    measured: Sequence[Measured],
    calibration: Calibration | str,
    text: str,
) -> None:
    """Writes everything.

    Args:
        arguments: `scale` of the frames, and the number of contact `sheets` of each kind.
        cell: the chain.
        recognition: what names its objects; None when that was not measured.
        out: the folder.
        scenes: the scenes.
        measured: what was measured of each of them.
        calibration: what was found, or why there is none.
        text: the report.
    """
    (out / "evaluation.md").write_text(text, encoding="utf-8")
    cell_scores.write_csv([scene.score for scene in measured], out / "scenes.csv")
    write_parts(out / "parts.csv", measured)
    _write_histograms(out, upright(measured))
    if recognition is not None:
        write_named(out / "recognition.csv", recognised(measured))
    figures = summary(measured)
    figures["calibration"] = calibration.summary() if isinstance(calibration, Calibration) else None
    (out / "summary.json").write_text(json.dumps(figures, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    _write_sheets(arguments, cell, recognition, out, scenes, measured)


def _write_histograms(out: OutputFolder, scenes: Sequence[Measured]) -> None:
    """Figures 13 to 17; the last three where something was recognised."""
    # Here, since drawing takes a second to load.
    from samsod.evaluation.histograms import write_angles, write_conventional, write_histograms

    parts = [part for scene in scenes for part in scene.objects.parts]
    for axis, name in enumerate("xy"):
        before = absolute((part.before_mm for part in parts if part.before_mm is not None), axis)
        after = absolute((part.after_mm for part in parts if part.after_mm is not None), axis)
        write_histograms(out / f"error-{name}.png", name, before, after)
    named = recognised(scenes)
    if not named:
        return

    def angles(method: str) -> list[float]:
        found = counted(method, scores_of(named, method))
        return [part.angle_error_deg for part in found if part.angle_error_deg is not None]

    write_angles(out / "error-angle.png", angles("sift"), angles("shape"))
    for method, title in (("sift", "conventional SIFT"), ("shape", "conventional shape matching")):
        conventional = f"conventional_{method}"
        scores = scores_of(named, conventional)
        errors = [part.error_mm for part in counted(conventional, scores) if part.error_mm is not None]
        if scores:
            path = out / f"conventional-{method}.png"
            write_conventional(path, title, absolute(errors, 0), absolute(errors, 1), angles(conventional))


def _write_sheets(
    arguments: argparse.Namespace,
    cell: samsod.Cell,
    recognition: Recognition | None,
    out: OutputFolder,
    scenes: Sequence[SceneInfo],
    measured: Sequence[Measured],
) -> None:
    """The contact sheets of the worst scenes of every kind."""
    from samsod.evaluation.recognition_sheets import write_recognition_sheet
    from samsod.evaluation.sheets import write_object_sheet, write_sheet

    # Scenes are inspected again rather than kept: forty would hold gigabytes.
    pairs = list(zip(measured, scenes, strict=True))

    def worst(badness: Callable[[Measured], float]) -> list[tuple[int, tuple[Measured, SceneInfo]]]:
        ordered = sorted(pairs, key=lambda pair: -badness(pair[0]))
        return list(enumerate(ordered[: arguments.sheets], start=1))

    for rank, (scene, info) in worst(lambda scene: scene.score.badness):
        name = f"worst-{rank:02}-{info.name}.png"
        out.claim([name])
        data = load_scene(info, arguments.scale)
        write_sheet(out / name, data, inspect(cell, data), scene.score)
    for rank, (scene, info) in worst(lambda scene: -scene.objects.mean_iou):
        name = f"objects-{rank:02}-{info.name}.png"
        out.claim([name])
        data = load_scene(info, arguments.scale)
        write_object_sheet(out / name, data, inspect(cell, data, paper=True), info, scene.objects)
    if recognition is None:
        return
    for rank, (scene, info) in worst(lambda scene: scene.recognition.badness if scene.recognition else 0.0):
        if scene.recognition is None:
            continue
        name = f"recognition-{rank:02}-{info.name}.png"
        out.claim([name])
        data = load_scene(info, arguments.scale)
        seen = cell.inspect(data.rgb)
        detections = recognition.recognizers["best"].recognize(
            data.rgb, seen.objects, true_camera(info, data), partition=seen.partition, regions=seen.regions
        )
        write_recognition_sheet(out / name, data, info, scene.recognition, detections)
