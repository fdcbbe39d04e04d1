"""Gaps in the events: times at which a sensor that had been busy sent nothing at all."""

from __future__ import annotations

import numpy as np

Array = np.ndarray

PACKET = 64  # events: the time they take says how dense the recording is
SAMPLES = 1_000_000  # packets looked at
GAP_PACKETS, GAP_US = 10, 10_000  # a gap is longer than both
TICKS = 3.0  # and than this many of the pauses between two times: some simulators know few times


def event_gaps(t: Array) -> Array:
    """Indices i of the times t (N,) int64 us, ascending, between which and t[i + 1] events are
    missing; none where there are too few to tell."""
    if len(t) < 4 * PACKET:
        return np.zeros(0, np.int64)
    stride = len(t) // SAMPLES + 1
    packet = float(np.median(t[PACKET::stride] - t[:-PACKET:stride]))
    between = np.diff(t)
    longest = np.flatnonzero(between > max(GAP_PACKETS * packet, GAP_US))
    if not len(longest):
        return longest
    pauses = between[between > 0]
    usual = np.quantile(pauses[::len(pauses) // SAMPLES + 1], 0.95)
    return longest[between[longest] > TICKS * usual]
