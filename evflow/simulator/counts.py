"""Event counts per pixel and polarity: exact, or smooth with gradients.

Counts are step functions of theta. The smooth mode replaces each step by a ramp around it. At the
width of a threshold the count is the expectation for a pixel whose memory is uniformly distributed
between thresholds; at width 0 it is the exact count. Gradients in theta, eta and light are those of
the ramp.
"""

from __future__ import annotations

import dataclasses
import math
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from evflow.camera import Camera
from evflow.camera.arguments import number
from evflow.camera.sensors import SensorModel
from evflow.checks import plain
from evflow.errors import EvflowDataError
from evflow.light.log_maps import check_log
from evflow.simulator import noise, pixel, sensor
from evflow.simulator.arguments import check_arguments, check_interval
from evflow.simulator.constants import Constants
from evflow.simulator.grids import as_log
from evflow.simulator.pixel import PixelState
from evflow.simulator.sensor import Sensor, SimState

Array = jax.Array


def simulate_counts(
    key: Array, log_frames: ArrayLike, camera: Camera, *, frame_dt_s: Array | float,
    model: SensorModel | None = None, smooth: float = 0.0,
) -> Array:
    """Events per pixel and polarity of a video; jit, vmap and differentiate it.

    Args:
        key: of jax.random; with smooth > 0 it only draws the leak's pattern
            and phases.
        log_frames: (T, H, W), T >= 2: natural-log intensity in the map of `model.log_map`, or
            uint8 DN that pass through that map.
        camera: maps (H, W).
        frame_dt_s: seconds from frame to frame; may be traced.
        model: the pixel circuit; None is `SensorModel()`.
        smooth: 0 gives exact counts without gradient; up to 1, each threshold becomes a ramp of
            this width (in thresholds), noise its expectation, and counts have gradients in theta,
            eta and light.

    Returns:
        (H, W, 2) = [ON, OFF] events, float32 (float64 where log_frames are); within jit NaN at
        pixels whose parameters are impossible (theta <= 0, eta < 0), and everywhere if a number of
        the model or frame_dt_s is; they else raise EV014, EV020.

    Raises:
        EvflowDataError: EV002 (shape), EV003 (no logarithms, or those of another map), EV007 (NaN),
            EV014 (camera out of range, or more noise than an interval holds), EV015 (frames and
            camera of different size), EV020 (no key, camera or model; options; a
            model that has no such counts).
    """
    check_arguments(key, camera, model)
    model = model or SensorModel()
    law = Constants.of(model)
    log_frames = as_log(law, jnp.asarray(plain("log_frames", log_frames)))
    if log_frames.dtype != jnp.float64:
        log_frames = log_frames.astype(jnp.float32)
    if log_frames.ndim != 3 or len(log_frames) < 2:
        raise EvflowDataError("EV002", f"log_frames has shape {log_frames.shape}.",
                              "Expected (T, H, W) with at least two frames; vmap for more.")
    if camera.shape != log_frames.shape[1:]:
        raise EvflowDataError(
            "EV015", f"the camera is {camera.shape}, the frames {log_frames.shape[1:]}.")
    if not 0 <= number(smooth) <= 1:
        raise EvflowDataError("EV020", f"smooth={smooth!r:.60}.",
                              "Choose a number from 0 (exact) to 1, not traced.")
    unsmooth = (law.refractory_s, law.leak_jitter, law.photoreceptor)
    if law.kind == "voltmeter" or (smooth and any(part is not None for part in unsmooth)):
        raise EvflowDataError(
            "EV020", f"{model} has no {'smooth ' if smooth else ''}counts.",
            "Add up simulate_voxels over bins." if law.kind == "voltmeter" else
            "Its dead time, jitter and second order have no gradient: dataclasses.replace(model, "
            "refractory_s=0, leak_jitter=0, photoreceptor=None).")
    check_log("log_frames", log_frames, law.log_map)
    seconds = check_interval(frame_dt_s)
    camera = jax.tree.map(lambda m: jnp.asarray(m, log_frames.dtype), sensor.simulable(camera))
    nominal = noise.nominal_thresholds(law, camera) if noise.is_noisy(law, camera) else None
    if nominal is not None and seconds is not None:
        noise.check_rate(noise.most_rate(law, camera, nominal), seconds)
    times = sensor.frame_times(frame_dt_s, len(log_frames) - 1)
    return _counts(key, log_frames, camera, nominal, jnp.asarray(frame_dt_s, jnp.float32), times,
                   law, smooth=float(smooth))


@partial(jax.jit, static_argnames="smooth")
def _counts(
    key: Array, log_frames: Array, camera: Camera, nominal: Array | None, dt: Array,
    times: Array, model: Constants, *, smooth: float,
) -> Array:
    steps, *shape = log_frames.shape
    camera, marks = sensor.possible(camera, model, dt)
    whole, state = sensor.start(key, log_frames[0], camera, model, nominal)
    frames = log_frames[1:].reshape(steps - 1, math.prod(shape))
    if smooth:  # unrounded thresholds, as rounded ones have no gradient
        whole = dataclasses.replace(whole, camera=jax.tree.map(jnp.ravel, camera))
    scan = partial(_scan_smooth, smooth) if smooth else partial(_scan, times)
    counts = jnp.stack(scan(model, whole, state, frames, dt), -1)
    return counts.reshape(*shape, 2) * marks[..., None]


def _scan(
    clock: Array, model: Constants, whole: Sensor, state: SimState, frames: Array, dt: Array
) -> tuple[Array, Array]:
    """(ON, OFF) counts (N,) over flat log frames (T, N); clock: times (T + 1, 2) of all frames."""
    steps = jnp.arange(len(frames))

    def body(
        carry: tuple[PixelState, Array, Array], inputs: tuple[Any, ...]
    ) -> tuple[tuple[PixelState, Array, Array], None]:
        (pixels, on, off), (log_i, salt, begin, end) = carry, inputs
        i01 = sensor.i01_of(model, log_i)
        dist = sensor.disturb(model, whole, i01, salt, dt)
        pixels, spikes = sensor.advance(
            model, whole.camera, pixels, log_i, i01, dist, dt, (begin, end))
        on, off = on + jnp.maximum(spikes.count, 0.0), off + jnp.maximum(-spikes.count, 0.0)
        if dist.struck is not None:
            more = _struck(model, whole.words, dist.struck)
            on, off = on + more[0], off + more[1]
        return (pixels, on, off), None

    zero = jnp.zeros_like(frames[0])
    inputs = (frames, noise.salts(state.key, steps), clock[:-1], clock[1:])
    (_, on, off), _ = jax.lax.scan(body, (state.pixels, zero, zero), inputs)
    return on, off


def _struck(model: Constants, words: Array, struck: sensor.Struck) -> tuple[Array, Array]:
    """(ON, OFF) noise events of an interval, the same as of `simulate`."""
    u, mean = noise.uniform(struck.drawn), struck.odds.mean

    def step(carry: tuple[noise.Tail, Array, Array]) -> tuple[noise.Tail, Array, Array]:
        tail, on, off = carry
        k = jnp.asarray(tail[2], jnp.uint32)
        rising = noise.event(model, words, struck.drawn, k, struck.odds.share)[1]
        sent = u < tail[0]
        more = [(sent & way).astype(on.dtype) for way in (rising, ~rising)]
        return noise.next_tail(mean, tail), on + more[0], off + more[1]

    zero = jnp.zeros_like(u)
    start = (jax.tree.map(jnp.asarray, struck.odds.tail()), zero, zero)
    return jax.lax.while_loop(lambda c: jnp.any(u < c[0][0]), step, start)[1:]


def soft_floor(x: Array, width: float) -> Array:
    """floor(x) whose steps are smooth ramps (3 s^2 - 2 s^3) of a width <= 1 around the integers:
    the mean over x is that of floor, the derivative is continuous."""
    shifted = x + 0.5 * width
    whole = jnp.floor(shifted)
    s = jnp.clip((shifted - whole) / width, 0.0, 1.0)
    return whole - 1.0 + s * s * (3.0 - 2.0 * s)


def _scan_smooth(
    smooth: float, model: Constants, whole: Sensor, state: SimState, frames: Array, dt: Array
) -> tuple[Array, Array]:
    """(ON, OFF) smooth counts (N,); the memory moves by these counts times theta."""
    camera = whole.camera

    def body(
        carry: tuple[PixelState, Array, Array], log_i: Array
    ) -> tuple[tuple[PixelState, Array, Array], None]:
        pixels, on, off = carry
        i01 = sensor.i01_of(model, log_i)
        lp, base, owed = log_i, pixels.base, pixels.owed
        if model.corner is not None:
            lp = pixel.low_pass(model, pixels.lp, log_i, i01, dt)
        if whole.leaking is not None:
            base, owed = pixel.lowered(base, owed, whole.leaking * dt)
        contrast = lp - base
        up, down = (jnp.maximum(soft_floor(sign * contrast / theta, smooth), 0.0)
                    for sign, theta in ((1.0, camera.theta_on), (-1.0, camera.theta_off)))
        base, owed = pixel.lowered(base, owed, down * camera.theta_off - up * camera.theta_on)
        if whole.rates is not None:
            rates = whole.rates.at(i01)
            if model.noise_resets_memory:
                some = noise.some(dt * (rates[0] + rates[1]))
                base = base + some * (lp - base)
            up, down = up + dt * rates[0], down + dt * rates[1]
        return (dataclasses.replace(pixels, lp=lp, base=base, owed=owed), on + up, off + down), None

    zero = jnp.zeros_like(frames[0])
    (_, on, off), _ = jax.lax.scan(body, (state.pixels, zero, zero), frames)
    return on, off
