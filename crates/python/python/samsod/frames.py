"""Frames into the shared memory of a cell, and frames and scenes out of it: what the crate `samsod-frame` is for Rust.

    import numpy as np
    from samsod import frames

    with frames.FramePublisher("cell", camera="top") as publisher:
        publisher.send(rgb)                              # uint8 (H, W, 3), or (H, W) for grey and Bayer

    with frames.SceneSubscriber("cell") as scenes:
        while (scene := scenes.wait(timeout_s=10.0)) is not None:
            for found in scene.data["detections"]:
                print(scene.sequence, found["name"])

    with frames.FrameSubscriber("cell") as subscriber:
        frame = subscriber.wait(timeout_s=1.0)           # the latest, or None
        if frame is not None:
            print(frame.camera, frame.pixels.shape)      # read in place, read-only

Needs iceoryx2 0.10 (`pip install samsod[frames]`). All participants of a cell run as one user and name the same
`root_path`. A wait lets other Python threads run. Objects of this module belong to one thread at a time.
"""

from __future__ import annotations

import ctypes
import json
import math
import re
import time
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import numpy.typing as npt

try:
    import iceoryx2 as iox2
except ImportError as error:
    raise ImportError("samsod.frames needs iceoryx2 0.10: pip install 'samsod[frames]'") from error

__all__ = [
    "MAX_SIDE_PX",
    "MAX_STRIDE_BYTES",
    "Frame",
    "FrameError",
    "FrameHeader",
    "FramePublisher",
    "FrameSubscriber",
    "PixelFormat",
    "Scene",
    "SceneHeader",
    "SceneSubscriber",
    "ServiceError",
]

Pixels = npt.NDArray[np.uint8]

MAX_SIDE_PX = 16_384
"""Largest width and height of a frame, px."""
MAX_STRIDE_BYTES = 65_536
"""Largest distance between the starts of two rows, bytes."""

_SENT_EVENT = 1
_MAX_PUBLISHERS = 2
_MAX_NODES = 16
_MAX_ROOT_PATH = 40
_BORROWED_FRAMES = 2
_BUFFERED_SCENES = 8
_BORROWED_SCENES = 2
_SLICE_S = 0.1
"""Longest sleep at a time, s: Python answers to Ctrl-C between two."""


class FrameError(ValueError):
    """A frame or a setting that is not accepted; the message names the value and what is allowed."""


class ServiceError(RuntimeError):
    """The shared memory of the cell cannot be used; the message says why."""


class PixelFormat(IntEnum):
    """How the bytes of a row are to be read. One byte a sample."""

    RGB8 = 1
    BGR8 = 2
    MONO8 = 3
    BAYER_RG8 = 4
    BAYER_GR8 = 5
    BAYER_GB8 = 6
    BAYER_BG8 = 7

    @property
    def bytes_per_pixel(self) -> int:
        """Bytes that one pixel takes."""
        return 3 if self in (PixelFormat.RGB8, PixelFormat.BGR8) else 1


class FrameHeader(ctypes.Structure):
    """What travels in front of every frame: 80 bytes, as `samsod_frame::FrameHeader` documents them."""

    sequence: int
    timestamp_ns: int
    width: int
    height: int
    stride: int
    pixel_format: int
    camera: bytes
    camera_frame: int
    camera_time_ns: int

    _fields_ = (
        ("sequence", ctypes.c_uint64),
        ("timestamp_ns", ctypes.c_uint64),
        ("width", ctypes.c_uint32),
        ("height", ctypes.c_uint32),
        ("stride", ctypes.c_uint32),
        ("pixel_format", ctypes.c_uint32),
        ("camera", ctypes.c_char * 32),
        ("camera_frame", ctypes.c_uint64),
        ("camera_time_ns", ctypes.c_uint64),
    )

    @staticmethod
    def type_name() -> str:
        """The name, with its version, that participants compare."""
        return "SamsodFrameHeaderV2"


class SceneHeader(ctypes.Structure):
    """What travels in front of every scene: 24 bytes, as `samsod_frame::SceneHeader` documents them."""

    sequence: int
    timestamp_ns: int
    encoding: int
    reserved: int

    _fields_ = (
        ("sequence", ctypes.c_uint64),
        ("timestamp_ns", ctypes.c_uint64),
        ("encoding", ctypes.c_uint32),
        ("reserved", ctypes.c_uint32),
    )

    @staticmethod
    def type_name() -> str:
        """The name, with its version, that participants compare."""
        return "SamsodSceneHeaderV1"


@dataclass(frozen=True, eq=False)
class Frame:
    """A frame in shared memory. Its place is free again when neither it nor a view of its pixels is left."""

    sequence: int
    """Number of the frame, counted by its publisher."""
    timestamp_ns: int
    """When the client handed it over or its first byte came from the camera, ns since the Unix epoch."""
    camera: str
    """Name of the camera, empty where the client gave none."""
    camera_frame: int
    """The camera's own number of the frame, 0 where it has none."""
    camera_time_ns: int
    """The camera's own clock, ns, 0 where it has none."""
    pixel_format: PixelFormat
    """How `pixels` are to be read."""
    pixels: Pixels
    """(H, W, 3) for rgb8 and bgr8, else (H, W); read-only, in place. Copy what is kept: few may be held at a time."""


@dataclass(frozen=True)
class Scene:
    """What samsodd saw in one frame."""

    sequence: int
    """Number of the frame."""
    timestamp_ns: int
    """Timestamp of the frame, ns since the Unix epoch."""
    data: dict[str, Any]
    """Regions, objects, detections, times: docs/recording.md names the fields."""


class _Topic:
    """One topic of a cell as this process has opened it."""

    def __init__(
        self,
        cell: str,
        topic: str,
        header: type[ctypes.Structure],
        *,
        root_path: str | Path | None,
        buffered: int,
        borrowed: int,
        max_subscribers: int,
    ) -> None:
        if re.fullmatch(r"[A-Za-z0-9_-][A-Za-z0-9_.-]{0,63}", cell) is None:
            raise FrameError(f"cell name {cell!r} must be 1 to 64 of a-z A-Z 0-9 _ - . and not start with a dot")
        _check("buffer_frames", buffered, 1, 64)
        _check("max_subscribers", max_subscribers, 1, 16)
        iox2.set_log_level_from_env_or(iox2.LogLevel.Error)
        # Not the global configuration: that is read from a file in whatever folder the process was started in.
        config = iox2.config.default()
        if root_path is not None:
            config.global_cfg.root_path = iox2.Path.new(_checked_root(root_path))
        self.name = f"samsod/{cell}/{topic}"
        try:
            builder = iox2.NodeBuilder.new().config(config)
            # Python owns the signals of its process.
            self.node = builder.signal_handling_mode(iox2.SignalHandlingMode.Disabled).create(iox2.ServiceType.Ipc)
            service = iox2.ServiceName.new(self.name)
            events = self.node.service_builder(service).event()
            events = events.max_nodes(_MAX_NODES).max_notifiers(_MAX_PUBLISHERS).max_listeners(max_subscribers)
            self.events = events.open_or_create()
            messages = self.node.service_builder(service).publish_subscribe(iox2.Slice[ctypes.c_uint8])
            messages = messages.user_header(header).enable_safe_overflow(True).history_size(0)
            messages = messages.subscriber_max_buffer_size(buffered).subscriber_max_borrowed_samples(borrowed)
            messages = messages.max_publishers(_MAX_PUBLISHERS).max_subscribers(max_subscribers).max_nodes(_MAX_NODES)
            self.messages = messages.open_or_create()
        except Exception as error:
            raise self.error("cannot be joined", error) from error

    def error(self, what: str, error: Exception) -> ServiceError:
        """What an error of the transport means."""
        text = str(error)
        hints = {
            "IncompatibleTypes": "a participant speaks another version of the header",
            "InternalError": "another user may own it; all participants run as one user, or name another root_path",
            "Permission": "another user owns it; all participants of a cell run as one user",
            "DoesNotSupport": "it exists with smaller limits; end all participants, or ask for no more",
            "ExceedsMaxSupported": "all its places are taken; end another participant first",
            "ExceedsMaxBorrows": "too many frames are held; let go of one, or copy its pixels",
        }
        hint = next((f": {hint}" for key, hint in hints.items() if key in text), "")
        return ServiceError(f"service {self.name} {what}: {text}{hint}")


class _Port:
    """A publisher or subscriber, open until it is closed."""

    _topic: _Topic
    _ports: list[Any]

    def close(self) -> None:
        """Leaves the cell. Frames that are held stay valid."""
        for port in self._ports:
            port.delete()
        self._ports = []

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /
    ) -> None:
        self.close()

    def _open_ports(self) -> list[Any]:
        if not self._ports:
            raise ServiceError(f"service {self._topic.name} has been left; open it again")
        return self._ports


class FramePublisher(_Port):
    """Sends frames to the daemon of a cell.

    `max_frame_bytes` bounds a frame; 17 places of it are reserved, committed as they are used. The other numbers are
    those of samsodd's `[frames]`. Raises FrameError for a value that is not allowed and ServiceError when the cell
    cannot be joined.
    """

    def __init__(
        self,
        cell: str,
        *,
        camera: str = "",
        root_path: str | Path | None = None,
        max_frame_bytes: int = 2048 * 1536 * 3,
        buffer_frames: int = 2,
        max_subscribers: int = 4,
    ) -> None:
        self._ports = []
        self._camera = _camera_bytes(camera)
        self._max_frame_bytes = _check("max_frame_bytes", max_frame_bytes, 1, 1 << 30)
        self._topic = _Topic(
            cell,
            "frames",
            FrameHeader,
            root_path=root_path,
            buffered=buffer_frames,
            borrowed=_BORROWED_FRAMES,
            max_subscribers=max_subscribers,
        )
        self._sequence = 0
        try:
            builder = self._topic.messages.publisher_builder()
            port = builder.initial_max_slice_len(max_frame_bytes).max_loaned_samples(1).create()
            self._ports.append(port)
            notifier = self._topic.events.notifier_builder().default_event_id(iox2.EventId.new(_SENT_EVENT)).create()
            self._ports.append(notifier)
        except Exception as error:
            self.close()
            raise self._topic.error("has no place for a publisher", error) from error

    @property
    def sent(self) -> int:
        """Frames sent so far."""
        return self._sequence

    @property
    def subscribers(self) -> int:
        """How many subscribers there are now."""
        return int(self._topic.messages.dynamic_config.number_of_subscribers)

    def send(
        self,
        pixels: Pixels,
        *,
        pixel_format: PixelFormat | None = None,
        timestamp_ns: int | None = None,
        camera_frame: int = 0,
        camera_time_ns: int = 0,
    ) -> int:
        """Copies a frame into shared memory, sends it and wakes the subscribers.

        `pixels` is uint8 of shape (H, W, 3), RGB without `pixel_format`, or (H, W), grey without it; it need not be
        contiguous. `timestamp_ns` is ns since the Unix epoch, by default now. Returns to how many subscribers the frame
        went. Raises FrameError for a frame that no subscriber would accept, ServiceError when it cannot be sent.
        """
        port, notifier = self._open_ports()
        pixel_format = _checked_format(pixels, pixel_format)
        height, width = pixels.shape[:2]
        for side, value in (("width", width), ("height", height)):
            if not 1 <= value <= MAX_SIDE_PX:
                raise FrameError(f"frame {side} is {value} px; 1 to {MAX_SIDE_PX} px are allowed")
        if pixels.nbytes > self._max_frame_bytes:
            largest = self._max_frame_bytes
            raise FrameError(f"{pixels.nbytes} bytes do not fit into a slot of {largest} bytes; raise max_frame_bytes")
        now_ns = time.time_ns() if timestamp_ns is None else _check("timestamp_ns", timestamp_ns, 0, (1 << 64) - 1)
        header = FrameHeader(
            sequence=self._sequence,
            timestamp_ns=now_ns,
            width=width,
            height=height,
            stride=width * pixel_format.bytes_per_pixel,
            pixel_format=pixel_format,
            camera=self._camera,
            camera_frame=_check("camera_frame", camera_frame, 0, (1 << 64) - 1),
            camera_time_ns=_check("camera_time_ns", camera_time_ns, 0, (1 << 64) - 1),
        )
        try:
            slot = port.loan_slice_uninit(pixels.nbytes)
            # The one copy, with the rows packed on the way.
            place = np.frombuffer(slot.payload().as_memory_view(), np.uint8).reshape(pixels.shape)
            np.copyto(place, pixels)
            ctypes.memmove(slot.user_header_ptr, ctypes.byref(header), ctypes.sizeof(header))
            recipients = int(slot.assume_init().send())
            self._sequence += 1
            notifier.notify()
        except Exception as error:
            raise self._topic.error("did not take the frame", error) from error
        return recipients


class _Subscriber(_Port):
    """What subscribers have in common: sleeping until something was sent."""

    def _join(self, topic: _Topic) -> None:
        self._topic = topic
        self._ports = []
        try:
            # The listener first, so that nothing that is sent meanwhile goes unheard.
            listener = topic.events.listener_builder().create()
            self._ports.append(listener)
            self._ports.append(topic.messages.subscriber_builder().create())
        except Exception as error:
            self.close()
            raise topic.error("has no place for a subscriber", error) from error

    def _is_waiting(self) -> bool:
        port = self._open_ports()[1]
        try:
            return bool(port.has_samples())
        except Exception as error:
            raise self._topic.error("cannot be read", error) from error

    def _receive(self) -> Any | None:
        port = self._open_ports()[1]
        try:
            return port.receive()
        except Exception as error:
            raise self._topic.error("cannot be read", error) from error

    def _sleep(self, deadline: float) -> bool:
        """False when the deadline, of time.monotonic(), has passed."""
        left = deadline - time.monotonic()
        if left <= 0:
            return False
        try:
            # The transport sleeps in whole milliseconds and must not spin over the last fraction.
            pause_ms = max(1, math.ceil(min(left, _SLICE_S) * 1e3))
            self._open_ports()[0].timed_wait(iox2.Duration.from_millis(pause_ms))
        except iox2.ListenerWaitError as error:
            # A signal: Python looks after it before the next sleep.
            if "Interrupt" not in str(error):
                raise self._topic.error("cannot be waited for", error) from error
        return True


class FrameSubscriber(_Subscriber):
    """Receives the frames of a cell, the latest first. At most two frames can be held at a time.

    Raises FrameError for a value that is not allowed and ServiceError when the cell cannot be joined.
    """

    def __init__(
        self, cell: str, *, root_path: str | Path | None = None, buffer_frames: int = 2, max_subscribers: int = 4
    ) -> None:
        self._join(
            _Topic(
                cell,
                "frames",
                FrameHeader,
                root_path=root_path,
                buffered=buffer_frames,
                borrowed=_BORROWED_FRAMES,
                max_subscribers=max_subscribers,
            )
        )

    def wait(self, timeout_s: float) -> Frame | None:
        """Waits for a frame, at most for `timeout_s` (0 to 1e6 s); of several that wait, the latest is returned.

        None when none came in time. Raises FrameError when the frame that came has a wrong header, after which the next
        may be waited for, and ServiceError when too many frames are held.
        """
        deadline = time.monotonic() + _checked_timeout(timeout_s)
        while True:
            latest = None
            while self._is_waiting():
                # The older one goes back before the newer is taken: the caller may hold all places but one.
                latest = None
                latest = self._receive()
            if latest is not None:
                return _frame(latest)
            if not self._sleep(deadline):
                return None


class SceneSubscriber(_Subscriber):
    """Receives what samsodd saw, scene after scene; the oldest of more than eight that wait are lost.

    Raises FrameError for a value that is not allowed and ServiceError when the cell cannot be joined.
    """

    def __init__(self, cell: str, *, root_path: str | Path | None = None, max_subscribers: int = 4) -> None:
        self._join(
            _Topic(
                cell,
                "scenes",
                SceneHeader,
                root_path=root_path,
                buffered=_BUFFERED_SCENES,
                borrowed=_BORROWED_SCENES,
                max_subscribers=max_subscribers,
            )
        )

    def wait(self, timeout_s: float) -> Scene | None:
        """Waits for the next scene, at most for `timeout_s` (0 to 1e6 s); None when none came in time.

        Raises FrameError for a scene that is no JSON object.
        """
        deadline = time.monotonic() + _checked_timeout(timeout_s)
        while (sample := self._receive()) is None:
            if not self._sleep(deadline):
                return None
        header = SceneHeader.from_buffer_copy(sample.user_header().contents)
        if header.encoding != 1:
            raise FrameError(f"scene {header.sequence} has encoding {header.encoding}; allowed is 1 (JSON)")
        try:
            data = json.loads(bytes(sample.payload().as_memory_view()))
        except ValueError as error:
            raise FrameError(f"scene {header.sequence} is no JSON: {error}") from error
        if not isinstance(data, dict):
            raise FrameError(f"scene {header.sequence} is a JSON {type(data).__name__}; an object is allowed")
        return Scene(header.sequence, header.timestamp_ns, data)


def _frame(sample: Any) -> Frame:
    """The frame of a sample whose header describes what came with it."""
    # Copied before it is checked, so that it cannot change between check and use.
    header = FrameHeader.from_buffer_copy(sample.user_header().contents)
    payload = sample.payload()
    try:
        pixel_format = PixelFormat(header.pixel_format)
    except ValueError:
        allowed = ", ".join(f"{known.value} ({known.name.lower()})" for known in PixelFormat)
        raise FrameError(f"pixel format {header.pixel_format} is unknown; allowed are {allowed}") from None
    width, height, stride = header.width, header.height, header.stride
    for side, value in (("width", width), ("height", height)):
        if not 1 <= value <= MAX_SIDE_PX:
            raise FrameError(f"frame {side} is {value} px; 1 to {MAX_SIDE_PX} px are allowed")
    row = width * pixel_format.bytes_per_pixel
    if not row <= stride <= MAX_STRIDE_BYTES:
        raise FrameError(f"stride is {stride} bytes; {row} to {MAX_STRIDE_BYTES} are allowed for {width} px")
    needed = stride * (height - 1) + row
    if payload.len() < needed:
        raise FrameError(
            f"payload has {payload.len()} bytes; {width} x {height} px with a stride of {stride} need {needed}"
        )
    memory = (ctypes.c_uint8 * payload.len()).from_address(payload.as_ptr())
    # The views below keep `memory`, and with it the sample: its place is not filled anew while one of them is left.
    memory.sample = sample
    # Read-only for numpy, too: the memory is, and a write would end the process.
    rows = np.frombuffer(memoryview(memory).toreadonly(), np.uint8)
    shape = (height, width, 3) if pixel_format.bytes_per_pixel == 3 else (height, width)
    strides = (stride, 3, 1) if pixel_format.bytes_per_pixel == 3 else (stride, 1)
    pixels = np.lib.stride_tricks.as_strided(rows, shape, strides, writeable=False)
    camera = header.camera.decode("utf-8", "replace")
    return Frame(
        header.sequence,
        header.timestamp_ns,
        camera,
        header.camera_frame,
        header.camera_time_ns,
        pixel_format,
        pixels,
    )


def _check(name: str, value: int, least: int, most: int) -> int:
    if not least <= value <= most:
        raise FrameError(f"{name} is {value}; {least} to {most} are allowed")
    return value


def _checked_timeout(timeout_s: float) -> float:
    if not 0 <= timeout_s <= 1e6:
        raise FrameError(f"timeout_s is {timeout_s}; 0 to 1e6 are allowed")
    return timeout_s


def _checked_root(root_path: str | Path) -> str:
    path = str(root_path)
    if not path.startswith("/"):
        raise FrameError(f"root_path {path}: it must be absolute")
    if len(path.encode()) > _MAX_ROOT_PATH:
        raise FrameError(f"root_path {path}: it has {len(path.encode())} bytes, at most {_MAX_ROOT_PATH} are allowed")
    return path


def _camera_bytes(camera: str) -> bytes:
    name = camera.encode()
    if len(name) > 31:
        raise FrameError(f"camera {camera!r} has {len(name)} bytes; at most 31 are allowed")
    if any(ord(letter) < 32 or 127 <= ord(letter) < 160 for letter in camera):
        raise FrameError(f"camera {camera!r} must have no control characters")
    return name


def _checked_format(pixels: Pixels, pixel_format: PixelFormat | None) -> PixelFormat:
    if pixels.dtype != np.uint8:
        raise FrameError(f"pixels are {pixels.dtype}; uint8 is allowed")
    is_colour = pixels.ndim == 3 and pixels.shape[2] == 3
    if not is_colour and pixels.ndim != 2:
        raise FrameError(f"pixels have shape {pixels.shape}; (H, W, 3) and (H, W) are allowed")
    if pixel_format is None:
        return PixelFormat.RGB8 if is_colour else PixelFormat.MONO8
    if (pixel_format.bytes_per_pixel == 3) != is_colour:
        wanted = "(H, W, 3)" if pixel_format.bytes_per_pixel == 3 else "(H, W)"
        raise FrameError(f"pixels have shape {pixels.shape}; {wanted} is allowed for {pixel_format.name.lower()}")
    return pixel_format
