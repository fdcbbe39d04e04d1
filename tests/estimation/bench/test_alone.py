"""Benches of which one polarity is not recorded."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from helpers.benches import bench, cameras

from evflow.estimation.bench.calibration import calibrate_step
from evflow.estimation.bench.steps import return_error, unrecorded
from evflow.types import Events

LEVELS = [25.0, 100.0, 225.0, 64.0, 160.0, 40.0, 100.0, 225.0, 40.0, 64.0, 160.0, 25.0, 225.0]


@pytest.mark.parametrize(("polarity", "name", "other"), [
    (True, "theta_on", "theta_off"), (False, "theta_off", "theta_on")])
def test_a_polarity_is_measured_without_the_other(polarity: bool, name: str, other: str) -> None:
    """The steps of the other were taken for steps without events: the threshold came out at two
    fifths of its value."""
    camera = cameras(0.03)
    whole = bench(camera, LEVELS)
    kept = whole.events.p == polarity
    columns = (getattr(whole.events, column)[kept] for column in ("x", "y", "t", "p"))
    found = calibrate_step(dataclasses.replace(whole, events=Events(*columns, whole.events.size)))
    value, error = (float(getattr(s, name)) for s in (found.summary, found.summary_std))
    truth = float(np.median(np.asarray(getattr(camera, name))))
    assert value == pytest.approx(truth, rel=0.08)
    assert abs(value - truth) < 1.5 * error
    assert found.undetermined == (other,)


def test_where_both_are_there_nothing_is_unrecorded() -> None:
    up, counts = np.array([True, False, True]), np.ones((3, 2, 2, 2))
    assert not unrecorded(up, counts).any()
    assert (return_error(up, counts) == 0.0).all()
    counts[:, 1] = 0.0
    assert unrecorded(up, counts).tolist() == [False, True, False]
    on, off = return_error(up, counts)
    assert on > 0.0
    assert off == 0.0
