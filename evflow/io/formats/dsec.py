"""HDF5 in the layout of the DSEC data set: the recommended exchange format for events.

/events/{x u16, y u16, p u8, t u32 us}, /t_offset (i64 us, add it to t), /ms_to_idx (u64; event
ms_to_idx[m] is the first with t >= 1000 m). evflow adds attributes width and height (absent in
DSEC, which is always 640x480; its ms_to_idx and t_offset identify it), and /frames, /frame_times
(i64 us, without t_offset; its attribute exposure_us is the frames' exposure, if known) if there are
frames; the attribute full_scale of uint16 and float32 ones is their white. `DsecWriter` takes
events in chunks, so that a long simulation is never in memory as a whole.
"""

from __future__ import annotations

import bisect
import contextlib
import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from evflow.checks import Size
from evflow.errors import EvflowDataError
from evflow.io.decode import tables
from evflow.io.decode.columns import LABEL, LABELS_UNREAD
from evflow.io.decode.hdf5 import MAGIC, Hdf5Writer, plausible
from evflow.io.decode.hdf5_search import (
    declared_offset,
    declared_size,
    images_beside,
    unit_of,
)
from evflow.io.decode.images_beside import are_images
from evflow.io.decode.stream import Chunk, gather
from evflow.io.hints import Hints
from evflow.io.images.exposures import KEY
from evflow.io.images.white import WHITE
from evflow.notes import Note
from evflow.types import Events, Recording

NAME = "dsec"
EXTENSIONS: tuple[str, ...] = (".h5", ".hdf5", "")

EVENTS = "events.h5"
COLUMNS = ("x", "y", "t", "p")
RECTIFY = Note("sensor.unrectified", "rectify_map.h5 is not applied: events keep the sensor's raw "
               "pixel coordinates, because thresholds belong to sensor pixels")
DSEC_SIZE = (640, 480)
FLUSH = 1 << 20  # events rewritten at a time where t widens
INDEX_MS = 1 << 20  # milliseconds indexed at a time: 8 MiB, however long the camera was silent
AROUND, PLACES = 2, 17  # neighbours examined around a time; positions at which times must increase
MAX_MS = 10**8  # 28 hours; beyond that two clocks were joined and ms_to_idx would not fit


def sniff(path: Path, head: bytes) -> bool:
    if path.is_dir():
        return (path / EVENTS).is_file()
    if not head.startswith(MAGIC):
        return False
    try:
        with tables.opened(path) as f:
            return "events" in f and hasattr(f["events"], "keys") and (
                "ms_to_idx" in f or all(name in f["events"] for name in COLUMNS))
    except EvflowDataError:
        return True  # `read` explains what is wrong


def read(path: Path, hints: Hints) -> Recording:
    """Only the part between start_s and stop_s is read. For a folder, its events.h5; a rectify map
    beside it is not applied.

    Raises EV008 (a data set is missing), EV009 (damaged), EV010 (h5py or a filter is missing),
    EV015 (neither width and height nor all of DSEC's own members), and what `stream.gather` and
    `Recording` raise.
    """
    path = path / EVENTS if path.is_dir() else path
    notes: tuple[Note, ...] = (RECTIFY,) if path.with_name("rectify_map.h5").is_file() else ()
    with tables.opened(path) as f:
        columns = _columns(path, f)
        if hints.time_unit == "auto":
            hints = dataclasses.replace(hints, time_unit=unit_of(f, "t", f["events/t"]))
        if LABEL in f["events"]:
            notes += (LABELS_UNREAD,)
        size, assumed = _size(f)
        if assumed and hints.size is None:
            notes += (assumed,)
        offset = (hints.instant(_scalar(path, f, "t_offset"), "us") if "t_offset" in f else
                  declared_offset(hints, f["events"], f))
        found = gather(path, _chunks(columns, hints), hints, size, "us", offset)
        if not _own_frames(f):
            return images_beside(path, f, found, hints, "events/t", notes)
        images = tables.dataset_images(path, f, "frames", "frame_times")
        return tables.with_frames(path, found, hints, images, "us", notes)


def _own_frames(f: Any) -> bool:
    """Whether /frames are as `DsecWriter` writes them, or were meant to be: no group of others, no
    images with channels."""
    if not {"frames", "frame_times"} <= set(f):
        return False
    frames = f["frames"]
    if hasattr(frames, "keys"):
        return not len(frames)
    return not (len(getattr(frames, "shape", None) or ()) == 4 and are_images(frames))


def _size(f: Any) -> tuple[Size | None, Note | None]:
    """Size of the sensor, None if unknown; and a note on what was assumed."""
    if "width" in f.attrs and "height" in f.attrs:
        return (int(f.attrs["width"]), int(f.attrs["height"])), None
    if size := declared_size(f, f["events"]):  # RVT: events/width, events/height
        return size, None
    if "ms_to_idx" in f and "t_offset" in f:
        return DSEC_SIZE, Note(
            "sensor.size", "assumed DSEC's sensor size, {}x{}: pass --size if it is "
            "another".format(*DSEC_SIZE))
    return None, None


class DsecWriter(Hdf5Writer):
    """Write events (and frames) in chunks; t is u32 and is widened to i64 past 71 minutes."""

    NAME = NAME
    LABELS = True
    offset_us: int | None = None
    n_events = 0  # in the file

    def _open(self, temporary: Path, stack: contextlib.ExitStack) -> None:
        super()._open(temporary, stack)
        self._file.attrs["width"], self._file.attrs["height"] = self.size
        for name, dtype in (("x", "u2"), ("y", "u2"), ("p", "u1"), ("t", "u4")):
            self._create(f"events/{name}", (), dtype, self.CHUNK)
        self._create("ms_to_idx", (), "u8", self.CHUNK)

    def _finish(self) -> None:
        super()._finish()
        self._store("t_offset", np.int64(self.offset_us or 0))

    def _check(self, events: Events) -> None:
        """Raise EV004 if the events span more than ms_to_idx can hold."""
        if self.offset_us is None:
            self.offset_us = int(events.t[0])
        span = int(events.t[-1]) - self.offset_us
        if span > MAX_MS * 1000:
            raise EvflowDataError(
                "EV004", f"events span {span / 3.6e9:,.0f} hours.",
                "Were recordings with different clocks joined?")

    def _write_frames(self, frames: np.ndarray, times: np.ndarray) -> None:
        if "frames" not in self._file:
            self._create("frames", frames.shape[1:], frames.dtype, 1)
            self._create("frame_times", (), "i8", self.CHUNK)
            if self.exposure_us:
                self._file["frame_times"].attrs[KEY] = np.int64(self.exposure_us)
            if self.white:
                self._file["frames"].attrs[WHITE] = np.int64(self.white)
        self._extend("frames", frames)
        self._extend("frame_times", times)

    def _write_labels(self, noise: np.ndarray) -> None:
        if LABEL not in self._file["events"]:
            self._create(f"events/{LABEL}", (), "u1", self.CHUNK)
        self._extend(f"events/{LABEL}", noise)

    def _write(self, events: Events) -> None:
        t = events.t - self.offset_us
        self._widen(int(t[-1]))
        for name, values in (("x", events.x), ("y", events.y), ("p", events.p), ("t", t)):
            self._extend(f"events/{name}", values)
        self._index(t)
        self.n_events += len(events)

    def _index(self, t: np.ndarray) -> None:
        """Extend ms_to_idx to the last millisecond that begins at or before t[-1]."""
        stop = int(t[-1]) // 1000 + 1
        for first in range(len(self._file["ms_to_idx"]), stop, INDEX_MS):
            ms = np.arange(first, min(first + INDEX_MS, stop))
            self._extend("ms_to_idx", self.n_events + np.searchsorted(t, ms * 1000))

    def _widen(self, last_us: int) -> None:
        """Convert t to int64 once it no longer fits u32 (71.6 minutes)."""
        group = self._file["events"]
        if last_us < 2**32 or group["t"].dtype == np.int64:
            return
        self._settle("events/t")
        group.move("t", "t_u32")
        self._create("events/t", (), "i8", self.CHUNK)
        for first in range(0, self.n_events, FLUSH):
            self._extend("events/t", group["t_u32"][first : first + FLUSH].astype(np.int64))
        del group["t_u32"]


def _columns(path: Path, f: Any) -> dict[str, Any]:
    """The four data sets, 1-D, of equal length and decodable; raises EV008, EV009, EV010."""
    group = f["events"]
    missing = [name for name in ("x", "y", "t", "p") if name not in group]
    if missing:
        raise EvflowDataError(
            "EV008", f"{path}: /events holds {sorted(group)} but not {missing}.",
            "Expected the DSEC layout: /events/{x, y, t, p}.", where=path)
    columns = {name: tables.dataset(path, group, name, (None,)) for name in ("x", "y", "t", "p")}
    tables.same_length(path, columns)
    return columns


def _scalar(path: Path, f: Any, name: str) -> Any:
    """The single value of a data set of shape () or (1,); raises EV009."""
    if getattr(f[name], "size", None) != 1:
        raise EvflowDataError("EV009", f"{path}: {name} is not a single number.", "Write it again.",
                              where=path)
    return plausible(path, f[name])[()]


def _chunks(columns: dict[str, Any], hints: Hints) -> Iterator[Chunk]:
    """Chunks of the events between start_s and stop_s, located by binary search in the file,
    preceded by the very first event, from which both are counted."""
    x, y, t, p = columns.values()
    first, last = _range(t, hints)

    def rows(part: slice) -> tuple[Any, Any, Any, Any]:
        return x[part], y[part], t[part], p[part]

    if first > 0:
        yield from tables.blocks(1, rows)
    stored = max(tables.stored_rows(column) for column in columns.values())
    yield from tables.blocks(last, rows, stored, first)


def _range(t: Any, hints: Hints) -> tuple[int, int]:
    """The range of events to read; `gather` selects the exact ones among them. All events if times
    are not increasing overall."""
    if hints.whole or not len(t) or hints.late != "stop" or not _rises(t):
        return 0, len(t)

    def us(at: int) -> int:
        near = np.sort(t[max(at - AROUND, 0) : at + AROUND + 1])  # a single time may be wrong
        return hints.instant(near[len(near) // 2], "us")

    start, stop = hints.span_us(hints.instant(t[0], "us"))
    first, last = (bisect.bisect_left(range(len(t)), value, key=us) for value in (start, stop))
    begin, end = max(first - 2 * AROUND, 0), min(last + 2 * AROUND, len(t))
    near = hints.microseconds(t[begin:end], "us") if first >= last else np.array([start])
    if not ((near >= start) & (near < stop)).any():
        raise hints.empty(us(len(t) - 1) - us(0))
    return begin, end


def _rises(t: Any) -> bool:
    """Whether times increase over positions spread evenly through the file."""
    places = np.unique(np.linspace(0, len(t) - 1, PLACES).astype(int))
    medians = [np.median(t[max(at - AROUND, 0) : at + AROUND + 1]) for at in places.tolist()]
    return bool((np.diff(medians) >= 0).all())
