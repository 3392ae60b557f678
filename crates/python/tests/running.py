"""A samsodd of its own for a test: its configuration, its log, its frames, and what can be asked of it."""

from __future__ import annotations

import json
import os
import queue
import shutil
import subprocess
import tempfile
import threading
import time
import urllib.request
from pathlib import Path
from types import TracebackType
from typing import Any, Self

ROOT = Path(__file__).parents[3]
DATA = ROOT / "tests" / "data"
#: Deadline of a whole wait: only a test that has failed comes here.
WATCHDOG_S = 120.0


def program(name: str) -> Path:
    """A program as `cargo test` leaves it."""
    path = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target")) / "debug" / name
    if not path.exists():
        raise FileNotFoundError(f"{path} is missing; `make test` builds it before these tests")
    return path


def wait_for(what: str, condition: Any) -> Any:
    """Waits until `condition()` is something."""
    deadline = time.monotonic() + WATCHDOG_S
    while not (value := condition()):
        assert time.monotonic() < deadline, f"{what}: not within {WATCHDOG_S} s"
        time.sleep(0.02)
    return value


class Process:
    """A program whose log is read."""

    def __init__(self, arguments: list[str | Path]) -> None:
        environment = {name: value for name, value in os.environ.items() if name != "RUST_LOG"}
        self.child = subprocess.Popen(
            [str(argument) for argument in arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            env=environment,
        )
        self.lines: queue.Queue[str] = queue.Queue()
        self.seen: list[str] = []
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self.child.stderr is not None
        for line in self.child.stderr:
            self.lines.put(line.rstrip())

    def line_with(self, text: str) -> str:
        """The next line of the log that contains `text`."""
        while True:
            try:
                line = self.lines.get(timeout=WATCHDOG_S)
            except queue.Empty:
                raise AssertionError(f"no line with {text!r}; there were {self.seen}") from None
            self.seen.append(line)
            if text in line:
                return line

    def end(self) -> int:
        """Asks it to end and waits until it has."""
        if self.child.poll() is None:
            self.child.terminate()
        code = self.child.wait(WATCHDOG_S)
        assert self.child.stderr is not None
        return code


class Samsodd:
    """A daemon with a page, and what sends it frames. Everything ends with the block."""

    def __init__(self, sections: str, catalogue: Path | None = None, camera: Path | None = None) -> None:
        # Directly below /tmp: the paths of sockets must be short.
        self.folder = Path(tempfile.mkdtemp(prefix="samsod-", dir="/tmp"))
        self.config = self.folder / "cell.toml"
        text = f'[cell]\nname = "browser"\n[frames]\nroot_path = "{self.folder}/shm"\n'
        # Small file systems of build machines are no reason to record nothing.
        text += f'[recording]\nfolder = "{self.folder}/recordings"\nmin_free_mib = 0\n'
        text += f'[http]\nlisten = "127.0.0.1:0"\n[camera]\nfile = "{camera or DATA / "cell" / "camera.toml"}"\n'
        text += "object_height_mm = 15.0\n"
        if catalogue:
            text += f'[catalogue]\nfolder = "{catalogue}"\n'
        self.config.write_text(text + sections)
        self.daemon = Process([program("samsodd"), "--config", self.config])
        self.clients: list[Process] = []

    def __enter__(self) -> Self:
        try:
            address = self.daemon.line_with("page, health and metrics").rsplit("address=", 1)[1]
            file = self.daemon.line_with("the operator's token").rsplit("file=", 1)[1]
            self.daemon.line_with("ready, waiting for frames")
        except BaseException:
            self._end()
            raise
        self.url = f"http://{address}"
        self.token = Path(file).read_text().strip()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._end()

    def _end(self) -> None:
        for process in [*self.clients, self.daemon]:
            process.child.kill()
            process.child.wait()
            if process.child.stderr is not None:
                process.child.stderr.close()
        shutil.rmtree(self.folder, ignore_errors=True)

    def publish(self, *images: Path, rate: float = 4) -> Process:
        """Sends images again and again."""
        folder = self.folder / f"images-{len(self.clients)}"
        folder.mkdir()
        for image in images:
            shutil.copy(image, folder)
        client = Process([program("samsod"), "publish", folder, "--config", self.config, "--rate", str(rate), "--loop"])
        self.clients.append(client)
        return client

    def ask(self, path: str) -> Any:
        with urllib.request.urlopen(f"{self.url}/api/v1/{path}", timeout=WATCHDOG_S) as answer:
            return json.load(answer)
