"""Signals between events, averaged about frames."""

from __future__ import annotations

import numpy as np
import pytest

from evflow.estimation.refine.between_events import ARC, SPAN_US, changes, signals_of

TIMES_US = np.array([0.0, 20e3, 40e3, 60e3])


def drawn(t: np.ndarray, on: np.ndarray, at: np.ndarray) -> np.ndarray:
    """(2, n) ON and minus OFF counts at instants, drawn event by event."""
    total = np.zeros((2, len(t)))
    for i in range(len(on)):
        before = at[i - 1] if i else at[i] - 1.0
        since = max(before, at[i] - SPAN_US)
        share = np.clip((t - since) / (at[i] - since), 0.0, 1.0)
        sign = 1.0 if on[i] else -1.0
        total[0 if on[i] else 1] += sign * share
        if i and on[i] != on[i - 1] and at[i] - before <= SPAN_US:
            total[1 if on[i] else 0] -= sign * ARC * share * (1.0 - share)
    return total


@pytest.mark.parametrize(("length_us", "delay_us"), [(500.0, 0.0), (12e3, 2e3), (30e3, -4e3)])
def test_means_are_those_of_the_drawn_signals(length_us: float, delay_us: float) -> None:
    """Of two pixels, by sums over instants."""
    rng = np.random.default_rng(0)
    rows = [(row, rng.random(12) > 0.5, np.sort(rng.uniform(-2e4, 8e4, 12))) for row in (3, 7)]
    events = (np.repeat([3, 7], 12), *(np.concatenate([row[k] for row in rows]) for k in (1, 2)))
    interval, place = np.repeat(np.arange(3), 2), np.tile([7, 3], 3)
    seen = signals_of(TIMES_US, interval, place, events, (30e3, 30e3))
    found = changes(seen, length_us, delay_us)
    assert found.shape == (2, 6)
    for k in range(6):
        _, on, at = rows[0 if place[k] == 3 else 1]
        before, after = (
            drawn(TIMES_US[i] + delay_us + length_us * (np.arange(4000) / 4000 - 0.49988), on, at)
            .mean(1) for i in (interval[k], interval[k] + 1))
        np.testing.assert_allclose(found[:, k], after - before, atol=2e-3)


def test_events_out_of_reach_are_left_out() -> None:
    at = np.arange(-90e3, 150e3, 1e3)
    events = np.zeros(len(at), np.int64), np.ones(len(at), bool), at
    seen = signals_of(TIMES_US, np.array([1]), np.array([0]), events, (10e3, 5e3))
    assert seen.at_us.min() >= 0.0
    assert seen.since_us.max() <= 60e3
    assert changes(seen, 10e3, 0.0)[0, 0] == pytest.approx(20.0)


def test_a_pixel_without_events_has_no_changes() -> None:
    events = np.array([2]), np.array([True]), np.array([10e3])
    seen = signals_of(TIMES_US, np.array([0, 0]), np.array([[1, 2], [9, 2]]), events, (1e4, 1e4))
    np.testing.assert_allclose(changes(seen, 1e3, 0.0)[0], [[0.0, 1.0], [0.0, 1.0]])
