"""Were times read in the wrong unit? Judged by the span of the frames and by the rate of events.

What is certain is refused by the code that reads the times, EV023; what is only likely is reported
by `recordings.check`. units.py infers the unit beforehand.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np

from evflow.errors import EvflowDataError
from evflow.io.decode.units import BLOCK, EPOCH_S, S_US, UNITS_US, all_on
from evflow.io.decode.written import Written, coarse
from evflow.io.hints import Hints
from evflow.notes import Note
from evflow.types import Events, Recording

UNITS = tuple(UNITS_US)  # each a thousandth of the previous one
CERTAIN = (  # formats whose times come from the camera's own clock
    "aedat2", "aedat3", "aedat4", "aedat", "evt2", "evt2.1", "evt3", "dat", "metavision", "rosbag",
    "rosbag2")
YEAR_S = 31_556_952

# Events per second and pixel, mean over the whole sensor.
FAST_HZ, SLOW_HZ = 100.0, 1.0  # few sensors send more, or less
LEAST_EVENTS = 1_000  # enough for the rate to decide
MOST_HZ = 5_000.0  # no sensor sends as many
STRETCHED_HZ, TICK_US = 0.1, 1_000  # nor so few if anything moves; step of times in stretched units
GAP = 8  # a pause of more than 1/8 of the whole duration is a pause, or a jump of the clock
SLOWEST_HZ = 0.01  # the noise of the quietest sensor alone is seven times as much
LASTING_HZ, FLASH = 1_500.0, 20  # maximum rate after 20 events a pixel: links carry 60 to 1,150

LOOKS = {-6: "s read as us", -3: "ms read as us", 3: "ns read as us", 6: "us read as s"}
ELSE = {  # the unit to pass, by the power of ten by which times are too long
    -6: "s", -3: "ms (or s if they were read in ms, us if in ns)",
    3: "ns (or ms if they were read in s, us if in ms)",
    6: "us if they were read in s, ns if in ms", 9: "ns if they were read in s"}
NEAR = 0.4  # tolerance in log10 for the ratio of the spans of events and frames


class Misread(NamedTuple):
    """Times read in a wrong unit: the evidence, the unit to pass, whether it is certain, and
    whether the reader must refuse."""

    seen: str
    unit: str
    certain: bool = True
    asked: bool = False


def doubt(
    events: Events, frame_times: np.ndarray, format: str, read_in: str | None
) -> Misread | None:
    """Evidence against the unit in which a file of that format was read, with the more likely unit;
    None if there is none, or if the format's unit is the camera's own. read_in: the unit of the
    times in the file.

    Raises EV023 if the user must decide: for dates beyond 2099 that another unit makes present
    dates, and for whole milliseconds with events in hardly any pixel.
    """
    if format in CERTAIN or not len(events):
        return None
    first = int(events.t[0])
    if abs(first) > EPOCH_S[1] * S_US and (late := _dated(first)):
        unit = _other(read_in, late)
        raise EvflowDataError(
            "EV023", f"event times begin {abs(first) / S_US / YEAR_S:,.0f} years after 1970; read "
            f"in {unit} they would be dates of this century.", f"Pass --time-unit {unit}.")
    found = misread(events, frame_times, read_in)
    if found and found.asked:
        raise EvflowDataError(
            "EV023", found.seen, f"Pass --time-unit {found.unit}, or, if they are right, the unit "
            f"they are in ({read_in or 'us, s'}).")
    return found


def with_doubts(recording: Recording, format: str, parsed: Hints, written: Written) -> Recording:
    """The recording, with a note if its times are doubtful; EV023 if the user must decide. A unit
    that the user gave is doubted where it is not the format's own."""
    coarseness = coarse(recording.events.t, written)
    given = parsed.time_unit != "auto"
    found = (None if given and parsed.time_unit == written.native else
             misread(recording.events, recording.frame_times, written.unit) if given else
             doubt(recording.events, recording.frame_times, format, written.unit))
    if found is not None:
        note = Note("events.unit", f"{found.seen} If so, pass --time-unit {found.unit}")
    elif coarseness:
        note = Note("events.coarse", coarseness)
    else:
        return recording
    return dataclasses.replace(recording, notes=(*recording.notes, note))


def misread(
    events: Events, frame_times: np.ndarray, read_in: str | None = None
) -> Misread | None:
    """Whether event times contradict the span of the frames, int64 us, or the rates of real
    sensors.
    read_in: the unit in which they were read, if known."""
    if len(events) < 2:
        return None
    span, pixels = max(events.duration_us, 1), events.size[0] * events.size[1]
    rate = len(events) / span * 1e6 / pixels
    if len(frame_times) > 1:
        frames_us = int(frame_times[-1] - frame_times[0])
        ratio = np.log10(span / frames_us)
        for power in (-6, -3, 3, 6):
            # a short excerpt of a long recording has a usual rate
            odd = rate > FAST_HZ if power < 0 else rate < SLOW_HZ
            if odd and abs(ratio - power) < NEAR:
                return Misread(f"events span {span:,} us but frames {frames_us:,} us: the event "
                               f"times look like {LOOKS[power]}.", _other(read_in, power))
    if len(events) < LEAST_EVENTS:
        return None
    if rate > (LASTING_HZ if len(events) > FLASH * pixels else MOST_HZ):
        power = -3 if rate < 1e3 * FAST_HZ else -6
        return Misread(
            f"{len(events):,} events in {span:,} us are {rate:,.0f} per second and pixel, more "
            f"than any sensor sends: the times look like {LOOKS[power]}.", _other(read_in, power))
    if rate >= STRETCHED_HZ:
        return None
    rate = len(events) / max(span - _gaps(events.t, span // GAP), 1) * 1e6 / pixels
    return _stretched(events, rate, read_in) if rate < STRETCHED_HZ else None


def _stretched(events: Events, rate: float, read_in: str | None) -> Misread | None:
    """For times that give few events: are they too long?"""
    power = 3 if rate * 1e3 > SLOWEST_HZ else 6
    unit = _other(read_in, power)
    ticks = all_on(TICK_US, events.t, int(events.t[0]))
    few = (f"{len(events):,} events in {events.duration_us / S_US:,.1f} s are few, {rate:.2g} per "
           f"second and pixel; {10**power:,} times as fast, they would be {rate * 10**power:.3g}")
    if ticks:
        return Misread(
            f"all times are multiples of {TICK_US:,} us: {few}. Or steps of 1 ms of "
            "a simulator.", unit, certain=False, asked=rate < SLOWEST_HZ)
    if rate < SLOWEST_HZ:
        return Misread(f"{few}. Or hardly anything moves, and there is no noise.", unit,
                       certain=False)
    return None


def too_few(count: int, log_change: float) -> Misread:
    """Evidence from too few events (`count`) for frames that change by that many log units."""
    power = 3 if log_change < 1e5 * max(count, 1) else 6
    return Misread(
        f"frames change by up to {log_change:,.0f} log units, as many events even at thresholds of "
        f"1, but only {count:,} events happen in that time.",
        _other(None, power), certain=False)


def _other(read_in: str | None, power: int) -> str:
    """The unit to pass for times that are 10^power too long when read in `read_in`."""
    place = -1 if read_in is None else UNITS.index(read_in) + power // 3
    return UNITS[place] if 0 <= place < len(UNITS) else ELSE[power]


def _dated(first_us: int) -> int:
    """The power of ten by which a time is too long to be a date since 1970; 0 if there is none."""
    return next((power for power in (3, 6, 9)
                 if EPOCH_S[0] < abs(first_us) / 10**power / S_US < EPOCH_S[1]), 0)


def _gaps(t: np.ndarray, longer: int) -> int:
    """The total time in us of pauses longer than `longer` between times (N,)."""
    total = 0
    for at in range(0, len(t), BLOCK):
        between = np.diff(t[at : at + BLOCK + 1])
        total += int(between[between > longer].sum())
    return total
