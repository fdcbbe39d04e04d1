"""Noise rates where the path of brightness is still, and so gives no cause for events."""

from __future__ import annotations

import cv2
import numpy as np

from evflow.estimation.refine.sightings import Sightings

Array = np.ndarray

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


def _widest(climb: Array) -> Array:
    kernel = np.ones((3, 3), np.uint8)
    return np.stack([cv2.dilate(np.ascontiguousarray(c, np.float32), kernel) for c in climb])


def _tiled(values: Array, shape: tuple[int, int]) -> Array:
    """Sums (TILES) of values (H * W,)."""
    y, x = (np.arange(n) * tiles // n for n, tiles in zip(shape, TILES, strict=True))
    tile = y[:, None] * TILES[1] + x
    return np.bincount(tile.ravel(), values, TILES[0] * TILES[1])
