"""Are times in the unit they were read in? What tells with certainty is refused when a file is
read; what frames and rates tell is found by `evflow.recordings.check`.

An event camera counts microseconds. Times that are all whole seconds are none; in which unit they
make a usual rate of events is a good guess.
"""

from __future__ import annotations

import numpy as np

from evflow.checks import Size
from evflow.errors import EvflowDataError
from evflow.io.hints import UNITS_US

SECONDS = (  # formats whose unit is s
    "e2vid", "event_utils", "evreal", "ijrr", "mvsec", "text", "v2e-text")
USUAL_HZ = 5.0  # events per second and pixel; units are three decades apart
LEAST = 10  # events: fewer may fall on whole seconds by chance
S_US = 1_000_000
BLOCK = 1 << 20  # times looked at at once: they may lie on disk


def check_seconds(t_us: np.ndarray, size: Size, told: str, format: str) -> None:
    """EV023 where times that were read in seconds are all whole ones.

    t_us: (N,) int64, as read; told: the unit asked for, or "auto"; format: its name.
    """
    in_seconds = told == "s" or (told == "auto" and format in SECONDS)
    if not in_seconds or len(t_us) < LEAST or t_us[0] == t_us[-1] or not whole_seconds(t_us):
        return
    first, last = int(t_us[0]) // S_US, int(t_us[-1]) // S_US
    unit, rate = likely_unit(len(t_us), last - first, size)
    raise EvflowDataError(
        "EV023", f"all {len(t_us):,} event times are whole seconds, {first} to {last}: no event "
        f"camera is that coarse. In {unit} they make {rate:.3g} events per second and pixel.",
        f"Pass --time-unit {unit} (time_unit={unit!r}).")


def whole_seconds(t_us: np.ndarray) -> bool:
    """Is every time (N,) a whole second? Most recordings answer at their first events."""
    return not (t_us[:LEAST] % S_US).any() and not any(
        (t_us[first : first + BLOCK] % S_US).any() for first in range(0, len(t_us), BLOCK))


def likely_unit(count: int, span: int, size: Size) -> tuple[str, float]:
    """The unit finer than s in which `count` events within `span` make the most usual rate, and
    that rate per second and pixel."""
    rates = {unit: count / (1e-6 * UNITS_US[unit] * span * size[0] * size[1])
             for unit in ("ms", "us", "ns")}
    return min(rates.items(), key=lambda item: abs(np.log(item[1] / USUAL_HZ)))
