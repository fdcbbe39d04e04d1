"""Remove events caused by a frame's readout (recordings/bunches.py) from a pixel's events.

Such an event is no change of light and carries no brightness. Yet the pixel resets its memory at
it, so the regression's constant of a pixel differs before and after.
"""

from __future__ import annotations

import numpy as np

from evflow.estimation.refine.sightings import Sightings, those
from evflow.recordings.bunches import Bunch

Array = np.ndarray


def without_readouts(
    s: Sightings, times_us: Array, found: Bunch | None
) -> tuple[Sightings, Array]:
    """Sightings without readout events, and (N,) the number of readout events before each.

    Args:
        s: all sightings of a stretch.
        times_us: (K + 1,) of the frames.
        found: when readout events come, relative to a frame; None: there are none.
    """
    if found is None:
        return s, np.zeros(len(s.pixel), int)
    length = np.diff(times_us)[s.interval]
    after = s.fraction * length
    before = after - length
    there = (((after >= found.begin_us) & (after < found.end_us))
             | ((before >= found.begin_us) & (before < found.end_us)))
    kept, disturbed = ~there, np.cumsum(there)
    return those(s, kept), disturbed[kept]
