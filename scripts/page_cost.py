#!/usr/bin/env python3
"""What viewers of the operator's page cost the vision chain.

Lets a samsodd work on a bundled frame, in turns without and with viewers that read every event and fetch every
picture as the page does, and compares the processor time and the time of the chain a frame. In short turns of one
samsodd, and by medians, since other load on the machine changes from minute to minute. The viewers give way to everything: elsewhere
they would not take a share of these cores.

With --browser the time from a frame to its drawn scene is measured instead, in headless Chromium over the page itself.

usage: scripts/page_cost.py [--bin target/release] [--viewers 3] [--turns 20] [--seconds 4] [--rate 22]
       .venv/bin/python scripts/page_cost.py --browser [--seconds 8] [--rate 10]
"""

from __future__ import annotations

import argparse
import contextlib
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
from collections.abc import Iterator
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
        "--turns",
        type=int,
        default=20,
        help="pairs of stretches without and with viewers",
    )
    parser.add_argument(
        "--seconds", type=float, default=4.0, help="length of a stretch"
    )
    parser.add_argument("--rate", type=float, default=22.0, help="frames a second")
    parser.add_argument(
        "--browser", action="store_true", help="from frame to drawn scene, in Chromium"
    )
    return parser.parse_args()


def metrics(address: str) -> dict[str, float]:
    connection = http.client.HTTPConnection(address, timeout=30)
    connection.request("GET", "/metrics")
    text = connection.getresponse().read().decode()
    return {
        name: float(value)
        for name, value in re.findall(r"^(samsod\S+) (\S+)$", text, re.MULTILINE)
    }


def cpu_s(pid: int) -> dict[str, float]:
    """Processor time of vision with the threads that share its stages, and of the page."""
    times = {"vision": 0.0, "page": 0.0}
    for task in Path(f"/proc/{pid}/task").iterdir():
        try:
            name = (task / "comm").read_text().strip()
            spent = int((task / "schedstat").read_text().split()[0]) / 1e9
        except FileNotFoundError:
            continue  # It has ended meanwhile.
        # The threads that share its stages have the name of the thread that asked for the first of them.
        if name in ("samsodd", "vision"):
            times["vision"] += spent
        elif name in ("http", "page") or name.startswith("tokio"):
            times["page"] += spent
    return times


class Viewer(threading.Thread):
    """Reads events, and fetches the picture of each scene."""

    def __init__(self, address: str) -> None:
        super().__init__(daemon=True)
        self.address, self.over, self.pictures, self.ages_ms = address, False, 0, []

    def run(self) -> None:
        # Of this thread alone.
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), 19)
        events = http.client.HTTPConnection(self.address, timeout=30)
        events.request("GET", "/api/v1/events")
        stream = events.getresponse()
        pictures = http.client.HTTPConnection(self.address, timeout=30)
        with contextlib.closing(events), contextlib.closing(pictures):
            self.watch(stream, pictures)

    def watch(
        self, stream: http.client.HTTPResponse, pictures: http.client.HTTPConnection
    ) -> None:
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


@contextlib.contextmanager
def served(options: argparse.Namespace) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A samsodd that gets frames, and where it serves."""
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
        yield daemon, address
    finally:
        for process in (client, daemon):
            if process:
                process.kill()
                process.wait()
        shutil.rmtree(folder, ignore_errors=True)


def window(
    options: argparse.Namespace, daemon: subprocess.Popen[str], address: str
) -> dict[str, float]:
    """Figures of a stretch of time."""
    before, start, cpu = metrics(address), time.monotonic(), cpu_s(daemon.pid)
    time.sleep(options.seconds)
    after, end, spent = metrics(address), time.monotonic(), cpu_s(daemon.pid)

    def grown(name: str) -> float:
        return after[name] - before.get(name, 0.0)

    frames = grown("samsod_frames_processed_total")
    total, show = (
        grown(f'samsod_stage_seconds_sum{{stage="{stage}"}}')
        for stage in ("total", "show")
    )
    return {
        "frames a second": frames / (end - start),
        "time of the chain a frame, ms": 1e3 * (total + show) / frames,
        "of it handing over to the page, ms": 1e3 * show / frames,
        "processor time of vision a frame, ms": 1e3
        * (spent["vision"] - cpu["vision"])
        / frames,
        "processor time of the page a second, ms": 1e3
        * (spent["page"] - cpu["page"])
        / (end - start),
    }


def watched_window(
    options: argparse.Namespace, daemon: subprocess.Popen[str], address: str
) -> tuple[dict[str, float], list[Viewer]]:
    """Figures of a stretch of time with viewers, and the viewers."""
    viewers = [Viewer(address) for _ in range(options.viewers)]
    for viewer in viewers:
        viewer.start()
    while any(viewer.pictures == 0 for viewer in viewers):
        time.sleep(0.05)
    figures = window(options, daemon, address)
    for viewer in viewers:
        viewer.over = True
    for viewer in viewers:
        viewer.join()
    return figures, viewers


def browse(options: argparse.Namespace) -> None:
    """From the time of a frame to the second picture of the screen after the page has drawn its scene."""
    from playwright.sync_api import sync_playwright

    watch = """() => {
        const drawing = document.getElementById("drawing");
        window.ages = [];
        new MutationObserver(() => {
            const taken = Number(drawing.dataset.timestampMs);
            requestAnimationFrame(() => requestAnimationFrame(() => window.ages.push(Date.now() - taken)));
        }).observe(drawing, { attributeFilter: ["data-drawn-unix-ms"] });
    }"""
    with served(options) as (_, address), sync_playwright() as playwright:
        arguments = ["--no-sandbox"] if os.geteuid() == 0 else []
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium"), args=arguments
        )
        page = browser.new_page(viewport={"width": 1024, "height": 768})
        page.goto(f"http://{address}/")
        page.wait_for_selector("#drawing[data-drawn-unix-ms]", state="attached")
        page.evaluate(watch)
        page.wait_for_timeout(1000 * options.seconds)
        ages = sorted(page.evaluate("window.ages"))
        browser.close()
    if not ages:
        raise SystemExit("no scene was drawn")
    print(f"load of the machine over the last minute: {os.getloadavg()[0]:.1f}")
    median, most = statistics.median(ages), ages[int(0.95 * (len(ages) - 1))]
    print(
        f"{len(ages)} scenes drawn; from frame to drawn scene: median {median:.0f} ms, 95 % within {most:.0f} ms"
    )


def main() -> None:
    options = arguments()
    if options.browser:
        return browse(options)
    without, watched, pictures, ages = [], [], 0, []
    with served(options) as (daemon, address):
        # The first frames fill buffers.
        while metrics(address)["samsod_frames_processed_total"] < 5:
            time.sleep(0.1)
        for turn in range(options.turns):
            without.append(window(options, daemon, address))
            figures, viewers = watched_window(options, daemon, address)
            watched.append(figures)
            pictures += sum(viewer.pictures for viewer in viewers)
            ages += [age for viewer in viewers for age in viewer.ages_ms]
            print(f"turn {turn + 1} of {options.turns} done", flush=True)
    print(f"load of the machine over the last five minutes: {os.getloadavg()[1]:.1f}")
    for name in watched[0]:
        a, b = (
            statistics.median(figures[name] for figures in runs)
            for runs in (without, watched)
        )
        print(f"{name}: {a:.2f} without, {b:.2f} with {options.viewers} viewers")
    name = "time of the chain a frame, ms"
    ratio = statistics.median(
        b[name] / a[name] for a, b in zip(without, watched, strict=True)
    )
    print(
        f"the chain takes {100 * (ratio - 1):+.1f} % longer with viewers (median of the turns)"
    )
    age = f"{statistics.median(ages):.0f} ms" if ages else "none"
    print(
        f"{pictures} pictures fetched; from frame to picture at the viewer, median: {age}"
    )


if __name__ == "__main__":
    main()
