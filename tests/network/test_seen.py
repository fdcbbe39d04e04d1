"""Codes of slow pixels: the light of a window behind a photoreceptor."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.networks import small_params
from helpers.videos import code_of

from evflow.camera import Camera
from evflow.camera.optics import Optics
from evflow.camera.sensors import SensorModel
from evflow.light.log_maps import lin_log, to_log
from evflow.network import api
from evflow.network.seen import photoreceptor, seen_changes
from evflow.network.weights import load_weights
from evflow.simulator import simulate_voxels

SHAPE = (24, 32)
KEY = jax.random.key(0)
CAMERA = Camera.constant(SHAPE, 0.2, 0.25, 0.1, 0.1)
SLOW = SensorModel(cutoff_hz=40.0)
PER_PART = 8  # frames in each sixteenth of the window
WINDOW_S = 0.05


def pattern(brightness: float = 90.0) -> np.ndarray:
    """DN (T, H, W) of waves that pass within the window."""
    y, x = np.mgrid[:SHAPE[0], :SHAPE[1]]
    t = np.linspace(0.0, 1.0, 16 * PER_PART + 1)[:, None, None]
    return brightness * np.exp(np.sin(x / 3 - 6 * t) * np.cos(y / 4 + 2 * t) * 0.8)


def light(dn: np.ndarray) -> tuple[Any, Any]:
    """Changes (H, W, 16) and mean log intensity."""
    log = lin_log(dn[::PER_PART])
    return jnp.moveaxis(jnp.diff(log, axis=0), 0, -1), 0.5 * (log[0] + log[-1])


@pytest.mark.parametrize(("sensor", "optics"), [
    (SLOW, Optics()), (SensorModel(cutoff_hz=40.0, cutoff_by_light=False), Optics()),
    (SensorModel(cutoff_hz=200.0), Optics(offset_dn=24.0, delay_s=2.5e-3)),
    (SensorModel(), Optics(delay_s=-2e-3)), (SensorModel(), Optics(offset_dn=10.0)),
    (SensorModel(log_map="log_eps"), Optics()),
    (SensorModel(cutoff_hz=40.0, log_map="log_eps"), Optics(offset_dn=2.0))])
def test_changes_are_those_of_many_short_steps(sensor: SensorModel, optics: Optics) -> None:
    dn = pattern(15.0 if sensor.log_map == "log_eps" else 90.0)
    changes, intensity = light(dn)
    seen_by = photoreceptor(sensor, optics)
    found, middle = seen_changes(seen_by, changes, intensity, jnp.float32(WINDOW_S))
    steps = 4096
    at = np.linspace(0, 16, steps + 1)
    knots = np.asarray(lin_log(dn[::PER_PART]), np.float64)
    low = np.minimum(at.astype(int), 15)
    log = knots[low] + (at - low)[:, None, None] * (knots[low + 1] - knots[low])
    lit = np.where(log < np.log(20), log * 20 / np.log(20), np.exp(log)) + optics.offset_dn
    u = (np.log(lit + 0.255) if sensor.log_map == "log_eps"
         else np.where(lit < 20, lit * np.log(20) / 20, np.log(lit)))
    path = u.copy()
    if sensor.cutoff_hz:
        pace = (lit + 20) / 275 if sensor.cutoff_by_light else np.ones_like(lit)
        share = pace * 2 * np.pi * sensor.cutoff_hz * WINDOW_S / steps
        for i in range(steps):
            path[i + 1] = path[i] + share[i] * (u[i + 1] - path[i])
    when = np.clip(np.arange(17) / 16 - optics.delay_s / WINDOW_S, 0, 1) * steps
    expected = np.moveaxis(np.diff(path[np.rint(when).astype(int)], axis=0), 0, -1)
    np.testing.assert_allclose(found, expected, atol=0.012)
    assert np.abs(expected - changes).max() > 0.03  # it matters
    moved = np.abs(np.asarray(middle) - np.asarray(intensity)).max()
    assert moved > (0.05 if sensor.cutoff_hz == 40 else 0.003)


@pytest.mark.parametrize("sensor", [SLOW, SensorModel(cutoff_hz=15.0)])
def test_generated_events_of_slow_pixels_are_nearer_to_their_simulation(
    sensor: SensorModel
) -> None:
    dn = pattern()
    changes, intensity = light(dn)
    params = load_weights()
    made = [simulate_voxels(jax.random.fold_in(KEY, i), to_log(dn), CAMERA,
                            frame_dt_s=WINDOW_S / (len(dn) - 1), model=sensor) for i in range(2)]
    simulated = sum(made) / 2

    def distance(given: SensorModel | None, **early: Any) -> float:
        code = api.code_from_video(
            params, changes, CAMERA, window_s=WINDOW_S, intensity=intensity, **early)
        voxels = api.generate(params, KEY, CAMERA, code, sensor=given)
        return float(jnp.abs(voxels - simulated).mean())

    plain, slow, early = distance(None), distance(sensor), distance(None, sensor=sensor)
    assert slow < 0.8 * plain
    assert early == pytest.approx(slow, rel=1e-3)


def test_ideal_pixels_change_nothing() -> None:
    params, (changes, _) = small_params(), light(pattern())
    code = api.code_from_video(params, changes, CAMERA)
    again = api.code_from_video(params, changes, CAMERA, sensor=SensorModel(shot_hz=1.0),
                                optics=Optics())
    for a, b in zip(jax.tree.leaves(code), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(
        api.generate(params, KEY, CAMERA, code),
        api.generate(params, KEY, CAMERA, code, sensor=SensorModel(), optics=Optics()))


def test_a_logarithm_in_dark_light_alone_is_seen() -> None:
    """As by a pixel so fast that its low-pass changes nothing."""
    params, (changes, intensity) = small_params(), light(pattern())
    dark = intensity - 2.0
    alone, fast = (api.code_from_video(
        params, changes, CAMERA, intensity=dark, sensor=SensorModel(log_map="log_eps", cutoff_hz=hz)
    ).changes for hz in (0.0, 1e6))
    lin_log = api.code_from_video(params, changes, CAMERA, intensity=dark).changes
    np.testing.assert_allclose(alone, fast, atol=2e-3)
    assert float(jnp.abs(alone - lin_log).max()) > 0.01


def test_brightness_must_be_known() -> None:
    params, (changes, intensity) = small_params(), light(pattern())
    unlit = api.code_from_video(params, changes, CAMERA)
    assert code_of(lambda: api.generate(params, KEY, CAMERA, unlit, sensor=SLOW)) == "EV020"
    assert code_of(lambda: api.code_from_video(
        params, changes, CAMERA, optics=Optics(offset_dn=3.0))) == "EV020"
    some = jnp.where(jnp.arange(SHAPE[1]) < 3, jnp.nan, intensity)
    code = api.code_from_video(params, changes, CAMERA, intensity=some, sensor=SLOW)
    assert np.isfinite(code.changes).all()
    assert not np.asarray(code.context)[:, :3, 1:].any()


def test_circuits_may_be_traced() -> None:
    """A sample of each of many cameras: 0 is no low-pass."""
    params, (changes, intensity) = small_params(), light(pattern())

    def seen(cutoff_hz: Any) -> Any:
        return api.code_from_video(
            params, changes, CAMERA, window_s=WINDOW_S, intensity=intensity,
            sensor=SensorModel(cutoff_hz=cutoff_hz)).changes

    given = jnp.array([20.0, 300.0, 0.0])
    alone = [seen(hz) for hz in given.tolist()]
    np.testing.assert_allclose(jax.jit(jax.vmap(seen))(given), alone, atol=5e-3)
