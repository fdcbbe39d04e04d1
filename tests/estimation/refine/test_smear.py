"""The mean of what a pixel fresh_probability, against a dense integral."""

from __future__ import annotations

import numpy as np
import pytest

from evflow.estimation.refine.smear import smeared


@pytest.mark.parametrize("length", [0.3, 2.0, 30.0])
def test_it_is_the_mean_over_the_time(length: float) -> None:
    rng = np.random.default_rng(0)
    pixel = rng.integers(0, 7, 60)
    at, counts = rng.uniform(0.0, 10.0, 60), rng.normal(size=60)
    found = smeared(pixel, at, counts, length)
    for i in range(60):
        own = pixel == pixel[i]
        order = np.argsort(at[own])
        dense = at[i] + length * (np.arange(4000) + 0.5 - 2000) / 4000
        expected = np.interp(dense, at[own][order], counts[own][order]).mean()
        assert found[i] == pytest.approx(expected, abs=2e-3)


def test_a_lone_event_stays_what_it_is() -> None:
    np.testing.assert_allclose(smeared(np.array([3]), np.array([1.0]), np.array([2.5]), 4.0), 2.5)
    assert smeared(np.zeros(0, int), np.zeros(0), np.zeros(0), 1.0).shape == (0,)
