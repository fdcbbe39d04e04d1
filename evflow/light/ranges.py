"""What frames probably hold, judged by their values: DN, or what is often mistaken for DN.

Frames in DN 0..255 nearly always exceed `DARKEST_DN` somewhere. Values that stay below it are
fractions of white, logarithms or radiance; simulated as DN they would be a black video. So would
integers of a few bits stored in 16.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from evflow.errors import EvflowDataError

DARKEST_DN = 8.0  # if no frame exceeds it, they are not DN
DIM_DN = 64.0  # if no frame exceeds it, white may lie elsewhere
FEW_BITS = 4095  # uint16 that no frame exceeds are 12 bits or fewer
MOST_LOG = 6.0  # the logarithm of 255 DN is 5.54
LOG_MEDIAN = 1.0  # logarithms of DN are mostly above it, radiance mostly below
OF_WHITE = ("Pass the value of white: --full-scale {:g} (full_scale=); if they are really that "
            "dark: --full-scale 65535.")
AS_THEY_ARE = "if they are really that dark: --full-scale 255 (full_scale=255)"


class Meaning(NamedTuple):
    """what: what the numbers probably are; fix: what to do about it."""

    what: str
    fix: str


def meaning(frame: np.ndarray) -> Meaning | None:
    """What a finite float frame (or several) probably holds, if not DN 0..255; None also for frames
    that are entirely black."""
    low, high = float(frame.min(initial=0)), float(frame.max(initial=0))
    if low < 0:
        return _negative(frame, low, high)
    if high == 0 or high > DARKEST_DN:
        return None
    if high <= 1:
        return Meaning("floats on 0..1", "Pass --full-scale 1 (full_scale=1), or in Python "
                       f"frames * 255; {AS_THEY_ARE}.")
    if high <= MOST_LOG and float(np.median(frame)) > LOG_MEDIAN:
        return Meaning("logarithms", "Pass --response log (response=\"log\"), or in Python "
                       f"np.exp(frames); radiance: --full-scale {high:.3g}; {AS_THEY_ARE}.")
    return Meaning("radiance", f"Pass the value of white, e.g. --full-scale {high:.3g} "
                   "(full_scale=), or in Python evflow.light.log_maps.to_dn(frames, white); "
                   f"{AS_THEY_ARE}.")


def meaning_of_logs(frame: np.ndarray) -> Meaning | None:
    """What a frame (or several) of logarithms is probably relative to, if not to DN 0..255; None
    for others."""
    high = float(np.exp(min(float(frame.max()), MOST_LOG)))
    if high > DARKEST_DN:
        return None
    fractions = high <= 1.01
    return Meaning(
        f"logarithms of {'fractions of white' if fractions else 'radiance'}",
        f"Pass the value of white: --full-scale {1 if fractions else high:.3g} (full_scale=); "
        f"{AS_THEY_ARE}.")


def likely_white(high: float) -> float:
    """The smallest usual white of integers that is not below `high`."""
    usual = [float(2**bits - 1) for bits in (8, 10, 12, 14, 16)]
    return next((white for white in usual if high <= white), high)


def check_bits(peak: int, fix: str = OF_WHITE) -> None:
    """Raise EV003 if uint16 frames whose largest value is `peak` hold fewer bits than 16; entirely
    black ones pass. fix: the advice, with a place for their likely white."""
    if 0 < peak <= FEW_BITS:
        raise EvflowDataError(
            "EV003", f"no value of the 16-bit frames is above {peak}, where white is 65535.",
            fix.format(likely_white(peak)))


def _negative(frame: np.ndarray, low: float, high: float) -> Meaning:
    if high > DARKEST_DN:
        return Meaning("undershoot of a sharpening filter or a resize beside edges",
                       "Light is not negative: np.clip(frames, 0, None).")
    if low >= -1 and high <= 1 and abs(float(np.median(frame))) < 0.9:
        return Meaning("normalised to -1..1, or logarithms of fractions of white",
                       "Pass (frames + 1) / 2 and --full-scale 1 (full_scale=1); logarithms: "
                       "--response log --full-scale 1, in Python 255 * np.exp(frames).")
    white = "--full-scale 1 " if high <= 0.1 else ""
    return Meaning("logarithms", f"Pass --response log {white}(response=\"log\"), or in Python "
                   f"{'255 * ' if white else ''}np.exp(frames).")
