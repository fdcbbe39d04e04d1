"""`Events`: what an event camera sends."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from evflow.checks import (
    COLUMNS,
    Size,
    check_columns,
    check_coordinates,
    check_polarity,
    check_size,
    check_times,
    integer_us,
    read_only,
)
from evflow.errors import EvflowDataError
from evflow.files.spool import forget


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

        Raises:
            EvflowDataError: EV003 for times that are no integers.
        """
        whole = np.iinfo(np.int64)
        bounds = np.array([min(max(integer_us(t), whole.min), whole.max) for t in (t0_us, t1_us)])
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
