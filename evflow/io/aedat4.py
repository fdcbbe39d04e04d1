"""AEDAT 4 (iniVation DV): events, and frames at mid-exposure, through the `aedat` package.

The decoder aborts the whole process on a header that is not UTF-8 XML and panics on damaged
packets; so the header is checked here first, and whatever the decoder raises becomes EV009 with
the byte where it stopped. Damage behind `stop_s` does not matter.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from evflow.errors import EvflowDataError
from evflow.io.frames import stack_frames
from evflow.io.hints import Hints
from evflow.types import Events, Recording

NAME = "aedat4"
EXTENSIONS: tuple[str, ...] = (".aedat4",)

MAGIC = b"#!AER-DAT4.0\r\n"
INFO_NODE = 2  # the XML is the third field of the header's flatbuffer table
LATE_US = 1_000_000  # frames lie behind the events of their time by less than this


def sniff(path: Path, head: bytes) -> bool:
    return head.startswith(b"#!AER-DAT4")


def read(path: Path, hints: Hints) -> Recording:
    """Events (N,) and frames (T, H, W) uint8; colour frames become Rec. 709 luma (float32).

    Raises EV008 (no event stream, or several), EV009 (damaged), EV010 (no `aedat`), and what
    `Events` and `Recording` raise.
    """
    packets_start = _check_header(path)
    streams = _decoder(path).id_to_stream()
    found = {kind: [i for i, s in streams.items() if s["type"] == kind]
             for kind in ("events", "frame")}
    if len(found["events"]) != 1 or len(found["frame"]) > 1:
        kinds = ", ".join(f"{i}: {s['type']}" for i, s in sorted(streams.items()))
        raise EvflowDataError(
            "EV008", f"{path} holds the streams {{{kinds}}}.",
            "One event stream and at most one frame stream are read: export one camera alone.")
    events, frames = _decode(path, packets_start, hints)
    info = streams[found["events"][0]]
    x, y, t, p = (np.concatenate([packet[n] for packet in events]) if events else np.zeros(0, int)
                  for n in ("x", "y", "t", "p"))
    t, size = hints.microseconds(t, "us"), hints.sensor((info["width"], info["height"]))
    return hints.crop(_recording(path, Events(x, y, t, hints.on(p), size), frames, hints))


def _decode(path: Path, packets_start: int, hints: Hints) -> tuple[list[Any], list[Any]]:
    """The event packets (structured arrays) and the frames (dicts), up to `stop_s` or the end."""
    events: list[Any] = []
    frames: list[Any] = []
    stop, last, count = np.iinfo(np.int64).max, 0, 0
    try:
        for count, packet in enumerate(_decoder(path), 1):  # noqa: B007 (read on failure)
            if len(packet.get("events", ())):
                events.append(packet["events"])
                last = hints.instant(events[-1]["t"][-1], "us")
                if len(events) == 1 and hints.stop_s is not None:
                    stop = hints.span_us(hints.instant(events[0]["t"][0], "us"))[1]
            elif "frame" in packet:
                frames.append(packet["frame"])
            if last >= stop + LATE_US:
                break
    except (KeyboardInterrupt, SystemExit):
        raise
    except BaseException as e:  # a Rust panic derives from BaseException
        if last < stop:
            raise _damaged(path, packets_start, count, events, len(frames), e) from e
    return events, frames


def _damaged(
    path: Path, packets_start: int, count: int, events: list[Any], n_frames: int, e: BaseException
) -> EvflowDataError:
    """EV009 with the byte at which packet number `count` begins and what was read before it."""
    position = next(
        (offset for i, offset in enumerate(_offsets(path, packets_start)) if i == count), None)
    place = f"at byte {position:,} of " if position is not None else "at the end of "
    n = sum(len(packet) for packet in events)
    us = int(events[-1]["t"][-1]) - int(events[0]["t"][0]) if events else 0
    until = us // 1000 / 1000  # rounded down: read with this stop_s, the file is sound
    return EvflowDataError(
        "EV009", f"{path} is cut off or damaged {place}{os.path.getsize(path):,} bytes "
        f"({e}); {n:,} events up to {until:.3f} s and {n_frames} frames before that are sound.",
        f"Copy it again, or read the sound part: stop_s={until:.3f} (--stop)." if until else
        "Copy it again.")


def _offsets(path: Path, start: int) -> Iterator[int]:
    """Where packets begin: each is {i32 stream, i32 size, size bytes}."""
    total = os.path.getsize(path)
    with open(path, "rb") as f:
        while start + 8 <= total:
            yield start
            f.seek(start + 4)
            size = int.from_bytes(f.read(4), "little", signed=True)
            if size < 0:
                return
            start += 8 + size


def _check_header(path: Path) -> int:
    """Return where the packets start; EV009 unless the header is a sound one."""
    with open(path, "rb") as f:
        magic, size = f.read(len(MAGIC)), int.from_bytes(f.read(4), "little")
        header = f.read(min(size, os.path.getsize(path)))
    try:
        if magic != MAGIC or len(header) < size:
            raise ValueError("cut off" if MAGIC.startswith(magic[:13]) else "wrong version line")
        ElementTree.fromstring(_info_node(header).decode("utf-8"))
    except (ValueError, struct.error, ElementTree.ParseError) as e:
        raise EvflowDataError(
            "EV009", f"{path} has a damaged AEDAT4 header ({e}).", "Copy it again.") from e
    return len(MAGIC) + 4 + size


def _info_node(header: bytes) -> bytes:
    """The XML string of the header's flatbuffer: root table -> vtable -> field -> string."""
    (table,) = struct.unpack_from("<I", header, 0)
    vtable = table - struct.unpack_from("<i", header, table)[0]
    (field,) = struct.unpack_from("<H", header, vtable + 4 + 2 * INFO_NODE)
    pointer = table + field
    string = pointer + struct.unpack_from("<I", header, pointer)[0]
    (length,) = struct.unpack_from("<I", header, string)
    if not 0 < length <= len(header) - string - 4:
        raise ValueError("its description is cut off")
    return header[string + 4 : string + 4 + length]


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


def _recording(path: Path, events: Events, frames: list[Any], hints: Hints) -> Recording:
    if not frames:
        return Recording.of_events(events)
    pixels, notes = stack_frames([frame["pixels"] for frame in frames], path)
    try:
        times = np.array([_mid_exposure(frame) for frame in frames], np.int64)
    except OverflowError as e:
        raise EvflowDataError("EV009", f"{path} has frame times beyond int64.") from e
    times = hints.microseconds(times, "us")
    return Recording(events, pixels, times, ("frame times are mid-exposure", *notes))


def _mid_exposure(frame: dict[str, Any]) -> int:
    """The middle of the exposure, else of the frame interval, else the packet's time (us)."""
    for begin, end in (("exposure_begin_t", "exposure_end_t"), ("begin_t", "end_t")):
        if 0 < frame[begin] <= frame[end]:
            return (frame[begin] + frame[end]) // 2
    return frame["t"]
