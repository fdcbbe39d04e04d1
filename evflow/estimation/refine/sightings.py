"""A pixel's events beside the path of its brightness.

Events are ordered by pixel, then time; each has its frame interval and the path's value at its
time. pixels.py, start.py and bounds.py derive the pixel's thresholds from these.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from evflow.types import Events

Array = np.ndarray

# These and the constants of pixels.py and bounds.py: chosen on 115 simulated recordings of .2 s.
PATH_ERROR = 0.03  # log units: error of the path at a frame, from the frame's noise
RANGE_ERROR = 0.2  # error half-way between two frames, relative to the path's range there
TYPICAL_THETA = 0.25  # log units: converts events into a range, where the path may have missed it
HIDDEN = 1e-9  # weight of events beside saturated or black frames; not 0, to avoid 0 / 0


@dataclasses.dataclass(frozen=True, eq=False)
class Sightings:
    """N events beside the path, by pixel and time.

    number: (N,) index among the events given to `sight`; pixel: (N,) flat index; interval: (N,);
    fraction: (N,) of the interval; on: (N,) bool; path: (N,) the path's value at the event;
    first: index of each pixel's first event; frames: (K + 1, H*W) path at the frames;
    inner: (K, H*W) range of the path within each interval; seen: (K + 1, H*W) bool, frames that
    are neither saturated nor black; shape: (H, W).
    """

    number: Array
    pixel: Array
    interval: Array
    fraction: Array
    on: Array
    path: Array
    first: Array
    frames: Array
    inner: Array
    seen: Array
    shape: tuple[int, int]

    @property
    def shown(self) -> Array:
        """(N,) bool: events whose frames before and after are neither saturated nor black."""
        at = self.interval, self.pixel
        return np.asarray(self.seen[at] & self.seen[self.interval + 1, self.pixel])


def sight(
    events: Events, times_us: Array, path: Array, steps: int, seen: Array | None = None
) -> Sightings:
    """Place events beside the path.

    Args:
        events: those outside of the frames' times are left out.
        times_us: (K + 1,) of the frames.
        path: (K*steps + 1, H, W) log units.
        steps: fine steps per interval.
        seen: (K + 1, H, W) bool, as of `Sightings`; by default all True.
    """
    width, height = events.size
    used = events.slice(int(times_us[0]) + 1, int(times_us[-1]) + 1)
    k, flat = len(times_us) - 1, path.reshape(len(path), -1)
    pixel = used.y.astype(np.int64) * width + used.x
    order = np.argsort(pixel, kind="stable")
    pixel, t, on = pixel[order], used.t[order], used.p[order]
    number = order + np.searchsorted(events.t, int(times_us[0]) + 1)
    interval = np.searchsorted(times_us, t, side="left") - 1
    fraction = (t - times_us[interval]) / np.diff(times_us)[interval]
    position = np.minimum((interval + fraction) * steps, k * steps - 1e-9)
    step = position.astype(np.int64)
    value = flat[step, pixel] + (position - step) * (flat[step + 1, pixel] - flat[step, pixel])
    parts = flat[1:].reshape(k, steps, -1)
    everything = np.ones((k + 1, height, width), bool) if seen is None else seen
    return Sightings(
        number, pixel, interval, fraction, on, value, np.flatnonzero(np.diff(pixel, prepend=-1)),
        flat[::steps], parts.max(1) - parts.min(1), everything.reshape(k + 1, -1), (height, width))


def those(s: Sightings, kept: Array) -> Sightings:
    """The sightings of some events only; kept: (N,) bool."""
    pixel = s.pixel[kept]
    others = {name: getattr(s, name)[kept]
              for name in ("number", "interval", "fraction", "on", "path")}
    first = np.flatnonzero(np.diff(pixel, prepend=-1))
    return dataclasses.replace(s, pixel=pixel, first=first, **others)


def no_sightings(seen: Array) -> Sightings:
    """Sightings without events and path. seen: (K + 1, H, W) bool."""
    none, shape = np.zeros(0, np.int64), seen.shape[1:]
    path = np.zeros((0, seen[0].size), np.float32)
    return Sightings(none, none, none, none.astype(float), none > 0, none.astype(float), none,
                     path, path, seen.reshape(len(seen), -1), shape)


def path_weights(s: Sightings) -> Array:
    """(N,) weights of the path at the events: PATH_ERROR² over its variance, 1 at a frame."""
    span = np.maximum(s.inner[s.interval, s.pixel], TYPICAL_THETA * _net_range(s))
    between = 4 * s.fraction * (1 - s.fraction)
    weight = 1.0 / (1.0 + (RANGE_ERROR / PATH_ERROR * span) ** 2 * between)
    return np.asarray(weight * np.where(s.shown, 1.0, HIDDEN))


def _net_range(s: Sightings) -> Array:
    """(N,): range of the pixel's net event count within each event's interval. It detects changes
    there and back between two frames, which the path misses."""
    sign = np.where(s.on, 1, -1)
    net = np.cumsum(sign)
    new = (np.diff(s.pixel, prepend=-1) != 0) | (np.diff(s.interval, prepend=-1) != 0)
    begin = np.flatnonzero(new)
    before = (net - sign)[begin]
    high = np.maximum(np.maximum.reduceat(net, begin), before)
    low = np.minimum(np.minimum.reduceat(net, begin), before)
    return (high - low)[np.cumsum(new) - 1]


def counts_so_far(s: Sightings) -> tuple[Array, Array, Array]:
    """For each event, (N,): index of its pixel among those with events; the pixel's ON events so
    far, itself included; minus its OFF events so far."""
    group = np.cumsum(np.diff(s.pixel, prepend=-1) != 0) - 1
    on, off = np.cumsum(s.on.astype(np.float64)), np.cumsum(1.0 - s.on)
    before_on, before_off = (on - s.on)[s.first], (off - 1.0 + s.on)[s.first]
    return group, on - before_on[group], before_off[group] - off
