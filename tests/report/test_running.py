"""What two re-simulations share is what recording and re-simulation share, if all is true."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest

from evflow import Camera, CameraEstimate, Events, Recording, SensorModel, estimate_camera, simulate
from evflow.report.resimulate import Trial, resimulate
from evflow.report.running import running

SHAPE = (40, 56)
STEP_US = 2_000


@pytest.fixture(scope="module")
def film() -> tuple[np.ndarray, np.ndarray]:
    """A faint moving texture in DN, few events a pixel, and its times."""
    rng = np.random.default_rng(3)
    times = np.arange(0, 120_000, STEP_US)
    y, x = np.mgrid[:SHAPE[0], :SHAPE[1]]
    waves = [np.sin(u * (x + 1.5e-4 * times[:, None, None]) + v * y + 9.0 * u)
             for u, v in rng.normal(0.0, 0.25, (12, 2))]
    return (110.0 + 10.0 * np.sum(waves, 0)).clip(0.0, 255.0).astype(np.float32), times


@pytest.fixture(scope="module")
def found(film: tuple[np.ndarray, np.ndarray]) -> tuple[Camera, CameraEstimate]:
    """A camera, and an estimate that says just this."""
    camera = Camera.constant(SHAPE, theta_on=0.45, theta_off=0.4, eta_on=0.1, eta_off=0.1)
    some = estimate_camera(Recording(simulate(jax.random.key(5), *film, camera), *film),
                           pixel="ideal")
    return camera, dataclasses.replace(some, camera=camera, sensor=SensorModel(),
                                       hot=np.zeros(SHAPE, bool))


def trial_of(events: Events, film: tuple[np.ndarray, np.ndarray], found: CameraEstimate) -> Trial:
    return resimulate(Recording(events, *film), found, (0, len(film[1]) - 1), 0)


def test_a_running_camera_and_its_re_simulation_agree_as_two_re_simulations_do(
    film: tuple[np.ndarray, np.ndarray], found: tuple[Camera, CameraEstimate]
) -> None:
    camera, estimate = found
    pictures, times = zip(*running(jax.random.key(6), zip(*film, strict=True), camera),
                          strict=True)
    trial = trial_of(simulate(jax.random.key(7), np.stack(pictures), np.array(times), camera),
                     film, estimate)
    for key in ("on", "off"):
        assert trial.ceiling[key] < 0.9
        assert trial.numbers["counts"]["r"][key] == pytest.approx(trial.ceiling[key], abs=0.03)
    assert trial.numbers["space_time_r"] == pytest.approx(trial.ceiling["space_time_r"], abs=0.04)


def test_one_that_starts_at_the_first_frame_agrees_more(
    film: tuple[np.ndarray, np.ndarray], found: tuple[Camera, CameraEstimate]
) -> None:
    camera, estimate = found
    trial = trial_of(simulate(jax.random.key(7), *film, camera), film, estimate)
    assert trial.numbers["counts"]["r"]["both"] > trial.ceiling["both"] + 0.05


def test_memories_start_between_the_thresholds() -> None:
    camera = Camera.constant((30, 40), theta_on=0.3, theta_off=0.2)
    grey = np.full((30, 40), 100.0, np.float32)
    (first, _), (second, t_us) = running(jax.random.key(0), [(grey, 0), (grey, 9)], camera, 5.0)
    away = np.log((grey + 5.0) / (first + 5.0))
    assert -0.2 <= away.min() < -0.19
    assert 0.29 < away.max() <= 0.3001
    np.testing.assert_array_equal(second, grey)
    assert t_us == 9
