"""Pixels with a photoreceptor of second order, against integration by many short steps."""

from __future__ import annotations

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.videos import SHAPE, code_of, drifting, milliseconds

from evflow.camera import Camera
from evflow.camera.sensors import SecondOrder, SensorModel
from evflow.light.log_maps import lin_log
from evflow.simulator import simulate, simulate_counts, simulate_voxels
from evflow.simulator.constants import Constants
from evflow.simulator.second_order import Inner, at_rest, fire, follow
from evflow.voxel import voxelize

KEY = jax.random.key(0)
DEFAULT = SecondOrder()
RINGING = dataclasses.replace(DEFAULT, miller_s=0.0, output_s=3e-3)
# Poles at 500 per second, two of them of the photoreceptor at the light .4: all three coincide.
COINCIDENT = SecondOrder(0.4 * 99 / 500, 0.0, 1 / 49_500, 49.0, 49.0, 1 / 500)


def integrated(receptor: SecondOrder, light: np.ndarray, i01: np.ndarray, dt: float, fine: int
               ) -> np.ndarray:
    """The follower's output at the ends of intervals (T,), by the midpoint rule; float64."""
    r = receptor
    v, dv, out, found = float(light[0]), 0.0, float(light[0]), []
    h = dt / fine
    for k, i in enumerate(i01):
        tau_in, tau_mil = r.input_s / i, r.miller_s / i
        square = (r.loop_gain + 1) / ((tau_in + tau_mil) * r.output_s)
        friction = (tau_in + r.output_s + (r.gain + 1) * tau_mil) / (
            (tau_in + tau_mil) * r.output_s)

        def slopes(y: np.ndarray, u: float, p: float = friction, q: float = square) -> np.ndarray:
            return np.array([y[1], q * (u - y[0]) - p * y[1], (y[0] - y[2]) / r.follower_s])

        y = np.array([v, dv, out])
        for n in range(fine):
            ahead, middle = (light[k] + (light[k + 1] - light[k]) * (n + part) / fine
                             for part in (0.0, 0.5))
            half = y + 0.5 * h * slopes(y, ahead)
            y = y + h * slopes(half, middle)
        v, dv, out = y
        found.append(out)
    return np.array(found)


@pytest.mark.parametrize(("receptor", "dt"), [
    (DEFAULT, 1e-3), (DEFAULT, 2e-2), (RINGING, 1e-3), (RINGING, 1e-2), (COINCIDENT, 2e-3),
    (dataclasses.replace(DEFAULT, follower_s=4e-3), 5e-3)])
def test_photoreceptor_and_follower_are_exact_for_any_step(
    receptor: SecondOrder, dt: float
) -> None:
    light = np.array([3.0, 4.2, 4.3, 3.9, 5.2, 5.2, 3.2, 3.2])
    i01 = np.array([0.1, 0.4, 0.4, 0.4, 0.8, 1.0, 0.3])
    expected = integrated(receptor, light, i01, dt, max(200, int(dt * 2e5)))
    lp, inner, found = jnp.float32(light[0]), at_rest(jnp.float32(light[0])), []
    step = jax.jit(follow)
    for u, i in zip(light[1:], i01, strict=True):
        lp, inner = step(receptor, lp, inner, jnp.float32(u), jnp.float32(i), jnp.float32(dt))
        found.append(float(lp))
    np.testing.assert_allclose(found, expected, atol=2e-3)


def test_steps_of_light_in_the_dark_and_in_white() -> None:
    """In the dark a low-pass of first order whose corner is that of `at`; in white it may ring, by
    what its damping says."""
    def after(receptor: SecondOrder, i01: float, seconds: float) -> float:
        step = Inner(*map(jnp.float32, (1, 0, 0, 0)))
        return float(follow(receptor, jnp.float32(0.0), step, jnp.float32(1.0), jnp.float32(i01),
                            jnp.float32(seconds))[0])

    expected = 1 - np.exp(-2 * np.pi * 100.0 * 0.01 * 0.2)
    assert after(SecondOrder().at(100.0), 0.01, 0.2) == pytest.approx(expected, rel=0.02)
    frequency, damping = (50 / (0.03 * 3e-3)) ** 0.5, 0.5 * (0.03 + 3e-3) / (0.03 * 3e-3)
    ring = (frequency**2 - damping**2) ** 0.5
    most = 1 + np.exp(-np.pi * damping / ring)
    ringing = dataclasses.replace(RINGING, follower_s=0.0)
    assert after(ringing, 1.0, np.pi / ring) == pytest.approx(most, rel=1e-3)
    assert most > 1.3


@pytest.mark.parametrize(("refractory_s", "amplifier_s", "leak"), [
    (0.0, 1.6e-4, 0.0), (7e-4, 1.6e-4, 0.0), (0.0, 3e-3, 0.0), (5e-3, 1e-3, 0.0), (0.0, 0.0, 0.0),
    (0.0, 1.6e-4, 90.0), (7e-4, 1e-3, 90.0), (0.0, 3e-3, 300.0)])
def test_events_are_those_of_short_steps(
    refractory_s: float, amplifier_s: float, leak: float
) -> None:
    """Of an amplifier behind straight pieces, whose base falls by `leak` a second."""
    ends, dt, fine = np.array([0.0, 0.7, 0.75, 1.9, 0.9, 0.2, 0.2, 1.4]), 4e-3, 10_000
    model = SensorModel(refractory_s=refractory_s, photoreceptor=SecondOrder(
        amplifier_s=amplifier_s))
    base = y = 0.0
    last, expected = 1e6, []
    for k in range(len(ends) - 1):
        count = 0
        for n in range(1, fine + 1):
            x = ends[k] + (ends[k + 1] - ends[k]) * n / fine
            last += dt / fine
            if last < refractory_s:
                base = y = x
                continue
            share = 1 - np.exp(-dt / fine / amplifier_s) if amplifier_s else 1.0
            y += share * (x - y)
            base -= leak * dt / fine
            if abs(y - base) >= (0.13 if y > base else 0.17):
                count += 1 if y > base else -1
                base, y, last = x, x, 0.0
        expected.append(count)
    state = [jnp.float32(v) for v in (0.0, 0.0, 1e6)]
    found = []
    step = jax.jit(fire)
    for begin, end in itertools.pairwise(ends):
        out = step(Constants.of(model), jnp.float32(0.13), jnp.float32(0.17), *state,
                   jnp.float32(begin), jnp.float32(end), jnp.float32(dt),
                   jnp.float32(leak * dt) if leak else None)
        state = [out.base, out.amplified, out.last]
        found.append(int(out.count))
    assert sum(map(abs, expected)) > 3
    assert np.abs(np.subtract(found, expected)).max() <= 1
    assert abs(sum(map(abs, found)) - sum(map(abs, expected))) <= 1


@pytest.mark.parametrize("distance_us", [10_000, 1_000_000])
def test_leak_does_not_depend_on_the_frames_distance(distance_us: int) -> None:
    times = np.arange(0, 4_000_001, distance_us)
    still = np.full((len(times), 2, 2), 100, np.uint8)
    model = SensorModel(photoreceptor=DEFAULT.at(200.0), leak_hz=5.1)
    events = simulate(KEY, still, times, Camera.constant((2, 2), 0.2, 0.2), model=model)
    assert events.p.all()
    np.testing.assert_array_equal(events.count_map()[0], 20)
    assert np.diff(events.t[(events.x == 0) & (events.y == 0)]).std() < 5


@pytest.mark.parametrize("model", [
    pytest.param(SensorModel(photoreceptor=DEFAULT), marks=pytest.mark.slow),
    SensorModel(photoreceptor=DEFAULT.at(60.0), refractory_s=3e-3, leak_hz=9.0, leak_jitter=0.1,
                shot_hz=20.0, noise_resets_memory=True)])
def test_all_exits_have_the_same_events(model: SensorModel) -> None:
    """Those that pass over still pixels, and those that do not."""
    camera, frames = Camera.constant(SHAPE, 0.15, 0.2), drifting(33)
    events = simulate(KEY, frames, milliseconds(33), camera, model=model)
    counts = simulate_counts(KEY, lin_log(frames), camera, frame_dt_s=1e-3, model=model)
    np.testing.assert_array_equal(np.moveaxis(np.asarray(counts), -1, 0), events.count_map())
    assert len(events) > 500
    voxels = simulate_voxels(KEY, lin_log(frames), camera, frame_dt_s=1e-3, model=model)
    ours = voxelize(events, 0, 32_000)
    assert float(np.abs(ours - np.asarray(voxels)).mean()) < 2e-3


def test_it_is_for_pixels_that_have_one() -> None:
    for options in ({"kind": "paper"}, {"timestamps": "v2e"}, {"cutoff_hz": 9.0}):
        assert code_of(lambda options=options: SensorModel(
            photoreceptor=DEFAULT, **options)) == "EV020"
    assert code_of(lambda: SecondOrder(output_s=0.0)) == "EV020"
    still = np.full((3, *SHAPE), 4.0, np.float32)
    assert code_of(lambda: simulate_counts(
        KEY, still, Camera.constant(SHAPE), frame_dt_s=1e-3, smooth=1.0,
        model=SensorModel(photoreceptor=DEFAULT))) == "EV020"
    assert len(jax.tree.leaves(SensorModel(photoreceptor=DEFAULT))) == 7
