"""Small networks and simulated recordings for the tests of networks, training and estimation."""

from __future__ import annotations

import dataclasses
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from evflow import Recording, simulate
from evflow.camera import Camera, CameraPrior
from evflow.network import architecture
from evflow.network.config import ModelConfig
from evflow.network.encoder import LOGIT_BIAS, NORMS
from evflow.scenes import SceneConfig, make_bank, sample_scene, watch
from evflow.simulator import simulate_voxels
from evflow.training.config import PRESETS, TrainConfig

SHAPE = (48, 64)  # of hidden recordings
Params = dict[str, Any]


def small_config(**changes: Any) -> TrainConfig:
    """The debug preset, smaller still."""
    return dataclasses.replace(PRESETS["debug"], crop=16, scenes=2, cameras=2, windows=2,
                               block=(8, 8), textures=4, **changes)


@cache
def small_params() -> Params:
    """A small network whose flow is far from the identity (couplings drawn at random)."""
    return random_params(PRESETS["debug"].model)


def random_params(config: ModelConfig, name: str = "default") -> Params:
    """As `architecture.init` makes them, but for zeros: no layer is zero."""
    shapes = jax.eval_shape(lambda key: architecture.init(key, config, name), jax.random.key(0))
    params = drawn(shapes, 0.1)
    last = params[name]["encoder"][f"Dense_{NORMS}"]
    last["bias"] = last["bias"] + LOGIT_BIAS
    return params


def drawn(shapes: Any, scale: float) -> Any:
    """Random arrays of these shapes, by NumPy, as compiling a draw for each takes ten seconds.
    Weights are N(0, 1 / fan-in), norms N(1, scale^2), the flow's last layers and all else
    N(0, scale^2)."""
    rng = np.random.default_rng(1)

    def one(path: Any, leaf: Any) -> jax.Array:
        names, noise = [p.key for p in path], rng.standard_normal(leaf.shape)
        last = names[-2:] in (["coupling", "w_3"], ["injector", "w_2"])
        weight = names[-1] == "kernel" or (names[-1][0] == "w" and not last)
        noise *= leaf.shape[-2] ** -0.5 if weight else scale
        return jnp.asarray(noise + (names[-1] == "scale"), leaf.dtype)

    return jax.tree_util.tree_map_with_path(one, shapes)


@cache
def seen(shape: tuple[int, int] = (12, 10), frames: int = 17) -> tuple[Any, Any, Camera]:
    """(voxels, dL (H, W, 16), camera) of a random moving pattern seen by a random camera."""
    walk = 0.15 * jax.random.normal(jax.random.key(2), (frames, *shape))
    log_frames = 4.0 + jnp.cumsum(walk, 0)
    camera = Camera.sample(jax.random.key(3), shape)
    voxels = simulate_voxels(jax.random.key(4), log_frames, camera, frame_dt_s=0.05 / (frames - 1))
    return voxels, jnp.moveaxis(jnp.diff(log_frames, axis=0), 0, -1), camera


@cache
def hidden(seed: int, ms: int = 280) -> tuple[Recording, Camera]:
    """A lively scene, recorded by a camera with thresholds .15-.4; and that camera. Frames every
    40 ms, the first at 20 ms, so that events cover all six windows."""
    k_bank, k_scene, k_nominal, k_pixels, k_events = jax.random.split(jax.random.key(seed), 5)
    scenes = SceneConfig(speed_px_s=(60.0, 200.0), static_fraction=0.0, contrast=(0.6, 1.0))
    scene = sample_scene(k_scene, make_bank(k_bank, 8, photos=False), scenes, SHAPE)
    times = np.arange(ms + 1)
    frames = np.concatenate(list(watch.film(scene, np.float32(times / 1e3), SHAPE)))
    prior = CameraPrior(theta=(0.15, 0.4))
    _, camera = watch.draw_camera(k_nominal, k_pixels, prior, SHAPE, None)
    events = simulate(k_events, frames, times * 1000, camera)
    kept = slice(watch.LEAD_MS, None, 40)
    gray = np.clip(np.rint(frames[kept]), 0, 255).astype(np.uint8)
    return Recording(events, gray, times[kept] * 1000), camera
