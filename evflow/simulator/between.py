"""Frames interpolated between those of a video: pictures warped along smooth paths.

Each point moves along a cubic in time, with continuous position and velocity at the frames. Its
velocity there is that of the polynomial through five frames; the mean of the velocities before and
after (Catmull-Rom) would be a fifth too small for oscillations at a sixth of the frame rate. The
picture is warped from both frames, by cubic interpolation at double resolution. Bilinear
interpolation blurs all but the given frames, which modulates the event rate at the frame rate;
OpenCV's cubic interpolation at single resolution moves unevenly.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from collections.abc import Iterable, Iterator

import cv2
import numpy as np

from evflow.process.threads import behind
from evflow.simulator.motion import (
    Motion,
    grid,
    inside,
    length,
    looked_up,
    motion_between,
    speed,
)

UNEVEN = 2.0  # ratio of neighbouring intervals above which no acceleration is estimated
REACH = 33  # halved pixels: neighbourhood for the acceleration where flow is not trusted
COVERED = 5  # halved pixels around untrusted flow that share DIS' patches with it
MIDDLE = np.array([9, -50, 225, 225, -50, 9], np.float32) / 368  # Lanczos' kernel of 3 pixels half
# way between two
BAND, TOGETHER = 1 << 15, 1 << 24  # pixels filled by a thread of OpenCV's at a time, so that caches
# hold much of their ways, and bytes of pictures that are filled together
BENT_PX = 0.05  # an acceleration that moves less is left out


@dataclasses.dataclass(frozen=True, eq=False)
class Frame:
    """dn: (H, W) float32; time: us."""

    dn: np.ndarray
    time: int

    @functools.cached_property
    def ends(self) -> tuple[float, float]:
        """The least and the most DN."""
        return float(self.dn.min()), float(self.dn.max())

    @functools.cached_property
    def doubled(self) -> np.ndarray:
        """(2H, 2W): the frame at twice the resolution (Lanczos)."""
        height, width = self.dn.shape
        wide = np.empty((height, 2 * width), np.float32)
        wide[:, ::2], wide[:, 1::2] = self.dn, _between_pixels(self.dn, 1)
        both = np.empty((2 * height, 2 * width), np.float32)
        both[::2], both[1::2] = wide, _between_pixels(wide, 0)
        return both


def _between_pixels(image: np.ndarray, axis: int) -> np.ndarray:
    kernel = MIDDLE[None] if axis else MIDDLE[:, None]
    anchor = (len(MIDDLE) // 2 - 1, 0) if axis else (0, len(MIDDLE) // 2 - 1)
    return cv2.filter2D(image, -1, kernel, anchor=anchor, borderType=cv2.BORDER_REPLICATE)


@dataclasses.dataclass(frozen=True, eq=False)
class Interval:
    """Two frames and the motion between them.

    bends: half the acceleration at a and at b, (H, W, 2) in pixels per squared interval; None
    without acceleration. speed_px: motion of the fast pixels of trusted flow at their greatest
    velocity, 0 where the flow is lost. grid: of `motion.grid`.
    """

    a: Frame
    b: Frame
    motion: Motion
    bends: tuple[np.ndarray, np.ndarray] | None
    speed_px: float
    grid: np.ndarray

    def at(self, fractions: Iterable[float], *, sharp: bool = True) -> Iterator[np.ndarray]:
        """The pictures (H, W) in DN, float32, at fractions of the interval. sharp: cubic at double
        resolution, else bilinear. Cross-fades where the flow is lost."""
        if self.motion.lost:
            for s in fractions:
                yield cv2.addWeighted(self.a.dn, 1 - s, self.b.dn, s, 0)
            return
        frames = (self.a.doubled, self.b.doubled) if sharp else (self.a.dn, self.b.dn)
        shares, shape, reach = list(fractions), self.a.dn.shape, self._reach()
        most = max(1, TOGETHER // self.a.dn.nbytes)
        for first in range(0, len(shares), most):
            some = shares[first : first + most]
            pictures = np.empty((len(some), *shape), np.float32)
            with behind(shape[0]) as later:
                for number, rows in enumerate(_bands(shape)):
                    work = (pictures[:, rows], some, rows, list(_edges(rows, shape, reach)),
                            frames, sharp)
                    if number % 2 and cv2.getNumThreads() == 1:
                        later(self._fill, *work)
                    else:
                        self._fill(*work)
            yield from pictures

    def _fill(
        self, pictures: np.ndarray, fractions: list[float], rows: slice,
        edges: list[tuple[slice, slice]], frames: tuple[np.ndarray, np.ndarray], sharp: bool,
    ) -> None:
        """Some rows of the pictures (N, rows, W). edges: parts of them from where something outside
        the frames may be looked up; frames: doubled where sharp."""
        a, b = frames
        how, scale = (cv2.INTER_CUBIC, 2) if sharp else (cv2.INTER_LINEAR, 1)
        there, back, places, *bends = (np.float32(scale) * values[rows] for values in (
            self.motion.there, self.motion.back, self.grid, *(self.bends or ())))
        apart, minus_there = there + back, -there
        (least_a, most_a), (least_b, most_b) = self.a.ends, self.b.ends
        along, to_a, to_b = (np.empty_like(apart) for _ in range(3))  # new memory costs more
        seen_a, seen_b = np.empty_like(pictures[0]), np.empty_like(pictures[0])
        for s, picture in zip(fractions, pictures, strict=True):
            # flow from the new picture: the quadratic blend of the two measured ones, which is
            # exact for constant velocity, and what acceleration moves it by
            cv2.scaleAdd(apart, s, minus_there, along)
            cv2.scaleAdd(along, s, places, to_a)
            for bend, share in zip(bends, (1 - s, s), strict=False):
                cv2.scaleAdd(bend, share * s * (1 - s), to_a, to_a)
            cv2.subtract(to_a, along, to_b)
            looked_up(a, to_a, how, seen_a)
            looked_up(b, to_b, how, seen_b)
            cv2.addWeighted(seen_a, 1 - s, seen_b, s, 0, picture)
            for edge in edges:
                in_a, in_b = inside(to_a[edge], a.shape), inside(to_b[edge], b.shape)
                cv2.copyTo(seen_a[edge], cv2.compare(in_a, in_b, cv2.CMP_GT), picture[edge])
                cv2.copyTo(seen_b[edge], cv2.compare(in_b, in_a, cv2.CMP_GT), picture[edge])
            np.clip(picture, min(least_a, least_b), max(most_a, most_b), out=picture)

    def _reach(self) -> tuple[int, int]:
        """Largest displacement (x, y) in pixels at any fraction of the interval."""
        def largest(moved: np.ndarray) -> np.ndarray:
            return np.array([cv2.norm(one, cv2.NORM_INF) for one in cv2.split(moved)])

        bent = sum(largest(bend) for bend in self.bends or ())
        x, y = np.maximum(largest(self.motion.there), largest(self.motion.back)) + bent
        return math.ceil(x) + 1, math.ceil(y) + 1


def _bands(shape: tuple[int, ...]) -> Iterator[slice]:
    """The rows of a frame (H, W) in bands, an even number of them: two threads share them where
    OpenCV has a single one."""
    pairs = math.ceil(math.prod(shape) / (2 * BAND * cv2.getNumThreads()))
    band = math.ceil(shape[0] / (2 * pairs))
    yield from (slice(top, min(top + band, shape[0])) for top in range(0, shape[0], band))


def _edges(
    rows: slice, shape: tuple[int, ...], reach: tuple[int, int]
) -> Iterator[tuple[slice, slice]]:
    """Disjoint parts of some rows of a frame (H, W) that cover its border of width `reach` (x, y)
    pixels; indices count from the first of these rows."""
    (x, y), (height, width), count = reach, shape, rows.stop - rows.start
    top = min(max(y - rows.start, 0), count)
    bottom = min(max(height - y - rows.start, top), count)
    columns = [slice(None)] if 2 * x >= width else [slice(x), slice(width - x, None)]
    parts = [(slice(top), slice(None)), *((slice(top, bottom), some) for some in columns),
             (slice(bottom, count), slice(None))]
    yield from ((along, across) for along, across in parts if along.stop > (along.start or 0))


def intervals(
    pairs: Iterable[tuple[np.ndarray, int]], *, jerk: bool = True
) -> Iterator[Interval]:
    """The intervals of a stream of frames.

    Args:
        pairs: (frame (H, W) in DN, float32, all of one size; time in us, increasing).
        jerk: use the change of acceleration; an interval is then yielded two frames later, not one.

    Yields:
        One interval per pair of neighbouring frames; none of a single frame.
    """
    held = outer = places = None
    for found in _bent(pairs):
        places = grid(found[0].a.dn.shape) if places is None else places
        if not jerk:
            yield _interval(*found, places)
            continue
        if held is not None:
            yield _interval(*held, places, outer, found[2])
            outer = held[1]
        held = found
    if held is not None and places is not None:
        yield _interval(*held, places, outer)


def _bent(
    pairs: Iterable[tuple[np.ndarray, int]]
) -> Iterator[tuple[_Pair, np.ndarray | None, np.ndarray | None]]:
    """Neighbouring frames, and `_acceleration` at each."""
    last = held = before = None
    for frame in itertools.starmap(Frame, pairs):
        if last is not None:
            new = _Pair(last, frame, motion_between(last.dn, frame.dn))
            if held is not None:
                after = _acceleration(held, new)
                yield held, before, after
                before = after
            held = new
        last = frame
    if held is not None:
        yield held, before, None


@dataclasses.dataclass(frozen=True, eq=False)
class _Pair:
    a: Frame
    b: Frame
    motion: Motion

    @property
    def length(self) -> int:
        """In us."""
        return self.b.time - self.a.time


def _acceleration(first: _Pair, second: _Pair) -> np.ndarray | None:
    """Half the acceleration at the frame shared by two intervals, (h, w, 2) in pixels per us² at
    half resolution; None where the intervals' lengths differ too much or the flow is lost. Where
    flow is not trusted, as at edges of objects and of the picture, it is averaged from around."""
    before, after = first.length, second.length
    lost = first.motion.lost or second.motion.lost
    if lost or max(before, after) > UNEVEN * min(before, after):
        return None
    jump = second.motion.halves[0] / after + first.motion.halves[1] / before
    trusted = first.motion.trusted[1] & second.motion.trusted[0]
    weight = cv2.erode(trusted.astype(np.float32), np.ones((COVERED, COVERED), np.uint8))[..., None]
    near = np.concatenate([jump * weight, weight], -1)
    for _ in range(2):
        near = cv2.blur(near, (REACH, REACH), borderType=cv2.BORDER_REPLICATE)
    around = near[..., :2] / (near[..., 2:] + np.float32(1e-3))
    return (around + weight * (jump - around)) / np.float32(before + after)


def _interval(
    pair: _Pair, before: np.ndarray | None, after: np.ndarray | None, places: np.ndarray,
    earlier: np.ndarray | None = None, later: np.ndarray | None = None,
) -> Interval:
    """The interval of a pair. before, after: `_acceleration` at its frames; if only one is known
    it is constant. earlier, later: at the neighbouring frames, for its change."""
    if pair.motion.lost:
        return Interval(pair.a, pair.b, pair.motion, None, 0.0, places)
    (there, back), (on_a, on_b) = pair.motion.halves, pair.motion.trusted
    fast, bends = _speed(there, on_a), None
    first, second = (after if before is None else before), (before if after is None else after)
    if before is not None and after is not None:  # the velocity of a swing, to the fourth order
        first = before if earlier is None else before + (after - earlier) / np.float32(6)
        second = after if later is None else after - (later - before) / np.float32(6)
    if first is not None and second is not None:
        square = np.float32(pair.length) ** 2
        bent = _limited(first * square, there), _limited(second * square, back)
        if max(map(speed, bent)) > BENT_PX:
            fast = max(fast, _speed(there - bent[0], on_a), _speed(back - bent[1], on_b))
            size = pair.a.dn.shape[::-1]
            bends = cv2.resize(bent[0], size), cv2.resize(bent[1], size)
    return Interval(pair.a, pair.b, pair.motion, bends, fast, places)


def _speed(flow: np.ndarray, trusted: np.ndarray) -> float:
    """`speed` of a flow (h, w, 2) where it is trusted: elsewhere, as where something comes into
    view, it may be twice as fast as all that moves."""
    return speed(flow[trusted] if trusted.any() else flow)


def _limited(bend: np.ndarray, flow: np.ndarray) -> np.ndarray:
    """The bend, at most as long as the flow: no point reverses, and resting points stay."""
    most, found = length(flow), length(bend)
    return bend * (np.minimum(found, most) / np.maximum(found, np.float32(1e-9)))[..., None]
