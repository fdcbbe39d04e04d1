"""When the frames saw the light that they show, and for how long, from the events between them.

A frame is the mean of the light over its exposure; events show what happens meanwhile. So the
change of a pixel from frame to frame is that of its counts' mean over the exposures, times the
thresholds. (The double integral of Pan et al., CVPR 2019, solved for the exposure.) No optical flow
is needed. The delay of the events behind the frames is the one at which least squares explain most.
Two things would bias the length that does. Means over longer spans have less of the counts'
rounding: so the residuals are compared with what the *neighbours'* events show, whose rounding is
their own (instrumental variables, by two-stage least squares). And a signal that is drawn straight
from event to event is cut where it turns: there it is an arc.

What the frames' times are wrong by follows from the delay (frame_clock.py).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from evflow.estimation.refine.between_events import changes
from evflow.estimation.refine.busy import Busy, busy
from evflow.estimation.refine.frame_clock import BIAS, CLEARLY, Seen, WithError, is_rolling, late
from evflow.estimation.refine.frame_exposure import ON_TIME, UNSEEN, Exposure, Late, is_untold
from evflow.estimation.refine.path import Place
from evflow.estimation.refine.receptor_data import TILES
from evflow.light.log_maps import log64
from evflow.recordings.rolling import GLOBAL, Rolling, Side
from evflow.types import release

Array = np.ndarray

LENGTHS_US = 1e3 * np.array([0.5, 6.0, 12.0, 16.0, 20.0, 25.0, 30.0, 35.0, 40.0, 50.0])
SHARPER = 1e6 * np.array([-900.0, -400.0, -150.0])  # squares of lengths: events blurred, not frames
MIDDLE_US = 10e3  # length at which the delay and the offset are sought
SHOWN_US = 8e3, 24e3  # over which neighbours' counts are averaged: their difference is curvature
DELAYS_US = 1e3 * np.arange(-18.0, 19.0, 2.0)  # of events after frames: slow pixels, and clocks
REACH_US = 0.5 * LENGTHS_US[-1] - DELAYS_US[0], 0.5 * LENGTHS_US[-1] + DELAYS_US[-1]
OFFSETS = (-16.0, -8.0, 0.0, 8.0, 16.0, 26.0, 40.0)  # DN
BEYOND = 1.3  # times the interval between frames, so that an exposure as long as that is inside
ENOUGH = 150  # changes
EXPLAINS = 4.0  # times the least misfit, which that of no exposure exceeds if one is seen
KNEE = 20.0  # DN, of a photoreceptor whose rate is proportional to light and this
LEAST = np.log(0.7)  # log of the unexplained share, at most: else it is another scene or clock
UNEQUAL = 0.05  # of a threshold, below which the other polarity foretells nothing
NOTHING = 1e-9  # of the sums, so that one polarity alone, or no change, can be solved
FEWEST, FEWEST_LENGTHS = 4, 3  # tiles, over which a length's scatter says something; lengths
FLOOR_S = 2.5e-3  # std beside the scatter, of simulated cameras exposed for 10 and 20 ms
SIDES: tuple[tuple[Side, Side], ...] = (("top", "bottom"), ("left", "right"))
# Columns of products: changes that neighbours show; ON and minus OFF of the pixels; their frames.
AROUND, OWN, FRAMES = slice(0, 4), slice(4, 6), slice(6, 7)
SOLVED = slice(4, 7)  # by least squares


class Timing(NamedTuple):
    """exposure: of the frames, where it is untold; late: of the events behind the frames, where
    slow pixels do not explain it; left_s: what they leave of it, however little, 0 if it is
    unknown; rolling: how the frames are read, where that is clear, and nothing else then."""

    exposure: Exposure = UNSEEN
    late: Late = ON_TIME
    left_s: float = 0.0
    rolling: Rolling = GLOBAL


UNTIMED = Timing()


def frame_timing(places: Sequence[Place]) -> Timing:
    """The timing of the frames in some runs of frame intervals."""
    if any(recording.frames_were_made for recording, _ in places):
        return UNTIMED
    rng = np.random.default_rng(0)
    runs = [busy(recording, run, REACH_US, rng) for recording, run in places]
    told_us = float(np.mean([recording.exposure_us for recording, _ in places]))
    untold = all(is_untold(recording) for recording, _ in places)
    for recording, _ in places:
        release(recording)
    if sum(len(run.block) for run in runs) < ENOUGH:
        return UNTIMED
    interval = float(np.median(np.concatenate([np.diff(run.own.times_us) for run in runs])))
    lengths = LENGTHS_US[BEYOND * interval >= LENGTHS_US]
    if len(lengths) < FEWEST_LENGTHS:
        return UNTIMED
    about = _about(runs, min(MIDDLE_US, lengths[-1]))
    fits = _fits(runs, lengths, *about) if about else None
    if fits is None:
        return UNTIMED
    if fits.rolling != GLOBAL:
        return UNTIMED._replace(rolling=fits.rolling)
    misfits = fits.misfits
    explains = misfits[len(SHARPER)] > EXPLAINS * misfits.min() and (
        int(np.argmin(misfits)) < len(misfits) - 1)  # longer ones may do so better
    exposure = _exposure(*fits.square, interval) if untold and explains else UNSEEN
    square = fits.square[0] - told_us**2, fits.square[1]
    left_us, wrong = late(Seen(fits.delay_us, fits.darker_us, square, _longer(runs)),
                          interval if untold else 0.0)
    return Timing(exposure, wrong, 1e-6 * left_us)


def _about(runs: Sequence[Busy], middle_us: float) -> tuple[int, float] | None:
    """Where least squares explain most: index of the delay, and the offset in DN; None if that is
    at a bound, or does not explain enough."""
    of_frames = np.stack([np.concatenate([_of_frames(run, o) for run in runs]) for o in OFFSETS])
    logs = np.stack([_unexplained(runs, of_frames, middle_us, delay) for delay in DELAYS_US])
    delay, offset = (int(k) for k in np.unravel_index(np.argmin(logs), logs.shape))
    if delay in (0, 1, len(DELAYS_US) - 2, len(DELAYS_US) - 1) or logs.min() > LEAST:
        return None
    return delay, OFFSETS[offset]


class Fits(NamedTuple):
    """Values and their errors: delay_us, of the events; darker_us, how much longer it is in the
    darker half; square, of the exposure's length. rolling: how the frames are read. misfits: of
    SHARPER and the lengths."""

    delay_us: WithError
    darker_us: WithError
    square: WithError
    rolling: Rolling
    misfits: Array


def _fits(runs: Sequence[Busy], lengths: Array, delay: int, offset: float) -> Fits | None:
    """About this delay, by its index, and offset; None if too little was seen, or of one polarity
    alone. The errors are a jackknife's over tiles of the image."""
    middle, at = min(MIDDLE_US, lengths[-1]), DELAYS_US[delay - 2:delay + 3]
    means = [*((middle, delay_us) for delay_us in at), *((length, at[2]) for length in lengths)]
    table = _products(runs, means, at[2], offset)
    used = np.flatnonzero(np.trace(table[0].sum(1), axis1=1, axis2=2))
    if len(used) < FEWEST or not _of_both(table[2].sum((0, 1))[SOLVED, SOLVED]):
        return None
    of_tiles = np.divmod(np.arange(TILES[0] * TILES[1]), TILES[1])  # their rows and columns
    lines = np.stack([np.tile(of, len(runs)) for of in of_tiles])
    slow = [_slow_times(runs, axis) for axis in (0, 1)]

    def measured(products: Array, lines: Array) -> Array:
        of_delays = products[:len(at), ..., SOLVED, SOLVED]
        by_light = of_delays.sum(1)
        dark, bright = (_delay(at, by_light[:, k]) for k in (0, 1))
        return np.array([_delay(at, by_light.sum(1)), dark - bright,
                         _lowest(*_misfits(lengths, products[len(at):].sum((1, 2)))),
                         *map(_sloping, [at] * 2, [of_delays.sum(2)] * 2, lines, slow)])

    best = measured(table, lines)
    without = [measured(np.delete(table, b, 1), np.delete(lines, b, 1)) for b in used]
    error = np.sqrt((len(used) - 1) * np.var(without, 0))
    delay_us, darker_us, square, *sloping_us = zip(best.tolist(), error.tolist(), strict=True)
    axis = int(np.argmax([abs(value) / (by + 1.0) for value, by in sloping_us]))
    rolling = GLOBAL
    if is_rolling(*sloping_us[axis]):  # by more than the delays that were tried, perhaps
        wide = _products(runs, [(middle, delay_us) for delay_us in DELAYS_US], at[2], offset)
        by_us = _sloping(DELAYS_US, wide[..., SOLVED, SOLVED].sum(2), lines[axis], slow[axis])
        rolling = Rolling(1e-6 * abs(by_us), SIDES[axis][int(by_us < 0.0)])
    return Fits(delay_us, darker_us, square, rolling,
                _misfits(lengths, table[len(at):].sum((1, 2)))[1])


def _exposure(square: float, error: float, interval_us: float) -> Exposure:
    """Of frames whose length of exposure has this square (us^2)."""
    if square <= CLEARLY * np.hypot(error, BIAS):
        return UNSEEN
    length = square**0.5
    return Exposure(1e-6 * min(length, interval_us),
                    float(np.hypot(5e-7 * error / length, FLOOR_S)))


def _longer(runs: Sequence[Busy]) -> float:
    """By which share of their delay slow pixels are later in the darker half than in the other."""
    dn = np.concatenate([0.5 * (run.before + run.after) for run in runs])
    bright = np.concatenate([run.block % 2 == 1 for run in runs])
    if bright.all() or not bright.any():
        return 0.0
    times = [1.0 / (float(dn[half].mean()) + KNEE) for half in (~bright, bright)]
    return 2.0 * (times[0] - times[1]) / (times[0] + times[1])


def _slow_times(runs: Sequence[Busy], axis: int) -> Array:
    """(TILES[axis],) in which slow pixels would be late, relative to each other, row by row or
    column by column."""
    lines = np.divmod(np.concatenate([run.block // 2 for run in runs]), TILES[1])[axis]
    dn = np.concatenate([0.5 * (run.before + run.after) for run in runs])
    number = np.bincount(lines, minlength=TILES[axis])
    mean = np.bincount(lines, dn, TILES[axis]) / np.maximum(number, 1)
    times = 1.0 / (mean + KNEE)
    return times / times[number > 0].mean()


def _sloping(at: Array, of_delays: Array, lines: Array, slow: Array) -> float:
    """How much longer the delay is on the last of some lines than on the first, beside what slow
    pixels can explain: products (delays, blocks, 3, 3), lines (rows or columns) of the blocks."""
    sums = [of_delays[:, lines == k].sum(1) for k in range(len(slow))]
    weight = np.array([np.trace(total[0]) for total in sums])
    delays = np.array([_delay(at, total) if w else 0.0
                       for w, total in zip(weight, sums, strict=True)])
    along = np.arange(len(slow)) / len(slow)

    def fitted(values: Array, *columns: Array) -> Array:
        scale = np.sqrt(weight)
        both = np.stack([np.ones(len(slow)), *columns], 1) * scale[:, None]
        return np.linalg.lstsq(both, scale * values, rcond=None)[0]

    most = max(float(weight @ delays) / weight.sum(), 0.0)  # slow pixels explain no more than all
    share = np.clip(fitted(delays, along, slow)[2], 0.0, most)
    return float(fitted(delays - share * slow, along)[1])


def _of_frames(run: Busy, offset: float) -> Array:
    """(M,) changes of the log of the frames."""
    before, after = (log64(np.maximum(dn + offset, 0.0), "linlog")
                     for dn in (run.before, run.after))
    return after - before


def _unexplained(
    runs: Sequence[Busy], of_frames: Array, length_us: float, delay_us: float
) -> Array:
    """(OFFSETS,) log of the share that least squares leave of what frames show (OFFSETS, M)."""
    counts = np.concatenate([changes(run.own, length_us, delay_us) for run in runs], 1)
    on_off = counts @ counts.T
    size = NOTHING * (1.0 + np.trace(on_off))
    both = of_frames @ counts.T
    total = (of_frames**2).sum(1) + NOTHING
    explained = (both * np.linalg.solve(on_off + size * np.eye(2), both.T).T).sum(1)
    return np.log(np.maximum(total - explained, NOTHING * total) / total)


def _products(
    runs: Sequence[Busy], means: Sequence[tuple[float, float]], delay_us: float, offset: float
) -> Array:
    """(means, blocks, 2, 7, 7): products of what neighbours show at this delay, (4,), the changes
    of ON and minus OFF over each length at each delay of `means`, and those of the frames."""
    found = []
    for run in runs:
        shown = [changes(run.around, over, delay_us).mean(1) for over in SHOWN_US]
        fixed, of_frames = np.concatenate(shown), _of_frames(run, offset)[None]
        of_means = []
        for mean in means:
            columns = np.concatenate([fixed, changes(run.own, *mean), of_frames])
            of_means.append([[np.bincount(run.block, a * b, 2 * TILES[0] * TILES[1])
                                for a in columns] for b in columns])
        found.append(np.moveaxis(np.asarray(of_means), -1, 1))
    both = np.concatenate(found, 1)
    return both.reshape(len(means), -1, 2, *both.shape[2:])


def _of_both(products: Array) -> bool:
    """Whether both polarities foretell the frames: thresholds of products (3, 3) are positive."""
    size = NOTHING * (1.0 + np.trace(products))
    theta = np.linalg.solve(products[:2, :2] + size * np.eye(2), products[:2, 2])
    return bool(theta.min() > UNEQUAL * theta.max())


def _delay(delays: Array, total: Array) -> float:
    """The delay that leaves least: products (delays, 3, 3)."""
    on_off, both = total[:, :2, :2], total[:, :2, 2:]
    size = NOTHING * (1.0 + np.trace(on_off[0]))
    explained = (both * np.linalg.solve(on_off + size * np.eye(2), both)).sum((1, 2))
    return _lowest(delays, -explained)


def _misfits(lengths: Array, total: Array) -> tuple[Array, Array]:
    """Squares of lengths, and how much the residuals of each have to do with what neighbours show:
    also of SHARPER, to which all is continued as it is linear in the square."""
    squares = np.concatenate([SHARPER, lengths**2])
    k = min(2, len(lengths) - 1)  # a length that differs from none beyond rounding
    bend = (total[k] - total[0]) / (lengths[k]**2 - lengths[0]**2)
    total = np.concatenate([total[0] + SHARPER[:, None, None] * bend, total])
    size = NOTHING * (1.0 + np.trace(total[-1]))
    weight = np.linalg.inv(total[..., AROUND, AROUND] + size * np.eye(4))
    counts, frames = total[..., AROUND, OWN], total[..., AROUND, FRAMES]
    weighted = np.swapaxes(counts, -1, -2) @ weight
    theta = np.linalg.solve(weighted @ counts + NOTHING * np.eye(2), weighted @ frames)
    left = frames - counts @ theta
    misfit = (np.swapaxes(left, -1, -2) @ weight @ left)[:, 0, 0]
    return squares, misfit


def _lowest(at: Array, values: Array) -> float:
    """Where values are lowest, by a parabola through the three there, and no further than these."""
    k = int(np.clip(np.argmin(values), 1, len(at) - 2))
    away = (at[k - 1:k + 2] - at[k]) / (at[k + 1] - at[k])
    bent, slope, _ = np.polyfit(away, values[k - 1:k + 2], 2)
    if bent <= 0.0:
        return float(at[np.argmin(values)])
    return float(at[k] + np.clip(-slope / (2 * bent), away[0], away[2]) * (at[k + 1] - at[k]))
