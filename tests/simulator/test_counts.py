"""Event counts: exact ones are the simulator's, smooth ones have gradients."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.videos import SHAPE, code_of, drifting, milliseconds

from evflow.camera import Camera, CameraPrior
from evflow.camera.sensors import SensorModel
from evflow.light.log_maps import to_log
from evflow.simulator import simulate, simulate_counts, simulate_voxels
from evflow.simulator.counts import soft_floor

KEY = jax.random.key(0)
PRIOR = CameraPrior(theta=(0.15, 0.3), mismatch=(0.03, 0.03), noise="none")
QUIET = Camera.sample(jax.random.key(1), SHAPE, PRIOR)
NOISY = dataclasses.replace(QUIET, eta_on=QUIET.eta_on + 300.0, eta_off=QUIET.eta_off + 150.0)
FRAMES = drifting(33)
LOG = to_log(FRAMES)
ALL = SensorModel(cutoff_hz=200.0, leak_hz=20.0, leak_fpn_decades=0.2, leak_jitter=0.1,
                  shot_hz=40.0, noise_resets_memory=True, refractory_s=3e-4)


@pytest.mark.parametrize(("camera", "model"), [
    (QUIET, SensorModel()), (NOISY, SensorModel()), (NOISY, ALL), (QUIET, SensorModel(kind="esim")),
    (NOISY, SensorModel(timestamps="v2e"))])
def test_exact_counts_are_those_of_the_events(camera: Camera, model: SensorModel) -> None:
    events = simulate(KEY, FRAMES, milliseconds(33), camera, model=model)
    counts = simulate_counts(KEY, to_log(FRAMES, model.log_map), camera, frame_dt_s=1e-3,
                             model=model)
    assert counts.shape == (*SHAPE, 2)
    np.testing.assert_array_equal(np.moveaxis(np.asarray(counts), -1, 0), events.count_map())


def test_whole_numbers_are_taken_as_what_they_are() -> None:
    frames = np.array([3, 4, 5, 3])[:, None, None] * np.ones((1, 3, 4), np.int32)
    ours, same = (simulate_counts(KEY, f, Camera.constant((3, 4), 0.2, 0.3), frame_dt_s=0.01)
                  for f in (frames, frames.astype(np.float32)))
    np.testing.assert_array_equal(ours, same)
    assert float(ours.min()) > 5
    wide = np.broadcast_to(np.full((10, 1, 1), 4.0, np.float16), (10, 64, 64))
    camera = Camera.constant((64, 64), 0.2, 0.3)
    assert simulate_counts(KEY, wide, camera, frame_dt_s=0.01).dtype == jnp.float32


@pytest.mark.parametrize("width", [0.01, 0.3, 1.0])
def test_soft_floor_steps_smoothly_and_keeps_the_mean(width: float) -> None:
    x = jnp.linspace(0.0, 6.0, 60_001)
    soft, hard = soft_floor(x, width), jnp.floor(x)
    assert float(jnp.diff(soft).min()) >= 0
    middle = slice(5_000, 55_001)  # from .5 to 5.5
    assert float(soft[middle].mean()) == pytest.approx(float(hard[middle].mean()), abs=1e-3)
    assert float(jnp.abs(soft - hard).max()) <= 0.51 + 0.5 * (width > 0.02)
    np.testing.assert_allclose(soft_floor(jnp.arange(7.0), width), jnp.arange(7.0) - 0.5, atol=1e-4)


def test_narrow_ramps_are_the_counts() -> None:
    exact = simulate_counts(KEY, LOG, QUIET, frame_dt_s=1e-3)
    narrow = simulate_counts(KEY, LOG, QUIET, frame_dt_s=1e-3, smooth=1e-3)
    assert float(jnp.abs(narrow - exact).mean()) < 0.01
    wide = simulate_counts(KEY, LOG, QUIET, frame_dt_s=1e-3, smooth=1.0)
    assert float(wide.sum()) == pytest.approx(float(exact.sum()), rel=0.05)


def test_smooth_noise_is_its_expectation() -> None:
    still = jnp.broadcast_to(LOG[:1], LOG.shape)
    counts = simulate_counts(KEY, still, NOISY, frame_dt_s=1e-3, smooth=0.5)
    np.testing.assert_allclose(counts, np.broadcast_to([300 * 0.032, 150 * 0.032], counts.shape),
                               rtol=1e-4)


@pytest.mark.parametrize("model", [
    SensorModel(),
    SensorModel(cutoff_hz=200.0, leak_hz=5.0, leak_fpn_decades=0.2, shot_hz=5.0),
    SensorModel(kind="esim")])
def test_gradients_are_those_of_finite_differences(model: SensorModel) -> None:
    """Of a weighted sum of counts, along each of the four maps, the contrast of the light, and each
    of the model's numbers."""
    weights = jax.random.uniform(jax.random.key(3), (*SHAPE, 2))
    numbers = {path[0].name: float(value)
               for path, value in jax.tree_util.tree_leaves_with_path(model)}
    start: tuple[Any, ...] = (NOISY, to_log(FRAMES, model.log_map), model)

    def total(camera: Camera, log: jax.Array, model: SensorModel) -> jax.Array:
        return jnp.sum(weights * simulate_counts(
            KEY, log, camera, frame_dt_s=1e-3, model=model, smooth=1.0))

    gradient = jax.jit(jax.grad(total, (0, 1, 2)))(*start)
    value = jax.jit(total)
    for part in ("theta_on", "theta_off", "eta_on", "eta_off", "light", *numbers):
        camera, light, of_model = jax.tree.map(jnp.zeros_like, start)
        if part == "light":
            light = start[1] - start[1].mean(0, keepdims=True)  # more contrast
        elif part in numbers:  # by a share of itself
            of_model = jax.tree_util.tree_map_with_path(
                lambda path, _: numbers[part] * (path[0].name == part), model)  # noqa: B023
        else:
            camera = dataclasses.replace(camera, **{part: jnp.ones(SHAPE)})
        tangent = camera, light, of_model
        slope = sum(float(jnp.vdot(g, t)) for g, t in zip(
            jax.tree.leaves(gradient), jax.tree.leaves(tangent), strict=True))
        step = {"eta_on": 1.0, "eta_off": 1.0, "light": 1e-3} | dict.fromkeys(numbers, 0.02)
        change = step.get(part, 2e-4)
        ahead, behind = (jax.tree.map(lambda a, t: a + s * t, start, tangent)  # noqa: B023
                         for s in (change, -change))
        difference = (float(value(*ahead)) - float(value(*behind))) / (2 * change)
        assert slope == pytest.approx(difference, rel=0.02, abs=1e-3 * abs(slope) + 1e-2), part


def test_more_sensitive_pixels_count_more() -> None:
    slope = jax.grad(lambda t: simulate_counts(
        KEY, LOG, Camera(t, QUIET.theta_off, QUIET.eta_on, QUIET.eta_off), frame_dt_s=1e-3,
        smooth=1.0)[..., 0].sum())(QUIET.theta_on)
    assert float((slope < 0).mean()) > 0.9


@pytest.mark.parametrize(("name", "value"), [
    ("theta_on", -0.05), ("theta_off", 0.0), ("eta_on", -1.0), ("theta_on", np.nan)])
def test_an_impossible_pixel_is_nan_where_nothing_can_be_refused(name: str, value: float) -> None:
    """Within jit: its counts and gradients, and those of no other pixel. Outside: EV014."""
    def total(values: jax.Array, smooth: float) -> tuple[jax.Array, jax.Array]:
        camera = dataclasses.replace(NOISY, **{name: values})
        counts = simulate_counts(KEY, LOG, camera, frame_dt_s=1e-3, smooth=smooth)
        return counts.sum(), counts

    sound = getattr(NOISY, name)
    wrong = sound.at[3, 4].set(value)
    assert code_of(lambda: total(wrong, 1.0)) == "EV014"
    assert code_of(lambda: simulate_voxels(KEY, LOG, dataclasses.replace(NOISY, **{name: wrong}),
                                           frame_dt_s=1e-3)) == "EV014"
    taught = jax.jit(jax.grad(total, has_aux=True), static_argnums=1)
    (gradient, counts), (_, whole) = (taught(values, 1.0) for values in (wrong, sound))
    here = np.zeros(SHAPE, bool)
    here[3, 4] = True
    np.testing.assert_array_equal(np.isnan(counts).all(-1), here)
    np.testing.assert_array_equal(np.isnan(gradient), here)
    np.testing.assert_allclose(counts[~here], whole[~here], rtol=0.1)  # noise knows the median
    np.testing.assert_array_equal(
        np.isnan(jax.jit(lambda v: total(v, 0.0)[1])(wrong)).all(-1), here)
    voxels = jax.jit(lambda v: simulate_voxels(KEY, LOG, dataclasses.replace(NOISY, **{name: v}),
                                               frame_dt_s=1e-3))(wrong)
    np.testing.assert_array_equal(np.isnan(voxels).all(-1), here)


def test_vmap_over_cameras() -> None:
    cameras = jax.tree.map(lambda m: jnp.stack([m, 1.5 * m]), NOISY)
    both = jax.vmap(lambda c: simulate_counts(KEY, LOG, c, frame_dt_s=1e-3))(cameras)
    np.testing.assert_array_equal(both[0], simulate_counts(KEY, LOG, NOISY, frame_dt_s=1e-3))


@pytest.mark.parametrize(("log", "options", "code"), [
    (LOG[0], {}, "EV002"), (LOG[:, :5], {}, "EV015"), (LOG, {"smooth": 2.0}, "EV020"),
    (LOG, {"smooth": 0.5, "model": SensorModel(refractory_s=1e-3)}, "EV020"),
    (LOG, {"model": SensorModel(kind="voltmeter")}, "EV020")])
def test_bad_input(log: jax.Array, options: dict[str, Any], code: str) -> None:
    assert code_of(lambda: simulate_counts(KEY, log, QUIET, frame_dt_s=1e-3, **options)) == code


@pytest.mark.parametrize("smooth", [0.0, 1.0])
def test_cameras_of_double_precision(smooth: float) -> None:
    log = to_log(drifting(8).astype(np.float32))
    camera = Camera.sample(jax.random.key(2), log.shape[1:])
    expected = simulate_counts(jax.random.key(1), log, camera, frame_dt_s=1e-3, smooth=smooth)
    with jax.enable_x64(True):
        double = jax.tree.map(lambda m: jnp.asarray(np.asarray(m), jnp.float64), camera)
        found = simulate_counts(jax.random.key(1), log, double, frame_dt_s=1e-3, smooth=smooth)
    np.testing.assert_allclose(found, expected, atol=1e-3)


def test_bytes_pass_through_the_log_map() -> None:
    raw = FRAMES.clip(0, 255).astype(np.uint8)
    counts = simulate_counts(KEY, raw, QUIET, frame_dt_s=1e-3)
    np.testing.assert_array_equal(counts, simulate_counts(KEY, to_log(raw), QUIET, frame_dt_s=1e-3))


@pytest.mark.parametrize(("change", "code"), [
    ({"log_frames": jnp.full((3, *SHAPE), jnp.nan)}, "EV007"),
    ({"log_frames": jnp.full((3, *SHAPE), 128.0)}, "EV003"),
    ({"frame_dt_s": -1e-3}, "EV020"), ({"frame_dt_s": np.nan}, "EV020"),
    ({"frame_dt_s": np.full(3, 1e-3)}, "EV020"), ({"frame_dt_s": "1e-3"}, "EV020"),
    ({"smooth": "1"}, "EV020"), ({"smooth": None}, "EV020"), ({"smooth": np.nan}, "EV020"),
    ({"key": 0}, "EV020"), ({"model": "v2e"}, "EV020"), ({"camera": {"theta_on": 0.2}}, "EV020"),
    ({"camera": dataclasses.replace(QUIET, eta_on=QUIET.eta_on + 1e7)}, "EV014")])
def test_bad_input_is_refused(change: dict[str, Any], code: str) -> None:
    given = {"key": KEY, "log_frames": LOG, "camera": QUIET, "frame_dt_s": 1e-3} | change
    assert code_of(lambda: simulate_counts(**given)) == code
