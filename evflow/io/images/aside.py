"""Frames stored among the events of a file, collected while the events are read.

A frame may follow events of its time by up to `LATE_US`: a file is read that much further than
`stop_s`.
"""

from __future__ import annotations

import collections
import contextlib
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from evflow.checks import Size
from evflow.io.decode.stream import Chunk, Damage, gather
from evflow.io.hints import Hints
from evflow.io.images.event_clock import beside_events
from evflow.io.images.exposures import Stamps
from evflow.io.images.recorded import FrameStack, cut
from evflow.io.images.streams import events_alone
from evflow.notes import Note
from evflow.types import Recording

LATE_US = 1_000_000
MID_EXPOSURE = Note("frames.clock", "frame times are mid-exposure")


class Aside:
    """stack: the frames so far; last: time of the last event so far, us."""

    def __init__(self, path: Path, hints: Hints, size: Size) -> None:
        self.path, self.hints, self.size = path, hints, size
        self.stack = FrameStack(path, size, hints.colour)
        self.last, self.stop, self.begun = 0, sys.maxsize, False

    def append(self, image: np.ndarray, time_us: int, origin: tuple[int, int] = (0, 0),
               exposure_us: int = 0) -> None:
        """Add a frame, as in `FrameStack`."""
        with events_alone():
            self.stack.append(image, time_us, origin, exposure_us)

    def follow(self, t: np.ndarray) -> None:
        """Note the time of events t (n,) us, if `stop_s` is set."""
        if self.hints.stop_s is not None and len(t):
            self.last = self.hints.instant(t[len(t) // 2], "us")  # robust to a single wrong time
            if not self.begun:
                self.begun, self.stop = True, self.hints.span_us(self.hints.instant(t[0], "us"))[1]

    @property
    def done(self) -> bool:
        """Whether all frames from before `stop_s` have arrived."""
        return self.last >= self.stop + LATE_US

    def collect(
        self, chunks: Iterator[Chunk], notes: Callable[[], tuple[Note, ...]] = tuple
    ) -> Recording:
        """The recording of events and frames. `chunks` calls `append` and `follow`, and ends once
        `done`; `notes` is called at the end. Raises what `gather` and `Recording` raise."""
        found = gather(self.path, chunks, self.hints, self.size)
        if self.last >= found.span[1]:
            with contextlib.suppress(Damage):
                collections.deque(chunks, 0)
        collected = (*found.notes, *notes())
        if not self.stack.times:
            return self.stack.beside(found.events, self.hints, collected)
        with events_alone():
            stamps = Stamps(np.array(self.stack.times))
            times = beside_events(stamps, self.path, "us", self.hints, found.events)
            collected = (MID_EXPOSURE, *collected, *times.notes)
            return cut(self.stack.at(times.us, found.events, self.hints, collected), found.span)
