"""When frames were filmed that a converter between frame rates shows again at regular places.

Of 24 frames a second that are shown at 30, every fourth is shown twice: without the repeats one gap
in four is twice as long, though the frames were filmed evenly. A converter shows a frame at its
first chance, so the filmed times lie on a line from which the shown ones are late by less than one
frame. A camera that had no new frame and showed the last again is another thing: there as much
happens in twice the time, and the times are right.
"""

from __future__ import annotations

import itertools

import numpy as np

Array = np.ndarray

LEAST_REPEATS, LEAST_FRAMES = 3, 16  # in a stretch: fewer tell no cadence
ROUNDED_US = 1_000  # containers round times to the millisecond
SLACK = 1.02  # frames: the most that a converter is late, and its clock's rounding
LEAST_STEP = 0.5  # frames between two of the found times


def evened(times: Array, changes: Array, frame_us: float) -> Array | None:
    """Times (K,) in us, int64, at which frames were filmed that are first shown at `times`; None
    where no stretch of them has the cadence of a converter.

    changes: (K - 1,) how much happens from frame to frame. frame_us: length of a frame of the video
    as it is shown. No time is moved by more than that, and its rounding.
    """
    even, begin, free = times.astype(np.float64), 0, 0
    while begin < len(times) - 1:
        end = _reach(times, begin, frame_us)
        first, step = _line(times[begin:end + 1])
        if _regular(times[begin:end + 1], changes[begin:end], frame_us):
            line = first + step * (np.arange(len(times)) - begin)
            while begin > free and 0 <= times[begin - 1] - line[begin - 1] <= _most(frame_us):
                begin -= 1  # what a stretch before took for its own
            while 0 < begin < end and line[begin] - even[begin - 1] < LEAST_STEP * frame_us:
                begin += 1
            if begin == 1 and times[0] > line[0]:
                begin = 0  # shown before the video was cut out of another
            even[begin:end + 1], free = line[begin:end + 1], end + 1
        begin = end + 1
    if not free or np.diff(even).min() < LEAST_STEP * frame_us:
        return None
    return np.rint(even).astype(np.int64)


def _most(frame_us: float) -> float:
    """How late a frame is shown at most, in us."""
    return SLACK * frame_us + ROUNDED_US


def _reach(times: Array, begin: int, frame_us: float) -> int:
    """The last frame (index) of the longest stretch from `begin` that may be evenly filmed."""

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
    """First value and step of the line below times (K,) that touches them on both sides of the
    middle."""
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
    """Whether a stretch has repeats, unevenly, and as much happens in its long gaps as in its short
    ones, not as much more as they are longer."""
    gaps = np.rint(np.diff(times) / frame_us)
    long = gaps > gaps.min(initial=np.inf)
    few = len(gaps) < LEAST_FRAMES or (gaps - 1).clip(0).sum() < LEAST_REPEATS
    if few or not long.any():
        return False
    more = np.median(gaps[long]) / np.median(gaps[~long])
    return bool(np.median(changes[long]) <= (1 + more) / 2 * np.median(changes[~long]))
