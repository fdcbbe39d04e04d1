"""When the frames saw the light that they show, and for how long, from the events between them.

A frame is the mean of the light over its exposure; events show what happens meanwhile. So the
change of a pixel from frame to frame is that of its counts' mean over the exposures, times the
thresholds. (The double integral of Pan et al., CVPR 2019, solved for the exposure.) No optical flow
is needed. The delay of the events behind the frames is the one at which least squares explain most.
Two things would bias the length that does. Means over longer spans have less of the counts'
rounding: so the residuals are compared with what the *neighbours'* events show, whose rounding is
their own (instrumental variables, by two-stage least squares). And a signal that is drawn straight
from event to event is cut where it turns: there it is an arc.

Slow pixels delay events too, but they also blur them: to second order, a low-pass of time constant
tau has a delay of tau and takes 12 tau^2 off the square of the length. And most are slower in the
dark. So wrong frame times show, where neither is so.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from evflow.estimation.refine.between_events import changes
from evflow.estimation.refine.busy import Busy, busy
from evflow.estimation.refine.frame_exposure import (
    ON_TIME,
    UNSEEN,
    Exposure,
    Late,
    is_untold,
)
from evflow.estimation.refine.path import Place
from evflow.estimation.refine.receptor_data import TILES
from evflow.light.log_maps import log64
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
CLEARLY, BIAS = 3.0, 70e6  # std of the square of the length that are none; its error in a scene
EXPLAINS = 4.0  # times the least misfit, which that of no exposure exceeds if one is seen
LEAST = np.log(0.7)  # log of the unexplained share, at most: else it is another scene or clock
UNEQUAL = 0.05  # of a threshold, below which the other polarity foretells nothing
NOTHING = 1e-9  # of the sums, so that one polarity alone, or no change, can be solved
FEWEST, FEWEST_LENGTHS = 4, 3  # tiles, over which a length's scatter says something; lengths
FLOOR_S = 2.5e-3  # std beside the scatter, of simulated cameras exposed for 10 and 20 ms
LATE_STD_US = 700.0  # std beside the scatter, of a delay
SLOWEST_US = 4000.0  # delay up to which slow pixels before frames of untold exposure are likelier
DARK_STD_US = 300.0  # std beside the scatter, of how much longer the delay is in the dark
KNEE = 20.0  # DN, of a photoreceptor whose rate is proportional to light and this
PARTLY = 0.2  # of what pixels as slow take off, from which a part of the delay is theirs
SLOW = 12.0  # square of the length over that of the delay, of a low-pass of first order


class Timing(NamedTuple):
    """exposure: of the frames, where it is untold; late: of the events behind the frames, beyond
    what slow pixels explain; delay_s: the same, whatever explains it; 0 if it is unknown."""

    exposure: Exposure = UNSEEN
    late: Late = ON_TIME
    delay_s: float = 0.0


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
    middle = min(MIDDLE_US, lengths[-1])
    of_frames = np.stack([np.concatenate([_of_frames(run, o) for run in runs]) for o in OFFSETS])
    logs = np.stack([_unexplained(runs, of_frames, middle, delay) for delay in DELAYS_US])
    delay, offset = (int(k) for k in np.unravel_index(np.argmin(logs), logs.shape))
    if delay in (0, 1, len(DELAYS_US) - 2, len(DELAYS_US) - 1) or logs.min() > LEAST:
        return UNTIMED
    at = DELAYS_US[delay - 2:delay + 3]
    means = [*((middle, delay_us) for delay_us in at), *((length, at[2]) for length in lengths)]
    table = _products(runs, means, at[2], OFFSETS[offset])
    used = np.flatnonzero(np.trace(table[0].sum(1), axis1=1, axis2=2))
    if len(used) < FEWEST or not _of_both(table[2].sum((0, 1))[4:, 4:]):
        return UNTIMED

    def measured(products: Array) -> Array:
        of_delays = products[:len(at), ..., 4:, 4:].sum(1)
        dark, bright = (_delay(at, of_delays[:, k]) for k in (0, 1))
        return np.array([_delay(at, of_delays.sum(1)), dark - bright,
                         _lowest(*_misfits(lengths, products[len(at):].sum((1, 2))))])

    best = measured(table)
    without = [measured(np.delete(table, b, 1)) for b in used]
    error = np.sqrt((len(used) - 1) * np.var(without, 0))
    late_us, by_light, square = zip(best.tolist(), error.tolist(), strict=True)
    misfits = _misfits(lengths, table[len(at):].sum((1, 2)))[1]
    explained = misfits[len(SHARPER)] > EXPLAINS * misfits.min()
    seen = square[0] < lengths[-1]**2 and untold and explained
    longer = (_longer_in_the_dark(runs) * late_us[0] - by_light[0], by_light[1])
    late = _late(late_us, longer, (square[0] - told_us**2, square[1]), untold=untold)
    return Timing(_exposure(*square, interval) if seen else UNSEEN, late, 1e-6 * late_us[0])


def _exposure(square: float, error: float, interval_us: float) -> Exposure:
    """Of frames whose length of exposure has this square (us^2)."""
    if square <= CLEARLY * np.hypot(error, BIAS):
        return UNSEEN
    length = square**0.5
    return Exposure(1e-6 * min(length, interval_us),
                    float(np.hypot(5e-7 * error / length, FLOOR_S)))


def _longer_in_the_dark(runs: Sequence[Busy]) -> float:
    """By which share of their delay slow pixels are later in the darker half than in the other."""
    dn = np.concatenate([0.5 * (run.before + run.after) for run in runs])
    bright = np.concatenate([run.block % 2 == 1 for run in runs])
    if bright.all() or not bright.any():
        return 0.0
    times = [1.0 / (float(dn[half].mean()) + KNEE) for half in (~bright, bright)]
    return 2.0 * (times[0] - times[1]) / (times[0] + times[1])


def _late(
    delay_us: tuple[float, float], missing_us: tuple[float, float], square: tuple[float, float], *,
    untold: bool,
) -> Late:
    """Events that are late by this, of values and their errors; not if they are blurred, or later
    in the dark, as those of slow pixels. missing_us: how much later these would be in the dark."""
    late_us, std_us = delay_us[0], float(np.hypot(delay_us[1], LATE_STD_US))
    error = float(np.hypot(square[1], BIAS))
    taken = SLOW * late_us**2  # off the square, by pixels that are as slow
    more = square[0] + taken
    if abs(late_us) <= CLEARLY * std_us:
        return ON_TIME
    if late_us < 0.0:
        return Late(1e-6 * late_us, 1e-6 * std_us)
    if untold and late_us < SLOWEST_US:
        return ON_TIME
    if more <= CLEARLY * error or square[0] <= -PARTLY * taken:
        return ON_TIME
    if missing_us[0] <= CLEARLY * float(np.hypot(missing_us[1], DARK_STD_US)):
        return ON_TIME
    return Late(1e-6 * late_us, 1e-6 * std_us, 1e-6 * more**0.5 * untold)


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
    weight = np.linalg.inv(total[..., :4, :4] + size * np.eye(4))
    counts, frames = total[..., :4, 4:6], total[..., :4, 6:]
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
