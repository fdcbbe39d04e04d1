"""Regions of a sensor: events and frames within a rectangle of pixels, bands of rows for large
sensors, and the events of all but some pixels."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from evflow.types import Events, Window


def bands(shape: tuple[int, int], pixels: int) -> Iterator[slice]:
    """Slices of rows of an image (H, W) of about as many pixels or fewer, all within a row of
    equally high: two shapes at most."""
    height, width = shape
    count = min(height, -(-height * width // pixels))
    edges = np.arange(count + 1) * height // count
    for first, end in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        yield slice(first, end)


def inside(events: Events, rows: slice, columns: slice) -> Events:
    """The events of a rectangle of pixels, counted from its first."""
    y, x = rows.start, columns.start
    kept = (events.y >= y) & (events.y < rows.stop)
    if columns.stop - x < events.size[0]:
        kept &= (events.x >= x) & (events.x < columns.stop)
    return Events.unchecked(events.x[kept] - np.uint16(x), events.y[kept] - np.uint16(y),
                            events.t[kept], events.p[kept], (columns.stop - x, rows.stop - y))


def outside(events: Events, pixels: np.ndarray) -> Events:
    """The events of other pixels than these, (H, W) bool."""
    return only(events, ~pixels[events.y, events.x]) if pixels.any() else events


def only(events: Events, kept: np.ndarray) -> Events:
    """Some of the events; kept: (N,) bool."""
    return Events.unchecked(events.x[kept], events.y[kept], events.t[kept], events.p[kept],
                            events.size)


def rows_of(window: Window, rows: slice) -> Window:
    """The part of a window that some rows saw."""
    width = window.events.size[0]
    return Window(inside(window.events, rows, slice(0, width)), window.frame0[rows],
                  window.frame1[rows], window.t0_us, window.t1_us, window.index)
