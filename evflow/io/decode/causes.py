"""Probable causes of invalid values among a file's events, and what to do, for error messages."""

from __future__ import annotations

import numpy as np

from evflow.checks import Size


def why_no_polarity(p: np.ndarray) -> str:
    """What values (N,) that are no polarity probably mean."""
    fix = {(0, 255): "Is 255 ON? Write p > 0.",
           (1, 255): "A -1 stored as unsigned reads as 255: p.astype(np.int8).",
           (1, 2): "Does it count from 1, and is 2 ON? Write p - 1."}
    values = tuple(np.unique(p[np.isfinite(p)])[:3].tolist())
    return "Polarity must be 0 or 1, or -1 or 1. " + fix.get(
        values, "Is it the right column, without the bits of other fields?")


def why_outside(x: np.ndarray, y: np.ndarray, size: Size) -> str:
    """Why some of the events at x, y (N,) might lie outside the sensor."""
    width, height = size
    least, right, low = min(int(x.min()), int(y.min())), int(x.max()), int(y.max())
    if least < 0:
        return ("No pixel is below 0: were they undistorted or shifted? Use raw ones. In AEDAT 2 "
                "the size is wrong: pass size=(width, height), --size WxH")
    if least > 0 and right <= width and low <= height:
        return ("Do coordinates start at 1, as in MATLAB? Subtract 1; if the sensor is larger, "
                "pass size=(width, height), --size WxH")
    if right < height and low < width:
        return ("Height before width, or x and y swapped in the file? If the former, pass "
                f"size=({height}, {width}), --size {height}x{width}")
    return ("Wrong size? Pass size=(width, height), --size WxH; if the size is right, the file is "
            "damaged: copy it again")
