"""Events of a frame's readout among those of a pixel: they part what came before from what follows.

Such an event (recordings/bunches.py) is no change of light, and says neither how far brightness
moved nor where it was; yet the pixel stores something at it, so that its constant is another after.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from evflow.estimation.refine.sightings import Sightings
from evflow.recordings.bunches import Bunch

Array = np.ndarray


def beside_readouts(
    s: Sightings, times_us: Array, found: Bunch | None
) -> tuple[Sightings, Array]:
    """The sightings that do not come with a readout, and (N,) how many of their pixel's events
    that do came before each. times_us: (K + 1,) of the frames."""
    if found is None:
        return s, np.zeros(len(s.pixel), int)
    length = np.diff(times_us)[s.interval]
    after = s.fraction * length
    before = after - length
    there = (((after >= found.begin_us) & (after < found.end_us))
             | ((before >= found.begin_us) & (before < found.end_us)))
    kept, disturbed = ~there, np.cumsum(there)
    pixel = s.pixel[kept]
    others = {name: getattr(s, name)[kept]
              for name in ("number", "interval", "fraction", "on", "path")}
    first = np.flatnonzero(np.diff(pixel, prepend=-1))
    return dataclasses.replace(s, pixel=pixel, first=first, **others), disturbed[kept]
