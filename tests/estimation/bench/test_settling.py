"""Slow pixels: how long they go on sending a step's events after the light rests."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from helpers.benches import SHAPE, screen

from evflow import Events, Recording, simulate
from evflow.camera import Camera
from evflow.camera.sensors import SensorModel
from evflow.estimation.bench.calibration import calibrate_step
from evflow.estimation.bench.levels import cutoff_hz
from evflow.estimation.bench.settling import SETTLE_US, settled_at, settling_us

SPANS = [(300_000 * k, 300_000 * k + 280_000) for k in range(5)]


def decaying(tau_us: float) -> Events:
    """Noise of 1 kHz, and 2,000 events from the begin of each rest on, which become fewer."""
    rng = np.random.default_rng(0)
    t = np.concatenate([rng.integers(0, SPANS[-1][1], SPANS[-1][1] // 1000),
                        *(a + rng.exponential(tau_us, 2000) for a, _ in SPANS[1:])])
    t = np.sort(t[t < SPANS[-1][1]]).astype(np.int64)
    x, y = rng.integers(0, [SHAPE[1], SHAPE[0]], (len(t), 2)).T
    return Events(x, y, t, rng.random(len(t)) < 0.5, SHAPE[::-1])


@pytest.mark.parametrize(("tau_ms", "settle_ms", "slow"), [
    (2, 20, False), (15, 68, False), (200, 140, True)])
def test_a_step_lasts_until_the_rate_is_that_of_the_noise(
    tau_ms: float, settle_ms: float, slow: bool
) -> None:
    settle, notes = settling_us(decaying(1000 * tau_ms), SPANS)
    assert settle == pytest.approx(1000 * settle_ms, rel=0.02)
    assert [n.code for n in notes] == ["steps.slow"] * slow
    assert settled_at([(0, 30_000)], SETTLE_US) == [15_000]


def test_slow_pixels_have_the_thresholds_of_fast_ones() -> None:
    """A low-pass of 40 Hz, of 7 Hz at 30 DN: its last events come 70 ms after the light rests."""
    rng = np.random.default_rng(0)
    camera = Camera(*(np.float32(theta * (1 + 0.1 * rng.standard_normal(SHAPE)))
                      for theta in (0.25, 0.3)), *np.full((2, *SHAPE), 0.2, np.float32))
    dn = screen([30, 220, 60, 220, 30, 130, 30], rest=250, ramp=2)
    t = 1000 * np.arange(len(dn))
    frames = np.broadcast_to(dn[:, None, None], (len(dn), *SHAPE))
    events = simulate(jax.random.key(0), frames, t, camera, model=SensorModel(cutoff_hz=40.0))
    found = calibrate_step(Recording(events, np.ascontiguousarray(frames[::10]), t[::10]))
    assert float(found.summary.theta_on) == pytest.approx(0.25, rel=0.05)
    assert float(found.summary.theta_off) == pytest.approx(0.3, rel=0.05)
    assert float(found.summary.eta_off) == pytest.approx(0.2, rel=0.2)
    assert found.notes == ()
    assert found.bench is not None
    assert cutoff_hz(found.bench.levels[0].down_s) < 1.1 * 40.0 * 50.0 / 275.0
