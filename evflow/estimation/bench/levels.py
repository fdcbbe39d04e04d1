"""What a bench shows level by level: noise where the light rests, and how long steps to it last.

A level is what the screen rests at, once or several times. Steps between them are told apart by
their size: where all are alike, the counts of a pixel can take a few values only.
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

SAME = 0.05  # log units: rests closer than that are of one level, steps of one size
WAY = (0.5, 0.9)  # of a step's rise or fall in log units: between them its duration is measured
BANDWIDTH = float(np.log(5.0)) / (2.0 * np.pi)  # cutoff of a first-order low-pass times that
LARGE = 3.0  # thresholds that a step takes at least, or its events do not tell how long it lasts
APART, EVEN = 0.87, 0.08  # sizes that are told apart; of a ratio, what is the same
SHORT = 0.05  # of a pixel's intervals are shorter
FEW_EVENTS = 100  # of a step, from all pixels: neither do these


@dataclasses.dataclass(frozen=True)
class Level:
    """One level of light.

    light: in the bench's unit; rests: how many times it was seen, for how many seconds in all;
    eta_on, eta_off: noise in Hz per pixel, means over pixels that are not hot, with their standard
    deviations; up_s, down_s: how long large steps up or down to it take from half to nine tenths of
    the way (median step), None where there are none."""

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
    """change: log units, of the median pixel; events: of its direction per pixel, the mean over
    pixels that are not hot, less the noise; seconds: from half to nine tenths of the way, None
    where they do not tell."""

    change: float
    events: float
    seconds: float | None = None


@dataclasses.dataclass(frozen=True)
class Bench:
    """What `CameraEstimate.bench` holds. unit: of the light, "light" where it was given without
    one; levels: darkest first; steps: in order of time, none of a static scene; dead: time of the
    pixels, where their events show one; latency: by kind of step, where triggers tell its
    instants."""

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
                "dead_time_s_std": self.dead.std_s if self.dead.measured else None}


def cutoff_hz(duration_s: float) -> float:
    """Of a first-order low-pass that takes so long from half to nine tenths of a step."""
    return BANDWIDTH / duration_s


def level_of(logs: np.ndarray) -> np.ndarray:
    """Which level, 0 the darkest, each rest (R,) of log intensity is at."""
    order = np.argsort(logs, kind="stable")
    found = np.empty(len(logs), int)
    found[order] = np.concatenate([[0], np.cumsum(np.diff(logs[order]) > SAME)])
    return found


def light_of_rests(logs: np.ndarray, lux: tuple[float, ...]) -> list[float]:
    """The lux of each rest (R,), given that of each level, darkest first; EV020 where they are not
    as many, or do not rise."""
    which = level_of(logs)
    levels = int(which.max()) + 1
    if len(lux) != levels or lux[0] <= 0 or any(b <= a for a, b in itertools.pairwise(lux)):
        raise EvflowDataError(
            "EV020", f"{len(lux)} values of lux ({', '.join(f'{v:g}' for v in lux)}), but the "
            f"frames rest at {levels} levels.", "Give one of each level, the darkest first.")
    return [lux[i] for i in which]


def measured_levels(
    quiet: list[Span], light: np.ndarray, logs: np.ndarray, rests: np.ndarray, kept: np.ndarray,
    steps: tuple[Step, ...],
) -> tuple[Level, ...]:
    """Levels of R rests, the spans `quiet`, and the R - 1 steps between them.

    light, logs: (R,) of each and its log intensity; rests (R, 2, H, W) events there; kept (H, W)
    pixels that are not hot."""
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
    """Seconds from half to nine tenths of the way, `way` thresholds long, that the events of a
    step's direction, at times t (N,) of so many pixels, go: fewer than it is long, where the light
    turned, as those that are missing are missing in the beginning."""
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


def few_sizes(changes: np.ndarray) -> list[Note]:
    """What is to be known where all steps (K,) are of one size, whatever their direction."""
    sizes = np.sort(np.abs(changes))
    if not len(sizes) or np.any(np.diff(sizes) > SAME):
        return []
    return [Note("levels.few", "all steps of light are of one size (a ratio of "
                 f"{np.exp(sizes.mean()):.2f}), so that a pixel's count takes few values only: "
                 "spikes in the histogram of the thresholds are counts, not kinds of pixels. Three "
                 "or more unequally spaced levels tell the pixels apart.")]


def measured_bench(
    unit: Unit, events: Events, spans: list[Span], quiet: list[Span], light: np.ndarray,
    logs: np.ndarray, rests: np.ndarray, clean: np.ndarray, kept: np.ndarray, theta: np.ndarray,
) -> Bench:
    """All of it. spans: the rests, of which `quiet` count; clean (K, 2, H, W): events of the steps,
    less the noise; theta (2, H, W): thresholds, NaN where they are unknown; the rest as in
    `measured_levels`."""
    inverse = [float(np.mean(1.0 / known)) if (known := t[kept & np.isfinite(t)]).size else 0.0
               for t in theta]
    steps = []
    for k, change in enumerate(np.diff(logs)):
        side = 0 if change > 0 else 1
        inside = events.slice(spans[k][1], quiet[k + 1][0])
        of_side = inside.p == (side == 0)
        t = inside.t[of_side & kept[inside.y, inside.x]]
        steps.append(Step(float(change), float(clean[k, side][kept].mean()), _duration(
            t, abs(change) * inverse[side], int(kept.sum()))))
    levels = measured_levels(quiet, light, logs, rests, kept, tuple(steps))
    during = [events.slice(spans[k][1], quiet[k + 1][0]) for k in range(len(steps))]
    return Bench(unit, levels, tuple(steps), _dead_time(events, np.diff(logs), during))


def _dead_time(events: Events, changes: np.ndarray, during: list[Events]) -> DeadTime:
    """Of all events; none where it is the light's own edge, which sends events of even pixels at
    even intervals too: those of smaller steps are longer then, as much as the steps are smaller.

    changes (K,) and `during` (K) are sizes and events of the steps."""
    found, sizes = dead_time(events), np.abs(changes)
    smaller = sizes[sizes < APART * sizes.max()] if len(sizes) else sizes
    if not found.measured or not len(smaller):
        return found
    waits = [own_intervals(Events.concatenate([
        during[k] for k in np.flatnonzero(np.abs(sizes - size) < SAME)]))
        for size in (sizes.max(), smaller.max())]
    if not all(map(len, waits)):
        return found
    longer = np.quantile(waits[1], SHORT) / max(np.quantile(waits[0], SHORT), 1.0)
    return UNSEEN if abs(longer * smaller.max() / sizes.max() - 1.0) < EVEN else found
