"""Events that bunch at the frames: the readout of a camera's frames disturbs its pixels.

In `slider_depth` of a DAVIS240C, pixels all over the sensor send ON events at twenty times the
previous rate half a millisecond before the time of each frame, and OFF events a millisecond later:
a fifth of all ON events. Bunches are short and at one phase of the frame period, unlike flickering
light, jerky motion and a simulator's time slots.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from evflow.recordings.region import only
from evflow.types import Events, Recording, release

BIN_US = 250
MOST_FRAMES = 64  # examined, evenly spread
LEAST_FRAMES, LEAST_BINS, MOST_BINS = 3, 16, 400  # bins: of the time examined around a frame
PEAK, RAISED = 4.0, 2.0  # times the usual rate: in the middle of a bunch, and at its edges
PRESENT = 0.8  # share of the frames that must have it
GAP_BINS = 4  # between a bunch and its rebound
LONGEST_US, LONGEST_SHARE = 4_000, 0.15  # of a bunch; relative to the frame period
LEAST_SHARE, LEAST_EVENTS = 0.02, 300  # of a polarity's events, in excess of the usual rate
LEAST_USUAL = 1.0  # events per bin elsewhere in the frame period


class Bunch(NamedTuple):
    """begin_us, end_us: its time relative to a frame (below 0: before); on, off: shares of the ON
    and OFF events in excess of the rate around it."""

    begin_us: int
    end_us: int
    on: float
    off: float


def beside(events: Events, frame_times: np.ndarray, found: Bunch) -> Events:
    """The events outside the bunch of each frame."""
    kept = np.ones(len(events), bool)
    ends = np.searchsorted(events.t, [frame_times + found.begin_us, frame_times + found.end_us])
    for first, last in ends.T:
        kept[first:last] = False
    return only(events, kept)


def bunch(recording: Recording) -> Bunch | None:
    """The bunch of events that comes with each frame; None if there is none."""
    counts, start_us = _by_phase(recording)
    total = counts.sum(0)
    usual = np.median(total, 1) if len(counts) else np.zeros(2)
    if usual.min() < LEAST_USUAL * len(counts) or not usual.all():
        return None
    rise = total / usual[:, None]
    raised = np.flatnonzero((rise >= RAISED).any(0))
    if rise.max() < PEAK or np.diff(raised).max(initial=0) > GAP_BINS + 1:
        return None  # none, or more than one in a period
    first, last = int(raised[0]), int(raised[-1]) + 1
    if BIN_US * (last - first) > min(LONGEST_US, LONGEST_SHARE * BIN_US * total.shape[1]):
        return None
    inside = counts[:, :, first:last].sum(2)
    excess = inside.sum(0) - usual * (last - first)
    shares = np.maximum(excess, 0.0) / total.sum(1)
    most = int(np.argmax(shares))
    there = inside[:, most] > RAISED * usual[most] / len(counts) * (last - first)
    if shares[most] < LEAST_SHARE or excess[most] < LEAST_EVENTS or there.mean() < PRESENT:
        return None
    return Bunch(start_us + BIN_US * first, start_us + BIN_US * last, float(shares[0]),
                 float(shares[1]))


def _by_phase(recording: Recording) -> tuple[np.ndarray, int]:
    """Events (F, 2, bins), ON and OFF, of frames whose period they cover, or 100 ms of it, evenly
    spread; and when the first bin begins, us after a frame. F = 0 where there
    are too few."""
    times, t = recording.frame_times, recording.events.t
    period_us = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    bins = min(int(period_us) // BIN_US, MOST_BINS)
    start = -(bins // 2) * BIN_US
    covered = np.flatnonzero((times + start >= t[0]) & (times + start + bins * BIN_US <= t[-1]))
    if bins < LEAST_BINS or len(covered) < LEAST_FRAMES:
        return np.zeros((0, 2, 1)), 0
    some = covered[np.unique(np.linspace(0, len(covered) - 1, MOST_FRAMES).astype(int))]
    counts = np.zeros((len(some), 2, bins), np.int64)
    for of_frame, begin in zip(counts, times[some] + start, strict=True):
        part = recording.events.slice(int(begin), int(begin) + bins * BIN_US)
        at = (part.t - begin) // BIN_US + bins * ~part.p
        of_frame[:] = np.bincount(at, minlength=2 * bins).reshape(2, bins)
    release(recording)
    return counts, start
