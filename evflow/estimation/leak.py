"""Separates leak from other noise: ON events at a pixel's own regular intervals.

A leaking memory reaches the ON threshold 1 / leak_hz after the pixel's last event, at any light;
all other noise ends a wait at any time. So the rates of a life table (intervals.py) are

    OFF(t) = m(t),    ON(t) = ratio m(t) + h(t),    t since the pixel's last event,

where m is arbitrary (uneven pixels: high at first) and h is the hazard of a log-normal around
1 / leak_hz, since pixels differ a little. For pixels that have not fired since observation started,
the last event was at an unknown earlier time, or, in a simulation, at the start.
"""

from __future__ import annotations

import dataclasses
import functools

import numpy as np

from evflow.estimation.intervals import EDGES, Waits

Array = np.ndarray

PERIODS = np.geomspace(0.02, 60.0, 131)  # s, 1 / leak_hz: steps of a sixteenth
SPREADS = (0.04, 0.08, 0.14, 0.23, 0.32)  # std of the log of the period: v2e's pixels have .23
RATIOS = (0.15, 7.0)  # bounds on ON over OFF noise without leak
RATIO_STEPS = 6  # EM iterations
RATIO_SPREAD = 0.5  # prior std of its log
ODDS = 8.0  # log odds required to report leak
LEAST_EVENTS = 200.0  # leak events required to report its rate
MOST_HAZARD = 50.0  # per period: bounds the hazard in the tail
FLOOR = 0.05  # relative error: grid of periods, and other differences between pixels


@dataclasses.dataclass(frozen=True)
class Leak:
    """hz, std_hz: for a pixel without other events, 0 and NaN if undetermined; rate_hz: leak events
    per second that were seen, which are fewer because others reset the memory; events: their
    number.
    """

    hz: float = 0.0
    std_hz: float = float("nan")
    rate_hz: float = 0.0
    events: float = 0.0


def measured_leak(waits: Waits) -> Leak:
    """The leak that pixels show while nothing happens near them. Where the waits that began before
    the observation hide it, as of pixels that moving things left below their memory, which wait for
    longer than a period, it is that of the others."""
    found = _measured(np.concatenate([waits.own, waits.first], 1))
    if found.hz or not waits.first.any():
        return found
    return _measured(np.concatenate([waits.own, np.zeros_like(waits.first)], 1))


def _measured(tables: Array) -> Leak:
    """The leak of waits (3, 2 K), own ones and those that began before."""
    used = tables[0] > 0
    seconds, on, off = tables[:, used]
    if on.sum() < LEAST_EVENTS:
        return Leak()
    from scipy import special  # short recordings do not need it

    others = float(2.0 * (off.sum() + 0.5) / seconds.sum())
    grid = [(period, spread, fresh) for fresh in (False, True) for spread in SPREADS
            for period in PERIODS]
    leaked = seconds * np.stack([_hazards(*point, others)[used] for point in grid])
    likely, expected = _likelihood(leaked, on, off)
    best = int(np.argmax(likely))
    strange = _overdispersion(expected[:, best], on, off)
    none = _likelihood(np.zeros((1, len(on))), on, off)[0][0]
    total = special.logsumexp(likely / strange)
    # Of the hazard of one period and spread, tails of the pixels' real ones would be left out.
    events = float((on * leaked[best] / expected[0, best]).sum())
    if total - np.log(len(grid)) - none / strange < ODDS or events < LEAST_EVENTS:
        return Leak()
    weight, logs = np.exp(likely / strange - total), np.log([period for period, *_ in grid])
    mean = float(weight @ logs)
    error = float(np.hypot(np.sqrt(weight @ (logs - mean) ** 2), FLOOR))
    hz = float(np.exp(-mean))
    return Leak(hz, hz * error, events / float(seconds.sum()), events)


def _hazards(period: float, spread: float, fresh: bool, others: float) -> Array:
    """(2 K,) leak events per second of waiting, between EDGES: since the last event, and for pixels
    without an event since they are observed."""
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
    # More of the slower pixels are still waiting.
    waiting = weights[:, None] * np.maximum(1.0 - middle / periods, 1e-9)
    return np.concatenate([own, (waiting * hazard).sum(0) / waiting.sum(0)])


@functools.cache
def _nodes() -> tuple[Array, Array]:
    """Quadrature nodes of a standard normal, and their weights."""
    from scipy import special

    nodes, weights = special.roots_hermite(5)
    return np.sqrt(2.0) * nodes, weights / np.sqrt(np.pi)


def _likelihood(leaked: Array, on: Array, off: Array) -> tuple[Array, Array]:
    """(G,) log probability of the events for this much leak (G, K), at the most probable m at each
    time and ratio; and (2, G, K) the expected ON and OFF events."""
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


def _overdispersion(expected: Array, on: Array, off: Array) -> float:
    """Overdispersion: how much more the events scatter around the expected ones (2, K) than Poisson
    counts; at least 1."""
    many = expected.min(0) > 5.0
    if not many.any():
        return 1.0
    away = (np.stack([on, off]) - expected) ** 2 / expected
    return max(1.0, float(away[:, many].sum() / many.sum()))
