"""The simulator's peer: plain loops over pixels on one thread, compiled by numba.

The same pixel as evflow's (thresholds per pixel and polarity, crossings interpolated linearly,
remainder kept, first-order low-pass that scales with intensity, ON leak that jitters, shot noise, a
noise event resets the memory), with at most one shot-noise event per pixel and interval. Per
interval: count, emit what was counted, then a counting sort by microsecond; or add to a voxel grid
instead. Noise off and on are compiled apart.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numba
import numpy as np

from evflow.camera import Camera
from evflow.camera.sensors import SensorModel

Array = np.ndarray
jit: Any = numba.njit  # its own annotations know nothing of arguments


@dataclasses.dataclass(frozen=True)
class Pixels:
    """on, off: thresholds (N,), natural log. dt: frame interval in seconds. leak: (N,) contrast
    in an interval, of which each step varies by the share `jitter`. shot_on, shot_off: (N,) events
    in an interval in darkness. corner: of the low-pass, in intervals and radians. noisy: whether
    the last five count."""

    on: Array
    off: Array
    dt: float
    leak: Array
    jitter: float
    shot_on: Array
    shot_off: Array
    corner: float
    noisy: bool

    @staticmethod
    def of(camera: Camera, model: SensorModel, dt: float) -> Pixels:
        """evflow's camera and sensor, whose leak has a pattern of its own."""
        on, off = (np.asarray(theta, np.float32).ravel()
                   for theta in (camera.theta_on, camera.theta_off))
        pattern = 10 ** (model.leak_fpn_decades * np.random.default_rng(1).normal(size=on.size))
        leak = (model.leak_hz * dt * pattern * on).astype(np.float32)
        shot = [np.float32(0.5 * model.shot_hz * dt * np.median(th)) / th for th in (on, off)]
        return Pixels(on, off, dt, leak, model.leak_jitter, *shot,
                      dt * model.cutoff_hz * 2 * np.pi, model != SensorModel())


def _counter(noisy: bool) -> Callable[..., int]:
    """count(...) -> events of one interval. Moves lp to the new frame, leaks base, and leaves
    lp's old value in `old`, signed signal counts in `signal`, shot noise (-1, 0, 1) in `noise`."""

    @jit
    def count(
        frame: Array, table: Array, lp: Array, old: Array, base: Array, signal: Array,
        noise: Array, on: Array, off: Array, rng: Any, corner: float, leak: Array, jitter: float,
        shot_on: Array, shot_off: Array,
    ) -> int:
        total = 0
        for i in range(len(frame)):
            log_i, i01 = table[frame[i]], np.float32(frame[i] + 20) * np.float32(1 / 275)
            old[i] = lp[i]
            if noisy:
                eps = min(np.float32(1), i01 * np.float32(corner))
                log_i = old[i] + eps * (log_i - old[i])
                base[i] -= leak[i] * np.float32(1 - jitter * rng.standard_normal())
            lp[i] = log_i
            contrast = log_i - base[i]
            signal[i] = np.int32(contrast / (on[i] if contrast > 0 else off[i]))
            total += abs(signal[i])
            if noisy:
                factor = np.float32(1) - np.float32(0.75) * i01
                u = rng.random()
                noise[i] = np.int32(u < shot_on[i] * factor) - np.int32(
                    u > 1 - shot_off[i] * factor)
                total += abs(noise[i])
        return total

    return count


COUNTERS = {noisy: _counter(noisy) for noisy in (False, True)}


@jit
def _emit(
    lp: Array, old: Array, base: Array, signal: Array, noise: Array, on: Array, off: Array,
    rng: Any, dt_us: int, pixel: Array, offset: Array, rising: Array,
) -> None:
    """The counted events, unsorted: pixel, microseconds into the interval, polarity. Settles
    the memory."""
    n = 0
    for i in range(len(lp)):
        if signal[i] != 0:
            step = on[i] if signal[i] > 0 else -off[i]
            rise = lp[i] - old[i]
            for k in range(1, abs(signal[i]) + 1):
                at = (base[i] + k * step - old[i]) / rise if rise * step > 0 else 0.0
                pixel[n], rising[n] = i, step > 0
                offset[n] = min(max(int(np.ceil(at * dt_us)), 1), dt_us)
                n += 1
            base[i] += abs(signal[i]) * step
        if noise[i] != 0:
            pixel[n], rising[n] = i, noise[i] > 0
            offset[n] = 1 + int(rng.random() * dt_us)
            n += 1
            base[i] = lp[i]


@jit
def _place(
    begin_us: int, width: int, dt_us: int, first: int, pixel: Array, offset: Array, on: Array,
    x: Array, y: Array, t: Array, p: Array,
) -> None:
    """Counting sort of one interval's events into x, y, t, p from index `first`."""
    slot = np.zeros(dt_us + 2, np.int64)
    for o in offset:
        slot[o + 1] += 1
    slot = first + np.cumsum(slot)
    for i in range(len(offset)):
        at = slot[offset[i]]
        slot[offset[i]] += 1
        x[at], y[at] = pixel[i] % width, pixel[i] // width
        t[at], p[at] = begin_us + offset[i], on[i]


@jit
def _accumulate(
    lp: Array, old: Array, base: Array, signal: Array, noise: Array, on: Array, off: Array,
    rng: Any, begin: float, length: float, grid: Array,
) -> None:
    """The counted events' triangular weights onto grid (pixels, 2, bins); the interval spans
    [begin, begin + length] bins. Settles the memory."""
    bins = grid.shape[2]
    for i in range(len(lp)):
        if signal[i] == 0 and noise[i] == 0:
            continue
        step = on[i] if signal[i] > 0 else -off[i]
        rise = lp[i] - old[i]
        for k in range(1, abs(signal[i]) + 1):
            at = (base[i] + k * step - old[i]) / rise if rise * step > 0 else 0.0
            position = begin + at * length
            low = min(int(position), bins - 2)
            grid[i, int(step < 0), low] += low + 1 - position
            grid[i, int(step < 0), low + 1] += position - low
        base[i] += abs(signal[i]) * step
        if noise[i] != 0:
            position = begin + rng.random() * length
            low = min(int(position), bins - 2)
            grid[i, int(noise[i] < 0), low] += low + 1 - position
            grid[i, int(noise[i] < 0), low + 1] += position - low
            base[i] = lp[i]


class _State:
    """All pixels of one sensor, and `count` for their next frame."""

    def __init__(self, frame: Array, table: Array, pixels: Pixels) -> None:
        self.table, self.pixels = table, pixels
        self.lp = table[frame.ravel()]
        self.old, self.base = self.lp.copy(), self.lp.copy()
        self.signal, self.noise = np.zeros((2, self.lp.size), np.int32)
        self.rng = np.random.default_rng(0)

    def count(self, frame: Array) -> int:
        p = self.pixels
        return COUNTERS[p.noisy](frame.ravel(), self.table, *self.arrays, p.corner, p.leak,
                                 p.jitter, p.shot_on, p.shot_off)

    @property
    def arrays(self) -> tuple[Any, ...]:
        return (self.lp, self.old, self.base, self.signal, self.noise, self.pixels.on,
                self.pixels.off, self.rng)


def simulate(frames: Array, table: Array, pixels: Pixels) -> tuple[Array, Array, Array, Array]:
    """Sorted x, y (uint16), t (int64 us), p (bool) of uint8 frames (T, H, W). table: log
    intensity of the 256 byte values, float32."""
    state, dt_us = _State(frames[0], table, pixels), round(1e6 * pixels.dt)
    out = [np.empty(0, d) for d in (np.uint16, np.uint16, np.int64, np.bool_)]
    first = 0
    for index, frame in enumerate(frames[1:]):
        total = state.count(frame)
        if first + total > len(out[0]):
            out = [_grown(a, first + total) for a in out]
        columns = [np.empty(total, d) for d in (np.int32, np.int32, np.bool_)]
        _emit(*state.arrays, dt_us, *columns)
        _place(index * dt_us, frames.shape[2], dt_us, first, *columns, *out)
        first += total
    x, y, t, p = (a[:first] for a in out)
    return x, y, t, p


def simulate_voxels(frames: Array, table: Array, pixels: Pixels, bins: int) -> Array:
    """Voxel grid float32 (H, W, 2 * bins) of uint8 frames (T, H, W); the window is their span."""
    state = _State(frames[0], table, pixels)
    grid = np.zeros((state.lp.size, 2, bins), np.float32)
    length = (bins - 1) / (len(frames) - 1)
    for index, frame in enumerate(frames[1:]):
        state.count(frame)
        _accumulate(*state.arrays, index * length, length, grid)
    return grid.reshape(*frames.shape[1:], 2 * bins)


def _grown(a: Array, least: int) -> Array:
    wider = np.empty(max(2 * len(a), least), a.dtype)
    wider[: len(a)] = a
    return wider
