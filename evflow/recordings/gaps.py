"""Gaps in the events: times at which a sensor that had been busy sent nothing at all."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from evflow.files.spool import forget
from evflow.types import Events

Array = np.ndarray

PACKET, QUARTERS = 64, 4  # events: the time they span gives the density of the recording
SAMPLES = 1_000_000  # packets examined
GAP_PACKETS, GAP_US = 10, 10_000  # a gap exceeds both
# Packets of steady noise: a pause as long comes by chance with e^-38. And share of the time
# that is busier, as where all pixels leak at once.
AT_REST, BUSIER = 0.6, 0.9
# Periods between gaps of a flickering light, their relative scatter; the longest one of a lamp, and
# the share of the time that is silent between the bursts of slower ones.
LEAST_PERIODS, EVEN, LAMP_US, SILENT = 4, 0.25, 50_000, 0.6
SLOW = 0.3  # share of the time; a sensor may have lost the rest
BLOCK = 1 << 22  # events examined at a time
TICKS = 3.0  # and this many usual pauses between two times: some simulators use few times


def event_gaps(t: Array, packets: float = GAP_PACKETS, slow: float = SLOW) -> Array:
    """Indices i of the ascending times t (N,) int64 us such that events are missing between t[i]
    and t[i + 1]; none if there are too few to decide. packets: usual spans of a packet that a gap
    exceeds; slow: as of `_usual_packet`."""
    if len(t) < 4 * PACKET:
        return np.zeros(0, np.int64)
    long = max(packets * _usual_packet(_packets(t), slow), GAP_US)
    longest = np.concatenate([first + np.flatnonzero(d > long) for first, d in _pauses(t)])
    if not len(longest):
        return longest
    usual = _usual_pause(t)
    return longest[t[longest + 1] - t[longest] > TICKS * usual]


def stretches_at_rest(events: Events, hot: Array) -> list[Events]:
    """The events of a scene at rest between the gaps; the events themselves if there is none. Noise
    is steady, so that shorter gaps show than among others, but not that of hot (H, W) pixels. Gaps
    at the pace of a lamp are the pauses of a flickering light."""
    steady = ~hot[events.y, events.x]
    t = events.t[steady]
    at = event_gaps(t, AT_REST, BUSIER)
    # Where a hot pixel fires, packets arrive.
    at = at[np.searchsorted(events.t, t[at + 1]) - np.searchsorted(events.t, t[at], "right") == 0]
    if not len(at) or _as_a_lamp(t[at], float((t[at + 1] - t[at]).sum()) / events.duration_us):
        return [events]
    begins, ends = [events.t[0], *t[at + 1]], [*t[at], events.t[-1]]
    return [events.slice(int(a), int(b) + 1) for a, b in zip(begins, ends, strict=True)]


def _as_a_lamp(t: Array, silent: float) -> bool:
    """Whether gaps that begin at t (N,) us, and take this share of the time, come as those of a
    flickering light: one period apart, which is short, or mostly silent."""
    apart = np.diff(t)
    if len(apart) < LEAST_PERIODS or np.std(apart) > EVEN * np.mean(apart):
        return False
    return bool(np.mean(apart) < LAMP_US or silent > SILENT)


def joined(parts: list[Events]) -> Events:
    """Stretches one after the other, as if no time had passed between them."""
    if len(parts) == 1:
        return parts[0]
    passed = np.cumsum([0, *(part.duration_us for part in parts[:-1])])
    whole = Events.concatenate(parts)
    t = np.concatenate([part.t - part.t[0] + by for part, by in zip(parts, passed, strict=True)])
    return Events.unchecked(whole.x, whole.y, t + parts[0].t[0], whole.p, whole.size)


def _packets(t: Array) -> Array:
    """Time spans (N, QUARTERS) of the quarters of SAMPLES packets, in blocks, as times may be
    memory-mapped."""
    stride = len(t) // SAMPLES + 1
    some = []
    for first in range(0, len(t) - PACKET, BLOCK // stride * stride):
        end = min(first + BLOCK // stride * stride, len(t) - PACKET)
        ends = [t[first + by : end + by : stride]
                for by in range(0, PACKET + 1, PACKET // QUARTERS)]
        some.append(np.diff(ends, axis=0).T)
        forget(t)
    return np.concatenate(some)


def _usual_packet(quarters: Array, slow: float) -> float:
    """The median time span of packets; or, if that is longer, the one which packets exceed in all
    but `slow` of the time: where most events come in bursts, as of steps of light, the time between
    is no gap. A gap in a packet does not count there, as it is in one of its quarters."""
    even = np.sort(QUARTERS * np.median(quarters, 1))
    passed = np.cumsum(even)
    slowest = even[np.searchsorted(passed, slow * passed[-1])]
    return max(float(np.median(quarters.sum(1))), float(slowest))


def _pauses(t: Array) -> Iterator[tuple[int, Array]]:
    """(number of the first, t[i + 1] - t[i]) in blocks, as times may be memory-mapped."""
    for first in range(0, len(t) - 1, BLOCK):
        yield first, np.diff(t[first : first + BLOCK + 1])
        forget(t)


def _usual_pause(t: Array) -> float:
    """The 95th percentile of pauses between distinct times, from SAMPLES of them."""
    stride = sum(int(np.count_nonzero(d)) for _, d in _pauses(t)) // SAMPLES + 1
    some, before = [], 0
    for _, d in _pauses(t):
        pauses = d[d > 0]
        some.append(pauses[-before % stride :: stride])
        before += len(pauses)
    return float(np.quantile(np.concatenate(some), 0.95))
