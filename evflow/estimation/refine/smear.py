"""Temporal smearing of the path, by exposure or by frames far apart.

The path between blurred or distant frames is a mean of the light over some time. A pixel's memory
changes from event to event. If the path is smeared, it explains the memory's mean over that time
better than the memory itself, and the regression gives higher thresholds.
"""

from __future__ import annotations

import numpy as np

Array = np.ndarray


def smeared(pixel: Array, at: Array, counts: Array, length: float) -> Array:
    """Mean of a pixel's counts over `length` around each of its events.

    The counts are interpolated linearly between events, and constant before the first and after
    the last.

    Args:
        pixel: (N,) int, events in any order.
        at: (N,) times, in the unit of length.
        counts: (N,) at these times.
        length: of the window.

    Returns:
        (N,) in the order of the events.
    """
    order = np.lexsort((at, pixel))
    pixel, t, v = pixel[order], at[order].astype(np.float64), counts[order].astype(np.float64)
    first, last = np.searchsorted(pixel, pixel), np.searchsorted(pixel, pixel, side="right") - 1
    same = np.diff(pixel) == 0
    area = np.concatenate([[0.0], np.cumsum(np.where(
        same, 0.5 * (v[1:] + v[:-1]) * np.diff(t), 0.0))])
    # One ascending time axis, on which every pixel has a span of its own.
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
