"""Noise where the path of brightness is still, and so gives no cause for events."""

from __future__ import annotations

import cv2
import numpy as np

from evflow.estimation.refine.sightings import Sightings, counts_so_far
from evflow.recordings.faulty_pixels import hot_in_stretch

Array = np.ndarray

QUIET = 0.05  # log units: below the thresholds of usable cameras
MANY, LEAST_THETA = 20, 0.03  # events; log units, less than any usable threshold
LEAST_MOVED = 0.02  # log units of the path's change per event: less is a light that blinks unseen
LEAST_RISE = 0.03  # log units in two frame intervals: smaller changes cause no event
TILES = (6, 8)  # of the image; their median is robust where the path misses motion
ENOUGH_S = 2.0  # pixel seconds of a tile


def noise_rates(s: Sightings, dt_s: Array) -> Array:
    """(2,) float32: rates of ON and OFF events in Hz per pixel where the path is still; 0 where it
    is nowhere still for long enough. dt_s: (K,) of the intervals."""
    intervals, pixels = s.inner.shape
    change = np.diff(s.frames, axis=0)
    shown = s.seen[1:] & s.seen[:-1]
    rates = []
    for on, back in ((True, np.minimum(change, 0.0)), (False, -np.maximum(change, 0.0))):
        climb = _widest((s.inner + back).reshape(intervals, *s.shape)).reshape(intervals, pixels)
        still = (climb[1:] < LEAST_RISE) & (climb[:-1] < LEAST_RISE) & shown[1:] & shown[:-1]
        place = (s.interval * pixels + s.pixel)[s.on == on]
        sent = np.bincount(place, minlength=intervals * pixels).reshape(intervals, pixels)[1:]
        seconds = _tiled((still * dt_s[1:, None]).sum(0), s.shape)
        events = _tiled((still * sent).sum(0), s.shape)
        used = seconds >= ENOUGH_S
        rates.append(float(np.median(events[used] / seconds[used])) if used.any() else 0.0)
    return np.array(rates, np.float32)


def quiet_maps(span: Array, counts: Array, dt_s: Array, shown: Array) -> Array:
    """(4, H, W) over intervals in which a pixel's path stays within QUIET and its frames show it:
    events, seconds, number of intervals, number of intervals with events.

    Args:
        span: (K, H, W) range of the path within each interval, log units.
        counts: (K, H, W) events.
        dt_s: (K,) of the intervals.
        shown: (K, H, W) bool, frames before and after are neither saturated nor black.
    """
    still = (span < QUIET) & shown
    events = counts * still
    return np.stack([events.sum(0), (dt_s[:, None, None] * still).sum(0), still.sum(0),
                     (events > 0).sum(0)])


def unlike_the_path(net: Array, path: Array, events: Array) -> Array:
    """Where no threshold explains so many events: squared deviations of their net count, and of the
    path at them (log units)."""
    return (events >= MANY) & (net * LEAST_THETA**2 > path)


def hot_ones(s: Sightings, dt_s: Array) -> Array:
    """(H, W) bool: the pixels of a stretch that fire without a signal, seen where their path is
    still, or as their events are `unlike_the_path`. dt_s: (K,) of the intervals."""
    intervals, pixels = s.inner.shape
    counts = np.bincount(s.interval * pixels + s.pixel, minlength=s.inner.size)
    span, events, shown = (a.reshape(intervals, *s.shape)
                           for a in (s.inner, counts, s.seen[1:] & s.seen[:-1]))
    hot = hot_in_stretch(
        quiet_maps(span, events, dt_s, shown), events.sum(0), float(dt_s.sum()))
    group, on, off = counts_so_far(s)
    number = np.bincount(group)
    moved = np.bincount(group[1:], np.abs(np.diff(s.path)) * (np.diff(group) == 0), len(number))
    net, path = (np.bincount(group, v * v) - np.bincount(group, v) ** 2 / number
                 for v in (on + off, s.path.astype(np.float64)))
    hot.ravel()[s.pixel[s.first]] |= unlike_the_path(net, path, number) | (
        (number >= MANY) & (moved < LEAST_MOVED * number))
    return hot


def _widest(climb: Array) -> Array:
    kernel = np.ones((3, 3), np.uint8)
    return np.stack([cv2.dilate(np.ascontiguousarray(c, np.float32), kernel) for c in climb])


def _tiled(values: Array, shape: tuple[int, int]) -> Array:
    """Sums (TILES) of values (H * W,)."""
    y, x = (np.arange(n) * tiles // n for n, tiles in zip(shape, TILES, strict=True))
    tile = y[:, None] * TILES[1] + x
    return np.bincount(tile.ravel(), values, TILES[0] * TILES[1])
