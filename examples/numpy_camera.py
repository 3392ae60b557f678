"""A frame client in Python: sends a grey table with two squares that change places, until it is told to stop.

usage: numpy_camera.py CELL ROOT_PATH [FRAMES]
"""

from __future__ import annotations

import itertools
import sys
import time

import numpy as np

from samsod import frames


def picture(number: int) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    """uint8 (72, 96, 3)."""
    rgb = np.full((72, 96, 3), 120, np.uint8)
    colours = [(220, 30, 30), (30, 30, 220)]
    rgb[24:40, 24:40] = colours[number % 2]
    rgb[24:40, 48:64] = colours[(number + 1) % 2]
    return rgb


def main() -> None:
    cell, root_path, *count = sys.argv[1:]
    numbers = range(int(count[0])) if count else itertools.count()
    with frames.FramePublisher(cell, camera="numpy", root_path=root_path) as publisher:
        while publisher.subscribers == 0:
            time.sleep(0.02)
        for number in numbers:
            publisher.send(picture(number))
            time.sleep(0.1)
        # A subscriber maps the memory when it wakes for its first frame.
        time.sleep(0.5)


if __name__ == "__main__":
    main()
