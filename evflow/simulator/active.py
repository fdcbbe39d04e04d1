"""One block of frames on the device: find the pixels that may fire, and step only those.

Few pixels fire within a few milliseconds. Those that may fire are gathered, stepped through the
block interval by interval, and their memory is written back, so the cost is proportional to the
number of active pixels. If the memory changes without events (low-pass, leak), `look` passes all
pixels through the block to find candidates, and `step` steps them. If it does not, brightness
`limits` give for each pixel which frames can trigger an event, and `step_still` steps the pixels
that saw such a frame. An `Exit` turns steps into output: events (`sent`) or voxels
(`grids.Touched`).
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from evflow.camera import Camera
from evflow.light.log_maps import LOG_MAPS, normalised_intensity, to_log
from evflow.simulator import noise, pixel, second_order, sensor
from evflow.simulator.constants import Constants
from evflow.simulator.pixel import PixelState
from evflow.simulator.sensor import Sensor
from evflow.simulator.spikes import TIE, Spikes

Array = jax.Array
T = TypeVar("T")

BLOCK = 8  # frames; larger blocks have more active pixels, smaller ones need more passes over all
TICKS = 1 << 30  # limit of a block's microseconds, for two flags beside them in 32 bits
SLACK = 1e-4  # of a threshold, or log units: more than rounding errors


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Block:
    """T frame intervals. first: global index of interval 0; frames: (T + 1, N) DN, uint8 or
    float32, the frame before the block and those at which its intervals end; dt: (T,) seconds;
    dt_us: (T,) uint32; clock: (T + 1, 2) times of the frames, see `SimState.time`; salts: (T, 2) of
    `noise.salts`; bits: uint32, bits of a pixel's number in `Sent.first`."""

    first: Any
    frames: Any
    dt: Any
    dt_us: Any
    clock: Any
    salts: Any
    bits: Any


# Steps K pixels through a block: (model, sensor, state and block of these pixels, their numbers
# (K,), -1 for padding) -> (state, output). Hashable, as `jit` compiles for each.
Exit = Callable[[Constants, Sensor, PixelState, Block, Array], tuple[PixelState, Any]]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Sent:
    """Events of K pixels in T intervals, arrays (T, K).

    first: uint32, 0 without a signal event; else that of the first: microseconds since the block's
    begin, times 4, + 2 if ON, + 1 if more follow (in blocks of `TICKS` us and more only nonzero);
    shifted left by `Block.bits`, with the pixel in these bits. spikes: all signal events. struck:
    whether there are noise events, None without noise."""

    first: Array
    spikes: Spikes
    struck: Array | None


@functools.partial(jax.jit, static_argnames="dtype")
def limits(model: Constants, camera: Camera, base: Array, dtype: np.dtype) -> Array:
    """(2, N) DN: a pixel with this memory can fire only at frames brighter than the first or darker
    than the second. dtype: of the frames."""
    inverse = LOG_MAPS[model.log_map][1]
    bright = inverse(base + (camera.theta_on - SLACK))
    dark = inverse(base - (camera.theta_off - SLACK))
    if dtype == np.uint8:  # the extreme values that do not fire
        bright = jnp.clip(jnp.ceil(bright) - 1.0, 0.0, 255.0)
        dark = jnp.clip(jnp.floor(dark) + 1.0, 0.0, 255.0)
    return jnp.stack([bright, dark]).astype(dtype)


@jax.jit
def look(
    model: Constants, whole: Sensor, pixels: PixelState, block: Block
) -> tuple[PixelState, Array]:
    """State after the block if no pixel fires, and (N,) bool: pixels that may fire."""
    def body(
        carry: tuple[PixelState, Array], inputs: tuple[Array, Array, Array]
    ) -> tuple[tuple[PixelState, Array], None]:
        (own, active), (frame, dt, salt) = carry, inputs
        log_i, inner = to_log(frame, model.log_map), own.inner
        base, owed = own.base, own.owed
        if model.corner is not None:
            log_i = pixel.low_pass(model, own.lp, log_i, _i01(frame), dt)
        elif inner is not None:
            middle = 0.5 * (sensor.i01_of(model, inner.light) + _i01(frame))
            log_i, inner = second_order.rest(model, own.lp, inner, log_i, middle, dt)
        if whole.leaking is not None:
            drawn = noise.draw(whole.words, salt)
            leaked = noise.leak(model, whole.leaking, whole.words, drawn, dt)
            base, owed = pixel.lowered(base, owed, leaked)
        compared = log_i if inner is None else inner.amplified
        own = PixelState(log_i, base, own.last, inner, owed)
        return (own, active | _beyond(whole.camera, compared - base)), None

    active = jnp.zeros(pixels.lp.shape, bool)
    if model.is_reset:
        active = pixels.last < model.refractory_s  # dead time ends within the block
    (after, active), _ = jax.lax.scan(
        body, (pixels, active), (block.frames[1:], block.dt, block.salts))
    last = pixels.last + jnp.sum(block.dt) if model.is_dead_between else pixels.last
    if whole.rates is not None:
        active |= look_for_noise(whole, block)
    return dataclasses.replace(after, last=last), active


def _beyond(camera: Camera, contrast: Array) -> Array:
    """Whether contrast may cross a threshold, up to rounding in `step`."""
    near = 1.0 - SLACK
    return (contrast >= near * camera.theta_on - TIE) | (-contrast >= near * camera.theta_off - TIE)


@jax.jit
def look_for_noise(sensor: Sensor, block: Block) -> Array:
    """(N,) bool: pixels that may have a noise event in the block, by their smallest draw against
    the highest probability."""
    assert sensor.rates is not None
    least = functools.reduce(jnp.minimum, [noise.draw(sensor.words, salt) for salt in block.salts])
    highest = -jnp.expm1(-noise.peak(sensor.rates) * jnp.max(block.dt))
    return noise.uniform(least) <= highest * (1.0 + SLACK)


def _i01(frame: Array) -> Array:
    """Normalised intensity of DN."""
    return normalised_intensity(frame.astype(jnp.float32))


@functools.partial(jax.jit, static_argnames="exit", donate_argnames="after")
def step(
    model: Constants, whole: Sensor, before: PixelState, after: PixelState, block: Block,
    at: Array, exit: Exit,
) -> tuple[PixelState, Any]:
    """Step some pixels through a block.

    Args:
        model, whole: the circuit and all pixels.
        before: state of all pixels before the block.
        after: state after it if none fires, of `look`.
        block: with frames (T + 1, K) of these pixels only.
        at: (K,) int32 pixels; numbers beyond the last pixel, all different, are padding.
        exit: what to compute of the steps.

    Returns:
        `after` with the stepped pixels written into it, and their output.
    """
    few, own = _gathered((whole, before), at)
    own, sent = exit(model, few, own, block, _numbers(whole, at))
    return _put_back(model, after, own, at), sent


@functools.partial(jax.jit, static_argnames="exit", donate_argnames="pixels")
def step_still(
    model: Constants, whole: Sensor, pixels: PixelState, block: Block, at: Array,
    rested: Array | None, exit: Exit,
) -> tuple[PixelState, Any, Array]:
    """`step` for sensors whose memory changes at events only; also returns new `limits` (2, K).
    rested: (K,) seconds before the block in which the pixels were not stepped, for models with a
    dead time."""
    few, own = _gathered((whole, pixels), at)
    last = own.last if rested is None else own.last + rested
    own = PixelState(to_log(block.frames[0], model.log_map), own.base, last)
    own, sent = exit(model, few, own, block, _numbers(whole, at))
    new = limits(model, few.camera, own.base, block.frames.dtype)
    return _put_back(model, pixels, own, at), sent, new


def _numbers(whole: Sensor, at: Array) -> Array:
    return jnp.where(at < whole.words.size, at, -1)


def _gathered(maps: T, at: Array) -> T:
    return jax.tree.map(lambda m: m.at[at].get(mode="clip"), maps)


def _put_back(model: Constants, pixels: PixelState, own: PixelState, at: Array) -> PixelState:
    changes = {"base": True, "last": model.refractory_s is not None, "owed": model.carries_leak}
    put: dict[str, Any] = {name: getattr(pixels, name).at[at].set(
        getattr(own, name), mode="drop", unique_indices=True, indices_are_sorted=True)
        for name, changed in changes.items() if changed}
    if pixels.inner is not None and own.inner is not None:
        amplified = pixels.inner.amplified.at[at].set(
            own.inner.amplified, mode="drop", unique_indices=True, indices_are_sorted=True)
        put["inner"] = dataclasses.replace(pixels.inner, amplified=amplified)
    return dataclasses.replace(pixels, **put)


def sent(
    model: Constants, few: Sensor, pixels: PixelState, block: Block, number: Array
) -> tuple[PixelState, Sent]:
    """The `Exit` to events."""
    logs, i01 = to_log(block.frames, model.log_map), _i01(block.frames[1:])
    number = number[None]
    real = number >= 0
    # Everything independent of the memory is computed for the block at once.
    dist = jax.vmap(functools.partial(sensor.disturb, model, few))(i01, block.salts, block.dt)
    inputs = (logs[1:], i01, dist, block.dt, (block.clock[:-1], block.clock[1:]))
    pixels, spikes = _spikes(model, few.camera, pixels, inputs)
    struck = None if dist.struck is None else dist.struck.some & real
    below = jnp.where(block.bits > 0, number, 0).astype(jnp.uint32)
    first = (_ticks(spikes, block.dt_us) << block.bits) | below
    return pixels, Sent(jnp.where((spikes.count != 0) & real, first, 0), spikes, struck)


def _spikes(
    model: Constants, camera: Camera, pixels: PixelState, inputs: tuple[Any, ...]
) -> tuple[PixelState, Spikes]:
    """State after T intervals, and the spikes of each. inputs: of `sensor.advance`, log intensities
    first."""
    def advance(pixels: PixelState, inputs: tuple[Any, ...]) -> tuple[PixelState, Spikes]:
        return sensor.advance(model, camera, pixels, *inputs)

    if model.timestamps == "v2e":  # slots are visited one by one
        return jax.lax.scan(advance, pixels, inputs)

    # Times are computed for all intervals at once: a loop that writes them takes twice as long.
    def body(
        pixels: PixelState, inputs: tuple[Any, ...]
    ) -> tuple[PixelState, tuple[PixelState, Array]]:
        after, spikes = advance(pixels, inputs)
        return after, (pixels, spikes.count)

    after, (begun, count) = jax.lax.scan(body, pixels, inputs)
    if model.is_still:  # nor need it write what is known
        begun = dataclasses.replace(begun, lp=jnp.concatenate([pixels.lp[None], inputs[0][:-1]]))
    return after, dataclasses.replace(jax.vmap(advance)(begun, inputs)[1], count=count)


def _ticks(spikes: Spikes, dt_us: Array) -> Array:
    """`Sent.first` of intervals with events, without pixel numbers. Times are rounded up to a
    microsecond, within (begin, end] of their interval."""
    at = spikes.first if spikes.earliest is None else jnp.maximum(spikes.first, spikes.earliest)
    length = dt_us.astype(at.dtype)[:, None]
    within = jnp.clip(jnp.ceil(at * length), 1, length).astype(jnp.uint32)
    within = jnp.minimum(within, dt_us[:, None])  # float32 rounds lengths above 2^24 us
    when = (jnp.cumsum(dt_us) - dt_us)[:, None] + within
    on, more = (flag.astype(jnp.uint32) for flag in (spikes.count > 0, abs(spikes.count) > 1))
    return jnp.maximum((when << 2) | (on << 1) | more, 1)


@jax.jit
def strike(model: Constants, whole: Sensor, block: Block) -> Array | None:
    """(T, N) bool: intervals with noise events, for sensors whose signal is computed elsewhere;
    None without noise."""
    one = functools.partial(sensor.disturb, model, whole)
    struck = jax.vmap(one)(_i01(block.frames[1:]), block.salts, block.dt).struck
    return None if struck is None else struck.some
