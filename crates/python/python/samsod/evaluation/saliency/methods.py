"""What makes a saliency map of an image: our variants, other packages', or a folder of maps.

Ours on the partition of a still photo: `background` (the default of `samsod.saliency`), `centred`, `averaged`, `paper`.
With the partition and the centre-surround contrast of a robot cell: `fast` and `exact`. `slic` and `felzenszwalb` put
scikit-image's partitions under `background`; `spectral-residual` and `fine-grained` are OpenCV's. `sigma-1` to
`sigma-3` are `averaged` with the three sets of scales of table A.3.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

import samsod
from samsod.evaluation.data import DataError

Rgb = npt.NDArray[np.uint8]
Map = npt.NDArray[np.number]

#: Centre and surround deviations of table A.3, px of an image of 256 px.
SIGMA_SETS: dict[str, tuple[tuple[float, ...], tuple[float, ...]]] = {
    "sigma-1": ((3, 5, 7), (19, 23, 29)),
    "sigma-2": ((3, 5, 7), (21, 25, 29)),
    "sigma-3": ((3, 7, 9), (15, 19, 29)),
}


def _variant(name: Literal["background", "centred", "averaged", "paper"], rgb: Rgb) -> Map:
    return samsod.saliency(rgb, variant=name)


def _cell(method: Literal["fast", "exact"], rgb: Rgb) -> Map:
    return samsod.saliency(rgb, samsod.segment(rgb), method)


def _sigmas(name: str, rgb: Rgb) -> Map:
    scale = max(rgb.shape[:2]) / 256
    center, surround = ([sigma * scale for sigma in sigmas] for sigmas in SIGMA_SETS[name])
    return samsod.saliency(rgb, None, "fast", center, surround, variant="averaged")


def _opencv(name: str, rgb: Rgb) -> Map:
    import cv2

    module: Any = cv2
    makers = {
        "spectral-residual": "StaticSaliencySpectralResidual_create",
        "fine-grained": "StaticSaliencyFineGrained_create",
    }
    try:
        method = getattr(module.saliency, makers[name])()
        done, values = method.computeSaliency(np.ascontiguousarray(rgb[:, :, ::-1]))
    except cv2.error as error:
        raise ValueError(f"OpenCV: {error}") from error
    if not done:
        raise ValueError("OpenCV made no map")
    result: Map = np.asarray(values)
    return result


def _skimage(name: str, rgb: Rgb) -> Map:
    from skimage import segmentation

    if name == "slic":
        labels = segmentation.slic(rgb, n_segments=200, compactness=20.0, start_label=0)
    else:
        least = max(1, round(40 * (max(rgb.shape[:2]) / 256) ** 2))
        labels = segmentation.felzenszwalb(rgb, scale=100.0, sigma=0.5, min_size=least)
    # Labels of either may have gaps.
    _, dense = np.unique(labels, return_inverse=True)
    partition = samsod.Partition.from_labels(rgb, np.ascontiguousarray(dense.reshape(labels.shape), dtype=np.uint32))
    return samsod.saliency(rgb, partition)


#: What makes a map of an image, uint8 (H, W, 3) to (H, W), by the name of the method.
METHODS: dict[str, Callable[[Rgb], Map]] = {
    "background": partial(_variant, "background"),
    "centred": partial(_variant, "centred"),
    "averaged": partial(_variant, "averaged"),
    "paper": partial(_variant, "paper"),
    "fast": partial(_cell, "fast"),
    "exact": partial(_cell, "exact"),
    "slic": partial(_skimage, "slic"),
    "felzenszwalb": partial(_skimage, "felzenszwalb"),
    "spectral-residual": partial(_opencv, "spectral-residual"),
    "fine-grained": partial(_opencv, "fine-grained"),
    **{name: partial(_sigmas, name) for name in SIGMA_SETS},
}

#: What runs without --run.
DEFAULT = ("background",)


def check_methods(names: Sequence[str]) -> None:
    """Looks whether all methods are known and their packages there.

    Raises:
        DataError: one is not; the message says which, and what is allowed or missing.
    """
    for name in names:
        if name not in METHODS:
            raise DataError(f"--run {name}: no such method; there are {', '.join(METHODS)}")
    if {"spectral-residual", "fine-grained"} & set(names):
        try:
            import cv2
        except ImportError as error:
            raise DataError(f"{error}; OpenCV's methods need it: pip install 'samsod[peers]'") from error
        if not hasattr(cv2, "saliency"):
            raise DataError("this OpenCV has no module saliency; opencv-contrib-python-headless has it")
    if {"slic", "felzenszwalb"} & set(names):
        try:
            import skimage  # noqa: F401
        except ImportError as error:
            raise DataError(f"{error}; these partitions need scikit-image: pip install 'samsod[peers]'") from error
