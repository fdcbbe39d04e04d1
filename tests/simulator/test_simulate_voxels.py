"""Voxels made without events are the voxels of the events, under jit, vmap and leading axes."""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.videos import SHAPE, drifting, milliseconds

from evflow.camera import Camera, CameraPrior
from evflow.camera.sensors import SensorModel
from evflow.light.log_maps import to_log
from evflow.simulator import sensor, simulate, simulate_counts, simulate_voxels
from evflow.simulator.bins import hat_sums
from evflow.simulator.voxels import _voxels
from evflow.types import Events
from evflow.voxel import voxelize

KEY = jax.random.key(0)
PRIOR = CameraPrior(theta=(0.15, 0.3), mismatch=(0.03, 0.03), noise="none")
QUIET = Camera.sample(jax.random.key(1), SHAPE, PRIOR)
NOISY = dataclasses.replace(QUIET, eta_on=QUIET.eta_on + 30.0, eta_off=QUIET.eta_off + 15.0)
SENSITIVE = Camera.constant(SHAPE, 0.06, 0.09)
ALL_ON = SensorModel(cutoff_hz=200.0, leak_hz=20.0, leak_jitter=0.2, leak_fpn_decades=0.2,
                     shot_hz=40.0, eta_intensity=True, noise_resets_memory=True)
FRAMES = drifting(33)


def both(camera: Camera, model: SensorModel, frames: np.ndarray, dt_us: int,
         bins: int = 16) -> tuple[np.ndarray, np.ndarray, Events]:
    """(voxels of the events, voxels without events, the events). Event times are rounded up to
    the next microsecond and lie in (t_prev, t]; one less puts them into the half-open window."""
    times = dt_us * np.arange(len(frames))
    events = simulate(KEY, frames, times, camera, model=model)
    events = dataclasses.replace(events, t=events.t - 1)
    light = frames if frames.dtype == np.uint8 else to_log(frames, model.log_map)
    direct = simulate_voxels(KEY, light, camera, frame_dt_s=dt_us * 1e-6, model=model, bins=bins)
    return voxelize(events, 0, int(times[-1]), bins), np.asarray(direct), events


def agree(a: np.ndarray, b: np.ndarray, events: Events, window_us: int, bins: int = 16) -> None:
    """Each event may be off by a microsecond: a bin by (bins - 1) / window for each event that
    touches it, and those number at most its own weight and its two neighbours'."""
    assert (a.shape, b.shape, b.dtype) == ((*SHAPE, 2 * bins),) * 2 + (np.float32,)
    grid = np.pad(a.reshape(*SHAPE, 2, bins), ((0, 0), (0, 0), (0, 0), (1, 1)))
    touching = (grid[..., :-2] + grid[..., 1:-1] + grid[..., 2:]).reshape(a.shape)
    excess = np.abs(a - b) - (bins - 1) / window_us * touching
    assert excess.max() < 2e-4
    counts = np.moveaxis(b.reshape(*SHAPE, 2, bins).sum(-1), -1, 0)
    np.testing.assert_allclose(counts, events.count_map(), atol=1e-3)


@pytest.mark.parametrize(("camera", "model", "dtype"), [
    (QUIET, SensorModel(), np.float32), (NOISY, SensorModel(), np.uint8),
    (NOISY, SensorModel(timestamps="v2e"), np.float32), (NOISY, ALL_ON, np.float32),
    (NOISY, ALL_ON, np.uint8)])
def test_voxels_are_those_of_the_events(
    camera: Camera, model: SensorModel, dtype: type
) -> None:
    ours, direct, events = both(camera, model, FRAMES.astype(dtype), 1000)
    assert len(events) > 1000
    assert min(events.p.sum(), (~events.p).sum()) > 300
    agree(ours, direct, events, 32_000)


@pytest.mark.parametrize(("count", "dt_us", "bins", "refractory_s", "dtype"), [
    (65, 500, 16, 4e-4, np.float32), (11, 3000, 16, 4e-4, np.uint8),
    (2, 30_000, 2, 2.5e-3, np.float32), (2, 30_000, 2, 2.5e-3, np.uint8)])
def test_any_number_of_frames_and_bins_and_dead_times(
    count: int, dt_us: int, bins: int, refractory_s: float, dtype: type
) -> None:
    """Many events per interval, so that pixels wait: late, on time, and from late to on time."""
    frames = drifting(count, speed=4.0 / count + 0.5).astype(dtype)
    ours, direct, events = both(SENSITIVE, SensorModel(refractory_s=refractory_s), frames, dt_us,
                                bins)
    assert len(events) > 500
    agree(ours, direct, events, dt_us * (count - 1), bins)


@pytest.mark.parametrize("refractory_s", [5e-4, 2e-4])
def test_slots_that_tie_with_the_dead_time_are_those_of_the_events(refractory_s: float) -> None:
    """Rounding alone decides, so that every frame's time must be the same to the last bit."""
    frames = np.random.default_rng(0).integers(0, 256, (41, 8, 16)).astype(np.uint8)
    camera = Camera.constant((8, 16), 0.2, 0.3)
    model = SensorModel(timestamps="v2e", refractory_s=refractory_s)
    events = simulate(KEY, frames, milliseconds(41), camera, model=model)
    grid = simulate_voxels(KEY, frames, camera, frame_dt_s=1e-3, model=model)
    counts = simulate_counts(KEY, frames, camera, frame_dt_s=1e-3, model=model)
    of_grid = np.asarray(grid).reshape(8, 16, 2, 16).sum(-1)
    np.testing.assert_allclose(np.moveaxis(of_grid, -1, 0), events.count_map(), atol=1e-3)
    np.testing.assert_array_equal(np.moveaxis(np.asarray(counts), -1, 0), events.count_map())


def test_windows_one_after_another_keep_the_time() -> None:
    """Seconds as pairs: what a sum loses to rounding is not lost."""
    times = sensor.frame_times(1e-3 / 3, 7)
    far = sensor.later(jnp.array([1000.0, 1e-5]), times)
    exact = 1000.0 + float(np.float32(1e-5)) + 1e-3 / 3 * np.arange(8)
    np.testing.assert_allclose(np.asarray(far, np.float64).sum(-1), exact, rtol=0, atol=1e-11)


def test_noise_with_several_events_an_interval() -> None:
    """Mean 2 per interval and polarity, where the loop over further events runs."""
    camera = Camera.constant(SHAPE, 0.2, 0.2, 2000.0, 2000.0)
    ours, direct, events = both(camera, SensorModel(), FRAMES, 1000)
    assert len(events) > 2 * 32 * 1.9 * np.prod(SHAPE)
    agree(ours, direct, events, 32_000)


@pytest.mark.parametrize("model", [
    SensorModel(), ALL_ON, SensorModel(kind="esim", log_map="log_eps"),
    SensorModel(kind="voltmeter")], ids=lambda m: m.kind)
def test_bytes_give_the_same_grid_as_their_logarithms(model: SensorModel) -> None:
    frames = FRAMES.astype(np.uint8)
    ours, theirs = (np.asarray(simulate_voxels(KEY, f, NOISY, frame_dt_s=1e-3, model=model))
                    for f in (frames, to_log(frames, model.log_map)))
    assert ours.sum() > 1000
    assert ours.shape == (*SHAPE, 32)
    np.testing.assert_allclose(ours, theirs, atol=1e-5)


@pytest.mark.parametrize("model", [SensorModel(), ALL_ON])
def test_bytes_within_a_program_are_those_outside(model: SensorModel) -> None:
    """Where the host cannot tell which pixels fire: in jit, in vmap, or beside what is traced."""
    frames = FRAMES.astype(np.uint8)
    call = partial(simulate_voxels, camera=NOISY, frame_dt_s=1e-3, model=model)
    ours, known = np.asarray(call(KEY, frames)), jnp.asarray(frames)
    for grid in (jax.jit(lambda key: call(key, frames))(KEY),
                 jax.vmap(lambda key: call(key, frames))(KEY[None])[0],
                 jax.jit(lambda one: one * call(KEY, known))(1.0)):
        np.testing.assert_allclose(ours, grid, atol=1e-5)
    batch = call(KEY, np.stack([frames] * 2))
    assert batch.shape == (2, *ours.shape)


LOG = to_log(FRAMES[:9])
call = partial(simulate_voxels, frame_dt_s=1e-3, bins=4)


def test_leading_axes_are_independent_videos() -> None:
    """(2, 2) videos with a camera each, then with one for all; each has its own key."""
    frames = jnp.stack([LOG, LOG, LOG + 0.1, LOG + 0.2]).reshape(2, 2, *LOG.shape)
    noise = jnp.array([200.0, 200.0, 400.0, 0.0]).reshape(2, 2, 1, 1) * jnp.ones((1, 1, *SHAPE))
    theta = jnp.broadcast_to(QUIET.theta_on, noise.shape)
    cameras = Camera(theta, theta, noise, noise)
    grids = call(KEY, frames, cameras)
    assert grids.shape == (2, 2, *SHAPE, 8)
    assert float(jnp.abs(grids[0, 0] - grids[0, 1]).mean()) > 0.1
    for i, key in enumerate(jax.random.split(KEY, 4)):
        at = (i // 2, i % 2)
        single = call(key, frames[at], jax.tree.map(lambda m: m[at], cameras))  # noqa: B023
        np.testing.assert_allclose(grids[at], single, atol=1e-5)
    shared = call(KEY, frames, Camera(*[QUIET.theta_on] * 2, *[jnp.zeros(SHAPE)] * 2))
    np.testing.assert_allclose(shared[1, 1], grids[1, 1], atol=1e-5)
    np.testing.assert_array_equal(shared[0, 0], shared[0, 1])


def test_vmap_over_cameras_and_jit_are_the_plain_call() -> None:
    """A traced camera might be noisy, so it takes the noisy path, and a silent one stays silent."""
    drawn = Camera.sample(jax.random.key(3), (2, *SHAPE), CameraPrior(eta_spread=0.2))
    cameras = jax.tree.map(lambda two, quiet: jnp.concatenate([two, quiet[None]]), drawn, QUIET)
    grids = jax.jit(jax.vmap(lambda c: call(KEY, LOG, c)))(cameras)
    for i, grid in enumerate(grids):
        alone = call(KEY, LOG, Camera(*(leaf[i] for leaf in jax.tree.leaves(cameras))))
        np.testing.assert_allclose(grid, alone, atol=1e-5)
    closed_over = jax.jit(lambda frames: call(KEY, frames, QUIET))(LOG)
    np.testing.assert_allclose(closed_over, grids[2], atol=1e-5)


def test_same_key_same_bytes_and_no_second_compilation() -> None:
    grids = [call(KEY, LOG, NOISY)]
    before = _voxels._cache_size()
    grids += [call(KEY, LOG, NOISY), call(jax.random.key(7), LOG, NOISY)]
    call(KEY, 0.9 * LOG, Camera.constant(SHAPE, 0.3, 0.2, 1.0, 2.0))
    call(KEY, np.asarray(LOG), jax.tree.map(np.asarray, NOISY))
    assert _voxels._cache_size() == before
    np.testing.assert_array_equal(grids[0], grids[1])
    assert not np.array_equal(grids[0], grids[2])


@pytest.mark.parametrize(("first", "spacing", "count", "width"), [
    (0.3, 0.21, 5, 3), (2.0, 0.0, 7, 4), (0.0, 0.5, 5, 3), (1.999, 0.001, 2, 4), (0.0, 1.0, 4, 4),
    (0.7, 0.3, 0, 2)])
def test_sums_of_hat_weights_are_those_of_the_single_events(
    first: float, spacing: float, count: int, width: int
) -> None:
    at = first + spacing * np.arange(count)
    expected = [np.maximum(0.0, 1.0 - np.abs(at - j)).sum() for j in range(width)]
    sums = hat_sums(width, jnp.float32(first), jnp.float32(spacing), jnp.float32(count))
    np.testing.assert_allclose(np.stack(sums), expected, atol=2e-5)


def test_the_interval_may_be_traced() -> None:
    frames = jnp.asarray(FRAMES, jnp.float32)
    made = jax.jit(simulate_voxels)(KEY, to_log(frames), QUIET, frame_dt_s=1e-3)
    plain = simulate_voxels(KEY, to_log(frames), QUIET, frame_dt_s=1e-3)
    np.testing.assert_allclose(made, plain, atol=1e-4)
    assert float(plain.sum()) > 100


def test_bytes_in_double_precision_mode_too() -> None:
    frames = FRAMES.astype(np.uint8)
    single = simulate_voxels(KEY, frames, QUIET, frame_dt_s=1e-3)
    with jax.enable_x64(True):
        np.testing.assert_allclose(simulate_voxels(KEY, frames, QUIET, frame_dt_s=1e-3), single,
                                   atol=1e-4)
