"""Frames -> voxel grid, without making events.

`simulate_window` is pure; jit, vmap and scan it. Large frames are processed in tiles of pixels,
whose state, light and grid stay in the cache from the first frame to the last. If `simulate_voxels`
is called with bytes on a CPU, outside of jit, only pixels that may fire are stepped, in blocks.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from evflow.camera import Camera
from evflow.camera.sensors import SensorModel
from evflow.checks import plain
from evflow.errors import EvflowDataError
from evflow.light.log_maps import check_log
from evflow.simulator import circuits, noise, sensor
from evflow.simulator.active import BLOCK
from evflow.simulator.arguments import check_arguments, check_interval
from evflow.simulator.bins import Schedule
from evflow.simulator.constants import Constants
from evflow.simulator.grids import Touched, as_log, put, scan, scan_brownian
from evflow.simulator.pixel import PixelState
from evflow.simulator.sensor import Sensor, SimState
from evflow.voxel import BINS

Array = jax.Array

TILE = 8192  # pixels, whose maps and grid take some 1.5 MB


def simulate_window(
    model: Constants, whole: Sensor, state: SimState, log_frames: Array,
    frame_dt_s: Array | float, bins: int, times: Array | None = None,
) -> tuple[SimState, Array]:
    """Advance through log_frames (T, H, W), T frames after the state's own, equally spaced: log
    intensity, or bytes. times: `sensor.frame_times`, if known more exactly than from a traced
    frame_dt_s.

    Returns the state and the voxel grid (H, W, 2*bins) of the window of T intervals.
    """
    steps, *shape = log_frames.shape
    count = math.prod(shape)
    if times is None:
        times = sensor.frame_times(frame_dt_s, steps)
    clock = sensor.later(state.time, times)
    dt = jnp.asarray(frame_dt_s, jnp.float32)
    intervals = state.interval + jnp.arange(steps)
    salts = noise.salts(state.key, intervals)
    plan, lengths = Schedule.of(steps, bins), jnp.full(steps, dt)

    def scanned(maps: Any) -> tuple[PixelState, Array]:
        tile, pixels, frames = maps
        pixels, grid = scan(model, tile, pixels, frames, lengths, salts, clock, plan, bins)
        return pixels, grid.T

    maps = (whole, state.pixels, log_frames.reshape(steps, count))
    whole_at_once = count <= TILE or model.timestamps == "v2e"  # slots depend on all pixels
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


def simulate_voxels(
    key: Array, log_frames: ArrayLike, camera: Camera, *, frame_dt_s: Array | float,
    model: SensorModel | None = None, bins: int = BINS,
) -> Array:
    """Voxel grid of a video seen by a camera, on the device (Eq. 2 of the paper); jit and vmap it.

    Without leading axes the grid equals `simulate` followed by `voxelize` (same key, noise
    included) up to the microsecond rounding of event times; it also holds the few events that round
    to the last instant itself, where the half-open window of `voxelize` ends.

    Args:
        key: of jax.random; one serves all leading axes, split among them.
        log_frames: (..., T, H, W), T >= 2: float32 natural-log intensity in the map of
            `model.log_map`, or uint8 DN, which pass through that map, take a quarter of the memory
            and, outside of jit on a CPU, half the time.
        camera: maps (H, W), or (..., H, W) with the same leading axes.
        frame_dt_s: seconds from frame to frame, one number; may be traced. The window is the span
            of the frames.
        model: the pixel circuit; None is `SensorModel()`.
        bins: time bins B per polarity, >= 2.

    Returns:
        float32 (..., H, W, 2*bins), channels [ON 0..B-1, OFF 0..B-1], in events; within jit NaN at
        pixels whose parameters are impossible (theta <= 0, eta < 0), and everywhere if a number of
        the model or frame_dt_s is; they else raise EV014, EV020.

    Raises:
        EvflowDataError: EV002 (shape), EV003 (no logarithms, or those of another map), EV007 (NaN),
            EV014 (camera out of range, or more noise than an interval holds), EV015 (frames and
            camera of different size), EV020 (no key, camera or model; bins, frame_dt_s).

    Example:
        >>> log_frames = to_log(frames)  # of evflow.light.log_maps
        >>> voxels = ef.simulate_voxels(key, log_frames, camera, frame_dt_s=1e-3)
    """
    check_arguments(key, camera, model)
    law = Constants.of(model or SensorModel())
    log_frames = jnp.asarray(plain("log_frames", log_frames))
    if log_frames.dtype != jnp.uint8:
        log_frames = log_frames.astype(jnp.float32)
    if log_frames.ndim < 3 or log_frames.shape[-3] < 2:
        raise EvflowDataError("EV002", f"log_frames has shape {log_frames.shape}.",
                              "Expected (..., T, H, W) with at least two frames.")
    if not isinstance(bins, int | np.integer) or bins < 2:
        raise EvflowDataError("EV020", f"bins={bins!r}.", "It is a whole number, >= 2.")
    seconds = check_interval(frame_dt_s)
    if log_frames.dtype != jnp.uint8:
        check_log("log_frames", log_frames, law.log_map)
    if camera.shape[-2:] != log_frames.shape[-2:]:
        raise EvflowDataError(
            "EV015", f"the camera is {camera.shape[-2:]}, the frames {log_frames.shape[-2:]}.")
    lead = log_frames.shape[:-3]
    if camera.shape[:-2] not in ((), lead):
        raise EvflowDataError(
            "EV015", f"the camera's leading axes are {camera.shape[:-2]}, the frames' {lead}.",
            "Give one camera (H, W) or one for each video.")
    camera = jax.tree.map(lambda m: jnp.asarray(m, jnp.float32), sensor.simulable(camera))
    if seconds is not None and _by_blocks(key, law, log_frames, camera):
        return _in_blocks(key, np.asarray(log_frames), camera, seconds, law, bins)
    nominal = noise.nominal_thresholds(law, camera) if noise.is_noisy(law, camera) else None
    if nominal is not None and seconds is not None:
        noise.check_rate(noise.most_rate(law, camera, nominal), seconds)
    times = sensor.frame_times(frame_dt_s, log_frames.shape[-3] - 1)
    return _voxels(key, log_frames, camera, nominal, jnp.asarray(frame_dt_s, jnp.float32), times,
                   law, bins=bins, lead=lead)


def _by_blocks(key: Array, model: Constants, frames: Array, camera: Camera) -> bool:
    """Whether the host can determine the pixels that may fire, and a CPU gains by it."""
    new = jnp.zeros(())  # traced within jit, even if all arguments are concrete
    given = jax.tree.leaves((key, model, frames, camera, new))
    traced = any(isinstance(value, jax.core.Tracer) for value in given)
    return (not traced and frames.ndim == 3 and frames.dtype == jnp.uint8
            and model.kind != "voltmeter" and model.timestamps != "v2e"
            and jax.default_backend() == "cpu")


def _in_blocks(
    key: Array, frames: np.ndarray, camera: Camera, frame_dt_s: float, model: Constants,
    bins: int,
) -> Array:
    """Voxels (H, W, 2 * bins) of bytes (T, H, W), stepping only active pixels."""
    count, *shape = frames.shape
    touched = Touched(count - 1, bins)
    pixels = circuits.thresholds(
        key, frames[0], 0, camera, model, exit=touched, tick_s=frame_dt_s)
    grid = jnp.zeros((*shape, 2 * bins), jnp.float32)

    def video() -> Iterator[tuple[list[np.ndarray], np.ndarray]]:
        for first in range(1, count, BLOCK):
            some = frames[first : first + BLOCK]
            yield list(some.reshape(len(some), -1)), np.arange(first - 1, first + len(some))

    for (pieces, *_), low in zip(pixels.steps(video()), touched.low, strict=True):
        for at, _, more in pieces:
            padded = np.zeros(len(more), np.int32)
            padded[: len(at)] = at
            grid = put(grid, padded, len(at), low, more)
    return grid


@partial(jax.jit, static_argnames=("bins", "lead"))
def _voxels(
    key: Array, log_frames: Array, camera: Camera, nominal: Array | None, dt: Array,
    times: Array, model: Constants, *, bins: int, lead: tuple[int, ...],
) -> Array:
    def one(key: Array, frames: Array, camera: Camera, nominal: Array | None) -> Array:
        camera, marks = sensor.possible(camera, model, dt)
        return grid_of(key, frames, camera, nominal) * marks[..., None]

    def grid_of(key: Array, frames: Array, camera: Camera, nominal: Array | None) -> Array:
        if model.kind != "voltmeter":
            first = as_log(model, frames[0])
            whole, state = sensor.start(key, first, camera, model, nominal)
            return simulate_window(model, whole, state, frames[1:], dt, bins, times)[1]
        key, signal = jax.random.split(key)
        frames = as_log(model, frames)
        whole, state = sensor.start(key, frames[0], camera, model, nominal)
        steps, *shape = frames.shape
        salts = noise.salts(state.key, jnp.arange(steps - 1))
        grid = scan_brownian(signal, model, whole, frames.reshape(steps, -1), salts, dt, bins)
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
