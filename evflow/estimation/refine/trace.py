"""A pixel's first event and event counts in a chunk, recorded or simulated.

After its first event a pixel's memory is the brightness at that time, so all later events follow
from path and thresholds. What came before is not compared.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from evflow.camera import THETA_MIN
from evflow.types import Events

Array = np.ndarray

NEVER = np.int32(1 << 30)
RUNNING, FRESH = (1.0, 1.0), (0.0, 0.0)  # starts


@dataclasses.dataclass(frozen=True, eq=False)
class Trace:
    """step: (H, W) int32, fine step of the first event, NEVER without one; fraction: (H, W),
    where in that step; first_on: (H, W) bool, its polarity; counts: (K, 2, H, W) float32,
    events per interval and polarity, the first one included."""

    step: Array
    fraction: Array
    first_on: Array
    counts: Array


def trace_of_events(events: Events, times_us: np.ndarray, steps: int) -> Trace:
    """The recorded Trace between the frames at times_us (K+1,), in NumPy arrays."""
    width, height = events.size
    used = events.slice(int(times_us[0]) + 1, int(times_us[-1]) + 1)
    pixel = used.y.astype(np.int64) * width + used.x
    interval = np.searchsorted(times_us, used.t, side="left") - 1
    n, k = height * width, len(times_us) - 1
    where = np.where(used.p, 0, n) + pixel
    ends = np.searchsorted(interval, np.arange(k + 1))
    counts = np.empty((k, 2 * n), np.float32)  # row by row: of all at once int64 is too large
    for row, first, last in zip(counts, ends[:-1], ends[1:], strict=True):
        row[:] = np.bincount(where[first:last], minlength=2 * n)
    pixels, first = np.unique(pixel, return_index=True)
    at = interval[first]
    position = (used.t[first] - times_us[at]) / np.diff(times_us)[at] * steps
    inside = np.clip(np.ceil(position) - 1, 0, steps - 1)
    step, fraction = np.full(n, NEVER, np.int32), np.zeros(n, np.float32)
    first_on = np.zeros(n, bool)
    step[pixels] = at * steps + inside
    fraction[pixels] = position - inside
    first_on[pixels] = used.p[first]
    shape = (height, width)
    return Trace(step.reshape(shape), fraction.reshape(shape), first_on.reshape(shape),
                 counts.reshape(k, 2, *shape))


@dataclasses.dataclass(frozen=True, eq=False)
class Draws:
    """Random numbers of simulated cameras on a chunk. pixels: (2, N) normal, for the thresholds;
    phase: (N,) uniform, brightness relative to the memory at the start; noise: (K, 2, N) uniform,
    compared with the probability of a noise event; when: (K, 2, N) int8, its fine step."""

    pixels: Array
    phase: Array
    noise: Array
    when: Array

    def thresholds(self, values: Array) -> Array:
        """theta (2, N), ON and OFF, of a camera (6,): theta, eta, sigma, ON and OFF each."""
        drawn = values[:2, None] + values[4:, None] * self.pixels
        return np.maximum(drawn, np.float32(THETA_MIN))


def draw(
    key: jax.Array, number: int, shape: tuple[int, int], intervals: int, steps: int
) -> Draws:
    """Draws for a chunk, by its number: cameras that share them differ only by their parameters.

    Args:
        key: of the recording.
        number: of the chunk.
        shape: (H, W).
        intervals, steps: frame intervals, and fine steps in each.
    """
    return Draws(*(
        np.asarray(a) for a in _drawn(key, np.uint32(number), shape, intervals, steps)))


@partial(jax.jit, static_argnums=(2, 3, 4))
def _drawn(
    key: jax.Array, number: jax.Array, shape: tuple[int, int], intervals: int, steps: int
) -> tuple[jax.Array, ...]:
    k_pixels, k_trace = jax.random.split(jax.random.fold_in(key, number))
    k_phase, k_noise, k_when = jax.random.split(k_trace, 3)
    each = intervals, 2, *shape
    return (jax.random.normal(k_pixels, (2, *shape)).reshape(2, -1),
            jax.random.uniform(k_phase, shape).ravel(),
            jax.random.uniform(k_noise, each).reshape(intervals, 2, -1),
            jax.random.randint(k_when, each, 0, steps).reshape(intervals, 2, -1).astype(jnp.int8))


def trace_of_camera(
    draws: Draws, path: Array, dt_s: Array, theta: Array, eta: Array, start: Array, steps: int
) -> Trace:
    """The Trace of a simulated camera, all float32.

    At most one noise event per pixel, polarity and interval is drawn (rates are ~.1 Hz, intervals
    ~25 ms); it sets the memory to the brightness.

    Args:
        draws: of the chunk.
        path: (K*steps + 1, H, W) log intensity.
        dt_s: (K,) interval lengths.
        theta: (2, N) of its pixels.
        eta: (2,) Hz.
        start: (2,) shares of theta_off and theta_on that bound the brightness about the memory:
            FRESH as in a simulation, RUNNING after motion, (0, 1) after a rise.
        steps: fine steps per interval.
    """
    # A simple pixel in NumPy (no low-pass, leak or dead time): few pixels have events in a step,
    # and a comparison finds them. XLA would compute all pixels, in ten times as long.
    flat, shape, (on, off) = path.reshape(len(path), -1), path.shape[1:], theta
    below, above = start[0] * off, start[1] * on
    base = flat[0] - (draws.phase * (above + below) - below)
    pixels, strikes = _Pixels(on, off, base, len(dt_s)), _strikes(draws, eta, dt_s, steps)
    for index, struck in enumerate(strikes):
        pixels.step(index, index // steps, flat[index], flat[index + 1])
        for polarity, at in enumerate(struck):
            pixels.strike(index, index // steps, flat[index], flat[index + 1], polarity, at)
    return Trace(pixels.first.reshape(shape), np.clip(pixels.fraction, 0.0, 1.0).reshape(shape),
                 pixels.first_on.reshape(shape), pixels.counts.reshape(-1, 2, *shape))


def _strikes(draws: Draws, eta: Array, dt_s: Array, steps: int) -> Iterator[tuple[Array, Array]]:
    """Pixels with a noise event in each fine step, ON and OFF."""
    for noise, when, dt in zip(draws.noise, draws.when, dt_s, strict=True):
        struck = [np.flatnonzero(u < -np.expm1(-rate * dt)) for u, rate in
                  zip(noise, eta, strict=True)]
        at = [w[pixels] for w, pixels in zip(when, struck, strict=True)]
        for step in range(steps):
            yield struck[0][at[0] == step], struck[1][at[1] == step]


class _Pixels:
    """State of N simulated pixels (float32): first (N,) step of the first event, fraction of that
    step, first_on; counts (K, 2, N)."""

    def __init__(self, on: Array, off: Array, base: Array, intervals: int) -> None:
        self.on, self.off, self.base = on, off, base
        self.first = np.full(base.shape, NEVER)
        self.fraction, self.first_on = np.zeros_like(base), np.zeros(base.shape, bool)
        self.counts = np.zeros((intervals, 2, *base.shape), np.float32)
        self._fall, self._rise = -off, np.empty_like(base)
        self._fires, self._falls = np.empty((2, *base.shape), bool)

    def step(self, index: int, interval: int, before: Array, now: Array) -> None:
        """Add the events of brightness changing from before (N,) to now (N,)."""
        np.subtract(now, self.base, out=self._rise)
        np.greater_equal(self._rise, self.on, out=self._fires)
        np.less_equal(self._rise, self._fall, out=self._falls)
        at = np.flatnonzero(np.logical_or(self._fires, self._falls, out=self._fires))
        if not len(at):
            return
        rise, on, off, base = self._rise[at], self.on[at], self.off[at], self.base[at]
        up = np.floor(np.maximum(rise, 0) / on)
        down = np.floor(np.maximum(-rise, 0) / off)
        self.base[at] = base + (up * on - down * off)
        self.counts[interval, 0, at] += up
        self.counts[interval, 1, at] += down
        new = self.first[at] == NEVER
        level = np.where(up > 0, on, -off)[new]
        at, up, base = at[new], up[new], base[new]
        change = now[at] - before[at]
        change[change == 0] = 1
        self.first[at], self.first_on[at] = index, up > 0
        self.fraction[at] = (level - before[at] + base) / change

    def strike(
        self, index: int, interval: int, before: Array, now: Array, polarity: int, at: Array
    ) -> None:
        """Add a noise event of pixels `at`, which sets their memory to the brightness."""
        self.base[at] = np.float32(0.5) * (before[at] + now[at])
        self.counts[interval, polarity, at] += 1
        at = at[self.first[at] == NEVER]
        self.first[at], self.fraction[at], self.first_on[at] = index, 0.5, polarity == 0
