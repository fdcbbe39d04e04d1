"""Signals of pixels between their events, averaged about the times of frames.

A count of events is known at events alone. Between two of the same sign it is drawn straight;
where it turns, the light went on beyond the last event before it came back: there it is an arc.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

Array = np.ndarray

SPAN_US = 40_000.0  # longest time between two events over which a signal is interpolated
ARC = 3.7  # E of a + E s (1 - s) where a signal turns: mean for turns 0 to 1 threshold beyond


class Signals(NamedTuple):
    """Events of some pixels of a run. times_us: (K + 1,) of the frames; pixels: number of pixels;
    where: (..., M) indices of interval and pixel that are asked for. Events (N,) by pixel and time:
    pixel; on; since_us, at_us, between which the pixel's signal is interpolated; turns: whether it
    turns between them."""

    times_us: Array
    pixels: int
    where: Array
    pixel: Array
    on: Array
    since_us: Array
    at_us: Array
    turns: Array


def signals_of(
    times_us: Array, interval: Array, place: Array, events: tuple[Array, Array, Array],
    reach_us: tuple[float, float],
) -> Signals:
    """Of the pixels `place` (..., M) in intervals (M,), from the events of all by pixel and time:
    pixel, on, at_us. reach_us: of means about the frames, before and after."""
    pixel, on, at = events
    used, row = np.unique(place, return_inverse=True)
    row_of = np.full(max(pixel.max(initial=0), used.max(initial=0)) + 1, -1)
    row_of[used] = np.arange(len(used))
    kept = np.flatnonzero(row_of[pixel] >= 0)
    pixel, on, at = row_of[pixel[kept]], on[kept], at[kept]
    again = np.diff(pixel, prepend=-1) == 0
    before = np.where(again, np.roll(at, 1), at)
    turns = again & (np.roll(on, 1) != on) & (at - before <= SPAN_US)
    since = np.clip(before, at - SPAN_US, at - 1.0)
    where = interval * len(used) + row.reshape(place.shape)
    near = _near(times_us, len(used), where, pixel, since, at, reach_us)
    return Signals(times_us, len(used), where, pixel[near], on[near], since[near], at[near],
                   turns[near])


def _near(
    times: Array, pixels: int, where: Array, pixel: Array, since: Array, at: Array,
    reach_us: tuple[float, float],
) -> Array:
    """Which events (N,) can have a part in the changes `where`, at any length and delay."""
    chosen = np.zeros((len(times) - 1) * pixels, np.int64)
    chosen[where] = 1
    before = np.zeros((len(times), pixels), np.int64)
    before[1:] = chosen.reshape(len(times) - 1, pixels).cumsum(0)
    first = np.searchsorted(times, since - reach_us[1]) - 1
    last = np.searchsorted(times, at + reach_us[0])
    first, last = (np.clip(k, 0, len(times) - 1) for k in (first, last))
    return np.flatnonzero(before[last, pixel] > before[first, pixel])


def changes(seen: Signals, length_us: float, delay_us: float) -> Array:
    """(2, ..., M) changes of the ON counts' and of minus the OFF counts' means over so long about
    the frames."""
    times, half = seen.times_us + delay_us, 0.5 * length_us
    total = np.zeros((2, (len(times) - 1) * seen.pixels))

    def passed(to: Array, k: Array) -> Array:
        """(2, n) Integral up to a time of a step that rises straight from `since` to `at`, and of
        the arc above it."""
        since, span = seen.since_us[k], seen.at_us[k] - seen.since_us[k]
        share = np.clip((to - since) / span, 0.0, 1.0)
        step = 0.5 * span * share**2 + np.maximum(to - seen.at_us[k], 0.0)
        return np.stack([step, ARC * seen.turns[k] * span * share**2 * (0.5 - share / 3.0)])

    first = np.searchsorted(times, seen.since_us - half) - 1
    last = np.searchsorted(times, seen.at_us + half)
    for more in range(int((last - first).max(initial=0))):
        interval = first + more
        k = np.flatnonzero((interval >= 0) & (interval < len(times) - 1) & (interval < last))
        i = interval[k]
        before, after = (passed(times[j] + half, k) - passed(times[j] - half, k)
                         for j in (i, i + 1))
        step, arc = (after - before) / length_us
        on, slot = seen.on[k], i * seen.pixels + seen.pixel[k]
        total[0] += np.bincount(slot, np.where(on, step, arc), total.shape[1])
        total[1] -= np.bincount(slot, np.where(on, arc, step), total.shape[1])
    return total[:, seen.where]
