"""Frames that the tests share."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image

FRAMES = Path(__file__).parents[3] / "tests" / "data" / "cell"

Frame = npt.NDArray[np.uint8]


@pytest.fixture(scope="session")
def frame() -> Frame:
    """A real cell scene at half size, (479, 539, 3)."""
    with Image.open(FRAMES / "0008.jpg") as image:
        return np.array(image.reduce(2))


@pytest.fixture
def two_squares() -> Frame:
    """A grey 96 x 72 image with a red and a blue square of 16 x 16 pixels, 8 pixels apart."""
    rgb = np.full((72, 96, 3), 120, dtype=np.uint8)
    rgb[24:40, 24:40] = (220, 30, 30)
    rgb[24:40, 48:64] = (30, 30, 220)
    return rgb
