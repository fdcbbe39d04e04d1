"""Is this recording what it claims to be? Each rule examines a whole `Recording` and reports.

    findings.py   Finding and Report: what was seen, what it means, the option that fixes it
    steps.py      changes between frames, and how well events follow them
    agreement.py  rules on that: polarity, alignment, mirrored, displaced and frozen frames
    clocks.py     time unit, gaps, jumps, dropped frames
    contents.py   polarities, amount of events, repeated events, hot pixels
    images.py     saturated, black, repeated frames; bit depth, colour

What no `Recording` can be (unsorted, outside the sensor, NaN, wrong shape) is refused at
construction, with codes of the same list. NumPy only: checking never loads JAX.
"""

from evflow.recordings.check.agreement import frames_offset
from evflow.recordings.check.findings import Finding, Report
from evflow.recordings.check.rules import check

__all__ = ["Finding", "Report", "check", "frames_offset"]
