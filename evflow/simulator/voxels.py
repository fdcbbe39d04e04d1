"""Log frames -> voxel grid without ever making an event; jit, vmap and scan it.

Within an interval a pixel's events sit on an arithmetic progression, so the sum of their
triangular weights (Eq. 2) has a closed form (`hat_sums`). An interval touches few bins; only
those are computed.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from evflow.camera import Camera, SensorModel
from evflow.errors import EvflowDataError
from evflow.simulator import noise, scan
from evflow.simulator.scan import Interval, SimState
from evflow.voxel import BINS

Array = jax.Array


def hat_sums(low: Array, width: int, first: Array, spacing: Array, count: Array) -> list[Array]:
    """Weights on bins low, low+1, ... (`width` of them) of a progression of events.

    first, spacing are in bins; every event must lie in [low, low + width - 1]. Within a gap
    between two bins the weights are linear, so the number of events in it and the sum of their
    positions suffice: one division, whatever the count.
    """
    start = first - low
    inverse = 1.0 / jnp.maximum(spacing, 1e-12)
    weights = [jnp.zeros_like(count) for _ in range(width)]
    done, total = jnp.zeros_like(count), jnp.zeros_like(count)
    for gap in range(width - 1):
        if gap == width - 2:
            upto = count
        else:
            upto = jnp.clip(jnp.floor((gap + 1.0 - start) * inverse) + 1.0, 0.0, count)
        position = upto * (start + spacing * (0.5 * (upto - 1.0)))  # sum of the first `upto`
        number, moment = upto - done, position - total
        weights[gap] += (gap + 1.0) * number - moment
        weights[gap + 1] += moment - gap * number
        done, total = upto, position
    return weights


def _signal_bins(
    interval: Interval, low: Array, begin: Array, length: Array, width: int, dead: Array | None
) -> list[Array]:
    """Weights (H, W) per touched bin of one interval's signal events, both polarities together.

    The interval spans [begin, begin + length] bins. dead: the refractory period in interval
    lengths, None where pixels never wait.
    """
    spikes = interval.spikes
    count = jnp.abs(spikes.count).astype(jnp.float32)
    spacing = spikes.spacing * length
    if dead is None:
        return hat_sums(low, width, begin + spikes.first * length, spacing, count)
    # The waiting events come first, `dead` apart, then those that cross in their own time; where
    # crossings are no further apart than `dead`, every event waits for the one before.
    gain = spikes.spacing - dead
    lag = jnp.maximum(spikes.earliest - spikes.first, 0.0)
    waiting = jnp.where(gain > 0, jnp.ceil(lag / jnp.maximum(gain, 1e-9)), count)
    waiting = jnp.minimum(waiting, count)
    at = spikes.first + waiting * spikes.spacing
    late = hat_sums(low, width, begin + spikes.earliest * length,
                    jnp.zeros_like(count) + dead * length, waiting)
    timely = hat_sums(low, width, begin + at * length, spacing, count - waiting)
    return [a + b for a, b in zip(late, timely, strict=True)]


def _noise_bins(
    model: SensorModel, interval: Interval, low: Array, begin: Array, length: Array, width: int
) -> list[Array]:
    """Weights (2, H, W) per touched bin of one interval's noise events (ON, OFF). The loop runs
    only where some pixel sends two or more in one interval."""
    counts = jnp.stack([interval.noise_on, interval.noise_off])

    def place(k: Array | int) -> list[Array]:
        s = begin + noise.placed(model, interval.noise_at, k) * length - low
        struck = jnp.where(counts > k, 1.0, 0.0)
        return [struck * jnp.maximum(0.0, 1.0 - jnp.abs(s - j)) for j in range(width)]

    def more(k: Array, weights: list[Array]) -> list[Array]:
        return [a + b for a, b in zip(weights, place(k), strict=True)]

    return jax.lax.fori_loop(1, jnp.max(counts).astype(jnp.int32), more, place(0))


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

    def body(state: SimState, inputs: tuple[Array, Array, Array]) -> tuple[SimState, Any]:
        log_i, at, begin = inputs
        end_s = jnp.stack([state.frame.astype(jnp.float32) * dt, jnp.zeros(())])
        state, interval = scan.advance(model, noisy, camera, state, log_i, dt, end_s)
        span = jnp.float32(length)
        weights = _signal_bins(interval, at, begin, span, width, dead)
        # An interval has one polarity per pixel: its sign marks it, and halves the traffic.
        sign = jnp.sign(interval.spikes.count).astype(jnp.float32)
        struck = _noise_bins(model, interval, at, begin, span, width) if noisy else []
        return state, ([w * sign for w in weights], struck)

    inputs = (log_frames, jnp.asarray(low, jnp.float32), jnp.asarray(edges, jnp.float32))
    state, (signed, struck) = jax.lax.scan(body, state, inputs)
    grid = [_collect(signed, struck, low, j, polarity) for polarity in (0, 1) for j in range(bins)]
    return state, jnp.stack(grid, -1)


def _collect(
    signed: list[Array], struck: list[Array], low: np.ndarray, j: int, polarity: int
) -> Array:
    """Bin j of one polarity (0 ON, 1 OFF): the few (interval, touched bin) pairs that fall on
    it, added. signed: per touched bin (T, H, W); struck: (T, 2, H, W), empty without noise."""
    total = jnp.zeros(signed[0].shape[1:], jnp.float32)
    for t in np.flatnonzero((low <= j) & (j < low + len(signed))):
        weight = signed[j - low[t]][t]
        total += jax.nn.relu(weight if polarity == 0 else -weight)
        if struck:
            total += struck[j - low[t]][t, polarity]
    return total


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
    if not 0 < frame_dt_s < math.inf or bins < 2:
        raise EvflowDataError("EV020", f"frame_dt_s={frame_dt_s}, bins={bins}.",
                              "Need frame_dt_s > 0 and bins >= 2.")
    known = not isinstance(log_frames, jax.core.Tracer)
    if known and not np.isfinite(np.asarray(log_frames)).all():
        raise EvflowDataError("EV007", "log_frames holds NaN or infinite values.",
                              "The logarithm of 0 or of a missing pixel? Use intensity.to_log.")
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
    noise.check_rate(noise.peak_rate(model, camera), frame_dt_s)
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
