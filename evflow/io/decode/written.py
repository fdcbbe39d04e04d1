"""How a file writes its times: in which unit, and how exactly.

A reader comes upon both where it converts times; whoever asked for the file hears of it by
`watched`, as no recording keeps how its file was written.
"""

from __future__ import annotations

import contextlib
import contextvars
import dataclasses
from collections.abc import Iterator

import numpy as np

from evflow.errors import EvflowDataError
from evflow.io.decode.units import BLOCK, DIGITS, FEW_EVENTS, S_US, UNITS_US, all_on

EXACT_US, LOST_US = 1.0, 10_000.0  # floats so far apart keep times, or lose them
SAMPLED = 256  # times looked at first
STEPS_US = (100_000, 10_000, 1_000)  # of times that were written with few digits


@dataclasses.dataclass
class Written:
    """unit: of the times of events in the file, None where there are none; apart_us: how far apart
    their dtype `kind` holds such numbers, 0 where it is exact."""

    unit: str | None = None
    apart_us: float = 0.0
    kind: str = ""


_WATCHED: contextvars.ContextVar[Written | None] = contextvars.ContextVar("watched", default=None)


@contextlib.contextmanager
def watched() -> Iterator[Written]:
    """What readers come upon in this block."""
    found = Written()
    token = _WATCHED.set(found)
    try:
        yield found
    finally:
        _WATCHED.reset(token)


def seen(t: np.ndarray, unit: str) -> None:
    """Times (N,) of a file, of any dtype, in that unit; the first unit is the file's."""
    found = _WATCHED.get()
    if found is None:
        return
    found.unit = found.unit or unit
    if t.dtype.kind == "f" and t.size:
        apart = float(np.spacing(np.abs(t).max())) * UNITS_US[unit]
        if apart > found.apart_us:
            found.apart_us, found.kind = apart, str(t.dtype)


def coarse(t_us: np.ndarray, written: Written) -> str:
    """What is said of times (N,) int64 us that lie on coarse steps, or were written as floats too
    far apart; "" where they are fine. EV003 where these are so far apart that the times are lost.
    """
    apart = written.apart_us
    if apart > LOST_US:
        raise EvflowDataError(
            "EV003", f"times are {written.kind}, which at such numbers is exact to "
            f"{apart / S_US:,.3g} s only: when anything happened is lost.", DIGITS)
    if apart > EXACT_US:
        return f"times are {written.kind}, at such numbers exact to {apart:,.3g} us only. {DIGITS}"
    some = t_us[:: max(len(t_us) // SAMPLED, 1)]  # most recordings answer by a few
    if len(t_us) < FEW_EVENTS or t_us[0] == t_us[-1] or ((some - some[0]) % STEPS_US[-1]).any():
        return ""
    for step in STEPS_US:
        if all_on(step, t_us, int(t_us[0])) and _shared(t_us) > 0.5:
            return (f"all times lie on steps of {step // 1000} ms: of a simulator, or written with "
                    f"few digits, and what happens in between is lost. {DIGITS}")
    return ""


def _shared(t_us: np.ndarray) -> float:
    """The share of times (N,) that are that of the event before."""
    same = sum(int(np.count_nonzero(t_us[at + 1 : at + BLOCK + 1] == t_us[at : at + BLOCK][
        : len(t_us) - at - 1])) for at in range(0, len(t_us), BLOCK))
    return same / len(t_us)
