#!/usr/bin/env python3
"""What viewers of the operator's page cost the vision chain.

Runs samsodd on a bundled frame again and again, in turns without and with viewers that read every event and fetch
every picture as the page does, and compares the processor time and the time of the chain a frame. In turns, and by
medians, since other load on the machine changes from minute to minute.

usage: scripts/page_cost.py [--bin target/release] [--viewers 3] [--turns 8] [--seconds 8] [--rate 22]
"""

from __future__ import annotations

import argparse
import http.client
import json
import os
import re
import shutil
import statistics
import subprocess
import tempfile
import threading
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FRAME = ROOT / "tests" / "data" / "cell" / "0022.jpg"


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument(
        "--bin",
        type=Path,
        default=ROOT / "target" / "release",
        help="folder of samsodd and samsod",
    )
    parser.add_argument("--viewers", type=int, default=3)
    parser.add_argument(
        "--turns", type=int, default=8, help="pairs of runs without and with viewers"
    )
    parser.add_argument("--seconds", type=float, default=8.0, help="length of a run")
    parser.add_argument("--rate", type=float, default=22.0, help="frames a second")
    return parser.parse_args()


def metrics(address: str) -> dict[str, float]:
    connection = http.client.HTTPConnection(address, timeout=30)
    connection.request("GET", "/metrics")
    text = connection.getresponse().read().decode()
    return {
        name: float(value)
        for name, value in re.findall(r"^(\S+) (\S+)$", text, re.MULTILINE)
    }


def cpu_s(pid: int) -> float:
    """Processor time of vision: of the first thread, and of those that it shares its stages with."""
    ticks = 0
    for task in Path(f"/proc/{pid}/task").iterdir():
        fields = (task / "stat").read_text().rsplit(")", 1)[1].split()
        name = (task / "comm").read_text().strip()
        # The http thread and those of its pictures are counted as what they take from the machine, not from the chain.
        if task.name == str(pid) or name.startswith(("samsodd", "rayon")):
            ticks += int(fields[11]) + int(fields[12])
    return ticks / os.sysconf("SC_CLK_TCK")


class Viewer(threading.Thread):
    """Reads events, and fetches the picture of each scene."""

    def __init__(self, address: str) -> None:
        super().__init__(daemon=True)
        self.address, self.over, self.pictures, self.ages_ms = address, False, 0, []

    def run(self) -> None:
        events = http.client.HTTPConnection(self.address, timeout=30)
        events.request("GET", "/api/v1/events")
        stream = events.getresponse()
        pictures = http.client.HTTPConnection(self.address, timeout=30)
        while not self.over:
            line = stream.readline()
            if not line.startswith(b'data: {"frame"'):
                continue
            scene = json.loads(line[6:])
            pictures.request("GET", f"/api/v1/frame.jpg?frame={scene['frame']}")
            answer = pictures.getresponse()
            answer.read()
            if answer.status == 200:
                self.pictures += 1
                self.ages_ms.append(time.time() * 1e3 - scene["timestamp_ns"] / 1e6)


def run(
    options: argparse.Namespace, viewers: int
) -> tuple[float, float, float, list[Viewer]]:
    """Processor time of vision and time of the chain a frame, ms; frames a second; the viewers."""
    folder = Path(tempfile.mkdtemp(prefix="samsod-", dir="/tmp"))
    (folder / "images").mkdir()
    shutil.copy(FRAME, folder / "images")
    config = folder / "cell.toml"
    config.write_text(
        f'[cell]\nname = "cost"\n[frames]\nroot_path = "{folder}/shm"\n[view]\n[robot]\ncontroller = "none"\n'
        f'[recording]\nfolder = "{folder}/recordings"\nmin_free_mib = 0\n[http]\nlisten = "127.0.0.1:0"\n'
    )
    daemon = subprocess.Popen(
        [options.bin / "samsodd", "--config", config],
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
    )
    client = None
    try:
        address = ""
        for line in daemon.stderr:
            if "page, health and metrics" in line:
                address = line.rsplit("address=", 1)[1].strip()
            if "ready, waiting" in line:
                break
        threading.Thread(target=daemon.stderr.read, daemon=True).start()
        frames = [
            "publish",
            folder / "images",
            "--config",
            config,
            "--rate",
            str(options.rate),
            "--loop",
        ]
        client = subprocess.Popen(
            [options.bin / "samsod", *frames],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        watching = [Viewer(address) for _ in range(viewers)]
        for viewer in watching:
            viewer.start()
        time.sleep(1.5)
        before, start, cpu = metrics(address), time.monotonic(), cpu_s(daemon.pid)
        time.sleep(options.seconds)
        after, end, cpu = metrics(address), time.monotonic(), cpu_s(daemon.pid) - cpu
        for viewer in watching:
            viewer.over = True

        def grown(name: str) -> float:
            return after[name] - before[name]

        frames = grown("samsod_frames_processed_total")
        chain = grown('samsod_stage_seconds_sum{stage="total"}') + grown(
            'samsod_stage_seconds_sum{stage="show"}'
        )
        return (
            1e3 * cpu / frames,
            1e3 * chain / frames,
            frames / (end - start),
            watching,
        )
    finally:
        for process in (client, daemon):
            if process:
                process.kill()
                process.wait()
        shutil.rmtree(folder, ignore_errors=True)


def main() -> None:
    options = arguments()
    without, watched, pictures, ages = [], [], 0, []
    for turn in range(options.turns):
        without.append(run(options, 0)[:3])
        *figures, viewers = run(options, options.viewers)
        watched.append(figures)
        pictures += sum(viewer.pictures for viewer in viewers)
        ages += [age for viewer in viewers for age in viewer.ages_ms]
        print(
            f"turn {turn + 1}: without {without[-1]}, with {tuple(figures)}", flush=True
        )
    names = [
        "processor time of vision a frame, ms",
        "chain and hand-over a frame, ms",
        "frames a second",
    ]
    for column, name in enumerate(names):
        a, b = (
            statistics.median(run[column] for run in runs)
            for runs in (without, watched)
        )
        ratios = statistics.median(
            w[column] / o[column] for o, w in zip(without, watched, strict=True)
        )
        print(
            f"{name}: {a:.2f} without, {b:.2f} with {options.viewers} viewers; "
            f"{100 * (ratios - 1):+.1f} %, median of turns"
        )
    age = statistics.median(ages)
    print(
        f"{pictures} pictures fetched; from frame to picture at the viewer: median {age:.0f} ms"
    )


if __name__ == "__main__":
    main()
