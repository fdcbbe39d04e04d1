"""When frames were filmed if a frame-rate converter repeats some of them at regular positions.

When 24 frames a second are shown at 30, every fourth is shown twice: without the repeats every
fourth gap is twice as long, though the frames were filmed evenly. A converter shows a frame as
early as it can, so the filmed times lie on a line, and the shown ones are later by less than one
frame. It is different if a camera had no new frame and repeated the last one: then the scene moves
twice as far in the double gap, and the times are right.
"""

from __future__ import annotations

import itertools

import numpy as np

Array = np.ndarray

LEAST_REPEATS, LEAST_FRAMES = 3, 16  # in a stretch: fewer do not show a cadence
ROUNDED_US = 1_000  # containers round times to the millisecond
SLACK = 1.02  # frames: maximum delay by a converter, with rounding of its clock
LEAST_STEP = 0.5  # frames between two of the recovered times


def evened(times: Array, changes: Array, frame_us: float) -> Array | None:
    """Times (K,) in us, int64, at which the frames first shown at `times` were filmed; None if no
    stretch of them has the cadence of a converter.

    changes: (K - 1,) amount of change from frame to frame. frame_us: duration of a frame of the
    video as shown. No time is moved by more than that, plus rounding.
    """
    even, begin, free = times.astype(np.float64), 0, 0
    while begin < len(times) - 1:
        end = _reach(times, begin, frame_us)
        first, step = _line(times[begin:end + 1])
        if _regular(times[begin:end + 1], changes[begin:end], frame_us):
            line = first + step * (np.arange(len(times)) - begin)
            while begin > free and 0 <= times[begin - 1] - line[begin - 1] <= _most(frame_us):
                begin -= 1  # part of the previous stretch
            while 0 < begin < end and line[begin] - even[begin - 1] < LEAST_STEP * frame_us:
                begin += 1
            if begin == 1 and times[0] > line[0]:
                begin = 0  # the first frame was shown before the video's start
            even[begin:end + 1], free = line[begin:end + 1], end + 1
        begin = end + 1
    if not free or np.diff(even).min() < LEAST_STEP * frame_us:
        return None
    return np.rint(even).astype(np.int64)


def _most(frame_us: float) -> float:
    """The maximum delay of a frame, in us."""
    return SLACK * frame_us + ROUNDED_US


def _reach(times: Array, begin: int, frame_us: float) -> int:
    """Index of the last frame of the longest stretch from `begin` that may be evenly filmed."""

    def even(end: int) -> bool:
        part = times[begin:end + 1]
        first, step = _line(part)
        return bool((part - first - step * np.arange(len(part))).max() <= _most(frame_us))

    good, bad = begin + 1, len(times)
    if even(bad - 1):
        return bad - 1
    step = 2
    while begin + step < bad and even(begin + step):
        good, step = begin + step, 2 * step
    bad = min(bad, begin + step)
    while bad - good > 1:
        middle = (good + bad) // 2
        good, bad = (middle, bad) if even(middle) else (good, middle)
    return good


def _line(times: Array) -> tuple[float, float]:
    """Value and step of the line below times (K,) that touches them on both sides of the middle."""
    hull: list[tuple[int, float]] = []
    for k, t in enumerate(times.tolist()):
        while len(hull) > 1 and (hull[-1][1] - hull[-2][1]) * (k - hull[-2][0]) >= (
                t - hull[-2][1]) * (hull[-1][0] - hull[-2][0]):
            hull.pop()
        hull.append((k, t))
    (i, t0), (j, t1) = next((a, b) for a, b in itertools.pairwise(hull)
                            if 2 * b[0] >= len(times) - 1)
    step = (t1 - t0) / (j - i)
    return t0 - i * step, step


def _regular(times: Array, changes: Array, frame_us: float) -> bool:
    """Whether a stretch has repeats at uneven positions, and its long gaps contain as much change
    as its short ones, rather than proportionally more."""
    gaps = np.rint(np.diff(times) / frame_us)
    long = gaps > gaps.min(initial=np.inf)
    few = len(gaps) < LEAST_FRAMES or (gaps - 1).clip(0).sum() < LEAST_REPEATS
    if few or not long.any() or gaps.min() < 1:  # a converter shows each for a frame at least
        return False
    more = np.median(gaps[long]) / np.median(gaps[~long])
    return bool(np.median(changes[long]) <= (1 + more) / 2 * np.median(changes[~long]))
