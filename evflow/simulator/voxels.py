"""Log frames -> voxel grid without ever making an event; jit, vmap and scan it.

The frames are scanned, `sensor.advance` says when events fall, `bins` what they weigh, and each
interval's few touched bins are added to the grid in place. Large frames are taken in tiles of
pixels, whose state, light and grid stay in the cache from the first frame to the last.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from evflow.camera import Camera
from evflow.errors import EvflowDataError
from evflow.intensity import LOG_MAPS, normalised_intensity, to_log
from evflow.sensors import SensorModel
from evflow.simulator import bins as weigh
from evflow.simulator import noise, sensor, voltmeter
from evflow.simulator.bins import Schedule
from evflow.simulator.pixel import PixelState, Spikes
from evflow.simulator.sensor import Sensor, SimState, Struck
from evflow.voxel import BINS

Array = jax.Array
Weights = tuple[list[Array], list[Array]]  # (ON, OFF), one (N,) per touched bin

MOST_LOG = 6.0  # more than the logarithm of 255 DN
TILE = 8192  # pixels; their maps and grid, some 1.5 MB, are worked on at a time


def simulate_window(
    model: SensorModel, whole: Sensor, state: SimState, log_frames: Array,
    frame_dt_s: Array | float, bins: int,
) -> tuple[SimState, Array]:
    """Advance through log_frames (T, H, W), T frames after the state's own, equally spaced: log
    intensity, or bytes.

    Returns the state and the voxel grid (H, W, 2*bins) of the window of T intervals.
    """
    steps, *shape = log_frames.shape
    count = math.prod(shape)
    dt = jnp.asarray(frame_dt_s, jnp.float32)
    intervals = state.interval + jnp.arange(steps)
    salts = noise.salts(state.key, intervals)
    high, low = state.time
    clock = jnp.stack([high + dt * jnp.arange(steps + 1), jnp.full(steps + 1, low)], -1)

    def scanned(maps: Any) -> tuple[PixelState, Array]:
        tile, pixels, frames = maps
        return _scan(model, tile, pixels, frames, salts, clock, dt, bins)

    maps = (whole, state.pixels, log_frames.reshape(steps, count))
    whole_at_once = count <= TILE or model.timestamps == "v2e"  # whose slots depend on all pixels
    pixels, grid = scanned(maps) if whole_at_once else _tiled(scanned, maps, count)
    end = SimState(pixels, intervals[-1] + 1, clock[-1], state.key)
    return end, grid.reshape(*shape, 2 * bins)


def _tiled(
    scanned: Callable[[Any], tuple[PixelState, Array]], maps: Any, count: int
) -> tuple[PixelState, Array]:
    """`scanned` tile by tile. maps: (..., count) each. A tile is a multiple of 128 pixels (loops
    with a remainder take XLA twice as long), so the last one repeats pixels of the one before."""
    tiles = math.ceil(count / TILE)
    size = 128 * math.ceil(count / tiles / 128)

    def tile(i: Array | int) -> tuple[Array, tuple[PixelState, Array]]:
        at = jnp.minimum(i * size, count - size)
        cut = partial(jax.lax.dynamic_slice_in_dim, start_index=at, slice_size=size, axis=-1)
        return at, scanned(jax.tree.map(cut, maps))

    def put(i: Array | int, done: tuple[PixelState, Array]) -> tuple[PixelState, Array]:
        at, parts = tile(i)
        return jax.tree.map(
            lambda whole, part: jax.lax.dynamic_update_slice_in_dim(whole, part, at, 0),
            done, parts)

    shapes = jax.eval_shape(lambda: tile(0)[1])
    empty = jax.tree.map(lambda s: jnp.zeros((count, *s.shape[1:]), s.dtype), shapes)
    return jax.lax.fori_loop(0, tiles, put, empty)


def _scan(
    model: SensorModel, whole: Sensor, pixels: PixelState, log_frames: Array, salts: Array,
    clock: Array, dt: Array, bins: int,
) -> tuple[PixelState, Array]:
    """`simulate_window` on flat maps: log_frames (T, N) -> grid (N, 2 * bins). salts: (T, 2).
    clock: (T + 1, 2), as in `SimState.time`."""
    steps, count = log_frames.shape
    plan = Schedule.of(steps, bins)
    def body(
        carry: tuple[PixelState, Array], inputs: tuple[Any, ...]
    ) -> tuple[tuple[PixelState, Array], None]:
        (pixels, grid), (frame, low, offset, wide, salt, clock) = carry, inputs
        log_i = _log(model, frame)
        i01 = sensor.i01_of(model, log_i)  # dropped by the compiler where nothing uses it
        dist = sensor.disturb(model, whole, i01, salt, dt)
        pixels, spikes = sensor.advance(
            model, whole.camera, pixels, log_i, i01, dist, dt, clock)
        weights = _weights(model, plan, spikes, offset, wide, dt)
        if dist.struck is not None:
            more = _noise_weights(model, plan, whole.words, dist.struck, offset)
            weights = jax.tree.map(jnp.add, weights, more)
        return (pixels, weigh.add(grid, low, *weights)), None

    inputs = (log_frames, plan.low, plan.offset, plan.wide, salts, (clock[:-1], clock[1:]))
    grid = jnp.zeros((2 * bins, count), pixels.lp.dtype)
    pixels, grid = jax.lax.scan(body, (pixels, grid), inputs)[0]
    return pixels, grid.T


def _log(model: SensorModel, frames: Array) -> Array:
    """Log intensity of frames, which they hold unless they are bytes."""
    return to_log(frames, model.log_map) if frames.dtype == jnp.uint8 else frames


def _scan_brownian(
    key: Array, model: SensorModel, whole: Sensor, log_frames: Array, salts: Array, dt: Array,
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


def _weights(
    model: SensorModel, plan: Schedule, spikes: Spikes, offset: Array, wide: Array, dt: Array
) -> Weights:
    """Weights of the signal events of an interval."""
    dead = model.refractory_s / dt if model.waits else None

    def signed(width: int, spikes: Spikes) -> list[Array]:
        spare = [jnp.zeros_like(spikes.first)] * (plan.width - width)
        return weigh.signal_bins(width, spikes, offset, plan.length, dead) + spare

    # The branch saves the third bin where it is not touched; it also is where XLA writes the
    # spikes down once, instead of computing them again for every bin and polarity.
    return weigh.by_polarity(
        jax.lax.cond(wide, partial(signed, plan.width), partial(signed, 2), spikes))


def _noise_weights(
    model: SensorModel, plan: Schedule, words: Array, struck: Struck, offset: Array
) -> Weights:
    """Weights of the noise events of one interval, each pixel's first and the few others."""
    u, mean = noise.uniform(struck.drawn), struck.odds.mean

    def placed(k: Array, sent: Array) -> Array:
        """Where each pixel's k-th event falls, negative for OFF, 0 where none is sent."""
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

    # Behind a branch XLA writes the places down once, not again for every bin and polarity.
    first = jax.lax.cond(jnp.any(struck.some), lambda: placed(jnp.zeros((), jnp.uint32),
                         struck.some), lambda: jnp.zeros_like(u))
    tail = jax.tree.map(jnp.asarray, noise.next_tail(mean, struck.odds.tail()))
    return jax.lax.while_loop(unfinished, step, (tail, weights(first)))[1]


def simulate_voxels(
    key: Array, log_frames: Array, camera: Camera, *, frame_dt_s: float,
    model: SensorModel | None = None, bins: int = BINS,
) -> Array:
    """Voxel grid of a video seen by a camera, on the device (Eq. 2).

    log_frames: float32 (..., T, H, W) natural-log intensity in the map of `model.log_map`, or
    uint8 DN, which pass through that map on the way (and take a quarter of the memory);
    frame_dt_s seconds apart, the window is their span. camera: maps (H, W), or (..., H, W)
    with the same leading axes. Returns float32 (..., H, W, 2*bins). One key serves all
    leading axes, split among them. Without leading axes the grid equals `simulate` followed
    by `voxelize` (same key, noise included) up to the microsecond rounding of event times.
    """
    model = model or SensorModel()
    log_frames = jnp.asarray(log_frames)
    if log_frames.dtype != jnp.uint8:
        log_frames = log_frames.astype(jnp.float32)
    if log_frames.ndim < 3 or log_frames.shape[-3] < 2:
        raise EvflowDataError("EV002", f"log_frames has shape {log_frames.shape}.",
                              "Expected (..., T, H, W) with at least two frames.")
    if not 0 < frame_dt_s < math.inf or bins < 2:
        raise EvflowDataError("EV020", f"frame_dt_s={frame_dt_s}, bins={bins}.",
                              "Need frame_dt_s > 0 and bins >= 2.")
    known = not isinstance(log_frames, jax.core.Tracer) and log_frames.dtype != jnp.uint8
    if known:
        _check_light(np.asarray(log_frames))
    if camera.shape[-2:] != log_frames.shape[-2:]:
        raise EvflowDataError(
            "EV015", f"the camera is {camera.shape[-2:]}, the frames {log_frames.shape[-2:]}.")
    lead = log_frames.shape[:-3]
    if camera.shape[:-2] not in ((), lead):
        raise EvflowDataError(
            "EV015", f"the camera's leading axes are {camera.shape[:-2]}, the frames' {lead}.",
            "Give one camera (H, W) or one for each video.")
    camera.validate()
    camera = jax.tree.map(lambda m: jnp.asarray(m, jnp.float32), camera)
    nominal = noise.nominal_thresholds(model, camera) if noise.is_noisy(model, camera) else None
    if nominal is not None:
        noise.check_rate(noise.most_rate(model, camera, nominal), frame_dt_s)
    return _voxels(key, log_frames, camera, nominal, frame_dt_s=float(frame_dt_s), model=model,
                   bins=bins, lead=lead)


def _check_light(log_frames: np.ndarray) -> None:
    """EV007 where not all is finite (a sum tells in a third of the time, unless it overflows),
    EV003 where it cannot be a logarithm of DN."""
    with np.errstate(over="ignore", invalid="ignore"):
        mean = log_frames.sum() / max(log_frames.size, 1)
        if not (np.isfinite(mean) or np.isfinite(log_frames).all()):
            raise EvflowDataError("EV007", "log_frames holds NaN or infinite values.",
                                  "The logarithm of 0 or of a missing pixel? Use intensity.to_log.")
    if mean > MOST_LOG:
        raise EvflowDataError(
            "EV003", f"log_frames has a mean of {mean:.3g}, but white (255 DN) has 5.54.",
            "Is it DN? Pass uint8, or take intensity.to_log first.")


@partial(jax.jit, static_argnames=("frame_dt_s", "model", "bins", "lead"))
def _voxels(
    key: Array, log_frames: Array, camera: Camera, nominal: Array | None, *, frame_dt_s: float,
    model: SensorModel, bins: int, lead: tuple[int, ...],
) -> Array:
    def one(key: Array, frames: Array, camera: Camera, nominal: Array | None) -> Array:
        if model.kind != "voltmeter":
            first = _log(model, frames[0])
            whole, state = sensor.start(key, first, camera, model, nominal)
            return simulate_window(model, whole, state, frames[1:], frame_dt_s, bins)[1]
        key, signal = jax.random.split(key)
        frames = _log(model, frames)
        whole, state = sensor.start(key, frames[0], camera, model, nominal)
        steps, *shape = frames.shape
        salts = noise.salts(state.key, jnp.arange(steps - 1))
        dt = jnp.asarray(frame_dt_s, jnp.float32)
        grid = _scan_brownian(signal, model, whole, frames.reshape(steps, -1), salts, dt, bins)
        return grid.reshape(*shape, 2 * bins)

    if not lead:
        return one(key, log_frames, camera, nominal)
    batch = math.prod(lead)
    shape = log_frames.shape[-2:]
    keys = jax.random.split(key, batch)
    cameras = jax.tree.map(lambda m: jnp.broadcast_to(m, (*lead, *shape)).reshape(-1, *shape),
                           camera)
    if nominal is not None:
        nominal = jnp.broadcast_to(jnp.moveaxis(nominal, 0, -1), (*lead, 2)).reshape(batch, 2)
    grids = jax.vmap(one)(keys, log_frames.reshape(batch, *log_frames.shape[-3:]), cameras, nominal)
    return grids.reshape(*lead, *grids.shape[1:])
