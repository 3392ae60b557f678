"""samsod.frames: against the Rust crate and against samsodd, each a process of its own, in real shared memory."""

from __future__ import annotations

import ctypes
import gc
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from conftest import Frame as Pixels

from samsod import frames

ROOT = Path(__file__).parents[3]
WATCHDOG_S = 120.0
"""Long enough for any machine: a test that needs it has failed."""
CELL = "python-test"


def program(name: str, how: str) -> Path:
    """What `cargo test` has built."""
    path = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target")) / "debug" / name
    if not path.exists():
        pytest.fail(f"{path} is not there; {how}, which make test does first")
    return path


@pytest.fixture
def root() -> Iterator[Path]:
    """Shared memory of one test; below /tmp, for the paths of sockets must be short."""
    with tempfile.TemporaryDirectory(prefix="samsod-", dir="/tmp") as folder:
        yield Path(folder)


class Process:
    """A program whose lines are read one by one, and which does not outlive its test."""

    def __init__(self, *command: str | Path) -> None:
        self.popen = subprocess.Popen(list(command), stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self.watchdog = threading.Timer(WATCHDOG_S, self.popen.kill)
        self.watchdog.start()

    def __enter__(self) -> Process:
        return self

    def __exit__(self, *error: object) -> None:
        self.watchdog.cancel()
        self.popen.kill()
        self.popen.communicate()

    def line(self) -> str:
        assert self.popen.stdout is not None
        line = self.popen.stdout.readline()
        assert line, f"{self.popen.args!r} has ended with code {self.popen.wait()}"
        return line.rstrip("\n")

    def tell(self, line: str) -> None:
        assert self.popen.stdin is not None
        self.popen.stdin.write(line + "\n")
        self.popen.stdin.flush()


def peer(*arguments: str | Path) -> Process:
    return Process(program("examples/frame_peer", "cargo build -p samsod-frame --example frame_peer"), *arguments)


def wait_for_scene(scenes: frames.SceneSubscriber) -> frames.Scene:
    scene = scenes.wait(WATCHDOG_S)
    assert scene is not None
    return scene


def test_layout_is_that_of_rust() -> None:
    lines = []
    for name, header in (("FrameHeader", frames.FrameHeader), ("SceneHeader", frames.SceneHeader)):
        for field in header._fields_:
            descriptor = getattr(header, field[0])
            lines.append(f"{name} {field[0]} {descriptor.offset} {descriptor.size}")
        lines.append(f"{name} - - {ctypes.sizeof(header)}")
    for known in frames.PixelFormat:
        lines.append(f"PixelFormat {known.name.lower()} {known.value} {known.bytes_per_pixel}")
    rust = program("examples/frame_peer", "cargo build -p samsod-frame --example frame_peer")
    said = subprocess.run([rust, "layout"], check=True, capture_output=True, text=True).stdout
    assert said.splitlines() == lines


def test_a_rust_subscriber_gets_python_frames(root: Path, frame: Pixels) -> None:
    mirrored = frame[:40, 20:80][:, ::-1]
    assert not mirrored.flags.c_contiguous
    grey = np.arange(12, dtype=np.uint8).reshape(3, 4)
    with (
        frames.FramePublisher(CELL, camera="links", root_path=root, max_frame_bytes=1 << 16) as publisher,
        peer("receive", CELL, root, "3") as rust,
    ):
        assert rust.line() == "ready"
        assert publisher.subscribers == 1
        assert publisher.send(mirrored, timestamp_ns=77, camera_frame=5, camera_time_ns=6) == 1
        first, last = mirrored[0, 0].tolist(), mirrored[-1, -1].tolist()
        assert rust.line() == f'0 77 60 40 180 rgb8 "links" 5 6 {first} {last}'
        before_ns = time.time_ns()
        publisher.send(grey)
        number, timestamp_ns, rest = rust.line().split(" ", 2)
        assert (number, rest) == ("1", '4 3 4 mono8 "links" 0 0 [0, 0, 0] [11, 11, 11]')
        assert before_ns <= int(timestamp_ns) <= time.time_ns()
        publisher.send(grey, pixel_format=frames.PixelFormat.BAYER_BG8, timestamp_ns=1)
        # Blue 0, green of 1 and 4, red 5; blue of the last row's neighbours 8 and 10, ..
        assert rust.line().startswith('2 1 4 3 4 bayer_bg8 "links" 0 0 [5, 3, 0] ')
        assert publisher.sent == 3


def test_python_gets_rust_frames_in_place(root: Path) -> None:
    with frames.FrameSubscriber(CELL, root_path=root) as subscriber, peer("send", CELL, root, "4") as rust:
        assert rust.line() == "ready"
        assert subscriber.wait(0.0) is None
        held = []
        for number in range(2):
            rust.tell("send")
            frame = subscriber.wait(WATCHDOG_S)
            assert frame is not None
            held.append(frame)
            assert (frame.sequence, frame.timestamp_ns, frame.camera) == (number, 1000 + number, "peer")
            assert (frame.camera_frame, frame.camera_time_ns) == (100 + number, 7)
            assert rust.line() == "sent"
        pixels = held[0].pixels
        assert pixels.shape == (4, 6, 3)
        assert pixels.strides == (20, 3, 1), "padded rows are read where they lie"
        rows, columns = np.mgrid[:4, :6]
        assert np.array_equal(pixels, np.dstack([rows, columns, np.zeros_like(rows)]))
        with pytest.raises(ValueError, match="read-only"):
            pixels[0, 0, 0] = 1
        with pytest.raises(ValueError, match="WRITEABLE"):
            pixels.flags.writeable = True

        rust.tell("send")
        assert rust.line() == "sent"
        with pytest.raises(frames.ServiceError, match="too many frames are held"):
            subscriber.wait(WATCHDOG_S)
        assert pixels[3, 5].tolist() == [3, 5, 0], "a frame that is held is not overwritten"
        # A view alone keeps its frame; without it the place is free.
        corner = pixels[3:, 5:]
        del frame, pixels
        held.clear()
        gc.collect()
        assert corner.tolist() == [[[3, 5, 0]]]
        frame = subscriber.wait(WATCHDOG_S)
        assert frame is not None
        assert frame.pixels[0, 0].tolist() == [0, 0, 2]
        rust.tell("send")
    assert corner.tolist() == [[[3, 5, 0]]], "also after the cell was left"


def test_python_gets_rust_scenes_in_order(root: Path) -> None:
    with frames.SceneSubscriber(CELL, root_path=root) as scenes, peer("send-scenes", CELL, root, "3") as rust:
        assert rust.line() == "ready"
        assert scenes.wait(0.0) is None
        for _ in range(3):
            rust.tell("send")
            assert rust.line() == "sent"
        for number in range(3):
            scene = wait_for_scene(scenes)
            assert (scene.sequence, scene.timestamp_ns) == (number, 1000 + number)
            assert scene.data["sequence"] == number
            assert [found["name"] for found in scene.data["detections"]] == ["Ölpumpe", None]


class RosNode:
    """What the node of docs/ros2.md uses of rclpy: this machine has no ROS 2."""

    def __init__(self, name: str) -> None:
        self.published: dict[str, list[Any]] = {}

    def create_publisher(self, kind: type, topic: str, depth: int) -> Any:
        messages = self.published.setdefault(topic, [])
        return SimpleNamespace(publish=messages.append)

    def create_timer(self, period_s: float, callback: Any) -> None:
        assert callback == self.poll  # type: ignore[attr-defined]


class RosMessage(SimpleNamespace):
    """A message of ROS 2: any field, with further fields below it."""

    def __getattr__(self, name: str) -> Any:
        value: Any = [] if name == "poses" else RosMessage()
        setattr(self, name, value)
        return value


def test_the_node_of_the_documentation(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = (ROOT / "docs" / "ros2.md").read_text()
    (code,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    assert "/run/samsod" in code
    code = code.replace("/run/samsod", str(root)).replace('"cell"', repr(CELL))
    nodes: list[Any] = []
    modules: dict[str, dict[str, Any]] = {
        "rclpy": {"init": lambda: None, "spin": nodes.append},
        "rclpy.node": {"Node": RosNode},
        "geometry_msgs": {},
        "geometry_msgs.msg": {"Pose": RosMessage, "PoseArray": RosMessage},
        "std_msgs": {},
        "std_msgs.msg": {"String": RosMessage},
    }
    for name, content in modules.items():
        module = ModuleType(name)
        module.__dict__.update(content)
        monkeypatch.setitem(sys.modules, name, module)
    exec(compile(code, "docs/ros2.md", "exec"), {"__name__": "__main__"})
    (node,) = nodes
    with peer("send-scenes", CELL, root, "2") as rust:
        assert rust.line() == "ready"
        for _ in range(2):
            rust.tell("send")
            assert rust.line() == "sent"
        node.poll()
    parts, scenes = node.published["samsod/parts"], node.published["samsod/scene"]
    assert [json.loads(scene.data)["sequence"] for scene in scenes] == [0, 1]
    for number, message in enumerate(parts):
        assert message.header.frame_id == "world"
        assert (message.header.stamp.sec, message.header.stamp.nanosec) == (0, 1000 + number)
        (pose,) = message.poses
        assert (pose.position.x, pose.position.y, pose.position.z) == (0.25, -0.04, 0.0)
        assert np.allclose([pose.orientation.z, pose.orientation.w], [np.sqrt(0.5)] * 2)
    node.scenes.close()


def test_samsodd_sees_python_frames(root: Path, two_squares: Pixels) -> None:
    config = root / "cell.toml"
    recordings = root / "recordings"
    config.write_text(
        f'[cell]\nname = "{CELL}"\n[frames]\nroot_path = "{root}"\n'
        f'[recording]\nfolder = "{recordings}"\nmin_free_mib = 0\n[robot]\ncontroller = "none"\n'
    )
    samsodd = program("samsodd", "cargo build -p samsod-daemon")
    with (
        frames.SceneSubscriber(CELL, root_path=root) as scenes,
        frames.FramePublisher(CELL, camera="numpy", root_path=root) as publisher,
        Process(samsodd, "--config", config) as daemon,
    ):
        start = time.monotonic()
        while publisher.subscribers == 0:
            assert daemon.popen.poll() is None, "samsodd has ended"
            assert time.monotonic() - start < WATCHDOG_S
            time.sleep(0.01)
        publisher.send(two_squares, timestamp_ns=123_456_789)
        scene = wait_for_scene(scenes)
        assert (scene.sequence, scene.timestamp_ns) == (0, 123_456_789)
        assert (scene.data["camera"], scene.data["width_px"], scene.data["height_px"]) == ("numpy", 96, 72)
        # Two squares of 16 px, at their places.
        assert scene.data["object_count"] == 2
        centroids = sorted(tuple(found["centroid_px"]) for found in scene.data["objects"])
        assert np.allclose(centroids, [(31.5, 31.5), (55.5, 31.5)], atol=1.0)
        # The examples, each a process of its own, in the places of this one.
        publisher.close()
        examples = ROOT / "examples"
        with Process(sys.executable, examples / "print_scenes.py", CELL, root, "1") as reader:
            assert reader.line() == "ready"
            with Process(sys.executable, examples / "numpy_camera.py", CELL, root):
                line = reader.line()
                printed = re.fullmatch(r"\d+ numpy \['(\d+) px', '(\d+) px'\] \[\]", line)
                assert printed is not None, line
                assert all(200 <= int(area) <= 300 for area in printed.groups()), f"16 x 16 px each: {line}"
        daemon.popen.send_signal(signal.SIGTERM)
        assert daemon.popen.wait(WATCHDOG_S) == 0
        assert list(recordings.glob("*.mcap")), "and recorded them"


def test_a_wait_lets_other_threads_run(root: Path) -> None:
    with frames.FrameSubscriber(CELL, root_path=root) as subscriber:
        with frames.FramePublisher(CELL, root_path=root, max_frame_bytes=64) as publisher:
            # Were the lock held, this thread could never send what the other one waits for.
            sender = threading.Thread(target=lambda: publisher.send(np.full((2, 2), 9, np.uint8)))
            sender.start()
            frame = subscriber.wait(WATCHDOG_S)
            sender.join()
        assert frame is not None
        assert frame.pixels.tolist() == [[9, 9], [9, 9]]


@pytest.mark.parametrize(
    ("pixels", "options", "message"),
    [
        (np.zeros((2, 2, 3), np.float32), {}, r"pixels are float32; uint8 is allowed"),
        (np.zeros((2, 2, 4), np.uint8), {}, r"shape \(2, 2, 4\); \(H, W, 3\) and \(H, W\) are allowed"),
        (np.zeros((0, 2), np.uint8), {}, r"height is 0 px; 1 to 16384 px are allowed"),
        (np.zeros((1, 16_385), np.uint8), {}, r"width is 16385 px; 1 to 16384 px are allowed"),
        (
            np.zeros((300, 2, 3), np.uint8),
            {},
            r"1800 bytes do not fit into a slot of 1024 bytes; raise max_frame_bytes",
        ),
        (np.zeros((2, 2), np.uint8), {"timestamp_ns": -1}, r"timestamp_ns is -1; 0 to \d+ are allowed"),
        (np.zeros((2, 2), np.uint8), {"camera_frame": 1 << 64}, r"camera_frame is 18446744073709551616; 0 to "),
        (
            np.zeros((2, 2, 3), np.uint8),
            {"pixel_format": frames.PixelFormat.BAYER_RG8},
            r"shape \(2, 2, 3\); \(H, W\) is allowed for bayer_rg8",
        ),
    ],
)
def test_frames_that_are_refused(root: Path, pixels: Any, options: dict[str, Any], message: str) -> None:
    with frames.FramePublisher(CELL, root_path=root, max_frame_bytes=1024) as publisher:
        with pytest.raises(frames.FrameError, match=message):
            publisher.send(pixels, **options)
        assert publisher.sent == 0


def test_settings_that_are_refused(root: Path) -> None:
    for cell in ("", ".cell", "a b", "x" * 65, "cell\n"):
        with pytest.raises(frames.FrameError, match=r"must be 1 to 64 of a-z A-Z 0-9 _ - \. and not start with a dot"):
            frames.FrameSubscriber(cell, root_path=root)
    with pytest.raises(frames.FrameError, match="root_path here: it must be absolute"):
        frames.SceneSubscriber(CELL, root_path="here")
    with pytest.raises(frames.FrameError, match="it has 41 bytes, at most 40 are allowed"):
        frames.SceneSubscriber(CELL, root_path="/" + "x" * 40)
    with pytest.raises(frames.FrameError, match="has 32 bytes; at most 31 are allowed"):
        frames.FramePublisher(CELL, root_path=root, camera="x" * 32)
    with pytest.raises(frames.FrameError, match="must have no control characters"):
        frames.FramePublisher(CELL, root_path=root, camera="a\0b")
    with pytest.raises(frames.FrameError, match="max_subscribers is 17; 1 to 16 are allowed"):
        frames.FramePublisher(CELL, root_path=root, max_subscribers=17)
    with frames.FrameSubscriber(CELL, root_path=root) as subscriber:
        with pytest.raises(frames.FrameError, match="timeout_s is nan; 0 to 1e6 are allowed"):
            subscriber.wait(float("nan"))
        with pytest.raises(frames.ServiceError, match=r"DoesNotSupport.*it exists with smaller limits"):
            frames.FrameSubscriber(CELL, root_path=root, buffer_frames=3)
    with pytest.raises(frames.ServiceError, match=f"service samsod/{CELL}/frames has been left"):
        subscriber.wait(0.0)


def test_a_third_publisher_finds_no_place(root: Path) -> None:
    with (
        frames.FramePublisher(CELL, root_path=root),
        frames.FramePublisher(CELL, root_path=root),
        pytest.raises(frames.ServiceError, match="all its places are taken; end another participant first"),
    ):
        frames.FramePublisher(CELL, root_path=root)
    with frames.FramePublisher(CELL, root_path=root) as publisher:
        assert publisher.send(np.zeros((2, 2), np.uint8)) == 0, "places are free again, and nobody listens"
