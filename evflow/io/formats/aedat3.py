"""AEDAT 3.1 and 3.0 (cAER, the IBM gestures; inivation.com, AEDAT file formats): `#` lines up to
`#!END-HEADER`, then packets of events of one type, little-endian.

A packet: i16 type, i16 source, i32 size of an event, offset and overflow of its time (t = overflow
<< 31 | time), capacity, number and valid. Type 1: u32 x [31:17], y [16:2], ON [1], valid [0]; i32
us. Type 2, a frame: u32 valid [0], channels [3:1], colour filter [7:4]; i32 begin and end of the
frame and of its exposure; width, height and position x, y; u16 pixels on 0..65535. Other types are
counted but not read. Of several sources (cameras) with events one is read, and its own frames. The
size is that of the chip named in its `#Source`, else in another. Version 3.0 has the origin at
the bottom and no end-of-header line.
"""

from __future__ import annotations

import collections
import contextlib
import os
import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np

from evflow.checks import Size
from evflow.errors import EvflowDataError
from evflow.io.decode import tables
from evflow.io.decode.chips import CHIPS, chip_size
from evflow.io.decode.stream import Chunk, Damage
from evflow.io.hints import Hints
from evflow.io.images.aside import Aside
from evflow.io.images.streams import ImageStream, choose
from evflow.notes import Note
from evflow.types import Recording

NAME = "aedat3"
EXTENSIONS: tuple[str, ...] = (".aedat", ".aedat3")

MAGIC, FIRST = b"#!AER-DAT3.", b"#!AER-DAT3.0"
MAX_HEADER = 1 << 20  # bytes
LINE = re.compile(rb"#[\x20-\x7e\t\x80-\xff]*\r?\n")
SOURCE = re.compile(rb"#-?Source (\d{1,5}): *([^\r\n]*)")
HEADER = struct.Struct("<hhiiiiii")
FRAME = struct.Struct("<Iiiiiiiii")
EVENT = np.dtype([("data", "<u4"), ("t", "<i4")])
POLARITY, IMAGE = 1, 2
TYPES = {0: "special events", IMAGE: "frames", 3: "IMU samples", 4: "IMU samples"}
COMPRESSED = 0x8000  # flag in the type, for formats other than RAW
MOST_TYPES, MOST_BYTES = 64, 1 << 26  # of types; of one event


class Part(NamedTuple):
    """Events of a packet, their timestamp overflow, and the byte where they begin."""

    events: np.ndarray
    overflow: int
    begin: int


class Packet(NamedTuple):
    """A header, without its offset; begin: the first byte after it."""

    kind: int
    source: int
    size: int
    overflow: int
    capacity: int
    number: int
    begin: int


def sniff(path: Path, head: bytes) -> bool:
    return head.startswith(MAGIC)


def read(path: Path, hints: Hints) -> Recording:
    """Raises EV008 (compressed packets), EV009 (damaged), EV015 (unknown chip) and what
    `Aside.collect` raises."""
    with open(path, "rb") as f:
        head = f.read(MAX_HEADER)
    start, chips = _header(head)
    cameras, filmed = _sources(path, start)
    names = {f"source{number}/events": number for number in cameras}
    camera, notes = hints.camera([*names] or ["events"])
    source = names.get(camera)
    sizes: dict[int | None, Size | None] = {number: chip_size(chip) for number, chip in chips}
    size = hints.size or sizes.get(source) or next(filter(None, sizes.values()), None)
    if size is None:
        raise EvflowDataError(
            "EV015", f"the header of {path} names the sources "
            f"{[chip for _, chip in chips] or 'none'}, of unknown size.",
            f"Pass size=(width, height), --size WxH; known chips: {', '.join(CHIPS)}.", where=path)
    streams = {f"source{number}/frames": number for number in filmed}
    chosen = choose([ImageStream(name, size if number == source else sizes.get(number))
                     for name, number in streams.items()], hints, size, camera)
    reading = _Reading(Aside(path, hints, size), size, head.startswith(FIRST), source,
                       streams[chosen.stream.name] if chosen.stream else None)
    with open(path, "rb") as f:
        f.seek(start)
        return reading.aside.collect(
            reading.chunks(path, f), lambda: (*notes, *chosen.notes, *reading.notes()))


def _header(head: bytes) -> tuple[int, list[tuple[int, str]]]:
    """Where the packets begin, and the number and name of each source in the header."""
    start, chips = 0, []
    while line := LINE.match(head, start):
        start = line.end()
        if source := SOURCE.match(line[0]):
            chips.append((int(source[1]), source[2].decode("latin-1").strip()))
        if line[0].startswith(b"#!END-HEADER"):
            break
    return start, chips


def _sources(path: Path, start: int) -> tuple[list[int], list[int]]:
    """The numbers of the sources with events, and of those with frames, each in order of their
    first packets, up to any damage."""
    found: dict[int, dict[int, None]] = {POLARITY: {}, IMAGE: {}}
    with open(path, "rb") as f, contextlib.suppress(Damage, EvflowDataError):
        f.seek(start)
        while packet := _next(path, f):
            if packet.kind in found and packet.number:
                found[packet.kind][packet.source] = None
            _pass(path, f, packet)
    return [*found[POLARITY]], [*found[IMAGE]]


class _Reading:
    """Decodes packets in order: events of one source become chunks, frames of another, or the same,
    are collected. turned: y counts from the bottom; frames: None if they are not wanted."""

    def __init__(
        self, aside: Aside, size: Size, turned: bool, source: int | None, frames: int | None
    ) -> None:
        self.aside, self.size, self.turned = aside, size, turned
        self.source, self.frames = source, frames
        self.left: collections.Counter[str] = collections.Counter()
        self.mosaic = False

    def chunks(self, path: Path, f: IO[bytes]) -> Iterator[Chunk]:
        found: list[Part] = []
        damage: Damage | None = None
        more, count = True, 0
        while more and not self.aside.done:
            before = len(found)
            try:
                more = self._packet(path, f, found)
            except Damage as e:
                damage, more = e, False
            count += sum(len(part.events) for part in found[before:])
            if count >= tables.ROWS:
                yield self._decode(found)
                found, count = [], 0
        if found:
            yield self._decode(found)
        if damage:
            raise damage

    def _packet(self, path: Path, f: IO[bytes], found: list[Part]) -> bool:
        """Read the next packet and append its events to `found`; False at the end of the file."""
        packet = _next(path, f)
        if packet is None:
            return False
        if packet.kind == POLARITY and packet.size != EVENT.itemsize:
            raise Damage(packet.begin - HEADER.size, f"events of {packet.size} bytes; expected 8")
        if packet.kind == POLARITY and packet.number and packet.source == self.source:
            body = f.read(min(packet.number * packet.size, os.path.getsize(path)))
            events = np.frombuffer(body, EVENT, len(body) // EVENT.itemsize)
            if len(events):
                found.append(Part(events, packet.overflow, packet.begin))
                self.aside.follow(_times(events["t"][-1:], packet.overflow))
        elif packet.kind == IMAGE and packet.source == self.frames:
            self._take(f, packet)
        elif packet.number:
            self.left[TYPES.get(packet.kind, "other events")] += packet.number
        _pass(path, f, packet)
        return True

    def _decode(self, found: list[Part]) -> Chunk:
        rows = np.concatenate([part.events for part in found])
        lengths = [len(part.events) for part in found]
        ends = np.cumsum(lengths)
        data = rows["data"]
        valid = np.flatnonzero(data & 1)
        if len(valid) < len(data):
            self.left["events marked as invalid"] += len(data) - len(valid)
        overflow = np.repeat(np.array([part.overflow for part in found], np.int64), lengths)
        t = _times(rows["t"], overflow)[valid]
        data = data[valid]
        y = (data >> 2 & 0x7FFF).astype(np.int32)

        def where(i: int) -> int:
            row = int(valid[i])
            part = int(np.searchsorted(ends, row, "right"))
            first = int(ends[part]) - lengths[part]
            return found[part].begin + EVENT.itemsize * (row - first)

        return Chunk((data >> 17).astype(np.uint16), self.size[1] - 1 - y if self.turned else y, t,
                     data & 2 != 0, where)

    def _take(self, f: IO[bytes], packet: Packet) -> None:
        """The frames of a packet."""
        if packet.size < FRAME.size:
            raise Damage(packet.begin - HEADER.size, f"frames of {packet.size} bytes")
        for k in range(packet.number):
            body = f.read(min(packet.size, os.path.getsize(self.aside.path)))
            if len(body) < packet.size:
                return
            info, *stamps, width, height, x, y = FRAME.unpack_from(body)
            channels = info >> 1 & 7
            if not info & 1:
                self.left["frames marked as invalid"] += 1
                continue
            if min(width, height, channels) < 1 or (
                    FRAME.size + 2 * width * height * channels > packet.size):
                raise Damage(packet.begin + k * packet.size, f"a frame of {width}x{height} with "
                             f"{channels} channels in {packet.size:,} bytes")
            pixels = np.frombuffer(body, "<u2", width * height * channels, FRAME.size)
            image = pixels.reshape(height, width, channels)
            self.mosaic |= channels == 1 and bool(info >> 4 & (7 if self.turned else 15))
            image = image[..., 0] if channels < 3 else image[..., 2::-1]  # R, G, B(, A)
            image = image[::-1] if self.turned else image
            known = 0 < stamps[2] <= stamps[3]
            begin, end = stamps[2:] if known else stamps[:2]
            self.aside.append(image.astype(np.float32) * np.float32(255 / 65535),
                              (packet.overflow << 31) + (begin + end) // 2, (x, y),
                              end - begin if known else 0)

    def notes(self) -> tuple[Note, ...]:
        notes = [Note("events.unread", f"{n:,} {name} were not read")
                for name, n in self.left.items() if n]
        if self.mosaic and self.aside.hints.colour == "luma":
            notes.append(Note("frames.raw", "frames are the raw mosaic of a colour sensor, as its "
                             "events are: --bayer RGGB would convert them to luma"))
        return tuple(notes)


def _times(t: np.ndarray, overflow: np.ndarray | int) -> np.ndarray:
    us: np.ndarray = t.astype(np.int64) + (np.int64(1 << 31) * overflow)
    return us


def _next(path: Path, f: IO[bytes]) -> Packet | None:
    """The header of the next packet, None at the end of the file; EV008, Damage."""
    at = f.tell()
    data = f.read(HEADER.size)
    if not data:
        return None
    if len(data) < HEADER.size:
        raise Damage(at, f"the file ends {len(data)} bytes into a packet header")
    packet = _parsed(data, at)
    if not _sound(packet._replace(kind=packet.kind & ~COMPRESSED)):
        raise Damage(at, f"not a packet header (type {packet.kind}, {packet.number:,} events of "
                     f"{packet.size:,} bytes)")
    if packet.kind & COMPRESSED:
        raise EvflowDataError(
            "EV008", f"{path} is AEDAT 3 of a compressed format (the packet at byte {at:,}).",
            "Convert it to AEDAT 4 with DV.", where=path)
    return packet


def _parsed(data: bytes, at: int) -> Packet:
    kind, source, size, _, overflow, capacity, number, _ = HEADER.unpack(data)
    return Packet(kind & 0xFFFF, source, size, overflow, capacity, number, at + HEADER.size)


def _sound(packet: Packet) -> bool:
    return packet.kind < MOST_TYPES and 0 < packet.size <= MOST_BYTES and (
        0 <= packet.number <= packet.capacity) and packet.overflow >= 0


def _pass(path: Path, f: IO[bytes], packet: Packet) -> None:
    """Skip to the end of a packet; Damage if the file ends before it. Some writers pad packets to
    their capacity."""
    total = os.path.getsize(path)
    end, full = (packet.begin + n * packet.size for n in (packet.number, packet.capacity))
    if end > total:
        raise Damage(total, f"the file ends within a packet of {packet.number:,} events")
    if end < full <= total and not _begins(f, end, total) and _begins(f, full, total):
        end = full
    f.seek(end)


def _begins(f: IO[bytes], at: int, total: int) -> bool:
    """Whether a packet begins there, or the file ends."""
    f.seek(at)
    data = f.read(HEADER.size)
    return at == total or (len(data) == HEADER.size and _sound(_parsed(data, at)))
