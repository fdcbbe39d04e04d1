"""Trajectories of layers: similarity transforms as closed-form functions of time.

A trajectory is constant velocity, spin and scale rate plus an optional sinusoidal shake, so a
pose at any instant is exact and needs no earlier one: frames can be rendered in any order, at
any rate, in any chunks. Times are seconds from the reference instant t = 0, of either sign;
callers put it at the start or the middle of their sequence.
"""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp

from evflow.scenes.config import Range, SceneConfig

Array = jax.Array

# A layer grows or shrinks by at most this factor, then its scale rate reverses: at the default
# rates that is after 1.35 s or more, and a long sequence never zooms into a single texel.
SCALE_LIMIT = 1.5


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Trajectory:
    """Motion of one layer; every leaf may have leading batch axes.

    position (2,), px: the layer's centre (x, y) at t = 0, without shake; velocity (2,), px/s.
    angle, rad, from +x towards +y (clockwise on screen, where y points down); spin, rad/s.
    scale_rate, 1/s: d log(scale)/dt, at first.
    shake (2,), px: amplitude of the sinusoid; shake_hz; shake_phase, rad.
    """

    position: Array
    velocity: Array
    angle: Array
    spin: Array
    scale_rate: Array
    shake: Array
    shake_hz: Array
    shake_phase: Array


class Pose(NamedTuple):
    """Where a layer is at one instant: centre (x, y) in px, angle in rad, scale (1 at t = 0)."""

    x: Array
    y: Array
    angle: Array
    scale: Array


def mirror(u: Array, top: Array | float) -> Array:
    """Fold the real line into [0, top], back and forth: 0 -> 0, top -> top, 2 top -> 0."""
    period = 2.0 * top
    return top - jnp.abs(u - period * jnp.floor(u / period) - top)


def pose(trajectory: Trajectory, t: Array) -> Pose:
    """The pose of one layer (unbatched leaves) at the instant t, a scalar in seconds."""
    swing = jnp.sin(2 * math.pi * trajectory.shake_hz * t + trajectory.shake_phase)
    centre = trajectory.position + trajectory.velocity * t + trajectory.shake * swing
    limit = math.log(SCALE_LIMIT)
    log_scale = mirror(trajectory.scale_rate * t + limit, 2 * limit) - limit
    return Pose(centre[0], centre[1], trajectory.angle + trajectory.spin * t, jnp.exp(log_scale))


def recycle(at: Pose, radius: Array, shape: tuple[int, int]) -> Pose:
    """Let a layer of `radius` px (at scale 1) that has left the frame come in on the far side.

    It jumps only while wholly outside, so no frame shows it, and a sequence of any length keeps
    its foregrounds.
    """
    margin = SCALE_LIMIT * radius + 1.0
    height, width = shape

    def wrap(u: Array, size: int) -> Array:
        return jnp.mod(u + margin, size - 1 + 2 * margin) - margin

    return at._replace(x=wrap(at.x, width), y=wrap(at.y, height))


def within(unit: Array, bounds: Range, log: bool = False) -> Array:
    """Carry draws from [0, 1) into `bounds`, uniformly or log-uniformly."""
    low, high = map(math.log, bounds) if log else bounds
    value = low + (high - low) * unit
    return jnp.exp(value) if log else value


TRAJECTORY_UNITS = 10


def trajectory_from(
    units: Array, position: Array, moving: Array, config: SceneConfig
) -> Trajectory:
    """One layer's motion through `position` (2,) px, from ten draws in [0, 1); `moving`, 0 or 1,
    multiplies all of it."""
    speed, heading, angle, spin, scale_rate, shakes, shake, axis, hz, phase = units
    turn = (-math.pi, math.pi)
    shake_hz = within(hz, config.shake_hz, log=True)
    fastest = config.speed_px_s[1] / (2 * math.pi * shake_hz)
    amplitude = jnp.minimum(within(shake, config.shake_px), fastest)
    amplitude = jnp.where(shakes < config.shake_probability, amplitude, 0.0)
    return Trajectory(
        position=position,
        velocity=moving * within(speed, config.speed_px_s, log=True) * _direction(heading),
        angle=within(angle, turn),
        spin=moving * jnp.deg2rad(within(spin, config.rotation_deg_s)),
        scale_rate=moving * within(scale_rate, config.scale_rate_per_s),
        shake=moving * amplitude * _direction(axis),
        shake_hz=shake_hz,
        shake_phase=within(phase, turn),
    )


def _direction(unit: Array) -> Array:
    return jnp.stack([jnp.cos(2 * math.pi * unit), jnp.sin(2 * math.pi * unit)])
