"""A block of frames on the device: which pixels may send events, and what those send.

Few pixels fire in a few milliseconds. `look` passes over whole frames once and finds the pixels
that may; `step` gathers some of them, takes them through the block interval by interval and puts
their memory back. Cost follows the active pixels; where nothing can fire, only light is worked out.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp

from evflow.intensity import normalised_intensity, to_log
from evflow.sensors import SensorModel
from evflow.simulator import noise, pixel, sensor
from evflow.simulator.pixel import PixelState, Spikes
from evflow.simulator.sensor import Sensor

Array = jax.Array

TICKS = 1 << 30  # microseconds in a block that leave room for two flags in 32 bits
SLACK = 1e-4  # of a threshold: what sums in another order may differ by


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Block:
    """T frames and the intervals that end at them. frames: (T, N) DN, uint8 or float32. dt: (T,)
    seconds. dt_us: (T,) uint32. clock: (T + 1, 2) times of the frame before and of these, see
    `SimState.time`. salts: (T, 2) of `noise.salts`."""

    frames: Any
    dt: Any
    dt_us: Any
    clock: Any
    salts: Any


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Sent:
    """What K pixels send in T intervals, each array (T, K). ticks: uint32, 0 where there is no
    signal event, else of the first of them the microseconds from the begin of the block, times 4,
    + 2 where ON, + 1 where it is not the only one (nonsense, but not 0, in blocks of `TICKS` us
    and more). struck: whether there are noise events, None without noise."""

    ticks: Array
    spikes: Spikes
    struck: Array | None


@functools.partial(jax.jit, static_argnames="model")
def look(
    model: SensorModel, sensor: Sensor, pixels: PixelState, block: Block
) -> tuple[PixelState, Array]:
    """The pixels after the block where none of them fires, and (N,) which may."""
    if model.cutoff_hz > 0 or model.leak_jitter > 0:
        after, active = _look_at_each(model, sensor, pixels, block)
    else:
        after, active = _look_at_extremes(model, sensor, pixels, block)
    if model.refractory_s > 0 and model.timestamps == "crossing":
        after = dataclasses.replace(after, last=pixels.last + jnp.sum(block.dt))
    if sensor.rates is not None:
        active |= _may_be_struck(sensor, block)
    return after, active


def _beyond(sensor: Sensor, above: Array, below: Array) -> Array:
    """Whether contrast that reaches from -below to above may cross a threshold."""
    near = 1.0 - SLACK
    return ((above >= near * sensor.camera.theta_on)
            | (below >= near * sensor.camera.theta_off))


def _look_at_extremes(
    model: SensorModel, sensor: Sensor, pixels: PixelState, block: Block
) -> tuple[PixelState, Array]:
    """Without a low-pass the brightest and the darkest frame of a pixel decide; whole frames
    turn into logarithms only for these."""
    frames = list(block.frames)
    most, least = (to_log(functools.reduce(pick, frames), model.log_map)
                   for pick in (jnp.maximum, jnp.minimum))
    base = pixels.base
    if sensor.leaking is not None:
        for dt in block.dt:  # one by one, as `step` does: a sum rounds differently
            base = base - sensor.leaking * dt
    active = _beyond(sensor, most - base, pixels.base - least)
    after = PixelState(to_log(frames[-1], model.log_map), base, pixels.last)
    return after, active


def _look_at_each(
    model: SensorModel, sensor: Sensor, pixels: PixelState, block: Block
) -> tuple[PixelState, Array]:
    def body(
        carry: tuple[Array, Array, Array], inputs: tuple[Array, Array, Array]
    ) -> tuple[tuple[Array, Array, Array], None]:
        (lp, base, active), (frame, dt, salt) = carry, inputs
        log_i = to_log(frame, model.log_map)
        if model.cutoff_hz > 0:
            log_i = pixel.low_pass(lp, log_i, _i01(frame), dt, model.cutoff_hz)
        if sensor.leaking is not None:
            drawn = noise.draw(sensor.words, salt)
            base = base - noise.leak(model, sensor.leaking, sensor.words, drawn, dt)
        contrast = log_i - base
        return (log_i, base, active | _beyond(sensor, contrast, -contrast)), None

    start = (pixels.lp, pixels.base, jnp.zeros(pixels.lp.shape, bool))
    (lp, base, active), _ = jax.lax.scan(body, start, (block.frames, block.dt, block.salts))
    return PixelState(lp, base, pixels.last), active


def _may_be_struck(sensor: Sensor, block: Block) -> Array:
    """Whether noise may strike: the least a pixel draws in the block against the highest odds."""
    assert sensor.rates is not None
    least = functools.reduce(jnp.minimum, [noise.draw(sensor.words, salt) for salt in block.salts])
    highest = -jnp.expm1(-noise.peak(sensor.rates) * jnp.max(block.dt))
    return noise.uniform(least) <= highest * (1.0 + SLACK)


def _i01(frame: Array) -> Array:
    """Normalised intensity of DN."""
    return normalised_intensity(frame.astype(jnp.float32))


@functools.partial(jax.jit, static_argnames="model", donate_argnames="after")
def step(
    model: SensorModel, whole: Sensor, before: PixelState, after: PixelState, block: Block,
    at: Array,
) -> tuple[PixelState, Sent]:
    """Take the pixels `at` (K,) int32 through the block, from `before` it.

    Returns `after` (see `look`) with their memory put back, and what they send. Entries of `at`
    beyond the last pixel are padding: they repeat it and are not put back.
    """
    few, pixels = jax.tree.map(lambda m: m.at[at].get(mode="clip"), (whole, before))
    frames = block.frames.at[:, at].get(mode="clip")
    log_i, i01 = to_log(frames, model.log_map), _i01(frames)
    # All that does not depend on the memory is worked out for the block at once.
    dist = jax.vmap(functools.partial(sensor.disturb, model, few))(i01, block.salts, block.dt)

    def body(
        pixels: PixelState, inputs: tuple[Any, ...]
    ) -> tuple[PixelState, Spikes]:
        return sensor.advance(model, few.camera, pixels, *inputs)

    clock = block.clock[:-1], block.clock[1:]
    pixels, spikes = jax.lax.scan(
        body, pixels, (log_i, i01, dist, block.dt, clock))
    real = (at < whole.words.size)[None]
    struck = None if dist.struck is None else dist.struck.some & real
    kept = ("base", "last") if model.refractory_s > 0 else ("base",)
    put = {name: getattr(after, name).at[at].set(getattr(pixels, name), mode="drop")
           for name in kept}
    ticks = jnp.where((spikes.count != 0) & real, _ticks(spikes, block.dt_us), 0)
    sent = Sent(ticks, spikes, struck)
    return dataclasses.replace(after, **put), sent


def _ticks(spikes: Spikes, dt_us: Array) -> Array:
    """`Sent.ticks` where there are events. Times are rounded up to a microsecond, within
    (begin, end] of their interval."""
    at = spikes.first if spikes.earliest is None else jnp.maximum(spikes.first, spikes.earliest)
    length = dt_us.astype(at.dtype)[:, None]
    within = jnp.clip(jnp.ceil(at * length), 1, length).astype(jnp.uint32)
    when = (jnp.cumsum(dt_us) - dt_us)[:, None] + within
    on, more = (flag.astype(jnp.uint32) for flag in (spikes.count > 0, abs(spikes.count) > 1))
    return jnp.maximum((when << 2) | (on << 1) | more, 1)


@functools.partial(jax.jit, static_argnames="model")
def strike(model: SensorModel, whole: Sensor, block: Block) -> Array | None:
    """Where there is noise in a block, bool (T, N), for sensors whose signal comes from
    elsewhere; None without noise."""
    one = functools.partial(sensor.disturb, model, whole)
    struck = jax.vmap(one)(_i01(block.frames), block.salts, block.dt).struck
    return None if struck is None else struck.some
