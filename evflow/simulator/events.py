"""Frames -> a sorted list of events: computed on the device, packed on the host.

Frames go to the device in blocks that begin at multiples of BLOCK (the last one padded with
empty intervals), so the same compiled programs see every frame and the bytes do not depend on
how the frames arrive. Frame interval i draws its noise from (key, i) alone.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from typing import Literal, overload

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from evflow.camera import Camera
from evflow.camera.sensors import SensorModel
from evflow.checks import COLUMNS, MOST_SIDE, need, plain
from evflow.errors import EvflowDataError
from evflow.simulator import pack
from evflow.simulator.active import BLOCK
from evflow.simulator.arguments import check_arguments
from evflow.simulator.circuits import circuit
from evflow.simulator.constants import Constants
from evflow.simulator.frames import blocks
from evflow.simulator.sensor import simulable
from evflow.types import Events

Array = jax.Array
Labelled = tuple[Events, np.ndarray]


@overload
def simulate(
    key: Array, frames: ArrayLike, times_us: ArrayLike, camera: Camera, *,
    model: SensorModel | None = None, labels: Literal[False] = False,
    full_scale: float | None = None,
) -> Events: ...
@overload
def simulate(
    key: Array, frames: ArrayLike, times_us: ArrayLike, camera: Camera, *,
    model: SensorModel | None = None, labels: Literal[True],
    full_scale: float | None = None,
) -> Labelled: ...
def simulate(
    key: Array, frames: ArrayLike, times_us: ArrayLike, camera: Camera, *,
    model: SensorModel | None = None, labels: bool = False, full_scale: float | None = None,
) -> Events | Labelled:
    """Events of a video seen by a camera.

    Not for jit, vmap or grad, as the number of events is not known beforehand; use
    `simulate_voxels` or `simulate_counts` there.

    Args:
        key: of jax.random; determines noise, leak pattern and the crossings of a Brownian pixel.
        frames: (T, H, W), T >= 2: uint8, float DN on 0..255, or uint16 on 0..65535 (10- and 12-bit
            data need `full_scale`). Between frames log intensity is interpolated linearly.
        times_us: (T,) integer microseconds, strictly increasing; the first may be anything.
        camera: maps (H, W).
        model: the pixel circuit; None is `SensorModel()`.
        labels: also return which events are noise.
        full_scale: value of white in float and uint16 frames (1023 for 10 bits); that of uint8 is
            always 255. None is 65535 for uint16 and 255 for floats; float frames of which none
            exceeds 8 are then refused, as they mostly are fractions, logarithms or radiance, and
            uint16 of which none exceeds 4095, as they mostly are 12 bits or fewer.

    Returns:
        Sorted `Events`, integer microseconds in (times_us[0], times_us[-1]]. With `labels`, also
        bool (N,): which are noise (eta and shot noise; leak crosses the threshold as light does,
        and counts as signal).

    Raises:
        EvflowDataError: EV001 (fewer than two frames), EV002 (shapes), EV003 (dtype or range),
            EV004 (times do not increase), EV007 (NaN), EV014 (camera out of range, or more events
            or noise than an interval holds), EV015 (frames and camera of different size), EV020
            (called within jit, vmap or grad; no key, camera or model; full_scale).

    Example:
        >>> camera = ef.Camera.sample(jax.random.key(0), frames.shape[1:])
        >>> events = ef.simulate(jax.random.key(1), frames, times_us, camera)
    """
    if any(isinstance(leaf, jax.core.Tracer)
           for leaf in jax.tree.leaves((key, frames, times_us, camera, model))):
        raise EvflowDataError("EV020", "simulate was called within jit, vmap or grad.",
                              "There take simulate_voxels, or simulate_counts.")
    check_arguments(key, camera, model)
    frames = np.asarray(plain("frames", frames))
    times_us = np.asarray(plain("times_us", times_us))
    if frames.ndim != 3 or times_us.shape != frames.shape[:1]:
        raise EvflowDataError(
            "EV002", f"frames {frames.shape} with times {times_us.shape}.",
            "Expected (T, H, W) frames and T times in microseconds."
            + (" Colour? evflow.light.colour.luma(frames[..., ::-1]) of R, G, B." if
               frames.ndim == 4 and frames.shape[-1] == 3 else ""))
    video = blocks([frames], [times_us], camera.shape, BLOCK, copy=False,
                   full_scale=full_scale)
    parts = list(_packed(key, video, camera, Constants.of(model or SensorModel())))
    height, width = camera.shape
    x, y, t, p = (np.concatenate([getattr(part, name) for part, _ in parts]) for name in COLUMNS)
    events = Events.unchecked(x, y, t, p, (width, height))
    return (events, np.concatenate([noise for _, noise in parts])) if labels else events


@overload
def simulate_stream(
    key: Array, frames_iter: Iterable[ArrayLike], times_iter: Iterable[ArrayLike],
    camera: Camera, *, model: SensorModel | None = None, labels: Literal[False] = False,
    full_scale: float | None = None,
) -> Iterator[Events]: ...
@overload
def simulate_stream(
    key: Array, frames_iter: Iterable[ArrayLike], times_iter: Iterable[ArrayLike],
    camera: Camera, *, model: SensorModel | None = None, labels: Literal[True],
    full_scale: float | None = None,
) -> Iterator[Labelled]: ...
def simulate_stream(
    key: Array, frames_iter: Iterable[ArrayLike], times_iter: Iterable[ArrayLike],
    camera: Camera, *, model: SensorModel | None = None, labels: bool = False,
    full_scale: float | None = None,
) -> Iterator[Events] | Iterator[Labelled]:
    """Events of a streamed video, in bounded memory.

    Args:
        key: of jax.random.
        frames_iter: yields single frames (H, W) or blocks (T, H, W), values as in `simulate`; a
            source may write its next frames over the last.
        times_iter: yields the matching times, scalars or (T,), integer microseconds.
        camera: maps (H, W).
        model: the pixel circuit; None is `SensorModel()`.
        labels: also return which events are noise.
        full_scale: as in `simulate`.

    Returns:
        An iterator over `Events` of eight frames each, in order of time, 8 or 16 frames behind the
        input. Together they are the same bytes as of `simulate`, for any chunking of the input.
        With `labels`, pairs of them and bool (N,) as in `simulate`.

    Raises:
        EvflowDataError: EV020 (no key, camera or model); EV001, EV002, EV003, EV004, EV007, EV014,
            EV015, EV020 (full_scale) as in `simulate`, while the iterator is read.

    Example:
        >>> with ef.open_writer("out.h5", size) as out:
        ...     for events in ef.simulate_stream(key, frames, times_us, camera):
        ...         out.append(events)
    """
    check_arguments(key, camera, model)
    need(frames_iter, Iterable, "frames_iter", "One that yields frames (H, W).")
    need(times_iter, Iterable, "times_iter", "One that yields times in us.")
    video = blocks(frames_iter, times_iter, camera.shape, BLOCK, copy=True,
                   full_scale=full_scale)
    packed = _packed(key, video, camera, Constants.of(model or SensorModel()))
    return packed if labels else (events for events, _ in packed)


def _packed(
    key: Array, video: Iterator[tuple[list[np.ndarray], np.ndarray]], camera: Camera,
    model: Constants,
) -> Iterator[Labelled]:
    """Pack a finished block while the device computes the next."""
    camera = _checked_camera(camera)
    shape = (camera.shape[0], camera.shape[1])
    (first,), last = next(video)
    pixels = circuit(key, first.reshape(shape), int(last[0]), camera, model)
    edges: deque[np.ndarray] = deque()  # of the blocks in flight

    def watched() -> Iterator[tuple[list[np.ndarray], np.ndarray]]:
        before = last
        for frames, times in video:
            edges.append(np.concatenate([before, times]))
            yield frames, edges[-1]
            before = times[-1:]

    fetch = None
    for fetched in pixels.run(watched()):
        if fetch:
            yield pack.sort(*fetch(), int(edges.popleft()[0]), shape)
        fetch = fetched
    if fetch:
        yield pack.sort(*fetch(), int(edges.popleft()[0]), shape)


def _checked_camera(camera: Camera) -> Camera:
    if len(camera.shape) != 2:
        raise EvflowDataError(
            "EV002", f"the camera's maps have shape {camera.shape}.",
            "Expected (H, W); simulate one camera at a time, or vmap simulate_voxels.")
    if max(camera.shape) > MOST_SIDE:
        raise EvflowDataError(
            "EV002", f"a sensor of {camera.shape[1]:,}x{camera.shape[0]:,} pixels.",
            f"Coordinates of events have 16 bits: at most {MOST_SIDE:,} pixels a side.")
    return jax.tree.map(lambda m: jnp.asarray(m, jnp.float32), simulable(camera))
