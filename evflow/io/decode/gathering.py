"""Collects a file's events chunk by chunk, and reports what is wrong with the others.

Faults are reported with their position: times that go back, coordinates outside the sensor, invalid
values. Only the requested range is checked.
"""

from __future__ import annotations

import math
import os
from pathlib import Path

import numpy as np

from evflow.checks import COLUMNS, RESET_US, Size
from evflow.errors import EvflowDataError
from evflow.files.spool import Spool
from evflow.io.decode import late, written
from evflow.io.decode.causes import why_no_polarity, why_outside
from evflow.io.decode.chunk import Chunk
from evflow.io.decode.possible import first_odd, possible_times
from evflow.io.decode.units import UNITS_US, check_whole
from evflow.io.hints import Hints, dropped, within
from evflow.notes import Note
from evflow.types import Events

KINDS = {"x": np.uint16, "y": np.uint16, "t": np.int64, "p": bool}


class Gathering:
    """The events kept so far. first, last: times of all events seen, in us."""

    def __init__(
        self, path: Path, hints: Hints, size: Size | None, native: str, offset: int
    ) -> None:
        self.path, self.hints, self.size = path, hints, size
        self.native, self.offset = native, offset
        self.columns = {name: Spool(KINDS[name]) for name in COLUMNS}
        self.signs: set[int] = set()  # values of p kept, unless they are bool
        self.seen = self.kept = self.first = self.last = self.outside = 0
        self.reach = (0, 0)
        self.notes: list[Note] = []
        self.start, self.stop = hints.span_us(0)
        self.clocked = False  # whether the range counts from the first event of all
        self.begun = hints.start_s is None  # whether the range has begun
        self.passed = False  # whether its end was seen; a jump there may be a single wrong time
        self.damage: tuple[EvflowDataError, BaseException] | None = None
        self.joint = late.Joint() if hints.late == "join" else None
        self.lateness = late.Lateness() if hints.late == "sort" else None

    def add(self, chunk: Chunk) -> bool:
        """Keep what lies in the range; True if the rest lies after it, or is not to be read."""
        if self.hints.partial and (odd := first_odd(chunk, self._unit)):
            i, name = odd
            error = self._odd(chunk, name, i)
            if not (i and self._add(chunk.only(np.arange(i)))):
                self.notes.append(self.hints.forgive(error, self.kept > 0))
            return True
        return self._add(chunk)

    @property
    def _unit(self) -> str:
        """Of the file's times."""
        return self.native if self.hints.time_unit == "auto" else self.hints.time_unit

    def _add(self, chunk: Chunk) -> bool:
        t = self._times(chunk)
        x, y, p = (self._whole(chunk, name) for name in ("x", "y", "p"))
        if p.dtype != bool:  # its convention is decided when all values are known
            if p.min() < -1 or p.max() > 1:
                raise self._odd(chunk, "p", int(np.argmax((p < -1) | (p > 1))))
            p = p.astype(np.int8)
        chunk = chunk._replace(x=x, y=y, p=p)
        if self.hints.drop_outside and self.size:
            chunk, t = self._inside(chunk, t, self.size)
            if not len(t):
                return False
        return self._unsorted(chunk, t) if self.lateness else self._sorted(chunk, t)

    def _times(self, chunk: Chunk) -> np.ndarray:
        fits = possible_times(chunk.t, self._unit)
        alone = self.hints.time_unit == "auto" and (self.seen or fits[0])
        huge = chunk.t.dtype.kind == "f" and not (np.abs(chunk.t) < 2.0**63).all()
        if huge or (alone and not fits.all()):
            raise self._odd(chunk, "t", int(np.argmin(fits)))
        if self.hints.time_unit == "auto":
            check_whole(
                chunk.t, self.native, math.prod(self.size) if self.size else chunk.area())
        written.seen(chunk.t, self._unit, self.native)
        t = self.hints.microseconds(chunk.t, self.native, self.offset)
        t = self.joint(t) if self.joint else t
        if not self.clocked:
            self._narrow(chunk)
            self.first = self.last = int(t[0])
            self.start, self.stop = self.hints.span_us(self.first)
            self.clocked = True
        return t

    def _sorted(self, chunk: Chunk, t: np.ndarray) -> bool:
        """Keep what lies in the range, as far as it is ordered and on the sensor."""
        if self.passed and t[0] >= self.stop:
            return True
        begin = 0 if self.begun else late.begin(t, self.start)
        back = begin + late.back_at(t[begin:], self.last if self.begun and self.seen else None)
        end = begin + int(np.searchsorted(t[begin:back], self.stop))
        ahead = late.ahead_of(t[begin:], back - begin) if back < len(t) else 0
        jump = begin <= end < len(t) and self._jumps(t, end)
        if end < back - ahead and not (jump and back < len(t) and t[back] < self.stop):
            back = len(t)  # the range ends before time goes back
        else:
            end = back
        wrong = min(back, begin + self._first_outside(chunk, begin, end))
        self._keep(chunk, t, begin, min(wrong, end))
        self.begun |= begin < len(t)
        if wrong < min(end, len(t)) or (wrong == back < len(t)):
            error = self._wrong(chunk, t, wrong, ahead)
            self.notes.append(self.hints.forgive(error, self.kept > 0))
            return True
        self.last = int(t[-1])
        self.passed = end < len(t)
        return self.passed and self.kept > 0 and not (jump and len(t) - end <= late.FEW)

    def _jumps(self, t: np.ndarray, i: int) -> bool:
        """Whether time jumps so far at event i that it may be wrong."""
        return int(t[i]) - (int(t[i - 1]) if i else self.last) > RESET_US

    def _unsorted(self, chunk: Chunk, t: np.ndarray) -> bool:
        """Keep what lies in the range, in any order."""
        assert self.lateness
        self.lateness.see(t)
        if (at := self._first_outside(chunk, 0, len(t))) < len(t):
            raise self._wrong(chunk, t, at, 0)
        kept = np.flatnonzero((t >= self.start) & (t < self.stop))
        self._keep(chunk.only(kept), t[kept], 0, len(kept))
        self.seen += len(t) - len(kept)
        self.last = max(self.last, int(t.max()))
        self.passed |= int(t[-1]) >= self.stop
        return bool(t.min() >= self.stop + RESET_US) and self.kept > 0

    def _inside(self, chunk: Chunk, t: np.ndarray, size: Size) -> tuple[Chunk, np.ndarray]:
        """Only the events on the sensor."""
        inside = within(chunk.x, chunk.y, size)
        if inside.all():
            return chunk, t
        self.outside += int((~inside).sum())
        kept = np.flatnonzero(inside)
        return chunk.only(kept), t[kept]

    def _whole(self, chunk: Chunk, name: str) -> np.ndarray:
        """A column of whole numbers as integers or bool."""
        column: np.ndarray = getattr(chunk, name)
        if column.dtype.kind in "biu":
            return column
        if column.dtype.kind != "f":
            raise EvflowDataError(
                "EV003", f"{self.path}: {name} has dtype {column.dtype}.", "Expected numbers.",
                where=self.path)
        with np.errstate(invalid="ignore"):
            whole = column.astype(np.int64)  # NaN and infinity become integers, which differ
        same = whole == column
        if not same.all():
            raise self._odd(chunk, name, int(np.argmin(same)))
        return whole

    def _odd(self, chunk: Chunk, name: str, i: int) -> EvflowDataError:
        """The error for an invalid value."""
        value = getattr(chunk, name)[i]
        code = "EV007" if not np.isfinite(value) else "EV006" if name == "p" else "EV003"
        fix = {"t": "Times must be seconds or integers: export the file again.",
               "p": why_no_polarity(chunk.p)}
        if name == "t" and np.isfinite(value):
            fix["t"] = "A damaged time? Copy the file again."
        place = self._place(chunk, i) + self.so_far(chunk, i)
        return EvflowDataError(
            code, f"{self.path}: {name} is {value} at {place}",
            fix.get(name, "Were they undistorted? Use the raw integer pixel ones.")
            + (" Read what comes before: --partial." if self.seen or i else ""), where=self.path)

    def _first_outside(self, chunk: Chunk, begin: int, end: int) -> int:
        """Index after `begin` of the first event outside the sensor; the length if there is
        none."""
        first = len(chunk.t) - begin
        if begin >= end:
            return first
        for a, limit in zip((chunk.x, chunk.y), self.size or (1 << 16, 1 << 16), strict=True):
            a = a[begin:end]
            if a.max() >= limit or (a.dtype.kind != "u" and a.min() < 0):
                first = min(first, int(np.argmax((a >= limit) | (a < 0))))
        return first

    def _place(self, chunk: Chunk, i: int) -> str:
        return place(self.path, chunk.unit, chunk.where(i))

    def _wrong(self, chunk: Chunk, t: np.ndarray, i: int, ahead: int) -> EvflowDataError:
        spot, before = self._place(chunk, i), int(t[i - 1]) if i else self.last
        if t[i] < before and not self.lateness:
            if ahead:
                self.last = int(t[i - ahead - 1]) if i > ahead else self.first
            fix = late.advice(t, i, before, self._turns(chunk), self.joint is not None,
                              late.sorted_by(chunk))
            return EvflowDataError(
                "EV004", f"{self.path}: time goes back from {before:,} to {t[i]:,} us at {spot}"
                f"{self.so_far()}", fix + self.sound_part(), where=self.path)
        width, height = self.size or (1 << 16, 1 << 16)
        return EvflowDataError(
            "EV005", f"{self.path}: an event at x={chunk.x[i]}, y={chunk.y[i]} is outside "
            f"{width}x{height}, at {spot}{self.so_far()}",
            why_outside(chunk.x, chunk.y, (width, height)) + self.sound_part(
                "leave such events out: --drop-outside (drop_outside=True)"), where=self.path)

    def _turns(self, chunk: Chunk) -> tuple[int, ...]:
        """After how many us times of so few bits as those of the chunk begin anew."""
        kind = chunk.t.dtype
        return (round(2 ** (8 * kind.itemsize) * UNITS_US[self._unit]),) if (
            kind.kind in "iu" and kind.itemsize < 8) else ()

    def _narrow(self, chunk: Chunk) -> None:
        """A note if coordinates have too few bits for the sensor: larger ones came back as small
        ones."""
        for name, side in zip(("x", "y"), self.size or (0, 0), strict=True):
            kind = getattr(chunk, name).dtype
            if kind == np.uint8 and side > 256:
                self.notes.append(Note(
                    "events.narrow", f"{name} has 8 bits, up to 255, but the sensor {side} pixels: "
                    "did larger ones begin anew at 0? Export it again with 16 bits"))

    def _keep(self, chunk: Chunk, t: np.ndarray, a: int, b: int) -> None:
        """Keep the events from a to b and skip those before a."""
        self.seen += b
        if self.size is None and b:
            x, y = self.reach
            self.reach = max(x, int(chunk.x[:b].max())), max(y, int(chunk.y[:b].max()))
        if a < b:
            self.last = int(t[b - 1])
            self.kept += b - a
            if chunk.p.dtype != bool:
                self.signs.update(v for v in (-1, 0, 1) if (chunk.p[a:b] == v).any())
            for name, column in zip(COLUMNS, (chunk.x, chunk.y, t, chunk.p > 0), strict=True):
                self.columns[name].append(column[a:b])

    def damaged(self, at: int, seen: str, unit: str, e: BaseException) -> None:
        """Record where the bytes stop making sense, for `check_damage`."""
        error = EvflowDataError(
            "EV009", f"{self.path} is truncated or damaged at {place(self.path, unit, at)}: {seen}",
            where=self.path)
        self.damage = error, e

    def check_damage(self) -> None:
        """Raise EV009 for damage, unless it lies after the range or is forgiven."""
        if self.damage is None or (self.passed and self.kept):
            return
        error, e = self.damage
        error = EvflowDataError(
            error.code, error.seen + self.so_far(), "Copy it again" + self.sound_part(),
            where=error.where)
        error.__cause__ = e
        self.notes.append(self.hints.forgive(error, self.kept > 0))

    def so_far(self, chunk: Chunk | None = None, begun: int = 0) -> str:
        """How much is sound, including the first `begun` events of a chunk that was not kept."""
        first, last = self.first, self.last
        if chunk is not None and begun:
            ends = self.hints.microseconds(chunk.t[[0, begun - 1]], self.native, self.offset)
            first, last = first if self.seen else int(ends[0]), int(ends[1])
        span = (last - first) // 1000 / 1000
        return f"; {self.seen + begun:,} events up to {span:.3f} s before that are sound."

    def sound_part(self, instead: str = "--partial") -> str:
        """How to read what is sound. instead: another way than to stop there."""
        until = (self.last - self.first) // 1000 / 1000  # rounded down: all before it is sound
        sound = f"read the sound part: stop_s={until:.3f} (--stop), or " if until > 0 else ""
        return f", or {sound}{instead}." if sound or instead != "--partial" else "."

    def result(self, size: Size | None) -> tuple[Events, tuple[int, int], tuple[Note, ...]]:
        """The events, the requested range in us, and notes on what was left out."""
        if self.seen and not self.kept:
            raise self.hints.empty(self.last - self.first)
        if self.outside and self.size:
            self.notes.append(dropped(self.outside, self.seen + self.outside, self.size))
        size = self.hints.sensor(size, reach=self.reach if self.seen else None)
        self.hints.on(np.array(sorted(self.signs), np.int8))  # checks that one convention holds
        x, y, t, on = self._columns()
        if self.hints.polarity == "invert":
            np.logical_not(on, out=on)
        self.notes += self.joint.notes() if self.joint else ()
        return Events.unchecked(x, y, t, on, size), (self.start, self.stop), tuple(self.notes)

    def _columns(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """x, y, t, p of the events kept, in order."""
        x, y, t, on = (self.columns.pop(name).array() for name in COLUMNS)
        if self.lateness is None or (order := self.lateness.order(t)) is None:
            return x, y, t, on
        self.notes += self.lateness.notes()
        return x[order], y[order], t[order], on[order]


def place(path: Path, unit: str, number: int) -> str:
    """A position in a file: "byte 12 of 3,456"."""
    total = f" of {os.path.getsize(path):,}" if unit == "byte" else ""
    return f"{unit} {number:,}{total}"
