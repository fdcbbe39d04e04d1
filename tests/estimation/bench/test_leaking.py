"""Leak between the steps of a bench: what it sends at rest, and what the steps lack of it."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from helpers.benches import SHAPE, bench, cameras

from evflow.camera import Camera
from evflow.camera.sensors import SensorModel
from evflow.estimation.bench import calibration
from evflow.estimation.bench.calibration import calibrate_step
from evflow.estimation.bench.leaking import NO_LEAK, Leaking, measured_leaking
from evflow.estimation.result import CameraEstimate
from evflow.report.bench import write_bench_report
from evflow.types import Events, Recording

LEVELS = [25.0, 225.0, 64.0, 160.0, 40.0, 100.0, 225.0, 40.0, 100.0, 25.0, 64.0, 225.0] * 2
LEAK_HZ = 1.0


@pytest.fixture(scope="module")
def leaking() -> tuple[Recording, Camera]:
    camera = cameras(0.03)
    model = SensorModel(leak_hz=LEAK_HZ, noise_resets_memory=True)
    return bench(camera, LEVELS, model=model), camera


def away(found: CameraEstimate, camera: Camera, name: str) -> float:
    """Relative error of a threshold's median over pixels."""
    return float(np.median(getattr(found.camera, name)) / np.median(getattr(camera, name))) - 1.0


def test_leak_and_thresholds_are_told_apart(leaking: tuple[Recording, Camera]) -> None:
    found = calibrate_step(leaking[0])
    assert abs(away(found, leaking[1], "theta_on")) < 0.025
    assert abs(away(found, leaking[1], "theta_off")) < 0.015
    assert abs(found.sensor.leak_hz - LEAK_HZ) < 2 * found.sensor_std["leak_hz"]
    assert found.sensor_std["leak_hz"] < 0.2 * LEAK_HZ
    assert abs(float(found.summary.eta_on) - LEAK_HZ) < 2 * float(found.summary_std.eta_on)
    assert found.sensor.eta_is_all
    assert "events.gaps" not in [note.code for note in found.notes]


def test_the_report_has_the_leak(leaking: tuple[Recording, Camera], tmp_path: Path) -> None:
    found = calibrate_step(leaking[0])
    for with_leak in (True, False):
        shown = found if with_leak else dataclasses.replace(
            found, sensor=SensorModel(noise_resets_memory=True))
        path = tmp_path / f"{with_leak}.html"
        write_bench_report(path, shown, leaking[0])
        assert ("leak, a part of the noise ON" in path.read_text()) == with_leak


def test_leak_taken_for_noise_lowers_the_threshold(
    leaking: tuple[Recording, Camera], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(calibration, "measured_leaking", lambda *_: NO_LEAK)
    assert away(calibrate_step(leaking[0]), leaking[1], "theta_on") < -0.03


@pytest.mark.parametrize("resets", [True, False])
def test_noise_that_any_rest_shows_is_no_leak(resets: bool) -> None:
    camera = cameras(0.03)
    noisy = dataclasses.replace(camera, eta_on=jnp.full(SHAPE, 3.0), eta_off=jnp.full(SHAPE, 1.0))
    found = calibrate_step(bench(
        noisy, LEVELS, model=SensorModel(noise_resets_memory=resets, eta_intensity=False)))
    assert found.sensor.leak_hz == 0.0
    assert not found.sensor.eta_is_all
    assert abs(float(found.summary.eta_on) - 3.0) < 3 * float(found.summary_std.eta_on)


def sent(rates: list[tuple[float, float]], up: list[bool], seconds: float = 1.0) -> Leaking:
    """The leak of 100 pixels whose ON and OFF rates (Hz) at rests after steps are these."""
    rng, columns = np.random.default_rng(0), []
    for k, rate in enumerate(rates):
        for side, hz in enumerate(rate):
            n = rng.poisson(100 * hz * seconds)
            t = 1e6 * (k + rng.random(n)) * seconds
            columns.append(np.stack([rng.integers(0, 10, n), rng.integers(0, 10, n), t,
                                     np.full(n, side == 0)]))
    x, y, t, p = np.concatenate(columns, 1).astype(np.int64)
    order = np.argsort(t, kind="stable")
    events = Events(x[order], y[order], t[order], p[order] > 0, (10, 10))
    spans = [(int(1e6 * k * seconds), int(1e6 * (k + 1) * seconds)) for k in range(len(rates))]
    return measured_leaking(events, spans, np.array(up), np.ones((10, 10), bool))


def test_leak_is_what_rises_add_to_the_noise_of_falls() -> None:
    rises, falls = (0.5, 0.2), (0.2, 0.2)
    found = sent([falls, *[rises, falls] * 20], [True, False] * 20)
    assert abs(found.hz - 0.3) < 2 * found.std_hz
    assert found.noise_hz == pytest.approx(0.2, rel=0.2)
    assert found.share == pytest.approx(0.6, rel=0.15)


@pytest.mark.parametrize("risen", [(0.5, 0.25), (0.5, 1.0)])
def test_noise_of_both_polarities_that_differs_with_the_direction_is_no_leak(
    risen: tuple[float, float]
) -> None:
    """As by light, or as a comparator's, which fires to the side of the last change."""
    assert sent([(0.25, 0.5), *[risen, (0.25, 0.5)] * 20], [True, False] * 20).hz == 0.0


def test_steps_of_one_direction_tell_nothing() -> None:
    assert sent([(0.5, 0.2)] * 4, [True] * 3).hz == 0.0


def test_what_leaked_since_the_memory_was_set_adds_to_a_step() -> None:
    found, rests = Leaking(0.4, 0.02, 0.1), np.zeros((2, 2, 1, 2), int)
    rests[1, 0, 0, 1] = 1
    times = np.array([0.5, 1.0]), np.array([[[0.5, 0.5]], [[1.0, 0.25]]])
    stored = found.brought_forward(*times, rests, stores=True)
    np.testing.assert_allclose(stored[:, 0], [[0.2, 0.2], [0.4, 0.1]])
    counted = found.brought_forward(*times, rests, stores=False)
    np.testing.assert_allclose(counted[:, 0], [[0.2, 0.2], [0.4, 0.4 - 0.8]])
