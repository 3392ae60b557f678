"""Pictures of the evaluation of saliency, each as PNG and as SVG: figure 8's sheets, curves, histograms, the stages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib
import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

import samsod
from samsod.evaluation import metrics as labels_metrics
from samsod.evaluation.data import DataError
from samsod.evaluation.saliency.averages import Averages
from samsod.evaluation.saliency.methods import METHODS
from samsod.evaluation.saliency.metrics import levels
from samsod.evaluation.saliency.pairs import Pair, Unreadable, read_image, read_map, read_mask, scaled
from samsod.evaluation.saliency.scoring import Score
from samsod.evaluation.sheets import partition_picture, region_picture

#: Rows of a contact sheet.
ROWS = 6
BINS = 25
#: From this S on `background` takes a pixel for an object.
BOUND = 0.5

# Ids in an SVG are random otherwise, and two runs would differ.
matplotlib.rcParams["svg.hashsalt"] = "samsod"


def _save(figure: Figure, paths: Sequence[Path]) -> None:
    for path in paths:
        # Without a date the same results give the same file.
        metadata = {"Date": None} if path.suffix == ".svg" else None
        figure.savefig(path, metadata=metadata)


def write_curves(paths: Sequence[Path], averages: Mapping[str, Averages]) -> None:
    """Precision over recall, and F over the threshold, of every method.

    Args:
        paths: files to write.
        averages: of every method.
    """
    figure = Figure(figsize=(12.0, 4.6), dpi=110, layout="constrained")
    left, right = figure.subplots(1, 2)
    for number, (method, a) in enumerate(averages.items()):
        # Colours come again after ten: then lines are broken.
        style = ("-", "--", ":")[number // 10 % 3]
        (line,) = left.plot(a.recalls, a.precisions, style, label=method, linewidth=1.4)
        left.plot([a.recall], [a.precision], "o", color=line.get_color(), markersize=4)
        right.plot(np.arange(len(a.fs)), a.fs, style, color=line.get_color(), linewidth=1.4)
    left.set(xlabel="recall", ylabel="precision", xlim=(0, 1), ylim=(0, 1), title="dots: at twice the mean")
    right.set(xlabel="threshold, levels of 255", ylabel="F", xlim=(0, 255), ylim=(0, 1), title="mean F of the images")
    for plot in (left, right):
        plot.grid(alpha=0.3)
    figure.legend(fontsize="small", loc="outside right center")
    _save(figure, paths)


def write_histograms(paths: Sequence[Path], scores: Mapping[str, Sequence[Score]]) -> None:
    """How F and the mean absolute error of the images are distributed, of every method.

    Args:
        paths: files to write.
        scores: of every method.
    """
    kept = {method: of for method, of in scores.items() if of}
    size = (9.0, 1.2 + 1.5 * len(kept))
    figure = Figure(figsize=size, dpi=110, layout="constrained")
    plots = figure.subplots(len(kept), 2, sharex="col", sharey="col", squeeze=False)
    edges = np.linspace(0.0, 1.0, BINS + 1)
    for row, (method, of) in zip(plots, kept.items(), strict=True):
        for plot, name, values in ((row[0], "F", [s.f for s in of]), (row[1], "MAE", [s.mae for s in of])):
            plot.hist(values, edges, color="#2060a0" if name == "F" else "#c05020", edgecolor="white", linewidth=0.5)
            plot.axvline(float(np.mean(values)), color="black", linestyle="--", linewidth=1.0)
            text = f"{method}: mean {np.mean(values):.3f}, median {np.median(values):.3f}"
            plot.set_title(text, fontsize="small")
            plot.grid(axis="y", alpha=0.3)
    plots[-1][0].set_xlabel("F at twice the mean")
    plots[-1][1].set_xlabel("mean absolute error")
    _save(figure, paths)


def write_sheet(paths: Sequence[Path], rows: Sequence[tuple[Pair, Mapping[str, Score]]], side_px: int | None) -> None:
    """A contact sheet as figure 8: image, truth and the map of every method, a row an image.

    Args:
        paths: files to write.
        rows: images, with the scores of their methods, which stand above the maps.
        side_px: longer side of the image that the methods are given; None: as it is.
    """
    methods = list(dict.fromkeys(method for _, scores in rows for method in scores))
    figure = Figure(figsize=(1.75 * (2 + len(methods)), 1.55 * len(rows)), dpi=110, layout="constrained")
    plots = figure.subplots(len(rows), 2 + len(methods), squeeze=False)
    for plot in plots.flat:
        plot.set_axis_off()
    for line, (pair, scores) in zip(plots, rows, strict=True):
        rgb, truth, maps = _panels(pair, list(scores), side_px)
        line[0].imshow(rgb)
        line[0].set_title(_safe(pair.name), fontsize="x-small")
        line[1].imshow(truth, cmap="gray", vmin=0, vmax=1)
        line[1].set_title("truth", fontsize="x-small")
        for plot, method in zip(line[2:], methods, strict=True):
            if method in maps:
                plot.imshow(maps[method], cmap="gray", vmin=0, vmax=255)
                plot.set_title(f"{_safe(method)} {scores[method].f:.2f}", fontsize="x-small")
    _save(figure, paths)


def _safe(text: str) -> str:
    """A name as matplotlib shall print it: a dollar would begin a formula."""
    return text.replace("$", r"\$")


def _panels(
    pair: Pair, methods: Sequence[str], side_px: int | None
) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.bool_], dict[str, npt.NDArray[np.uint8]]]:
    """Image, mask and maps of one row; they could be read a moment ago, when they were measured."""
    rgb, file_size = read_image(pair.image, side_px)
    size = scaled(file_size, side_px) if side_px is not None else file_size
    truth = read_mask(pair.mask, file_size, size).salient
    maps = {
        method: levels(read_map(pair.maps[method], size) if method in pair.maps else METHODS[method](rgb))
        for method in methods
    }
    return rgb, truth, maps


def write_stages(paths: Sequence[Path], image: Path, side_px: int | None) -> None:
    """The stages of one image: image, partitions, centre-surround contrast, by the background, centred, regions.

    Args:
        paths: files to write.
        image: the image.
        side_px: longer side that it is brought to; None leaves it.

    Raises:
        DataError: it is not an image.
    """
    try:
        rgb, _ = read_image(image, side_px)
    except Unreadable as error:
        raise DataError(str(error)) from error
    partition = samsod.segment(rgb, preset="photo")
    background = samsod.saliency(rgb, partition, variant="background")
    regions = samsod.salient_regions(background, partition, BOUND)
    painted = labels_metrics.region_image(partition.labels, [region.partitions for region in regions])
    panels: list[tuple[str, npt.NDArray[np.generic]]] = [
        (f"image, {rgb.shape[1]} x {rgb.shape[0]} px", rgb),
        (f"{len(partition)} partitions", partition_picture(partition.labels, partition.means)),
        ("paper: eqs 2 to 14", samsod.saliency(rgb, partition, variant="paper")),
        ("averaged over partitions", samsod.saliency(rgb, partition, variant="averaged")),
        ("background", background),
        (f"{len(regions)} regions, S above {BOUND:g}", region_picture(rgb, painted)),
    ]
    figure = Figure(figsize=(12.0, 6.6), dpi=110, layout="constrained")
    for plot, (title, picture) in zip(figure.subplots(2, 3).flat, panels, strict=True):
        plot.imshow(picture, cmap="gray")
        plot.set_title(title, fontsize="small")
        plot.set_axis_off()
    _save(figure, paths)


def chosen_rows(
    pairs: Mapping[str, Pair], scores: Mapping[str, Sequence[Score]], method: str
) -> dict[str, list[tuple[Pair, Mapping[str, Score]]]]:
    """The images of the contact sheets: where a method is worst, about its median, and best."""
    by_image: dict[str, dict[str, Score]] = {}
    for of in scores.values():
        for score in of:
            by_image.setdefault(score.image, {})[score.method] = score
    ordered = [score.image for score in sorted(scores[method], key=lambda score: (score.f, score.image))]
    middle = max(0, (len(ordered) - ROWS) // 2)
    parts = {"worst": ordered[:ROWS], "middle": ordered[middle : middle + ROWS], "best": ordered[-ROWS:][::-1]}
    return {part: [(pairs[image], by_image[image]) for image in images] for part, images in parts.items()}
