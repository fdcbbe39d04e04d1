"""AEDAT 4 (iniVation DV) written by hand: three small FlatBuffers, no package needed.

The file is the version line; {u32 size, IOHE: compression i32, table position i64, XML}; packets
{i32 stream, i32 size, EVTS or FRME}; and at the end the FTAB, an entry per packet with its position
and times, which DV uses to seek and by which readers notice truncation. Every buffer is a
FlatBuffer that begins with its own size. Packets are not compressed: 16 bytes per event.
"""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from evflow.files.whole import need_size
from evflow.io.writer import EventWriter, blocks
from evflow.types import Events

VERSION = b"#!AER-DAT4.0\r\n"
EVENTS, FRAMES = 0, 1  # ids of the streams
PACKET = 1 << 14  # events in a packet: 256 KiB
EVENT = np.dtype({"names": ["t", "x", "y", "p"], "formats": ["<i8", "<i2", "<i2", "?"],
                  "offsets": [0, 8, 10, 12], "itemsize": 16})
ENTRY = np.dtype([("vtable", "<i4"), ("stream", "<i4"), ("size", "<i4"), ("", "<i4"),
                  ("byte", "<i8"), ("count", "<i8"), ("first", "<i8"), ("last", "<i8")])
ATTR = '<attr key="{}" type="{}">{}</attr>'


class Aedat4Writer(EventWriter):
    """Events and 8-bit grey frames, whose time is the middle of their exposure, if that is known,
    else its begin and end."""

    NAME = "aedat4"
    DEPTHS = ("uint8",)
    MAX_SIDE = 2**15  # x, y are int16
    TIMES_US = (0, 2**63 - 1)

    def _open(self, temporary: Path, stack: contextlib.ExitStack) -> None:
        self._file = stack.enter_context(open(temporary, "wb"))  # noqa: SIM115
        self._entries: list[tuple[int, ...]] = []
        self._file.write(VERSION + _header(self.size, 0))

    def _write(self, events: Events) -> None:
        for part in blocks(events, PACKET):
            table = np.zeros(len(part), EVENT)
            for name in "txyp":
                table[name] = getattr(part, name)
            buffer = _buffer(b"EVTS", [], len(part), table.tobytes())
            self._packet(EVENTS, buffer, len(part), part.t)

    def _write_frames(self, frames: np.ndarray, times: np.ndarray) -> None:
        self._flush()  # the file is ordered by time, as readers expect
        for frame, t in zip(frames, times, strict=True):
            self._packet(FRAMES, _frame(frame, int(t), self.exposure_us), 1, np.array([t]))

    def _packet(self, stream: int, buffer: bytes, count: int, t: np.ndarray) -> None:
        self._file.write(struct.pack("<ii", stream, len(buffer)))
        self._entries.append(
            (0, stream, len(buffer), 0, self._file.tell(), count, int(t[0]), int(t[-1])))
        self._file.write(buffer)

    def _finish(self) -> None:
        position = self._file.tell()
        self._bytes = position + self._file.write(_table(np.array(self._entries, ENTRY)))
        self._file.seek(len(VERSION))
        self._file.write(_header(self.size, position))

    def _verify(self, temporary: Path) -> None:
        need_size(temporary, self._bytes)


def _header(size: tuple[int, int], table: int) -> bytes:
    """IOHE, not compressed; table: offset of the FTAB."""
    width, height = size
    streams = "".join(
        f'<node name="{stream}" path="/outInfo/{stream}/">'
        + ATTR.format("compression", "string", "NONE")
        + ATTR.format("originalModuleName", "string", "evflow")
        + ATTR.format("originalOutputName", "string", name)
        + ATTR.format("typeIdentifier", "string", kind)
        + f'<node name="info" path="/outInfo/{stream}/info/">'
        + ATTR.format("sizeX", "int", width) + ATTR.format("sizeY", "int", height)
        + ATTR.format("source", "string", "evflow") + "</node></node>"
        for stream, name, kind in ((EVENTS, "events", "EVTS"), (FRAMES, "frames", "FRME")))
    xml = f'<dv version="2.0"><node name="outInfo" path="/outInfo/">{streams}</node></dv>'.encode()
    return _buffer(b"IOHE", [("i", 0), ("q", table)], len(xml), xml + b"\0")


def _frame(frame: np.ndarray, t: int, exposure_us: int) -> bytes:
    """FRME: its time, begin and end of the interval and of the exposure; format 0 (grey, 8 bits),
    width, height, x and y offset; pixels."""
    height, width = frame.shape
    begin = t - exposure_us // 2
    times = (t, *(begin, begin + exposure_us) * 2)
    scalars = [*(("q", time) for time in times),
               ("b", 0), ("h", width), ("h", height), ("h", 0), ("h", 0)]
    return _buffer(b"FRME", scalars, frame.size, frame.tobytes())


def _table(entries: np.ndarray) -> bytes:
    """FTAB: a vector of offsets to entries; then the entries and their one vtable."""
    n, index = len(entries), np.arange(len(entries))
    start = _padded(4 * n) + 16
    entries["vtable"] = 16 + ENTRY.itemsize * index
    offsets = (start + (ENTRY.itemsize - 4) * index).astype("<u4").tobytes()
    vtable = struct.pack("<7H", 14, ENTRY.itemsize, 16, 4, 24, 32, 40)  # byte, (stream, size), ...
    return _buffer(b"FTAB", [], n, offsets.ljust(start - 16, b"\0") + vtable.ljust(16, b"\0")
                   + entries.tobytes())


def _buffer(
    identifier: bytes, scalars: Sequence[tuple[str, int]], count: int, vector: bytes
) -> bytes:
    """A FlatBuffer of one table: scalars (struct code, value) in the order of the schema, followed
    by a vector of `count` elements, aligned to 8.

    size u32 | root u32 | identifier | vtable | table | count u32 | elements: the table and the
    count begin 4 bytes after a multiple of 8, so that what follows them is aligned.
    """
    sizes = [*(struct.calcsize(f"<{code}") for code, _ in scalars), 4]
    places, end = [0] * len(sizes), 4
    for slot in sorted(range(len(sizes)), key=lambda slot: -sizes[slot]):
        places[slot], end = end, end + sizes[slot]
    vtable = struct.pack(f"<{2 + len(sizes)}H", 4 + 2 * len(sizes), end, *places)
    vtable = vtable.ljust(_padded(len(vtable)), b"\0")
    table = bytearray(_padded(end))
    struct.pack_into("<i", table, 0, len(vtable))
    for (code, value), place in zip(scalars, places[:-1], strict=True):
        struct.pack_into(f"<{code}", table, place, value)
    struct.pack_into("<I", table, places[-1], len(table) - places[-1])
    body = b"".join((vtable, table, struct.pack("<I", count), vector))
    return struct.pack("<II4s", 8 + len(body), 8 + len(vtable), identifier) + body


def _padded(size: int) -> int:
    return -(-size // 8) * 8
