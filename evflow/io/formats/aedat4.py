"""AEDAT 4 (iniVation DV): events, and frames at mid-exposure, through the `aedat` package.

The decoder aborts the whole process on a header that is not UTF-8 XML, or nested too deeply, and
on a packet that claims more than there is memory; it panics on damaged ones. So the header and the
sizes of all packets are checked here first, the decoder sees no further than they are sound, and
whatever it raises becomes EV009 with the byte where it stopped. Damage behind `stop_s` does not
matter.
"""

from __future__ import annotations

import array
import collections
import contextlib
import itertools
import os
import struct
import sys
import tempfile
import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any
from xml.parsers import expat

import numpy as np

from evflow.checks import COLUMNS
from evflow.errors import EvflowDataError
from evflow.files.compressed import most_bytes
from evflow.files.limits import FREE, RATIO
from evflow.io.decode import tables
from evflow.io.decode.stream import Chunk, Damage, Gathered, gather
from evflow.io.hints import Hints
from evflow.io.images.frames import FrameStack, cut
from evflow.io.images.times import beside_events
from evflow.notes import Note
from evflow.types import Recording

NAME = "aedat4"
EXTENSIONS: tuple[str, ...] = (".aedat4",)

MAGIC = b"#!AER-DAT4.0\r\n"
TABLE_POSITION, INFO_NODE = 1, 2  # fields of the header's flatbuffer table: i64, XML
MAX_DEPTH = 64  # of the XML; DV writes 5
LATE_US = 1_000_000  # frames lie behind the events of their time by less than this


def sniff(path: Path, head: bytes) -> bool:
    return head.startswith(b"#!AER-DAT4")


def read(path: Path, hints: Hints) -> Recording:
    """Events (N,) and frames (T, H, W) uint8; colour frames become their luma.

    Raises EV008 (no event stream, or several), EV009 (damaged), EV010 (no `aedat`), and what
    `stream.gather` and `Recording` raise.
    """
    packets_start, table = _check_header(path)
    streams = _decoder(path).id_to_stream()
    found = {kind: [i for i, s in streams.items() if s["type"] == kind]
             for kind in ("events", "frame")}
    if len(found["events"]) != 1 or len(found["frame"]) > 1:
        kinds = ", ".join(f"{i}: {s['type']}" for i, s in sorted(streams.items()))
        raise EvflowDataError(
            "EV008", f"{path} holds the streams {{{kinds}}}.",
            "One event stream and at most one frame stream are read: export one camera alone.")
    info = streams[found["events"][0]]
    starts, damage = _packets(path, packets_start, table)
    with _before(path, damage) as sound:
        reading = _Reading(path, sound, starts, damage, hints)
        chunks = reading.chunks()
        gathered = gather(path, chunks, hints, (info["width"], info["height"]))
        if reading.last >= gathered.span[1]:  # frames that are late
            with contextlib.suppress(Damage):
                collections.deque(chunks, 0)
    return reading.beside(gathered)


class _Reading:
    """Packets decoded in turn: events become chunks, frames are put aside. last: time of the last
    event so far in us."""

    def __init__(
        self, path: Path, sound: Path, starts: Iterable[int], damage: Damage | None, hints: Hints
    ) -> None:
        self.path, self.hints, self.damage = path, hints, damage
        self.decoder = iter(_decoder(sound))
        self.places = itertools.chain(starts, itertools.repeat(os.path.getsize(sound)))
        self.stack, self.times = FrameStack(path), array.array("q")
        self.last, self.stop = 0, sys.maxsize
        self.begun = False
        self.warned: set[str] = set()

    def chunks(self) -> Iterator[Chunk]:
        """All events up to `stop_s`, and up to the time when frames from before it have come."""
        done = 0
        while found := self._some():
            x, y, t, p = (np.concatenate([packet[name] for packet in found]) for name in COLUMNS)
            yield Chunk(x, y, t, p, lambda i, done=done: done + i, "event")  # type: ignore[misc]
            done += len(t)
        if self.damage:
            raise self.damage

    def _some(self) -> list[np.ndarray]:
        """The next packets of events; none at the end, and where the damage is next."""
        found: list[np.ndarray] = []
        count = byte = 0
        try:
            with warnings.catch_warnings(record=True) as said:
                warnings.simplefilter("always")
                while count < tables.ROWS and self.last < self.stop + LATE_US:
                    byte = next(self.places)
                    packet = next(self.decoder, None)
                    if packet is None:
                        self.decoder = iter(())
                        break
                    if len(packet.get("events", ())):
                        found.append(packet["events"])
                        count += len(found[-1])
                        self._at(found[-1]["t"])
                    elif "frame" in packet:
                        self.times.append(_mid_exposure(packet["frame"]))
                        pixels = packet["frame"]["pixels"]  # colours come as R, G, B(, A)
                        self.stack.append(pixels if pixels.ndim == 2 else pixels[..., 2::-1])
            self.warned |= {str(w.message) for w in said}
        except (KeyboardInterrupt, SystemExit, EvflowDataError):
            raise
        except BaseException as e:  # a Rust panic derives from BaseException
            self.damage, self.decoder = Damage(byte, str(e)), iter(())
            self.damage.__cause__ = e
        return found

    def _at(self, t: np.ndarray) -> None:
        """Follow the time of events t as far as `stop_s` needs it."""
        if self.hints.stop_s is not None:
            self.last = self.hints.instant(t[-1], "us")
            if not self.begun:
                self.begun, self.stop = True, self.hints.span_us(self.hints.instant(t[0], "us"))[1]

    def beside(self, found: Gathered) -> Recording:
        """The recording of these events and the frames in their span."""
        notes = (*found.notes, *(Note("events.unread", f"the decoder left something out: {said}")
                                 for said in sorted(self.warned)))
        if not self.times:
            return Recording.of_events(found.events, notes)
        times, told = beside_events(
            np.array(self.times), self.path, "us", self.hints, found.events)
        notes = (Note("frames.clock", "frame times are mid-exposure"), *notes, *told)
        return cut(self.stack.beside(found.events, times, notes), found.span)


@contextlib.contextmanager
def _before(path: Path, damage: Damage | None) -> Iterator[Path]:
    """A file that ends where the damage begins; `path` itself without damage.

    The decoder must not meet what it aborts on, and it may read several packets in one step: it
    skips frames of a kind that it does not know.
    """
    if damage is None:
        yield path
        return
    with tempfile.NamedTemporaryFile(prefix="evflow-", suffix=".aedat4") as copy:
        with open(path, "rb") as f:
            left = damage.byte
            while left and (part := f.read(min(left, 1 << 20))):
                copy.write(part)
                left -= len(part)
        copy.flush()
        yield Path(copy.name)


def _packets(path: Path, start: int, table: int) -> tuple[array.array[int], Damage | None]:
    """Where packets begin, each {i32 stream, i32 size, size bytes}, up to the table; and the one
    that claims more than is left, or expands beyond measure: the decoder would take that much
    memory."""
    total = os.path.getsize(path)
    starts = array.array("q")
    with open(path, "rb") as f:
        while start + 8 <= total and start != table:
            f.seek(start + 4)
            size = int.from_bytes(f.read(4), "little", signed=True)
            if not 0 <= size <= total - start - 8:
                return starts, Damage(start, f"a packet of {size:,} bytes where "
                                      f"{total - start - 8:,} are left")
            if (most := most_bytes(f.read(size))) > FREE + RATIO * size:
                return starts, Damage(start, f"a packet of {size:,} bytes that expand to {most:,}")
            starts.append(start)
            start += 8 + size
    return starts, None


def _check_header(path: Path) -> tuple[int, int]:
    """Where the packets start, and where their table is (-1: nowhere); EV009 unless the header is
    a sound one."""
    with open(path, "rb") as f:
        magic, size = f.read(len(MAGIC)), int.from_bytes(f.read(4), "little")
        header = f.read(min(size, os.path.getsize(path)))
    try:
        if magic != MAGIC or len(header) < size:
            raise ValueError("cut off" if MAGIC.startswith(magic[:13]) else "wrong version line")
        _check_xml(_info_node(header))
        place = _field(header, TABLE_POSITION)
        table = struct.unpack_from("<q", header, place)[0] if place else -1
    except (ValueError, struct.error, expat.ExpatError) as e:
        raise EvflowDataError(
            "EV009", f"{path} has a damaged AEDAT4 header ({e}).", "Copy it again.") from e
    return len(MAGIC) + 4 + size, table


def _field(header: bytes, number: int) -> int:
    """The byte of a field of the header's flatbuffer, root table -> vtable -> field; 0: absent."""
    (table,) = struct.unpack_from("<I", header, 0)
    vtable = table - struct.unpack_from("<i", header, table)[0]
    if vtable < 0:
        raise ValueError("its table lies before it")
    if struct.unpack_from("<H", header, vtable)[0] < 6 + 2 * number:
        return 0
    (field,) = struct.unpack_from("<H", header, vtable + 4 + 2 * number)
    return table + field if field else 0


def _info_node(header: bytes) -> bytes:
    """The XML string of the header's flatbuffer."""
    pointer = _field(header, INFO_NODE)
    if not pointer:
        raise ValueError("it has no description")
    string = pointer + struct.unpack_from("<I", header, pointer)[0]
    (length,) = struct.unpack_from("<I", header, string)
    if not 0 < length <= len(header) - string - 4:
        raise ValueError("its description is cut off")
    return header[string + 4 : string + 4 + length]


def _check_xml(text: bytes) -> None:
    """ValueError and ExpatError unless it is UTF-8 XML, of tags in tags to a bounded depth."""
    depth = 0

    def step(by: int) -> None:
        nonlocal depth
        depth += by
        if depth > MAX_DEPTH:
            raise ValueError(f"its description is nested more than {MAX_DEPTH} deep")

    def refuse(*_: object) -> None:
        raise ValueError("its description defines entities")

    parser = expat.ParserCreate()
    parser.StartElementHandler = lambda *_: step(1)
    parser.EndElementHandler = lambda _: step(-1)
    parser.StartDoctypeDeclHandler = refuse
    parser.Parse(text.decode("utf-8"), True)


def _decoder(path: Path) -> Any:
    try:
        import aedat
    except ImportError as e:
        raise EvflowDataError(
            "EV010", f"reading {path} needs the package 'aedat'.",
            'pip install "evflow-jax[io]"') from e
    try:
        return aedat.Decoder(os.fspath(path))
    except (KeyboardInterrupt, SystemExit):
        raise
    except BaseException as e:
        raise EvflowDataError(
            "EV009", f"{path} cannot be decoded ({e}).", "Copy it again.") from e


def _mid_exposure(frame: dict[str, Any]) -> int:
    """The middle of the exposure, else of the frame interval, else the packet's time (us)."""
    for begin, end in (("exposure_begin_t", "exposure_end_t"), ("begin_t", "end_t")):
        if 0 < frame[begin] <= frame[end]:
            return (frame[begin] + frame[end]) // 2
    return frame["t"]
