"""Frames that are read row by row, or column by column (a rolling shutter): the times at which
events happened are told as those at which their row was read.

Every pixel is measured from its own events and its own light, so moving all events of a row by the
delay of that row is as good as frames of one time.
"""

from __future__ import annotations

import dataclasses
import itertools
from typing import Literal, NamedTuple, get_args

import numpy as np

from evflow.errors import EvflowDataError
from evflow.files.spool import Spool, forget
from evflow.notes import Note
from evflow.types import Events, Recording

Side = Literal["top", "bottom", "left", "right"]

LINES = {"top": "row", "bottom": "row", "left": "column", "right": "column"}
AT_ONCE = 1 << 21  # events


class Rolling(NamedTuple):
    """How long it takes to read a frame, from which side on; 0 if all is of one time."""

    seconds: float = 0.0
    first: Side = "top"

    def __str__(self) -> str:
        across = {"top": "bottom", "bottom": "top", "left": "right", "right": "left"}[self.first]
        return f"from the {self.first} to the {across} in {1e3 * self.seconds:.3g} ms"


GLOBAL = Rolling()


def unrolled(recording: Recording, rolling: Rolling) -> Recording:
    """The recording as if all of a frame were read at once, in the middle of its reading.

    Args:
        recording: with frames, whose times are those of the middle row or column.
        rolling: how they were read.

    Returns:
        A recording whose events are in the order of their new times (from equal ones on, of their
        old), without frames that the events no longer cover from side to side, and with a note.

    Raises:
        EvflowDataError: EV020 (a negative time, another side, or a time as long as the recording).
    """
    check_rolling(rolling)
    events, times = recording.events, recording.frame_times
    if not rolling.seconds or not len(events):
        return recording
    half_us = 0.5e6 * rolling.seconds
    kept = (times >= events.t[0] + half_us) & (times <= events.t[-1] - half_us)
    if recording.has_frames and not kept.any():
        raise EvflowDataError(
            "EV020", f"frames read {rolling}: in none of {len(times):,} frames are there events "
            "around every row.", "Give the time of a single frame's reading, in milliseconds.")
    left = f"; {len(times) - kept.sum()} frames at the ends were left out" * (not kept.all())
    note = Note("frames.unrolled", f"frames were read {rolling}: events were moved by the time at "
                f"which the {LINES[rolling.first]} of their pixel was read{left}")
    return dataclasses.replace(
        recording, events=_moved(events, rolling),
        frames=recording.frames if kept.all() else recording.frames[kept],
        frame_times=times[kept], notes=(*recording.notes, note))


def check_rolling(rolling: Rolling) -> None:
    """EV020 if the time is negative, or from an unknown side on."""
    if rolling.first not in get_args(Side):
        raise EvflowDataError("EV020", f"frames read from {rolling.first!r} on.",
                              f"Choose from {get_args(Side)}.")
    if not 0.0 <= rolling.seconds < np.inf:
        raise EvflowDataError(
            "EV020", f"frames read in {1e3 * rolling.seconds:g} ms.", "Give the time from the "
            "first row to the last, 0 or more, and the side that is read first.")


def delays_us(rolling: Rolling, size: tuple[int, int]) -> np.ndarray:
    """(rows,) or (columns,) int64, by which each is read after the middle of the frame."""
    width, height = size
    count = height if LINES[rolling.first] == "row" else width
    share = (np.arange(count) + 0.5) / count - 0.5
    sign = 1.0 if rolling.first in ("top", "left") else -1.0
    return np.rint(sign * 1e6 * rolling.seconds * share).astype(np.int64)


def _moved(events: Events, rolling: Rolling) -> Events:
    """The events at times less the delay of their row or column."""
    delays = delays_us(rolling, events.size)
    line = events.y if LINES[rolling.first] == "row" else events.x
    reach = int(np.abs(delays).max())
    spools = {name: Spool(getattr(events, name).dtype) for name in "xytp"}
    bounds = [int(t) for t in events.t[::AT_ONCE]] + [int(events.t[-1]) + reach + 1]
    bounds[0] -= reach
    for begin, end in itertools.pairwise(bounds):
        near = slice(*np.searchsorted(events.t, (begin - reach, end + reach + 1)))
        t = events.t[near] - delays[line[near]]
        inside = np.flatnonzero((t >= begin) & (t < end))
        order = inside[np.argsort(t[inside], kind="stable")]
        spools["t"].append(t[order])
        for name in "xyp":
            spools[name].append(getattr(events, name)[near][order])
        forget(events.x, events.y, events.t, events.p)
    x, y, t, p = (spools[name].array() for name in "xytp")
    return Events.unchecked(x, y, t, p, events.size)
