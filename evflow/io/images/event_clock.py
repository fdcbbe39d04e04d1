"""Times of frames that a file stores with its events, on the events' clock."""

from __future__ import annotations

import numpy as np

from evflow.io.decode.units import UNITS_US, other_unit, shared_unit, usual_unit
from evflow.io.hints import Hints
from evflow.io.images.exposures import Stamps
from evflow.io.images.times import FrameTimes, to_us
from evflow.notes import Note
from evflow.types import Events


def beside_events(
    stamps: Stamps, where: object, native: str, hints: Hints, events: Events
) -> FrameTimes:
    """Times of the frames stored with a recording's events in us, and a note if their unit was
    inferred.

    native: their unit in the format; if in it they fall beside the events, that in which they fall
    among them. The unit in `hints` is that of the events; frames share it, unless another unit
    makes their span agree with the events'. Fractions in a unit of integers indicate the unit that
    allows them. Raises as `to_us`.
    """
    times, asked = stamps.times, hints.time_unit
    odd = times.dtype.kind == "f" and native != "s"
    usual = asked == "auto" and not odd
    numbers = times.ndim == 1 and times.dtype.kind in "iuf" and bool(np.isfinite(times).all())
    other = other_unit(times, events.t, native) if usual and numbers else None
    if not numbers or (usual and other is None):
        unit = native if asked == "auto" else asked
        return FrameTimes(hints.microseconds(times, native), stamps.notes, stamps.exposure_us(unit))
    units = [other] if other else [native, *UNITS_US] if asked == "auto" else [asked, native]
    shared = shared_unit(times, events.t, units)
    if shared is None and asked == "auto":
        return to_us(stamps, where)
    unit = shared or usual_unit(times, units)
    notes = stamps.notes if unit == asked else (*stamps.notes, Note(
        "frames.unit", f"frame times of {where} were read in {unit}."))
    return FrameTimes(
        Hints(time_unit=unit).microseconds(times, unit), notes, stamps.exposure_us(unit))
