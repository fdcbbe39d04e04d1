"""Video frames that repeat the one before, as frame-rate converters insert them.

A camera would see no change at the repeat and a double step after it. A static scene repeats its
frames too, but many times: only short runs are attributed to a converter, and longer ones if they
all have the same length. Where frames mostly go back to the one before the last, a light blinks.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from evflow.io.images.cadence import evened
from evflow.light.colour import Frames
from evflow.notes import Note

REPEATED = "frames.repeated"
LONGEST = 4  # times a converter shows a frame; more, and the scene is static
LONGEST_ALIKE, MOVES_DN = 12, 1.0  # ... unless frames in a row are shown equally often and change
# this much in between: 5 frames a second at 60
IN_ROW = 5  # so many: fewer may be slides, or a screen that scrolls
ALIKE, NOISE_DN = 0.05, 0.5  # residual of compression: share of the previous change, mean DN
SAMPLED = 4  # every 4th pixel of every 4th row is compared first
HIDDEN = 255.0  # DN: assumed change before the first frame


@dataclasses.dataclass
class Runs:
    """Frames and their repeats, collected as they are read. times: of all frames in us; firsts:
    indices of frames that are not repeats; changes: their difference to the previous, mean DN;
    returned: how many of them show the one before the previous again."""

    times: list[int] = dataclasses.field(default_factory=list)
    firsts: list[int] = dataclasses.field(default_factory=list)
    changes: list[float] = dataclasses.field(default_factory=list)
    returned: int = 0

    def watched(self, pairs: Frames) -> Frames:
        """The (frame, time) pairs, recorded as they pass."""
        held = former = None
        for frame, time in pairs:
            before = self.changes[-1] if self.changes else HIDDEN
            most = min(NOISE_DN, ALIKE * before)  # residual of compression
            change = HIDDEN if held is None else _change(held, frame, most)
            if held is None or change > most:
                self.returned += former is not None and _change(former, frame, most) <= most
                held, former = frame, held
                self.firsts.append(len(self.times))
                self.changes.append(change)
            self.times.append(time)
            yield frame, time

    def repeats(self) -> np.ndarray:
        """Whether each frame is a converter's repeat, (T,) bool."""
        lengths = np.diff([*self.firsts, len(self.times)])
        if len(lengths) < 2 or 2 * self.returned > len(lengths):  # a static scene, a blinking light
            return np.zeros(len(self.times), bool)
        alike = np.abs(np.diff(lengths)) <= 1
        many = np.zeros(len(lengths), bool)
        for k in range(len(lengths) - IN_ROW + 1):
            many[k:k + IN_ROW] |= alike[k:k + IN_ROW - 1].all()
        moves = np.array(self.changes) >= MOVES_DN
        short = (lengths <= LONGEST) | (many & moves & (lengths <= LONGEST_ALIKE))
        shown_again = np.repeat(short, lengths)
        shown_again[self.firsts] = False
        return shown_again

    def without(self) -> tuple[np.ndarray, np.ndarray, bool]:
        """Frames left without repeats, (T,) bool; their times (K,) in us; whether these were made
        even, as they were filmed (`cadence`)."""
        left = ~self.repeats()
        times = np.array(self.times, np.int64)
        if left.all() or left.sum() < 2:
            return left, times[left], False
        changes = np.zeros(len(times))
        changes[self.firsts] = self.changes
        found = evened(times[left], changes[left][1:], float(np.median(np.diff(times))))
        if found is None:
            return left, times[left], False
        return left, found + (times[0] - found[0]), True  # keep the start of the video

    def note(self) -> Note | None:
        """The note if repeats are kept; None if there are none."""
        count = int(self.repeats().sum()) if self.times else 0
        return None if count < 2 else Note(
            REPEATED, f"{_said(count, len(self.times))}: they give no events, and a "
            "double step after; --repeated drop leaves them out (not of slides, a screen or a "
            "blinking light, which really stay as they are).")


def dropped(open_again: Callable[[], Frames], notes: list[Note]) -> Frames:
    """The (frame, time) pairs of a video without repeats, which is read twice. notes: is
    extended."""
    runs = Runs()
    for _ in runs.watched(open_again()):
        pass
    left, times, even = runs.without()
    if count := int((~left).sum()):
        spaced = f"; the others are evenly spaced again, {_rate(times)}" if even else ""
        notes.append(Note(REPEATED, f"{_said(count, len(left))}; they were left out "
                          f"(--repeated drop){spaced}."))
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
    """Mean absolute change in DN; over all pixels only if a sample does not exceed `most`."""
    some = np.s_[::SAMPLED, ::SAMPLED]
    sampled = _mean(before[some], after[some])
    return sampled if sampled > 2 * most else _mean(before, after)


def _mean(before: np.ndarray, after: np.ndarray) -> float:
    if before.shape != after.shape:
        return float("inf")
    return float(np.abs(after.astype(np.float32) - before.astype(np.float32)).mean())
