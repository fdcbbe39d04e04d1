"""AEDAT 4 (iniVation DV): events, and frames at mid-exposure, through the `aedat` package.

The decoder aborts the whole process if the header is not UTF-8 XML or is nested too deeply, or if a
packet claims more than the memory; it panics on damaged packets. So the header and the sizes of all
packets are checked here first, the decoder is given only the sound part, and whatever it raises
becomes EV009 with the byte where it stopped. Damage after `stop_s` does not matter.
"""

from __future__ import annotations

import array
import contextlib
import itertools
import os
import struct
import tempfile
import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from evflow.checks import COLUMNS
from evflow.errors import EvflowDataError
from evflow.files.compressed import most_bytes
from evflow.files.limits import FREE, RATIO
from evflow.io.decode import tables
from evflow.io.decode.stream import Chunk, Damage
from evflow.io.formats.aedat4_header import Header, elsewhere, read_header, stream_names
from evflow.io.hints import Hints
from evflow.io.images.aside import Aside
from evflow.io.images.streams import ImageStream, alike, another_camera, choose, nearest
from evflow.notes import Note
from evflow.types import Recording

NAME = "aedat4"
EXTENSIONS: tuple[str, ...] = (".aedat4",)
EXTERNAL = (1, 2, 3)  # trigger sources: rising edge, falling edge, pulse of an external signal


def sniff(path: Path, head: bytes) -> bool:
    return head.startswith(b"#!AER-DAT4")


def read(path: Path, hints: Hints) -> Recording:
    """Events (N,) and frames (T, H, W) uint8; colour frames become their luma.

    With several event streams the first that has packets is read, or the one requested; with
    several frame streams `streams.choose` picks one by their cameras and the names of their outputs
    in DV. Raises EV008 (no event stream), EV009 (damaged), EV010 (no `aedat`), and what
    `stream.gather` and `Recording` raise.
    """
    header = read_header(path)
    streams = _decoder(path).id_to_stream()
    packets = _packets(path, header.packets, header.table)
    events = _of_events(streams, packets)
    if not events:
        kinds = ", ".join(f"{i}: {s['type']}" for i, s in sorted(streams.items()))
        raise EvflowDataError(
            "EV008", f"{path} holds the streams {{{kinds}}}, none of which has events.",
            "Record the events too, or pass the file that contains them.", where=path)
    frames = {i: s for i, s in streams.items() if s["type"] == "frame"}
    names = stream_names(header.outputs, {*frames, *events})
    camera, more = hints.camera([names[i] for i in events])
    source = next(i for i in events if names[i] == camera)
    info = streams[source]
    size = hints.size or (info["width"], info["height"])
    chosen = choose([ImageStream(names[i], (s["width"], s["height"]), elsewhere=elsewhere(
        header.outputs, i, source)) for i, s in frames.items()], hints, size, camera)
    taken = [i for i in frames if chosen.stream and chosen.stream.name == names[i]]
    with _before(path, packets.damage) as sound:
        reading = _Reading(sound, packets.starts, packets.damage, Aside(path, hints, size), source,
                           taken)
        return reading.aside.collect(
            reading.chunks(), lambda: (*more, *chosen.notes, *reading.notes()))


def triggers(path: Path, topic: str | None = None) -> np.ndarray:
    """Times (N,) int64 us of edges and pulses of external signals, up to any damage.

    topic: of whose events, by default the first. Raises EV001 (several streams of triggers, and
    none is of that camera), EV020 (no such events).
    """
    header = read_header(path)
    packets = _packets(path, header.packets, header.table)
    streams = _triggers_of(path, header, packets, topic)
    found = [np.zeros(0, np.int64)]
    with _before(path, packets.damage) as sound:
        decoder = iter(_decoder(sound))
        while packet := _next(decoder):
            triggers = packet.get("triggers")
            if triggers is not None and packet["stream_id"] in streams:
                found.append(triggers["t"][np.isin(triggers["source"], EXTERNAL)].astype(np.int64))
    return np.concatenate(found)


def _triggers_of(path: Path, header: Header, packets: Packets, topic: str | None) -> list[int]:
    """The streams of triggers of the events' camera; the only one, whose ever it is: where cameras
    are synchronised, the signal may be connected to one of them."""
    streams = _decoder(path).id_to_stream()
    told = sorted(i for i, s in streams.items() if s["type"] == "triggers")
    events = _of_events(streams, packets)
    if len(told) < 2 or not events:
        return told
    names = stream_names(header.outputs, {*told, *events})
    camera, _ = Hints(events_topic=topic).camera([names[i] for i in events])
    source = next(i for i in events if names[i] == camera)
    near = nearest([names[i] for i in told if not elsewhere(header.outputs, i, source)
                    and not another_camera(names[i], camera)], camera)
    if not near or not alike(near):
        raise EvflowDataError(
            "EV001", f"{path} holds the triggers {', '.join(names[i] for i in told)}; which are "
            f"those of {camera} is not clear.",
            "Write their times into a text file, one per line, and pass that.", where=path)
    return [i for i in told if names[i] in near]


def _of_events(streams: dict[int, dict[str, Any]], packets: Packets) -> list[int]:
    """The streams of events in order, those with packets first."""
    events = (i for i, s in streams.items() if s["type"] == "events")
    return sorted(events, key=lambda i: (i not in packets.streams, i))


def _next(decoder: Iterator[dict[str, Any]]) -> dict[str, Any] | None:
    """The next packet; None at the end, or if the decoder fails."""
    try:
        return next(decoder, None)
    except (KeyboardInterrupt, SystemExit):
        raise
    except BaseException:  # a Rust panic derives from BaseException
        return None


class _Reading:
    """Decodes packets in order: events of the stream `source` become chunks, frames of the streams
    `taken` are collected."""

    def __init__(
        self, sound: Path, starts: Iterable[int], damage: Damage | None, aside: Aside,
        source: int, taken: list[int],
    ) -> None:
        self.damage, self.aside, self.source, self.taken = damage, aside, source, taken
        self.decoder = iter(_decoder(sound))
        self.places = itertools.chain(starts, itertools.repeat(os.path.getsize(sound)))
        self.warned: set[str] = set()

    def chunks(self) -> Iterator[Chunk]:
        """All events up to `stop_s`, until frames from before that time have also arrived."""
        done = 0
        while found := self._some():
            x, y, t, p = (np.concatenate([packet[name] for packet in found]) for name in COLUMNS)
            yield Chunk(x, y, t, p, lambda i, done=done: done + i, "event")  # type: ignore[misc]
            done += len(t)
        if self.damage:
            raise self.damage

    def _some(self) -> list[np.ndarray]:
        """The next packets of events; none at the end or where the damage begins."""
        found: list[np.ndarray] = []
        count = byte = 0
        try:
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                while count < tables.ROWS and not self.aside.done:
                    byte = next(self.places)
                    packet = next(self.decoder, None)
                    if packet is None:
                        self.decoder = iter(())
                        break
                    if len(packet.get("events", ())) and packet["stream_id"] == self.source:
                        found.append(packet["events"])
                        count += len(found[-1])
                        self.aside.follow(found[-1]["t"])
                    elif "frame" in packet and packet["stream_id"] in self.taken:
                        self._take(packet["frame"])
            self.warned |= {str(w.message) for w in caught}
        except (KeyboardInterrupt, SystemExit, EvflowDataError):
            raise
        except BaseException as e:  # a Rust panic derives from BaseException
            self.damage, self.decoder = Damage(byte, str(e)), iter(())
            self.damage.__cause__ = e
        return found

    def _take(self, frame: dict[str, Any]) -> None:
        pixels = frame["pixels"]  # colours come as R, G, B(, A)
        self.aside.append(pixels if pixels.ndim == 2 else pixels[..., 2::-1],
                          _mid_exposure(frame),
                          (frame.get("offset_x", 0), frame.get("offset_y", 0)), _exposure(frame))

    def notes(self) -> tuple[Note, ...]:
        return tuple(Note("events.unread", f"the decoder left something out: {text}")
                     for text in sorted(self.warned))


@contextlib.contextmanager
def _before(path: Path, damage: Damage | None) -> Iterator[Path]:
    """A file that ends where the damage begins; `path` itself without damage.

    The decoder must not reach data on which it aborts, and it may read several packets in one step,
    because it skips frames of unknown kinds.
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


class Packets(NamedTuple):
    """Offsets of packets, the Damage at the first that is not sound, and the streams before it."""

    starts: array.array[int]
    damage: Damage | None
    streams: set[int]


def _packets(path: Path, start: int, table: int) -> Packets:
    """The packets, each {i32 stream, i32 size, size bytes}, up to the table; and the Damage at the
    first one that claims more bytes than are left, or expands too far: the decoder would allocate
    that much."""
    total = os.path.getsize(path)
    starts, streams = array.array("q"), set[int]()
    with open(path, "rb") as f:
        while start + 8 <= total and start != table:
            f.seek(start)
            stream, size = struct.unpack("<ii", f.read(8))
            if not 0 <= size <= total - start - 8:
                return Packets(starts, Damage(start, f"a packet claims {size:,} bytes, "
                               f"{total - start - 8:,} are left"), streams)
            if (most := most_bytes(f.read(size))) > FREE + RATIO * size:
                return Packets(starts, Damage(start, f"a packet of {size:,} bytes expands to "
                               f"{most:,}"), streams)
            starts.append(start)
            streams.add(stream)
            start += 8 + size
    return Packets(starts, None, streams)


def _decoder(path: Path) -> Any:
    try:
        import aedat
    except ImportError as e:
        raise EvflowDataError(
            "EV010", f"reading {path} needs the package 'aedat'.",
            'pip install "evflow-jax[io]"', where=path) from e
    try:
        return aedat.Decoder(os.fspath(path))
    except (KeyboardInterrupt, SystemExit):
        raise
    except BaseException as e:
        raise EvflowDataError(
            "EV009", f"{path} cannot be decoded ({e}).", "Copy it again.", where=path) from e


def _exposure(frame: dict[str, Any]) -> int:
    """How long it took (us), 0 if that is not stored."""
    begin, end = frame["exposure_begin_t"], frame["exposure_end_t"]
    return end - begin if _stored(frame, begin, end) else 0


def _mid_exposure(frame: dict[str, Any]) -> int:
    """The middle of the exposure (us); without one, of the frame interval, or the packet's time."""
    for name in ("exposure_", ""):
        begin, end = frame[f"{name}begin_t"], frame[f"{name}end_t"]
        if _stored(frame, begin, end):
            return (begin + end) // 2
    return frame["t"]


def _stored(frame: dict[str, Any], begin: int, end: int) -> bool:
    """Whether these are begin and end of an interval. Up to 0 they are not, unless the frame is at
    the middle: then the clock began meanwhile."""
    return 0 < begin <= end or (begin < end and (begin + end) // 2 == frame["t"])
