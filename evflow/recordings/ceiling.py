"""A ceiling of the event rate: a readout or an event rate control that lets no more through.

Events above it are lost, or wait and get later times, so thresholds come out too high and edges in
the wrong places. Below a ceiling, numbers of events in equal times vary at least as those of
independent events do; at one they are all alike. What loses a random share of the events, or drops
them before it gives them a time, leaves no such trace.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from evflow.files.spool import forget

Array = np.ndarray

BINS_US = (100, 1_000, 10_000)  # the times in which events are counted
LEAST_COUNT = 40  # of a ceiling, in one bin: fewer are alike by chance
LEAST_BINS = 20  # beside others at the ceiling
ALIKE = 0.2  # half the width of a ceiling, in standard deviations of independent events
NEAR = 0.9  # of the ceiling: both bins beside one in which it is expected
SHARE = 0.6  # of these that must be at the ceiling; 16 % of independent events
BEYOND = 0.02  # bins above a ceiling, relative to those at it
BELOW = 0.05  # share of the bins with events that must lie below: times of a made-up stream may be
# even all the time
MOST_BINS = 4_000_000  # counted: longer recordings have longer ones
BLOCK = 1 << 22  # events at a time: they may be memory-mapped


class Ceiling(NamedTuple):
    """per_s: events per second; share: of the time with events; spans: (M, 2) int64 us, begin and
    end of the times at the ceiling."""

    per_s: float
    share: float
    spans: Array


def rate_ceiling(t: Array) -> Ceiling | None:
    """The ceiling of the rate of events at ascending times t (N,) int64 us; None if there is
    none."""
    passed = int(t[-1]) - int(t[0]) if len(t) >= LEAST_COUNT * LEAST_BINS else 0
    fitting = [us for us in BINS_US if LEAST_BINS < passed // us < MOST_BINS]
    if not fitting:
        return None
    shortest = _counts(t, fitting[0], passed // fitting[0])
    for bin_us in fitting:
        together = bin_us // fitting[0]
        bins = len(shortest) // together
        counts = shortest[: bins * together].reshape(bins, together).sum(1)
        if found := _ceiling(counts):
            level, half = found
            at = np.abs(counts - level) <= half
            share = float(at.sum() / np.count_nonzero(counts))
            per_s = float(np.median(counts[at])) * 1e6 / bin_us
            return Ceiling(per_s, share, int(t[0]) + bin_us * _runs(at))
    return None


def _counts(t: Array, bin_us: int, bins: int) -> Array:
    """Events in each of so many bins; what follows them, less than a bin, is left out."""
    counts, start = np.zeros(bins + 1, np.int64), int(t[0])
    for first in range(0, len(t), BLOCK):
        at = (t[first : first + BLOCK] - start) // bin_us
        some = np.bincount(at - at[0])
        counts[int(at[0]) : int(at[0]) + len(some)] += some
        forget(t)
    return counts[:-1]


def _ceiling(counts: Array) -> tuple[int, int] | None:
    """Events per bin at the ceiling, and by how many those of single bins differ from it."""
    number = np.concatenate([[0], np.cumsum(np.bincount(counts))])  # of bins with fewer events
    levels = np.arange(LEAST_COUNT, len(number) - 1)
    if not len(levels):
        return None
    half = np.maximum(1, ALIKE * np.sqrt(levels)).astype(np.int64)
    above = np.minimum(levels + half + 1, len(number) - 1)
    inside = number[above] - number[levels - half]
    inside[number[-1] - number[above] > BEYOND * inside] = 0
    best = int(np.argmax(inside))
    level, width = int(levels[best]), int(half[best])
    near = counts >= NEAR * level
    if np.count_nonzero(counts[~near]) < BELOW * np.count_nonzero(counts):
        return None
    amid = counts[1:-1][near[:-2] & near[2:]]
    alike = np.abs(amid - level) <= width
    return (level, width) if alike.sum() >= max(LEAST_BINS, SHARE * len(amid)) else None


def _runs(at: Array) -> Array:
    """(M, 2): first, and one past the last, of successive true values."""
    edges = np.flatnonzero(np.diff(at.astype(np.int8), prepend=0, append=0))
    return edges.reshape(-1, 2)
