"""Contributions of frame intervals to a voxel grid, without making events.

The frames are scanned; `sensor.advance` gives the times of events, `bins` their weights, and the
few bins that an interval touches are added to the grid in place.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from evflow.light.log_maps import LOG_MAPS, normalised_intensity, to_log
from evflow.simulator import bins as weigh
from evflow.simulator import noise, sensor, voltmeter
from evflow.simulator.active import BLOCK, Block
from evflow.simulator.bins import Schedule
from evflow.simulator.constants import Constants
from evflow.simulator.pixel import PixelState
from evflow.simulator.sensor import Sensor, Struck
from evflow.simulator.spikes import Spikes

Array = jax.Array
Weights = tuple[list[Array], list[Array]]  # (ON, OFF), one (N,) per touched bin


def scan(
    model: Constants, whole: Sensor, pixels: PixelState, frames: Array, dt: Array, salts: Array,
    clock: Array, plan: Schedule, bins: int,
) -> tuple[PixelState, Array]:
    """State of pixels (N,) after T intervals, and their voxels (2 * bins, N).

    frames: (T, N), log intensity or bytes, at the ends of the intervals. dt: (T,) seconds. salts:
    (T, 2). clock: (T + 1, 2), as in `SimState.time`. plan: of these intervals and bins.
    """
    def body(
        carry: tuple[PixelState, Array], inputs: tuple[Any, ...]
    ) -> tuple[tuple[PixelState, Array], None]:
        (pixels, grid), (frame, low, offset, wide, dt, salt, clock) = carry, inputs
        log_i = as_log(model, frame)
        i01 = sensor.i01_of(model, log_i)  # dropped by the compiler where nothing uses it
        dist = sensor.disturb(model, whole, i01, salt, dt)
        pixels, spikes = sensor.advance(
            model, whole.camera, pixels, log_i, i01, dist, dt, clock)
        weights = _weights(model, plan, spikes, offset, wide, dt)
        if dist.struck is not None:
            more = _noise_weights(model, plan, whole.words, dist.struck, offset)
            weights = jax.tree.map(jnp.add, weights, more)
        return (pixels, weigh.add(grid, low, *weights)), None

    inputs = (frames, plan.low, plan.offset, plan.wide, dt, salts, (clock[:-1], clock[1:]))
    grid = jnp.zeros((2 * bins, frames.shape[1]), pixels.lp.dtype)
    return jax.lax.scan(body, (pixels, grid), inputs)[0]


def as_log(model: Constants, frames: Array) -> Array:
    """Log intensity of frames: bytes are converted, others are logarithms already."""
    return to_log(frames, model.log_map) if frames.dtype == jnp.uint8 else frames


@dataclasses.dataclass(frozen=True)
class Touched:
    """The `active.Exit` to voxels of a window of `steps` intervals and `bins` bins: K pixels in a
    block contribute (K, 2, span), ON and OFF, to the bins from `low` on."""

    steps: int
    bins: int

    @functools.cached_property
    def plan(self) -> Schedule:
        """Schedule of whole blocks; padding intervals repeat the last one and add nothing."""
        plan, more = Schedule.of(self.steps, self.bins), (0, -self.steps % BLOCK)
        low, offset, wide = (np.pad(row, more, "edge")
                             for row in (plan.low, plan.offset, plan.wide))
        return dataclasses.replace(plan, low=low, offset=offset, wide=wide)

    @functools.cached_property
    def span(self) -> int:
        """Largest number of bins that a block touches."""
        low = self.plan.low.reshape(-1, BLOCK)
        return min(self.bins, int(np.max(low[:, -1] - low[:, 0])) + self.plan.width)

    @functools.cached_property
    def low(self) -> np.ndarray:
        """The first bin of each block."""
        low: np.ndarray = np.minimum(self.plan.low[::BLOCK], self.bins - self.span)
        return low

    def __call__(
        self, model: Constants, few: Sensor, pixels: PixelState, block: Block, _: Array
    ) -> tuple[PixelState, Array]:
        low, offset, wide = (jax.lax.dynamic_slice_in_dim(jnp.asarray(rows), block.first, BLOCK)
                             for rows in (self.plan.low, self.plan.offset, self.plan.wide))
        low -= jnp.asarray(self.low)[block.first // BLOCK]
        plan = dataclasses.replace(self.plan, low=low, offset=offset, wide=wide)
        pixels, grid = scan(model, few, pixels, block.frames[1:], block.dt, block.salts,
                            block.clock, plan, self.span)
        return pixels, grid.T.reshape(-1, 2, self.span)


def scan_brownian(
    key: Array, model: Constants, whole: Sensor, log_frames: Array, salts: Array, dt: Array,
    bins: int,
) -> Array:
    """DVS-Voltmeter's grid (N, 2 * bins) of flat log frames (T + 1, N), with the camera's noise.
    key: of the signal."""
    frames = LOG_MAPS[model.log_map][1](log_frames)
    plan = Schedule.of(len(frames) - 1, bins)

    def body(
        carry: tuple[voltmeter.State, Array], inputs: tuple[Any, ...]
    ) -> tuple[tuple[voltmeter.State, Array], None]:
        (voltage, grid), (frame, index, salt, low, offset) = carry, inputs
        touched = jnp.zeros((2, plan.width, frame.size), grid.dtype)
        voltage, (on, off) = voltmeter.weights(
            key, index, model.voltmeter, whole.camera, voltage, frame, dt * 1e6, touched, offset,
            plan.length)
        weights: Weights = list(on), list(off)
        struck = sensor.disturb(model, whole, normalised_intensity(frame), salt, dt).struck
        if struck is not None:
            more = _noise_weights(model, plan, whole.words, struck, offset)
            weights = jax.tree.map(jnp.add, weights, more)
        return (voltage, weigh.add(grid, low, *weights)), None

    steps = jnp.arange(len(frames) - 1)
    start = voltmeter.start(frames[0]), jnp.zeros((2 * bins, frames.shape[1]), frames.dtype)
    inputs = (frames[1:], steps, salts, plan.low, plan.offset)
    return jax.lax.scan(body, start, inputs)[0][1].T


@functools.partial(jax.jit, donate_argnames="grid")
def put(grid: Array, at: Array, count: int, low: ArrayLike, more: Array) -> Array:
    """grid (H, W, 2 * bins) with more (K, 2, span) of the first `count` flat pixels `at` (K,) added
    to the bins from `low` on."""
    zero, low = jnp.zeros((), at.dtype), jnp.asarray(low, at.dtype)  # indices of one dtype

    def one(i: Array, grid: Array) -> Array:  # XLA's scatter takes twice as long on a CPU
        start = (at[i], zero, low)
        old = jax.lax.dynamic_slice(grid, start, (1, *more.shape[1:]))
        return jax.lax.dynamic_update_slice(grid, old + more[i][None], start)

    flat = grid.reshape(-1, 2, grid.shape[-1] // 2)
    return jax.lax.fori_loop(0, count, one, flat).reshape(grid.shape)


def _weights(
    model: Constants, plan: Schedule, spikes: Spikes, offset: Array, wide: Array, dt: Array
) -> Weights:
    """Weights of the signal events of an interval."""
    dead = model.refractory_s / jnp.maximum(dt, 1e-9) if model.waits else None

    def signed(width: int, spikes: Spikes) -> list[Array]:
        spare = [jnp.zeros_like(spikes.first)] * (plan.width - width)
        return weigh.signal_bins(width, spikes, offset, plan.length, dead) + spare

    # The branch skips the third bin where it is not touched. It also makes XLA materialise the
    # spikes once, instead of recomputing them for every bin and polarity.
    return weigh.by_polarity(
        jax.lax.cond(
        wide, functools.partial(signed, plan.width), functools.partial(signed, 2), spikes))


def _noise_weights(
    model: Constants, plan: Schedule, words: Array, struck: Struck, offset: Array
) -> Weights:
    """Weights of the noise events of one interval, each pixel's first and the few others."""
    u, mean = noise.uniform(struck.drawn), struck.odds.mean

    def placed(k: Array, sent: Array) -> Array:
        """Fraction of the interval of each pixel's k-th event, negative for OFF, 0 without one."""
        at, on = noise.event(model, words, struck.drawn, k, struck.odds.share)
        return jnp.where(sent, jnp.where(on, at, -at), 0.0)

    def weights(at: Array) -> Weights:
        return weigh.by_polarity(weigh.noise_bins(
            plan.width, jnp.abs(at), jnp.sign(at), offset, plan.length))

    def unfinished(carry: tuple[noise.Tail, Weights]) -> Array:
        return jnp.any(u < carry[0][0])

    def step(carry: tuple[noise.Tail, Weights]) -> tuple[noise.Tail, Weights]:
        tail, total = carry
        more = weights(placed(jnp.asarray(tail[2], jnp.uint32), u < tail[0]))
        return noise.next_tail(mean, tail), jax.tree.map(jnp.add, total, more)

    # The branch makes XLA materialise the places once, not for every bin and polarity.
    first = jax.lax.cond(jnp.any(struck.some), lambda: placed(jnp.zeros((), jnp.uint32),
                         struck.some), lambda: jnp.zeros_like(u))
    tail = jax.tree.map(jnp.asarray, noise.next_tail(mean, struck.odds.tail()))
    return jax.lax.while_loop(unfinished, step, (tail, weights(first)))[1]
