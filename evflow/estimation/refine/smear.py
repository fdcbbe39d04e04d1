"""How much slower the frames' path moves than what the events saw: the mark of an exposure, and of
frames too far apart.

The path between blurred or distant frames is the mean of the light over some time. What a pixel
remembered moves from event to event; the mean of that over the same time is explained better by
the path than the memory itself, and the thresholds that explain it are the higher.
"""

from __future__ import annotations

import numpy as np

Array = np.ndarray


def smeared(pixel: Array, at: Array, counts: Array, length: float) -> Array:
    """Mean of a pixel's counts over `length` around each of its events, with straight lines between
    events, and constant before the first and after the last.

    pixel: (N,) int; at: (N,) instants, in the unit of length; counts: (N,) at the instants.
    Events of any order; the result is in theirs.
    """
    order = np.lexsort((at, pixel))
    pixel, t, v = pixel[order], at[order].astype(np.float64), counts[order].astype(np.float64)
    first, last = np.searchsorted(pixel, pixel), np.searchsorted(pixel, pixel, side="right") - 1
    same = np.diff(pixel) == 0
    area = np.concatenate([[0.0], np.cumsum(np.where(
        same, 0.5 * (v[1:] + v[:-1]) * np.diff(t), 0.0))])
    # One ascending axis for all pixels: time, and each pixel's own span of it.
    span = (t.max() - t.min() if len(t) else 0.0) + 2.0 * length + 1.0
    axis = pixel * span + t

    def integral(to: Array) -> Array:
        at_or_before = np.searchsorted(axis, pixel * span + to, side="right") - 1
        k = np.clip(at_or_before, first, last)
        following = np.minimum(k + 1, last)
        gone, gap = to - t[k], t[following] - t[k]
        slope = np.where((gap > 0) & (gone > 0),
                         (v[following] - v[k]) / np.maximum(gap, 1e-12), 0.0)
        return np.asarray(area[k] + v[k] * gone + 0.5 * slope * gone**2)

    result = np.empty(len(v))
    result[order] = (integral(t + 0.5 * length) - integral(t - 0.5 * length)) / length
    return result
