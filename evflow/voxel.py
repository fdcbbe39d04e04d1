"""Events -> spatiotemporal voxel grid (Eq. 2), one grid per polarity.

E_p(j) = sum over events of polarity p of max(0, 1 - |j - (B-1)(t - t0)/window|), j = 0..B-1.
Channels are [ON 0..B-1, OFF 0..B-1]; weights are raw counts, never normalised: the absolute
count is the signal. Only events in [t0, t0 + window) enter, so each event weighs exactly one.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from evflow.checks import need
from evflow.errors import EvflowDataError
from evflow.types import Events

Array = jax.Array

BINS = 16


def voxelize(events: Events, t0_us: int, window_us: int, bins: int = BINS) -> np.ndarray:
    """Events of one time window as a voxel grid, one per polarity (Eq. 2 of the paper).

    An event adds weight 1, shared linearly between the two time bins next to it. Counts are not
    normalised: their size determines the threshold.

    Args:
        events: of the whole recording or a part; only those in [t0_us, t0_us + window_us) enter.
        t0_us: start of the window, integer microseconds.
        window_us: length of the window, integer microseconds, > 0.
        bins: time bins B per polarity, >= 2. The released network takes 16.

    Returns:
        float32 (H, W, 2*bins), channels [ON 0..B-1, OFF 0..B-1], in events.

    Raises:
        EvflowDataError: EV003 (times are not integers), EV020 (an empty window, too few bins, or
            `events` is not an `Events`).

    Example:
        >>> voxels = ef.voxelize(window.events, window.t0_us, window.t1_us - window.t0_us)
    """
    need(events, Events, "events",
         "For a recording: recording.events; for a path: evflow.read_events(path).")
    for name, value in (("t0_us", t0_us), ("window_us", window_us)):
        if not isinstance(value, int | np.integer):
            raise EvflowDataError("EV003", f"{name} is {value!r}.",
                                  "Times are integer microseconds: round(seconds * 1e6).")
    if window_us <= 0 or not isinstance(bins, int | np.integer) or bins < 2:
        raise EvflowDataError("EV020", f"window_us={window_us}, bins={bins}.",
                              "Need a window > 0 and a whole number of bins, 2 or more.")
    width, height = events.size
    pixels, voxels = fired_voxels(events, int(t0_us), int(window_us), bins)
    grid = np.zeros((height * width, 2 * bins), np.float32)
    grid[pixels] = voxels
    return grid.reshape(height, width, 2 * bins)


def fired_voxels(
    events: Events, t0_us: int, window_us: int, bins: int = BINS
) -> tuple[np.ndarray, np.ndarray]:
    """Those pixels alone that have events in the window: their numbers y * W + x (k,), and their
    voxels (k, 2*bins), as of `voxelize`."""
    inside = events.slice(t0_us, t0_us + window_us)
    width, height = events.size
    position = (inside.t - t0_us) * ((bins - 1) / window_us)
    low = np.minimum(position.astype(np.int64), bins - 2)
    weight = position - low
    pixel = inside.y.astype(np.int64) * width + inside.x
    fired = np.zeros(height * width, bool)
    fired[pixel] = True
    pixels = np.flatnonzero(fired)
    index = ((np.cumsum(fired) - 1)[pixel] * 2 + ~inside.p) * bins + low
    size = len(pixels) * 2 * bins
    voxels = np.bincount(index, 1.0 - weight, size)
    voxels += np.bincount(index + 1, weight, size)
    return pixels, voxels.astype(np.float32).reshape(-1, 2 * bins)


def voxelize_padded(
    x: Array, y: Array, t: Array, p: Array, valid: Array, *,
    shape: tuple[int, int], window: float, bins: int = BINS,
) -> Array:
    """Device events of fixed length N -> float32 (H, W, 2*bins); jit and vmap it.

    x, y: integer (N,); p: bool, {0, 1} or {-1, 1} (N,); t: (N,) relative to the window's start
    in the unit of `window` (int32 us or float); valid: bool (N,), False for padding. Events
    outside the window or the sensor count as padding: nothing is clipped to an edge.
    """
    height, width = shape
    position = t.astype(jnp.float32) * ((bins - 1) / window)
    inside = valid & (position >= 0) & (t < window)
    inside &= (x >= 0) & (x < width) & (y >= 0) & (y < height)
    low = jnp.clip(jnp.floor(position), 0, bins - 2).astype(jnp.int32)
    weight = position - low.astype(jnp.float32)
    channel = jnp.where(p > 0, 0, bins) + low
    pixel = y.astype(jnp.int32) * width + x.astype(jnp.int32)
    index = jnp.where(inside, pixel * (2 * bins) + channel, height * width * 2 * bins)
    grid = jnp.zeros(height * width * 2 * bins, jnp.float32)
    grid = grid.at[index].add(1.0 - weight, mode="drop")
    grid = grid.at[jnp.where(inside, index + 1, index)].add(weight, mode="drop")
    return grid.reshape(height, width, 2 * bins)
