"""All pixels of a sensor over one frame interval: the step shared by events and voxels.

`start` makes a sensor and its state from the first frame, `advance` moves the state by one
interval. Both are pure; jit, vmap and scan them. Pixels are one flat axis (N,).
"""

from __future__ import annotations

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np

from evflow.camera import Camera
from evflow.camera.arguments import real_maps
from evflow.camera.camera import THETA_MIN
from evflow.errors import EvflowDataError
from evflow.light.log_maps import LOG_MAPS, normalised_intensity
from evflow.simulator import noise, pixel, second_order
from evflow.simulator.constants import Constants
from evflow.simulator.pixel import PixelState
from evflow.simulator.spikes import Spikes, floor_divide

Array = jax.Array
LEAST_THETA = 1e-4  # log units; float32 holds the log of 255 DN to half a percent of that
Clock = tuple[Array, Array]  # begin and end of an interval, see `SimState.time`


def simulable(camera: Camera) -> Camera:
    """The validated camera, of float maps. Raises EV002, EV014, EV015, also for thresholds as small
    as rounding errors of brightness. Traced maps pass unchecked."""
    camera = real_maps(camera.validate())
    if any(isinstance(m, jax.core.Tracer) for m in jax.tree.leaves(camera)):
        return camera
    for name in ("theta_on", "theta_off"):
        theta = np.asarray(getattr(camera, name))
        if theta.size and theta.min() < LEAST_THETA:
            where = tuple(int(i) for i in np.unravel_index(theta.argmin(), theta.shape))
            raise EvflowDataError(
                "EV014", f"{name} is {theta[where]:.3g} at index {where}: below {LEAST_THETA:g}, "
                "brightness is rounded to the size of a threshold.",
                f"Those of real pixels are .05 to 1, natural log; clamp them at {THETA_MIN}.")
    return camera


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Sensor:
    """Constants of the pixels, maps (N,). words: see `noise.draw`. rates: None without noise.
    leaking: log units per second, None without leak."""

    camera: Camera
    words: Array
    rates: noise.Rates | None
    leaking: Array | None


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class SimState:
    """pixels: PixelState of maps (N,). interval: index of the next frame interval (int32), which
    with the key makes its `noise.salts`. time: of the last frame, seconds since frame 0 as a
    (2,) float32 pair, high and low part (only v2e's slots read it)."""

    pixels: PixelState
    interval: Array
    time: Array
    key: Array


def frame_times(dt: Array | float, steps: int) -> Array:
    """(steps + 1, 2) seconds since the first of frames dt apart, pairs as in `SimState.time`; exact
    for a number dt, rounded to float32 if traced."""
    if isinstance(dt, jax.core.Tracer):
        high = dt * jnp.arange(steps + 1)
        return jnp.stack([high, jnp.zeros_like(high)], -1)
    seconds = float(dt) * np.arange(steps + 1)
    rounded = seconds.astype(np.float32)
    return jnp.asarray(np.stack([rounded, seconds - rounded], -1), jnp.float32)


def later(time: Array, by: Array) -> Array:
    """time (2,) plus each of by (T, 2), pairs as in `SimState.time`. Rounding errors of the high
    parts' sum are added to the low parts."""
    high = time[0] + by[:, 0]
    added = high - time[0]
    lost = (time[0] - (high - added)) + (by[:, 0] - added)
    return jnp.stack([high, lost + (time[1] + by[:, 1])], -1)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Struck:
    """Noise of an interval, maps (N,). some: whether a pixel sends any event; drawn (of
    `noise.draw`) and odds determine number, times and polarities."""

    some: Array
    drawn: Array
    odds: noise.Odds


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Disturbance:
    """Effects on pixels in an interval that do not depend on their memory. leaked: log units (N,),
    None without leak. struck: None without noise."""

    leaked: Array | None
    struck: Struck | None


def possible(camera: Camera, model: Constants, dt: Array) -> tuple[Camera, Array]:
    """Replace impossible parameters of a traced camera (theta <= 0, eta < 0, not finite).

    Within jit nothing can raise, and a pixel with a negative threshold would return numbers that
    look like events.

    Returns:
        The camera with valid parameters, and a factor (..., H, W) for its output: 1, or NaN where
        parameters were impossible; everywhere if a number of the model is (NaN), or dt (<= 0).
    """
    least = {"theta_on": 1e-30, "theta_off": 1e-30, "eta_on": 0.0, "eta_off": 0.0}
    maps = {name: jnp.asarray(getattr(camera, name)) for name in least}
    good = [jnp.isfinite(values) & (values >= least[name]) for name, values in maps.items()]
    allowed = good[0] & good[1] & good[2] & good[3]
    numbers = [jnp.isfinite(number) for number in jax.tree.leaves(model)]
    known = jnp.stack([*numbers, jnp.isfinite(dt) & (dt > 0)]).all()
    put = Camera(**{name: jnp.where(allowed, values, 1.0) for name, values in maps.items()})
    unmoved = 1.0 + 0.0 * sum(maps.values())  # through it the gradients become NaN as well
    return put, jnp.where(allowed & known, 1.0, jnp.nan) * unmoved


def start(
    key: Array, log_frame: Array, camera: Camera, model: Constants,
    nominal: Array | None, phase: Array | float | None = None,
) -> tuple[Sensor, SimState]:
    """The sensor and its state after the first log frame; maps of any one shape, kept flat.

    nominal: `noise.nominal_thresholds`; None: no noise. phase: initial contrast of the pixels (log
    units, a map); that of a running camera is uniform in (-theta_off, theta_on). None: 0 as in v2e;
    where eta is all noise, as of a measured camera, what leaked since an event (`_leaked`).
    """
    k_leak, k_words, k_intervals = jax.random.split(key, 3)
    count = math.prod(log_frame.shape)
    flat = jax.tree.map(lambda m: m.reshape(count), camera)
    base = (log_frame - (0.0 if phase is None else phase)).reshape(count)
    log_i = log_frame.reshape(count)
    reference = jnp.mean(i01_of(model, log_i))
    pattern = noise.leak_pattern(model, k_leak, (count,))
    sensor = Sensor(
        flat,
        noise.pixel_words(k_words, count),
        None if nominal is None else noise.rates(model, flat, reference, nominal),
        noise.leak_rates(model, flat.theta_on, pattern) if model.leak_hz is not None else None,
    )
    if phase is None and model.eta_is_all and sensor.leaking is not None:
        base = base - jnp.where(sensor.leaking > 0, _leaked(
            model, sensor, sensor.leaking, reference), 0.0)  # it may be traced
    last = jnp.full_like(log_i, pixel.never_fired(model))
    inner = None if model.photoreceptor is None else second_order.at_rest(log_i)
    owed = jnp.zeros_like(log_i) if model.carries_leak else None
    pixels = PixelState(log_i, base, last, inner, owed)
    return sensor, SimState(
        pixels, jnp.zeros((), jnp.int32), jnp.zeros(2, jnp.float32), k_intervals)


def _leaked(model: Constants, sensor: Sensor, leaking: Array, reference: Array) -> Array:
    """The contrast (N,) of pixels of a running camera that sees no motion: leak since the last
    event, at most a threshold. The time since then is uniform up to the leak's period, or where
    noise resets the memory, exponential with its rate."""
    theta = jnp.minimum(sensor.camera.theta_on, noise.LEAK_THETA)
    u = jnp.minimum(noise.uniform(noise.scramble(sensor.words)), 0.999999)
    if sensor.rates is None or not model.noise_resets_memory:
        return theta * u
    on, off = sensor.rates.at(reference)
    many = jnp.maximum((on + off) * theta / jnp.maximum(leaking, 1e-12), 1e-3)  # in a period
    return theta * (-jnp.log1p(u * jnp.expm1(-many)) / many)


def i01_of(model: Constants, log_i: Array) -> Array:
    """Normalised intensity of log intensities."""
    return normalised_intensity(LOG_MAPS[model.log_map][1](log_i))


def disturb(
    model: Constants, sensor: Sensor, i01: Array, salt: Array, dt: Array
) -> Disturbance:
    """Leak and noise of an interval of dt seconds at normalised intensity i01 (N,). salt: the
    interval's `noise.salts`."""
    drawn, leaked, struck = noise.draw(sensor.words, salt), None, None
    if sensor.leaking is not None:
        leaked = noise.leak(model, sensor.leaking, sensor.words, drawn, dt)
    if sensor.rates is not None:
        odds = noise.odds(sensor.rates, i01, dt)
        struck = Struck(noise.uniform(drawn) < odds.some, drawn, odds)
    return Disturbance(leaked, struck)


def advance(
    model: Constants, camera: Camera, state: PixelState, log_i: Array, i01: Array,
    disturbance: Disturbance, dt: Array, clock: Clock,
) -> tuple[PixelState, Spikes]:
    """One frame interval of dt seconds that ends at the log frame log_i (N,), normalised
    intensity i01: the signal events, by per-pixel functions vmapped over (N,).

    dt = 0 with the same frame changes nothing and emits nothing (padding).
    """
    if model.photoreceptor is not None:
        assert state.inner is not None
        middle = 0.5 * (i01_of(model, state.inner.light) + i01)
        step = functools.partial(pixel.advance_second_order, model)
        state, spikes = jax.vmap(step, (0,) * 6 + (None,))(
            camera.theta_on, camera.theta_off, state, log_i, middle, disturbance.leaked, dt)
        return _reset(model, state, disturbance), spikes

    def contrast(
        on: Array, off: Array, s: PixelState, log: Array, i: Array, leak: Array | None
    ) -> tuple[PixelState, Array, Array, Array]:
        return pixel.contrast(model, on, off, s, log, i, leak, dt)

    state, theta, begin, end = jax.vmap(contrast)(
        camera.theta_on, camera.theta_off, state, log_i, i01, disturbance.leaked)
    most = jnp.zeros((), end.dtype)
    if model.timestamps == "v2e":
        most = jnp.max(floor_divide(end, jnp.abs(theta)))

    def send(s: PixelState, th: Array, b: Array, e: Array) -> tuple[PixelState, Spikes]:
        return pixel.send(model, s, th, b, e, dt, *clock, most)

    state, spikes = jax.vmap(send)(state, theta, begin, end)
    return _reset(model, state, disturbance), spikes


def _reset(model: Constants, state: PixelState, disturbance: Disturbance) -> PixelState:
    """The memory after noise events, where they reset it."""
    if disturbance.struck is None or not model.noise_resets_memory:
        return state
    some = disturbance.struck.some
    state = dataclasses.replace(state, base=jnp.where(some, state.lp, state.base))
    if state.inner is None:
        return state
    amplified = jnp.where(some, state.lp, state.inner.amplified)
    return dataclasses.replace(
        state, inner=dataclasses.replace(state.inner, amplified=amplified))
