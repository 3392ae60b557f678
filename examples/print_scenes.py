"""Prints what samsodd found, a line for each frame, until it is told to stop.

usage: print_scenes.py CELL ROOT_PATH [SCENES]
"""

from __future__ import annotations

import itertools
import sys

from samsod import frames


def main() -> None:
    cell, root_path, *count = sys.argv[1:]
    numbers = range(int(count[0])) if count else itertools.count()
    with frames.SceneSubscriber(cell, root_path=root_path) as scenes:
        print("ready", flush=True)
        for _ in numbers:
            while (scene := scenes.wait(timeout_s=60.0)) is None:
                pass
            objects = [f"{found['area_px']} px" for found in scene.data["objects"]]
            names = [found["name"] or "unknown" for found in scene.data["detections"]]
            print(scene.sequence, scene.data["camera"], objects, names, flush=True)


if __name__ == "__main__":
    main()
