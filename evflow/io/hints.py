"""What a user may tell a reader, and how every reader obeys it.

`stream.gather` passes what a reader parses through `microseconds`, `on`, `sensor` and `span_us`;
so units, polarity, size and time range mean the same for every format.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, TypedDict

import numpy as np

from evflow.checks import Size, beyond, check_polarity, check_size
from evflow.errors import EvflowDataError
from evflow.io.decode.units import UNITS_US, since_1970
from evflow.light.colour import COLOURS
from evflow.notes import Note

POLARITIES = ("auto", "01", "pm1", "invert")
LATE = ("stop", "drop", "sort", "join")


def check_choices(options: Any, **choices: tuple[str, ...]) -> None:
    """EV020 where an attribute of `options` is none of its choices."""
    for name, allowed in choices.items():
        if getattr(options, name) not in allowed:
            raise EvflowDataError(
                "EV020", f"{name}={getattr(options, name)!r}.", f"Choose from {allowed}.")


def known(given: Mapping[str, Any], fields_of: type, who: str) -> Mapping[str, Any]:
    """`given`; EV020 where it names what is no field of the dataclass. who: takes its fields."""
    names = [field.name for field in dataclasses.fields(fields_of)]
    unknown = sorted(set(given) - set(names))
    if unknown:
        raise EvflowDataError(
            "EV020", f"unknown option {', '.join(unknown)}.", f"{who} know {names}.")
    return given


class Told(TypedDict, total=False):
    """The keyword arguments that become `Hints`."""

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
    time_unit: "auto" = what the format says; "s", "ms", "us" or "ns" overrides it.
    polarity: "auto" = {0, 1} or {-1, 1}, whichever it is; "01" and "pm1" insist; "invert"
        swaps ON and OFF.
    size: (width, height), overrides what the file says.
    partial: of a damaged or cut-off file take what lies before the damage; of HDF5 and npz, which
        are sound or not as a whole, only what lies before a time that goes back.
    drop_outside: leave out events outside the sensor instead of refusing them.
    frames_topic: of several streams of images the one whose images are the frames (see `streams`).
    no_frames: read the events alone.
    late: what becomes of times that go back: "stop" = they are refused, or with `partial` end the
        reading; "drop" leaves out as few events as make the others ordered; "sort" puts them in
        their place; "join" puts one clock behind the other.
    events_topic: of several streams of events (of several cameras) the one to read.
    colour: what a pixel sees of colour: "luma", or a Bayer pattern: its own colour under that
        mosaic, as the events of a colour sensor do. Raw mosaics then stay as they are.
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
                "EV020", f"frames_topic={self.frames_topic!r} and no_frames contradict.",
                "Give one of them (--frames-topic, --no-frames).")
        if self.size is not None:
            object.__setattr__(self, "size", check_size(self.size))

    @staticmethod
    def parse(given: Mapping[str, Any]) -> Hints:
        """Hints of keyword arguments; an unknown one raises EV020."""
        return Hints(**known(given, Hints, "Readers"))

    def camera(self, names: Sequence[str]) -> tuple[str, tuple[Note, ...]]:
        """Which of several streams of events to read, the first unless one is asked for: by its
        name, or as the only one that ends so; and what is to be said. EV020 where none is it."""
        named, best = self.events_topic, names[0]
        if named is not None:
            ends = [n for n in names if n == named] or [
                n for n in names if f"/{n}".endswith("/" + named.strip("/"))]
            if len(ends) != 1:
                raise EvflowDataError(
                    "EV020", f"events_topic={named!r} names {len(ends)} streams of events.",
                    f"There are: {', '.join(names)}.")
            best = ends[0]
        elif len(names) == 1:
            return best, ()
        others = ", ".join(name for name in names if name != best) or "none"
        return best, (Note("sensor.camera", f"events are those of {best}; not read: {others}"
                           + ("" if others == "none" else "; --events-topic NAME reads another")),)

    def sensor(self, *known: Size | None, reach: tuple[int, int] | None = None) -> Size:
        """The first of `self.size` and `known` that is not None, or EV015.

        reach: the largest x and y seen, for the message.
        """
        for size in (self.size, *known):
            if size is not None:
                return check_size(size)
        raise EvflowDataError(
            "EV015", "the file does not tell the size of its sensor"
            + (f" (events reach x={reach[0]}, y={reach[1]})." if reach else "."),
            "Pass size=(width, height), --size WxH.")

    def microseconds(self, t: np.ndarray, native: str, offset_us: int = 0) -> np.ndarray:
        """Times of any dtype in `time_unit` (auto: `native`) as int64 us, offset_us added.

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
        if t.dtype.kind == "f":
            if self.time_unit == "auto" and native != "s":
                raise EvflowDataError(
                    "EV003", f"times have dtype {t.dtype} (first {t[0]}) where {native} are whole.",
                    "Are they seconds? Pass time_unit='s' (--time-unit s).")
            if not np.isfinite(t).all():
                raise EvflowDataError("EV007", f"{(~np.isfinite(t)).sum():,} times are not finite.")
            with np.errstate(over="ignore"):  # an overflow is too late, as below
                us = np.rint(t.astype(np.float64) * UNITS_US[unit])
            if beyond(us.min(), us.max()):
                raise _too_late(t, unit)
            return us.astype(np.int64)
        if t.dtype.kind not in "iu":
            raise EvflowDataError("EV003", f"times have dtype {t.dtype}.", "Expected numbers.")
        if beyond(*(int(end) * max(UNITS_US[unit], 1) for end in (t.min(), t.max()))):
            raise _too_late(t, unit)
        whole = t.astype(np.int64, copy=False)
        if unit == "ns":
            return (whole + 500) // 1000
        return whole if unit == "us" else whole * np.int64(UNITS_US[unit])

    def instant(self, t: Any, native: str) -> int:
        """One time as `microseconds` has it."""
        return int(self.microseconds(np.asarray(t).reshape(1), native)[0])

    def on(self, p: np.ndarray) -> np.ndarray:
        """Polarity as bool, True = ON, after the convention asked for; EV006."""
        expected = {"01": (0, 1), "pm1": (-1, 1)}.get(self.polarity)
        if expected and p.size and p.dtype != bool:
            values = np.unique(p)
            if not np.isin(values, expected).all():
                raise EvflowDataError(
                    "EV006", f"p holds {values[:5]} but polarity={self.polarity!r} was asked for.",
                    f"Expected {expected} only; polarity='auto' detects the convention.")
        on = check_polarity(p)
        return ~on if self.polarity == "invert" else on

    def forgive(self, error: EvflowDataError, sound: bool) -> Note:
        """A note on the error where what is sound before the damage was asked for and is some;
        else it is raised."""
        if not (self.partial and sound and error.code in ("EV004", "EV009")):
            raise error
        return Note("events.partial",
                    f"only the part before the damage was read (--partial): {error.seen}")

    def span_us(self, first_us: int) -> tuple[int, int]:
        """The absolute half-open range [start, stop) in us for a file that begins at first_us."""
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
    """(N,) bool: which coordinates lie on a sensor of (width, height)."""
    return (x >= 0) & (x < size[0]) & (y >= 0) & (y < size[1])


def dropped(count: int, total: int, size: Size) -> Note:
    """What is said of events that were left out."""
    return Note("events.outside", f"{count:,} of {total:,} events lay outside {size[0]}x{size[1]} "
                "and were left out (--drop-outside)")


def _too_late(t: np.ndarray, unit: str) -> EvflowDataError:
    """The unit that makes them times since 1970 is named, if there is one."""
    last = float(t.max())
    since = since_1970(last)
    return EvflowDataError(
        "EV003", f"times span {t.min():.0f}..{last:.0f} {unit}, beyond 2^62 microseconds"
        f"{f'; in {since[0]} they are times since 1970' if since else ''}.",
        f"Pass the right time_unit (--time-unit {since[0] if since else 'us, or ns'}).")
