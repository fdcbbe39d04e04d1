"""The exposure of the frames, where no file tells it, from what it blurs.

A frame is the mean of the light over its exposure; events show what happens meanwhile. So the
change of a pixel from frame to frame is that of its counts' mean over the exposures, times the
thresholds. The length of exposure that explains the frames best is theirs. (The double integral of
Pan et al., CVPR 2019, solved for the exposure.) No optical flow is needed.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from evflow.estimation.refine.path import Place
from evflow.estimation.refine.receptor_data import TILES
from evflow.estimation.refine.stretches import Stretch
from evflow.io.images.exposures import BLURRED
from evflow.light.log_maps import log64
from evflow.recordings import glitches
from evflow.types import Recording, release

Array = np.ndarray

LENGTHS_US = 1e3 * np.array([0.5, 4.0, 8.0, 12.0, 16.0, 20.0, 25.0, 30.0, 35.0, 40.0, 50.0])
DELAYS_US = 1e3 * np.arange(-6.0, 11.0, 2.0)  # of events after frames: slow pixels, and clocks
OFFSETS = (-16.0, -8.0, 0.0, 8.0, 16.0, 26.0, 40.0)  # DN
BEYOND = 1.3  # times the interval between frames, so that an exposure as long as that is inside
SPAN_US = 40_000.0  # longest time between two events over which a signal is interpolated
BUSY = 4.0  # events between two frames: of fewer the interpolated signal looks smooth itself
MOST, ENOUGH = 5_000, 500  # changes used of a run; in all
LEAST_S = 1e-2  # shorter ones are found where there is none: the interpolation is never exact
CLEARLY, LEAST_GAIN = 3.0, 0.01  # of log unexplained share: its standard deviations, and at least
TELLING = (BLURRED, "frames.dense")  # notes of recordings in which it is not to be measured
NOTHING = 1e-9  # of the sums, so that one polarity alone, or no change, can be solved
FEWEST = 4  # tiles, over which a gain's scatter says something
FLOOR_S = 2.5e-3  # std beside the scatter, of simulated cameras exposed for 10 and 20 ms


@dataclasses.dataclass(frozen=True)
class Exposure:
    """seconds, std_s: of the frames, 0 and NaN if it cannot be told from none."""

    seconds: float = 0.0
    std_s: float = float("nan")


UNSEEN = Exposure()


class Busy(NamedTuple):
    """Where much happens between two frames of a run. times_us: (K + 1,) of the frames; pixels:
    number of those with such changes. Their events (N,) by pixel and time: pixel; on; and since_us,
    at_us, between which the pixel's signal is interpolated. Changes (M,): where, index of interval
    and pixel; before, after, DN; block, of the image."""

    times_us: Array
    pixels: int
    pixel: Array
    on: Array
    since_us: Array
    at_us: Array
    where: Array
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
    if sum(len(run.where) for run in runs) < ENOUGH:
        return UNSEEN
    interval = float(np.median(np.concatenate([np.diff(run.times_us) for run in runs])))
    lengths = LENGTHS_US[BEYOND * interval >= LENGTHS_US]
    if lengths.max(initial=0.0) <= 1e6 * LEAST_S:
        return UNSEEN
    best, delay = min(10e3, lengths[-1]), np.nan
    for _ in range(2):
        before = delay
        delay = min(DELAYS_US, key=lambda d: _logs(_products(runs, best, d)).min())
        if delay == before:
            break
        table = np.stack([_products(runs, length, delay) for length in lengths])
        offset = int(np.argmin(_logs(table).min(0)))
        best, _ = _least(lengths, _logs(table[:, offset]))
    of_blocks = table[:, offset]
    used = np.flatnonzero(np.trace(of_blocks[0], axis1=1, axis2=2))
    if len(used) < FEWEST or delay in DELAYS_US[[0, -1]]:
        return UNSEEN
    found = np.array([_least(lengths, _logs(np.delete(of_blocks, b, 1))) for b in used])
    _, gain = _least(lengths, _logs(of_blocks))
    scatter, error = np.sqrt((len(used) - 1) * found.var(0))
    seen = (best >= 1e6 * LEAST_S and best < lengths[-1] and gain > LEAST_GAIN
            and gain > CLEARLY * error)
    seconds, std_s = 1e-6 * min(best, interval), float(np.hypot(1e-6 * scatter, FLOOR_S))
    return Exposure(seconds, std_s) if seen else UNSEEN


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
    pixels = height * width
    events = recording.events.slice(int(times[0] - SPAN_US), int(times[-1] + SPAN_US))
    pixel, at = events.y.astype(np.int64) * width + events.x, events.t.astype(np.float64)
    number = _smooth_numbers(times, at, pixel, pixels)
    shown = np.stack([glitches.exposed(frame) for frame in frames]).reshape(len(frames), -1)
    where = np.flatnonzero((shown[1:] & shown[:-1]).ravel() & (number > BUSY))
    if len(where) > MOST:
        where = np.sort(rng.choice(where, MOST, replace=False))
    place = where % pixels
    used, row = np.unique(place, return_inverse=True)
    row_of = np.full(pixels, -1)
    row_of[used] = np.arange(len(used))
    kept = np.flatnonzero(row_of[pixel] >= 0)
    kept = kept[np.argsort(row_of[pixel[kept]], kind="stable")]
    pixel, on, at = row_of[pixel[kept]], events.p[kept], at[kept]
    since = np.where(np.diff(pixel, prepend=-1) == 0, np.roll(at, 1), at)
    since = np.clip(since, at - SPAN_US, at - 1.0)
    where = where // pixels * len(used) + row
    near = _near(times, len(used), where, pixel, since, at)
    light = frames.reshape(len(frames), -1)
    y, x = place // width * TILES[0] // height, place % width * TILES[1] // width
    return Busy(times, len(used), pixel[near], on[near], since[near], at[near], where,
                light[:-1][where // len(used), place], light[1:][where // len(used), place],
                y * TILES[1] + x)


def _near(
    times: Array, pixels: int, where: Array, pixel: Array, since: Array, at: Array
) -> Array:
    """Which events (N,) can have a part in the changes `where`, at any length and delay."""
    chosen = np.zeros((len(times) - 1) * pixels, np.int64)
    chosen[where] = 1
    before = np.zeros((len(times), pixels), np.int64)
    before[1:] = chosen.reshape(len(times) - 1, pixels).cumsum(0)
    half = 0.5 * LENGTHS_US[-1]
    first = np.searchsorted(times, since - half - DELAYS_US[-1]) - 1
    last = np.searchsorted(times, at + half - DELAYS_US[0])
    first, last = (np.clip(k, 0, len(times) - 1) for k in (first, last))
    return np.flatnonzero(before[last, pixel] > before[first, pixel])


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


def _changes(run: Busy, length_us: float, delay_us: float) -> Array:
    """(2, K * pixels) changes of the ON and OFF counts' means over so long about the frames."""
    times, half = run.times_us + delay_us, 0.5 * length_us
    total = np.zeros((2, (len(times) - 1) * run.pixels))

    def passed(to: Array, since: Array, at: Array) -> Array:
        """Integral up to a time of what rises from 0 at `since` to 1 at `at`."""
        inside = np.clip(to - since, 0.0, at - since)
        return inside * inside / (2.0 * (at - since)) + np.maximum(to - at, 0.0)

    first = np.searchsorted(times, run.since_us - half) - 1
    last = np.searchsorted(times, run.at_us + half)
    for more in range(int((last - first).max(initial=0))):
        interval = first + more
        k = np.flatnonzero((interval >= 0) & (interval < len(times) - 1) & (interval < last))
        i, event = interval[k], (run.since_us[k], run.at_us[k])
        before, after = (passed(times[j] + half, *event) - passed(times[j] - half, *event)
                         for j in (i, i + 1))
        share = (after - before) / length_us
        for row, which in zip(total, (run.on[k], ~run.on[k]), strict=True):
            row += np.bincount((i * run.pixels + run.pixel[k])[which], share[which], len(row))
    return total


def _products(runs: Sequence[Busy], length_us: float, delay_us: float) -> Array:
    """(OFFSETS, blocks, 3, 3): products of the changes of ON, of minus OFF, and of the frames."""
    found = []
    for run in runs:
        on, off = _changes(run, length_us, delay_us)[:, run.where]
        of_offsets = []
        for offset in OFFSETS:
            before, after = (log64(np.maximum(dn + offset, 0.0), "linlog")
                             for dn in (run.before, run.after))
            columns = on, -off, after - before
            of_offsets.append(np.stack([[np.bincount(run.block, a * b, TILES[0] * TILES[1])
                                         for a in columns] for b in columns]))
        found.append(np.moveaxis(np.stack(of_offsets), -1, 1))
    return np.concatenate(found, 1)


def _logs(products: Array) -> Array:
    """Log of the unexplained share, of products (..., blocks, 3, 3)."""
    total = products.sum(-3)
    size = NOTHING * (1.0 + np.trace(total, axis1=-2, axis2=-1))
    total = total + size[..., None, None] * np.eye(3)
    theta = np.linalg.solve(total[..., :2, :2], total[..., :2, 2:])[..., 0]
    left = total[..., 2, 2] - (theta * total[..., :2, 2]).sum(-1)
    return np.log(np.maximum(left / total[..., 2, 2], NOTHING))


def _least(lengths: Array, logs: Array) -> tuple[float, float]:
    """Where the curve is lowest, by a parabola, and how much lower than at no exposure."""
    k = int(np.argmin(logs))
    gain = float(logs[0] - logs[k])
    if 0 < k < len(lengths) - 1:
        away = lengths[k - 1:k + 2] - lengths[k]
        bent, slope, _ = np.polyfit(away, logs[k - 1:k + 2], 2)
        return float(lengths[k] + np.clip(-slope / (2 * bent), away[0], away[2])), gain
    return float(lengths[k]), gain
