"""Messages of event cameras as bytes, for ROS 1 and ROS 2.

ROS 1: little-endian fields in sequence, strings and arrays after their u32 length
(wiki.ros.org/msg). ROS 2: the same fields as XCDR1 (OMG DDS-XTypes): after a four-byte header, each
number at a multiple of its size, strings with a final NUL. A field beyond the end of its message is
`Damage`.
"""

from __future__ import annotations

import dataclasses
import struct
from typing import Any

import numpy as np

from evflow.checks import Size
from evflow.io.decode.stream import Damage
from evflow.io.images import encodings
from evflow.io.images.folder import decoded

ARRAYS = ("dvs_msgs/msg/EventArray", "prophesee_event_msgs/msg/EventArray")
EVENT_TYPES = (*ARRAYS, "event_camera_msgs/msg/EventPacket")
IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
IMAGES = (IMAGE, COMPRESSED)

CDR_LITTLE = bytes((0, 1, 0, 0))
EVENT = np.dtype([("x", "<u2"), ("y", "<u2"), ("s", "<u4"), ("ns", "<u4"), ("p", "u1")])
ALIGNED = np.dtype({
    "names": ["x", "y", "s", "ns", "p"], "formats": ["<u2", "<u2", "<u4", "<u4", "u1"],
    "offsets": [0, 2, 6, 10, 14], "itemsize": 16})


@dataclasses.dataclass(frozen=True)
class Packet:
    """Events of one message: `data` bytes of `encoding` ("" for an EventArray)."""

    index: int
    encoding: str
    size: Size | None
    base: int
    data: bytes

    def whole(self, itemsize: int) -> np.ndarray:
        """The data as uint8; Damage if it is not a multiple of itemsize."""
        if len(self.data) % itemsize:
            raise Damage(self.index, f"{len(self.data)} bytes of events are no multiple of "
                         f"{itemsize}", "message")
        return np.frombuffer(self.data, np.uint8)

    def base_ns(self) -> np.int64:
        if self.base >= 2**62:
            raise Damage(self.index, f"time_base is {self.base}", "message")
        return np.int64(self.base)


class Message:
    """The bytes of message number `index` of its topic, with a read position. aligned: a ROS 2
    message; recorded_ns: when it was recorded."""

    def __init__(
        self, raw: bytes, index: int, aligned: bool = False, recorded_ns: int = 0
    ) -> None:
        self.raw, self.index, self.aligned, self.at = raw, index, aligned, 0
        self.recorded_ns = recorded_ns
        if aligned and self._take(len(CDR_LITTLE))[:2] != CDR_LITTLE[:2]:
            raise Damage(index, f"it begins with {raw[:2].hex()}, which is no little-endian XCDR1",
                         "message")

    def fields(self, layout: str) -> tuple[Any, ...]:
        """Numbers; one `struct` letter each."""
        return tuple(self._number(code) for code in layout)

    def _number(self, code: str) -> Any:
        size = struct.calcsize("<" + code)
        if self.aligned:
            self.at += -(self.at - len(CDR_LITTLE)) % size
        return struct.unpack("<" + code, self._take(size))[0]

    def block(self, itemsize: int = 1) -> bytes:
        """The bytes of an array."""
        (count,) = self.fields("I")
        return self._take(count * itemsize)

    def text(self) -> str:
        """A string."""
        data = self.block()
        return (data.removesuffix(b"\0") if self.aligned else data).decode("latin-1")

    def _take(self, size: int) -> bytes:
        if self.at + size > len(self.raw):
            raise Damage(self.index, f"it claims {self.at + size:,} bytes and has "
                         f"{len(self.raw):,}", "message")
        self.at += size
        return self.raw[self.at - size : self.at]

    def stamp_ns(self) -> int:
        """The header's time in ns; call it once, before reading anything else."""
        if not self.aligned:
            self.fields("I")  # seq
        seconds, nanoseconds = self.fields("II")
        self.text()  # frame_id
        return int(seconds) * 10**9 + int(nanoseconds)

    def events(self, kind: str) -> Packet:
        """An event message, read from its beginning."""
        self.stamp_ns()
        height, width = self.fields("II")
        size = (width, height) if 0 < width <= 65536 and 0 < height <= 65536 else None
        if kind in ARRAYS:
            data = self._aligned_events() if self.aligned else self.block(EVENT.itemsize)
            return Packet(self.index, "", size, 0, data)
        _, base = self.fields("QQ")
        encoding = self.text()
        if self.fields("B")[0]:
            raise Damage(self.index, "its events are big-endian", "message")
        return Packet(self.index, encoding, size, base, self.block())

    def _aligned_events(self) -> bytes:
        """The events of an EventArray, packed as in ROS 1.

        One byte after each polarity is padding, and so are two before all seconds but those of the
        first event; with two added there, every event takes 16 bytes."""
        (count,) = self.fields("I")
        if not count:
            return b""
        data = self._take(16 * count - 3)
        rows = np.frombuffer(data[:4] + bytes(2) + data[4:] + bytes(1), ALIGNED)
        packed = np.empty(count, EVENT)
        for name in EVENT.names or ():
            packed[name] = rows[name]
        return packed.tobytes()

    def picture(self) -> tuple[Size, str]:
        """(width, height) and encoding of an Image whose header was read."""
        height, width = self.fields("II")
        return (width, height), self.text()

    def compressed(self) -> tuple[str, bytes]:
        """For a CompressedImage whose header was read: the encoding of the image before compression
        (image_transport: "bayer_rggb8; png compressed "), and its file."""
        return self.text().partition(";")[0].strip().lower(), self.block()

    def image(self, kind: str, seen: str = "luma") -> np.ndarray:
        """The pixels of an image whose header was read, as returned by `encodings.decode`."""
        if kind == COMPRESSED:
            encoding, data = self.compressed()
            return encodings.unpacked(encoding, decoded(data, f"message {self.index:,}"), seen)
        size, encoding = self.picture()
        big_endian, step = self.fields("BI")
        data = self.block()
        if why := encodings.unreadable(encoding):
            raise Damage(self.index, f"it is {why}, unlike others of its topic", "message")
        try:
            return encodings.decode(
                encoding, data, size, step, big_endian=bool(big_endian), seen=seen)
        except ValueError as e:
            raise Damage(self.index, str(e), "message") from e
