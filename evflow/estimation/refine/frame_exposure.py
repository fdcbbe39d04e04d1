"""The exposure of the frames, where no file tells it, from what it blurs.

A frame is the mean of the light over its exposure; events show what happens meanwhile. So the
change of a pixel from frame to frame is that of its counts' mean over the exposures, times the
thresholds. (The double integral of Pan et al., CVPR 2019, solved for the exposure.) No optical flow
is needed. Two things would bias the length that explains the frames best. Means over longer spans
have less of the counts' rounding: so the residuals are compared with what the *neighbours'* events
show, whose rounding is their own (instrumental variables, by two-stage least squares). And a signal
that is drawn straight from event to event is cut where it turns: there it is an arc.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from evflow.estimation.refine.between_events import SPAN_US, Signals, changes, signals_of
from evflow.estimation.refine.path import Place
from evflow.estimation.refine.receptor_data import TILES
from evflow.estimation.refine.stretches import Stretch
from evflow.io.images.exposures import BLURRED
from evflow.light.log_maps import log64
from evflow.recordings import glitches
from evflow.types import Recording, release

Array = np.ndarray

LENGTHS_US = 1e3 * np.array([0.5, 6.0, 12.0, 16.0, 20.0, 25.0, 30.0, 35.0, 40.0, 50.0])
SHARPER = 1e6 * np.array([-900.0, -400.0, -150.0])  # squares of lengths: events blurred, not frames
MIDDLE_US = 10e3  # length at which the delay and the offset are sought
SHOWN_US = 8e3, 24e3  # over which neighbours' counts are averaged: their difference is curvature
DELAYS_US = 1e3 * np.arange(-6.0, 11.0, 2.0)  # of events after frames: slow pixels, and clocks
REACH_US = 0.5 * LENGTHS_US[-1] - DELAYS_US[0], 0.5 * LENGTHS_US[-1] + DELAYS_US[-1]
OFFSETS = (-16.0, -8.0, 0.0, 8.0, 16.0, 26.0, 40.0)  # DN
BEYOND = 1.3  # times the interval between frames, so that an exposure as long as that is inside
BUSY = 4.0  # events between two frames: of fewer the interpolated signal looks smooth itself
MOST, ENOUGH = 5_000, 150  # changes used of a run; in all
CLEARLY, BIAS = 3.0, 60e6  # std of the square of the length that are none; its error in a scene
TELLING = (BLURRED, "frames.dense")  # notes of recordings in which it is not to be measured
NOTHING = 1e-9  # of the sums, so that one polarity alone, or no change, can be solved
FEWEST = 4  # tiles, over which a length's scatter says something
FLOOR_S = 2.5e-3  # std beside the scatter, of simulated cameras exposed for 10 and 20 ms


@dataclasses.dataclass(frozen=True)
class Exposure:
    """seconds, std_s: of the frames, 0 and NaN if it cannot be told from none."""

    seconds: float = 0.0
    std_s: float = float("nan")


UNSEEN = Exposure()


class Busy(NamedTuple):
    """Where much happens between two frames of a run. own: of those pixels; around: of their four
    neighbours. Changes (M,): before, after, DN; block, of the image."""

    own: Signals
    around: Signals
    before: Array
    after: Array
    block: Array


def frame_exposure(places: Sequence[Place]) -> Exposure:
    """The exposure of the frames in some runs of frame intervals, where it is untold."""
    if not all(is_untold(recording) for recording, _ in places):
        return UNSEEN
    rng = np.random.default_rng(0)
    runs = [_busy(recording, run, rng) for recording, run in places]
    for recording, _ in places:
        release(recording)
    if sum(len(run.block) for run in runs) < ENOUGH:
        return UNSEEN
    interval = float(np.median(np.concatenate([np.diff(run.own.times_us) for run in runs])))
    lengths = LENGTHS_US[BEYOND * interval >= LENGTHS_US]
    if lengths.max(initial=0.0)**2 <= CLEARLY * BIAS:
        return UNSEEN
    middle = min(MIDDLE_US, lengths[-1])
    logs = np.stack([_unexplained(runs, middle, delay) for delay in DELAYS_US])
    delay, offset = (int(k) for k in np.unravel_index(np.argmin(logs), logs.shape))
    if delay in (0, len(DELAYS_US) - 1):
        return UNSEEN
    of_blocks = _products(runs, lengths, DELAYS_US[delay], OFFSETS[offset])
    used = np.flatnonzero(np.trace(of_blocks[0], axis1=1, axis2=2))
    if len(used) < FEWEST:
        return UNSEEN
    square = _least(lengths, of_blocks)
    found = np.array([_least(lengths, np.delete(of_blocks, b, 1)) for b in used])
    error = np.sqrt((len(used) - 1) * found.var())
    best = max(square, 0.0) ** 0.5
    if square <= CLEARLY * np.hypot(error, BIAS) or best >= lengths[-1]:
        return UNSEEN
    return Exposure(1e-6 * min(best, interval), float(np.hypot(5e-7 * error / best, FLOOR_S)))


def with_exposures(
    stretches: Sequence[Stretch], exposure: Exposure, before: Exposure = UNSEEN
) -> tuple[Stretch, ...]:
    """The stretches, with `with_exposure` of their recordings, one of each. before: what they have
    of an earlier measurement, which this replaces."""
    recordings = {id(s.recording): s.recording for s in stretches}
    changed = {key: with_exposure(recording, exposure.seconds, before.seconds)
               for key, recording in recordings.items()}
    return tuple(dataclasses.replace(s, recording=changed[id(s.recording)]) for s in stretches)


def with_exposure(recording: Recording, seconds: float, before_s: float = 0.0) -> Recording:
    """The recording with a measured exposure of its frames, if there is one and no other is told.
    before_s: an earlier measured one."""
    earlier = before_s and recording.exposure_us == round(1e6 * before_s)
    if not seconds or not (earlier or is_untold(recording)):
        return recording
    return dataclasses.replace(recording, exposure_us=round(1e6 * seconds))


def is_untold(recording: Recording) -> bool:
    """Whether neither a file nor the user says how long the frames were exposed, and it can be
    long: of frames that come faster than an estimate uses it cannot."""
    told = any(note.code in TELLING for note in recording.notes)
    return not (recording.exposure_us or told or recording.frames_were_made)


def _busy(recording: Recording, run: Sequence[int], rng: np.random.Generator) -> Busy:
    """Of a run of frame intervals, at most MOST changes."""
    frames = np.stack([recording.frame_dn(i) for i in [*run, run[-1] + 1]])
    times = recording.frame_times[run[0]:run[-1] + 2].astype(np.float64)
    height, width = frames.shape[1:]
    events = recording.events.slice(int(times[0] - SPAN_US), int(times[-1] + SPAN_US))
    pixel, at = events.y.astype(np.int64) * width + events.x, events.t.astype(np.float64)
    number = _smooth_numbers(times, at, pixel, height * width)
    shown = np.stack([glitches.exposed(frame) for frame in frames])
    shown[:, [0, -1]] = shown[:, :, [0, -1]] = False  # they lack a neighbour
    shown = shown.reshape(len(frames), -1)
    where = np.flatnonzero((shown[1:] & shown[:-1]).ravel() & (number > BUSY))
    if len(where) > MOST:
        where = np.sort(rng.choice(where, MOST, replace=False))
    interval, place = np.divmod(where, height * width)
    around = place + np.array([-width, -1, 1, width])[:, None]
    order = np.argsort(pixel, kind="stable")
    sent = pixel[order], events.p[order], at[order]
    light = frames.reshape(len(frames), -1)
    y, x = place // width * TILES[0] // height, place % width * TILES[1] // width
    return Busy(signals_of(times, interval, place, sent, REACH_US),
                signals_of(times, interval, around, sent, REACH_US),
                light[:-1][interval, place], light[1:][interval, place], y * TILES[1] + x)


def _smooth_numbers(times: Array, at: Array, pixel: Array, pixels: int) -> Array:
    """(K * pixels) events between two frames, those near a frame shared with the interval beyond:
    a choice by whole intervals would prefer events that are early or late in it."""
    middles = 0.5 * (times[1:] + times[:-1])
    place = np.interp(at, middles, np.arange(len(middles)), left=-1.0, right=-1.0)
    inside = np.flatnonzero(place >= 0)
    first = place[inside].astype(np.int64)
    later = place[inside] - first
    slot, size = first * pixels + pixel[inside], len(middles) * pixels
    number = np.bincount(slot, 1.0 - later, size)
    number[pixels:] += np.bincount(slot, later, size)[:-pixels]
    return number


def _of_frames(run: Busy, offset: float) -> Array:
    """(M,) changes of the log of the frames."""
    before, after = (log64(np.maximum(dn + offset, 0.0), "linlog")
                     for dn in (run.before, run.after))
    return after - before


def _unexplained(runs: Sequence[Busy], length_us: float, delay_us: float) -> Array:
    """(OFFSETS,) log of the share that least squares leave."""
    counts = np.concatenate([changes(run.own, length_us, delay_us) for run in runs], 1)
    of_frames = np.stack([np.concatenate([_of_frames(run, o) for run in runs]) for o in OFFSETS])
    on_off = counts @ counts.T
    size = NOTHING * (1.0 + np.trace(on_off))
    both = of_frames @ counts.T
    total = (of_frames**2).sum(1) + NOTHING
    explained = (both * np.linalg.solve(on_off + size * np.eye(2), both.T).T).sum(1)
    return np.log(np.maximum(total - explained, NOTHING * total) / total)


def _products(
    runs: Sequence[Busy], lengths: Array, delay_us: float, offset: float
) -> Array:
    """(lengths, blocks, 7, 7): products of what neighbours show, (4,), the changes of ON and minus
    OFF, and those of the frames."""
    found = []
    for run in runs:
        shown = [changes(run.around, over, delay_us).mean(1) for over in SHOWN_US]
        fixed, of_frames = np.concatenate(shown), _of_frames(run, offset)[None]
        of_lengths = []
        for length in lengths:
            columns = np.concatenate([fixed, changes(run.own, length, delay_us), of_frames])
            of_lengths.append([[np.bincount(run.block, a * b, TILES[0] * TILES[1])
                                for a in columns] for b in columns])
        found.append(np.moveaxis(np.asarray(of_lengths), -1, 1))
    return np.concatenate(found, 1)


def _least(lengths: Array, of_blocks: Array) -> float:
    """The square of the length whose residuals have least to do with what neighbours show, by a
    parabola; below none, where it is linear in the square, too."""
    total = of_blocks.sum(1)
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
    k = int(np.clip(np.argmin(misfit), 1, len(squares) - 2))
    away = squares[k - 1:k + 2] - squares[k]
    bent, slope, _ = np.polyfit(1e-6 * away, misfit[k - 1:k + 2], 2)
    if bent <= 0.0:
        return float(squares[np.argmin(misfit)])
    return float(squares[k] + np.clip(-1e6 * slope / (2 * bent), away[0], away[2]))
