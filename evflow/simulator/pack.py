"""What a block of frames has sent -> a sorted list of events (host, NumPy).

Event times are integer microseconds in (t_prev, t_now] of their frame interval, so intervals
never overlap. The order is total: time, then pixel, then polarity, then noise after signal.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import numpy as np

from evflow.sensors import SensorModel
from evflow.simulator import noise
from evflow.simulator.active import TICKS, Sent
from evflow.simulator.pixel import Spikes
from evflow.simulator.sensor import Struck
from evflow.types import Events

Array = np.ndarray


@dataclasses.dataclass(frozen=True)
class Columns:
    """Events in no order: microseconds from the begin of the block, pixel, whether ON, whether
    noise (one flag for all). Integers; their dtype is the callers' choice."""

    when: Array
    pixel: Array
    on: Array
    noise: bool


def from_fractions(
    step: Array, pixel: Array, fraction: Any, on: Any, dt_us: Array, *, noise: bool
) -> Columns:
    """Events at a fraction of interval `step` of the block. Times are rounded up to a
    microsecond, within (begin, end] of their interval."""
    exact = np.float32 if dt_us.max(initial=0) < 1 << 24 else np.float64
    length = dt_us.astype(exact).take(step)
    within = np.clip(np.ceil(fraction * length), 1, length)
    begin = np.cumsum(dt_us) - dt_us
    return Columns(begin.take(step) + within.astype(np.int64), pixel, on, noise)


def signal_columns(
    model: SensorModel, sent: Sequence[tuple[Array, Sent]], dt_us: Array
) -> Iterator[Columns]:
    """The signal events of a block. sent: what some pixels send, and which they are."""
    # Ticks have room for nearly half an hour; time-lapse goes by fractions altogether.
    timed = int(dt_us.sum()) < TICKS
    further = []
    for pixels, out in sent:
        at, pixel = _where(out.fires, pixels, len(dt_us))
        ticks = _of(out.ticks, at)
        if timed:
            yield Columns(ticks >> 2, pixel, (ticks >> 1) & 1, noise=False)
            many = np.flatnonzero((ticks & 1).astype(bool))  # there are few
            at, pixel = at.take(many), pixel.take(many)
        spikes = jax.tree.map(lambda values, at=at: _of(values, at), out.spikes)
        further.append((at // out.fires.shape[1], pixel, spikes))
    if further:
        step, pixel, spikes = jax.tree.map(lambda *parts: np.concatenate(parts), *further)
        yield _progressions(model, step, pixel, spikes, dt_us, skip=int(timed))


def _progressions(
    model: SensorModel, step: Array, pixel: Array, spikes: Spikes, dt_us: Array, skip: int
) -> Columns:
    """All events of `spikes` but the first `skip` of each."""
    row, k = _repeated(np.abs(spikes.count) - skip)
    step, k = step.take(row), (k + skip).astype(np.float32)
    fraction: Any = spikes.first.take(row) + k * spikes.spacing.take(row)
    if spikes.earliest is not None:
        dead = (model.refractory_s / (dt_us * 1e-6)).astype(np.float32)
        fraction = np.maximum(fraction, spikes.earliest.take(row) + k * dead.take(step))
    return from_fractions(
        step, pixel.take(row), fraction, spikes.count.take(row) > 0, dt_us, noise=False)


def noise_columns(
    model: SensorModel, struck: Struck | None, pixels: Array, words: Array, dt_us: Array
) -> Iterator[Columns]:
    """The noise events. words: `Sensor.words`, whole."""
    if struck is None:
        return
    at, pixel = _where(struck.some, pixels, len(dt_us))
    step, odds = at // struck.some.shape[1], jax.tree.map(lambda a: _of(a, at), struck.odds)
    words, drawn = words.take(pixel), _of(struck.drawn, at)
    row, k = _repeated(_number(odds, noise.uniform(drawn)))
    fraction, on = noise.event(
        model, words[row], drawn[row], k.astype(np.uint32), odds.share[row])
    yield from_fractions(step[row], pixel[row], fraction, on, dt_us, noise=True)


def _number(odds: noise.Odds, u: Array) -> Array:
    """How many noise events each pixel sends that drew u."""
    tail, number = odds.tail(), np.zeros(len(u), np.int64)
    while (more := u < tail[0]).any():
        number += more
        tail = noise.next_tail(odds.mean, tail)
    return number


def _where(flags: jax.Array, pixels: Array, steps: int) -> tuple[Array, Array]:
    """Index into arrays (T, K), and pixel, of what is flagged; intervals from `steps` on are
    padding."""
    at = np.flatnonzero(np.asarray(flags)[:steps])
    row = at // flags.shape[1]
    return at, pixels.take(at - row * flags.shape[1])  # % takes three times as long


def _of(values: jax.Array, at: Array) -> Array:
    return np.asarray(values).ravel().take(at)


def _repeated(number: Array) -> tuple[Array, Array]:
    """Rows 0, 1, ... each `number` times, and which time it is: 0, 1, ..."""
    number = number.astype(np.int64)
    row = np.repeat(np.arange(len(number)), number)
    return row, np.arange(len(row)) - np.repeat(np.cumsum(number) - number, number)


def sort(
    parts: list[Columns], edges: Array, shape: tuple[int, int]
) -> tuple[Events, Array]:
    """The sorted `Events` of a block whose frames are at `edges` (T + 1,) us, and (N,) bool:
    which of them are noise.

    Time, pixel, polarity and kind in one integer make a sort without an index array; equal
    integers are equal events.
    """
    height, width = shape
    bits = (4 * height * width - 1).bit_length()  # of pixel, polarity and kind
    dtype = np.uint32 if (int(edges[-1] - edges[0]) << bits) < 2**32 else np.uint64
    nothing = np.empty(0, dtype)
    keys = np.concatenate([nothing, *(_keys(part, bits, dtype) for part in parts)])
    keys.sort()
    pixel = (keys & dtype((1 << bits) - 1)) >> dtype(2)
    y = pixel // dtype(width)
    x = pixel - y * dtype(width)
    t = (keys >> dtype(bits)).astype(np.int64)
    t += edges[0]
    on, noise = ((keys & dtype(flag)).astype(bool) for flag in (2, 1))
    columns = x.astype(np.uint16), y.astype(np.uint16), t, on
    return Events.unchecked(*columns, (width, height)), noise


def _keys(part: Columns, bits: int, dtype: type) -> Array:
    """Time, pixel, polarity and kind, packed into integers that sort so."""
    keys: Array = part.when.astype(dtype)
    keys <<= dtype(bits - 2)
    keys += part.pixel.astype(dtype)
    keys <<= dtype(1)
    keys += part.on.astype(dtype)
    keys <<= dtype(1)
    return keys + dtype(part.noise)
