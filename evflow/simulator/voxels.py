"""Log frames -> voxel grid without ever making an event; jit, vmap and scan it.

Within an interval a pixel's events sit on an arithmetic progression, so the sum of their
triangular weights (Eq. 2) has a closed form: the hat is a second difference of ramps,
hat(s - j) = r(j+1-s) - 2 r(j-s) + r(j-1-s), and a sum of ramps over a progression needs only
the number of terms below each knot. An interval touches few bins; only those are computed.
"""

from __future__ import annotations

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from evflow.camera import Camera, SensorModel
from evflow.errors import EvflowDataError
from evflow.simulator import noise, scan
from evflow.simulator.scan import Interval, SimState
from evflow.voxel import BINS

Array = jax.Array


def ramp_sum(knot: Array, first: Array, spacing: Array, count: Array) -> Array:
    """Sum over k < count of max(0, knot - (first + k spacing)), element-wise."""
    room = knot - first
    below = jnp.floor(room / jnp.maximum(spacing, 1e-12)) + 1.0
    below = jnp.clip(jnp.where(room > 0, below, 0.0), 0.0, count)
    return below * room - spacing * (0.5 * below * (below - 1.0))


def hat_sums(low: Array, width: int, first: Array, spacing: Array, count: Array) -> Array:
    """Weights (width, ...) that a progression of events puts on bins low, low+1, ...

    first, spacing are in bins; every event must lie in [low, low + width - 1].
    """
    knots = [low + (j - 1.0) for j in range(width + 2)]
    ramps = [ramp_sum(knot, first, spacing, count) for knot in knots]
    return jnp.stack([ramps[j] - 2.0 * ramps[j + 1] + ramps[j + 2] for j in range(width)])


def _interval_bins(
    interval: Interval, low: Array, begin: Array, length: Array, width: int, dead: Array | None
) -> Array:
    """Weights (width, 2, H, W) of one interval that spans [begin, begin + length] bins.

    dead: the refractory period in interval lengths, None where pixels never wait."""
    spikes = interval.spikes
    count = jnp.abs(spikes.count).astype(jnp.float32)
    if dead is not None:  # refractory: the waiting events come first, dead apart, then the crossings
        gain = jnp.maximum(spikes.spacing - dead, 1e-9)
        waiting = jnp.ceil(jnp.maximum(spikes.earliest - spikes.first, 0.0) / gain)
        waiting = jnp.clip(waiting, 0.0, count)
        signal = hat_sums(low, width, begin + spikes.earliest * length,
                          jnp.zeros_like(count) + dead * length, waiting)
        at = spikes.first + waiting * spikes.spacing
        signal += hat_sums(low, width, begin + at * length, spikes.spacing * length,
                           count - waiting)
    else:
        signal = hat_sums(low, width, begin + spikes.first * length, spikes.spacing * length,
                          count)
    rising = spikes.count > 0
    pair = jnp.stack([jnp.where(rising, signal, 0.0), jnp.where(rising, 0.0, signal)], 1)
    return pair + _noise_bins(interval, low, begin, length, width)


def _noise_bins(
    interval: Interval, low: Array, begin: Array, length: Array, width: int
) -> Array:
    """Weights (width, 2, H, W) of the noise events."""
    counts = jnp.stack([interval.noise_on, interval.noise_off])
    bins = low + jnp.arange(width, dtype=jnp.float32).reshape(width, 1, 1, 1)

    def place(k: int, total: Array) -> Array:
        s = begin + noise.placed(interval.noise_at, k) * length
        hat = jnp.maximum(0.0, 1.0 - jnp.abs(bins - s[None]))
        return total + hat * (counts > k)[None]

    most = jnp.max(counts).astype(jnp.int32)
    zero = jnp.zeros((width, *counts.shape), jnp.float32)
    return jax.lax.fori_loop(0, most, place, zero)


def simulate_window(
    model: SensorModel, noisy: bool, camera: Camera, state: SimState, log_frames: Array,
    frame_dt_s: Array | float, bins: int,
) -> tuple[SimState, Array]:
    """Advance through log_frames (T, H, W), T frames after the state's own, equally spaced.

    Returns the state and the voxel grid (H, W, 2*bins) of the window of T intervals.
    """
    steps = log_frames.shape[0]
    length = (bins - 1) / steps
    edges = np.arange(steps) * length
    low = np.minimum(np.floor(edges + 1e-6), bins - 2).astype(np.int32)
    width = min(bins, int(np.max(np.ceil(edges + length - 1e-6) - low)) + 1)
    low = np.minimum(low, bins - width)
    dt = jnp.asarray(frame_dt_s, jnp.float32)
    waits = model.refractory_s > 0 and model.timestamps == "crossing"
    dead = model.refractory_s / dt if waits else None

    def body(state: SimState, inputs: tuple[Array, Array, Array]) -> tuple[SimState, Array]:
        log_i, at, begin = inputs
        end_s = jnp.stack([state.frame.astype(jnp.float32) * dt, jnp.zeros(())])
        state, interval = scan.advance(model, noisy, camera, state, log_i, dt, end_s)
        return state, _interval_bins(interval, at, begin, jnp.float32(length), width, dead)

    inputs = (log_frames, jnp.asarray(low, jnp.float32), jnp.asarray(edges, jnp.float32))
    state, parts = jax.lax.scan(body, state, inputs)
    chosen = np.zeros((bins, steps, width), np.float32)
    for j in range(width):
        chosen[low + j, np.arange(steps), j] = 1.0
    grid = jnp.einsum("btj,tjphw->hwpb", chosen, parts, precision="highest")
    return state, grid.reshape(*grid.shape[:2], 2 * bins)


def simulate_voxels(
    key: Array, log_frames: Array, camera: Camera, *, frame_dt_s: float,
    model: SensorModel | None = None, bins: int = BINS,
) -> Array:
    """Voxel grid of a video seen by a camera, on the device (Eq. 2).

    log_frames: float32 (..., T, H, W) natural-log intensity in the map of `model.log_map`,
    frame_dt_s seconds apart; the window is their span. camera: maps (H, W), or (..., H, W)
    with the same leading axes. Returns float32 (..., H, W, 2*bins). One key serves all
    leading axes, split among them. Without leading axes the grid equals `simulate` followed
    by `voxelize` (same key, noise included) up to the microsecond rounding of event times.
    """
    model = model or SensorModel()
    log_frames = jnp.asarray(log_frames, jnp.float32)
    if log_frames.ndim < 3 or log_frames.shape[-3] < 2:
        raise EvflowDataError("EV002", f"log_frames has shape {log_frames.shape}.",
                              "Expected (..., T, H, W) with at least two frames.")
    if not frame_dt_s > 0 or bins < 2:
        raise EvflowDataError("EV020", f"frame_dt_s={frame_dt_s}, bins={bins}.",
                              "Need frame_dt_s > 0 and bins >= 2.")
    if camera.shape[-2:] != log_frames.shape[-2:]:
        raise EvflowDataError(
            "EV015", f"the camera is {camera.shape[-2:]}, the frames {log_frames.shape[-2:]}.")
    camera.validate()
    lead = log_frames.shape[:-3]
    return _voxels(key, log_frames, camera, frame_dt_s=float(frame_dt_s), model=model, bins=bins,
                   noisy=scan.is_noisy(model, camera), lead=lead)


@partial(jax.jit, static_argnames=("frame_dt_s", "model", "bins", "noisy", "lead"))
def _voxels(
    key: Array, log_frames: Array, camera: Camera, *, frame_dt_s: float, model: SensorModel,
    bins: int, noisy: bool, lead: tuple[int, ...],
) -> Array:
    def one(key: Array, frames: Array, camera: Camera) -> Array:
        state = scan.start(key, frames[0], model)
        return simulate_window(model, noisy, camera, state, frames[1:], frame_dt_s, bins)[1]

    if not lead:
        return one(key, log_frames, camera)
    batch = math.prod(lead)
    shape = log_frames.shape[-2:]
    keys = jax.random.split(key, batch)
    cameras = jax.tree.map(lambda m: jnp.broadcast_to(m, (*lead, *shape)).reshape(-1, *shape),
                           camera)
    grids = jax.vmap(one)(keys, log_frames.reshape(batch, *log_frames.shape[-3:]), cameras)
    return grids.reshape(*lead, *grids.shape[1:])
