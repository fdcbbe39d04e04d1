"""Correlation over cubes, against the dense one."""

from __future__ import annotations

import numpy as np
import pytest

from evflow.metrics.space_time import space_time_r
from evflow.types import Events


def drawn(seed: int, n: int = 4000) -> Events:
    rng = np.random.default_rng(seed)
    t = np.sort(rng.integers(500, 60_500, n))
    x = np.minimum(rng.integers(0, 31, n), rng.integers(0, 31, n))
    return Events(x, rng.integers(0, 19, n), t, rng.random(n) < 0.6, (31, 19))


def dense(events: Events) -> np.ndarray:
    cubes = np.zeros((31, 7, 11))  # 60.5 ms from 500 us on, cells of three
    np.add.at(cubes, ((events.t - 500) // 2000, events.y // 3, events.x // 3),
              np.where(events.p, 1, -1))
    return cubes.ravel()


def test_it_is_the_correlation_over_all_cubes() -> None:
    a, b = drawn(0), drawn(1)
    mixed = Events.concatenate([a.slice(500, 30_000), b.slice(30_000, 70_000)])
    expected = np.corrcoef(dense(a), dense(mixed))[0, 1]
    assert 0.3 < expected < 0.7
    assert space_time_r(a, mixed, 500, 62_500) == pytest.approx(expected, abs=1e-9)
    assert space_time_r(a, a, 500, 62_500) == pytest.approx(1.0)


def test_a_swapped_polarity_is_negative_and_nothing_is_none() -> None:
    a = drawn(2)
    swapped = Events(a.x, a.y, a.t, ~a.p, a.size)
    assert space_time_r(a, swapped, 500, 62_500) == pytest.approx(-1.0)
    assert space_time_r(a, a.slice(0, 0), 500, 62_500) is None
