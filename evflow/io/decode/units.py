"""In which unit are these times? Judged here alone, for readers, files of frame times and checks.

What tells: a unit written in a header or comment; whole numbers, as no event camera counts whole
seconds; dates since 1970; and how many events and frames a second each unit would make, against
the rates that cameras have. What is certain is refused by whoever reads the times, EV003 or EV023;
what is merely likely, `recordings.check` reports. Units are three decades apart, rates are not.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from evflow.checks import Size
from evflow.errors import EvflowDataError
from evflow.types import Events

UNITS_US = {"s": 1e6, "ms": 1e3, "us": 1.0, "ns": 1e-3}
UNITS = tuple(UNITS_US)  # each a thousandth of the one before
CERTAIN = (  # formats whose times are the camera's own
    "aedat2", "aedat3", "aedat4", "aedat", "evt2", "evt2.1", "evt3", "dat", "metavision", "rosbag",
    "rosbag2")
EPOCH_S = (1e9, 4.1e9)  # 2001 to 2099 as seconds since 1970
S_US = 1_000_000
YEAR_S = 31_556_952
LEAST, LATE_S = 10, 1000  # whole times: so many, or so late, are no seconds
BLOCK = 1 << 20  # times looked at at once: they may lie on disk

# Events per second and pixel, mean of a whole sensor.
USUAL_HZ = 1.9  # amid the recordings at hand, .07 to 52
RARER = {"ns": 3.0}  # log units by which that must fit better: the clocks of cameras count us
FAST_HZ, SLOW_HZ = 100.0, 1.0  # few sensors send more, or less
LEAST_EVENTS, FEW_EVENTS = 1_000, 100  # of which the rate alone tells; of which it says nothing
MOST_HZ = 5_000.0  # none sends as many
STRETCHED_HZ, TICK_US = 0.1, 1_000  # nor so few where anything moves; times of a us, stretched
GAP = 8  # a pause of so large a part of all the time is one, or a jump to another clock
SLOWEST_HZ = 0.01  # the quietest sensor's noise alone is seven times as much
LASTING_HZ, FLASH = 1_500.0, 20  # nor, after 20 events a pixel, this: links carry 60 to 1,150

# Seconds between frames.
POSSIBLE_S = (2e-5, 2.0)  # 50,000 frames/s to one in two seconds
USUAL_S = (2.5e-3, 0.125)  # 400 to 8 frames/s, where only one unit of 1000 can fall
MIDDLE_S = 0.02  # of two units the one nearer to 50 frames/s

DIGITS = "Write them again as whole microseconds, or as float64 seconds with six decimals."
LOOKS = {-6: "s read as us", -3: "ms read as us", 3: "ns read as us", 6: "us read as s"}
ELSE = {  # the unit to pass, by the power of ten by which times are too long
    -6: "s", -3: "ms (or s where they were read in ms, us where in ns)",
    3: "ns (or ms where they were read in s, us where in ms)",
    6: "us where they were read in s, ns where in ms", 9: "ns where they were read in s"}
NEAR = 0.4  # of log10: the ratio of two spans of one recording, events and frames
WORDS = re.compile(
    r"(?:[\[(_]|in )(n(?:s|sec|anoseconds?)|[uµμ]s(?:ec)?|microseconds?|m(?:s|sec|illiseconds?)|"
    r"s(?:ec(?:onds?)?)?)\b", re.IGNORECASE)


class Misread(NamedTuple):
    """Times read in a wrong unit: what tells it, the unit to pass, whether it is certain, and
    whether a reader must ask."""

    seen: str
    unit: str
    certain: bool = True
    asked: bool = False


def written_unit(words: str) -> str:
    """The unit of times that a header or comment tells ("[ns]", "timestamp_us"), or "auto"."""
    units = {_unit(word.lower()) for word in WORDS.findall(words)}
    return units.pop() if len(units) == 1 else "auto"


def _unit(word: str) -> str:
    if word[0] in "uµμ" or word.startswith("mic"):
        return "us"
    return {"n": "ns", "m": "ms", "s": "s"}[word[0]]


def since_1970(time: float) -> list[str]:
    """The units, one at most, in which a time is a date from 2001 to 2099."""
    return [u for u, us in UNITS_US.items() if EPOCH_S[0] < abs(time) * us / S_US < EPOCH_S[1]]


def video_unit(times: np.ndarray) -> tuple[str | None, dict[str, float]]:
    """The only unit in which times (T,) are those of a video, None where none is the only one; and
    the frames per second in each unit that is possible."""
    step = usual_step(times)
    whole = times.dtype.kind in "iu" or bool((times % 1 == 0).all())
    seconds = {unit: 1e-6 * us * step for unit, us in UNITS_US.items()}
    possible = [u for u, s in seconds.items() if POSSIBLE_S[0] <= s <= POSSIBLE_S[1]
                and (whole or u in ("s", "ms"))]
    usual = [u for u in possible if USUAL_S[0] <= seconds[u] <= USUAL_S[1]]
    dated = set(since_1970(float(times[0]))) & set(possible)
    only = [next(iter(found)) for found in (dated, possible, usual) if len(found) == 1]
    return only[0] if only else None, {u: 1 / seconds[u] for u in possible}


def usual_unit(times: np.ndarray, units: list[str]) -> str:
    """That of `units` which makes times (T,) the more usual video, the first of several."""
    step = usual_step(times)
    if not step > 0:
        return units[0]
    return min(units, key=lambda unit: abs(np.log(step * UNITS_US[unit] / (MIDDLE_S * S_US))))


def usual_step(times: np.ndarray) -> float:
    """Between times (T,), as they usually are; 0 of one."""
    return float(np.median(np.diff(times.astype(np.float64)))) if len(times) > 1 else 0.0


def shared_unit(times: np.ndarray, t: np.ndarray, units: list[str]) -> str | None:
    """That of `units` in which times (T,) share most of the span of events at t (N,) us, the first
    of several; None where none shares any."""
    if not (len(times) and len(t)):
        return None

    def shared(unit: str) -> float:
        first, last = (float(v) * UNITS_US[unit] for v in (times.min(), times.max()))
        common = min(last, float(t[-1])) - max(first, float(t[0])) + 1.0
        return max(common, 0.0) / (max(last, float(t[-1])) - min(first, float(t[0])) + 1.0)

    best = max(units, key=shared)
    return best if shared(best) > 0 else None


def spoken_for(
    n: int, span: float, pixels: float, first: float = 0.0,
    units: Sequence[str] = tuple(UNITS_US),
) -> tuple[str, str]:
    """That of `units` for which the numbers of n events speak, and the words that say why.

    span: from the first time to the last, as written; first: the first time, which may be a date.
    """
    dated = [unit for unit in since_1970(first) if unit in units]
    if dated:
        return dated[0], f"in {dated[0]} they are dates since 1970"
    lasting = {unit: 1e-6 * UNITS_US[unit] * max(span, 1e-9) for unit in units}  # s
    rates = {unit: n / (s * pixels) for unit, s in lasting.items()}
    best, other = sorted(rates, key=lambda unit: (
        (n < FEW_EVENTS and unit != "us"),
        abs(np.log(rates[unit] / USUAL_HZ)) + RARER.get(unit, 0.0)))[:2]
    return best, (f"in {best} they last {lasting[best]:,.4g} s and make {rates[best]:.3g} events "
                  f"per second and pixel, in {other} {lasting[other]:,.4g} s and "
                  f"{rates[other]:.3g}")


def check_text_seconds(t: np.ndarray, where: object, pixels: float) -> None:
    """EV003 where the first times (N,) of a text, as written, are whole numbers, which seconds are
    not, or later than any seconds since 1970. pixels: of the sensor, or of what events reach."""
    last = float(np.nanmax(t, initial=0.0))
    if last >= 2.0**63:  # no times at all, as `stream.gather` tells
        return
    whole = bool((t % 1 == 0).all())
    if not (whole and (len(t) >= LEAST or last >= LATE_S)) and last <= EPOCH_S[1]:
        return
    if whole and since_1970(float(t[0])) == ["s"]:
        raise EvflowDataError(
            "EV003", f"{where}: all times are whole seconds, dates since 1970: the digits behind "
            "were lost when they were written.", DIGITS, where=where)
    units = ("ms", "us", "ns") if whole else ("ms", "us")
    unit, why = spoken_for(len(t), last - float(np.nanmin(t)), pixels, float(t[0]), units)
    seen = (f"all times are whole numbers ({t[0]:.0f}, ...), not seconds" if whole else
            f"{last:.6f} s are no time since 1970")
    raise EvflowDataError("EV003", f"{where}: {seen}; {why}.",
                          f"Pass time_unit={unit!r} (--time-unit {unit}).", where=where)


def check_seconds(t_us: np.ndarray, size: Size, read_in: str | None) -> None:
    """EV023 where times that were read in seconds are all whole ones.

    t_us: (N,) int64, as read; read_in: their unit in the file.
    """
    if read_in != "s" or len(t_us) < LEAST or not all_on(S_US, t_us):
        return
    if since_1970(float(t_us[0]) / S_US) == ["s"]:
        raise EvflowDataError(
            "EV023", f"all {len(t_us):,} event times are whole seconds, dates since 1970: the "
            "digits behind were lost when they were written.", DIGITS)
    if t_us[0] == t_us[-1]:
        return
    first, last = int(t_us[0]) // S_US, int(t_us[-1]) // S_US
    unit, why = spoken_for(len(t_us), last - first, size[0] * size[1], first, ("ms", "us", "ns"))
    raise EvflowDataError(
        "EV023", f"all {len(t_us):,} event times are whole seconds, {first} to {last}: no event "
        f"camera is that coarse; {why}.", f"Pass --time-unit {unit} (time_unit={unit!r}).")


def doubt(
    events: Events, frame_times: np.ndarray, format: str, read_in: str | None
) -> Misread | None:
    """What speaks against the unit in which a file of that format was read, with the unit that
    speaks for itself; None where nothing does, or the format's unit is the camera's own. read_in:
    the unit of the times in the file.

    Raises EV023 where the question must be answered: dates beyond 2099 that another unit makes
    dates of today; and whole milliseconds of which hardly any pixel has events.
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
            "EV023", found.seen, f"Pass --time-unit {found.unit}; if they are right, the unit in "
            f"which they are ({read_in or 'us, s'}).")
    return found


def misread(
    events: Events, frame_times: np.ndarray, read_in: str | None = None
) -> Misread | None:
    """Whether event times contradict the span of the frames, int64 us, or the rates of sensors.
    read_in: the unit in which they were read, where that is known."""
    if len(events) < 2:
        return None
    span, pixels = max(events.duration_us, 1), events.size[0] * events.size[1]
    rate = len(events) / span * 1e6 / pixels
    if len(frame_times) > 1:
        frames_us = int(frame_times[-1] - frame_times[0])
        ratio = np.log10(span / frames_us)
        for power in (-6, -3, 3, 6):
            # a short cut of a long recording has a usual rate
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
            f"than a sensor sends: the times look like {LOOKS[power]}.", _other(read_in, power))
    if rate >= STRETCHED_HZ:
        return None
    rate = len(events) / max(span - _gaps(events.t, span // GAP), 1) * 1e6 / pixels
    return _stretched(events, rate, read_in) if rate < STRETCHED_HZ else None


def _stretched(events: Events, rate: float, read_in: str | None) -> Misread | None:
    """Of times that make few events: are they too long?"""
    power = 3 if rate * 1e3 > SLOWEST_HZ else 6
    unit = _other(read_in, power)
    ticks = all_on(TICK_US, events.t, int(events.t[0]))
    few = (f"{len(events):,} events in {events.duration_us / S_US:,.1f} s are few, {rate:.2g} per "
           f"second and pixel; {10**power:,} times as fast they would be {rate * 10**power:.3g}")
    if ticks:
        return Misread(
            f"all times are {TICK_US:,} us apart or multiples of that: {few}. Or steps of 1 ms of "
            "a simulator.", unit, certain=False, asked=rate < SLOWEST_HZ)
    if rate < SLOWEST_HZ:
        return Misread(f"{few}. Or nearly nothing moves, and there is no noise.", unit,
                       certain=False)
    return None


def too_few(count: int, log_change: float) -> Misread:
    """What `count` events say where frames change by that many log units: times are stretched."""
    power = 3 if log_change < 1e5 * max(count, 1) else 6
    return Misread(
        f"frames change by {log_change:,.0f} log units where they change most, which is as many "
        f"events at thresholds of 1, but {count:,} events happen meanwhile.",
        _other(None, power), certain=False)


def _other(read_in: str | None, power: int) -> str:
    """The unit of times that are 10^power times too long as they were read, in `read_in`."""
    place = -1 if read_in is None else UNITS.index(read_in) + power // 3
    return UNITS[place] if 0 <= place < len(UNITS) else ELSE[power]


def _dated(first_us: int) -> int:
    """By which power of ten a time is too long to be a date since 1970; 0 where none makes it."""
    return next((power for power in (3, 6, 9)
                 if EPOCH_S[0] < abs(first_us) / 10**power / S_US < EPOCH_S[1]), 0)


def _gaps(t: np.ndarray, longer: int) -> int:
    """The time in us without events, between times (N,) further apart than `longer`."""
    total = 0
    for at in range(0, len(t), BLOCK):
        between = np.diff(t[at : at + BLOCK + 1])
        total += int(between[between > longer].sum())
    return total


def all_on(tick_us: int, t_us: np.ndarray, first: int = 0) -> bool:
    """Do all times (N,) lie on ticks from `first` on? Most recordings answer at their first."""
    return not ((t_us[:LEAST] - first) % tick_us).any() and not any(
        ((t_us[at : at + BLOCK] - first) % tick_us).any() for at in range(0, len(t_us), BLOCK))
