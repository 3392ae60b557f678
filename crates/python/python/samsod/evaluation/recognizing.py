"""Runs the methods of recognition on scenes."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import samsod
from samsod.evaluation.data import DataError, SceneData, SceneInfo
from samsod.evaluation.recognition import CONVENTIONAL, METHODS, MethodScore, RecognitionScore, score_method


def check_left_out(names: set[str], left_out: Sequence[str]) -> None:
    """Checks which parts are to be left out.

    Args:
        names: all parts.
        left_out: the names to check.

    Raises:
        DataError: there is no such part, or none would remain.
    """
    unknown = sorted(set(left_out) - names)
    if unknown:
        raise DataError(f"no part {', '.join(unknown)} to leave out; there are {', '.join(sorted(names))}")
    if names <= set(left_out):
        raise DataError("all parts are left out; recognition needs at least one")


@dataclass(frozen=True)
class Recognition:
    """The recognisers that are compared.

    Attributes:
        recognizers: one for each of `METHODS`, of the same catalogue.
        known: names of the parts in it.
    """

    recognizers: Mapping[str, samsod.Recognizer]
    known: frozenset[str]

    @staticmethod
    def of(catalogue: samsod.Catalogue, left_out: Sequence[str], cell: samsod.Cell) -> Recognition:
        """The recognisers of a catalogue without some parts, with the parameters of a cell.

        Raises:
            DataError: a name is not in the catalogue, or no part is left.
        """
        check_left_out({part.name for part in catalogue.parts}, left_out)
        rest = catalogue.without(list(left_out))
        params = {key: value for key, value in cell.params["recognize"].items() if key != "method"}
        recognizers: dict[str, samsod.Recognizer] = {
            method: samsod.Recognizer(rest, method, **params) for method in METHODS
        }
        return Recognition(recognizers, frozenset(part.name for part in rest.parts))

    def warm_up(self, cell: samsod.Cell, data: SceneData, camera: samsod.Camera) -> None:
        """Runs every method once: the first frame pays for their scratch memory."""
        objects = cell.inspect(data.rgb).objects
        for recognizer in self.recognizers.values():
            recognizer.recognize(data.rgb, objects, camera)

    def measure(
        self,
        info: SceneInfo,
        data: SceneData,
        camera: samsod.Camera,
        objects: Sequence[samsod.ObjectRegion],
        detected: Sequence[int],
        repeat: int,
        conventional: bool,
        *,
        partition: samsod.Partition | None = None,
        regions: Sequence[samsod.SalientRegion] | None = None,
    ) -> tuple[RecognitionScore, list[samsod.ObjectRegion]]:
        """Runs the methods on the objects of one scene and compares what they say with the truth.

        Args:
            info: the scene.
            data: its pixels and truth.
            camera: its true camera.
            objects: its objects.
            detected: ids of the parts that a salient region covers to a half.
            repeat: number of runs, of which the time is the median; the conventional methods run once.
            conventional: run the conventional methods over the whole frame, too.
            partition, regions: of the scene, to search regions without an object, too.

        Returns:
            what the methods reached, and the objects as the parts that "best" recognised settle them.

        Raises:
            DataError: the truth does not say how a part lies.
        """
        said: dict[str, list[samsod.Detection]] = {}

        def scored(method: str, search: Callable[[], list[samsod.Detection]], runs: int) -> MethodScore:
            times = []
            for _ in range(runs):
                start = time.perf_counter()
                detections = search()
                times.append(1e3 * (time.perf_counter() - start))
            said[method] = detections
            ms = statistics.median(times)
            return score_method(info, data, camera, method, detections, self.known, detected, ms)

        scores = {
            method: scored(
                method,
                partial(recognizer.recognize, data.rgb, objects, camera, partition=partition, regions=regions),
                repeat,
            )
            for method, recognizer in self.recognizers.items()
        }
        if conventional:
            by_shape = partial(self.recognizers["shape"].conventional_shape, data.rgb, camera)
            by_sift = partial(self.recognizers["sift"].conventional_sift, data.rgb, camera)
            for method, search in zip(CONVENTIONAL, (by_shape, by_sift), strict=True):
                scores[method] = scored(method, search, 1)
        settled, _ = samsod.settle_objects(objects, said["best"])
        return RecognitionScore(scores, pixels=data.parts.size), settled
