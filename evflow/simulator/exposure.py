"""The blur of an exposure, taken out of the frames between which others are interpolated.

A frame is the mean of the light over its exposure, and the interpolated frames around it show what
passed during that time. Their mean is therefore blurred once more, and what it lacks of the frame
is, to first order, what the frame lacks of the light:

    sharp = frame * frame / mean of the interpolated frames over the exposure.

One such step (the first of Gold's iteration, 1964) restores the contrast of what is longer than
twice the blur; further ones amplify noise. A quotient, unlike a difference, keeps dark places dark,
where events are most sensitive. Nothing changes where nothing moves, or where the optical flow is
lost.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator

import numpy as np

from evflow.simulator.between import Frame, Interval

NODES = (0.2386191861, 0.6612093865, 0.9324695142)  # Gauss-Legendre, 6 points on -1 .. 1: a half
WEIGHTS = np.array([0.2339569673, 0.1803807865, 0.0856622462], np.float32)
WHITE_DN = 255.0
DARK = np.float32(5)  # DN, added to both: bounds the quotient of dark, noisy frames
MOST = np.float32(1.3)  # change of brightness: textures need less, edges of objects would overshoot
LEAST_PX = 0.5  # motion during the exposure: less blurs hardly more than a pixel does


def unblurred(found: Iterable[Interval], exposure_us: int) -> Iterator[Interval]:
    """The intervals with frames from which the blur of their exposure is taken out.

    Args:
        found: successive intervals, with the frames as recorded.
        exposure_us: of each frame, around its time, at most an interval; 0 leaves the frames as
            they are.

    Yields:
        The intervals, each one later than it came, with the same motion.
    """
    if not exposure_us:
        yield from found
        return
    last: Interval | None = None
    sharp: Frame | None = None  # of last.a
    for new in found:
        frame = _sharp(new.a, last, new, exposure_us)
        if last is not None and sharp is not None:
            yield dataclasses.replace(last, a=sharp, b=frame)
        last, sharp = new, frame
    if last is not None and sharp is not None:
        yield dataclasses.replace(last, a=sharp, b=_sharp(last.b, last, None, exposure_us))


def _sharp(
    frame: Frame, before: Interval | None, after: Interval | None, exposure_us: int
) -> Frame:
    """A frame, sharpened; before, after: the intervals at its sides, of which one may be missing:
    the motion of the other is then continued. One side alone would move the frame."""
    sides = [(side, begin) for side, begin in ((before, 1.0), (after, 0.0))
             if side is not None and not side.motion.lost]
    if not any(_motion_px(side, exposure_us) >= LEAST_PX for side, _ in sides):
        return frame
    total = np.zeros_like(frame.dn)
    for sign, (side, begin) in ((-1, sides[0]), (1, sides[-1])):
        share = min(0.5 * exposure_us / (side.b.time - side.a.time), 0.5)
        pictures = side.at([begin + sign * share * node for node in NODES])
        for weight, picture in zip(WEIGHTS, pictures, strict=True):
            total += weight * picture
    gain = np.clip((frame.dn + DARK) / (total + DARK), 1 / MOST, MOST)
    sharp = (frame.dn + DARK) * gain - DARK
    return Frame(np.clip(sharp, 0, max(WHITE_DN, frame.ends[1])), frame.time)


def _motion_px(side: Interval, exposure_us: int) -> float:
    """Of the fast pixels during the exposure."""
    return side.speed_px * exposure_us / (side.b.time - side.a.time)
