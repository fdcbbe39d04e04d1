"""One pixel, one frame interval: v2e's model as a pure step, to be vmapped over pixels.

The low-passed log intensity `lp` moves linearly from its old to its new value during the
interval; the memory `base` holds the value at the last event. An event fires each time
lp - base passes theta; base then moves by theta, so the remainder is kept. Inside an interval
a pixel fires one polarity only, at times that form an arithmetic progression: `Spikes` holds
it as (count, first, spacing) in fractions of the interval, and nothing is ever looped.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from evflow.camera import SensorModel

Array = jax.Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class PixelState:
    """lp, base: log intensities. last: with crossing times, seconds since the last signal
    event (positive); with v2e's slots, its time stamp in float32 seconds as v2e keeps it."""

    lp: Array
    base: Array
    last: Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Spikes:
    """Signal events of one interval. count: int32, positive ON, negative OFF.

    The k-th event (k = 0, 1, ...) falls at max(first + k spacing, earliest + k dead), in
    fractions of the interval, where dead = refractory / dt.
    """

    count: Array
    first: Array
    spacing: Array
    earliest: Array


def floor_divide(a: Array, theta: Array) -> Array:
    """floor(a / theta) for a >= 0, corrected by the remainder.

    8-bit video makes exact ties common; a rounded quotient would shift whole edges.
    """
    quotient = jnp.floor(a / theta)
    remainder = a - quotient * theta
    return quotient + jnp.where(remainder >= theta, 1.0, 0.0) - jnp.where(remainder < 0, 1.0, 0.0)


def low_pass(lp: Array, log_i: Array, i01: Array, dt: Array, cutoff_hz: float) -> Array:
    """First-order low-pass whose corner scales with intensity (v2e): eps = i01 dt 2 pi fc."""
    eps = jnp.minimum(i01 * (dt * (2 * jnp.pi * cutoff_hz)), 1.0)
    return lp + eps * (log_i - lp)


def pixel_step(
    model: SensorModel,
    theta_on: Array,
    theta_off: Array,
    state: PixelState,
    log_i: Array,
    i01: Array,
    leak: Array,
    dt: Array,
) -> tuple[PixelState, Array, Array]:
    """Advance to the end of an interval of dt seconds, before any event is sent.

    leak: contrast that leaks into ON during the interval (log units). Returns the state with
    its memory leaked, the contrast d = lp - base at the start and at the end.
    """
    lp = low_pass(state.lp, log_i, i01, dt, model.cutoff_hz) if model.cutoff_hz > 0 else log_i
    start = state.lp - state.base
    base = state.base - leak
    return PixelState(lp, base, state.last), start, lp - base


def crossings(
    model: SensorModel, theta: Array, start: Array, end: Array, last: Array, dt: Array
) -> Spikes:
    """Events at the true crossing of the interpolated contrast.

    start, end: contrast in the direction of the event (end >= 0). With a refractory period r
    the k-th event waits for the pixel: t_k = max(s_k, max(s_0, t_last + r) + k r), the
    max-plus form of "no sooner than the crossing, no sooner than r after the one before".
    """
    count = floor_divide(jnp.maximum(end, 0.0), theta)
    rise = end - start
    safe = jnp.where(rise > 0, rise, 1.0)
    first = jnp.where(rise > 0, (theta - start) / safe, 0.0)
    spacing = jnp.where(rise > 0, theta / safe, 0.0)
    earliest = jnp.maximum(first, 0.0)
    if model.refractory_s > 0:
        positive_dt = jnp.maximum(dt, 1e-9)
        dead = model.refractory_s / positive_dt
        earliest = jnp.maximum(earliest, dead - last / positive_dt)
        fits = jnp.where(earliest <= 1.0, jnp.floor((1.0 - earliest) / dead) + 1.0, 0.0)
        count = jnp.minimum(count, fits)
    return Spikes(count, first, spacing, earliest)


def slot_time(k: Array, total: Array, begin: Array, end: Array) -> Array:
    """Time of v2e's slot k of `total` in (begin, end], float32 as torch.linspace rounds it:
    counted from the first slot in the left half, from the last in the right half.

    begin, end: (2,) float32 pairs whose sum is the time in float64 (v2e computes the first
    slot in double precision). The barrier keeps XLA from fusing multiply and add, which
    would round once instead of twice.
    """
    length = (end[0] - begin[0]) + (end[1] - begin[1])
    first = jnp.where(total > 1, begin[0] + (begin[1] + length / total), end[0])
    step = (end[0] - first) / jnp.maximum(total - 1.0, 1.0)
    left = k < jnp.floor(total / 2)
    offset = jax.lax.optimization_barrier(jnp.where(left, k, total - 1.0 - k) * step)
    return jnp.where(left, first + offset, end[0] - offset)


def slots(
    model: SensorModel, theta: Array, end: Array, last: Array, dt: Array, begin: Array,
    stop: Array, slots_used: Array,
) -> tuple[Spikes, Array]:
    """v2e's timestamps: the k-th event of every pixel sits in slot k of the frame's M slots.

    slots_used: M, the largest count of any pixel in this interval. A refractory pixel skips
    slots (only where the period exceeds a slot) and keeps the contrast. The slots are visited
    one by one with v2e's float32 times, because frame-locked slots tie with the period and
    rounding alone decides. Returns the spikes and the new `last`.
    """
    count = floor_divide(jnp.maximum(end, 0.0), theta)
    total = jnp.maximum(slots_used, 1.0)
    one = 1.0 / total
    plain = Spikes(count, jnp.full_like(count, one), jnp.full_like(count, one),
                   jnp.full_like(count, one))
    if model.refractory_s <= 0:
        return plain, last

    def visit(k: Array, carry: tuple[Array, Array, Array, Array]) -> tuple[Array, ...]:
        passed, first, final, last = carry
        k = k.astype(count.dtype)
        time = slot_time(k, total, begin, stop)
        fires = (count > k) & (time - last > model.refractory_s)
        first = jnp.where(fires & (passed == 0), k, first)
        return passed + fires, first, jnp.where(fires, k, final), jnp.where(fires, time, last)

    zero = jnp.zeros_like(count)
    start = (zero, zero, zero, last)
    passed, first, final, new_last = jax.lax.fori_loop(0, total.astype(jnp.int32), visit, start)
    stride = (final - first) / jnp.maximum(passed - 1.0, 1.0)
    skipping = Spikes(passed, (first + 1.0) * one, stride * one, (first + 1.0) * one)
    checked = model.refractory_s > dt * one
    spikes = jax.tree.map(lambda a, b: jnp.where(checked, a, b), skipping, plain)
    return spikes, jnp.where(checked, new_last, last)


def settle(
    model: SensorModel, theta_on: Array, theta_off: Array, state: PixelState,
    spikes: Spikes, rising: Array, dt: Array,
) -> tuple[PixelState, Spikes]:
    """Move the memory by the events that were sent; give the count its sign. With crossing
    times, also remember when the last event was."""
    base = state.base + spikes.count * jnp.where(rising, theta_on, -theta_off)
    last = state.last
    if model.timestamps == "crossing":
        k = spikes.count - 1.0
        dead = model.refractory_s / jnp.maximum(dt, 1e-9)
        at = jnp.maximum(spikes.first + k * spikes.spacing, spikes.earliest + k * dead)
        last = jnp.where(spikes.count > 0, (1.0 - at) * dt, state.last + dt)
    signed = jnp.where(rising, spikes.count, -spikes.count).astype(jnp.int32)
    return PixelState(state.lp, base, last), dataclasses.replace(spikes, count=signed)
