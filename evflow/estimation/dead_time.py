"""The dead time (refractory period) of a camera, from the intervals between a pixel's events.

Below the dead time there are no intervals except from noise, above it there are many, because a
pixel whose light keeps changing fires as soon as it can. If few pixels change that fast there is no
such edge, and the dead time is only known to be shorter than usual intervals.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from evflow.files.spool import forget
from evflow.types import Events

MOST_EVENTS = 2_000_000  # examined; of a longer recording, those of a subset of the pixels
BLOCK = 1 << 20  # events at a time: they may be memory-mapped
BEGINNING = 16_000_000  # events of a long recording from which it is measured
SHORTEST_US, LONGEST_US = 20.0, 50_000.0
STEP = 1.03  # ratio of successive candidates
ABOVE, BELOW = (1.0, 1.1), (0.8, 0.95)  # relative ranges with many, few intervals
ENOUGH = 200  # intervals just above
SHARP = 8.0  # ratio of densities above and below; a slow pixel's only double over this distance
# The shortest intervals of a busy scene become many by degrees: 5 to 7 times as many at the edge as
# below, and again a quarter further on. An edge exceeds that growth.
FURTHER, GROWTH = (1.25, 1.375), 4.0
PILED, ROUNDED_US = 0.005, 2.0  # spread at the edge of events that waited for it, as v2e's do
# Where events are dropped, intervals are as many right behind the dead time as further on; where a
# pixel begins anew they become many only with the time that a threshold takes. The distance of the
# quantiles .02 and .1 near the edge is .2 of that of .1 and .5 if they are as many, .45 if their
# density rises from 0 (simulated: .16 to .29 in 22 of 25 cameras, .28 to .68 in 16 of 17).
NEAREST, ABRUPT = (0.02, 0.1, 0.5), 0.27
TILES, LEFT_OUT = 8, 16  # tiles a side, and those with most intervals at the edge
PIXELS = 20  # with intervals at the edge: a hot pixel may fire as regularly as a clock
LATTICE = 20  # distinct intervals within an octave: coarse times have an edge at each step
SHORTEST = 0.01  # share of the intervals
FEW_SHORTER = 0.05  # maximum share of shorter intervals: from noise that ignores the dead time


@dataclasses.dataclass(frozen=True)
class DeadTime:
    """seconds, std_s: the dead time, 0 and NaN if the recording does not show it; below_s: an upper
    bound, from shortest intervals that may have another cause, NaN if there is none; shortest_s:
    what SHORTEST of the intervals are below, 0 with too few; edge_s: where they abruptly become
    many, 0 if they do not: the dead time of pixels that drop events or let them wait, or, if that
    is in few places, perhaps a blinking lamp."""

    seconds: float = 0.0
    std_s: float = float("nan")
    below_s: float = float("nan")
    shortest_s: float = 0.0
    edge_s: float = 0.0

    @property
    def measured(self) -> bool:
        return self.seconds > 0


def dead_time(events: Events) -> DeadTime:
    """The dead time of a stream's pixels, if at least ENOUGH intervals lie at its edge."""
    intervals, pixel = own_intervals(events)
    order = np.argsort(intervals, kind="stable")
    intervals, pixel = intervals[order], pixel[order]
    if len(intervals) < ENOUGH:
        return DeadTime()
    unknown = DeadTime(shortest_s=1e-6 * float(np.quantile(intervals, SHORTEST)))
    edges = SHORTEST_US * STEP ** np.arange(int(np.log(LONGEST_US / SHORTEST_US) / np.log(STEP)))

    sharpness = _sharpness(intervals, edges, ENOUGH)
    best = int(np.argmax(sharpness))
    growth = max(_growth(intervals, float(edges[best])), 1.0)
    if sharpness[best] < max(SHARP, GROWTH * growth):
        return unknown
    at_edge = slice(*np.searchsorted(intervals, edges[best] * np.array([0.95, 1.1])))
    near = intervals[at_edge]
    octave = intervals[slice(*np.searchsorted(intervals, edges[best] * np.array([0.95, 1.9])))]
    shorter = np.searchsorted(intervals, 0.95 * edges[best]) / len(intervals)
    few_pixels = len(np.unique(pixel[at_edge])) < PIXELS
    if len(np.unique(octave)) < LATTICE or shorter > FEW_SHORTER or few_pixels:
        return unknown
    low, middle = np.quantile(near, [0.05, 0.5])
    edge_s = 1e-6 * float(low) if _abrupt(near) else 0.0
    if middle - low > PILED * low + ROUNDED_US:
        elsewhere = _elsewhere(pixel, at_edge, events.size)
        if _sharpness(intervals[elsewhere], edges[best:best + 1], ENOUGH // 4)[0] < SHARP:
            return dataclasses.replace(unknown, edge_s=edge_s)
    seconds, std_s = float(low) * 1e-6, float(max(middle - low, 0.02 * low)) * 1e-6
    return DeadTime(seconds, std_s, shortest_s=seconds, edge_s=edge_s)


def _sharpness(intervals: np.ndarray, edges: np.ndarray, enough: int) -> np.ndarray:
    """Ratio of the densities of the sorted intervals above and below each of the edges; 0 with
    fewer than `enough` above."""
    many, few = (np.diff(np.searchsorted(intervals, [edges * low, edges * high]), axis=0)[0]
                 for low, high in (ABOVE, BELOW))
    density = (ABOVE[1] - ABOVE[0]) / (BELOW[1] - BELOW[0])
    return many / (few * density + 1.0) * (many >= enough)


def _growth(intervals: np.ndarray, edge: float) -> float:
    """Ratio of the densities of the sorted intervals further on and right above an edge."""
    more, many = (np.diff(np.searchsorted(intervals, [edge * low, edge * high]))[0]
                  / (high - low) for low, high in (FURTHER, ABOVE))
    return float(more / max(many, 1.0))


def _abrupt(near: np.ndarray) -> bool:
    """Whether intervals (N,) near an edge are as many right behind it as further on."""
    first, few, half = np.quantile(near, NEAREST)
    return bool(few - first <= ABRUPT * (half - few) + ROUNDED_US)


def _elsewhere(pixel: np.ndarray, at_edge: slice, size: tuple[int, int]) -> np.ndarray:
    """(N,) bool: intervals outside the tiles with most of those at the edge. The edge of a
    blinking lamp's light has one too, but in its place only."""
    (width, height), y = size, pixel // size[0]
    tile = y * TILES // height * TILES + pixel % width * TILES // width
    most = np.argsort(np.bincount(tile[at_edge], minlength=TILES**2))[-LEFT_OUT:]
    return ~np.isin(tile, most)


def own_intervals(events: Events) -> tuple[np.ndarray, np.ndarray]:
    """(N,) int64, microseconds between successive events of a pixel, of either polarity; and (N,)
    that pixel."""
    width, height = events.size
    # Every k-th pixel in a shuffled order: rows and columns of a sensor may differ.
    share = max(1, -(-len(events) // MOST_EVENTS))
    used = np.random.default_rng(0).permutation(height * width) % share == 0
    parts = []
    for first in range(0, len(events), BLOCK):
        part = slice(first, first + BLOCK)
        pixel = events.y[part].astype(np.int64) * width + events.x[part]
        kept = used[pixel]
        parts.append((pixel[kept], events.t[part][kept]))
        forget(events.x, events.y, events.t)
    if not parts:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    pixel, t = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.argsort(pixel, kind="stable")
    pixel, t = pixel[order], t[order]
    same = np.diff(pixel) == 0
    return np.diff(t)[same], pixel[1:][same]


def first_events(events: Events) -> Events:
    """The first BEGINNING events."""
    if len(events) <= BEGINNING:
        return events
    return events.slice(int(events.t[0]), int(events.t[BEGINNING]))
