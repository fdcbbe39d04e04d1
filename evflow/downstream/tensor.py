"""Event tensors of E2VID, FireNet and EV-FlowNet, and video from a stream of events.

B signed bins: t* = (B - 1)(t - t_first) / (t_last - t_first) between the first and the last EVENT
of a window, polarity +-1, bilinear in time. E2VID and FireNet need normalised tensors, E2VID+ and
FireNet+ (S2R) raw ones, which keep the scale of the camera's thresholds.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

from evflow.downstream.network import Network, Params, State
from evflow.errors import EvflowDataError
from evflow.types import Events

Array = jax.Array

BINS = 5
ROBUST = 0.95  # of the entries are within the range of `prepared`


def event_tensor(events: Events, bins: int = BINS, split: bool = False) -> np.ndarray:
    """Events of one window -> float32 (H, W, bins); zeros where there are none. split: ON events
    are counted in the first half of the bins, OFF events in the other.

    Raises EV020 for fewer bins than 1, or with split for bins that have no halves."""
    if not isinstance(bins, int | np.integer) or bins < 1 or (split and bins % 2):
        raise EvflowDataError("EV020", f"{bins!r} bins{' to split' if split else ''}.",
                              "Give an even number, 2 or more." if split
                              else "Give a whole number, 1 or more.")
    width, height = events.size
    if not len(events):
        return np.zeros((height, width, bins), np.float32)
    span = max(int(events.t[-1] - events.t[0]), 1)
    steps = bins // 2 if split else bins
    position = (events.t - events.t[0]) * ((steps - 1) / span)
    low = np.floor(position).astype(np.int64)
    index = (events.y.astype(np.int64) * width + events.x) * bins + low
    index += np.where(events.p, 0, steps) if split else 0
    sign = np.where(events.p | split, 1.0, -1.0)
    late = position - low
    size = height * width * bins
    grid = np.bincount(index, sign * (1.0 - late), size)
    inside = low < steps - 1  # the last event is on the last bin, with no share in a next one
    grid += np.bincount(index[inside] + 1, (sign * late)[inside], size)
    return grid.astype(np.float32).reshape(height, width, bins)


def prepared(events: Events, bins: int = BINS, split: bool = False) -> np.ndarray:
    """`event_tensor`; split bins are scaled as for S2R's later models ("RobustNorm"): clipped at
    the 95th percentile of all entries, which becomes 1. Unchanged where that is 0."""
    tensor = event_tensor(events, bins, split)
    if not (split and tensor.size):
        return tensor
    rank = round(ROBUST * (tensor.size - 1))
    most = float(np.partition(tensor, rank, axis=None)[rank])
    return np.minimum(tensor, most) / np.float32(most) if most > 0 else tensor


def signed(voxels: Array) -> Array:
    """A voxel grid (..., H, W, 2B) of `voxelize` or the simulator, ON minus OFF: (..., H, W, B)."""
    on, off = jnp.split(voxels, 2, -1)
    return on - off


def normalise(tensor: Array) -> Array:
    """(..., H, W, B), with nonzero entries scaled to mean 0 and standard deviation 1 over the whole
    tensor; zeros are kept. A single distinct value becomes 0."""
    axes = (-3, -2, -1)
    some = (tensor != 0).astype(tensor.dtype)
    count = jnp.maximum(some.sum(axes, keepdims=True), 1.0)
    off_mean = some * (tensor - tensor.sum(axes, keepdims=True) / count)
    variance = (off_mean**2).sum(axes, keepdims=True) / count
    varies = variance > 1e-30
    # The unused root is taken of 1, as its gradient at 0 would make all gradients NaN.
    return off_mean * jnp.where(varies, jax.lax.rsqrt(jnp.where(varies, variance, 1.0)), 0.0)


def windows_between(times_us: np.ndarray, frame_times_us: np.ndarray) -> list[slice]:
    """Events of each frame: those since the frame before, up to its time stamp; for the first
    frame, since the beginning."""
    stops = np.searchsorted(times_us, frame_times_us, "right")
    return [slice(int(a), int(b)) for a, b in zip([0, *stops[:-1]], stops, strict=True)]


@functools.partial(jax.jit, static_argnames=("network", "normalised"))
def _step(
    network: Network, params: Params, tensor: Array, state: State, normalised: bool
) -> tuple[Array, State]:
    return network.apply(params, normalise(tensor) if normalised else tensor, state)


def reconstructions(
    network: Network, params: Params, events: Events, frame_times_us: np.ndarray, *,
    normalised: bool = False, split: bool = False, hold: bool = False,
) -> Iterator[np.ndarray]:
    """Outputs of `reconstruct`, one at a time: images (H, W), or flow (2, H, W).

    hold: without any event since the image before, yield that image again and keep the state; a
    network forgets a scene after more windows than it was trained on. Raises as `reconstruct`,
    before the first image.
    """
    times = np.asarray(frame_times_us)
    if not times.size:
        raise EvflowDataError("EV001", "frame_times_us is empty.")
    if times.dtype.kind not in "iu":
        raise EvflowDataError("EV003", f"frame_times_us has dtype {times.dtype}.",
                              "Times are integer microseconds: np.rint(t * 1e6).astype(np.int64).")
    times = times.astype(np.int64)  # unsigned differences are never negative
    if np.any(np.diff(times) < 0):
        raise EvflowDataError("EV004", "frame_times_us falls.", "Pass them in order.")

    def images() -> Iterator[np.ndarray]:
        width, height = events.size
        state, image = network.start((height, width)), None
        for window in windows_between(events.t, times):
            if hold and image is not None and window.start == window.stop:
                yield image
                continue
            part = Events.unchecked(events.x[window], events.y[window], events.t[window],
                                    events.p[window], events.size)
            tensor = prepared(part, network.bins, split)
            made, state = _step(network, params, tensor, state, normalised)
            image = np.asarray(made)
            yield image

    return images()


def reconstruct(
    network: Network, params: Params, events: Events, frame_times_us: np.ndarray, *,
    normalised: bool = False, split: bool = False,
) -> np.ndarray:
    """Output of a network at each of the T frame times, from the events between them: images
    (T, H, W) of E2VID and FireNet, about 0..1 and not clipped, or flow (T, 2, H, W).

    normalised: True for E2VID and FireNet, False for E2VID+, FireNet+ and EV-FlowNet; split: True
    for S2R's later models of ten bins, see `prepared`.
    Raises EV001 without frame times, EV004 where they fall.
    """
    return np.stack(list(reconstructions(
        network, params, events, frame_times_us, normalised=normalised, split=split)))
