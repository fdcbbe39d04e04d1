"""Cameras for which `generate` makes events: one as drawn, and the same with other thresholds."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from evflow import Camera
from evflow.camera import THETA_MIN

Array = jax.Array

SCALES = {  # of theta_on, theta_off
    "as it is": (1.0, 1.0), "halved": (0.5, 0.5), "doubled": (2.0, 2.0),
    "ON halved": (0.5, 1.0), "ON doubled": (2.0, 1.0),
    "OFF halved": (1.0, 0.5), "OFF doubled": (1.0, 2.0)}
CHANGED = ("halved", "doubled")  # which log_prob should separate from the camera as drawn
SINGLE_PIXELS = 0.1  # share of pixels whose thresholds change at an unchanged summary


def scaled(camera: Camera, on: Array | float, off: Array | float) -> Camera:
    return dataclasses.replace(camera, theta_on=jnp.maximum(camera.theta_on * on, THETA_MIN),
                               theta_off=jnp.maximum(camera.theta_off * off, THETA_MIN))


def variants(key: Array, camera: Camera) -> dict[str, tuple[Camera, Array]]:
    """Cameras to compare, and the pixels (H, W) that count."""
    everywhere = jnp.ones(camera.shape, bool)
    found = {name: (scaled(camera, *scale), everywhere) for name, scale in SCALES.items()}
    some = jax.random.bernoulli(key, SINGLE_PIXELS, camera.shape)
    for name, scale in (("single pixels halved", 0.5), ("single pixels doubled", 2.0)):
        factor = jnp.where(some, scale, 1.0)
        found[name] = scaled(camera, factor, factor), some
    return found
