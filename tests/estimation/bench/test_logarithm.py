"""Which logarithm the pixels of a bench have where light is dark."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.benches import SHAPE, bench

import evflow
from evflow.camera import Camera
from evflow.camera.sensors import SensorModel
from evflow.estimation.bench.calibration import calibrate_step

DARK = [6, 15, 40, 6, 40, 15, 100, 6, 100, 15, 6]
RNG = np.random.default_rng(0)
CAMERA = Camera(*(np.float32(theta * (1 + 0.1 * RNG.standard_normal(SHAPE)))
                  for theta in (0.25, 0.3)), *np.zeros((2, *SHAPE), np.float32))


@pytest.mark.parametrize(("model", "log_map"), [
    (SensorModel(), "linlog"), (evflow.SENSORS["esim"].model, "log_eps")])
def test_the_logarithm_of_dark_light_is_that_of_the_steps(
    model: SensorModel, log_map: str
) -> None:
    """Thresholds are the same from frames and from a light meter."""
    recording = bench(CAMERA, DARK, model=model)
    for lux in ((), (0.6, 1.5, 4.0, 10.0)):
        found = calibrate_step(recording, lux=lux)
        assert float(found.summary.theta_on) == pytest.approx(0.25, rel=0.05)
        assert float(found.summary.theta_off) == pytest.approx(0.3, rel=0.05)
        assert found.sensor.log_map == log_map
        assert [n.code for n in found.notes] == ["pixels.log"] * (log_map == "log_eps")


def test_steps_between_two_levels_leave_it_open() -> None:
    found = calibrate_step(bench(CAMERA, [8, 40, 8, 40, 8]))
    text = next(n.text for n in found.notes if n.code == "levels.dark")
    assert "taken as linear, as v2e's: if they are logarithmic, θ ON is -" in text
    assert found.sensor.log_map == "linlog"
    metered = calibrate_step(bench(CAMERA, [8, 40, 8, 40, 8]), lux=(1.0, 5.0))
    assert "levels.dark" in [n.code for n in metered.notes]
    assert metered.sensor.log_map == "log_eps"
