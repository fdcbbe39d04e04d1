"""How much of a recording was read, and what more would bring."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import Any

from evflow.notes import Note


@dataclasses.dataclass(frozen=True)
class Extent:
    """How much of a recording an estimate has read.

    Attributes:
        read_s: seconds of the recording that were read.
        seconds: seconds that could be read.
        stretches: number of stretches of some frames that were read; 0 if none were selected.
        of: number of stretches in all.
        gain: relative reduction of the pixels' errors if twice as much were read; NaN if not
            evaluated.
        ended: whether reading was stopped from outside.
        again: whether a `CameraEstimator` began again, with the pieces that it had kept.
    """

    read_s: float = 0.0
    seconds: float = 0.0
    stretches: int = 0
    of: int = 0
    gain: float = float("nan")
    ended: bool = False
    again: bool = False

    @property
    def whole(self) -> bool:
        """Whether everything was read."""
        return self.stretches >= self.of

    def notes(self) -> list[Note]:
        """Notes about it; none if everything was read."""
        if self.whole:
            return []
        extent = (f"{self.read_s:.1f} of {self.seconds:.1f} s were read, in {self.stretches} of "
                  f"{self.of} stretches")
        if self.again:
            return [Note("reading.again", f"{extent}: when more moved than at first, the pixels' "
                         "low-pass and the frames' offset were measured again, and what was kept "
                         "of the pieces was read again. Earlier ones are not used.")]
        if self.ended:
            return [Note("reading.ended", f"{extent}: reading was stopped. The estimate uses what "
                         "was read; its errors say how well that determines the camera.")]
        more = (f"; with twice as much the pixels' errors would be {self.gain:.0%} smaller"
                if self.gain == self.gain else "")
        return [Note("reading.part", f"{extent}, those with most activity{more}. "
                     "To read everything: --effort full (effort='full').")]

    def as_dict(self) -> dict[str, Any]:
        """JSON-ready values."""
        gain = self.gain if self.gain == self.gain else None
        return {**dataclasses.asdict(self), "gain": gain}


def covered_s(spans: Iterable[tuple[int, int]]) -> float:
    """Seconds that spans (begin, end) in us cover together. Stretches overlap where a window that
    begins in one ends in the next."""
    covered, done = 0, None
    for begin, end in sorted(spans):
        begin = begin if done is None else max(begin, done)
        covered += max(end - begin, 0)
        done = max(begin, end)
    return covered / 1e6


EVERYTHING = Extent()
