"""The data types shared by all packages: `Events`, `Recording`, `Window`. Host side, NumPy only.

An object that exists is valid: construction checks shape, dtype, NaN, order, coordinates and
polarity once, and raises an `EvflowDataError` that says what was seen, where, and what to do.
Nothing is sorted, clipped or dropped. Arrays are kept read-only, and without a copy where their
dtype already fits. Units: times are int64 microseconds on the recording's own clock, a size is
(width, height), an image is (height, width), brightness is in DN (digital numbers).
"""

from __future__ import annotations

import dataclasses
import functools
import operator
from collections.abc import Sequence

import numpy as np

from evflow.checks import (
    COLUMNS,
    Size,
    check_columns,
    check_coordinates,
    check_frames,
    check_polarity,
    check_size,
    check_times,
    need,
    plain,
    read_only,
)
from evflow.errors import EvflowDataError
from evflow.files.spool import forget
from evflow.notes import Note

BIT_DEPTHS = (8, 10, 12, 14, 16)  # of image sensors' converters; a 16-bit file may hold any


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Events:
    """Events of one camera in time order; N may be 0 (a silent camera).

    Attributes:
        x: (N,) column of the pixel, any integer dtype, 0..width-1; kept as uint16.
        y: (N,) row of the pixel, any integer dtype, 0..height-1; kept as uint16.
        t: (N,) any integer dtype, microseconds, non-decreasing; kept as int64.
        p: (N,) bool, or integers in {0, 1} or {-1, 1}; kept as bool, True = ON (brighter).
        size: (width, height) of the sensor in pixels.

    Raises:
        EvflowDataError: EV002 (columns are not 1-D, or differ in length), EV003 (dtype), EV004
            (times go back), EV005 (outside the sensor), EV006 (polarity), EV007 (NaN), EV020
            (size).

    Example:
        >>> events = ef.Events(x, y, t, p, size=(346, 260))
        >>> on, off = events.slice(0, 50_000).count_map()  # (260, 346) each
    """

    x: np.ndarray
    y: np.ndarray
    t: np.ndarray
    p: np.ndarray
    size: Size

    def __post_init__(self) -> None:
        columns = check_columns(self.x, self.y, self.t, self.p)
        size = check_size(self.size)
        x, y = check_coordinates(columns["x"], columns["y"], size)
        t = check_times(columns["t"], "t", strict=False)
        self._set(x, y, t, check_polarity(columns["p"]), size)

    def _set(self, x: np.ndarray, y: np.ndarray, t: np.ndarray, p: np.ndarray, size: Size) -> None:
        for name, value in zip(COLUMNS, (x, y, t, p), strict=True):
            object.__setattr__(self, name, read_only(value))
        object.__setattr__(self, "size", size)

    @classmethod
    def unchecked(
        cls, x: np.ndarray, y: np.ndarray, t: np.ndarray, p: np.ndarray, size: Size
    ) -> Events:
        """Wrap columns that are canonical and valid by construction; O(1), nothing is checked.

        Args:
            x: (N,) uint16, column.
            y: (N,) uint16, row.
            t: (N,) int64, microseconds, non-decreasing.
            p: (N,) bool, True = ON.
            size: (width, height) in pixels.

        Returns:
            The events; the columns are not copied.
        """
        events = object.__new__(cls)
        events._set(x, y, t, p, size)
        return events

    @staticmethod
    def concatenate(parts: Sequence[Events]) -> Events:
        """Join consecutive parts of one camera.

        Args:
            parts: events of one size, in time order.

        Returns:
            All events of the parts, copied.

        Raises:
            EvflowDataError: EV001 (no part), EV004 (a part begins before the end of the one before
                it), EV015 (different sizes).
        """
        if not parts:
            raise EvflowDataError("EV001", "there are no events to concatenate.")
        sizes = sorted({part.size for part in parts})
        if len(sizes) > 1:
            raise EvflowDataError(
                "EV015", f"cannot join events of sizes {sizes}.", "Join parts of one camera only.")
        x, y, t, p = (np.concatenate([getattr(part, n) for part in parts]) for n in COLUMNS)
        return Events.unchecked(x, y, check_times(t, "t", strict=False), p, sizes[0])

    def __len__(self) -> int:
        return len(self.t)

    def __repr__(self) -> str:
        width, height = self.size
        text = f"{len(self):,} events, {width}x{height}, {self.duration_us / 1e6:.3f} s"
        return text + (f", {100 * self._share_on():.0f} % ON" if len(self) else "")

    def _share_on(self) -> float:
        """Share of ON events, counted in blocks because the events may be memory-mapped."""
        on = 0
        for first in range(0, len(self), 1 << 24):
            on += int(np.count_nonzero(self.p[first : first + (1 << 24)]))
            forget(self.p)
        return on / len(self)

    @property
    def duration_us(self) -> int:
        """Time from the first to the last event in microseconds; 0 without events."""
        return int(self.t[-1] - self.t[0]) if len(self) else 0

    def slice(self, t0_us: int, t1_us: int) -> Events:
        """The events with t0_us <= t < t1_us, as views (no copy, nothing is checked again).

        Args:
            t0_us: first time, integer microseconds.
            t1_us: end of the range, integer microseconds, not included.

        Returns:
            The events of that range; none where it is empty.
        """
        whole = np.iinfo(np.int64)
        bounds = np.array([min(max(operator.index(t), whole.min), whole.max)
                           for t in (t0_us, t1_us)])
        first, last = np.searchsorted(self.t, bounds)
        x, y, t, p = (getattr(self, name)[first:last] for name in COLUMNS)
        return Events.unchecked(x, y, t, p, self.size)

    def count_map(self) -> np.ndarray:
        """Events per pixel, uint32 (2, H, W) = [ON, OFF]."""
        width, height = self.size
        counts = np.zeros(2 * height * width, np.uint32)
        for first in range(0, len(self), 1 << 22):  # bounds the int64 indices to 32 MiB
            part = slice(first, first + (1 << 22))
            plane = np.where(self.p[part], 0, height)
            index = (plane + self.y[part]) * width + self.x[part]
            counts += np.bincount(index, minlength=counts.size).astype(np.uint32)
            if len(self) > 1 << 22:  # they may be memory-mapped
                forget(self.x, self.y, self.p)
        return counts.reshape(2, height, width)


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Recording:
    """Events and intensity frames of one camera on one clock.

    Attributes:
        events: the events.
        frames: (T, H, W) uint8, uint16 or float32 in DN; T may be 0. Float frames are on 0..255.
        frame_times: (T,) any integer dtype, microseconds, mid-exposure, strictly increasing; kept
            as int64.
        notes: what a reader assumed, left out or converted.

    Raises:
        EvflowDataError: EV002 (shape, or colour), EV003 (dtype, or range of float frames), EV004
            (times do not increase), EV007 (NaN), EV015 (frames and events of different size),
            EV020 (`events` is not an `Events`, or `notes` are not `Note`s).

    Example:
        >>> recording = ef.Recording(events, frames, frame_times)
        >>> recording.frame_dn(0)  # float32, white at 255
    """

    events: Events
    frames: np.ndarray
    frame_times: np.ndarray
    notes: tuple[Note, ...] = ()

    def __post_init__(self) -> None:
        need(self.events, Events, "events", "For a path: evflow.read_recording(path).")
        frames, times = (np.asarray(plain(name, getattr(self, name)))
                         for name in ("frames", "frame_times"))
        check_frames(frames, self.events.size)
        if times.shape != frames.shape[:1]:
            raise EvflowDataError(
                "EV002", f"frame_times has shape {times.shape} for {len(frames)} frames.",
                "Give one mid-exposure time in microseconds per frame.")
        times = check_times(times, "frame_times", strict=True)
        for note in self.notes:
            need(note, Note, "a note", "For a sentence: evflow.notes.Note(code, sentence).")
        object.__setattr__(self, "frames", read_only(frames))
        object.__setattr__(self, "frame_times", read_only(times))

    @staticmethod
    def of_events(events: Events, notes: tuple[Note, ...] = ()) -> Recording:
        """A recording without frames.

        Args:
            events: the recording's events.
            notes: as in `Recording`.

        Returns:
            The recording; its frames are (0, H, W) uint8.

        Raises:
            EvflowDataError: EV020 (`events` is not an `Events`, or `notes` are not `Note`s).
        """
        need(events, Events, "events", "For a recording: recording.events.")
        width, height = events.size
        return Recording(
            events, np.zeros((0, height, width), np.uint8), np.zeros(0, np.int64), notes)

    @property
    def frames_were_made(self) -> bool:
        """Whether a note says that the frames were reconstructed from the events by a network."""
        return any(note.code == "frames.made" for note in self.notes)

    def __repr__(self) -> str:
        frames = f"{len(self.frames)} frames ({self.frames.dtype})"
        return f"{self.events!r}, {frames if self.has_frames else 'no frames'}"

    @property
    def has_frames(self) -> bool:
        """Whether there is at least one frame."""
        return len(self.frames) > 0

    @functools.cached_property
    def full_scale(self) -> int:
        """The DN of a saturated pixel: 255 for uint8 and, by convention, float32; for uint16 the
        maximum of the smallest converter (8, 10, 12, 14 or 16 bits: 255, 1023, 4095, 16383, 65535)
        that covers all frames."""
        if self.frames.dtype != np.uint16 or not self.has_frames:
            return 255
        peak = int(self.frames.max())
        return next(2**bits - 1 for bits in BIT_DEPTHS if peak < 2**bits)

    def frame_dn(self, index: int) -> np.ndarray:
        """One frame on the common scale.

        Args:
            index: frame number, 0..T-1.

        Returns:
            float32 (H, W), scaled so that `full_scale` is 255 DN.
        """
        return self.frames[index].astype(np.float32) * np.float32(255 / self.full_scale)


def release(recording: Recording) -> None:
    """Release the pages that were read from a memory-mapped recording."""
    events = recording.events
    forget(events.x, events.y, events.t, events.p, recording.frames)


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Window:
    """What a camera saw between two of its frames: the input of one `estimate`.

    Attributes:
        events: those with t0_us <= t < t1_us.
        frame0: float32 (H, W), DN on 0..255, the frame taken at t0_us.
        frame1: float32 (H, W), DN on 0..255, the frame taken at t1_us.
        t0_us: start in microseconds, the mid-exposure of frame0.
        t1_us: end in microseconds, the mid-exposure of frame1.
        index: index among the recording's windows, from 0.
    """

    events: Events
    frame0: np.ndarray
    frame1: np.ndarray
    t0_us: int
    t1_us: int
    index: int

    def __repr__(self) -> str:
        return f"Window({self.index}: {self.events!r}, from {self.t0_us} to {self.t1_us} us)"

    @property
    def window_s(self) -> float:
        """Length in seconds, the `window_s` of `estimate`."""
        return (self.t1_us - self.t0_us) / 1e6
