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
import functools

import numpy as np

from evflow.estimation.intervals import EDGES, Waits

Array = np.ndarray

PERIODS = np.geomspace(0.02, 60.0, 131)  # s, 1 / leak_hz: steps of a sixteenth
SPREADS = (0.04, 0.08, 0.14, 0.23, 0.32)  # std of the log of the period: v2e's pixels have .23
RATIOS = (0.15, 7.0)  # of ON over OFF noise but for leak, at most
RATIO_STEPS = 6  # of expectation and maximisation
RATIO_SPREAD = 0.5  # std of its log before any data
ODDS = 8.0  # log odds that it takes to speak of leak
LEAST_EVENTS = 200.0  # of leak, to tell its rate
MOST_HAZARD = 50.0  # of a period: what is left of a wait after it
FLOOR = 0.05  # relative error: periods of a grid, pixels that differ otherwise


@dataclasses.dataclass(frozen=True)
class Leak:
    """hz, std_hz: of a pixel that sends nothing else, 0 and NaN where it is not told; rate_hz:
    events per second that were seen, fewer, as others reset the memory; events: how many."""

    hz: float = 0.0
    std_hz: float = float("nan")
    rate_hz: float = 0.0
    events: float = 0.0


def measured_leak(waits: Waits) -> Leak:
    """The leak that pixels show while they are left alone."""
    tables = np.concatenate([waits.own, waits.first], 1)
    used = tables[0] > 0
    seconds, on, off = tables[:, used]
    if on.sum() < LEAST_EVENTS:
        return Leak()
    from scipy import special  # of which short recordings have no need

    others = float(2.0 * (off.sum() + 0.5) / seconds.sum())
    grid = [(period, spread, fresh) for fresh in (False, True) for spread in SPREADS
            for period in PERIODS]
    leaked = seconds * np.stack([_hazards(*point, others)[used] for point in grid])
    likely, expected = _likelihood(leaked, on, off)
    best = int(np.argmax(likely))
    strange = _strangeness(expected[:, best], on, off)
    none = _likelihood(np.zeros((1, len(on))), on, off)[0][0]
    total = special.logsumexp(likely / strange)
    events = float(leaked[best].sum())
    if total - np.log(len(grid)) - none / strange < ODDS or events < LEAST_EVENTS:
        return Leak()
    weight, logs = np.exp(likely / strange - total), np.log([period for period, *_ in grid])
    mean = float(weight @ logs)
    error = float(np.hypot(np.sqrt(weight @ (logs - mean) ** 2), FLOOR))
    hz = float(np.exp(-mean))
    return Leak(hz, hz * error, events / float(seconds.sum()), events)


def _hazards(period: float, spread: float, fresh: bool, others: float) -> Array:
    """(2 K,) leak events per second that is waited, between EDGES: since the last event, and since
    pixels are watched that have sent none."""
    from scipy import special

    z = np.log(np.maximum(EDGES, 1e-9) / period) / spread
    own = np.diff(-special.log_ndtr(-z)) / np.diff(EDGES)
    if fresh:
        return np.concatenate([own, own])
    middle = 0.5 * (EDGES[1:] + EDGES[:-1])
    nodes, weights = _nodes()
    periods = (period * np.exp(spread * nodes))[:, None]
    left = np.maximum(periods - middle, periods / MOST_HAZARD)
    hazard = others / np.expm1(np.clip(others * left, 1e-9, 50.0))
    # Of the slower pixels more are still waiting.
    waiting = weights[:, None] * np.maximum(1.0 - middle / periods, 1e-9)
    return np.concatenate([own, (waiting * hazard).sum(0) / waiting.sum(0)])


@functools.cache
def _nodes() -> tuple[Array, Array]:
    """Normal numbers that stand for all, and their weights."""
    from scipy import special

    nodes, weights = special.roots_hermite(5)
    return np.sqrt(2.0) * nodes, weights / np.sqrt(np.pi)


def _likelihood(leaked: Array, on: Array, off: Array) -> tuple[Array, Array]:
    """(G,) log probability of the events with so much leak (G, K), at the most probable m of each
    time and ratio; and (2, G, K) ON and OFF events that are then expected."""
    left = np.maximum(on.sum() - leaked.sum(1), 0.0)
    for _ in range(RATIO_STEPS):
        ratio = np.clip(left / (off.sum() + 0.5), *RATIOS)[:, None]
        a, b = ratio * (1.0 + ratio), (on + off) * ratio - (1.0 + ratio) * leaked
        m = np.maximum((b + np.sqrt(b * b + 4.0 * a * off * leaked)) / (2.0 * a), 1e-12)
        expected = ratio * m + leaked
        left = (on * ratio * m / expected).sum(1)
    likely = off * np.log(m) - m + on * np.log(expected) - expected
    prior = -0.5 * (np.log(ratio[:, 0]) / RATIO_SPREAD) ** 2
    return likely.sum(1) + prior, np.stack([expected, m])


def _strangeness(expected: Array, on: Array, off: Array) -> float:
    """How many times more the events scatter about what is expected (2, K) than counts do; at
    least 1."""
    many = expected.min(0) > 5.0
    if not many.any():
        return 1.0
    away = (np.stack([on, off]) - expected) ** 2 / expected
    return max(1.0, float(away[:, many].sum() / many.sum()))
