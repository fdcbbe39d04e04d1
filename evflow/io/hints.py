"""Hints: what a user knows about a file, and how every reader applies it.

`stream.gather` passes what a reader parses through `microseconds`, `on`, `sensor` and `span_us`, so
units, polarity, size and time range mean the same for every format.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, TypedDict

import numpy as np

from evflow.checks import Size, beyond, check_polarity, check_size
from evflow.errors import EvflowDataError
from evflow.io.decode.units import UNITS_US, check_whole, since_1970
from evflow.light.colour import COLOURS
from evflow.notes import Note

POLARITIES = ("auto", "01", "pm1", "invert")
LATE = ("stop", "drop", "sort", "join")
# What a damaged file can show: events before that are read with `partial`.
FORGIVEN = ("EV003", "EV004", "EV005", "EV006", "EV007", "EV009")


def check_choices(options: Any, **choices: tuple[str, ...]) -> None:
    """Raise EV020 if an attribute of `options` is not one of its choices."""
    for name, allowed in choices.items():
        if getattr(options, name) not in allowed:
            raise EvflowDataError(
                "EV020", f"{name}={getattr(options, name)!r}.", f"Choose from {allowed}.")


def known(given: Mapping[str, Any], fields_of: type, who: str) -> Mapping[str, Any]:
    """`given`; raises EV020 for names that are not fields of the dataclass. who: for the
    message."""
    names = [field.name for field in dataclasses.fields(fields_of)]
    unknown = sorted(set(given) - set(names))
    if unknown:
        raise EvflowDataError(
            "EV020", f"unknown option {', '.join(unknown)}.", f"{who} know {names}.")
    return given


class HintArguments(TypedDict, total=False):
    """The keyword arguments from which `Hints` are made."""

    start_s: float | None
    stop_s: float | None
    time_unit: str
    polarity: str
    size: Size | None
    partial: bool
    drop_outside: bool
    frames_topic: str | None
    no_frames: bool
    late: str
    events_topic: str | None
    colour: str


@dataclasses.dataclass(frozen=True)
class Hints:
    """What the user knows about a file.

    start_s, stop_s: keep events and frames with start <= time < stop, in seconds from the
        file's first event; None = all.
    time_unit: "auto" = what the format says; "s", "ms", "us" or "ns" override it.
    polarity: "auto" = {0, 1} or {-1, 1}, whichever fits; "01" and "pm1" require one; "invert"
        swaps ON and OFF.
    size: (width, height), overrides what the file says.
    partial: of a damaged or truncated file, read what lies before the damage; of HDF5, npz and
        bags other than MCAP, which are sound or not as a whole, only what lies before a time that
        goes back.
    drop_outside: leave out events outside the sensor instead of refusing them.
    frames_topic: which of several image streams holds the frames (see `streams`).
    no_frames: read only the events.
    late: what to do with times that go back: "stop" refuses them, or with `partial` ends the
        reading there; "drop" leaves out the fewest events such that the rest are ordered; "sort"
        sorts them in; "join" appends one clock to the other.
    events_topic: which of several event streams (cameras) to read.
    colour: what a pixel sees of colour frames: "luma", or a Bayer pattern: one colour of that
        mosaic, as in a colour sensor's events. Raw mosaics then stay as they are.
    """

    start_s: float | None = None
    stop_s: float | None = None
    time_unit: str = "auto"
    polarity: str = "auto"
    size: Size | None = None
    partial: bool = False
    drop_outside: bool = False
    frames_topic: str | None = None
    no_frames: bool = False
    late: str = "stop"
    events_topic: str | None = None
    colour: str = "luma"

    def __post_init__(self) -> None:
        check_choices(
            self, time_unit=("auto", *UNITS_US), polarity=POLARITIES, late=LATE, colour=COLOURS)
        for name in ("start_s", "stop_s"):
            value = getattr(self, name)
            number = isinstance(value, int | float | np.number)
            if value is not None and not (number and 0 <= value < np.inf):
                raise EvflowDataError(
                    "EV020", f"{name}={value!r}.", "Give seconds from the first event, >= 0.")
        if self.stop_s is not None and self.stop_s <= (self.start_s or 0.0):
            raise EvflowDataError(
                "EV020", f"stop_s={self.stop_s} is not after start_s={self.start_s or 0.0}.")
        for name in ("frames_topic", "events_topic"):
            topic = getattr(self, name)
            if topic is not None and not (isinstance(topic, str) and topic.strip("/")):
                raise EvflowDataError("EV020", f"{name}={topic!r}.",
                                      "Give the name of a topic, group or data set.")
        if self.frames_topic is not None and self.no_frames:
            raise EvflowDataError(
                "EV020", f"frames_topic={self.frames_topic!r} and no_frames contradict each other.",
                "Give only one of them (--frames-topic, --no-frames).")
        if self.size is not None:
            object.__setattr__(self, "size", check_size(self.size))

    @staticmethod
    def parse(given: Mapping[str, Any]) -> Hints:
        """Hints from keyword arguments; an unknown one raises EV020."""
        return Hints(**known(given, Hints, "Readers"))

    def camera(self, names: Sequence[str]) -> tuple[str, tuple[Note, ...]]:
        """Which of several event streams to read (the first unless one is requested, by its name or
        a unique ending of it), and notes on it. EV020 if none fits."""
        named, best = self.events_topic, names[0]
        if named is not None:
            ends = [n for n in names if n == named] or [
                n for n in names if f"/{n}".endswith("/" + named.strip("/"))]
            if len(ends) != 1:
                raise EvflowDataError(
                    "EV020", f"events_topic={named!r} matches {len(ends)} event streams.",
                    f"There are: {', '.join(names)}.")
            best = ends[0]
        elif len(names) == 1:
            return best, ()
        others = ", ".join(name for name in names if name != best) or "none"
        return best, (Note("sensor.camera", f"events of {best} were read; not read: {others}"
                           + ("" if others == "none" else "; --events-topic NAME reads another")),)

    def sensor(self, *known: Size | None, reach: tuple[int, int] | None = None) -> Size:
        """The first of `self.size` and `known` that is not None, or EV015.

        reach: the largest x and y seen, for the message.
        """
        for size in (self.size, *known):
            if size is not None:
                return check_size(size)
        raise EvflowDataError(
            "EV015", "the file does not contain the size of its sensor"
            + (f" (events reach x={reach[0]}, y={reach[1]})." if reach else "."),
            "Pass size=(width, height), --size WxH.")

    def microseconds(self, t: np.ndarray, native: str, offset_us: int = 0) -> np.ndarray:
        """Times of any dtype in `time_unit` (auto: `native`) as int64 us, plus offset_us.

        Integers stay exact; floats and ns are rounded to the nearest microsecond.
        Raises EV003, EV007, EV009 (the offset takes them beyond 2^62 us).
        """
        if t.size == 0:
            return np.zeros(0, np.int64)
        us = self._microseconds(t, native)
        if offset_us == 0:
            return us
        if beyond(int(us.min()) + offset_us, int(us.max()) + offset_us):
            raise EvflowDataError("EV009", f"an offset of {offset_us} takes times beyond 2^62 us.")
        return us + np.int64(offset_us)

    def _microseconds(self, t: np.ndarray, native: str) -> np.ndarray:
        unit = native if self.time_unit == "auto" else self.time_unit
        if t.dtype.kind in "mM" and not np.isnat(t).any():  # they know their unit
            exact = np.datetime_data(t.dtype)[0] in ("ns", "ps", "fs", "as")
            unit = "ns" if exact else "us"  # to be rounded below, which a cast does not
            t = t.astype(f"{t.dtype.kind}8[{unit}]").astype(np.int64)
        if t.dtype.kind == "f":
            if self.time_unit == "auto":
                check_whole(t, native)
            if not np.isfinite(t).all():
                raise EvflowDataError("EV007", f"{(~np.isfinite(t)).sum():,} times are not finite.")
            with np.errstate(over="ignore"):  # an overflow is refused below
                us = np.rint(t.astype(np.float64) * UNITS_US[unit])
            if beyond(us.min(), us.max()):
                raise _too_late(t, unit)
            return us.astype(np.int64)
        if t.dtype.kind not in "iu":
            raise EvflowDataError("EV003", f"times have dtype {t.dtype}.", "Expected numbers.")
        if beyond(*(int(end) * max(UNITS_US[unit], 1) for end in (t.min(), t.max()))):
            raise _too_late(t, unit)
        counts = t.astype(np.int64, copy=False)
        if unit == "ns":
            return (counts + 500) // 1000
        return counts if unit == "us" else counts * np.int64(UNITS_US[unit])

    def instant(self, t: Any, native: str) -> int:
        """One time, converted as by `microseconds`."""
        return int(self.microseconds(np.asarray(t).reshape(1), native)[0])

    def on(self, p: np.ndarray) -> np.ndarray:
        """Polarity as bool, True = ON, by the requested convention; EV006."""
        expected = {"01": (0, 1), "pm1": (-1, 1)}.get(self.polarity)
        if expected and p.size and p.dtype != bool:
            values = np.unique(p)
            if not np.isin(values, expected).all():
                raise EvflowDataError(
                    "EV006", f"p holds {values[:5]} but polarity={self.polarity!r} was requested.",
                    f"Expected {expected} only; polarity='auto' detects the convention.")
        on = check_polarity(p)
        return ~on if self.polarity == "invert" else on

    def forgive(self, error: EvflowDataError, sound: bool) -> Note:
        """A note on the error if reading what is sound before the damage was requested and there is
        something; else the error is raised."""
        if not (self.partial and sound and error.code in FORGIVEN):
            raise error
        return Note("events.partial",
                    f"only the part before the damage was read (--partial): {error.seen}")

    def span_us(self, first_us: int) -> tuple[int, int]:
        """The half-open range [start, stop) in us on the file's clock, which begins at first_us."""
        limits = np.iinfo(np.int64)
        start = limits.min if self.start_s is None else first_us + round(self.start_s * 1e6)
        stop = limits.max if self.stop_s is None else first_us + round(self.stop_s * 1e6)
        return min(start, limits.max), min(stop, limits.max)

    @property
    def whole(self) -> bool:
        return self.start_s is None and self.stop_s is None

    def empty(self, duration_us: int) -> EvflowDataError:
        """EV001 for a time range without events in a recording of that duration."""
        stop = "the end" if self.stop_s is None else f"{self.stop_s:g} s"
        return EvflowDataError(
            "EV001", f"no events between {self.start_s or 0:g} s and {stop}.",
            f"The recording covers 0.000 to {duration_us / 1e6:.3f} s.")


def within(x: np.ndarray, y: np.ndarray, size: Size) -> np.ndarray:
    """(N,) bool: which coordinates lie on a sensor of size (width, height)."""
    return (x >= 0) & (x < size[0]) & (y >= 0) & (y < size[1])


def dropped(count: int, total: int, size: Size) -> Note:
    """The note on events that were left out."""
    return Note("events.outside", f"{count:,} of {total:,} events lay outside {size[0]}x{size[1]} "
                "and were left out (--drop-outside)")


def _too_late(t: np.ndarray, unit: str) -> EvflowDataError:
    """EV003 that names the unit in which the times would be dates since 1970, if there is one."""
    last = float(t.max())
    since = since_1970(last)
    return EvflowDataError(
        "EV003", f"times span {t.min():.0f}..{last:.0f} {unit}, beyond 2^62 microseconds"
        f"{f'; in {since[0]} they are times since 1970' if since else ''}.",
        f"Pass the right time_unit (--time-unit {since[0] if since else 'us, or ns'}).")
