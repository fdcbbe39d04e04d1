"""Where pixels fire much between two frames: their events, those of their neighbours, and what the
frames show."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from evflow.estimation.refine.between_events import SPAN_US, Signals, signals_of
from evflow.estimation.refine.receptor_data import TILES
from evflow.recordings import glitches
from evflow.types import Recording

Array = np.ndarray

BUSY = 2.0  # events between two frames: of fewer the interpolated signal looks smooth itself
MOST = 5_000  # changes used of a run
DIM = 20.0  # DN, pixels' mean up to which cameras' logarithms differ, and whole DN are steps


class Busy(NamedTuple):
    """Where much happens between two frames of a run of frame intervals. own: of those pixels;
    around: of their four neighbours. Changes (M,): before, after, DN; block, of the image, twice:
    dark and bright."""

    own: Signals
    around: Signals
    before: Array
    after: Array
    block: Array


def busy(
    recording: Recording, run: Sequence[int], reach_us: tuple[float, float],
    rng: np.random.Generator,
) -> Busy:
    """Of a run of frame intervals, at most MOST changes. reach_us: as of `signals_of`."""
    frames = np.stack([recording.frame_dn(i) for i in [*run, run[-1] + 1]])
    times = recording.frame_times[run[0]:run[-1] + 2].astype(np.float64)
    height, width = frames.shape[1:]
    events = recording.events.slice(int(times[0] - SPAN_US), int(times[-1] + SPAN_US))
    pixel, at = events.y.astype(np.int64) * width + events.x, events.t.astype(np.float64)
    number = _smooth_numbers(times, at, pixel, height * width)
    shown = np.stack([glitches.exposed(frame) for frame in frames])
    shown &= frames.mean(0) > DIM
    shown[:, [0, -1]] = shown[:, :, [0, -1]] = False  # they lack a neighbour
    shown = shown.reshape(len(frames), -1)
    where = np.flatnonzero((shown[1:] & shown[:-1]).ravel() & (number > BUSY))
    if len(where) > MOST:
        where = np.sort(rng.choice(where, MOST, replace=False))
    interval, place = np.divmod(where, height * width)
    around = place + np.array([-width, -1, 1, width])[:, None]
    asked = np.zeros(height * width, bool)
    asked[place] = asked[around] = True
    kept = np.flatnonzero(asked[pixel])
    kept = kept[np.argsort(pixel[kept], kind="stable")]
    sent = pixel[kept], events.p[kept], at[kept]
    light = frames.reshape(len(frames), -1)
    y, x = place // width * TILES[0] // height, place % width * TILES[1] // width
    before, after = light[:-1][interval, place], light[1:][interval, place]
    middle = np.median(before + after) if len(before) else 0.0
    return Busy(signals_of(times, interval, place, sent, reach_us),
                signals_of(times, interval, around, sent, reach_us),
                before, after, 2 * (y * TILES[1] + x) + (before + after > middle))


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
