"""Frames of a video that repeat the one before, as converters between frame rates show them twice.

A camera would see nothing between the two, and a double step after them. A scene that stands still
repeats its frames as well, but many times: only short runs are taken for a converter's, and longer
ones that are all as long.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from evflow.io.images.cadence import evened
from evflow.light.colour import Frames
from evflow.notes import Note

LONGEST = 4  # times a frame is shown; more often, and the scene stands still
LONGEST_ALIKE, MOVES_DN = 12, 1.0  # ... where at least three in a row are shown as often, and
# change by so much: 5 frames a second at 60
ALIKE, NOISE_DN = 0.05, 0.5  # of the change before, mean DN: what compression leaves of a repeat
SAMPLED = 4  # every 4th pixel of every 4th row is compared first
HIDDEN = 255.0  # DN: the change before the first frame


@dataclasses.dataclass
class Runs:
    """Frames and their repeats, as they come. times: of all frames in us; firsts: indices of those
    that repeat none; changes: how far these differ from the frame before, mean DN."""

    times: list[int] = dataclasses.field(default_factory=list)
    firsts: list[int] = dataclasses.field(default_factory=list)
    changes: list[float] = dataclasses.field(default_factory=list)

    def watched(self, pairs: Frames) -> Frames:
        """The (frame, time) pairs, which are noted on their way."""
        held = None
        for frame, time in pairs:
            before = self.changes[-1] if self.changes else HIDDEN
            most = min(NOISE_DN, ALIKE * before)  # of what compression leaves
            change = HIDDEN if held is None else _change(held, frame, most)
            if held is None or change > most:
                held = frame
                self.firsts.append(len(self.times))
                self.changes.append(change)
            self.times.append(time)
            yield frame, time

    def repeats(self) -> np.ndarray:
        """Whether each frame is one that a converter showed again, (T,) bool."""
        lengths = np.diff([*self.firsts, len(self.times)])
        if len(lengths) < 2:  # nothing moves
            return np.zeros(len(self.times), bool)
        alike = np.abs(np.diff(lengths)) <= 1
        three = alike[1:] & alike[:-1]
        many = np.zeros(len(lengths), bool)
        for k in range(3):
            many[k:len(lengths) - 2 + k] |= three
        moves = np.array(self.changes) >= MOVES_DN
        short = (lengths <= LONGEST) | (many & moves & (lengths <= LONGEST_ALIKE))
        shown_again = np.repeat(short, lengths)
        shown_again[self.firsts] = False
        return shown_again

    def without(self) -> tuple[np.ndarray, np.ndarray, bool]:
        """Which frames are left without repeats, (T,) bool; their times (K,) in us; whether these
        are made even, as they were filmed (`cadence`)."""
        left = ~self.repeats()
        times = np.array(self.times, np.int64)
        if left.all() or left.sum() < 2:
            return left, times[left], False
        changes = np.zeros(len(times))
        changes[self.firsts] = self.changes
        found = evened(times[left], changes[left][1:], float(np.median(np.diff(times))))
        if found is None:
            return left, times[left], False
        return left, found + (times[0] - found[0]), True  # the video begins when it did

    def note(self) -> Note | None:
        """What is said where they are kept; None where there is nothing to say."""
        count = int(self.repeats().sum()) if self.times else 0
        return None if count < 2 else Note(
            "frames.repeated", f"{_said(count, len(self.times))}: no events there, and a double "
            "step after; --repeated drop leaves them out.")


def dropped(open_again: Callable[[], Frames], notes: list[Note]) -> Frames:
    """The (frame, time) pairs of a video without repeats, which is read twice. notes: is told of
    them."""
    runs = Runs()
    for _ in runs.watched(open_again()):
        pass
    left, times, even = runs.without()
    if count := int((~left).sum()):
        spaced = f"; the others are evenly spaced again, {_rate(times)}" if even else ""
        notes.append(Note("frames.repeated", f"{_said(count, len(left))}: left out (--repeated "
                          f"drop){spaced}."))
    moved = iter(times.tolist())
    for (frame, _), stays in zip(open_again(), left.tolist(), strict=True):
        if stays:
            yield frame, next(moved)


def _said(count: int, frames: int) -> str:
    return (f"{count:,} of {frames:,} frames repeat the one before while the scene moves (a "
            "converted frame rate?)")


def _rate(times: np.ndarray) -> str:
    return f"{1e6 / np.median(np.diff(times)):.4g} frames/s"


def _change(before: np.ndarray, after: np.ndarray, most: float) -> float:
    """Mean absolute change in DN; of all pixels only where that may be at most `most`."""
    some = np.s_[::SAMPLED, ::SAMPLED]
    sampled = _mean(before[some], after[some])
    return sampled if sampled > 2 * most else _mean(before, after)


def _mean(before: np.ndarray, after: np.ndarray) -> float:
    if before.shape != after.shape:
        return float("inf")
    return float(np.abs(after.astype(np.float32) - before.astype(np.float32)).mean())
