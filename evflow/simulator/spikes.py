"""The signal events of a pixel in one interval, and what a dead time makes of them."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from evflow.simulator.constants import Constants

Array = jax.Array

NEVER = 1e9  # intervals
# Log units below a threshold that cross it: rounding errors of a memory near 5, over some events.
# Pixels of 8-bit video return to earlier values, k theta away. v2e loses one event in 600 to them,
# and all of one polarity behind a flat shape if theta_ON = theta_OFF; ESIM none.
TIE = 2.0**-20


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Spikes:
    """Signal events of one interval. count: float32, positive ON, negative OFF.

    The k-th event (k = 0, 1, ...) falls at max(first + k spacing, earliest + k dead), in
    fractions of the interval, where dead = refractory / dt. earliest is None for models without
    waiting, and only the first term applies.
    """

    count: Array
    first: Array
    spacing: Array
    earliest: Array | None


def floor_divide(a: Array, theta: Array) -> Array:
    """floor(a / theta) for a >= 0, corrected by the remainder.

    Exact ties are common in 8-bit video; a rounded quotient would shift whole edges.
    """
    quotient = jnp.floor(a / theta)
    remainder = a - quotient * theta
    return quotient + jnp.where(remainder >= theta, 1.0, 0.0) - jnp.where(remainder < 0, 1.0, 0.0)


def crossings(
    model: Constants, theta: Array, start: Array, end: Array, last: Array, dt: Array
) -> tuple[Spikes, Array]:
    """Events at the crossings of the interpolated contrast, and the number of thresholds by which
    the memory moves.

    start, end: contrast in the direction of the event (end >= 0).
    """
    crossed = floor_divide(jnp.maximum(end, 0.0) + TIE, theta)
    rise = end - start
    inverse = jnp.where(rise > 0, 1.0 / jnp.where(rise > 0, rise, 1.0), 0.0)
    first = (theta - start) * inverse
    spikes = Spikes(crossed, first, theta * inverse, None)
    if model.refractory_s is None:
        return spikes, crossed
    dt = jnp.maximum(dt, 1e-9)
    dead = model.refractory_s / dt
    ready = dead - last / dt
    if model.dead_contrast == "drops":
        return thinned(spikes, ready, dead), crossed
    if model.is_reset:
        spikes = spread_out(spikes, dead)
        return spikes, jnp.where(spikes.count > 0, (end - since_reset(spikes, rise, dead)) / theta,
                                 0.0)
    spikes = delayed(spikes, ready, dead)
    return spikes, spikes.count


def delayed(spikes: Spikes, ready: Array, dead: Array) -> Spikes:
    """v2e's refractory period: an event within it is delayed.

    t_k = max(s_k, max(s_0, ready) + k dead): not before the crossing, and not within `dead` of the
    event before. Contrast of events that do not fit into the interval is kept. ready: time from
    which the pixel may fire.
    """
    earliest = jnp.maximum(jnp.maximum(spikes.first, 0.0), ready)
    fits = jnp.where(earliest <= 1.0, jnp.floor((1.0 - earliest) / dead) + 1.0, 0.0)
    return dataclasses.replace(spikes, count=jnp.minimum(spikes.count, fits), earliest=earliest)


def thinned(spikes: Spikes, ready: Array, dead: Array) -> Spikes:
    """ESIM's refractory period: an event within it is lost. The rest of an arithmetic progression
    is one again: the first event after `ready`, then each first one at least `dead` later."""
    spacing = jnp.maximum(spikes.spacing, 1e-9)
    skipped = jnp.clip(jnp.ceil((ready - spikes.first) / spacing), 0.0, spikes.count)
    stride = jnp.maximum(jnp.ceil(dead / spacing), 1.0)
    left = spikes.count - skipped
    count = jnp.where(left > 0, jnp.floor((left - 1.0) / stride) + 1.0, 0.0)
    first = spikes.first + skipped * spikes.spacing
    return Spikes(count, first, stride * spikes.spacing, None)


def spread_out(spikes: Spikes, dead: Array) -> Spikes:
    """The dead time of a pixel that begins anew after it: between two events it passes, and then a
    threshold's worth of change."""
    spacing = jnp.where(spikes.spacing > 0, dead + spikes.spacing, NEVER)
    more = jnp.floor(jnp.maximum(1.0 - spikes.first, 0.0) / spacing)
    count = jnp.where(spikes.count > 0, 1.0 + more, 0.0)
    return Spikes(count, spikes.first, spacing, None)


def since_reset(spikes: Spikes, rise: Array, dead: Array) -> Array:
    """Contrast at the end of the interval, since the reset after its last event."""
    at = spikes.first + (spikes.count - 1.0) * spikes.spacing
    return rise * jnp.maximum(1.0 - at - dead, 0.0)


def begun_anew(
    model: Constants, start: Array, end: Array, last: Array, dt: Array
) -> tuple[Array, Array, Array]:
    """Contrast at the begin and the end of an interval, of pixels that begin anew after a dead
    time: one that ends in it sets the contrast to 0. Last, whether one does."""
    waits = jnp.clip((model.refractory_s - last) / jnp.maximum(dt, 1e-9), 0.0, 1.0)
    rise = end - start
    anew = waits > 0
    return (jnp.where(anew, -rise * waits, start),
            jnp.where(anew, rise * (1.0 - waits), end), anew)


def since_last(model: Constants, spikes: Spikes, last: Array, dt: Array) -> Array:
    """Seconds from the last signal event to the end of the interval (crossing times). count
    has no sign here."""
    k = spikes.count - 1.0
    at = spikes.first + k * spikes.spacing
    if spikes.earliest is not None:
        at = jnp.maximum(at, spikes.earliest + k * (model.refractory_s / jnp.maximum(dt, 1e-9)))
    return jnp.where(spikes.count > 0, (1.0 - at) * dt, last + dt)
