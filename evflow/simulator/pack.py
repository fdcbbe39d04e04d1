"""The events of a block of frames, as a sorted list (host, NumPy).

Event times are integer microseconds in (t_prev, t_now] of their frame interval, so intervals
never overlap. The order is total: time, OFF before ON, noise after signal, pixel.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import numpy as np

from evflow.errors import EvflowDataError
from evflow.light.log_maps import normalised_intensity
from evflow.simulator import noise
from evflow.simulator.active import TICKS, Block, Sent
from evflow.simulator.constants import Constants
from evflow.simulator.sensor import Sensor
from evflow.types import Events

Array = np.ndarray

MOST_EVENTS = 1 << 27  # of a block of frames: 8 GB while they are sorted


@dataclasses.dataclass(frozen=True)
class Keys:
    """Encoding of a block's events as integers in sort order: microseconds since the block's begin,
    times 4, + 2 if ON, + 1 if noise (the rank), shifted left by `bits`, with the pixel in these.
    Equal integers are equal events; 0 is none. dtype: 32 bits if sufficient, else 64."""

    bits: int
    dtype: type

    @classmethod
    def of(cls, pixels: int, length_us: int) -> Keys:
        bits = (pixels - 1).bit_length()
        if length_us << bits + 2 >= 2**64:
            raise EvflowDataError(
                "EV004", f"a block of frames lasts {length_us / 8.64e10:,.0f} days, too long for "
                f"the event times of {pixels:,} pixels.", "Are the times in another unit? Simulate "
                "parts of a time lapse separately.")
        return cls(bits, np.uint32 if length_us << bits + 2 < 2**32 else np.uint64)

    @property
    def bits_below(self) -> int:
        """`Block.bits`: the device makes whole keys of 32 bits, but only ranks of wider ones."""
        return self.bits if self.dtype is np.uint32 else 0

    def __call__(self, rank: Array, pixel: Array) -> Array:
        keys: Array = rank.astype(self.dtype)
        keys <<= self.dtype(self.bits)
        keys += pixel.astype(self.dtype)
        return keys


def from_fractions(
    keys: Keys, step: Array, pixel: Array, fraction: Any, on: Any, dt_us: Array, *, noise: bool
) -> Array:
    """Events at a fraction of interval `step` of the block. Times are rounded up to a
    microsecond, within (begin, end] of their interval."""
    exact = np.float32 if dt_us.max(initial=0) < 1 << 24 else np.float64
    length = dt_us.astype(exact).take(step)
    within = np.clip(np.ceil(fraction * length), 1, length)
    begin = np.cumsum(dt_us) - dt_us
    when = begin.take(step) + within.astype(np.int64)
    return keys((when << 2) + 2 * on + noise, pixel)


def signal(
    model: Constants, keys: Keys, sent: Sequence[tuple[Array, Sent]], dt_us: Array
) -> Iterator[Array]:
    """Keys of the signal events of a block. sent: pixels and their output."""
    # Ranks hold nearly half an hour; longer blocks (time lapse) use fractions only.
    timed = int(dt_us.sum()) < TICKS
    flag = np.uint32(1 << keys.bits_below)
    further = []
    for pixels, out in sent:
        first = np.asarray(out.first)[: len(dt_us)]
        at = np.flatnonzero(first != 0)  # six times as fast on bools
        if timed:
            found = first.ravel().take(at)
            yield (found & ~flag if keys.bits_below else
                   keys(found & ~flag, _pixels(at, first, pixels)))
            at = at.take(np.flatnonzero((found & flag) != 0))  # few pixels have more than one
        further.append((out, at, _pixels(at, first, pixels)))
    if any(len(at) for _, at, _ in further):
        yield _progressions(model, keys, further, dt_us, skip=int(timed))


def _progressions(
    model: Constants, keys: Keys, sent: list[tuple[Sent, Array, Array]], dt_us: Array, skip: int
) -> Array:
    """All events but the first `skip` of each pixel and interval. sent: outputs, flat indices into
    their arrays, and the pixels there."""
    def spikes(name: str) -> Array:
        return np.concatenate([_of(getattr(out.spikes, name), at) for out, at, _ in sent])

    count = spikes("count")
    need_few(count, len(dt_us))
    row, k = repeated(np.abs(count) - skip)
    step, pixel = (np.concatenate(parts).take(row) for parts in zip(
        *((at // out.first.shape[1], pixel) for out, at, pixel in sent), strict=True))
    k = (k + skip).astype(np.float32)
    fraction: Any = spikes("first").take(row) + k * spikes("spacing").take(row)
    if sent[0][0].spikes.earliest is not None:
        dead = (model.refractory_s / (dt_us * 1e-6)).astype(np.float32)
        fraction = np.maximum(fraction, spikes("earliest").take(row) + k * dead.take(step))
    return from_fractions(keys, step, pixel, fraction, count.take(row) > 0, dt_us, noise=False)


def noises(
    model: Constants, keys: Keys, whole: Sensor, struck: Sequence[tuple[Array, Array, Any]],
    block: Block, dt_us: Array,
) -> Iterator[Array]:
    """Keys of the noise events of a block.

    Draws and probabilities are recomputed here for the few pixels with noise events: writing them
    as maps on the device would cost more than the rest of the block.

    Args:
        model, keys: the circuit, and the encoding.
        whole: the sensor in NumPy.
        struck: pixels, their frames (T + 1, K), and flags of noise events (None without noise).
        block, dt_us: the block and its intervals in us.
    """
    found = [_struck(pixels, frames, np.asarray(flags)[: len(dt_us)])
             for pixels, frames, flags in struck if flags is not None]
    if not found:
        return
    step, pixel, dn = (np.concatenate(parts) for parts in zip(*found, strict=True))
    words, rates = jax.tree.map(lambda m: m.take(pixel), (whole.words, whole.rates))
    drawn = noise.draw(words, block.salts.take(step, axis=0).T)
    odds = noise.odds(rates, normalised_intensity(dn.astype(np.float32)), block.dt.take(step))
    row, k = repeated(_number(odds, noise.uniform(drawn)))
    fraction, on = noise.event(
        model, words[row], drawn[row], k.astype(np.uint32), odds.share[row])
    yield from_fractions(keys, step[row], pixel[row], fraction, on, dt_us, noise=True)


def _struck(pixels: Array, frames: Array, flags: Array) -> tuple[Array, Array, Array]:
    """Interval, pixel and DN of noise events."""
    at = np.flatnonzero(flags)
    return at // flags.shape[1], _pixels(at, flags, pixels), frames[1:].ravel().take(at)


def _number(odds: noise.Odds, u: Array) -> Array:
    """Number of noise events of pixels that drew u: at least one, whatever the rounding of the
    device that flagged them."""
    tail, number = noise.next_tail(odds.mean, odds.tail()), np.ones(len(u), np.int64)
    while (more := u < tail[0]).any():
        number += more
        tail = noise.next_tail(odds.mean, tail)
    return number


def _pixels(at: Array, values: Array, pixels: Array) -> Array:
    """The pixels of flat indices into an array (T, K); pixels: (K,)."""
    row = at // values.shape[1]
    return pixels.take(at - row * values.shape[1])  # % takes three times as long


def _of(values: jax.Array, at: Array) -> Array:
    return np.asarray(values).ravel().take(at)


def need_few(count: Array, intervals: int) -> None:
    """Raise EV014 for more events than a video gives at plausible thresholds. count: signed, per
    pixel."""
    if (total := float(np.abs(count).sum(dtype=np.float64))) > MOST_EVENTS:
        most = float(np.abs(count).max())
        raise EvflowDataError(
            "EV014", f"{total:.3g} events between {intervals + 1} frames, up to {most:.3g} of one "
            "pixel: the thresholds are too low for this video.",
            "Raise them (those of real pixels are .05 to 1, natural log); or are the frames "
            "logarithms, or of another scale?")


def repeated(number: Array) -> tuple[Array, Array]:
    """Indices 0, 1, ... each repeated `number` times, and the number of the repetition, from 0."""
    number = number.astype(np.int64)
    row = np.repeat(np.arange(len(number)), number)
    return row, np.arange(len(row)) - np.repeat(np.cumsum(number) - number, number)


def sort(
    keys: Keys, parts: list[Array], begin_us: int, shape: tuple[int, int]
) -> tuple[Events, Array]:
    """The sorted `Events` of a block that begins at `begin_us`, and (N,) bool: which are noise."""
    height, width = shape
    bits, merged = keys.bits, np.concatenate([np.empty(0, keys.dtype), *parts])
    merged, above = _in_order(merged, bits)
    dtype = merged.dtype.type
    pixel = merged & dtype((1 << bits) - 1)
    y = pixel // dtype(width)
    x = pixel - y * dtype(width)
    t = (merged >> dtype(bits + 2)).astype(np.int64)
    t += begin_us + (above >> bits + 2)
    noise, on = ((merged & dtype(flag << bits)).astype(bool) for flag in (1, 2))
    columns = x.astype(np.uint16), y.astype(np.uint16), t, on
    return Events.unchecked(*columns, (width, height)), noise


def _in_order(keys: Array, bits: int) -> tuple[Array, Array]:
    """Sorted integers, and an offset to add to them. Of 64 bits with few distinct upper halves, the
    lower halves are sorted by 32 bits, in two thirds of the time."""
    few = keys.dtype == np.uint64 and bits <= 30 and int(keys.max(initial=0)) >> 40 == 0
    if not few:
        keys.sort()
        return keys, np.zeros((), np.int64)
    upper = (keys >> np.uint64(32)).astype(np.uint8)
    counts = np.bincount(upper, minlength=1)
    lower = keys.astype(np.uint32).take(np.argsort(upper, kind="stable"))
    for end, count in zip(np.cumsum(counts).tolist(), counts.tolist(), strict=True):
        lower[end - count : end].sort()
    return lower, np.repeat(np.arange(len(counts)) << 32, counts)
