"""Frames of a video that repeat the one before, as converters between frame rates show them twice.

A camera would see nothing between the two, and a double step after them. A scene that stands still
repeats its frames as well, but many times: only short runs are taken for a converter's.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from evflow.light.colour import Frames
from evflow.notes import Note

LONGEST = 4  # times a frame is shown; more often, and the scene stands still
ALIKE, NOISE_DN = 0.05, 0.5  # of the change before, mean DN: what compression leaves of a repeat
SAMPLED = 4  # every 4th pixel of every 4th row is compared first


@dataclasses.dataclass
class Count:
    """frames: how many there were. repeats: how many of them repeated the one before."""

    frames: int = 0
    repeats: int = 0

    def note(self, *, dropped: bool) -> Note | None:
        """What is said; None where there is nothing to say."""
        if self.repeats < 2:
            return None
        what = (f"{self.repeats:,} of {self.frames:,} frames repeat the one before while the scene "
                "moves (a converted frame rate?)")
        return Note("frames.repeated", f"{what}: left out (--repeated drop)." if dropped else
                    f"{what}: no events there, and a double step after; --repeated drop leaves "
                    "them out.")


def watched(pairs: Frames, drop: bool, count: Count) -> Frames:
    """(frame, time) pairs, without repeats where `drop`; `count` grows with them.

    drop holds back up to LONGEST frames, else none waits.
    """
    run: list[tuple[np.ndarray, int]] = []  # a frame and its repeats
    shown, last_change = 0, 0.0
    for frame, time in pairs:
        count.frames += 1
        most = min(NOISE_DN, ALIKE * last_change)  # of what compression leaves
        change = _change(run[0][0], frame, most) if run else np.inf
        if run and change <= most:
            shown += 1
            if not drop or shown > LONGEST:
                if drop and shown == LONGEST + 1:
                    yield from run[1:]
                yield frame, time
                run = run[:1]
            else:
                run.append((frame, time))
            continue
        count.repeats += shown - 1 if run and shown <= LONGEST else 0
        yield frame, time
        last_change = change if np.isfinite(change) else 255.0
        run, shown = [(frame, time)], 1
    count.repeats += shown - 1 if run and shown <= LONGEST else 0


def _change(before: np.ndarray, after: np.ndarray, most: float) -> float:
    """Mean absolute change in DN; of all pixels only where that may be at most `most`."""
    some = np.s_[::SAMPLED, ::SAMPLED]
    sampled = _mean(before[some], after[some])
    return sampled if sampled > 2 * most else _mean(before, after)


def _mean(before: np.ndarray, after: np.ndarray) -> float:
    if before.shape != after.shape:
        return float("inf")
    return float(np.abs(after.astype(np.float32) - before.astype(np.float32)).mean())
