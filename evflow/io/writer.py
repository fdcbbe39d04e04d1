"""What every writer does: take events and frames in parts, check them, and write all or nothing.

A format's writer derives from `EventWriter`, declares what it can hold, and stores what `_write`
and `_write_frames` are given. Memory: `FLUSH` events, and what the caller appends at once. The file
gets its name when the `with` block ends without error and `_verify` finds it complete; otherwise
nothing is left behind.
"""

from __future__ import annotations

import abc
import atexit
import contextlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, ClassVar, TypeVar

import numpy as np

from evflow.checks import (
    COLUMNS,
    Size,
    check_exposure,
    check_frames,
    check_full_scale,
    check_size,
    check_times,
)
from evflow.errors import EvflowDataError
from evflow.files.atomic import atomic_write
from evflow.files.spool import forget
from evflow.process.signals import uninterrupted
from evflow.types import Events, Recording

FLUSH = 1 << 20  # events written at a time, which suits compressors
FRAMES = 16  # frames written at a time: a signal may have to wait for them
DEPTHS = ("uint8", "uint16", "float32")
SECONDS_US = 2**31 * 10**6  # float64 seconds keep the microsecond up to here, the year 2038

Self = TypeVar("Self", bound="EventWriter")


class EventWriter(abc.ABC):
    """Write a recording of one camera in parts.

    >>> with open_writer("out.zip", (346, 260)) as out:
    ...     for events in simulate_stream(...):
    ...         out.append(events)

    NAME: the format. DEPTHS: dtypes of frames it can hold, () for none. MAX_SIDE: largest side of a
    sensor in pixels. TIMES_US: its first and last possible time. BEYOND: what to do about others.
    LABELS: whether it can label noise events. exposure_us: of the frames, stored with them; 0 =
    unknown. full_scale: the DN of white of uint16 frames, stored with them; 0 = unknown.
    """

    NAME: ClassVar[str]
    DEPTHS: ClassVar[tuple[str, ...]] = DEPTHS
    MAX_SIDE: ClassVar[int] = 65536
    TIMES_US: ClassVar[tuple[int, int]] = (-(2**63), 2**63 - 1)
    BEYOND: ClassVar[str] = (
        "Wrong time unit? Pass --time-unit when reading; or write dsec or npz.")
    LABELS: ClassVar[bool] = False

    def __init__(
        self, path: str | os.PathLike, size: Size, *, overwrite: bool = False,
        exposure_us: int = 0, full_scale: int = 0,
    ) -> None:
        self.path, self.size, self.overwrite = Path(path), check_size(size), overwrite
        self.exposure_us = check_exposure(exposure_us)
        self.full_scale = check_full_scale(full_scale)
        if max(self.size) > self.MAX_SIDE:
            raise EvflowDataError(
                "EV003", f"{self.NAME} holds sensors of up to {self.MAX_SIDE} pixels a side, not "
                f"{self.size[0]}x{self.size[1]}.", "Write dsec or npz.")
        self._waiting: list[Events] = []
        self._count = 0  # of the events that wait
        self._last_us = self._last_frame_us = np.zeros(0, np.int64)
        self._depth: np.dtype | None = None
        self._session: Any = None

    def __enter__(self: Self) -> Self:
        self._session = self._writing()
        atexit.register(self._abandon)
        try:
            with uninterrupted():
                self._session.__enter__()
        except BaseException:
            self._session.__exit__(*sys.exc_info())
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, e: BaseException | None, tb: TracebackType | None
    ) -> None:
        try:
            self._session.__exit__(kind, e, tb)
        finally:
            atexit.unregister(self._abandon)

    def _abandon(self) -> None:
        """Leave nothing behind where a signal came before `__exit__` began."""
        self._session.gen.close()

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        """The lifetime of the file, from its creation to its final name."""
        with self._place() as temporary:
            self._stack = contextlib.ExitStack()
            try:
                with self._guard():
                    self._open(temporary, self._stack)
                yield
                self._flush()
                with self._guard():
                    self._finish()
                with uninterrupted():  # else what is closed last would be left
                    self._stack.close()
            except BaseException:
                with uninterrupted(), contextlib.suppress(Exception):  # the first error counts
                    self._stack.close()
                raise
            self._verify(temporary)

    def append(self, events: Events) -> None:
        """Add events that follow those appended before; raises EV003 (times), EV004, EV015."""
        if events.size != self.size:
            raise EvflowDataError(
                "EV015", f"events of size {events.size} for a file of size {self.size}.")
        if len(events) == 0:
            return
        check_times(np.append(self._last_us, events.t[:1]), "t", strict=False)
        self._check_times(events.t[[0, -1]], "events")
        self._check(events)
        self._last_us = events.t[-1:].copy()
        self._waiting.append(events)
        self._count += len(events)
        if self._count >= FLUSH:
            self._flush()
        else:
            self._waiting[-1] = _copied(events)  # the caller may reuse the arrays

    def append_labels(self, noise: np.ndarray) -> None:
        """Add labels, bool (N,), True = noise, one for each event in order, in parts of any length;
        EV020 if the format cannot store them."""
        if not self.LABELS:
            raise EvflowDataError("EV020", f"{self.NAME} cannot label noise events.",
                                  "Write dsec (.h5) or npz.")
        if len(noise):
            with self._guard():
                self._write_labels(noise)

    def append_frames(self, frames: np.ndarray, frame_times: np.ndarray) -> None:
        """Add frames (T, H, W) at frame_times (T,) int64 us.

        Raises EV020 (the format has no frames), EV003 (unsupported or mixed dtypes; float
        frames outside 0..255; times), EV004 (order), EV002 and EV015 (shape), EV007 (NaN).
        """
        frames, times = _sound_frames(frames, frame_times, self.size)
        if why := self.refuses(frames.dtype):
            raise EvflowDataError("EV003" if self.DEPTHS else "EV020", f"{why}.",
                                  "Leave the frames out, or write dsec or npz.")
        if self._depth not in (None, frames.dtype):
            raise EvflowDataError(
                "EV003", f"frames of {frames.dtype} after {self._depth}.",
                "All frames of a recording must have the same dtype.")
        if not len(frames):
            return
        check_times(np.append(self._last_frame_us, times), "frame_times", strict=True)
        self._check_times(times[[0, -1]], "frames")
        self._depth, self._last_frame_us = frames.dtype, times[-1:].copy()
        for first in range(0, len(frames), FRAMES):
            part = slice(first, first + FRAMES)
            with self._guard():
                self._write_frames(frames[part], times[part])

    @property
    def white(self) -> int:
        """White as it is stored with uint16 and float32 frames, which do not show it; 0 for uint8.
        Float32 frames are in DN: dark ones would be taken for fractions of white."""
        return {np.dtype(np.uint16): self.full_scale, np.dtype(np.float32): 255}.get(
            np.dtype(self._depth), 0)

    @classmethod
    def refuses(cls, depth: np.dtype) -> str:
        """Why frames of this dtype cannot be written, "" if they can."""
        if not cls.DEPTHS:
            return f"{cls.NAME} holds events only"
        return "" if depth.name in cls.DEPTHS else (
            f"{cls.NAME} holds frames of {', '.join(cls.DEPTHS)}, not {depth}")

    def _place(self) -> contextlib.AbstractContextManager[Path]:
        return atomic_write(self.path, overwrite=self.overwrite)

    def _guard(self) -> contextlib.AbstractContextManager[None]:
        """A context for each step of writing."""
        return contextlib.nullcontext()

    @abc.abstractmethod
    def _open(self, temporary: Path, stack: contextlib.ExitStack) -> None:
        """Create the file `temporary`; whatever must be closed goes on the stack."""

    @abc.abstractmethod
    def _write(self, events: Events) -> None:
        """Store events (at least one) that follow those before."""

    def _write_frames(self, frames: np.ndarray, times: np.ndarray) -> None:
        """Store frames (T, H, W) of one dtype, T > 0, that follow those before."""
        raise NotImplementedError

    def _write_labels(self, noise: np.ndarray) -> None:
        """Store labels (N,), N > 0, that follow those before."""
        raise NotImplementedError

    def _finish(self) -> None:  # noqa: B027 (most have nothing)
        """Write what is known only at the end."""

    @abc.abstractmethod
    def _verify(self, temporary: Path) -> None:
        """Refuse the closed file unless it is complete, before it gets its name; EV019."""

    def _check(self, events: Events) -> None:  # noqa: B027 (most have nothing)
        """Refuse events that the format cannot hold."""

    def _check_times(self, ends: np.ndarray, what: str) -> None:
        if self._session is None:
            raise EvflowDataError("EV020", f"{self.path} is not open.",
                                  "Write within: with ef.open_writer(path, size) as out: ...")
        low, high = self.TIMES_US
        if ends[0] < low or ends[-1] > high:
            raise EvflowDataError(
                "EV003", f"{what} at {ends[0]:,}..{ends[-1]:,} us; {self.NAME} holds times from "
                f"{low:,} to {high:,} us.", self.BEYOND)

    def _flush(self) -> None:
        if self._waiting:
            events, self._waiting, self._count = Events.concatenate(self._waiting), [], 0
            for part in blocks(events, FLUSH):
                with self._guard():
                    self._write(part)


def copy(recording: Recording, out: EventWriter) -> None:
    """Copy a whole recording, each frame after the events that precede it, as a camera sends
    them."""
    events, first = recording.events, 0
    cuts = np.searchsorted(events.t, recording.frame_times)
    for index, last in enumerate(cuts.tolist()):
        _copy_events(events, first, last, out)
        out.append_frames(recording.frames[index : index + 1],
                          recording.frame_times[index : index + 1])
        forget(recording.frames)
        first = last
    _copy_events(events, first, len(events), out)


def _copy_events(events: Events, first: int, last: int, out: EventWriter) -> None:
    """Copy in parts, releasing the memory of each memory-mapped part afterwards."""
    for begin in range(first, last, FLUSH):
        out.append(_part(events, begin, min(begin + FLUSH, last)))
        for name in COLUMNS:
            forget(getattr(events, name))


def _sound_frames(
    frames: np.ndarray, times: np.ndarray, size: Size
) -> tuple[np.ndarray, np.ndarray]:
    """Frames and times of a part of a recording; float frames in DN, however dark."""
    frames, times = np.asarray(frames), np.asarray(times)
    check_frames(frames[:0], size)
    if times.shape != frames.shape[:1]:
        raise EvflowDataError(
            "EV002", f"frame_times has shape {times.shape} for {len(frames)} frames.",
            "Give one mid-exposure time in microseconds per frame.")
    if frames.dtype == np.float32 and len(frames):
        low, high = float(frames.min()), float(frames.max())
        if not 0 <= low <= high <= 255:
            raise EvflowDataError(
                "EV007" if not np.isfinite(low + high) else "EV003",
                f"float frames span {low:g}..{high:g}; expected DN 0..255.", "Rescale them.")
    return frames, check_times(times, "frame_times", strict=True)


def blocks(events: Events, rows: int) -> Iterator[Events]:
    """The events in parts of up to `rows`, as views."""
    for first in range(0, len(events), rows):
        yield _part(events, first, first + rows)


def _copied(events: Events) -> Events:
    x, y, t, p = (getattr(events, name).copy() for name in COLUMNS)
    return Events.unchecked(x, y, t, p, events.size)


def _part(events: Events, first: int, last: int) -> Events:
    x, y, t, p = (getattr(events, name)[first:last] for name in COLUMNS)
    return Events.unchecked(x, y, t, p, events.size)
