"""Infers the unit of times that are about to be read, for all readers and files of frame times.

Evidence: a unit written in a header or comment; integers, as no event camera counts whole seconds;
dates since 1970; and the rates of events and frames that each unit would imply, compared with those
of real cameras. Units are three decades apart, rates vary less. misread.py judges times that were
read already.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from evflow.checks import Size
from evflow.errors import EvflowDataError

UNITS_US = {"s": 1e6, "ms": 1e3, "us": 1.0, "ns": 1e-3}
EPOCH_S = (1e9, 4.1e9)  # 2001 to 2099 as seconds since 1970
S_US = 1_000_000
LEAST, LATE_S = 10, 1000  # this many integer times, or times this late, are not seconds
BLOCK = 1 << 20  # times examined at a time: they may be memory-mapped

# Events per second and pixel, mean over the whole sensor.
USUAL_HZ = 1.9  # median of many recordings, which have .07 to 52
RARER = {"ns": 3.0}  # log units by which this unit must fit better: cameras' clocks count us
FEW_EVENTS = 100  # too few to say anything

# Seconds between frames.
POSSIBLE_S = (2e-5, 2.0)  # 50,000 frames/s to one in two seconds
USUAL_S = (2.5e-3, 0.125)  # 400 to 8 frames/s: only one of units 1000 apart can lie within
MIDDLE_S = 0.02  # of two units, the one nearer to 50 frames/s
LEAST_SHARED = 0.01  # of the whole span: in a wrong unit, times share a thousandth
FAR_MORE = 10.0  # times as much is shared in the right unit

DIGITS = "Export them again as integer microseconds, or as float64 seconds with six decimals."
WORDS = re.compile(
    r"(?:[\[(_]|in )(n(?:s|sec|anoseconds?)|[uµμ]s(?:ec)?|microseconds?|m(?:s|sec|illiseconds?)|"
    r"s(?:ec(?:onds?)?)?)\b", re.IGNORECASE)


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


def without_decimals(t: np.ndarray) -> bool:
    """Whether whole times (N,) are dates in seconds that have lost their decimals: most of them are
    that of the event before. Of a clock that has run for 17 to 68 minutes, microseconds are such
    numbers too."""
    return (len(t) > 1 and since_1970(float(t[0])) == ["s"]
            and float((np.diff(t[:BLOCK]) == 0).mean()) > 0.5)


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
    if not usual_step(times) > 0:
        return units[0]
    return min(units, key=lambda unit: _unlike(times, UNITS_US[unit]))


def usual_step(times: np.ndarray) -> float:
    """The usual step between times (T,); 0 for a single one."""
    return float(np.median(np.diff(times.astype(np.float64)))) if len(times) > 1 else 0.0


def shared_unit(times: np.ndarray, t: np.ndarray, units: list[str]) -> str | None:
    """The unit of `units` in which times (T,) fall among events at t (N,) us; None if in none.

    It is the first if they share more there than in a wrong one. Else, as events may be a short
    part of a recording, that of a usual video, or else that in which they share most.
    """
    shared = {unit: _shared(times, t, UNITS_US[unit]) for unit in units}
    if shared[units[0]] > LEAST_SHARED:
        return units[0]
    best = max(units, key=lambda unit: (
        shared[unit] > 0 and _is_usual(times, UNITS_US[unit]), shared[unit]))
    return best if shared[best] > 0 else None


def other_unit(times: np.ndarray, t: np.ndarray, native: str) -> str | None:
    """The unit in which times (T,) of frames fall among events at t (N,) us if in the native one
    they do not; None if they do, or in no unit."""
    factor = _factor(times, t, UNITS_US[native], [*UNITS_US.values()])
    return next((unit for unit, us in UNITS_US.items() if us == factor), None)


def too_large(times: np.ndarray, t: np.ndarray) -> str:
    """How many times times (T,) us of frames are those of events at t (N,) us, in words ("1,000
    times"), if they only look apart because one of both was read in a wrong unit; "" if nothing
    says so."""
    factor = _factor(times, t, 1.0, [10.0**power for power in (-9, -6, -3, 3, 6, 9)])
    if not factor and len(times) and len(t) and since_1970(float(t[0])) == ["us"]:
        factor = next((UNITS_US[unit] for unit in since_1970(float(times[0])) if unit != "us"), 0.0)
    return "" if not factor else (
        f"{1 / factor:,.0f} times" if factor < 1 else f"1/{factor:,.0f} of")


def _factor(times: np.ndarray, t: np.ndarray, native: float, factors: list[float]) -> float:
    """The factor at which times (T,) share most with events at t (N,), if at `native` they share
    nothing and are a less usual video, or far less and are no usual video, as they are at that
    factor; 0 if there is none. Frames may last longer than events, or less, or lie beside a part
    of them: that alone tells nothing."""
    best = max(factors, key=lambda factor: _shared(times, t, factor))
    most, now = _shared(times, t, best), _shared(times, t, native)
    if now == 0:
        nearer = not usual_step(times) > 0 or _unlike(times, best) < _unlike(times, native)
        return best if nearer and most > LEAST_SHARED else 0.0
    return best if (_is_usual(times, best) and not _is_usual(times, native)
                    and most > FAR_MORE * now) else 0.0


def _is_usual(times: np.ndarray, factor: float) -> bool:
    """Whether times (T,) times a factor, in us, are those of a usual video."""
    return USUAL_S[0] <= factor * usual_step(times) / S_US <= USUAL_S[1]


def _unlike(times: np.ndarray, factor: float) -> float:
    """How far the step of times (T,) times a factor, in us, is from that of 50 frames/s, in log
    units."""
    return float(abs(np.log(factor * usual_step(times) / (MIDDLE_S * S_US))))


def _shared(times: np.ndarray, t: np.ndarray, factor: float) -> float:
    """How much of their whole span times (T,) times a factor share with sorted t (N,)."""
    if not (len(times) and len(t)):
        return 0.0
    first, last = (float(v) * factor for v in (times.min(), times.max()))
    common = min(last, float(t[-1])) - max(first, float(t[0])) + 1.0
    return max(common, 0.0) / (max(last, float(t[-1])) - min(first, float(t[0])) + 1.0)


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


def check_whole(t: np.ndarray, native: str, pixels: float = 0.0) -> None:
    """Raise EV003 for times (N,) of a float dtype in a unit that is counted in integers, with the
    unit in which they make the most usual recording. pixels: as in `check_text_seconds`; 0 if they
    are unknown. Those that are not finite pass."""
    if t.dtype.kind != "f" or native == "s" or not np.isfinite(t).all():
        return
    seen = f"times are {t.dtype} (first {t[0]}), but {native} must be integers"
    units = ("ms", "us", "ns") if (t % 1 == 0).all() else ("s", "ms", "us")
    if not pixels or len(t) < FEW_EVENTS:
        raise EvflowDataError("EV003", f"{seen}.", f"Are they {', '.join(units)}? Pass time_unit "
                              "(--time-unit).")
    unit, why = likeliest_unit(len(t), float(np.ptp(t)), pixels, float(t[0]), units)
    raise EvflowDataError(
        "EV003", f"{seen}; {why}.", f"Pass time_unit={unit!r} (--time-unit {unit}).")


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
    if whole and without_decimals(t):
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
    if without_decimals(t_us[:BLOCK] // S_US):
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


def all_on(tick_us: int, t_us: np.ndarray, first: int = 0) -> bool:
    """Whether all times (N,) lie on ticks from `first` on; usually decided by the first few."""
    return not ((t_us[:LEAST] - first) % tick_us).any() and not any(
        ((t_us[at : at + BLOCK] - first) % tick_us).any() for at in range(0, len(t_us), BLOCK))
