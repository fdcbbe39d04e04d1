"""EventGAN's losses: the critic's, and cycle losses on the motion and image that events imply.

Frames are in -1..1, predictions lists of maps from coarse to full resolution, each scale weighing
half of the next finer one.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from evflow.metrics.image import ssim
from evflow.scenes.render import bilinear

Array = jax.Array

SMOOTH = 0.5  # weight of the flow's smoothness
POWER, EPSILON = 0.45, 1e-5  # of the robust penalty (x^2 + eps^2)^power
REACH = 0.25  # of the frame's side: the fastest flow per window
FLIPPED = 0.1  # share of the critic's labels that are exchanged


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Pair:
    """B windows: frames (B, H, W, 2) at their ends, in -1..1, and true voxels (B, H, W, 2*bins)."""

    frames: Array
    voxels: Array


def critic_loss(
    params: dict[str, Any], critic: nn.Module, key: Array, fake: Array, real: Array
) -> Array:
    """Hinge loss of volumes beside their frames (B, H, W, C); some labels are exchanged."""
    def logits(x: Array) -> Array:
        return jnp.asarray(critic.apply({"params": params}, x))

    no, yes = logits(fake), logits(real)
    swap = jax.random.bernoulli(key, FLIPPED, no.shape)
    no, yes = jnp.where(swap, yes, no), jnp.where(swap, no, yes)
    return (nn.relu(1.0 - yes) + nn.relu(1.0 + no)).mean()


def flow_loss(flows: list[Array], pair: Pair) -> Array:
    """Photometric and smoothness loss of flows (B, h, w, 2) at several scales: the first frame,
    moved, against the second, where events are."""
    shape = pair.frames.shape[1:3]
    active = (pair.voxels.sum(-1) > 0).astype(jnp.float32)
    sides = jnp.array(shape[::-1], jnp.float32)[None, None, None]  # px
    total = jnp.zeros(())
    for i, flow in enumerate(flows[::-1]):
        flow = REACH * jnp.tanh(flow)  # in sides of the frame, as smoothness counts it
        large = jax.image.resize(flow, (len(flow), *shape, 2), "nearest") * sides
        moved, inside = jax.vmap(_moved)(pair.frames[..., 0], large)
        used = active * inside
        error = _robust(moved - pair.frames[..., 1]) * used
        photometric = (error.sum((1, 2)) / jnp.maximum(used.sum((1, 2)), 1.0)).mean()
        smooth = 0.5 * sum(_robust(jnp.diff(flow, axis=a)).mean() for a in (1, 2))
        total += 0.5**i * (photometric + SMOOTH * smooth)
    return total


def _moved(image: Array, flow: Array) -> tuple[Array, Array]:
    """image (H, W) at each pixel plus flow (H, W, 2) = (x, y), and 1 where that is inside. The
    image is filled up to the square that `bilinear` takes."""
    height, width = image.shape
    side = max(height, width)
    square = jnp.pad(image, ((0, side - height), (0, side - width)), mode="edge")
    x = jnp.arange(width, dtype=flow.dtype)[None, :] + flow[..., 0]
    y = jnp.arange(height, dtype=flow.dtype)[:, None] + flow[..., 1]
    inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    return bilinear(square[None], x, y)[0], inside.astype(flow.dtype)


def _robust(x: Array) -> Array:
    return (x**2 + EPSILON**2) ** POWER


def reconstruction_loss(images: list[Array], pair: Pair) -> Array:
    """L1 less SSIM of images (B, h, w, 1) at several scales against the second frame."""
    total = jnp.zeros(())
    after = pair.frames[..., 1]
    for i, image in enumerate(images[::-1]):
        large = jax.image.resize(jnp.tanh(image[..., 0]), after.shape, "nearest")
        alike = ssim(0.5 + 0.5 * large, 0.5 + 0.5 * after).mean()
        total += 0.5**i * (jnp.abs(large - after).mean() - alike)
    return total
