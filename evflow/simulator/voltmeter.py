"""DVS-Voltmeter: the pixel's voltage as a Brownian motion with drift.

Lin et al., "DVS-Voltmeter: Stochastic Process-based Event Simulator for Dynamic Vision
Sensors", ECCV 2022. An event is the first passage of the voltage through +level_on or
-level_off, which returns it to 0; in round k of an interval, every pixel that still fires draws
its k-th. `fired` gives the events to the host, `weights` puts the same ones (same key) on a voxel
grid, on the device. Interval i draws from (key, i) alone.

As published: polarity from the two-sided exit probability, then time from the one-sided first
passage (inverse Gaussian), exact where |mu| level / sigma^2 >> 1 (over 300 at rest with the
published constants); where diffusion rules, events come late. Departures from the published code:
- no drift: the exit probability is B / (A + B), not 1/2, and Levy times are half as long;
- against the drift: the time law of the reversed drift (that of the conditioned path), not a
  truncated normal put through the inverse Gaussian sampler;
- no event: the voltage moves on the bridge to the passage drawn (`settle`), not on its mean, a
  straight line, whose noise vanishes as the frame rate grows.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from evflow.camera import Camera
from evflow.camera.sensors import Voltmeter
from evflow.errors import EvflowDataError

Array = jax.Array

MAX_ROUNDS = 10_000  # events per pixel and interval; beyond, `fired` raises and `weights` stops
BURST = 8  # rounds per call of the host exit
TINY = 1e-30  # keeps float32 quotients finite where drift and variance are 0
NEAREST = 1e-6  # least distance to a level, relative to the span between the levels


class State(NamedTuple):
    """Between frames, maps of one shape: dn, the last frame (0..255), and residual, the voltage
    since the last event, within [-level_off, level_on]."""

    dn: Array
    residual: Array


class Circuit(NamedTuple):
    """Pixels in one interval: drift mu dt, variance sigma^2 dt, and the two levels, > 0."""

    drift: Array
    variance: Array
    level_on: Array
    level_off: Array


def start(frame: Array | np.ndarray) -> State:
    """State at the first frame, (H, W) or (N,), DN on 0..255: no residual voltage."""
    dn = jnp.asarray(frame)
    dn = dn if jnp.issubdtype(dn.dtype, jnp.floating) else dn.astype(jnp.float32)
    return State(dn, jnp.zeros_like(dn))


def circuit(
    voltmeter: Voltmeter, camera: Camera, before: Array, after: Array, dt_us: Array | float
) -> Circuit:
    """Drift and variance of an interval of dt_us between two frames of DN (Eq. 10, 11)."""
    k = voltmeter
    mean = 0.5 * (before + after)
    drift = k.k1 * (after - before) / (mean + k.k2) + (k.k4 + k.k5 * mean) * dt_us
    sigma = k.k3 * jnp.sqrt(mean) / (mean + k.k2) + k.k6
    return Circuit(drift, sigma * sigma * dt_us, k.k1 * camera.theta_on, k.k1 * camera.theta_off)


def exit_against(speed: Array, variance: Array, ahead: Array, behind: Array) -> Array:
    """Probability that a drift of `speed` >= 0 ends at the level `behind` it, not the one `ahead`:
    e^-rb (1 - e^-ra) / (1 - e^-r(a+b)) with r = 2 speed / sigma^2, or a / (a+b) as r vanishes."""
    rate = 2.0 * speed / jnp.maximum(variance, TINY)
    span = rate * (ahead + behind)
    drifting = jnp.expm1(-rate * ahead) / jnp.expm1(-jnp.maximum(span, TINY))
    return jnp.where(span < 1e-6, ahead / (ahead + behind), jnp.exp(-rate * behind) * drifting)


def passage(c: Circuit, residual: Array, u: Array, z: Array) -> tuple[Array, Array]:
    """Next passage of a pixel: its distance, and its pace = distance over time in intervals,
    positive for ON. u: uniform in (0, 1]; z: standard normal. Scalars; vmap it.

    The time is inverse Gaussian of mean d / |mu| and shape d^2 / sigma^2, by the two roots of
    Michael, Schucany and Haas (1976). As paces their product is mu^2, and mu = 0 is no special
    case: the larger becomes z^2 sigma^2 / d, the Levy law.
    """
    rising, speed, span = c.drift >= 0, jnp.abs(c.drift), c.level_on + c.level_off
    ahead = jnp.where(rising, c.level_on - residual, c.level_off + residual)
    ahead = jnp.maximum(ahead, NEAREST * span)
    behind = jnp.maximum(span - ahead, NEAREST * span)
    against = exit_against(speed, c.variance, ahead, behind)
    contrary = u < against
    distance = jnp.where(contrary, behind, ahead)
    g = 0.5 * z * z * c.variance / distance
    fast = jnp.maximum(speed + g + jnp.sqrt(g * (2.0 * speed + g)), TINY)
    # Given the polarity, u is uniform in its remaining range, and may choose between the roots.
    u, whole = jnp.where(contrary, u, u - against), jnp.where(contrary, against, 1.0 - against)
    pace = jnp.where(u * (fast + speed) < whole * fast, fast, speed * (speed / fast))
    pace = jnp.maximum(pace, TINY)
    return distance, jnp.where(rising != contrary, pace, -pace)


def settle(c: Circuit, distance: Array, pace: Array, rest: Array, u: Array, z: Array) -> Array:
    """Voltage after the `rest` of an interval that ends before the passage drawn. Scalars.

    Seen from the level, a path that first meets it at time t is a three-dimensional Bessel
    bridge: after s, about d (1 - s/t) on one axis, with variance sigma^2 s (1 - s/t) on each.
    """
    left = jnp.maximum(distance - jnp.abs(pace) * rest, 0.0)
    variance = c.variance * rest * (left / distance)
    gap = jnp.sqrt(jnp.square(left + jnp.sqrt(variance) * z) - 2.0 * variance * jnp.log(u))
    residual = jnp.where(pace > 0, c.level_on - gap, gap - c.level_off)
    return jnp.clip(residual, -c.level_off, c.level_on)


def advance(c: Circuit, elapsed: Array, residual: Array, *draws: Array) -> tuple[Array, Array]:
    """One round of a pixel that is `elapsed`, a fraction, into an interval: its event, the
    fraction signed + for ON and - for OFF, or 0; and the voltage after it, or at the end."""
    distance, pace = passage(c, residual, *draws[:2])
    at = elapsed + distance / jnp.abs(pace)
    end = settle(c, distance, pace, 1.0 - elapsed, *draws[2:])
    return jnp.where(at <= 1.0, jnp.copysign(at, pace), 0.0), jnp.where(at <= 1.0, 0.0, end)


def _draws(key: Array, pixel: Array, dtype: jnp.dtype) -> tuple[Array, Array]:
    """A uniform in (0, 1], in steps of 2^-32 near zero where rare exits are decided, and a normal,
    |z| < 5.4, for each pixel, independent of the other pixels drawn."""
    words = jax.vmap(lambda p: jax.random.key_data(jax.random.fold_in(key, p)))(pixel)
    odd = ((words[:, 1] >> 9).astype(dtype) + 0.5) * 2.0**-22 - 1.0
    return (words[:, 0].astype(dtype) + 0.5) * 2.0**-32, 2.0**0.5 * jax.lax.erf_inv(odd)


def _round(
    key: Array, c: Circuit, pixel: Array, elapsed: Array, residual: Array
) -> tuple[Array, Array]:
    """`advance` on pixels (M,), numbered `pixel`; key: of the interval and the round."""
    first, last = (_draws(k, pixel, residual.dtype) for k in jax.random.split(key))
    return jax.vmap(advance)(c, elapsed, residual, *first, *last)


@jax.jit
def _first(
    key: Array, voltmeter: Voltmeter, camera: Camera, state: State, frame: Array | np.ndarray,
    dt_us: Array | float,
) -> tuple[State, Circuit, Array]:
    """Round 0 of all N pixels: the next state if none fires again, circuit and events (N,).
    key: of the interval."""
    dn = start(frame).dn
    c = jax.tree.map(jnp.ravel, circuit(voltmeter, camera, state.dn, dn, dt_us))
    pixel = jnp.arange(dn.size, dtype=jnp.uint32)
    event, residual = _round(jax.random.fold_in(key, 0), c, pixel, jnp.zeros_like(c.drift),
                             state.residual.ravel())
    return State(dn, residual.reshape(dn.shape)), c, event


def _later(
    key: Array, c: Circuit, state: State, pixel: Array, event: Array, done: Array | int,
    stop: Array | int, out: Array, emit: Callable[[Array, Array, Array], Array],
) -> tuple[State, Array]:
    """Rounds done..stop - 1 of pixels (M,) whose last event is `event`, 0 for padding. Returns
    the next state, and `out` after out = emit(out, round, events (M,)) in every round."""
    c = jax.tree.map(lambda m: m.at[pixel].get(mode="clip"), c)
    zero = jnp.zeros_like(event)

    def body(carry: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        k, last, residual, out = carry
        fresh, end = _round(jax.random.fold_in(key, k), c, pixel, jnp.abs(last), zero)
        fresh = jnp.where(last != 0, fresh, 0.0)
        return k + 1, fresh, jnp.where(last != 0, end, residual), emit(out, k, fresh)

    _, _, end, out = jax.lax.while_loop(
        lambda carry: (carry[0] < stop) & jnp.any(carry[1] != 0), body,
        (jnp.asarray(done, jnp.int32), event, zero, out))
    where = jnp.where(event != 0, pixel, state.dn.size)
    residual = state.residual.ravel().at[where].set(end, mode="drop")
    return State(state.dn, residual.reshape(state.dn.shape)), out


_interval = jax.jit(jax.random.fold_in)  # 0.2 ms a call without jit


@jax.jit
def _burst(
    key: Array, c: Circuit, state: State, pixel: Array, event: Array, done: Array
) -> tuple[State, Array]:
    """BURST further rounds and their events (BURST, M)."""
    out = jnp.zeros((BURST, *event.shape), event.dtype)
    return _later(key, c, state, pixel, event, done, done + BURST, out,
                  lambda out, k, event: out.at[k - done].set(event))


def fired(
    key: Array, index: int, voltmeter: Voltmeter, camera: Camera, state: State,
    frame: Array | np.ndarray, dt_us: float,
) -> tuple[State, np.ndarray, np.ndarray, np.ndarray]:
    """Events of interval `index`, dt_us long, that ends at `frame` (host side).

    Returns the next state and, in no order of time, each event's pixel (int64, in raster order),
    its fraction of the interval in (0, 1] (float32), and whether it is ON (bool). Raises EV015
    (sizes) and EV014 (a pixel with more than MAX_ROUNDS events).
    """
    shapes = {"frame": np.shape(frame), "frame before": state.dn.shape, "camera": camera.shape}
    if len(set(shapes.values())) > 1:
        raise EvflowDataError("EV015", f"the shapes differ: {shapes}.", "Resize one of them.")
    key, done = _interval(key, np.uint32(index)), 1
    state, c, event = _first(key, voltmeter, camera, state, frame, float(dt_us))
    pixel, rounds, pixels, events = np.arange(event.size), np.asarray(event), [], []
    while True:
        at = np.flatnonzero(rounds != 0)  # of a bool vector: 10x faster than other kinds
        pixels.append(pixel[at % pixel.size])
        events.append(rounds[at])
        again = at >= rounds.size - pixel.size  # fired in the last round
        pixel, event = pixels[-1][again], events[-1][again]
        if not pixel.size:
            signed = np.concatenate(events)
            return state, np.concatenate(pixels), np.abs(signed), signed > 0
        if done >= MAX_ROUNDS:
            raise EvflowDataError(
                "EV014", f"pixel {pixel[0]} fires more than {MAX_ROUNDS} times in {dt_us:g} us.",
                "Raise its threshold, or interpolate the video.")
        padding = (0, max(1024, 1 << (pixel.size - 1).bit_length()) - pixel.size)
        state, burst = _burst(key, c, state, np.pad(pixel.astype(np.uint32), padding),
                              np.pad(event, padding), np.int32(done))
        rounds, done = np.asarray(burst)[:, :pixel.size].ravel(), done + BURST


def weights(
    key: Array, index: Array | int, voltmeter: Voltmeter, camera: Camera, state: State,
    frame: Array, dt_us: Array | float, grid: Array, begin: Array | float, length: Array | float,
) -> tuple[State, Array]:
    """Add the events of `fired` to a voxel grid (Eq. 2); jit, vmap and scan it.

    grid: (2, bins, *shape), ON then OFF; the interval spans [begin, begin + length] of its bins
    0..bins - 1 (pass the few that it touches). Returns the next state and the grid. Nothing is
    checked. All pixels run one round, then a sixteenth at a time of those that fired.
    """
    key = jax.random.fold_in(key, index)
    state, c, event = _first(key, voltmeter, camera, state, frame, dt_us)
    size = max(event.size // 16, min(event.size, 1024))
    bins = jnp.arange(grid.shape[1], dtype=grid.dtype)[:, None]

    def add(out: Array, _: Array | int, event: Array) -> Array:
        hat = jnp.maximum(0.0, 1.0 - jnp.abs(begin + jnp.abs(event)[None] * length - bins))
        return out + jnp.stack([jnp.where(p[None], hat, 0.0) for p in (event > 0, event < 0)])

    def batch(carry: tuple[State, Array, Array]) -> tuple[State, Array, Array]:
        state, flat, event = carry
        pixel = jnp.flatnonzero(event, size=size, fill_value=event.size)
        out = jnp.zeros((*flat.shape[:2], size), flat.dtype)
        last = event.at[pixel].get(mode="fill", fill_value=0.0)
        state, out = _later(key, c, state, pixel, last, 1, MAX_ROUNDS, out, add)
        flat = flat.at[:, :, pixel].add(out, mode="drop")
        return state, flat, event.at[pixel].set(0.0, mode="drop")

    flat = add(grid.reshape(*grid.shape[:2], -1), 0, event)
    state, flat, _ = jax.lax.while_loop(
        lambda carry: jnp.any(carry[2] != 0), batch, (state, flat, event))
    return state, flat.reshape(grid.shape)
