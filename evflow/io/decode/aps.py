"""DAVIS frames from the samples of its converter: each pixel is read after its reset and again
after its exposure; the difference is the light.

Columns are read one after another. With a global shutter all resets come before all signals, and
the exposure lies between them; with a rolling shutter each column has its own exposure and the two
are interleaved. A frame begins where the resets return to the first column.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np

from evflow.checks import Size
from evflow.notes import Note

RESET, SIGNAL = 0, 1  # kinds of samples
WHITE = 1023  # of 10 bits
NONE = -1  # a pixel that was not read
SURE = 8  # coordinate steps that show which coordinate is slower, and its direction


class Aps:
    """Builds frames (H, W) float32 from samples, in parts of any length; the converter's full range
    becomes 255. done(frame, its mid-exposure, exposure_us=) is called for each complete frame.
    """

    def __init__(self, size: Size, done: Callable[..., Any]) -> None:
        self.size, self.done = size, done
        self.incomplete = self.dark = self.outside = 0
        self.slow, self.way, self.last = "", 0, NONE
        self._clear()

    def _clear(self) -> None:
        self.reads: list[_Reads] = [_Reads(), _Reads()]
        self.orphaned = False  # whether signals came before the resets

    def add(
        self, kind: np.ndarray, x: np.ndarray, y: np.ndarray, t: np.ndarray, value: np.ndarray
    ) -> None:
        """Samples (n,) in file order: t int64 us, x and y from the top left."""
        inside = (x >= 0) & (x < self.size[0]) & (y >= 0) & (y < self.size[1])
        self.outside += int((~inside).sum())
        if not inside.all():
            kind, x, y, t, value = (column[inside] for column in (kind, x, y, t, value))
        resets = np.flatnonzero(kind == RESET)
        begins = resets[self._starts(x[resets], y[resets])]
        edges = [0, *begins.tolist(), len(kind)]
        for i, (begin, end) in enumerate(itertools.pairwise(edges)):
            if i:
                self.finish()
            part = slice(begin, end)
            self._put(kind[part], x[part], y[part], t[part], value[part])

    def _starts(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Which of these resets (n,) begin a frame, because the column goes back."""
        if not len(x):
            return np.zeros(0, bool)
        if not self.slow:
            steps = {"x": np.diff(x), "y": np.diff(y)}
            changes = {name: int(np.count_nonzero(step)) for name, step in steps.items()}
            if max(changes.values()) >= SURE:
                self.slow = min(changes, key=lambda name: changes[name])
                self.way = 1 if np.sign(steps[self.slow]).sum() > 0 else -1
        column = x if self.slow != "y" else y
        step = np.diff(column, prepend=column[0] if self.last == NONE else self.last)
        self.last = int(column[-1])
        return step * self.way < 0

    def _put(
        self, kind: np.ndarray, x: np.ndarray, y: np.ndarray, t: np.ndarray, value: np.ndarray
    ) -> None:
        if not self.reads[RESET].count:  # signals whose resets are missing: of an earlier frame
            first = int(np.argmax(kind == RESET)) if (kind == RESET).any() else len(kind)
            self.incomplete += first > 0 and not self.orphaned
            self.orphaned |= first > 0
            kind, x, y, t, value = (column[first:] for column in (kind, x, y, t, value))
        pixels = self.size[0] * self.size[1]
        over = False
        for which, reads in enumerate(self.reads):
            of = np.flatnonzero(kind == which)
            over |= len(of) > pixels - reads.count
            of = of[: pixels - reads.count]  # further ones are of a frame whose resets are missing
            if len(of):
                reads.add(x[of], y[of], t[of], value[of])
        self.incomplete += over
        if min(reads.count for reads in self.reads) >= pixels:
            self.finish()

    def finish(self) -> None:
        """At the end of the file: emit the last frame if it is complete."""
        counts = [reads.count for reads in self.reads]
        complete = min(counts) >= self.size[0] * self.size[1]
        if complete:
            reset, signal = (reads.image(self.size) for reads in self.reads)
            complete = min(int(reset.min()), int(signal.min())) > NONE
        if complete:
            light = reset - signal
            self.dark += int((light < 0).sum())
            frame = np.maximum(light, 0).astype(np.float32) * np.float32(255 / WHITE)
            begin, end = _exposure(*self.reads)
            self.done(frame, round((begin + end) / 2), exposure_us=round(max(end - begin, 0)))
        elif max(counts):
            self.incomplete += 1
        self._clear()

    def notes(self) -> tuple[Note, ...]:
        notes = []
        if self.dark:
            notes.append(Note("frames.dark", f"{self.dark:,} frame values below their "
                             "reset are 0"))
        if self.incomplete:
            notes.append(Note("frames.unused", f"{self.incomplete:,} frames with missing samples "
                             "were left out"))
        if self.outside:
            notes.append(Note("events.unread", f"{self.outside:,} APS samples outside the sensor "
                             "were left out"))
        return tuple(notes)


class _Reads:
    """Samples of one kind, and their times in us."""

    def __init__(self) -> None:
        self.first = self.last = self.total = self.count = 0
        self.parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    def add(self, x: np.ndarray, y: np.ndarray, t: np.ndarray, value: np.ndarray) -> None:
        self.first = self.first if self.count else int(t[0])
        self.last = int(t[-1])
        self.total += int(t.sum())
        self.count += len(t)
        self.parts.append((x, y, value))

    def image(self, size: Size) -> np.ndarray:
        """The values (H, W) int32, `NONE` where there is none."""
        out = np.full(size[::-1], NONE, np.int32)
        for x, y, value in self.parts:
            out[y, x] = value
        return out


def _exposure(resets: _Reads, signals: _Reads) -> tuple[float, float]:
    """Begin and end: the last reset and the first signal, or means over the columns."""
    if resets.last <= signals.first:
        return resets.last, signals.first
    return resets.total / resets.count, signals.total / signals.count
