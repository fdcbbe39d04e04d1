"""Frames -> events: the device counts, the host packs a sorted list.

Frames go to the device in chunks of fixed length (the last one padded with empty intervals),
so the same compiled program sees every frame and the bytes do not depend on how the frames
arrive. Frame i draws its noise from fold_in(key, i) alone. Event times are integer
microseconds in (t_prev, t_now] of their frame interval, so intervals never overlap and the
order is total: time, then pixel, then index.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator

import jax
import jax.numpy as jnp
import numpy as np

from evflow.camera import Camera, SensorModel
from evflow.errors import EvflowDataError
from evflow.intensity import to_log
from evflow.simulator import noise, scan
from evflow.types import Events

Array = jax.Array

CHUNK_PIXELS = 32 * 346 * 260  # frames x pixels on the device at a time: ~100 MB in flight
CHUNK_FRAMES = 64


def simulate(
    key: Array, frames: np.ndarray, times_us: np.ndarray, camera: Camera, *,
    model: SensorModel | None = None,
) -> Events:
    """Events of a video seen by a camera.

    frames: (T, H, W) uint8, or float DN on 0..255, or uint16 on 0..65535 (convert 10- and
    12-bit data with `intensity.to_dn`). times_us: (T,) int, strictly increasing; the first
    may be anything. camera: maps (H, W). Returns sorted `Events` with integer us times in
    (times_us[0], times_us[-1]].
    """
    frames, times_us = np.asarray(frames), np.asarray(times_us)
    if frames.ndim != 3 or times_us.shape != frames.shape[:1]:
        raise EvflowDataError(
            "EV002", f"frames {frames.shape} with times {times_us.shape}.",
            "Expected (T, H, W) frames and T times in microseconds.")
    chunks = list(simulate_stream(key, [frames], [times_us], camera, model=model))
    return Events.concatenate(chunks)


def simulate_stream(
    key: Array, frames_iter: Iterable[np.ndarray], times_iter: Iterable[np.ndarray | int],
    camera: Camera, *, model: SensorModel | None = None,
) -> Iterator[Events]:
    """Events of a video that arrives piece by piece, in bounded memory.

    frames_iter yields single frames (H, W) or blocks (T, H, W), times_iter the matching
    scalars or (T,) arrays in us. Yields `Events` chunk by chunk, each later than the one
    before; together they are the same bytes as `simulate` for any cut of the input.
    """
    model = model or SensorModel()
    camera = _checked_camera(camera)
    pairs = _single_frames(frames_iter, times_iter, camera.shape)
    first, time = next(pairs, (None, 0))
    if first is None:
        raise EvflowDataError("EV001", "the video has no frames.", "Give at least two frames.")
    noisy, rate = scan.is_noisy(model, camera), noise.peak_rate(model, camera)
    state = jax.jit(scan.start, static_argnames="model")(
        key, to_log(first, model.log_map), model=model)
    length = min(max(1, CHUNK_PIXELS // first.size), CHUNK_FRAMES)
    origin, seen = time, 1
    while chunk := list(itertools.islice(pairs, length)):
        frames = np.stack([f for f, _ in chunk])
        edges = np.array([time, *(t for _, t in chunk)], np.int64)
        seen, time = seen + len(chunk), int(edges[-1])
        padded = np.append(edges, np.full(length - len(chunk), time))
        dt = (np.diff(padded) * 1e-6).astype(np.float32)
        seconds = (padded[1:] - origin) * 1e-6
        high = seconds.astype(np.float32)
        end_s = np.stack([high, seconds - high], -1).astype(np.float32)
        noise.check_rate(rate, float(dt.max()))
        if len(chunk) < length:
            pad = np.broadcast_to(frames[-1], (length - len(chunk), *frames.shape[1:]))
            frames = np.concatenate([frames, pad])
        state, out = scan.advance_chunk(
            camera, state, to_log(frames, model.log_map), jnp.asarray(dt), jnp.asarray(end_s),
            model=model, noisy=noisy)
        yield _pack(out, edges, model, noisy)
    if seen < 2:
        raise EvflowDataError("EV001", "the video has one frame.",
                              "Events need a change: give at least two frames.")


def _checked_camera(camera: Camera) -> Camera:
    if len(camera.shape) != 2:
        raise EvflowDataError(
            "EV002", f"the camera's maps have shape {camera.shape}.",
            "Expected (H, W); simulate one camera at a time, or vmap simulate_voxels.")
    camera.validate()
    return jax.tree.map(lambda m: jnp.asarray(m, jnp.float32), camera)


def _single_frames(
    frames_iter: Iterable[np.ndarray], times_iter: Iterable[np.ndarray | int],
    shape: tuple[int, ...],
) -> Iterator[tuple[np.ndarray, int]]:
    """Validated (frame, time) pairs, whatever the blocks they came in."""
    dtype, last, index = None, None, 0
    for block, times in itertools.zip_longest(frames_iter, times_iter):
        if block is None or times is None:
            raise EvflowDataError(
                "EV002", f"the {'frames' if block is None else 'times'} end after {index} frames.",
                "Give one time per frame, in blocks of the same lengths.")
        block, times = np.asarray(block), np.atleast_1d(np.asarray(times))
        block = block[None] if block.ndim == 2 else block
        _check_block(block, times, shape, dtype, index)
        dtype = block.dtype
        for frame, t in zip(block, times.tolist(), strict=True):
            if last is not None and t <= last:
                raise EvflowDataError(
                    "EV004", f"frame {index} is at {t} us, the one before at {last} us.",
                    "Frame times must increase strictly.")
            last, index = t, index + 1
            yield frame, t


def _check_block(
    block: np.ndarray, times: np.ndarray, shape: tuple[int, ...], dtype: np.dtype | None,
    index: int,
) -> None:
    if block.ndim != 3 or len(times) != len(block):
        raise EvflowDataError("EV002", f"frames {block.shape} with times {times.shape}.",
                              "Expected (T, H, W) gray frames and T times.")
    if block.shape[1:] != shape:
        raise EvflowDataError(
            "EV015", f"frames are {block.shape[1:]} (H, W), the camera is {shape}.",
            "Resize one of them.")
    if dtype is not None and block.dtype != dtype:
        raise EvflowDataError("EV003", f"frame {index} is {block.dtype}, earlier ones {dtype}.")
    if not np.issubdtype(times.dtype, np.integer):
        raise EvflowDataError("EV003", f"frame times are {times.dtype}.",
                              "Give integer microseconds (seconds x 1e6).")
    if block.dtype in (np.uint8, np.uint16):
        return
    if not np.issubdtype(block.dtype, np.floating):
        raise EvflowDataError("EV003", f"frames are {block.dtype}.",
                              "Expected uint8, uint16 or floating DN on 0..255.")
    bad = ~np.isfinite(block)
    if bad.any():
        at = np.argwhere(bad)[0]
        raise EvflowDataError(
            "EV007", f"{bad.sum()} values of the frames are not finite, first in frame "
            f"{index + int(at[0])} at y={at[1]}, x={at[2]}.")
    if block.min(initial=0.0) < 0 or block.max(initial=0.0) > 255.5:
        raise EvflowDataError(
            "EV003", f"float frames reach from {block.min():.4g} to {block.max():.4g}.",
            "Expected DN on 0..255; scale with intensity.to_dn.")


def _pack(out: scan.Interval, edges: np.ndarray, model: SensorModel, noisy: bool) -> Events:
    """Intervals (T, H, W) on the device -> one sorted `Events` on the host."""
    steps = len(edges) - 1
    height, width = out.spikes.count.shape[1:]
    dt = np.diff(edges)
    parts = [_signal_events(out, dt, model)]
    if noisy:
        parts += [_noise_events(np.asarray(c[:steps]), np.asarray(out.noise_at[:steps, i]), i == 0,
                                model)
                  for i, c in enumerate((out.noise_on, out.noise_off))]
    step, pixel, fraction, p = (np.concatenate(column) for column in zip(*parts, strict=True))
    within = np.ceil(fraction * dt[step]).astype(np.int64)
    t = edges[step] + np.clip(within, 1, dt[step])
    order = np.argsort(t, kind="stable")
    pixel = pixel[order]
    return Events.unchecked(
        (pixel % width).astype(np.uint16), (pixel // width).astype(np.uint16), t[order], p[order],
        (width, height))


Columns = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def _signal_events(out: scan.Interval, dt: np.ndarray, model: SensorModel) -> Columns:
    """(step, pixel, fraction of the interval, polarity) of every signal event."""
    steps = len(dt)
    count = np.asarray(out.spikes.count)[:steps].reshape(steps, -1)
    step, pixel = np.nonzero(count)
    signed = count[step, pixel]
    number = np.abs(signed)
    k = (np.arange(number.sum()) - np.repeat(np.cumsum(number) - number, number)).astype(np.float32)

    def column(a: Array) -> np.ndarray:
        values = np.asarray(a)[:steps].reshape(steps, -1)[step, pixel]
        return np.repeat(values, number)

    fraction = column(out.spikes.first) + k * column(out.spikes.spacing)
    if model.refractory_s > 0 and model.timestamps == "crossing":
        dead = np.repeat((model.refractory_s / (dt * 1e-6)).astype(np.float32)[step], number)
        fraction = np.maximum(fraction, column(out.spikes.earliest) + k * dead)
    return (np.repeat(step, number), np.repeat(pixel, number), fraction,
            np.repeat(signed > 0, number))


def _noise_events(counts: np.ndarray, at: np.ndarray, on: bool, model: SensorModel) -> Columns:
    """The same columns for the noise events of one polarity; v2e puts them at the frame."""
    steps = len(counts)
    counts, at = counts.reshape(steps, -1), at.reshape(steps, -1)
    step, pixel = np.nonzero(counts)
    number = counts[step, pixel].astype(np.int64)
    k = np.arange(number.sum()) - np.repeat(np.cumsum(number) - number, number)
    fraction = np.mod(np.repeat(at[step, pixel], number) + k * noise.GOLDEN, 1.0)
    if model.timestamps == "v2e":
        fraction = np.ones_like(fraction)
    return (np.repeat(step, number), np.repeat(pixel, number), fraction.astype(np.float32),
            np.full(len(fraction), on))
