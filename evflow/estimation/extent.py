"""How much of a recording was read, and what more would bring."""

from __future__ import annotations

import dataclasses
from typing import Any

from evflow.notes import Note


@dataclasses.dataclass(frozen=True)
class Extent:
    """How much of a recording an estimate has read.

    Attributes:
        read_s: seconds of the recording that were read.
        seconds: seconds of it that could be.
        stretches: how many stretches of some frames were read; 0 where nothing was chosen.
        of: how many there are.
        gain: share by which the pixels' errors would shrink were twice as much read; NaN where
            that was not looked at.
        ended: whether reading was ended from outside.
    """

    read_s: float = 0.0
    seconds: float = 0.0
    stretches: int = 0
    of: int = 0
    gain: float = float("nan")
    ended: bool = False

    @property
    def whole(self) -> bool:
        """Whether everything was read."""
        return self.stretches >= self.of

    def notes(self) -> list[Note]:
        """What to know of it: nothing where everything was read."""
        if self.whole:
            return []
        told = (f"{self.read_s:.1f} of {self.seconds:.1f} s were read, in {self.stretches} of "
                f"{self.of} stretches")
        if self.ended:
            return [Note("reading.ended", f"{told}: reading was ended. The estimate is that of "
                         "what was read; its errors say how well that tells it.")]
        more = (f"; with twice as much the pixels' errors would be {self.gain:.0%} smaller"
                if self.gain == self.gain else "")
        return [Note("reading.part", f"{told}, those in which most happens{more}. "
                     "All is read with --effort full (effort='full').")]

    def as_dict(self) -> dict[str, Any]:
        """JSON-ready values."""
        gain = self.gain if self.gain == self.gain else None
        return {**dataclasses.asdict(self), "gain": gain}


EVERYTHING = Extent()
