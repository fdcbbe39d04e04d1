"""Measurements of a bench by level of light: noise at rest, and the duration of steps.

The screen rests at a level once or several times. Steps are grouped by size; if all have one size,
the counts of a pixel take few values only.
"""

from __future__ import annotations

import dataclasses
import itertools
from typing import Any, Literal

import numpy as np

from evflow.errors import EvflowDataError
from evflow.estimation.bench.latency import Latency
from evflow.estimation.dead_time import DeadTime, dead_time, own_intervals
from evflow.notes import Note
from evflow.types import Events

UNSEEN = DeadTime()
Unit = Literal["DN", "lux", "light"]
Span = tuple[int, int]

SAME = 0.05  # log units: tolerance of one level, and of one size of steps
WAY = (0.5, 0.9)  # shares of a step in log units between which its duration is measured
BANDWIDTH = float(np.log(5.0)) / (2.0 * np.pi)  # of a first-order low-pass: cutoff times duration
UNLIKE = 2.0  # ratio of two ratios of lux to frames, above which one of them is doubtful
LARGE = 3.0  # thresholds: the duration of smaller steps is not measured
# Relative error of a threshold by steps of one threshold: of 73 random benches with noise it is 8 %
# (rms) for 1 to 1.5 thresholds, 5 % for 1.5 to 2.5, 2 % for 3 to 4.
SIZE_ERROR = 0.15
LEAST_SIZE = 2.5  # thresholds: smaller steps are noted
APART, EVEN = 0.87, 0.08  # ratio of distinct sizes at most; tolerance of equal intervals
SHORT = 0.05  # quantile of a pixel's intervals
LEAST_KINDS = 3  # of steps by direction and size, whose intervals are compared
FEW_EVENTS = 100  # of a step, from all pixels: with fewer its duration is not measured


@dataclasses.dataclass(frozen=True)
class Level:
    """One level of light.

    light: in the bench's unit; rests, seconds: number of rests at it, and their total duration;
    eta_on, eta_off: noise in Hz per pixel, means over pixels that are not hot, with their standard
    deviations; up_s, down_s: median duration of large steps up or down to it, from half to nine
    tenths of the way; None without such steps."""

    light: float
    rests: int
    seconds: float
    eta_on: float
    eta_on_std: float
    eta_off: float
    eta_off_std: float
    up_s: float | None = None
    down_s: float | None = None


@dataclasses.dataclass(frozen=True)
class Step:
    """One step of light. change: log units, of the median pixel; events: of its direction per
    pixel, mean over pixels that are not hot, minus the noise; seconds: duration from half to nine
    tenths of the way, None where not measured."""

    change: float
    events: float
    seconds: float | None = None


@dataclasses.dataclass(frozen=True)
class Bench:
    """Measurements of a bench (`CameraEstimate.bench`). unit: of the light, "light" if unknown;
    levels: darkest first; steps: in order of time, none for a static scene; dead: dead time of the
    pixels, if detected, or its upper bound; latency: by size and level of steps, if triggers were
    given."""

    unit: Unit
    levels: tuple[Level, ...]
    steps: tuple[Step, ...] = ()
    dead: DeadTime = UNSEEN
    latency: tuple[Latency, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """JSON-ready values."""
        return {"unit": self.unit, "levels": [dataclasses.asdict(v) for v in self.levels],
                "steps": [dataclasses.asdict(v) for v in self.steps],
                "latency": [dataclasses.asdict(v) for v in self.latency],
                "dead_time_s": self.dead.seconds if self.dead.measured else None,
                "dead_time_s_std": self.dead.std_s if self.dead.measured else None,
                "dead_time_s_below": self.dead.below_s if self.dead.below_s > 0 else None}


def cutoff_hz(duration_s: float) -> float:
    """Cutoff of a first-order low-pass whose step takes so long from half to nine tenths."""
    return BANDWIDTH / duration_s


def level_of(logs: np.ndarray) -> np.ndarray:
    """Index of the level, 0 the darkest, of each rest (R,) of log intensity."""
    order = np.argsort(logs, kind="stable")
    found = np.empty(len(logs), int)
    found[order] = np.concatenate([[0], np.cumsum(np.diff(logs[order]) > SAME)])
    return found


def light_of_rests(logs: np.ndarray, lux: tuple[float, ...]) -> list[float]:
    """Lux of each rest (R,), given that of each level, darkest first. Raises EV020 where the
    number of levels differs, or lux does not increase."""
    which = level_of(logs)
    levels = int(which.max()) + 1
    if len(lux) != levels or lux[0] <= 0 or any(b <= a for a, b in itertools.pairwise(lux)):
        raise EvflowDataError(
            "EV020", f"{len(lux)} values of lux ({', '.join(f'{v:g}' for v in lux)}), but the "
            f"frames rest at {levels} levels.", "Give one of each level, the darkest first.")
    return [lux[i] for i in which]


def lux_notes(logs: np.ndarray, lux: tuple[float, ...]) -> list[Note]:
    """A note if lux of the levels rises elsewhere than the frames' log intensity at the rests (R,):
    by more than `UNLIKE` times as much between two neighbours than between two others."""
    which = level_of(logs)
    seen = np.diff([logs[which == level].mean() for level in range(len(lux))])
    given = np.diff(np.log(lux))
    pace = given / seen
    if len(seen) < 2 or pace.max() <= UNLIKE * pace.min():
        return []
    k = int(np.argmax(np.abs(np.log(pace / np.median(pace)))))
    return [Note("levels.lux", f"from {lux[k]:g} to {lux[k + 1]:g} lux light becomes "
                 f"{np.exp(given[k]):.3g} times as bright, in the frames {np.exp(seen[k]):.3g} "
                 "times, unlike between other levels: a wrong number, or saturated frames? "
                 "Thresholds follow from the lux.")]


def measured_levels(
    quiet: list[Span], light: np.ndarray, logs: np.ndarray, rests: np.ndarray, kept: np.ndarray,
    steps: tuple[Step, ...],
) -> tuple[Level, ...]:
    """Levels of R rests and the R - 1 steps between them.

    Args:
        quiet: the R spans in which events were counted.
        light, logs: (R,) in the bench's unit, and log intensity.
        rests: (R, 2, H, W) events.
        kept: (H, W) bool, pixels that are not hot.
        steps: between the rests.
    """
    which = level_of(logs)
    found = []
    for level in range(int(which.max()) + 1):
        own = np.flatnonzero(which == level)
        seconds = sum(quiet[i][1] - quiet[i][0] for i in own) * 1e-6
        total = rests[own][:, :, kept].sum((0, 2), dtype=np.float64)
        spent = max(seconds * int(kept.sum()), 1e-9)
        errors = np.sqrt(np.maximum(total, 1.0)) / spent
        to_it = [steps[i - 1] for i in own if i]
        up, down = (_median([s.seconds for s in to_it if (s.change > 0) == rises])
                    for rises in (True, False))
        found.append(Level(float(np.mean(light[own])), len(own), seconds,
                           float(total[0] / spent), float(errors[0]),
                           float(total[1] / spent), float(errors[1]), up, down))
    return tuple(found)


def _duration(t: np.ndarray, way: float, pixels: int) -> float | None:
    """Seconds from half to nine tenths of a step.

    t: (N,) times of the events of its direction; way: its size in thresholds; pixels: that sent
    them. Where the direction of the light reversed, events at the beginning of a step are missing,
    so the shares are counted back from the end.
    """
    if len(t) < FEW_EVENTS or way < LARGE:
        return None
    behind = [(1.0 - part) * way * pixels / len(t) for part in WAY]
    if behind[0] >= 1.0:
        return None
    first, last = np.quantile(t, [1.0 - share for share in behind])
    return float(last - first) * 1e-6


def _median(values: list[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return float(np.median(known)) if known else None


def size_error(changes: np.ndarray, theta: np.ndarray, known: np.ndarray) -> np.ndarray:
    """(2,) relative errors of the thresholds theta (2,) as the steps (K,) are of few thresholds:
    their remainders, and what noise changes of them, are not as even as the regression assumes.
    known: (K,) bool."""
    sizes = [np.abs(changes[known & side]) for side in (changes > 0, changes < 0)]
    in_thresholds = np.array([np.median(size) / t if len(size) else LARGE
                              for size, t in zip(sizes, theta, strict=True)])
    return np.asarray(SIZE_ERROR / np.maximum(in_thresholds, 1.0) ** 2)


def small_steps(error: np.ndarray) -> list[Note]:
    """A note where the steps are too small, by their `size_error` (2,)."""
    size = np.sqrt(SIZE_ERROR / error.max())
    if size >= LEAST_SIZE:
        return []
    return [Note("steps.small", f"steps of light are of {size:.1f} thresholds (median): thresholds "
                 f"may be {error.max():.0%} off. Take steps of 3 thresholds or more, as between "
                 "40, 100 and 220 DN.")]


def few_sizes(changes: np.ndarray) -> list[Note]:
    """A note if all steps (K,) have one size, whatever their direction."""
    sizes = np.sort(np.abs(changes))
    if not len(sizes) or np.any(np.diff(sizes) > SAME):
        return []
    return [Note("levels.few", "all steps of light are of one size (a ratio of "
                 f"{np.exp(sizes.mean()):.2f}), so that a pixel's count takes few values only: "
                 "spikes in the histogram of the thresholds are counts, not kinds of pixels. Three "
                 "or more unequally spaced levels distinguish the pixels.")]


def measured_bench(
    unit: Unit, events: Events, spans: list[Span], settled: list[int], quiet: list[Span],
    light: np.ndarray, logs: np.ndarray, rests: np.ndarray, clean: np.ndarray, kept: np.ndarray,
    theta: np.ndarray, sized: np.ndarray, whole: bool,
) -> Bench:
    """All measurements of a bench.

    Args:
        unit: of light.
        events: of the recording.
        spans: the rests; settled: (R,) times until which events belong to the step that leads to
            a rest; other arguments as of `measured_levels`.
        clean: (K, 2, H, W) events of the steps minus the noise.
        theta: (2, H, W) thresholds, NaN where unknown.
        sized: (K,) bool, steps whose size and events are known; the others are left out.
        whole: whether all events of the steps are known, and so their durations.
    """
    inverse = [float(np.mean(1.0 / known)) if (known := t[kept & np.isfinite(t)]).size else 0.0
               for t in theta]
    steps = []
    for k, change in enumerate(np.diff(logs)):
        side = 0 if change > 0 else 1
        inside = events.slice(spans[k][1], settled[k + 1])
        of_side = inside.p == (side == 0)
        t = inside.t[of_side & kept[inside.y, inside.x]]
        steps.append(Step(float(change), float(clean[k, side][kept].mean()), _duration(
            t, abs(change) * inverse[side], int(kept.sum())) if whole and sized[k] else None))
    levels = measured_levels(quiet, light, logs, rests, kept, tuple(steps))
    during = [events.slice(spans[k][1], settled[k + 1]) for k in range(len(steps))]
    told = tuple(step for step, known in zip(steps, sized, strict=True) if known)
    return Bench(unit, levels, told, _dead_time(events, np.diff(logs), during))


def _dead_time(events: Events, changes: np.ndarray, during: list[Events]) -> DeadTime:
    """Dead time from all events; an upper bound where the light's edge may cause the intervals.

    An edge also sends a pixel's events at regular intervals, which depend on the size of the step
    and its direction; a dead time is the same for all. changes (K,), during (K): sizes and events
    of the steps."""
    found = dead_time(events)
    if not found.measured:
        return found
    shortest = []
    for changed in (changes, -changes):
        sizes = np.unique(changed[changed > 0])[::-1]
        for size in [*sizes[:1], *sizes[sizes < APART * sizes[:1]][:1]]:
            alike = Events.concatenate([
                during[k] for k in np.flatnonzero(np.abs(changed - size) < SAME)])
            shortest += [np.quantile(waits, SHORT)] if len(waits := own_intervals(alike)[0]) else []
    same = len(shortest) >= LEAST_KINDS and max(shortest) < (1.0 + EVEN) * min(shortest)
    return found if same else DeadTime(below_s=found.seconds)
