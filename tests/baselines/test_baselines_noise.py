"""Closed forms of two simulators' noise, against the simulators."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from evflow import simulate
from evflow.baselines import v2e_noise, voltmeter_noise
from evflow.camera import Camera
from evflow.camera.sensors import DVS240, DVS346, SensorModel, Voltmeter

LIGHT = np.array([10.0, 80.0, 160.0, 250.0])
SIDE = 32  # pixels of a band: 32 x 32 per luminance


def rest(seconds: float, intervals: int) -> tuple[np.ndarray, np.ndarray]:
    """Frames and times of four bands at rest."""
    frames = np.broadcast_to(np.repeat(LIGHT, SIDE).astype(np.float32),
                             (intervals + 1, SIDE, 4 * SIDE))
    return frames, np.linspace(0, 1e6 * seconds, intervals + 1).round().astype(np.int64)


def rates(camera: Camera, model: SensorModel, seconds: float, intervals: int) -> np.ndarray:
    """Measured rates (2, bands) in Hz."""
    frames, times = rest(seconds, intervals)
    counts = simulate(jax.random.key(3), frames, times, camera, model=model).count_map()
    return counts.reshape(2, SIDE, 4, SIDE).mean((1, 3)) / seconds


def test_v2e_noise_is_the_simulators() -> None:
    """Half of the rows at the nominal threshold, a quarter above and a quarter below; 30 000
    events in the least band."""
    row = np.where(np.arange(SIDE) < 8, 0.1, np.where(np.arange(SIDE) < 24, 0.2, 0.4))
    theta = np.broadcast_to(row[:, None], (SIDE, 4 * SIDE)).astype(np.float32)
    zero = jnp.zeros(theta.shape)
    camera = Camera(jnp.asarray(theta), jnp.asarray(theta), zero, zero)
    found = rates(camera, SensorModel(shot_hz=2.0), 100.0, 100)
    law = v2e_noise(row[:, None], LIGHT[None], nominal=0.2, rate_hz=2.0).mean(0)
    np.testing.assert_allclose(found, np.stack([law, law]), rtol=0.02)


@pytest.mark.parametrize("constants", [DVS346, DVS240])
def test_voltmeter_noise_is_the_simulators(constants: Voltmeter) -> None:
    """With the published constants: ON grows with light, OFF never comes."""
    camera = Camera.constant((SIDE, 4 * SIDE), 1 / constants.k1, 1 / constants.k1)
    model = SensorModel(kind="voltmeter", voltmeter=constants)
    on, off = (np.asarray(r) for r in voltmeter_noise(LIGHT, constants=constants))
    found = rates(camera, model, 200.0, 20)
    np.testing.assert_allclose(found[0], on, rtol=0.02)
    assert found[1].sum() == 0
    assert off.max() < 1e-30
    assert (np.diff(on) > 0).all()


def test_voltmeter_noise_at_other_thresholds() -> None:
    camera = Camera.constant((SIDE, 4 * SIDE), 0.1, 0.3)
    found = rates(camera, SensorModel(kind="voltmeter", voltmeter=DVS346), 200.0, 20)
    on, _ = voltmeter_noise(LIGHT, 0.1, 0.3)
    np.testing.assert_allclose(found[0], on, rtol=0.02)


def test_published_leak_rates() -> None:
    """DVS346 leaks .735 Hz at 127 DN, DVS240 6.5 Hz: drift over the threshold."""
    for constants, hz in ((DVS346, 0.735), (DVS240, 6.45)):
        on, _ = voltmeter_noise(127.0, constants=constants)
        assert float(on) == pytest.approx(hz, rel=0.01)


def test_both_polarities_against_a_random_walk() -> None:
    """Diffusion rules: a walk of fine steps between two unequal levels, restarted at 0; 19 000
    exits at the rarer one, so .7 % by chance."""
    noisy = Voltmeter(1.0, 20.0, 0.0, 1e-6, 0.0, 2.5e-3)  # 2 mu (A + B) / sigma² = .8
    a, b = 1.0, 1.5
    rng, dt = np.random.default_rng(0), 200.0
    x, counts, steps, settled = np.zeros(4000), np.zeros(2), 25_000, 5_000
    for k in range(steps):
        x += noisy.k4 * dt + noisy.k6 * np.sqrt(dt) * rng.standard_normal(len(x))
        # Levels seen at steps alone are overshot by .5826 of a step (Chernoff, Siegmund).
        over = 0.5826 * noisy.k6 * np.sqrt(dt)
        up, down = x > a - over, x < over - b
        if k >= settled:  # before, the slower exits are still to come
            counts += up.sum(), down.sum()
        x = np.where(up | down, 0.0, x)
    found = counts / (len(x) * (steps - settled) * dt * 1e-6)
    np.testing.assert_allclose([float(r) for r in voltmeter_noise(100.0, a, b, constants=noisy)],
                               found, rtol=0.02)


def test_driftless_limit() -> None:
    """mu = 0: rates B / (A + B) and A / (A + B) of sigma² / (A B); and no jump towards it."""
    still = Voltmeter(1.0, 20.0, 0.0, 0.0, 0.0, 1e-3)
    on, off = voltmeter_noise(0.0, 1.0, 3.0, constants=still)
    np.testing.assert_allclose([float(on), float(off)], [0.25, 1 / 12], rtol=1e-5)
    for drift in (1e-12, 1e-11, 1e-10, 1e-9):
        near = Voltmeter(1.0, 20.0, 0.0, drift, 0.0, 1e-3)
        moved = voltmeter_noise(0.0, 1.0, 3.0, constants=near)
        np.testing.assert_allclose([float(r) for r in moved], [0.25, 1 / 12], rtol=0.02)
