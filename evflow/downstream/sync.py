"""Times at which a network runs on a stream of events: at the frames, after a fixed number of
events, or at equal intervals."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np

from evflow.errors import EvflowDataError
from evflow.recordings.windows import need_few_windows
from evflow.types import Recording

Sync = Literal["auto", "frames", "events", "ms"]

PER_PIXEL = 0.35  # events per pixel in a window, as published for E2VID
WINDOW_US = 33_000


def sync_times(
    recording: Recording, sync: Sync = "auto", *, count: int | None = None,
    window_us: int = WINDOW_US,
) -> np.ndarray:
    """Increasing times (T,) int64 us, the ends of windows: at the frames; after every `count`
    events (default: .35 per pixel); or every window_us from the first event on. An incomplete
    window at the end is left out, unless it is the only one.

    auto: the frames, where there are two or more, else equal intervals.
    Raises EV001 (no events), EV011 (no frames to follow), EV020 (another sync, a count or length
    that is no whole number of 1 or more), EV026 (more than 10 million windows of equal length).
    """
    if sync not in (choices := get_args(Sync)):
        raise EvflowDataError("EV020", f"sync {sync!r}.", f"Choose one of {choices}.")
    t = recording.events.t
    if not len(t):
        raise EvflowDataError("EV001", "the recording has no events.")
    if sync == "auto":
        sync = "frames" if len(recording.frames) > 1 else "ms"
    if sync == "frames":
        if not recording.has_frames:
            raise EvflowDataError("EV011", "the recording has no frames to follow.",
                                  "Choose windows of equal length or count.")
        return recording.frame_times
    if sync == "events":
        width, height = recording.events.size
        count = max(1, round(PER_PIXEL * width * height)) if count is None else count
        if not _counts(count):
            raise EvflowDataError("EV020", f"{count!r} events a window.",
                                  "Give a whole number, one or more.")
        # Windows that end at the same microsecond are merged.
        return np.unique(t[count - 1::count] if count <= len(t) else t[-1:])
    if not _counts(window_us):
        raise EvflowDataError("EV020", f"windows of {window_us!r} us.",
                              "Give whole microseconds, 1 or more.")
    return t[0] + window_us * np.arange(1, max(1, need_few_windows(t, window_us)) + 1)


def _counts(value: object) -> bool:
    return isinstance(value, int | np.integer) and int(value) >= 1


def window_edges(recording: Recording, times: np.ndarray) -> np.ndarray:
    """Edges (T + 1,) int64 of the windows that end at times (T,). The first window begins at the
    first event; times up to it are left out. Raises EV012 (frames) or EV017 (events) where none is
    left, EV001 without events or times."""
    if not len(recording.events) or not len(times):
        what = "times to end windows" if len(recording.events) else "events"
        raise EvflowDataError("EV001", f"there are no {what}.")
    start = recording.events.t[0]
    after = times[times > start]
    if not len(after) and times is not recording.frame_times:
        raise EvflowDataError("EV017", f"all events are at {start:,} us.",
                              "A window needs a length: take a longer recording.")
    if not len(after):
        raise EvflowDataError(
            "EV012", f"the last frame is at {times[-1]:,} us, the first event at {start:,} us.",
            "Are both on one clock and in one unit? See --time-unit and --frames-offset-ms.")
    return np.concatenate([[start], after])
