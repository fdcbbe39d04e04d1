"""Small networks and seen scenes for the tests of the learned rooms."""

from __future__ import annotations

import dataclasses
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp

from evflow import network
from evflow.camera import Camera
from evflow.config import PRESETS, TrainConfig
from evflow.simulator import simulate_voxels


def small_config(**changes: Any) -> TrainConfig:
    """The debug preset, smaller still."""
    return dataclasses.replace(PRESETS["debug"], crop=16, scenes=2, cameras=2, windows=2,
                               block=(8, 8), textures=4, **changes)


@cache
def small_params() -> dict[str, Any]:
    """A small network whose flow is far from the identity (couplings drawn at random)."""
    params = network.init(jax.random.key(0), PRESETS["debug"].model)
    return jiggle(params, 0.1)


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
