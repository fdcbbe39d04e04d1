"""What the times of frames are wrong by, from the delay of the events behind them.

Slow pixels delay events too, but they also blur them: to second order, a low-pass of time constant
tau has a delay of tau and takes 12 tau^2 off the square of the frames' exposure. And most are
slower in the dark. What neither explains of the delay is an error of the frame times. If it grows
from row to row, or from column to column, so the frames are read (a rolling shutter).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from evflow.estimation.refine.frame_exposure import ON_TIME, Late

CLEARLY, BIAS = 3.0, 70e6  # std of a square of lengths (us^2) that are none; its error in a scene
LATE_STD_US = 700.0  # std beside the scatter, of a delay
DARK_STD_US = 300.0  # std beside the scatter, of how much longer the delay is in the dark
LEAST_LATE_US = 4000.0  # beyond slow pixels, as far as their blur and the dark tell them
OPEN = 0.5  # share of it that a time constant may be longer than its blur tells: long ones are
SLOW = 12.0  # square of the length over that of the delay, of a low-pass of first order
TOLERANCE = 1.1  # of the interval between frames, which no exposure exceeds
LEAST_ROLLING_US, CLEARLY_ROLLING = 5000.0, 5.0  # from side to side; in std

WithError = tuple[float, float]  # value and error


class Seen(NamedTuple):
    """delay_us: of the events behind the frames; darker_us: how much longer it is in the darker
    half; square: of the exposure's length, less what is told of it, us^2; longer: share of the
    delay of slow pixels by which it would be longer in the darker half."""

    delay_us: WithError
    darker_us: WithError
    square: WithError
    longer: float


def late(seen: Seen, interval_us: float) -> tuple[float, Late]:
    """What slow pixels leave of the delay (us), and whether frame times are wrong by it.
    interval_us: between frames of untold exposure, else 0."""
    delay_us, error_us = seen.delay_us
    error = float(np.hypot(seen.square[1], BIAS))
    less = max(-seen.square[0], 0.0)
    less *= less**2 / (less**2 + error**2)  # of little, little is believed
    tau_us, open_us = np.sqrt(less / SLOW), np.sqrt(error / SLOW)
    left_us = delay_us - float(tau_us)
    if delay_us > 0.0 and seen.longer > 0.0:
        left_us = min(left_us, delay_us - seen.darker_us[0] / seen.longer)
    std_us = float(np.hypot(error_us, LATE_STD_US))
    if abs(delay_us) <= CLEARLY * std_us:
        return left_us, ON_TIME
    stated_us = float(np.hypot(std_us, error / (2.0 * SLOW * max(tau_us, open_us))))
    if delay_us < 0.0:
        return left_us, Late(1e-6 * left_us, 1e-6 * stated_us)
    more = seen.square[0] + SLOW * delay_us**2  # than the square less what pixels as slow take
    missing_us = seen.longer * delay_us - seen.darker_us[0]
    if (left_us < LEAST_LATE_US + OPEN * tau_us or more <= CLEARLY * error
            or missing_us <= CLEARLY * float(np.hypot(seen.darker_us[1], DARK_STD_US))):
        return left_us, ON_TIME
    alike_us = float(np.sqrt(more))
    possible = alike_us < TOLERANCE * interval_us
    return left_us, Late(1e-6 * left_us, 1e-6 * stated_us,
                         1e-6 * min(alike_us, interval_us) * possible)


def is_rolling(sloping_us: float, error_us: float) -> bool:
    """Whether the delay grows from one side of the frames to the other by so much as if they were
    read row by row, or column by column."""
    return abs(sloping_us) > max(LEAST_ROLLING_US, CLEARLY_ROLLING * error_us)
