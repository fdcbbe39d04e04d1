"""A pixel with a second-order photoreceptor: `SecondOrder` of camera/sensors.py.

    photoreceptor    v'' + 2 a v' + w^2 v = w^2 u        u: log light; a, w grow with the light
    source follower  lp' = (v - lp) / tau_f
    amplifier        y' = (lp - y) / tau_d               an event comes where |y - base| = theta

An event resets the amplifier: during the dead time y follows lp, then starts with base = y = lp. So
changes of light in a dead time are lost. Within an interval u is linear and the rates are those of
its middle; photoreceptor and follower are solved exactly for any length. For the amplifier lp is
taken as linear, which is solved exactly too: after the first reset, the distance of events is dead
time plus rise time. Leak lowers base steadily, from each reset on.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from evflow.camera.sensors import SecondOrder
from evflow.simulator.constants import Constants
from evflow.simulator.spikes import NEVER

Array = jax.Array

NO_TIME = 1e-9  # seconds
TINY = 1e-9  # a rise that reaches no threshold, with a nonzero square for gradients
APART = 1e-3  # least |(1 - tau_f p1)(1 - tau_f p2)| of the poles p; closer ones are moved apart
LEAST_DELAY = 1e-3  # of the amplifier, in intervals
SEARCH, RISE, LEAKING = 4, 4, 12  # steps of Newton's method


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Inner:
    """State beside `PixelState`: log light u, photoreceptor voltage v, its derivative per second,
    and y behind the amplifier; log units."""

    light: Array
    voltage: Array
    slope: Array
    amplified: Array


def at_rest(log_i: Array) -> Inner:
    return Inner(log_i, log_i, jnp.zeros_like(log_i), log_i)


def constants(receptor: SecondOrder, i01: Array) -> tuple[Array, Array]:
    """a and w of the photoreceptor, per second, at normalised light i01."""
    tau_in, tau_mil = receptor.input_s / i01, receptor.miller_s / i01
    pole = 1.0 / ((tau_in + tau_mil) * receptor.output_s)
    damping = (tau_in + receptor.output_s + (receptor.gain + 1.0) * tau_mil) * pole
    return 0.5 * damping, jnp.sqrt((receptor.loop_gain + 1.0) * pole)


def decay(a: Array, w: Array, dt: Array) -> tuple[Array, Array]:
    """exp(-a dt) (cosh, sinh / d)(d dt), d^2 = a^2 - w^2 of either sign."""
    square = a * a - w * w
    d = jnp.sqrt(jnp.maximum(jnp.abs(square), 1e-6 * w * w))  # closer to 0 makes no difference
    slow, fast = jnp.exp(-dt * (w * w) / (a + d)), jnp.exp(-dt * (a + d))
    still = jnp.exp(-a * dt)
    over = square > 0
    even = jnp.where(over, 0.5 * (slow + fast), still * jnp.cos(d * dt))
    odd = jnp.where(over, 0.5 * (slow - fast), still * jnp.sin(d * dt))
    return even, odd / d


def follow(
    receptor: SecondOrder, lp: Array, inner: Inner, log_i: Array, i01: Array, dt: Array
) -> tuple[Array, Inner]:
    """lp and the photoreceptor's state after an interval of dt seconds in which log light moves to
    log_i. i01: light in its middle."""
    a, w = constants(receptor, i01)
    tau = jnp.maximum(receptor.follower_s, NO_TIME)
    near = jnp.abs(1.0 - 2.0 * a * tau + (w * tau) ** 2) < APART
    outwards = jnp.where(w * w * tau < a, -1.0, 1.0)  # of the two poles
    tau = tau * (1.0 + jnp.where(near, APART**0.5 * outwards, 0.0))
    far = 1.0 - 2.0 * a * tau + (w * tau) ** 2
    rise = (log_i - inner.light) / jnp.maximum(dt, NO_TIME)
    lag = rise * (2.0 * a / (w * w))
    even, odd = decay(a, w, dt)
    # z: v relative to a line that lags behind the light; q: the follower's response to it.
    z = inner.voltage - inner.light + lag
    slope = inner.slope - rise
    later = even * z + odd * (slope + a * z)
    later_slope = even * slope - odd * (a * slope + w * w * z)

    def followed(z: Array, slope: Array) -> Array:
        return z - (tau / far) * (slope + tau * w * w * z)

    gone = lp - inner.light + lag + tau * rise - followed(z, slope)
    new = (log_i - lag - tau * rise + followed(later, later_slope)
           + gone * jnp.exp(-dt / tau))
    return new, Inner(log_i, log_i - lag + later, rise + later_slope, inner.amplified)


def amplified(y: Array, start: Array, rise: Array, delay: Array, elapsed: Array) -> Array:
    """y after `elapsed` intervals, with lp moving from `start` by `rise` per interval. delay: tau_d
    in intervals."""
    lag = rise * delay
    return start + rise * elapsed - lag + (y - start + lag) * jnp.exp(-elapsed / delay)


def _delay(model: Constants, dt: Array) -> Array:
    """tau_d of the amplifier in intervals."""
    delay = model.photoreceptor.amplifier_s / jnp.maximum(dt, NO_TIME)
    return jnp.maximum(delay, LEAST_DELAY)


def rest(
    model: Constants, lp: Array, inner: Inner, log_i: Array, i01: Array, dt: Array
) -> tuple[Array, Inner]:
    """`follow`, and the amplifier of a pixel that sends no event."""
    new, inner = follow(model.photoreceptor, lp, inner, log_i, i01, dt)
    y = amplified(inner.amplified, lp, new - lp, _delay(model, dt), jnp.ones_like(dt))
    return new, dataclasses.replace(inner, amplified=y)


def rise_time(theta: Array, rise: Array, delay: Array) -> Array:
    """Intervals from a reset until y has risen by theta, with lp rising steadily: x - 1 + exp(-x) =
    theta / (rise delay), x in units of delay."""
    wanted = theta / jnp.maximum(rise * delay, TINY)
    x = jnp.minimum(jnp.sqrt(2.0 * wanted) + 0.5 * wanted, wanted + 1.0)
    for _ in range(RISE):
        x = x - (x + jnp.expm1(-x) - wanted) / -jnp.expm1(-x)
    return jnp.minimum(x * delay, NEVER)


def leaking_rise_time(theta: Array, rise: Array, delay: Array, leak: Array) -> Array:
    """`rise_time` where base falls by `leak` an interval, negative for OFF:
    rise delay (x - 1 + exp(-x)) + leak delay x = theta. NEVER where both together do not rise."""
    rises = rise + leak > TINY
    # From the asymptote's root, which lies beyond that of a convex curve and before that of a
    # concave one (falling light): either way Newton's method comes nearer from one side.
    x = jnp.maximum(theta + rise * delay, 0.0) / (jnp.where(rises, rise + leak, 1.0) * delay)
    for _ in range(LEAKING):
        value = delay * (rise * (x + jnp.expm1(-x)) + leak * x) - theta
        slope = delay * (leak - rise * jnp.expm1(-x))
        x = jnp.maximum(x - value / jnp.where(jnp.abs(slope) > TINY, slope, 1.0), 0.0)
    return jnp.where(rises, jnp.minimum(x * delay, NEVER), NEVER)


def first_time(
    y: Array, start: Array, rise: Array, delay: Array, level: Array, left: Array,
    leak: Array | float = 0.0,
) -> Array:
    """First time at which y, and `leak` an interval, meet `level`, given that they are beyond after
    `left`: Newton's method, starting from a straight line."""
    end = amplified(y, start, rise, delay, left) + leak * left
    low = jnp.where(jnp.abs(end - y) > 1e-12, (level - y) / jnp.where(end == y, 1.0, end - y), 1.0)
    at = jnp.clip(low, 0.0, 1.0) * left
    for _ in range(SEARCH):
        value = amplified(y, start, rise, delay, at)
        slope = rise - (value - start - rise * at + rise * delay) / delay + leak
        step = (level - value - leak * at) / jnp.where(jnp.abs(slope) > 1e-9, slope, 1e9)
        at = jnp.clip(at + step, 0.0, left)
    return at


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Fired:
    """Result of an interval: memory, y, seconds since the last event; events as signed count, time
    of the first and their distance, in intervals; leak too small for base, see `pixel.lowered`."""

    base: Array
    amplified: Array
    last: Array
    count: Array
    first: Array
    spacing: Array
    owed: Array


def fire(
    model: Constants, theta_on: Array, theta_off: Array, base: Array, y: Array, last: Array,
    start: Array, end: Array, dt: Array, leaked: Array | None = None,
) -> Fired:
    """The events of an interval of dt seconds in which lp moves from start to end. leaked: by how
    much base falls in it, None without leak."""
    long, delay = jnp.maximum(dt, NO_TIME), _delay(model, dt)
    dead = jnp.zeros_like(last) if model.refractory_s is None else model.refractory_s / long
    rise = end - start
    waits = jnp.clip(dead - last / long, 0.0, 1.0)  # rest of a dead time from before
    begin = start + rise * waits
    base, y = (jnp.where(waits > 0, begin, value) for value in (base, y))
    left = 1.0 - waits
    leak = 0.0 if leaked is None else leaked
    contrast = amplified(y, begin, rise, delay, left) + leak * left - base
    up = contrast > 0
    sign = jnp.where(up, 1.0, -1.0)
    theta = jnp.where(up, theta_on, theta_off)
    fires = sign * contrast >= theta
    first = waits + first_time(y, begin, rise, delay, base + sign * theta, left, leak)
    if leaked is None:
        spacing = dead + jnp.where(sign * rise > 0, rise_time(theta, sign * rise, delay), NEVER)
    else:
        spacing = dead + leaking_rise_time(theta, sign * rise, delay, sign * leaked)
    count = jnp.where(fires, 1.0 + jnp.floor(jnp.maximum(1.0 - first, 0.0) / spacing), 0.0)
    at = first + (count - 1.0) * spacing
    reset = jnp.minimum(at + dead, 1.0)
    anew = start + rise * reset
    silent = base - leak * left
    return Fired(
        jnp.where(fires, anew - leak * (1.0 - reset), silent),
        jnp.where(fires, amplified(anew, anew, rise, delay, 1.0 - reset),
                  amplified(y, begin, rise, delay, left)),
        jnp.where(fires, (1.0 - at) * dt, last + dt), sign * count, first, spacing,
        jnp.where(fires | (waits > 0), 0.0, leak - (base - silent)))
