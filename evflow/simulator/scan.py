"""The simulator's device side: pixels vmapped, frames scanned, nothing but arrays.

`start` makes a state from the first log frame, `advance` moves it by one frame interval. Both
exits (events on the host, voxels on the device) run the same `advance`, so they count alike.
"""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from evflow.camera import Camera, SensorModel
from evflow.intensity import LOG_MAPS, normalised_intensity
from evflow.simulator import noise, pixel
from evflow.simulator.pixel import PixelState, Spikes

Array = jax.Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class SimState:
    """pixels: PixelState of (H, W) maps; leak_pattern (H, W); reference: mean I01 of frame 0;
    frame: index of the next frame, which alone seeds its noise; time: of the last frame, seconds
    since frame 0 as a (2,) float32 pair, high and low part (only v2e's slots read it); key: the
    typed key."""

    pixels: PixelState
    leak_pattern: Array
    reference: Array
    frame: Array
    time: Array
    key: Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Interval:
    """What one interval emits, each (H, W): signal spikes and noise counts per polarity.
    noise_at: where in the interval the noise falls, a fraction (2, H, W), see noise.placed."""

    spikes: Spikes
    noise_on: Array
    noise_off: Array
    noise_at: Array


def start(
    key: Array, log_frame: Array, model: SensorModel, phase: Array | float = 0.0
) -> SimState:
    """State after the first log frame (H, W).

    phase: contrast already on the pixel (log units, (H, W) or 0 as in v2e); a recording cut
    from a running camera has it uniform in (-theta_off, theta_on).
    """
    k_leak, k_frames = jax.random.split(key)
    i01 = normalised_intensity(LOG_MAPS[model.log_map][1](log_frame))
    never = 1e6 if model.timestamps == "crossing" else -model.refractory_s
    return SimState(
        PixelState(log_frame, log_frame - phase, jnp.full_like(log_frame, never)),
        noise.leak_pattern(model, k_leak, log_frame.shape),
        jnp.mean(i01),
        jnp.ones((), jnp.int32),
        jnp.zeros(2, jnp.float32),
        k_frames,
    )


def _signal(
    model: SensorModel, camera: Camera, state: PixelState, log_i: Array, i01: Array,
    leak: Array, dt: Array, clock: tuple[Array, Array],
) -> tuple[PixelState, Spikes]:
    """Signal events of one interval, by per-pixel functions vmapped over (H, W)."""

    def over_pixels(f):
        return jax.vmap(jax.vmap(f))

    step = over_pixels(lambda on, off, s, log, i, leaked: pixel.pixel_step(
        model, on, off, s, log, i, leaked, dt))
    state, begin, end = step(camera.theta_on, camera.theta_off, state, log_i, i01, leak)
    rising = end > 0
    theta = jnp.where(rising, camera.theta_on, camera.theta_off)
    begin, end = jnp.where(rising, begin, -begin), jnp.abs(end)
    if model.timestamps == "v2e":
        most = jnp.max(pixel.floor_divide(end, theta))
        spikes, last = over_pixels(lambda th, e, last: pixel.slots(
            model, th, e, last, dt, *clock, most))(theta, end, state.last)
        state = dataclasses.replace(state, last=last)
    else:
        spikes = over_pixels(lambda th, b, e, last: pixel.crossings(
            model, th, b, e, last, dt))(theta, begin, end, state.last)
    return over_pixels(lambda on, off, s, k, r: pixel.settle(model, on, off, s, k, r, dt))(
        camera.theta_on, camera.theta_off, state, spikes, rising)


def advance(
    model: SensorModel, noisy: bool, camera: Camera, state: SimState, log_i: Array, dt: Array,
    end_s: Array,
) -> tuple[SimState, Interval]:
    """One frame interval of dt seconds that ends at the log frame log_i (H, W), at end_s, a
    (2,) pair as in `SimState.time`.

    dt = 0 with the same frame changes nothing and emits nothing (padding). noisy=False
    leaves out the noise draws for cameras known to be silent.
    """
    k_on_off, k_leak = jax.random.split(jax.random.fold_in(state.key, state.frame))
    i01 = normalised_intensity(LOG_MAPS[model.log_map][1](log_i))
    leak = jnp.zeros_like(log_i)
    if model.leak_hz > 0:
        leak = noise.leak_contrast(model, camera.theta_on, state.leak_pattern, k_leak, dt)
    pixels, spikes = _signal(model, camera, state.pixels, log_i, i01, leak, dt,
                             (state.time, end_s))
    counts = at = jnp.zeros((2, *log_i.shape), jnp.float32)
    if noisy:
        rates = jnp.stack(noise.noise_rates(model, camera, i01, state.reference))
        u, at = noise.uniform_pair(k_on_off, counts.shape)
        counts = noise.poisson(u, rates * dt)
        if model.noise_resets_memory:
            struck = counts[0] + counts[1] > 0
            base = jnp.where(struck, pixels.lp, pixels.base)
            pixels = dataclasses.replace(pixels, base=base)
    state = dataclasses.replace(state, pixels=pixels, frame=state.frame + 1, time=end_s)
    return state, Interval(spikes, counts[0], counts[1], at)


def is_noisy(model: SensorModel, camera: Camera) -> bool:
    """False only where no noise event can occur (host side; traced cameras count as noisy)."""
    etas = (camera.eta_on, camera.eta_off)
    if model.shot_hz > 0 or any(isinstance(e, jax.core.Tracer) for e in etas):
        return True
    return any(bool(np.any(np.asarray(eta) > 0)) for eta in etas)


@partial(jax.jit, static_argnames=("model", "noisy"))
def advance_chunk(
    camera: Camera, state: SimState, log_frames: Array, dt: Array, end_s: Array, *,
    model: SensorModel, noisy: bool,
) -> tuple[SimState, Interval]:
    """Scan `advance` over log_frames (T, H, W), dt (T,) and end_s (T, 2); outputs gain a leading
    T axis."""

    def body(state: SimState, inputs: tuple[Array, Array, Array]) -> tuple[SimState, Interval]:
        return advance(model, noisy, camera, state, *inputs)

    return jax.lax.scan(body, state, (log_frames, dt, end_s))
