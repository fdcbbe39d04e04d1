"""HDF5 in the layout of the DSEC data set: the format to exchange events in.

/events/{x u16, y u16, p u8, t u32 us}, /t_offset (i64 us, add it to t), /ms_to_idx (u64; event
ms_to_idx[m] is the first with t >= 1000 m). Of our own: attributes width and height (absent in
DSEC, which is 640x480), and /frames, /frame_times (i64 us, without t_offset) where there are any.
`DsecWriter` takes events chunk by chunk, so that a long simulation never sits in memory.
"""

from __future__ import annotations

import bisect
import contextlib
import os
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from evflow.checks import Size, check_size, check_times
from evflow.errors import EvflowDataError
from evflow.files import atomic_write
from evflow.io.hdf5 import DAMAGE, MAGIC, Disk, load_h5py, need_filters, plausible
from evflow.io.hints import Hints
from evflow.types import Events, Recording

NAME = "dsec"
EXTENSIONS: tuple[str, ...] = (".h5", ".hdf5")

DSEC_SIZE = (640, 480)
CHUNK = 1 << 16  # events per HDF5 chunk: 256 KiB of t
FLUSH = 1 << 20  # events gathered before they are compressed
INDEX_MS = 1 << 20  # milliseconds indexed at a time: 8 MiB, however long the camera was silent
MAX_MS = 10**8  # 28 hours; beyond that two clocks were joined and ms_to_idx would not fit


def sniff(path: Path, head: bytes) -> bool:
    if not head.startswith(MAGIC):
        return False
    try:
        with load_h5py().File(path) as f:
            return "events" in f and hasattr(f["events"], "keys")
    except (EvflowDataError, *DAMAGE):
        return True  # `read` says why


def read(path: Path, hints: Hints) -> Recording:
    """Only the part between start_s and stop_s is read.

    Raises EV008 (a data set is missing), EV009 (damaged), EV010 (h5py or a filter is missing),
    EV001 (no event in the range), and what `Events` and `Recording` raise.
    """
    h5py = load_h5py()
    try:
        with h5py.File(path) as f:
            columns = _columns(path, f)
            size = DSEC_SIZE
            if "width" in f.attrs:
                size = int(f.attrs["width"]), int(f.attrs["height"])
            offset = hints.instant(f["t_offset"][()], "us") if "t_offset" in f else 0
            part, span = _range(columns["t"], offset, hints)
            x, y, t, p = (columns[name][part] for name in ("x", "y", "t", "p"))
            t = _shift(hints.microseconds(t, "us"), offset)
            events = Events(x, y, t, hints.on(p), hints.sensor(size))
            if "frames" not in f:
                return Recording.of_events(events)
            times = hints.microseconds(plausible(path, f["frame_times"])[:], "us")
            keep = slice(*np.searchsorted(times, span))
            return Recording(events, plausible(path, f["frames"])[keep], times[keep])
    except DAMAGE as e:
        raise EvflowDataError(
            "EV009", f"{path} is cut off or damaged ({type(e).__name__}: {e}).",
            "Copy it again; h5ls and h5dump show what is left.") from e


def write(path: str | os.PathLike, recording: Recording, *, overwrite: bool = False) -> None:
    """Raises EV010 (no h5py), EV013 (exists), EV019 (cannot be written)."""
    with DsecWriter(path, recording.events.size, overwrite=overwrite) as out:
        out.append(recording.events)
        if recording.has_frames:
            out.append_frames(recording.frames, recording.frame_times)


class DsecWriter:
    """Write events (and frames) chunk by chunk; the file appears when the block ends well.

    >>> with DsecWriter("out.h5", (346, 260)) as out:
    ...     for events in simulate_stream(...):
    ...         out.append(events)

    Nothing is left behind by an exception. t is u32 and widens to i64 past 71 minutes.
    """

    def __init__(self, path: str | os.PathLike, size: Size, *, overwrite: bool = False) -> None:
        self.path, self.size, self.overwrite = Path(path), check_size(size), overwrite
        self.offset_us: int | None = None
        self.n_events = 0  # in the file
        self._waiting: list[Events] = []
        self._last_us = self._last_frame_us = np.zeros(0, np.int64)
        self._stack = contextlib.ExitStack()
        self._file: Any = None
        self._disk: Disk

    def __enter__(self) -> DsecWriter:
        h5py = load_h5py()
        with contextlib.ExitStack() as stack:
            temporary = stack.enter_context(atomic_write(self.path, overwrite=self.overwrite))
            self._disk = stack.enter_context(Disk(temporary, "w+"))
            stack.callback(self._disk.check)
            # HDF5 1.10 checksums its metadata: of 1,500 damaged files none passed for sound,
            # where 24 did in the older layout.
            self._file = stack.enter_context(h5py.File(self._disk, "w", libver=("v110", "v110")))
            self._file.attrs["width"], self._file.attrs["height"] = self.size
            for name, dtype in (("x", "u2"), ("y", "u2"), ("p", "u1"), ("t", "u4")):
                self._create(f"events/{name}", (), dtype, CHUNK)
            self._create("ms_to_idx", (), "u8", CHUNK)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, e: BaseException | None, tb: TracebackType | None
    ) -> None:
        if e is not None:
            self._stack.__exit__(kind, e, tb)
            return
        with self._stack:
            self._flush()
            self._file.create_dataset("t_offset", data=np.int64(self.offset_us or 0))

    def append(self, events: Events) -> None:
        """Add events that follow those appended before; EV004 (order), EV015 (size)."""
        if events.size != self.size:
            raise EvflowDataError(
                "EV015", f"events of size {events.size} for a file of size {self.size}.")
        if len(events) == 0:
            return
        if self.offset_us is None:
            self.offset_us = int(events.t[0])
        check_times(np.append(self._last_us, events.t[:1]), "t", strict=False)
        span = int(events.t[-1]) - self.offset_us
        if span > MAX_MS * 1000:
            raise EvflowDataError(
                "EV004", f"events span {span / 3.6e9:,.0f} hours.",
                "Were recordings of different clocks joined?")
        self._last_us = events.t[-1:]
        self._waiting.append(events)
        if sum(map(len, self._waiting)) >= FLUSH:
            self._flush()

    def append_frames(self, frames: np.ndarray, frame_times: np.ndarray) -> None:
        """Add frames (T, H, W) at frame_times (T,) int64 us; what `Recording` raises."""
        none = np.zeros(0, int)
        part = Recording(Events(none, none, none, none, self.size), frames, frame_times)
        check_times(np.append(self._last_frame_us, part.frame_times), "frame_times", strict=True)
        if "frames" not in self._file:
            self._create("frames", part.frames.shape[1:], part.frames.dtype, 1)
            self._create("frame_times", (), "i8", CHUNK)
        if self._file["frames"].dtype != part.frames.dtype:
            raise EvflowDataError(
                "EV003", f"frames of {part.frames.dtype} after {self._file['frames'].dtype}.",
                "All frames of a recording have one dtype.")
        self._last_frame_us = part.frame_times[-1:]
        self._extend("frames", part.frames)
        self._extend("frame_times", part.frame_times)

    def _create(self, name: str, item: tuple[int, ...], dtype: Any, chunk: int) -> None:
        self._file.create_dataset(
            name, (0, *item), dtype, maxshape=(None, *item), chunks=(chunk, *item),
            compression="gzip", compression_opts=1, shuffle=True)

    def _extend(self, name: str, values: np.ndarray) -> None:
        data = self._file[name]
        data.resize(len(data) + len(values), axis=0)
        data[len(data) - len(values) :] = values
        self._disk.check()

    def _flush(self) -> None:
        if not self._waiting:
            return
        events, self._waiting = Events.concatenate(self._waiting), []
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
        """Turn t into int64 once it no longer fits u32 (71.6 minutes)."""
        group = self._file["events"]
        if last_us < 2**32 or group["t"].dtype == np.int64:
            return
        group.move("t", "t_u32")
        self._create("events/t", (), "i8", CHUNK)
        for first in range(0, self.n_events, FLUSH):
            self._extend("events/t", group["t_u32"][first : first + FLUSH].astype(np.int64))
        del group["t_u32"]


def _columns(path: Path, f: Any) -> dict[str, Any]:
    """The four data sets, 1-D, of one length and decodable; EV008, EV009, EV010."""
    group = f["events"]
    missing = [name for name in ("x", "y", "t", "p") if name not in group]
    if missing:
        raise EvflowDataError(
            "EV008", f"{path}: /events holds {sorted(group)} but not {missing}.",
            "Expected the DSEC layout: /events/{x, y, t, p}.")
    columns = {name: group[name] for name in ("x", "y", "t", "p")}
    shapes = {name: data.shape for name, data in columns.items()}
    if len(set(shapes.values())) > 1 or len(shapes["t"]) != 1:
        raise EvflowDataError(
            "EV009", f"{path}: /events has columns of shapes {shapes}.", "Write the file again.")
    for data in columns.values():
        need_filters(path, plausible(path, data))
    return columns


def _range(t: Any, offset: int, hints: Hints) -> tuple[slice, np.ndarray]:
    """Events to read as a slice, and the absolute range (2,) in us; binary search on the file."""
    if hints.whole or len(t) == 0:
        limits = np.iinfo(np.int64)
        return slice(None), np.array([limits.min, limits.max])

    def us(value: Any) -> int:
        return hints.instant(value, "us")

    span = hints.span_us(us(t[0]))
    first, last = (bisect.bisect_left(t, value, key=us) for value in span)
    if first >= last:
        raise hints.empty(us(t[-1]) - us(t[0]))
    return slice(first, last), np.clip(np.array(span), -(2**62), 2**62) + offset


def _shift(t: np.ndarray, offset: int) -> np.ndarray:
    """t + offset in int64, or EV009 where that does not fit."""
    if len(t) and not -(2**63) <= min(offset, int(t.min()) + offset) <= max(
        offset, int(t.max()) + offset) < 2**63:
        raise EvflowDataError("EV009", f"t_offset {offset} takes times beyond int64.")
    return t + np.int64(offset)
