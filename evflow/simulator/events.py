"""Frames -> events, a sorted list: the device finds what is sent, the host packs it.

Frames go to the device in blocks that begin at multiples of BLOCK (the last one padded with
empty intervals), so the same compiled programs see every frame and the bytes do not depend on
how the frames arrive. Frame interval i draws its noise from (key, i) alone. While the device
works on a block, the host packs the one before.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import Literal, overload

import jax
import jax.numpy as jnp
import numpy as np

from evflow.camera import Camera, SensorModel
from evflow.checks import COLUMNS
from evflow.errors import EvflowDataError
from evflow.intensity import to_log
from evflow.simulator import active, noise, pack, sensor
from evflow.simulator.active import Block, Sent
from evflow.simulator.frames import blocks
from evflow.simulator.pixel import PixelState
from evflow.simulator.sensor import Sensor, SimState
from evflow.types import Events

Array = jax.Array
Labelled = tuple[Events, np.ndarray]

BLOCK = 8  # frames; more of them have more active pixels, fewer pass more often over all pixels
SALTED = 64 * BLOCK  # intervals whose salts are drawn at a time
ACTIVE = 8192  # active pixels that are stepped at a time; their arrays stay in the cache


@overload
def simulate(
    key: Array, frames: np.ndarray, times_us: np.ndarray, camera: Camera, *,
    model: SensorModel | None = None, labels: Literal[False] = False,
) -> Events: ...
@overload
def simulate(
    key: Array, frames: np.ndarray, times_us: np.ndarray, camera: Camera, *,
    model: SensorModel | None = None, labels: Literal[True],
) -> Labelled: ...
def simulate(
    key: Array, frames: np.ndarray, times_us: np.ndarray, camera: Camera, *,
    model: SensorModel | None = None, labels: bool = False,
) -> Events | Labelled:
    """Events of a video seen by a camera.

    frames: (T, H, W) uint8, or float DN on 0..255, or uint16 on 0..65535 (convert 10- and
    12-bit data with `intensity.to_dn`). times_us: (T,) int, strictly increasing; the first
    may be anything. camera: maps (H, W). Returns sorted `Events` with integer us times in
    (times_us[0], times_us[-1]]; with `labels`, also (N,) bool: which of them are noise (eta
    and shot noise; what leaks crosses the threshold as light does, and counts as signal).
    """
    frames, times_us = np.asarray(frames), np.asarray(times_us)
    if frames.ndim != 3 or times_us.shape != frames.shape[:1]:
        raise EvflowDataError(
            "EV002", f"frames {frames.shape} with times {times_us.shape}.",
            "Expected (T, H, W) frames and T times in microseconds.")
    parts = list(simulate_stream(key, [frames], [times_us], camera, model=model, labels=True))
    height, width = camera.shape
    x, y, t, p = (np.concatenate([getattr(part, name) for part, _ in parts]) for name in COLUMNS)
    events = Events.unchecked(x, y, t, p, (width, height))
    return (events, np.concatenate([noise for _, noise in parts])) if labels else events


@overload
def simulate_stream(
    key: Array, frames_iter: Iterable[np.ndarray], times_iter: Iterable[np.ndarray | int],
    camera: Camera, *, model: SensorModel | None = None, labels: Literal[False] = False,
) -> Iterator[Events]: ...
@overload
def simulate_stream(
    key: Array, frames_iter: Iterable[np.ndarray], times_iter: Iterable[np.ndarray | int],
    camera: Camera, *, model: SensorModel | None = None, labels: Literal[True],
) -> Iterator[Labelled]: ...
def simulate_stream(
    key: Array, frames_iter: Iterable[np.ndarray], times_iter: Iterable[np.ndarray | int],
    camera: Camera, *, model: SensorModel | None = None, labels: bool = False,
) -> Iterator[Events] | Iterator[Labelled]:
    """Events of a video that arrives piece by piece, in bounded memory.

    frames_iter yields single frames (H, W) or blocks (T, H, W), times_iter the matching
    scalars or (T,) arrays in us. Yields `Events` of eight frames at a time, each later than the
    one before, after reading eight frames more; together they are the same bytes as `simulate`
    for any cut of the input. labels: as in `simulate`.
    """
    packed = _packed(key, blocks(frames_iter, times_iter, camera.shape, BLOCK), camera,
                     model or SensorModel())
    return packed if labels else (events for events, _ in packed)


def _packed(
    key: Array, video: Iterator[tuple[list[np.ndarray], np.ndarray]], camera: Camera,
    model: SensorModel,
) -> Iterator[Labelled]:
    """One block is with the device while the one before is packed."""
    camera = _checked_camera(camera)
    nominal, most_hz = None, 0.0
    if noise.is_noisy(model, camera):
        nominal = noise.nominal_thresholds(model, camera)
        most_hz = noise.most_rate(model, camera, nominal)
    (first,), last = next(video)
    whole, state = _start(key, first.reshape(camera.shape), camera, nominal, model=model)
    pixels, origin = state.pixels, int(last[0])
    words, shape = np.asarray(whole.words), (camera.shape[0], camera.shape[1])

    def packed(sent: list[tuple[np.ndarray, Sent]], edges: np.ndarray) -> Labelled:
        parts = [part for group, out in sent
                 for part in pack.columns(model, out, group, words, np.diff(edges))]
        return pack.sort(parts, edges, shape)

    # NumPy and XLA let go of the interpreter in long loops: two cores are busy.
    with ThreadPoolExecutor(1) as behind:
        waiting: list[Future[Labelled]] = []
        for (frames, times), salts in zip(video, _salts(state.key), strict=False):
            edges = np.concatenate([last, times])
            noise.check_rate(most_hz, float(np.diff(edges).max()) * 1e-6)
            pixels, sent = _advance(model, whole, pixels, _block(salts, frames, edges, origin))
            yield from (one.result() for one in waiting)
            waiting, last = [behind.submit(packed, sent, edges)], times[-1:]
        yield from (one.result() for one in waiting)


@partial(jax.jit, static_argnames="model")
def _start(
    key: Array, frame: Array, camera: Camera, nominal: Array | None, *, model: SensorModel
) -> tuple[Sensor, SimState]:
    return sensor.start(key, to_log(frame, model.log_map), camera, model, nominal)


def _advance(
    model: SensorModel, whole: Sensor, pixels: PixelState, block: Block
) -> tuple[PixelState, list[tuple[np.ndarray, Sent]]]:
    """Dispatch a block; only which pixels are active is waited for."""
    after, may_send = active.look(model, whole, pixels, block)
    count = whole.words.size
    if model.timestamps == "v2e":  # its slots depend on all pixels
        at, size = np.arange(count, dtype=np.int32), count
    else:
        at, size = np.flatnonzero(may_send).astype(np.int32), ACTIVE
    sent = []
    for first in range(0, len(at), size):
        some = at[first : first + size]
        padded = np.full(size, count, np.int32)
        padded[: len(some)] = some
        after, out = active.step(model, whole, pixels, after, block, padded)
        sent.append((some, out))
    return after, sent


def _block(
    salts: np.ndarray, frames: list[np.ndarray], edges: np.ndarray, origin: int
) -> Block:
    """The block, padded to BLOCK frames."""
    missing = BLOCK - len(frames)
    frames = frames + [frames[-1]] * missing
    edges = np.append(edges, np.full(missing, edges[-1]))
    seconds = (edges - origin) * 1e-6
    high = seconds.astype(np.float32)
    clock = np.stack([high, seconds - high], -1).astype(np.float32)
    dt = (np.diff(edges) * 1e-6).astype(np.float32)
    return Block(*map(jnp.asarray, (np.stack(frames), dt, clock, salts)))


def _salts(key: Array) -> Iterator[np.ndarray]:
    """`noise.salts` of block after block."""
    for first in itertools.count(0, SALTED):
        yield from np.asarray(_some_salts(key, first)).reshape(-1, BLOCK, 2)


@jax.jit
def _some_salts(key: Array, first: int) -> Array:
    return noise.salts(key, first + jnp.arange(SALTED))


def _checked_camera(camera: Camera) -> Camera:
    if len(camera.shape) != 2:
        raise EvflowDataError(
            "EV002", f"the camera's maps have shape {camera.shape}.",
            "Expected (H, W); simulate one camera at a time, or vmap simulate_voxels.")
    camera.validate()
    return jax.tree.map(lambda m: jnp.asarray(m, jnp.float32), camera)
