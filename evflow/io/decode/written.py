"""How a file stores its times: in which unit, and how precisely.

Readers learn both where they convert times; `watched` passes them on to whoever asked for the file,
because a recording does not keep how its file was written.
"""

from __future__ import annotations

import contextlib
import contextvars
import dataclasses
from collections.abc import Iterator

import numpy as np

from evflow.errors import EvflowDataError
from evflow.io.decode.units import BLOCK, DIGITS, FEW_EVENTS, S_US, UNITS_US, all_on

EXACT_US, LOST_US = 1.0, 10_000.0  # spacing of floats that keeps times, and that loses them
SAMPLED = 256  # times examined first
STEPS_US = (100_000, 10_000, 1_000)  # of times written with few digits


@dataclasses.dataclass
class Written:
    """unit: of the event times in the file, None if it has none; native: that of its format;
    apart_us: spacing of their dtype
    `kind` at such values, 0 if exact."""

    unit: str | None = None
    native: str | None = None
    apart_us: float = 0.0
    kind: str = ""


_WATCHED: contextvars.ContextVar[Written | None] = contextvars.ContextVar("watched", default=None)


@contextlib.contextmanager
def watched() -> Iterator[Written]:
    """What readers find out in this block."""
    found = Written()
    token = _WATCHED.set(found)
    try:
        yield found
    finally:
        _WATCHED.reset(token)


def seen(t: np.ndarray, unit: str, native: str) -> None:
    """Record times (N,) of a file, of any dtype, in that unit; the first unit is the file's.
    native: what it is by the format, if none is given."""
    found = _WATCHED.get()
    if found is None:
        return
    found.unit, found.native = found.unit or unit, found.native or native
    if t.dtype.kind == "f" and t.size:
        apart = float(np.spacing(np.abs(t).max())) * UNITS_US[unit]
        if apart > found.apart_us:
            found.apart_us, found.kind = apart, str(t.dtype)


def coarse(t_us: np.ndarray, written: Written) -> str:
    """What to say about times (N,) int64 us that lie on coarse steps or were stored as floats with
    too wide a spacing; "" if they are fine. EV003 if the spacing is so wide that the times are
    lost.
    """
    apart = written.apart_us
    if apart > LOST_US:
        raise EvflowDataError(
            "EV003", f"times are stored as {written.kind}, which resolves such values to "
            f"{apart / S_US:,.3g} s: the times of events are lost.", DIGITS)
    if apart > EXACT_US:
        return f"times are {written.kind}, with a resolution of {apart:,.3g} us only. {DIGITS}"
    some = t_us[:: max(len(t_us) // SAMPLED, 1)]  # a few decide for most recordings
    if len(t_us) < FEW_EVENTS or t_us[0] == t_us[-1] or ((some - some[0]) % STEPS_US[-1]).any():
        return ""
    for step in STEPS_US:
        if all_on(step, t_us, int(t_us[0])) and _shared(t_us) > 0.5:
            return (f"all times lie on steps of {step // 1000} ms: from a simulator, or written "
                    f"with few digits, so that times in between are lost. {DIGITS}")
    return ""


def _shared(t_us: np.ndarray) -> float:
    """The share of times (N,) that equal the previous one."""
    same = sum(int(np.count_nonzero(t_us[at + 1 : at + BLOCK + 1] == t_us[at : at + BLOCK][
        : len(t_us) - at - 1])) for at in range(0, len(t_us), BLOCK))
    return same / len(t_us)
