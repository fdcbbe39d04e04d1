"""How long pixels go on sending a step's events after the light rests again.

20 ms are enough for fast pixels. Slow ones, in dim light above all, take longer: until then the
first part of a rest is busier than its last third, which is noise.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from evflow.notes import Note
from evflow.types import Events

Span = tuple[int, int]

SETTLE_US, LONGER = 20_000, 1.5  # shortest time, and ratio of successive candidates
BUSY, SURE = 1.2, 4.0  # ratio of rates that shows events of a step, and standard deviations


def settled_at(spans: list[Span], settle_us: int) -> list[int]:
    """(R,) times until which events belong to the step before a rest: half of it at most."""
    return [min(a + settle_us, (a + b) // 2) for a, b in spans]


def settling_us(events: Events, spans: list[Span]) -> tuple[int, list[Note]]:
    """Time after which the rests (R,) send noise alone, and a note if that is more than half of
    them."""
    half = int(np.median([b - a for a, b in spans])) // 2
    settle = SETTLE_US
    while _busy(events, spans[1:], settle):
        if settle >= half:
            return settle, [Note(
                "steps.slow", "pixels still send a step's events when half of a rest is over: "
                "thresholds come out too high, and so does the noise. Rest longer at each level, "
                "or take brighter light.")]
        settle = min(round(LONGER * settle), half)
    return settle, []


def slow(notes: Iterable[Note]) -> bool:
    """Whether the pixels are too slow for the rests, by `settling_us`."""
    return any(note.code == "steps.slow" for note in notes)


def _busy(events: Events, spans: list[Span], settle: int) -> bool:
    """Whether rests send more events from `settle` to twice as long than in their last third."""
    early = late = early_us = late_us = 0
    for begin, end in spans:
        first, last = begin + settle, end - (end - begin) // 3
        middle = min(first + settle, last)
        if first < middle:
            early += len(events.slice(first, middle))
            late += len(events.slice(last, end))
            early_us, late_us = early_us + middle - first, late_us + end - last
    if not early:
        return False
    share = early_us / late_us
    chance = np.sqrt(early + late * share**2)
    return early > BUSY * share * late and early - share * late > SURE * float(chance)
