"""Small networks and seen scenes for the tests of the learned rooms."""

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
from evflow.scenes import SceneConfig, make_bank, sample_scene, watch
from evflow.simulator import simulate_voxels
from evflow.training.config import PRESETS, TrainConfig

SHAPE = (48, 64)  # of hidden recordings


def small_config(**changes: Any) -> TrainConfig:
    """The debug preset, smaller still."""
    return dataclasses.replace(PRESETS["debug"], crop=16, scenes=2, cameras=2, windows=2,
                               block=(8, 8), textures=4, **changes)


@cache
def small_params() -> dict[str, Any]:
    """A small network whose flow is far from the identity (couplings drawn at random)."""
    init = jax.jit(architecture.init, static_argnums=1)
    return jax.jit(jiggle)(init(jax.random.key(0), PRESETS["debug"].model), 0.1)


def jiggle(params: Any, scale: float) -> Any:
    """Every leaf moved by scale N(0, 1) / sqrt(fan-in), so that no layer is zero."""
    leaves, tree = jax.tree.flatten(params)
    keys = jax.random.split(jax.random.key(1), len(leaves))
    moved = [leaf + scale * jax.random.normal(k, leaf.shape) for leaf, k in
             zip(leaves, keys, strict=True)]
    return jax.tree.unflatten(tree, moved)


@cache
def seen(shape: tuple[int, int] = (12, 10), frames: int = 17) -> tuple[Any, Any, Camera]:
    """(voxels, dL (H, W, 16), camera) of a random moving pattern seen by a random camera."""
    walk = 0.15 * jax.random.normal(jax.random.key(2), (frames, *shape))
    log_frames = 4.0 + jnp.cumsum(walk, 0)
    camera = Camera.sample(jax.random.key(3), shape)
    voxels = simulate_voxels(jax.random.key(4), log_frames, camera, frame_dt_s=0.05 / (frames - 1))
    return voxels, jnp.moveaxis(jnp.diff(log_frames, axis=0), 0, -1), camera


def hidden(seed: int, ms: int = 280) -> tuple[Recording, Camera]:
    """A camera with thresholds .15-.4 watches a lively scene; frames every 40 ms, the
    first at 20 ms: events cover all six windows."""
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
