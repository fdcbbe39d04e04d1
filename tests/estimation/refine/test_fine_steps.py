"""Positions in fine steps and seconds, where frames are not evenly spaced."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from evflow.estimation.refine.fine_steps import evenly, later, seconds_at
from evflow.estimation.refine.receptor_data import Sample
from evflow.estimation.refine.waiting import without_waiting

DT_S = np.repeat([0.005, 0.015], 4).astype(np.float32)  # frames 20 and 60 ms apart, four steps each


def test_seconds_follow_the_frames() -> None:
    np.testing.assert_allclose(seconds_at([0.0, 1.0, 4.0, 5.0, 8.0], DT_S),
                               [0.0, 0.005, 0.02, 0.035, 0.08], rtol=1e-6)


def test_later_goes_on_at_the_pace_of_the_interval_it_is_in() -> None:
    np.testing.assert_allclose(later([0.0, 3.0, 4.0], DT_S, 0.01), [2.0, 4 + 1 / 3, 4 + 2 / 3],
                               rtol=1e-6)
    np.testing.assert_allclose(later([0.0, 8.0], DT_S, -0.015), [0.0, 7.0], atol=1e-6)
    at = np.linspace(0.0, 7.0, 30)
    np.testing.assert_allclose(later(later(at, DT_S, 0.007), DT_S, -0.007), at, atol=1e-5)


def test_a_path_is_evenly_spaced_in_time() -> None:
    seconds = seconds_at(np.arange(9), DT_S)
    path = np.stack([seconds, 3.0 - 2.0 * seconds], 1)
    even = np.linspace(0.0, 0.08, 9)
    np.testing.assert_allclose(evenly(path, DT_S), np.stack([even, 3.0 - 2.0 * even], 1),
                               atol=1e-7)


@pytest.mark.parametrize(("first", "apart_s", "waited"), [(0.5, 0.005, True), (4.5, 0.007, False)])
def test_an_event_waits_by_the_time_since_the_last(
    first: float, apart_s: float, waited: bool
) -> None:
    """Events 5 ms apart in the short interval, and 7 ms in the long one: of a mean step of 10 ms
    they would be 10 and 4.7 ms apart."""
    at = first + np.arange(3) * apart_s / DT_S[int(first)]
    columns = {name: jnp.zeros((1, 3)) for name in Sample._fields}
    data = Sample(**columns)._replace(
        dt_s=jnp.asarray(DT_S)[None], at=jnp.asarray(at)[None], weight=jnp.ones((1, 3)),
        pixel=jnp.zeros((1, 3), jnp.int32))
    weight = np.asarray(without_waiting(data, 0.005).weight[0])
    np.testing.assert_array_equal(weight < 0.5, [False, waited, waited])
