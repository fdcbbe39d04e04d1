"""One block of frames on the device: find the pixels that may fire, and step only those.

Few pixels fire in a few milliseconds. Those that may are gathered, taken through the block interval
by interval, and their memory is put back, so that cost follows the active pixels. Where the memory
moves by itself (low-pass, leak), `look` takes all pixels through the light of the block to find
them, and `step` steps them. Where it stays as it is between events, `limits` of brightness tell
which frames can matter to a pixel, and `step_still` steps those that saw one. What the steps are
made into is their `Exit`: events (`sent`), or voxels (`grids.Touched`).
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
from evflow.simulator.pixel import PixelState, Spikes
from evflow.simulator.sensor import Sensor

Array = jax.Array
T = TypeVar("T")

BLOCK = 8  # frames; more of them have more active pixels, fewer pass more often over all pixels
TICKS = 1 << 30  # microseconds in a block that leave room for two flags in 32 bits
SLACK = 1e-4  # of a threshold, or log units: beyond what rounding may differ by


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Block:
    """T intervals, of which `first` is the index of the first. frames: (T + 1, N) DN, uint8 or
    float32, the frame before and those at which they end. dt: (T,) seconds. dt_us: (T,) uint32.
    clock: (T + 1, 2) times of the frames, see `SimState.time`. salts: (T, 2) of `noise.salts`.
    bits: uint32, of a pixel's number in `Sent.first`."""

    first: Any
    frames: Any
    dt: Any
    dt_us: Any
    clock: Any
    salts: Any
    bits: Any


# Takes K pixels through a block: (model, their sensor, their state, the block as they see it, their
# numbers (K,), -1 for padding) -> (state, what they send). Hashable: `jit` compiles for each.
Exit = Callable[[Constants, Sensor, PixelState, Block, Array], tuple[PixelState, Any]]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Sent:
    """What K pixels send in T intervals, each array (T, K). first: uint32, 0 where there is no
    signal event, else of the first of them the microseconds from the begin of the block, times 4,
    + 2 where ON, + 1 where it is not the only one (nonsense, but not 0, in blocks of `TICKS` us
    and more); and below these, in `Block.bits` bits if any, the pixel. struck: whether there are
    noise events, None without noise."""

    first: Array
    spikes: Spikes
    struck: Array | None


@functools.partial(jax.jit, static_argnames="dtype")
def limits(model: Constants, camera: Camera, base: Array, dtype: np.dtype) -> Array:
    """(2, N) DN: only frames brighter than the first or darker than the second can make pixels
    with this memory fire. dtype: that of the frames."""
    inverse = LOG_MAPS[model.log_map][1]
    bright = inverse(base + (camera.theta_on - SLACK))
    dark = inverse(base - (camera.theta_off - SLACK))
    if dtype == np.uint8:  # the last values that cannot
        bright = jnp.clip(jnp.ceil(bright) - 1.0, 0.0, 255.0)
        dark = jnp.clip(jnp.floor(dark) + 1.0, 0.0, 255.0)
    return jnp.stack([bright, dark]).astype(dtype)


@jax.jit
def look(
    model: Constants, whole: Sensor, pixels: PixelState, block: Block
) -> tuple[PixelState, Array]:
    """The pixels after the block where none of them fires, and (N,) which may."""
    def body(
        carry: tuple[PixelState, Array], inputs: tuple[Array, Array, Array]
    ) -> tuple[tuple[PixelState, Array], None]:
        (own, active), (frame, dt, salt) = carry, inputs
        log_i, base, inner = to_log(frame, model.log_map), own.base, own.inner
        if model.corner is not None:
            log_i = pixel.low_pass(model, own.lp, log_i, _i01(frame), dt)
        elif inner is not None:
            middle = 0.5 * (sensor.i01_of(model, inner.light) + _i01(frame))
            log_i, inner = second_order.rest(model, own.lp, inner, log_i, middle, dt)
        if whole.leaking is not None:
            drawn = noise.draw(whole.words, salt)
            base = base - noise.leak(model, whole.leaking, whole.words, drawn, dt)
        compared = log_i if inner is None else inner.amplified
        own = PixelState(log_i, base, own.last, inner)
        return (own, active | _beyond(whole.camera, compared - base)), None

    active = jnp.zeros(pixels.lp.shape, bool)
    if model.photoreceptor is not None and model.refractory_s is not None:
        active = pixels.last < model.refractory_s  # whose reset ends within the block
    (after, active), _ = jax.lax.scan(
        body, (pixels, active), (block.frames[1:], block.dt, block.salts))
    last = pixels.last + jnp.sum(block.dt) if model.is_dead_between else pixels.last
    if whole.rates is not None:
        active |= look_for_noise(whole, block)
    return dataclasses.replace(after, last=last), active


def _beyond(camera: Camera, contrast: Array) -> Array:
    """Whether contrast may cross a threshold; `step` may round otherwise."""
    near = 1.0 - SLACK
    return (contrast >= near * camera.theta_on) | (-contrast >= near * camera.theta_off)


@jax.jit
def look_for_noise(sensor: Sensor, block: Block) -> Array:
    """(N,) whether noise may strike in the block: the least a pixel draws against the highest
    odds."""
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
    """Take the pixels `at` (K,) int32 through the block, whose frames (T + 1, K) are theirs alone,
    from `before` it.

    Returns `after` (see `look`) with their memory put back, and what they send. Entries of `at`
    beyond the last pixel are padding, all different: they repeat it and are not put back.
    """
    few, own = _gathered((whole, before), at)
    own, sent = exit(model, few, own, block, _numbers(whole, at))
    return _put_back(model, after, own, at), sent


@functools.partial(jax.jit, static_argnames="exit", donate_argnames="pixels")
def step_still(
    model: Constants, whole: Sensor, pixels: PixelState, block: Block, at: Array,
    rested: Array | None, exit: Exit,
) -> tuple[PixelState, Any, Array]:
    """The same for sensors that are still. rested: (K,) seconds before the block in which the
    pixels were not stepped, where they wait. Returns their new `limits` (2, K) as well."""
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
    kept = ("base", "last") if model.refractory_s is not None else ("base",)
    put: dict[str, Any] = {name: getattr(pixels, name).at[at].set(
        getattr(own, name), mode="drop", unique_indices=True, indices_are_sorted=True)
        for name in kept}
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
    # All that does not depend on the memory is worked out for the block at once.
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
    """The pixels after T intervals, and what they send in each. inputs: of `sensor.advance`, log
    intensities first."""
    def advance(pixels: PixelState, inputs: tuple[Any, ...]) -> tuple[PixelState, Spikes]:
        return sensor.advance(model, camera, pixels, *inputs)

    if model.timestamps == "v2e":  # whose slots are visited one by one
        return jax.lax.scan(advance, pixels, inputs)

    # A loop that also writes times takes twice as long: these are made for all intervals at once.
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
    """`Sent.first` where there are events, but for the pixels. Times are rounded up to a
    microsecond, within (begin, end] of their interval."""
    at = spikes.first if spikes.earliest is None else jnp.maximum(spikes.first, spikes.earliest)
    length = dt_us.astype(at.dtype)[:, None]
    within = jnp.clip(jnp.ceil(at * length), 1, length).astype(jnp.uint32)
    when = (jnp.cumsum(dt_us) - dt_us)[:, None] + within
    on, more = (flag.astype(jnp.uint32) for flag in (spikes.count > 0, abs(spikes.count) > 1))
    return jnp.maximum((when << 2) | (on << 1) | more, 1)


@jax.jit
def strike(model: Constants, whole: Sensor, block: Block) -> Array | None:
    """Where there is noise in a block, bool (T, N), for sensors whose signal comes from
    elsewhere; None without noise."""
    one = functools.partial(sensor.disturb, model, whole)
    struck = jax.vmap(one)(_i01(block.frames[1:]), block.salts, block.dt).struck
    return None if struck is None else struck.some
