"""Features of a chunk's events and of random points, for separating noise from signal.

Noise is a Poisson process independent of the signal, so the surroundings of a noise event (without
the event itself) are distributed as those of a random pixel at a random time (Mecke's formula).
Signal events have neighbours of their polarity, come while the path moves in their direction, and
about one threshold of change after the pixel's last event. `surroundings` computes such features
for events and random points alike.
"""

from __future__ import annotations

import dataclasses
import itertools

import cv2
import numpy as np

from evflow.estimation.refine.chunk import Chunk
from evflow.estimation.refine.sightings import Sightings

Array = np.ndarray

# Neighbourhoods: side in pixels and number of fine steps, both odd.
BOXES = ((3, 1), (5, 3), (9, 9), (9, 33), (17, 17), (1, 3), (1, 9), (1, 33))
# Points with more events of their polarity nearby are not used: with them, accuracy on held-out
# recordings falls by a fifth.
NEAR, MOST_NEAR = BOXES[1], 1.0
SPANS = (1, 4, 8)  # fine steps before and after, for the path's climb
MOST_CLIMB, MOST_AROUND = 3.0, 5.0  # in thresholds: limits of a pixel's climb, and of that in 3x3
RANDOM_POINTS = 4096  # per chunk and polarity
MOST_EVENTS = 8192  # per chunk and polarity; more are thinned
STILL = 0.02  # log units: added to the path's range before its logarithm
FEATURES = 2 * len(BOXES) + len(SPANS) + 8


@dataclasses.dataclass(frozen=True, eq=False)
class Points:
    """Points of one polarity. features: (N, FEATURES) float32; event: (N,) number of the event
    among the sightings, -1 for a random point; density: (N,) random points per pixel second,
    divided by the share of events that were kept."""

    features: Array
    event: Array
    density: Array


@dataclasses.dataclass(frozen=True, eq=False)
class _Places:
    """Places of N points of one polarity. pixel: flat index; position: in fine steps; event: number
    of the event among the sightings, -1 for a random point."""

    pixel: Array
    position: Array
    event: Array
    on: bool
    width: int

    @property
    def at(self) -> tuple[Array, Array, Array]:
        """Fine step, y and x, whole numbers."""
        return self.position.astype(np.int64), self.pixel // self.width, self.pixel % self.width

    def __getitem__(self, kept: Array) -> _Places:
        return dataclasses.replace(self, pixel=self.pixel[kept], position=self.position[kept],
                                   event=self.event[kept])


def chunk_points(chunk: Chunk, theta: Array, steps: int, seed: int) -> list[Points]:
    """ON and OFF points of a chunk's bright pixels.

    Args:
        chunk: with sightings.
        theta: (2,) thresholds of the camera.
        steps: fine steps per interval.
        seed: of the random points, and of the choice of events where there are too many.
    """
    s, (k, rng) = chunk.sightings, (len(chunk.dt_s), np.random.default_rng(seed))
    table = _cumulated(s, k * steps, steps)
    wide = np.stack([cv2.dilate(np.ascontiguousarray(i.reshape(s.shape)), np.ones((5, 5), np.uint8))
                     for i in s.inner])
    found = []
    for side, on in enumerate((True, False)):
        events, random = _candidates(s, k * steps, steps, on, rng)
        events, random = (p[_isolated(p, chunk.bright, table[side])] for p in (events, random))
        kept = min(1.0, MOST_EVENTS / max(len(events.pixel), 1))
        events = events[rng.random(len(events.pixel)) < kept]
        pixel, position, event = (np.concatenate([getattr(p, name) for p in (events, random)])
                                  for name in ("pixel", "position", "event"))
        both = _Places(pixel, position, event, on, s.shape[1])
        density = RANDOM_POINTS / (chunk.bright.size * float(chunk.dt_s.sum())) / kept
        found.append(Points(surroundings(chunk, both, table, wide, theta[side], steps),
                            both.event, np.full(len(both.pixel), density)))
    return found


def _candidates(
    s: Sightings, length: int, steps: int, on: bool, rng: np.random.Generator
) -> tuple[_Places, _Places]:
    """The events of a polarity, and random points."""
    last, width = np.nextafter(length, 0), s.shape[1]
    number = np.flatnonzero(s.on == on)
    when = np.minimum((s.interval + s.fraction)[number] * steps, last)
    return (_Places(s.pixel[number], when, number, on, width),
            _Places(rng.integers(0, s.frames.shape[1], RANDOM_POINTS),
                    rng.uniform(0, last, RANDOM_POINTS), np.full(RANDOM_POINTS, -1), on, width))


def _isolated(p: _Places, bright: Array, table: Array) -> Array:
    """(N,) bool: points of bright pixels with at most MOST_NEAR events of their polarity nearby."""
    return bright.ravel()[p.pixel] & (_events_near(table, p, NEAR) - (p.event >= 0) <= MOST_NEAR)


def _cumulated(s: Sightings, length: int, steps: int) -> Array:
    """(2, length + 1, H + 1, W + 1) int32: events before each fine step, row and column."""
    step = np.minimum(((s.interval + s.fraction) * steps).astype(np.int64), length - 1)
    key = np.where(s.on, 0, length) + step
    order = np.argsort(key, kind="stable")
    pixel, ends = s.pixel[order], np.searchsorted(key[order], np.arange(2 * length + 1))
    out = np.zeros((2, length + 1, s.shape[0] + 1, s.shape[1] + 1), np.int32)
    # Image by image, which stays in the cache: five times as fast as sums over the whole table.
    for k, (first, last) in enumerate(itertools.pairwise(ends)):
        side, at = divmod(k, length)
        counts = np.bincount(pixel[first:last], minlength=s.shape[0] * s.shape[1])
        np.add(out[side, at], _integral(counts.reshape(s.shape)), out=out[side, at + 1])
    return out


def _integral(counts: Array) -> Array:
    """(H + 1, W + 1) int32: sums of counts (H, W) before each row and column."""
    if counts.max(initial=0) < 256:
        return cv2.integral(counts.astype(np.uint8))
    return np.pad(counts.cumsum(0).cumsum(1), ((1, 0), (1, 0))).astype(np.int32)


def _events_near(table: Array, p: _Places, box: tuple[int, int]) -> Array:
    """(N,) events of a table (T + 1, H + 1, W + 1) in the box around each point."""
    ends = []
    strides = (table.shape[1] * table.shape[2], table.shape[2], 1)
    for at, width, most, stride in zip(p.at, (box[1], box[0], box[0]), table.shape, strides,
                                       strict=True):
        half = width // 2
        ends.append((np.maximum(at - half, 0) * stride,
                     np.minimum(at + half + 1, most - 1) * stride))
    total, flat = np.zeros(len(p.pixel), np.int32), table.reshape(-1)
    for (i, t), (j, y) in itertools.product(enumerate(ends[0]), enumerate(ends[1])):
        row = t + y  # a flat gather per corner is three times as fast as three indices
        difference = flat.take(row + ends[2][1]) - flat.take(row + ends[2][0])
        total += difference if i == j else -difference
    return total.astype(np.float32)


def surroundings(
    chunk: Chunk, p: _Places, table: Array, wide: Array, unit: float, steps: int
) -> Array:
    """Features (N, FEATURES) of points.

    Counts of neighbouring events of the same and of the other polarity; the path's climb in the
    polarity's direction in units of the threshold, at the pixel and the largest in 3x3 pixels; its
    range within the interval, at the pixel and in 5x5 pixels; the pixel's previous and next event.

    Args:
        chunk: with sightings.
        p: the points.
        table: of `_cumulated`.
        wide: (K, H, W) range of the path in 5x5 pixels.
        unit: threshold, log units.
        steps: fine steps per interval.
    """
    path, side, sign = chunk.path, 0 if p.on else 1, 1.0 if p.on else -1.0
    step, y, x = p.at
    columns = []
    for box in BOXES:
        columns += [np.log1p(_events_near(table[side], p, box) - (p.event >= 0)),
                    np.log1p(_events_near(table[1 - side], p, box))]
    for span in SPANS:
        begin, end = np.maximum(step - span, 0), np.minimum(step + 1 + span, len(path) - 1)
        climb = sign / unit * (path[end, y, x] - path[begin, y, x])
        columns.append(np.clip(climb, -MOST_CLIMB, MOST_CLIMB))
    for dy, dx in itertools.product((-1, 0, 1), repeat=2):
        row = np.clip(y + dy, 0, path.shape[1] - 1)
        column = np.clip(x + dx, 0, path.shape[2] - 1)
        climb = np.maximum(climb, sign / unit * (path[end, row, column] - path[begin, row, column]))
    columns.append(np.clip(climb, -MOST_CLIMB, MOST_AROUND))
    interval = step // steps
    columns += [np.log(chunk.sightings.inner[interval, p.pixel] + STILL),
                np.log(wide[interval, y, x] + STILL)]
    columns += _own(chunk.sightings, p, path, sign / unit, steps)
    return np.stack(columns, -1).astype(np.float32)


def _own(s: Sightings, p: _Places, path: Array, scale: float, steps: int) -> list[Array]:
    """The climb since the pixel's last event; whether there is one, and whether of the same
    polarity; the climb to the next; whether there is one."""
    if len(s.pixel) == 0:
        return [np.zeros(len(p.pixel))] * 5
    length = float(len(path))
    order = s.pixel * length + np.minimum((s.interval + s.fraction) * steps, length - 1)
    after = np.searchsorted(order, p.pixel * length + p.position)
    before = np.where(p.event >= 0, p.event, after) - 1
    after = np.where(p.event >= 0, p.event + 1, after)
    was = (before >= 0) & (s.pixel[np.maximum(before, 0)] == p.pixel)
    after_in = np.minimum(after, len(order) - 1)
    will = (after < len(order)) & (s.pixel[after_in] == p.pixel)
    step, y, x = p.at
    part = p.position - step
    here = path[step, y, x] * (1 - part) + path[step + 1, y, x] * part
    since = np.clip((here - s.path[before]) * scale, -MOST_CLIMB, MOST_CLIMB) * was
    until = np.clip((s.path[after_in] - here) * scale, -MOST_CLIMB, MOST_CLIMB) * will
    return [since, was, np.where(s.on[before] == p.on, 1.0, -1.0) * was, until, will]
