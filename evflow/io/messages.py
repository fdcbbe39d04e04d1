"""ROS 1 messages of event cameras as bytes: little-endian fields one after another, strings and
arrays behind their u32 length (wiki.ros.org/msg). A field beyond its message is `Damage`.
"""

from __future__ import annotations

import dataclasses
import struct
from typing import Any

import numpy as np

from evflow.checks import Size
from evflow.io.stream import Damage

ARRAYS = ("dvs_msgs/msg/EventArray", "prophesee_event_msgs/msg/EventArray")
EVENT_TYPES = (*ARRAYS, "event_camera_msgs/msg/EventPacket")
IMAGE = "sensor_msgs/msg/Image"

PIXELS: dict[str, tuple[str, int]] = {  # encoding: dtype, channels
    "mono8": ("u1", 1), "8UC1": ("u1", 1), "mono16": ("u2", 1), "16UC1": ("u2", 1),
    "bgr8": ("u1", 3), "rgb8": ("u1", 3)}


@dataclasses.dataclass(frozen=True)
class Packet:
    """Events of one message: `data` bytes of `encoding` ("" for an EventArray)."""

    index: int
    encoding: str
    size: Size | None
    base: int
    data: bytes

    def whole(self, itemsize: int) -> np.ndarray:
        """The data as uint8, or Damage where it is no multiple of itemsize."""
        if len(self.data) % itemsize:
            raise Damage(self.index, f"{len(self.data)} bytes of events are no multiple of "
                         f"{itemsize}", "message")
        return np.frombuffer(self.data, np.uint8)

    def base_ns(self) -> np.int64:
        if self.base >= 2**62:
            raise Damage(self.index, f"time_base is {self.base}", "message")
        return np.int64(self.base)


class Message:
    """The bytes of message number `index` of its topic, and how far they are read."""

    def __init__(self, raw: bytes, index: int) -> None:
        self.raw, self.index, self.at = raw, index, 0

    def fields(self, layout: str) -> tuple[Any, ...]:
        size = struct.calcsize("<" + layout)
        values = struct.unpack("<" + layout, self._take(size))
        return values

    def block(self, itemsize: int = 1) -> bytes:
        """The bytes of a string or array."""
        (count,) = self.fields("I")
        return self._take(count * itemsize)

    def _take(self, size: int) -> bytes:
        if self.at + size > len(self.raw):
            raise Damage(self.index, f"it claims {self.at + size:,} bytes and has "
                         f"{len(self.raw):,}", "message")
        self.at += size
        return self.raw[self.at - size : self.at]

    def stamp_ns(self) -> int:
        """The header's time in ns; read once, before anything else."""
        _, seconds, nanoseconds = self.fields("3I")
        self.block()  # frame_id
        return int(seconds) * 10**9 + int(nanoseconds)

    def events(self, kind: str) -> Packet:
        """An event message from its beginning."""
        self.stamp_ns()
        height, width = self.fields("2I")
        size = (width, height) if 0 < width <= 65536 and 0 < height <= 65536 else None
        if kind in ARRAYS:
            return Packet(self.index, "", size, 0, self.block(13))
        _, base = self.fields("2Q")
        encoding = self.block().decode("latin-1")
        if self.fields("B")[0]:
            raise Damage(self.index, "its events are big-endian", "message")
        return Packet(self.index, encoding, size, base, self.block())

    def image(self) -> np.ndarray:
        """The pixels, (H, W) or (H, W, 3) RGB, of an image whose header was read."""
        height, width = self.fields("2I")
        encoding = self.block().decode("latin-1")
        big_endian, step = self.fields("BI")
        data = np.frombuffer(self.block(), np.uint8)
        if encoding not in PIXELS:
            raise Damage(self.index, f"images are encoded as {encoding[:20]!r}; known are "
                         f"{', '.join(PIXELS)}", "message")
        kind, channels = PIXELS[encoding]
        row = width * channels * np.dtype(kind).itemsize
        if not (0 < row <= step and step * height == len(data)):
            raise Damage(self.index, f"an image of {width}x{height} {encoding} in rows of {step} "
                         f"bytes has {len(data):,} bytes", "message")
        rows = np.ascontiguousarray(data.reshape(height, step)[:, :row])
        pixels = rows.view((">" if big_endian else "<") + kind).astype(kind)
        if channels == 1:
            return pixels
        colour = pixels.reshape(height, width, channels)
        return colour if encoding == "rgb8" else colour[..., ::-1]
