"""Which stretches of a recording are read, in which order, and when that is enough.

A camera does not change, so part of a long recording determines it: stretches spread over the time,
chosen in each part where most happens at little-known pixels, until the errors stop shrinking or a
budget is spent. What fits into the budget is read whole, in order.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Literal

import numpy as np

from evflow.estimation.refine.stretches import INTERVALS, PART, Stretch, most_simulated, spread
from evflow.files.spool import forget

Array = np.ndarray
Effort = Literal["quick", "normal", "full"]
EFFORTS = ("quick", "normal", "full")

UNIT = INTERVALS * PART[0] * PART[1]  # pixels of a stretch of a DAVIS346
LONG_S, MOST_LONGER = 30.0, 2.0  # longer recordings: budget grows as the root of their length
MOST_LARGER = 2.0  # also for larger sensors: fewer events per pixel are enough
CELL, SAMPLE = 16, 16  # pixels; stride of the events counted for the choice
SATURATED = 4.0  # events per pixel beyond which more add little
BATCH = 4  # stretches between two evaluations of the errors
SIMULATED = 5  # stretches, of many: beyond this the model's own error dominates


@dataclasses.dataclass(frozen=True)
class Budget:
    """most: number of stretches of a DAVIS346 to read; enough: stop when reading twice as much
    would reduce the errors by less than this share."""

    most: int
    enough: float


BUDGETS = {"quick": Budget(6, 0.1), "normal": Budget(18, 0.03)}


@dataclasses.dataclass(frozen=True)
class Order:
    """numbers: of the stretches to read, in this order; simulated: those that the refinement
    simulates; every: which of a stretch's windows are pooled."""

    numbers: tuple[int, ...]
    simulated: frozenset[int]
    every: int = 1


def ordered(stretches: Sequence[Stretch], effort: Effort) -> Order:
    """What to read of a recording's stretches, which are in time order."""
    recording = stretches[0].recording
    most = most_simulated(recording.events.size)
    lengths = [max(len(s.run), len(s.windows)) for s in stretches]
    number = len(stretches) if effort == "full" else _affordable(stretches, lengths, effort)
    if number >= len(stretches):
        simulated = spread([len(s.run) for s in stretches], most) if stretches[0].run else []
        return Order(tuple(range(len(stretches))), frozenset(simulated))
    chosen = _chosen(stretches, number)
    longest = max(len(stretches[i].run) for i in chosen)
    simulated = [i for i in chosen if len(stretches[i].run) == longest][:min(most, SIMULATED)]
    return Order(tuple(chosen), frozenset(simulated), every=2)


def _affordable(stretches: Sequence[Stretch], lengths: list[int], effort: Effort) -> int:
    """How many stretches the budget allows."""
    recording = stretches[0].recording
    width, height = recording.events.size
    begin, end = stretches[0].span_us[0], stretches[-1].span_us[1]
    longer = np.clip(np.sqrt((end - begin) * 1e-6 / LONG_S), 1.0, MOST_LONGER)
    larger = np.clip(width * height / (PART[0] * PART[1]), 1.0, MOST_LARGER)
    budget = BUDGETS[effort].most * UNIT * longer * larger
    return max(2, int(budget / (width * height * np.mean(lengths))))


def _chosen(stretches: Sequence[Stretch], number: int) -> list[int]:
    """Numbers of stretches: one from each of `number` equal parts, ordered so that any prefix is
    spread over the whole."""
    edges = np.linspace(0, len(stretches), number + 1).astype(int)
    longest = max(len(s.run) for s in stretches)
    known: Array | float = 0.0
    chosen: list[int] = []
    for k in _spreading(number):
        part = [i for i in range(edges[k], edges[k + 1]) if len(stretches[i].run) == longest]
        counts = {i: _cells(stretches[i]) for i in part or range(edges[k], edges[k + 1])}
        best = max(counts, key=lambda i: float(_value(known + counts[i]).sum()))
        known = known + counts[best]
        chosen.append(best)
    return chosen


def _value(counts: Array) -> Array:
    """The value of so many events of a pixel."""
    return np.log1p(counts / SATURATED)


def _cells(stretch: Stretch) -> Array:
    """Events per pixel of a stretch, in cells of pixels, estimated from a sample."""
    events = stretch.recording.events
    width, height = events.size
    part = events.slice(*stretch.span_us)
    columns, rows = -(-width // CELL), -(-height // CELL)
    cell = part.y[::SAMPLE].astype(np.int64) // CELL * columns + part.x[::SAMPLE] // CELL
    forget(events.x, events.y, events.t)
    return np.bincount(cell, minlength=columns * rows) * (SAMPLE / CELL**2)


def _spreading(number: int) -> list[int]:
    """0 ... number - 1 in an order whose prefixes are evenly spread (van der Corput)."""
    def mirrored(i: int) -> float:
        place, scale = 0.0, 0.5
        while i:
            place, i, scale = place + scale * (i & 1), i >> 1, scale / 2
        return place

    bits = max(1, int(np.ceil(np.log2(number))))
    return list(dict.fromkeys(int(mirrored(i) * number) for i in range(2 ** (bits + 1))))


def gain(history: Sequence[tuple[int, float]]) -> float:
    """Relative reduction of the errors with twice as much data. history: (stretches, variance) so
    far; the variance is modelled as a / stretches + b. NaN for fewer than two."""
    if len(history) < 2:
        return float("nan")
    n, now = history[-1]
    m, before = min(history[:-1], key=lambda h: abs(h[0] - n / 2))
    falling = max(before - now, 0.0) / (1 / m - 1 / n)
    return float(1.0 - np.sqrt(max(1.0 - falling / (2 * n * now), 0.0)))
