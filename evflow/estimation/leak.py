"""Leak told from other noise: ON events that come at a pixel's own regular intervals.

A memory that leaks reaches the ON threshold 1 / leak_hz after the pixel's last event, in every
light; all other noise ends a wait at any time. So the rates of a life table (intervals.py) are

    OFF(t) = m(t),    ON(t) = ratio m(t) + h(t),    t since the pixel's last event,

m whatever the pixels make it (uneven pixels: high at first), h the hazard of a log-normal around
1 / leak_hz, as pixels differ a little. Of pixels that have not fired since they are watched, the
last event was at any time before, or, in a simulation, at the beginning.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy import special

from evflow.estimation.intervals import EDGES, Waits

Array = np.ndarray

PERIODS = np.geomspace(0.02, 60.0, 131)  # s, 1 / leak_hz: steps of a sixteenth
SPREADS = (0.04, 0.08, 0.14, 0.23, 0.32)  # std of the log of the period: v2e's pixels have .23
RATIOS = np.exp(np.linspace(-1.8, 1.8, 25))  # of ON over OFF noise but for leak
RATIO_SPREAD = 0.5  # std of its log before any data
ODDS = 8.0  # log odds that it takes to speak of leak
LEAST_EVENTS = 200.0  # of leak, to tell its rate
MOST_HAZARD = 50.0  # of a period: what is left of a wait after it
NODES = np.sqrt(2.0) * special.roots_hermite(5)[0]
WEIGHTS = special.roots_hermite(5)[1] / np.sqrt(np.pi)
FLOOR = 0.05  # relative error: periods of a grid, pixels that differ otherwise


@dataclasses.dataclass(frozen=True)
class Leak:
    """hz, std_hz: of a pixel left alone, 0 and NaN where it is not told; rate_hz: events that it
    sends, as others reset the memory; events: how many of those that were seen."""

    hz: float = 0.0
    std_hz: float = float("nan")
    rate_hz: float = 0.0
    events: float = 0.0


def surviving(leak_hz: float, others_hz: Array | float) -> Array:
    """Leak events per second of a pixel whose memory others_hz other events reset."""
    waited = np.asarray(others_hz, np.float64) / max(leak_hz, 1e-12)
    return leak_hz * np.where(waited > 1e-6, waited / np.expm1(np.maximum(waited, 1e-6)), 1.0)


def measured_leak(waits: Waits) -> Leak:
    """The leak that pixels show while they are left alone."""
    tables = np.concatenate([waits.own, waits.first], 1)
    used = tables[0] > 0
    seconds, on, off = tables[:, used]
    if on.sum() < LEAST_EVENTS:
        return Leak()
    others = float(2.0 * (off.sum() + 0.5) / seconds.sum())

    def leaking(period: float, spread: float, fresh: bool) -> Array:
        return seconds * _hazards(period, spread, others, fresh)[used]

    grid = [(period, spread, fresh) for fresh in (False, True) for spread in SPREADS
            for period in PERIODS]
    likely = np.array([_likelihood(leaking(*point), on, off) for point in grid])
    leaked = leaking(*grid[int(np.argmax(likely.max(1)))])
    strange = _strangeness(leaked, on, off, int(np.argmax(likely.max(0))))
    prior = -0.5 * (np.log(RATIOS) / RATIO_SPREAD) ** 2
    none = special.logsumexp(_likelihood(0.0 * seconds, on, off) / strange + prior)
    chance = special.logsumexp(likely / strange + prior, 1)
    total = special.logsumexp(chance)
    if total - np.log(len(grid)) - none < ODDS or leaked.sum() < LEAST_EVENTS:
        return Leak()
    weight, logs = np.exp(chance - total), np.log([point[0] for point in grid])
    mean = float(weight @ logs)
    error = float(np.hypot(np.sqrt(weight @ (logs - mean) ** 2), FLOOR))
    hz = float(np.exp(-mean))
    return Leak(hz, hz * error, float(leaked.sum() / seconds.sum()), float(leaked.sum()))


def _hazards(period: float, spread: float, others: float, fresh: bool) -> Array:
    """(2 K,) leak events per second that is waited, between EDGES: since the last event, and since
    pixels are watched that have sent none."""
    z = np.log(np.maximum(EDGES, 1e-9) / period) / spread
    own = np.diff(-special.log_ndtr(-z)) / np.diff(EDGES)
    if fresh:
        return np.concatenate([own, own])
    middle = 0.5 * (EDGES[1:] + EDGES[:-1])
    periods = (period * np.exp(spread * NODES))[:, None]
    left = np.maximum(periods - middle, periods / MOST_HAZARD)
    hazard = others / np.expm1(np.clip(others * left, 1e-9, 50.0))
    # Of the slower pixels more are still waiting.
    waiting = WEIGHTS[:, None] * np.maximum(1.0 - middle / periods, 1e-9)
    return np.concatenate([own, (waiting * hazard).sum(0) / waiting.sum(0)])


def _rates(leaked: Array, on: Array, off: Array) -> tuple[Array, Array]:
    """(RATIOS, K) events that are expected, ON and OFF, at the most probable m of each time."""
    ratio = RATIOS[:, None]
    a, b = ratio * (1.0 + ratio), (on + off) * ratio - (1.0 + ratio) * leaked
    m = np.maximum((b + np.sqrt(b * b + 4.0 * a * off * leaked)) / (2.0 * a), 1e-12)
    return ratio * m + leaked, m


def _likelihood(leaked: Array, on: Array, off: Array) -> Array:
    """(RATIOS,) log probability of the events."""
    expected_on, expected_off = _rates(leaked, on, off)
    return (off * np.log(expected_off) - expected_off
            + on * np.log(expected_on) - expected_on).sum(-1)


def _strangeness(leaked: Array, on: Array, off: Array, ratio: int) -> float:
    """How many times more the events scatter about what is expected than counts do; at least 1."""
    expected = np.stack(_rates(leaked, on, off))[:, ratio]
    many = expected.min(0) > 5.0
    if not many.any():
        return 1.0
    away = (np.stack([on, off]) - expected) ** 2 / expected
    return max(1.0, float(away[:, many].sum() / many.sum()))
