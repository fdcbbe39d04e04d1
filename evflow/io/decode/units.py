"""In which unit are these times? Judged here alone, for readers, files of frame times and checks.

What tells: a unit written in a header or comment; whole numbers, as no event camera counts whole
seconds; dates since 1970; and how many events and frames a second each unit would make, against
the rates that cameras have. What is certain is refused by whoever reads the times, EV003 or EV023;
what is merely likely, `recordings.check` reports. Units are three decades apart, rates are not.
"""

from __future__ import annotations

import re
from typing import NamedTuple

import numpy as np

from evflow.checks import Size
from evflow.errors import EvflowDataError
from evflow.types import Events

UNITS_US = {"s": 1e6, "ms": 1e3, "us": 1.0, "ns": 1e-3}
SECONDS = (  # formats whose unit is s
    "e2vid", "event_utils", "evreal", "ijrr", "mvsec", "text", "v2e-text")
EPOCH_S = (1e9, 4.1e9)  # 2001 to 2099 as seconds since 1970
S_US = 1_000_000
LEAST, LATE_S = 10, 1000  # whole times: so many, or so late, are no seconds
BLOCK = 1 << 20  # times looked at at once: they may lie on disk

# Events per second and pixel, mean of a whole sensor.
USUAL_HZ = 5.0
FAST_HZ, SLOW_HZ = 100.0, 1.0  # few sensors send more, or less
LEAST_EVENTS = 1_000  # of which the rate alone tells
MOST_HZ = 5_000.0  # none sends as many
STRETCHED_HZ, TICK_US = 0.1, 1_000  # nor so few where anything moves; times of a us, stretched
LASTING_HZ, FLASH = 1_500.0, 20  # nor, after 20 events a pixel, this: links carry 60 to 1,150

# Seconds between frames.
POSSIBLE_S = (2e-5, 2.0)  # 50,000 frames/s to one in two seconds
USUAL_S = (2.5e-3, 0.125)  # 400 to 8 frames/s, where only one unit of 1000 can fall
MIDDLE_S = 0.02  # of two units the one nearer to 50 frames/s

MISREAD = {  # log10 of (span as read) / (true span): what the times look like, and the option
    -6: ("s read as us", "s"), -3: ("ms read as us", "ms"),
    3: ("ns read as us", "ns (or ms where they were read in s, us where in ms)"),
    6: ("us read as s", "us")}
NEAR = 0.4  # of log10: the ratio of two spans of one recording, events and frames
WORDS = re.compile(
    r"(?:[\[(_]|in )(n(?:s|sec|anoseconds?)|[uµμ]s(?:ec)?|microseconds?|m(?:s|sec|illiseconds?)|"
    r"s(?:ec(?:onds?)?)?)\b", re.IGNORECASE)


class Misread(NamedTuple):
    """Times read in a wrong unit: what tells it, the unit to pass, and whether it is certain."""

    seen: str
    unit: str
    certain: bool = True


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


def check_text_seconds(t: np.ndarray, where: object) -> None:
    """EV003 where the first times (N,) of a text, as written, are whole numbers, which seconds are
    not, or later than any seconds since 1970."""
    last = float(np.nanmax(t, initial=0.0))
    if last >= 2.0**63:  # no times at all, as `stream.gather` tells
        return
    if bool((t % 1 == 0).all()) and (len(t) >= LEAST or last >= LATE_S):
        raise EvflowDataError(
            "EV003", f"{where}: all times are whole numbers ({t[0]:.0f}, ...), not seconds.",
            "Microseconds? Pass time_unit='us' (--time-unit us).")
    if last > EPOCH_S[1]:
        raise EvflowDataError(
            "EV003", f"{where}: {last:.6f} s are no time since 1970.",
            "Milliseconds, or microseconds? Pass time_unit='ms' or 'us' (--time-unit).")


def check_seconds(t_us: np.ndarray, size: Size, told: str, format: str) -> None:
    """EV023 where times that were read in seconds are all whole ones.

    t_us: (N,) int64, as read; told: the unit asked for, or "auto"; format: its name.
    """
    in_seconds = told == "s" or (told == "auto" and format in SECONDS)
    if not in_seconds or len(t_us) < LEAST or t_us[0] == t_us[-1] or not _all_on(S_US, t_us):
        return
    first, last = int(t_us[0]) // S_US, int(t_us[-1]) // S_US
    rates = {unit: len(t_us) / (1e-6 * UNITS_US[unit] * (last - first) * size[0] * size[1])
             for unit in ("ms", "us", "ns")}
    unit = min(rates, key=lambda unit: abs(np.log(rates[unit] / USUAL_HZ)))
    raise EvflowDataError(
        "EV023", f"all {len(t_us):,} event times are whole seconds, {first} to {last}: no event "
        f"camera is that coarse. In {unit} they make {rates[unit]:.3g} events per second and "
        "pixel.", f"Pass --time-unit {unit} (time_unit={unit!r}).")


def misread(events: Events, frame_times: np.ndarray) -> Misread | None:
    """Whether event times contradict the span of the frames, int64 us, or the rates of sensors."""
    if len(events) < 2:
        return None
    span, pixels = max(events.duration_us, 1), events.size[0] * events.size[1]
    rate = len(events) / span * 1e6 / pixels
    if len(frame_times) > 1:
        frames_us = int(frame_times[-1] - frame_times[0])
        ratio = np.log10(span / frames_us)
        for power, (what, unit) in MISREAD.items():
            # a short cut of a long recording has a usual rate
            odd = rate > FAST_HZ if power < 0 else rate < SLOW_HZ
            if odd and abs(ratio - power) < NEAR:
                return Misread(f"events span {span:,} us but frames {frames_us:,} us: the event "
                               f"times look like {what}.", unit)
    if len(events) < LEAST_EVENTS:
        return None
    if rate > (LASTING_HZ if len(events) > FLASH * pixels else MOST_HZ):
        return Misread(
            f"{len(events):,} events in {span:,} us are {rate:,.0f} per second and pixel, more "
            "than a sensor sends: milliseconds read as microseconds?", "ms (or s)")
    if rate < STRETCHED_HZ and _all_on(TICK_US, events.t, int(events.t[0])):
        return Misread(
            f"all times are {TICK_US:,} us apart or multiples of that, and {rate:.2g} events per "
            "second and pixel are few: times a thousand times too long? Or steps of 1 ms of a "
            "simulator.", "ns where they were read in us, us where in ms, ms where in s", False)
    return None


def _all_on(tick_us: int, t_us: np.ndarray, first: int = 0) -> bool:
    """Do all times (N,) lie on ticks from `first` on? Most recordings answer at their first."""
    return not ((t_us[:LEAST] - first) % tick_us).any() and not any(
        ((t_us[at : at + BLOCK] - first) % tick_us).any() for at in range(0, len(t_us), BLOCK))
