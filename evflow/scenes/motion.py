"""The exact optical flow of a scene, and whether each point stays visible.

Layers move by similarity transforms that are known in closed form, so the flow between two
instants is too, whatever the distance. Pure functions on the device; batch by `vmap`.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp

from evflow.scenes.render import Layer, Scene, bilinear
from evflow.scenes.trajectory import Pose, pose, recycle

Array = jax.Array

SOLID = 0.5  # a pixel belongs to the front layer that covers at least this much of it


@functools.partial(jax.jit, static_argnames="shape")
def optical_flow(
    scene: Scene, start_s: Array, stop_s: Array, shape: tuple[int, int]
) -> tuple[Array, Array]:
    """Displacements (2, H, W) = (x, y) in px from the instant start_s to stop_s, of what each
    pixel of `shape` = (H, W) shows at start_s; and visible (H, W) bool: at stop_s it is still
    inside the frame, with no other layer in front of it.

    The times are scalars in seconds, as those of `render`. A pixel on a soft edge belongs to the
    front layer that covers half of it or more.
    """
    dtype = scene.background.texture.dtype
    x, y = jnp.arange(shape[1], dtype=dtype)[None, :], jnp.arange(shape[0], dtype=dtype)[:, None]
    before, after = (jnp.asarray(t, dtype) for t in (start_s, stop_s))
    path = scene.background.path
    flow = _displacement(pose(path, before), pose(path, after), x, y)
    owner = jnp.full(shape, -1)
    count = scene.opacity.shape[0]
    for k in range(count):
        layer = _foreground(scene, k)
        at = pose(layer.path, before)
        here = recycle(at, scene.radius[k], shape)
        # A layer may be recycled during the interval; its points still move on along the path.
        there = pose(layer.path, after)
        there = there._replace(x=there.x + (here.x - at.x), y=there.y + (here.y - at.y))
        covers = scene.opacity[k] * _alpha(layer, here, x, y) >= SOLID
        flow = jnp.where(covers, _displacement(here, there, x, y), flow)
        owner = jnp.where(covers, k, owner)
    x, y = x + flow[0], y + flow[1]
    visible = (x >= 0) & (x <= shape[1] - 1) & (y >= 0) & (y <= shape[0] - 1)
    for k in range(count):
        layer = _foreground(scene, k)
        at = recycle(pose(layer.path, after), scene.radius[k], shape)
        hides = scene.opacity[k] * _alpha(layer, at, x, y) >= SOLID
        visible &= ~(hides & (owner < k))
    return flow, visible


def _foreground(scene: Scene, k: int) -> Layer:
    return jax.tree.map(lambda leaf: leaf[k], scene.foregrounds)


def _displacement(start: Pose, stop: Pose, x: Array, y: Array) -> Array:
    """(2, H, W): how far the layer's points at (x, y) move from one pose to the other."""
    dx, dy = x - start.x, y - start.y
    scale, turn = stop.scale / start.scale, stop.angle - start.angle
    c, s = scale * jnp.cos(turn) - 1.0, scale * jnp.sin(turn)
    return jnp.stack([
        stop.x - start.x + (c * dx - s * dy), stop.y - start.y + (s * dx + c * dy)])


def _alpha(layer: Layer, at: Pose, x: Array, y: Array) -> Array:
    """The cut-out's mask at the points (x, y) of the frame."""
    zoom = layer.zoom / at.scale
    c, s = zoom * jnp.cos(at.angle), zoom * jnp.sin(at.angle)
    dx, dy = x - at.x, y - at.y
    (alpha,) = bilinear(
        layer.texture[1:], layer.anchor[0] + (c * dx + s * dy), layer.anchor[1] + (c * dy - s * dx))
    return alpha
