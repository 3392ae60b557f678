from collections.abc import Mapping, Sequence
from os import PathLike
from typing import Any, Literal, final

import numpy as np
import numpy.typing as npt

__all__ = [
    "Cell",
    "Partition",
    "SalientRegion",
    "Scene",
    "__version__",
    "saliency",
    "salient_regions",
    "segment",
]

__version__: str

@final
class Partition:
    @staticmethod
    def from_labels(rgb: npt.NDArray[np.uint8], labels: npt.NDArray[np.uint32]) -> Partition: ...
    @property
    def width(self) -> int: ...
    @property
    def height(self) -> int: ...
    @property
    def labels(self) -> npt.NDArray[np.uint32]: ...
    @property
    def areas(self) -> npt.NDArray[np.int64]: ...
    @property
    def means(self) -> npt.NDArray[np.float32]: ...
    @property
    def boxes(self) -> npt.NDArray[np.int64]: ...
    @property
    def centroids(self) -> npt.NDArray[np.float32]: ...
    def neighbours(self, label: int) -> npt.NDArray[np.uint32]: ...
    def __len__(self) -> int: ...

@final
class SalientRegion:
    @property
    def mask(self) -> npt.NDArray[np.bool_]: ...
    @property
    def centroid(self) -> tuple[float, float]: ...
    @property
    def bbox(self) -> tuple[int, int, int, int]: ...
    @property
    def area(self) -> int: ...
    @property
    def partitions(self) -> list[int]: ...
    @property
    def mean_saliency(self) -> float: ...
    @property
    def axis_deg(self) -> float: ...

@final
class Scene:
    @property
    def partition(self) -> Partition: ...
    @property
    def saliency(self) -> npt.NDArray[np.float32]: ...
    @property
    def regions(self) -> list[SalientRegion]: ...
    @property
    def timings_ms(self) -> dict[str, float]: ...

@final
class Cell:
    def __new__(cls, config: str | PathLike[str] | Mapping[str, Any] | None = None) -> Cell: ...
    @property
    def params(self) -> dict[str, Any]: ...
    def inspect(self, rgb: npt.NDArray[np.uint8]) -> Scene: ...

def segment(
    rgb: npt.NDArray[np.uint8],
    *,
    spatial_bandwidth_px: float | None = None,
    range_bandwidth: float | None = None,
    min_area_px: int | None = None,
    texture_gain: float | None = None,
) -> Partition: ...
def saliency(
    rgb: npt.NDArray[np.uint8],
    partition: Partition,
    method: Literal["fast", "exact"] = "fast",
    center: Sequence[float] | None = None,
    surround: Sequence[float] | None = None,
) -> npt.NDArray[np.float32]: ...
def salient_regions(
    saliency: npt.NDArray[np.float32],
    partition: Partition,
    threshold: Literal["positive", "adaptive"] | float | None = None,  # None: "positive"
) -> list[SalientRegion]: ...
