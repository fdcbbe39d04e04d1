"""One pixel over one frame interval: pure functions of scalars, vmapped over pixels.

The low-passed log intensity `lp` moves linearly from its old to its new value during the interval;
the memory `base` is the value at the last event. An event fires each time lp - base passes theta;
base then moves by theta, so the remainder is kept. Within an interval a pixel fires one polarity
only, at times in arithmetic progression: `Spikes` holds it as (count, first, spacing) in fractions
of the interval, so that no loop is needed.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from evflow.simulator import second_order
from evflow.simulator.constants import Constants
from evflow.simulator.spikes import Spikes, begun_anew, crossings, floor_divide, since_last

Array = jax.Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class PixelState:
    """lp, base: log intensities. last: with crossing times, seconds since the last signal
    event (positive); with v2e's slots, its time stamp in float32 seconds as in v2e. inner: state of
    a second-order photoreceptor, else None. owed: leak still to be taken off base, see `lowered`;
    None without leak, or where it is rounded away as in v2e."""

    lp: Array
    base: Array
    last: Array
    inner: second_order.Inner | None = None
    owed: Array | None = None


def never_fired(model: Constants) -> Array | float:
    """`PixelState.last` of a pixel that has not fired yet."""
    if model.timestamps == "crossing":
        return 1e6
    return 0.0 if model.refractory_s is None else -model.refractory_s


def low_pass(model: Constants, lp: Array, log_i: Array, i01: Array, dt: Array) -> Array:
    """First-order low-pass, eps = dt 2 pi fc, with fc proportional to intensity i01 (v2e) or
    constant, by the model."""
    eps = dt * model.corner
    eps = jnp.minimum(i01 * eps if model.cutoff_by_light else eps, 1.0)
    return lp + eps * (log_i - lp)


def lowered(base: Array, owed: Array | None, by: Array) -> tuple[Array, Array | None]:
    """The memory after a leak, and what of it is still owed.

    A memory near 5 holds steps of 5e-7 in float32. The leak of .01 Hz in an interval of .1 ms is
    smaller and would all be lost, so the rounding error is carried on. v2e loses it (owed None).
    """
    if owed is None:
        return base - by, None
    due = owed + by
    left = base - due
    return left, due - (base - left)


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
    model: Constants, theta: Array, end: Array, last: Array, dt: Array, begin: Array,
    stop: Array, slots_used: Array,
) -> tuple[Spikes, Array]:
    """v2e's timestamps: the k-th event of every pixel sits in slot k of the frame's M slots.

    slots_used: M, the largest count of any pixel in this interval. A refractory pixel skips slots
    (if the period exceeds a slot) and keeps the contrast. The slots are visited one by one with
    v2e's float32 times, as slots locked to frames tie with the period, and rounding decides.
    Returns the spikes and the new `last`.
    """
    count = floor_divide(jnp.maximum(end, 0.0), theta)
    total = jnp.maximum(slots_used, 1.0)
    one = 1.0 / total
    plain = Spikes(count, jnp.full_like(count, one), jnp.full_like(count, one), None)
    if model.refractory_s is None:
        return plain, last

    def visit(k: Array, carry: tuple[Array, Array, Array, Array]) -> tuple[Array, ...]:
        passed, first, final, last = carry
        k = k.astype(count.dtype)
        time = slot_time(k, total, begin, stop)
        fires = (count > k) & (time - last > model.refractory_s)
        first = jnp.where(fires & (passed == 0), k, first)
        passed = passed + fires.astype(passed.dtype)
        return passed, first, jnp.where(fires, k, final), jnp.where(fires, time, last)

    zero = jnp.zeros_like(count)
    start = (zero, zero, zero, last)
    passed, first, final, new_last = jax.lax.fori_loop(0, total.astype(jnp.int32), visit, start)
    stride = (final - first) / jnp.maximum(passed - 1.0, 1.0)
    skipping = Spikes(passed, (first + 1.0) * one, stride * one, None)
    checked = model.refractory_s > dt * one
    spikes = jax.tree.map(lambda a, b: jnp.where(checked, a, b), skipping, plain)
    return spikes, jnp.where(checked, new_last, last)


def contrast(
    model: Constants, theta_on: Array, theta_off: Array, state: PixelState, log_i: Array,
    i01: Array, leaked: Array | None, dt: Array,
) -> tuple[PixelState, Array, Array, Array]:
    """Advance to the end of an interval of dt seconds, before any event is sent.

    i01: normalised intensity, for the low-pass only. leaked: contrast that leaks into ON during the
    interval. Returns the state after leak; the threshold in the direction of motion, negative for
    OFF; the contrast in that direction at the begin and the end of the interval.
    """
    lp = log_i if model.corner is None else low_pass(model, state.lp, log_i, i01, dt)
    base, owed = state.base, state.owed
    if leaked is not None:
        base, owed = lowered(base, owed, leaked)
    start, end = state.lp - state.base, lp - base
    if model.is_reset:
        start, end, anew = begun_anew(model, start, end, state.last, dt)
        base = jnp.where(anew, lp - end, base)
    rising = end > 0
    theta = jnp.where(rising, theta_on, -theta_off)
    after = PixelState(lp, base, state.last, owed=owed)
    return after, theta, jnp.where(rising, start, -start), jnp.abs(end)


def send(
    model: Constants, state: PixelState, theta: Array, start: Array, end: Array, dt: Array,
    begin: Array, stop: Array, slots_used: Array,
) -> tuple[PixelState, Spikes]:
    """State and events after an interval, from the results of `contrast`. begin, stop, slots_used:
    see `slots`."""
    threshold = jnp.abs(theta)
    if model.timestamps == "v2e":
        spikes, last = slots(model, threshold, end, state.last, dt, begin, stop, slots_used)
        moved = spikes.count
    else:
        spikes, moved = crossings(model, threshold, start, end, state.last, dt)
        last = state.last
        if model.refractory_s is not None:
            last = since_last(model, spikes, last, dt)
    signed = dataclasses.replace(spikes, count=jnp.sign(theta) * spikes.count)
    return dataclasses.replace(state, base=state.base + moved * theta, last=last), signed


def advance_second_order(
    model: Constants, theta_on: Array, theta_off: Array, state: PixelState, log_i: Array,
    i01: Array, leaked: Array | None, dt: Array,
) -> tuple[PixelState, Spikes]:
    """An interval of dt seconds of a pixel with a second-order photoreceptor. i01: normalised light
    in its middle."""
    assert state.inner is not None
    lp, inner = second_order.follow(model.photoreceptor, state.lp, state.inner, log_i, i01, dt)
    due = leaked if leaked is None or state.owed is None else leaked + state.owed
    fired = second_order.fire(
        model, theta_on, theta_off, state.base, inner.amplified, state.last, state.lp, lp, dt, due)
    inner = dataclasses.replace(inner, amplified=fired.amplified)
    owed = None if state.owed is None else fired.owed
    return (PixelState(lp, fired.base, fired.last, inner, owed),
            Spikes(fired.count, fired.first, fired.spacing, None))
