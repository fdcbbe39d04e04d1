"""The dead time, from intervals that are drawn here."""

from __future__ import annotations

import numpy as np
import pytest

from evflow.estimation.dead_time import dead_time, own_intervals
from evflow.types import Events

PIXELS, EACH = 400, 40


def stream(intervals_us: np.ndarray) -> Events:
    """Events of PIXELS pixels whose intervals (PIXELS, EACH) in microseconds are given."""
    rng = np.random.default_rng(5)
    t = rng.integers(0, 50_000, (PIXELS, 1)) + np.cumsum(np.maximum(np.rint(intervals_us), 1), 1)
    pixel = np.broadcast_to(np.arange(PIXELS)[:, None], t.shape)
    order = np.argsort(t.ravel(), kind="stable")
    x, y = pixel.ravel()[order] % 20, pixel.ravel()[order] // 20
    p = rng.random(len(order)) < 0.5
    return Events(x, y, t.ravel()[order].astype(np.int64), p, (20, 20))


def wanted(scale_us: float = 1500.0) -> np.ndarray:
    """Intervals (PIXELS, EACH) without a dead time, whose density rises as a pixel's does."""
    return np.random.default_rng(0).gamma(3.0, scale_us, (PIXELS, EACH))


@pytest.mark.parametrize("dead_us", [300, 1000, 5000])
@pytest.mark.parametrize("lost", [False, True])
def test_it_is_found_whether_events_wait_or_are_lost(dead_us: int, lost: bool) -> None:
    free = wanted(dead_us)
    intervals = np.maximum(free, dead_us)
    if lost:  # what is too short never is, and the next change of light comes later
        intervals = np.where(free < dead_us, np.random.default_rng(1).uniform(
            dead_us, 4 * dead_us, free.shape), free)
    found = dead_time(stream(intervals))
    assert found.measured
    assert abs(found.seconds * 1e6 - dead_us) < 0.05 * dead_us
    assert found.edge_s == found.seconds
    assert found.std_s < 0.1 * found.seconds


def test_noise_that_does_not_know_it_does_not_hide_it() -> None:
    intervals = np.maximum(wanted(), 2000.0)
    noise = np.random.default_rng(2).random(intervals.shape) < 0.02
    found = dead_time(stream(np.where(noise, 100.0, intervals)))
    assert abs(found.seconds - 2e-3) < 1e-4


@pytest.mark.parametrize("intervals", [
    wanted(), np.full((PIXELS, EACH), 10_000.0),  # none; a lamp's flicker, or frames
    1000.0 * np.ceil(wanted() / 1000.0),  # times in steps of a millisecond
    np.random.default_rng(3).exponential(4000.0, (PIXELS, EACH)),  # noise
    6000.0 * np.random.default_rng(3).random((PIXELS, EACH)) ** 0.07,  # many by degrees
    np.maximum(wanted(), 800.0)[:, :2]], ids=["none", "flicker", "steps", "noise", "tail", "few"])
def test_without_an_edge_nothing_is_said(intervals: np.ndarray) -> None:
    whole = np.full((PIXELS, EACH), 1e5) if intervals.shape[1] < EACH else intervals.copy()
    whole[:, :intervals.shape[1]] = intervals
    found = dead_time(stream(whole))
    assert not found.measured
    assert np.isnan(found.std_s)
    assert found.edge_s == 0.0


def test_a_hot_pixel_that_fires_like_a_clock_is_no_dead_time() -> None:
    """Neither are a few of them."""
    whole = np.random.default_rng(3).exponential(40_000.0, (PIXELS, EACH))
    whole[:8] = np.random.default_rng(4).uniform(2000.0, 2100.0, (8, EACH))
    assert not dead_time(stream(whole)).measured


@pytest.mark.parametrize("wide", [1.05, 1.2])
@pytest.mark.parametrize("share", [0.1, 0.2, 1.0])
def test_the_edge_of_a_lamp_s_light_is_no_dead_time(share: float, wide: float) -> None:
    """Intervals of 450 us and a little more, in a part of the view; a dead time is everywhere.
    Yet a dead time may show in a part alone, so the edge is told."""
    rng, intervals = np.random.default_rng(6), wanted(4000.0)
    intervals = np.maximum(intervals, 600.0)
    lit = np.arange(PIXELS) < share * PIXELS
    edge = 450.0 * rng.uniform(1.0, wide, (PIXELS, EACH))
    often = rng.random((PIXELS, EACH)) < 0.7
    found = dead_time(stream(np.where(lit[:, None] & often, edge, intervals)))
    assert found.measured == (share == 1.0)
    assert found.edge_s == pytest.approx(450e-6, rel=0.02)


def test_intervals_are_a_pixel_s_own() -> None:
    events = Events(np.array([1, 2, 1, 1]), np.zeros(4, int), np.array([0, 5, 30, 100]),
                    np.array([1, 0, 1, 0], bool), (4, 2))
    assert sorted(own_intervals(events)[0]) == [30, 70]
    assert len(own_intervals(events.slice(0, 0))[0]) == 0
    assert not dead_time(events.slice(0, 0)).measured


def test_the_shortest_usual_intervals_are_known_without_a_dead_time() -> None:
    """They bound the dead time of a pixel that begins anew after it."""
    intervals = wanted()
    found = dead_time(stream(intervals))
    assert not found.measured
    assert found.shortest_s == pytest.approx(1e-6 * np.quantile(intervals[:, 1:], 0.01), rel=0.05)
    assert dead_time(Events([], [], [], [], (20, 20))).shortest_s == 0.0
