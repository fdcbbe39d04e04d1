"""Infers the unit of times, for readers, files of frame times and checks; no other module does.

Evidence: a unit written in a header or comment; integers, as no event camera counts whole seconds;
dates since 1970; and the rates of events and frames that each unit would imply, compared with those
of real cameras. What is certain is refused by the code that reads the times, EV003 or EV023; what
is only likely is reported by `recordings.check`. Units are three decades apart, rates vary less.
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
UNITS = tuple(UNITS_US)  # each a thousandth of the previous one
CERTAIN = (  # formats whose times come from the camera's own clock
    "aedat2", "aedat3", "aedat4", "aedat", "evt2", "evt2.1", "evt3", "dat", "metavision", "rosbag",
    "rosbag2")
EPOCH_S = (1e9, 4.1e9)  # 2001 to 2099 as seconds since 1970
S_US = 1_000_000
YEAR_S = 31_556_952
LEAST, LATE_S = 10, 1000  # this many integer times, or times this late, are not seconds
BLOCK = 1 << 20  # times examined at a time: they may be memory-mapped

# Events per second and pixel, mean over the whole sensor.
USUAL_HZ = 1.9  # median of many recordings, which have .07 to 52
RARER = {"ns": 3.0}  # log units by which this unit must fit better: cameras' clocks count us
FAST_HZ, SLOW_HZ = 100.0, 1.0  # few sensors send more, or less
LEAST_EVENTS, FEW_EVENTS = 1_000, 100  # enough for the rate to decide; too few to say anything
MOST_HZ = 5_000.0  # no sensor sends as many
STRETCHED_HZ, TICK_US = 0.1, 1_000  # nor so few if anything moves; step of times in stretched units
GAP = 8  # a pause of more than 1/8 of the whole duration is a pause, or a jump of the clock
SLOWEST_HZ = 0.01  # the noise of the quietest sensor alone is seven times as much
LASTING_HZ, FLASH = 1_500.0, 20  # maximum rate after 20 events a pixel: links carry 60 to 1,150

# Seconds between frames.
POSSIBLE_S = (2e-5, 2.0)  # 50,000 frames/s to one in two seconds
USUAL_S = (2.5e-3, 0.125)  # 400 to 8 frames/s: only one of units 1000 apart can lie within
MIDDLE_S = 0.02  # of two units, the one nearer to 50 frames/s

DIGITS = "Export them again as integer microseconds, or as float64 seconds with six decimals."
LOOKS = {-6: "s read as us", -3: "ms read as us", 3: "ns read as us", 6: "us read as s"}
ELSE = {  # the unit to pass, by the power of ten by which times are too long
    -6: "s", -3: "ms (or s if they were read in ms, us if in ns)",
    3: "ns (or ms if they were read in s, us if in ms)",
    6: "us if they were read in s, ns if in ms", 9: "ns if they were read in s"}
NEAR = 0.4  # tolerance in log10 for the ratio of the spans of events and frames
WORDS = re.compile(
    r"(?:[\[(_]|in )(n(?:s|sec|anoseconds?)|[uµμ]s(?:ec)?|microseconds?|m(?:s|sec|illiseconds?)|"
    r"s(?:ec(?:onds?)?)?)\b", re.IGNORECASE)


class Misread(NamedTuple):
    """Times read in a wrong unit: the evidence, the unit to pass, whether it is certain, and
    whether the reader must refuse."""

    seen: str
    unit: str
    certain: bool = True
    asked: bool = False


def written_unit(words: str) -> str:
    """The unit of times in a header or comment ("[ns]", "timestamp_us"), or "auto"."""
    units = {_unit(word.lower()) for word in WORDS.findall(words)}
    return units.pop() if len(units) == 1 else "auto"


def _unit(word: str) -> str:
    if word[0] in "uµμ" or word.startswith("mic"):
        return "us"
    return {"n": "ns", "m": "ms", "s": "s"}[word[0]]


def since_1970(time: float) -> list[str]:
    """The units (at most one) in which a time is a date from 2001 to 2099."""
    return [u for u, us in UNITS_US.items() if EPOCH_S[0] < abs(time) * us / S_US < EPOCH_S[1]]


def video_unit(times: np.ndarray) -> tuple[str | None, dict[str, float]]:
    """The only unit in which times (T,) are those of a video, None if there are several or none;
    and the frames per second in each possible unit."""
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
    """The unit of `units` in which times (T,) make the more usual video; the first if equal."""
    step = usual_step(times)
    if not step > 0:
        return units[0]
    return min(units, key=lambda unit: abs(np.log(step * UNITS_US[unit] / (MIDDLE_S * S_US))))


def usual_step(times: np.ndarray) -> float:
    """The usual step between times (T,); 0 for a single one."""
    return float(np.median(np.diff(times.astype(np.float64)))) if len(times) > 1 else 0.0


def shared_unit(times: np.ndarray, t: np.ndarray, units: list[str]) -> str | None:
    """The unit of `units` in which times (T,) overlap most of the span of events at t (N,) us; the
    first if equal, None if none overlaps."""
    if not (len(times) and len(t)):
        return None

    def shared(unit: str) -> float:
        first, last = (float(v) * UNITS_US[unit] for v in (times.min(), times.max()))
        common = min(last, float(t[-1])) - max(first, float(t[0])) + 1.0
        return max(common, 0.0) / (max(last, float(t[-1])) - min(first, float(t[0])) + 1.0)

    best = max(units, key=shared)
    return best if shared(best) > 0 else None


def likeliest_unit(
    n: int, span: float, pixels: float, first: float = 0.0,
    units: Sequence[str] = tuple(UNITS_US),
) -> tuple[str, str]:
    """The unit of `units` that best explains the times of n events, and the reason in words.

    span: last minus first time, as written; first: the first time, which may be a date.
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
    """Raise EV003 if the first times (N,) of a text, as written, are integers, which seconds are
    not, or later than any date since 1970. pixels: of the sensor, or of the area that events
    reach."""
    last = float(np.nanmax(t, initial=0.0))
    if last >= 2.0**63:  # not times at all, as `stream.gather` will report
        return
    whole = bool((t % 1 == 0).all())
    if not (whole and (len(t) >= LEAST or last >= LATE_S)) and last <= EPOCH_S[1]:
        return
    if whole and since_1970(float(t[0])) == ["s"]:
        raise EvflowDataError(
            "EV003", f"{where}: all times are whole seconds, dates since 1970: their decimals were "
            "lost when they were written.", DIGITS, where=where)
    units = ("ms", "us", "ns") if whole else ("ms", "us")
    unit, why = likeliest_unit(len(t), last - float(np.nanmin(t)), pixels, float(t[0]), units)
    seen = (f"all times are integers ({t[0]:.0f}, ...), not seconds" if whole else
            f"{last:.6f} s is not a time since 1970")
    raise EvflowDataError("EV003", f"{where}: {seen}; {why}.",
                          f"Pass time_unit={unit!r} (--time-unit {unit}).", where=where)


def check_seconds(t_us: np.ndarray, size: Size, read_in: str | None) -> None:
    """Raise EV023 if times that were read in seconds are all whole seconds.

    t_us: (N,) int64, as read; read_in: their unit in the file.
    """
    if read_in != "s" or len(t_us) < LEAST or not all_on(S_US, t_us):
        return
    if since_1970(float(t_us[0]) / S_US) == ["s"]:
        raise EvflowDataError(
            "EV023", f"all {len(t_us):,} event times are whole seconds, dates since 1970: their "
            "decimals were lost when they were written.", DIGITS)
    if t_us[0] == t_us[-1]:
        return
    first, last = int(t_us[0]) // S_US, int(t_us[-1]) // S_US
    unit, why = likeliest_unit(
        len(t_us), last - first, size[0] * size[1], first, ("ms", "us", "ns"))
    raise EvflowDataError(
        "EV023", f"all {len(t_us):,} event times are whole seconds, {first} to {last}: no event "
        f"camera has so coarse a clock; {why}.", f"Pass --time-unit {unit} (time_unit={unit!r}).")


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


def all_on(tick_us: int, t_us: np.ndarray, first: int = 0) -> bool:
    """Whether all times (N,) lie on ticks from `first` on; usually decided by the first few."""
    return not ((t_us[:LEAST] - first) % tick_us).any() and not any(
        ((t_us[at : at + BLOCK] - first) % tick_us).any() for at in range(0, len(t_us), BLOCK))
