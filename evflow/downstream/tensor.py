"""Event tensors as E2VID, FireNet and EV-FlowNet take them, and video from a stream of events.

B signed bins: t* = (B - 1)(t - t_first) / (t_last - t_first) between the first and the last
EVENT of a window, polarity +-1, bilinear in time. E2VID and FireNet want it normalised, E2VID+
and FireNet+ (S2R) raw, which keeps the scale of the camera's thresholds in it.
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
    inside = low < steps - 1  # the last event falls on the last bin: nothing is left for a next
    grid += np.bincount(index[inside] + 1, (sign * late)[inside], size)
    return grid.astype(np.float32).reshape(height, width, bins)


def prepared(events: Events, bins: int = BINS, split: bool = False) -> np.ndarray:
    """`event_tensor`, of split bins scaled as S2R's later models are given them ("RobustNorm" of
    its inference): cut off at the 95th percentile of all entries, which becomes 1. Where that is
    0, as most entries are, it stays as it is."""
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
    """(..., H, W, B): its entries other than 0 with mean 0 and standard deviation 1 over the
    whole tensor, 0 kept. One value alone becomes 0."""
    axes = (-3, -2, -1)
    some = (tensor != 0).astype(tensor.dtype)
    count = jnp.maximum(some.sum(axes, keepdims=True), 1.0)
    off_mean = some * (tensor - tensor.sum(axes, keepdims=True) / count)
    variance = (off_mean**2).sum(axes, keepdims=True) / count
    varies = variance > 1e-30
    # The root is taken of 1 where it is not used: its gradient at 0 would make all of them NaN.
    return off_mean * jnp.where(varies, jax.lax.rsqrt(jnp.where(varies, variance, 1.0)), 0.0)


def windows_between(times_us: np.ndarray, frame_times_us: np.ndarray) -> list[slice]:
    """Which events make each frame: those since the one before, up to its time stamp; of the
    first frame, since the beginning."""
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
    """What `reconstruct` stacks, one at a time: images (H, W), or flow (2, H, W).

    hold: where not one event came since the image before, that one again, and the memory as it
    was; a network's memory of a scene fades after more windows than it was trained on.
    Raises, before the first image, what `reconstruct` raises.
    """
    times = np.asarray(frame_times_us)
    if not times.size:
        raise EvflowDataError("EV001", "frame_times_us is empty.")
    if times.dtype.kind not in "iu":
        raise EvflowDataError("EV003", f"frame_times_us has dtype {times.dtype}.",
                              "Times are integer microseconds: np.rint(t * 1e6).astype(np.int64).")
    times = times.astype(np.int64)  # differences of unsigned ones never fall
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
