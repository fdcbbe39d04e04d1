"""Latency on a bench: from a step, timed by a trigger, to each pixel's first event of the step's
direction.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from evflow.errors import EvflowDataError
from evflow.types import Events

Span = tuple[int, int]

ALIKE = 0.05  # log units: steps to one level whose sizes differ by less are repetitions


@dataclasses.dataclass(frozen=True)
class Latency:
    """Latency of all steps of one size to one level.

    change: log units, negative down; light: the level they lead to, in the bench's unit; steps:
    number with a trigger; seconds: median over pixels and steps from the trigger to the first event
    of the step's direction; std_s: its standard deviation, from the scatter of the steps' medians
    (None for a single step); jitter_s: half the width of the central 68 % of these times;
    responded: share of the pixels that sent such an event."""

    change: float
    light: float
    steps: int
    seconds: float
    std_s: float | None
    jitter_s: float
    responded: float


def measured_latency(
    events: Events, triggers_us: Sequence[int] | np.ndarray, spans: Sequence[Span],
    ends: Sequence[int], light: np.ndarray, logs: np.ndarray, kept: np.ndarray,
) -> tuple[Latency, ...]:
    """Latencies by size of the step and level, dark to light.

    Args:
        events: of the recording.
        triggers_us: (N,) times of steps; the first counts where several lie within a step.
        spans: the R rests.
        ends: (R,) time until which events belong to the step that leads to a rest.
        light, logs: (R,) light of the rests in the bench's unit, and its log intensity.
        kept: (H, W) bool, pixels that are not hot.

    Raises:
        EvflowDataError: EV012 where no trigger lies at a step.
    """
    instants = np.sort(np.asarray(triggers_us, np.int64))
    answers: dict[tuple[float, int], list[np.ndarray]] = {}
    changes = np.diff(logs)
    for k, change in enumerate(changes):
        lead = (spans[k][1] - spans[k][0]) // 10  # the rest's end is known to a frame only
        at = instants[(instants >= spans[k][1] - lead) & (instants <= spans[k + 1][0])]
        if len(at):
            key = next((kind for kind in answers if abs(kind[0] - change) < ALIKE
                        and abs(logs[kind[1]] - logs[k + 1]) < ALIKE), (float(change), k + 1))
            answers.setdefault(key, []).append(
                _answers(events.slice(int(at[0]), int(ends[k + 1])), int(at[0]), change > 0, kept))
    if not answers:
        raise EvflowDataError(
            "EV012", f"none of {len(instants)} triggers lies at one of {len(changes)} steps.",
            "Are they on the clock of the events, and of the edges of the light?")
    kinds = sorted(answers, key=lambda kind: (logs[kind[1]], kind[0]))
    pixels = max(int(kept.sum()), 1)
    return tuple(_summed(kind[0], float(light[kind[1]]), answers[kind], pixels) for kind in kinds
                 if any(len(times) for times in answers[kind]))


def _answers(events: Events, instant_us: int, rises: bool, kept: np.ndarray) -> np.ndarray:
    """(N,) us from a time to the first event of a direction, for each pixel that has one."""
    of_side = (events.p == rises) & kept[events.y, events.x]
    pixel = events.y[of_side].astype(np.int64) * events.size[0] + events.x[of_side]
    return events.t[of_side][np.unique(pixel, return_index=True)[1]] - instant_us


def _summed(change: float, light: float, times: list[np.ndarray], pixels: int) -> Latency:
    low, middle, high = np.quantile(np.concatenate(times), [0.16, 0.5, 0.84])
    medians = [float(np.median(t)) for t in times if len(t)]
    several = len(medians) > 1
    std = 1e-6 * float(np.std(medians, ddof=1)) / len(medians) ** 0.5 if several else None
    return Latency(change, light, len(times), float(middle) * 1e-6, std,
                   float(high - low) * 0.5e-6, float(np.mean([len(t) for t in times])) / pixels)
