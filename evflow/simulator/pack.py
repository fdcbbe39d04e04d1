"""What a block of frames has sent -> a sorted list of events (host, NumPy).

Event times are integer microseconds in (t_prev, t_now] of their frame interval, so intervals
never overlap. The order is total: time, then pixel, then polarity, then noise after signal.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import jax
import numpy as np

from evflow.sensors import SensorModel
from evflow.simulator import noise
from evflow.simulator.active import Sent
from evflow.simulator.sensor import Struck
from evflow.types import Events

Array = np.ndarray


@dataclasses.dataclass(frozen=True)
class Columns:
    """Events in no order: interval of the block, pixel, fraction of the interval, whether ON,
    whether noise (one flag for all)."""

    step: Array
    pixel: Array
    fraction: Array
    on: Array
    noise: bool


def signal_columns(
    model: SensorModel, sent: Sent, pixels: Array, dt_us: Array
) -> Iterator[Columns]:
    """The signal events of `sent`, whose columns belong to `pixels`."""
    spikes, (at, step, pixel) = sent.spikes, _where(sent.fires, pixels, len(dt_us))
    count, first = _of(spikes.count, at), _of(spikes.first, at)
    earliest = None if spikes.earliest is None else _of(spikes.earliest, at)
    on = count > 0
    yield Columns(step, pixel, first if earliest is None else np.maximum(first, earliest), on,
                  noise=False)
    # The further events of each progression; there are few.
    many = np.flatnonzero(np.abs(count) > 1)
    row, k = _repeated(np.abs(count.take(many)) - 1)
    row, k = many[row], (k + 1).astype(np.float32)
    step, fraction = step.take(row), first.take(row) + k * _of(spikes.spacing, at.take(row))
    if earliest is not None:
        dead = (model.refractory_s / (dt_us * 1e-6)).astype(np.float32)
        fraction = np.maximum(fraction, earliest.take(row) + k * dead.take(step))
    yield Columns(step, pixel.take(row), fraction, on.take(row), noise=False)


def noise_columns(
    model: SensorModel, struck: Struck | None, pixels: Array, words: Array, dt_us: Array
) -> Iterator[Columns]:
    """The noise events. words: `Sensor.words`, whole."""
    if struck is not None:
        at, step, pixel = _where(struck.some, pixels, len(dt_us))
        odds = jax.tree.map(lambda a: _of(a, at), struck.odds)
        yield _noise(model, step, pixel, words.take(pixel), _of(struck.drawn, at), odds)


def _where(flags: jax.Array, pixels: Array, steps: int) -> tuple[Array, Array, Array]:
    """Index into arrays (T, K), interval and pixel of what is flagged; intervals from `steps` on
    are padding."""
    at = np.flatnonzero(np.asarray(flags)[:steps])
    step = at // flags.shape[1]
    return at, step, pixels.take(at - step * flags.shape[1])


def _of(values: jax.Array, at: Array) -> Array:
    return np.asarray(values).ravel().take(at)


def _repeated(number: Array) -> tuple[Array, Array]:
    """Rows 0, 1, ... each `number` times, and which time it is: 0, 1, ..."""
    number = number.astype(np.int64)
    row = np.repeat(np.arange(len(number)), number)
    return row, np.arange(len(row)) - np.repeat(np.cumsum(number) - number, number)


def _noise(
    model: SensorModel, step: Array, pixel: Array, words: Array, drawn: Array, odds: noise.Odds
) -> Columns:
    """Noise events, of which each pixel and interval here sends one or more."""
    u, tail, number = noise.uniform(drawn), odds.tail(), np.zeros(len(step), np.int64)
    while (more := u < tail[0]).any():
        number += more
        tail = noise.next_tail(odds.mean, tail)
    row, k = _repeated(number)
    at, on = noise.event(model, words[row], drawn[row], k.astype(np.uint32), odds.share[row])
    return Columns(step[row], pixel[row], at, on, noise=True)


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
    keys = np.concatenate([nothing, *(_keys(part, np.diff(edges), bits, dtype) for part in parts)])
    keys.sort()
    pixel = (keys & dtype((1 << bits) - 1)) >> dtype(2)
    y = pixel // dtype(width)
    x = pixel - y * dtype(width)
    t = (keys >> dtype(bits)).astype(np.int64)
    t += edges[0]
    on, noise = ((keys & dtype(flag)).astype(bool) for flag in (2, 1))
    columns = x.astype(np.uint16), y.astype(np.uint16), t, on
    return Events.unchecked(*columns, (width, height)), noise


def _keys(part: Columns, dt_us: Array, bits: int, dtype: type) -> Array:
    """Microseconds into the block, pixel, polarity and kind, packed into integers that sort so.
    Times are rounded up to a microsecond, within (begin, end] of their interval."""
    exact = np.float32 if dt_us.max(initial=0) < 1 << 24 else np.float64
    even = (dt_us == dt_us[0]).all()
    length = exact(dt_us[0]) if even else dt_us.astype(exact).take(part.step)
    within = part.fraction * length
    np.ceil(within, out=within)
    np.maximum(within, 1, out=within)
    np.minimum(within, length, out=within)
    keys = (part.step * dt_us[0] if even else (np.cumsum(dt_us) - dt_us).take(part.step)
            ).astype(dtype)
    keys += within.astype(dtype)
    keys <<= dtype(bits - 2)
    keys += part.pixel.astype(dtype)
    keys <<= dtype(1)
    keys += part.on
    keys <<= dtype(1)
    return keys + dtype(part.noise)
