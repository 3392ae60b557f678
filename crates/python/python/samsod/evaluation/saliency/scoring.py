"""Measures all methods on one image; what is measured here can run in any process."""

from __future__ import annotations

import base64
import hashlib
import json
import time
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

import samsod
from samsod import _native
from samsod.evaluation.saliency.methods import METHODS
from samsod.evaluation.saliency.metrics import (
    Counts,
    Sweep,
    adaptive_threshold,
    f_measure,
    levels,
    mean_absolute_error,
    shuffled_auc,
)
from samsod.evaluation.saliency.pairs import (
    Pair,
    Problem,
    Unreadable,
    read_image,
    read_map,
    read_mask,
    reference_mask,
    scaled,
    stretched,
)

#: Size at which masks are kept for negative references of other images.
REFERENCE_SIDE_PX = 256


@dataclass(frozen=True)
class Settings:
    """What the results depend on beside the files.

    Attributes:
        methods: that are run.
        size_px: longer side that everything is brought to; None leaves the size.
        others: images whose masks make a negative reference.
        seed: chooses them.
    """

    methods: tuple[str, ...]
    size_px: int | None = None
    others: int = 10
    seed: int = 0


@dataclass(frozen=True)
class Job:
    """One image to measure: its files, and the masks that make its negative reference."""

    pair: Pair
    others: tuple[Path, ...]
    settings: Settings

    @property
    def key(self) -> str:
        """Changes when the result would: with a file, a setting or the compiled code."""
        native = Path(str(_native.__file__))
        files = [self.pair.image, self.pair.mask, *self.pair.maps.values(), *self.others, native]
        stamps = [[str(file), *_stamp(file)] for file in files]
        methods = sorted(self.pair.maps)
        said = json.dumps([self.pair.name, asdict(self.settings), methods, stamps, samsod.__version__])
        return hashlib.sha256(said.encode()).hexdigest()


def _stamp(file: Path) -> tuple[int, int]:
    try:
        status = file.stat()
    except OSError:
        return (-1, -1)
    return (status.st_size, status.st_mtime_ns)


def make_jobs(pairs: Sequence[Pair], settings: Settings) -> list[Job]:
    """One job an image, with the other images that make its negative reference.

    The choice depends on the seed and the name of the image, not on the order.
    """
    jobs = []
    for number, pair in enumerate(pairs):
        random = np.random.default_rng([settings.seed, zlib.crc32(pair.name.encode())])
        count = min(settings.others, len(pairs) - 1)
        chosen = sorted(random.choice(len(pairs) - 1, size=count, replace=False).tolist()) if count else []
        # Numbers from that of the image on belong to the next one, so that none is its own reference.
        others = tuple(pairs[other + (other >= number)].mask for other in chosen)
        jobs.append(Job(pair, others, settings))
    return jobs


@dataclass(frozen=True)
class Score:
    """How well one method did on one image.

    Attributes:
        image, method: which.
        width, height: of what was compared, px.
        threshold: twice the mean, in levels of 255.
        precision, recall, f: at that threshold (eq 17).
        best_threshold, best_f: the threshold with the largest F, and that.
        mae: eq 20.
        shuffled_f, shuffled_auc: against the negative reference; None without one.
        ms: it took to make the map; None for maps that were read.
        true, false: pixels at and above each level, of the truth and beside it: int64 (256,).
    """

    image: str
    method: str
    width: int
    height: int
    threshold: int
    precision: float
    recall: float
    f: float
    best_threshold: int
    best_f: float
    mae: float
    shuffled_f: float | None
    shuffled_auc: float | None
    ms: float | None
    true: npt.NDArray[np.int64]
    false: npt.NDArray[np.int64]

    @property
    def sweep(self) -> Sweep:
        """Precision, recall and F at every threshold."""
        return Sweep.of(Counts(self.true), Counts(self.false))


@dataclass(frozen=True)
class Result:
    """What came of a job."""

    key: str
    name: str
    scores: Sequence[Score]
    problems: Sequence[Problem]

    def to_json(self) -> str:
        """One line of text."""
        scores = [asdict(score) | {"true": _packed(score.true), "false": _packed(score.false)} for score in self.scores]
        problems = [asdict(problem) for problem in self.problems]
        return json.dumps({"key": self.key, "name": self.name, "scores": scores, "problems": problems})

    @staticmethod
    def from_json(line: str) -> Result:
        """From such a line.

        Raises:
            ValueError, KeyError, TypeError: it is none.
        """
        record: dict[str, Any] = json.loads(line)
        scores = [
            Score(**(score | {"true": _unpacked(score["true"]), "false": _unpacked(score["false"])}))
            for score in record["scores"]
        ]
        return Result(record["key"], record["name"], scores, [Problem(**problem) for problem in record["problems"]])


def _packed(counts: npt.NDArray[np.int64]) -> str:
    return base64.b85encode(zlib.compress(counts.astype("<i8").tobytes())).decode()


def _unpacked(text: str) -> npt.NDArray[np.int64]:
    counts = np.frombuffer(zlib.decompress(base64.b85decode(text)), dtype="<i8").astype(np.int64)
    if counts.shape != (256,):
        raise ValueError(f"{counts.shape} counts; expected 256")
    return counts


def negative_reference(others: Sequence[Path], size: tuple[int, int]) -> npt.NDArray[np.bool_]:
    """The union of other images' masks, each stretched to (width, height): bool (H, W)."""
    union = np.zeros((size[1], size[0]), dtype=np.bool_)
    for path in others:
        mask = reference_mask(path, REFERENCE_SIDE_PX)
        if mask is not None:
            union |= stretched(mask, size)
    return union


def score_image(job: Job) -> Result:
    """Measures every method on one image; what is wrong with its files is among the result's problems."""
    pair, settings = job.pair, job.settings
    try:
        rgb, file_size = read_image(pair.image, settings.size_px)
        size = scaled(file_size, settings.size_px) if settings.size_px is not None else file_size
        mask = read_mask(pair.mask, file_size, size)
    except Unreadable as error:
        return Result(job.key, pair.name, [], [Problem(error.kind, pair.name, error.detail)])
    problems = []
    if mask.grey_pixels:
        detail = f"{pair.mask}: {mask.grey_pixels} pixels between its darkest and its lightest; above 127 is salient"
        problems.append(Problem("mask with grey values", pair.name, detail, lost=False))
    negative = negative_reference(job.others, size)
    scores = []
    for method in (*settings.methods, *pair.maps):
        try:
            ms: float | None = None
            if method in pair.maps:
                saliency = levels(read_map(pair.maps[method], size))
            else:
                start = time.perf_counter()
                made = METHODS[method](rgb)
                ms = 1000.0 * (time.perf_counter() - start)
                saliency = levels(made)
            scores.append(_score(pair.name, method, saliency, mask.salient, negative, ms))
        except Unreadable as error:
            problems.append(Problem(f"{error.kind} of {method}", pair.name, error.detail))
        except (ValueError, RuntimeError, MemoryError) as error:
            problems.append(Problem(f"no map made by {method}", pair.name, f"{pair.image}: {error}"))
    return Result(job.key, pair.name, scores, problems)


def _score(
    image: str,
    method: str,
    saliency: npt.NDArray[np.uint8],
    truth: npt.NDArray[np.bool_],
    negative: npt.NDArray[np.bool_],
    ms: float | None,
) -> Score:
    true, false = Counts.of(saliency, truth), Counts.of(saliency, ~truth)
    sweep = Sweep.of(true, false)
    at = adaptive_threshold(saliency)
    reference = Counts.of(saliency, negative)
    best = int(np.argmax(sweep.f))
    return Score(
        image=image,
        method=method,
        width=saliency.shape[1],
        height=saliency.shape[0],
        threshold=at,
        precision=float(sweep.precision[at]),
        recall=float(sweep.recall[at]),
        f=f_measure(float(sweep.precision[at]), float(sweep.recall[at])),
        best_threshold=best,
        best_f=float(sweep.f[best]),
        mae=mean_absolute_error(saliency, truth),
        shuffled_f=float(Sweep.of(true, reference).f[at]) if reference.pixels else None,
        shuffled_auc=shuffled_auc(true, reference),
        ms=ms,
        true=true.at_least,
        false=false.at_least,
    )


def by_method(results: Sequence[Result], methods: Sequence[str]) -> Mapping[str, list[Score]]:
    """The scores of every method, in the order of the images."""
    return {method: [s for result in results for s in result.scores if s.method == method] for method in methods}
