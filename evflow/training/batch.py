"""Training data, made where it is used: scenes -> cameras -> voxels, one jitted program.

`sample_batch(key, bank, config)` is a pure function: step i of a run draws its batch from
fold_in(key, i), on any number of devices, and nothing touches the disk.
"""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from evflow.camera import THETA_MIN, Camera, Summary
from evflow.camera.sensors import SensorModel
from evflow.light.log_maps import lin_log, noise_factor, normalised_intensity
from evflow.process.devices import by_shard
from evflow.scenes import TextureBank, render, sample_scene, watch
from evflow.training.config import NuisanceConfig, TrainConfig

Array = jax.Array

FIXED = 11  # folded into the seed's key, for the fixed sequences of a run


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Batch:
    """B sequences of W windows of H x W' pixels.

    voxels (B, W, H, W', 32); dlogI (B, W, H, W') from the noisy 8-bit frames at the window's
    edges; changes (B, W, H, W', m) true signed log-intensity changes; intensity (B, W, H, W')
    mean log intensity of the two frames; window_s (B,); camera maps (B, H, W'); nominal: the
    sequence's true Summary (B,).
    """

    voxels: Array
    dlogI: Array
    changes: Array
    intensity: Array
    window_s: Array
    camera: Camera
    nominal: Summary


def sample_batch(key: Array, bank: TextureBank, config: TrainConfig) -> Batch:
    """Render `scenes` scenes, each seen by `cameras` cameras; B = scenes x cameras, the cameras of
    one scene side by side. Under a mesh every device makes its own scenes. With config.sequences
    the key chooses among that many fixed ones."""
    numbers = jnp.arange(config.scenes)
    if config.sequences:
        there = config.sequences // config.cameras
        numbers = jax.random.permutation(key, there)[:config.scenes]
        key = jax.random.fold_in(jax.random.key(config.seed), FIXED)

    def make(common: tuple[Array, TextureBank], numbers: Array) -> Batch:
        return _sample_scenes(*common, numbers, config)

    return by_shard(make)((key, bank), numbers)


def _sample_scenes(key: Array, bank: TextureBank, numbers: Array, config: TrainConfig) -> Batch:
    """The sequences of the scenes `numbers` (S,) of a batch. A scene depends only on key and
    number, so that a batch can be divided among devices."""
    each = jax.vmap(jax.random.fold_in, (None, 0))
    k_scene, k_window, k_camera = jax.random.split(key, 3)
    shape = (config.crop, config.crop)
    steps = config.windows * config.steps_per_window
    low, high = np.log(config.window_s[0]), np.log(config.window_s[1])
    window_s = jnp.exp(jax.vmap(lambda k: jax.random.uniform(k, minval=low, maxval=high))(
        each(k_window, numbers)))

    def scene_frames(key: Array, window_s: Array) -> tuple[Array, Array]:
        k_scene, k_seen = jax.random.split(key)
        scene = sample_scene(k_scene, bank, config.scene, shape)
        times = (jnp.arange(steps + 1) - 0.5 * steps) * (window_s / config.steps_per_window)
        frames, edges = render(scene, times, shape), slice(None, None, config.steps_per_window)
        if config.nuisances.sharp:
            return frames, frames[edges]
        n = config.nuisances
        exposures = watch.exposures(k_seen, times[edges], n.exposures, n.exposure_s, n.jitter_s)
        return frames, watch.exposed(scene, exposures, shape)

    frames, seen = jax.vmap(scene_frames)(each(k_scene, numbers), window_s)
    group = min(config.cameras, len(config.sensors))
    k_group, *k_sensors = jax.random.split(k_camera, group + 1)

    def look(*models: SensorModel) -> Batch:
        parts = []
        for key, model in zip(k_sensors, models, strict=True):
            keys = jax.vmap(lambda k: jax.random.split(k, config.cameras // group))(
                each(key, numbers))
            see = jax.vmap(partial(_sequence, model=model, config=config), (0, None, None, None))
            parts.append(jax.vmap(see)(keys, frames, seen, window_s))
        batch = jax.tree.map(lambda *a: jnp.concatenate(a, 1), *parts)
        return jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), batch)

    groups = [config.sensors[i:i + group] for i in range(0, len(config.sensors), group)]
    # One group of pixel models a step: the branch not taken costs nothing.
    index = jax.random.randint(k_group, (), 0, len(groups))
    return jax.lax.switch(index, [partial(look, *models) for models in groups])


def _sequence(
    key: Array, frames: Array, seen: Array, window_s: Array, *, model: SensorModel,
    config: TrainConfig,
) -> Batch:
    """One camera on one scene. frames: (W*steps + 1, H, W') DN, for the events; seen: (W+1, H, W')
    recorded frames."""
    k_nominal, k_pixels, k_phase, k_sim, k_frame, k_odd, k_hot = jax.random.split(key, 7)
    shape = (frames.shape[1], frames.shape[2])
    first = watch.light(frames[0])
    nominal, camera = watch.draw_camera(k_nominal, k_pixels, config.prior, shape, first)
    camera = _with_odd_pixels(k_odd, camera, config.nuisances)
    camera = _with_hot_pixels(k_hot, camera, config.nuisances)
    log_frames = lin_log(frames)
    # A window is cut from a running camera, whose memory lies anywhere between the thresholds, or
    # starts like a simulation, with the memory at the first frame.
    k_phase, k_fresh = jax.random.split(k_phase)
    running = jax.random.bernoulli(k_fresh, 1.0 - config.nuisances.fresh).astype(jnp.float32)
    voxels = watch.voxels(
        k_sim, log_frames, camera, model, config.windows, window_s / config.steps_per_window,
        config.model.bins, running * watch.memory(k_phase, camera))
    seen = lin_log(watch.recorded(k_frame, seen, config.nuisances.frame_noise_dn))
    # Targets are rates at the sequence's mean intensity.
    gain = watch.noise_gain(model, noise_factor(normalised_intensity(frames)), first)
    return Batch(
        voxels=voxels,
        dlogI=seen[1:] - seen[:-1],
        changes=_changes(log_frames, config),
        intensity=0.5 * (seen[1:] + seen[:-1]),
        window_s=window_s,
        camera=watch.with_noise(camera, gain),
        nominal=watch.with_noise(nominal, gain),
    )


def _with_odd_pixels(key: Array, camera: Camera, nuisances: NuisanceConfig) -> Camera:
    """Set both thresholds of some pixels far from the camera's."""
    if nuisances.odd_pixels == 0:
        return camera
    k_where, k_factor = jax.random.split(key)
    odd = jax.random.bernoulli(k_where, nuisances.odd_pixels, camera.theta_on.shape)
    low, high = np.log(nuisances.odd_factor[0]), np.log(nuisances.odd_factor[1])
    factor = jnp.exp(jax.random.uniform(k_factor, odd.shape, minval=low, maxval=high))
    factor = jnp.where(odd, factor, 1.0)
    return dataclasses.replace(
        camera, theta_on=jnp.maximum(camera.theta_on * factor, THETA_MIN),
        theta_off=jnp.maximum(camera.theta_off * factor, THETA_MIN))


def _with_hot_pixels(key: Array, camera: Camera, nuisances: NuisanceConfig) -> Camera:
    """Give some cameras hot pixels, ON or OFF, at tens of Hz."""
    k_some, k_where, k_rate = jax.random.split(key, 3)
    share = nuisances.hot_pixels * jnp.maximum(0.0, jax.random.uniform(k_some, (), minval=-1.0))
    hot = jax.random.bernoulli(k_where, share, (2, *camera.eta_on.shape))
    low, high = np.log(nuisances.hot_hz[0]), np.log(nuisances.hot_hz[1])
    rate = jnp.exp(jax.random.uniform(k_rate, camera.eta_on.shape, minval=low, maxval=high))
    return dataclasses.replace(camera, eta_on=jnp.where(hot[0], rate, camera.eta_on),
                               eta_off=jnp.where(hot[1], rate, camera.eta_off))


def _changes(log_frames: Array, config: TrainConfig) -> Array:
    """True changes over the m equal parts of each window, (W, H, W', m)."""
    knots = log_frames[:: config.steps_per_window // config.model.changes]
    parts = jnp.diff(knots, axis=0).reshape(config.windows, config.model.changes,
                                            *log_frames.shape[1:])
    return jnp.moveaxis(parts, 1, -1)
