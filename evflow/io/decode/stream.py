"""Events decoded chunk by chunk: time range, order, sensor and damage in one place.

A decoder yields `Chunk`s and raises `Damage` where the bytes stop making sense; `gather` makes
`Events` of them. It keeps what lies between start_s and stop_s alone, reads no further than
stop_s, and names the place of the first event that cannot be right; damage behind stop_s does not
matter. Memory: the temporaries of a chunk, and of the columns kept, 13 bytes per event, what
`spool` keeps there.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from evflow.checks import COLUMNS, RESET_US, Size
from evflow.errors import EvflowDataError
from evflow.files.spool import Spool
from evflow.io.hints import Hints, dropped, within
from evflow.notes import Note
from evflow.types import Events, Recording

CHUNK = 1 << 18  # bytes decoded at a time: the temporaries of 64k words stay in a core's cache
MOST_RESERVED = 0.125, 16  # of the words of a chunk, and at least; of random ones a third are
KINDS = {"x": np.uint16, "y": np.uint16, "t": np.int64, "p": bool}


class Chunk(NamedTuple):
    """Consecutive events, (n,) each: x, y whole numbers, t in the format's own unit, p bool,
    {0, 1} or {-1, 1}. Event i is written at `unit` number `where(i)` of the file."""

    x: np.ndarray
    y: np.ndarray
    t: np.ndarray
    p: np.ndarray
    where: Callable[[int], int]
    unit: str = "byte"


class Gathered(NamedTuple):
    """events: those that were asked for; span: the range [start, stop) in us that was asked for;
    notes: what obeying that cost."""

    events: Events
    span: tuple[int, int]
    notes: tuple[Note, ...]


class Damage(Exception):
    """What a decoder cannot go on from, and the byte (or other unit) where it lies."""

    def __init__(self, byte: int, seen: str, unit: str = "byte") -> None:
        super().__init__(seen)
        self.byte, self.seen, self.unit = byte, seen, unit


class Clock:
    """A counter of `bits` bits as an endless one: int64, carried from chunk to chunk.

    The smaller of the two ways round is taken, so a step back (damage, a reset) stays one, and a
    wraparound is told from it as long as the counter is read twice per turn.
    """

    def __init__(self, bits: int) -> None:
        self.turn = 1 << bits
        self.value: int | None = None  # the last reading

    def unwrap(self, raw: np.ndarray) -> np.ndarray:
        """Readings (n,) unsigned -> int64 (n,), continuing those of the calls before."""
        if not len(raw):
            return np.zeros(0, np.int64)
        value = int(raw[0]) if self.value is None else self.value
        half = self.turn // 2
        step: np.ndarray = np.diff(raw.astype(np.int64), prepend=value % self.turn)
        step += half
        step &= self.turn - 1
        step -= half
        out = np.cumsum(step, out=step)
        out += value
        self.value = int(out[-1])
        return out


def words(path: Path, start: int, dtype: Any) -> Iterator[tuple[int, np.ndarray]]:
    """(byte, whole words) of a file from byte `start`; Damage where it ends inside a word."""
    size = np.dtype(dtype).itemsize
    with open(path, "rb") as f:
        f.seek(start)
        while data := f.read(CHUNK // size * size):
            n = len(data) // size
            yield start, np.frombuffer(data, dtype, n)
            if len(data) % size:
                raise Damage(start + n * size, f"it ends {len(data) % size} bytes into a "
                             f"word of {size} bytes")
            start += len(data)


def cut_at(wrong: np.ndarray, table: np.ndarray) -> tuple[np.ndarray, int]:
    """The rows before the first wrong one, and its index (-1 where none is wrong)."""
    if not wrong.any():
        return table, -1
    first = int(np.argmax(wrong))
    return table[:first], first


def typed(
    source: Iterable[tuple[int, np.ndarray]], reserved: Reserved,
    decode: Callable[[np.ndarray, np.ndarray, int], Chunk], unit: str = "byte",
) -> Iterator[Chunk]:
    """decode(words, their types, byte) of (byte, words) whose top four bits are a type. Words of
    reserved types stay among them, for `decode` to pass over."""
    for byte, table in source:
        size = table.dtype.itemsize
        kind = (table >> (8 * size - 4)).astype(np.uint8)
        wrong = reserved.seen(table, kind)
        sound = len(table) if wrong < 0 else wrong
        yield decode(table[:sound], kind[:sound], byte)
        if wrong >= 0:
            raise Damage(byte + size * wrong, f"word {table[wrong]:#0{2 * size + 2}x} is of type "
                         f"{kind[wrong]:#x}, which {reserved.format} does not have, and so are "
                         "many behind it", unit)


class Reserved:
    """Words of types that a format reserves or does not define: they are passed over and counted,
    as firmware pads with them. types: (16,) bool, which they are.

    Where more than `MOST_RESERVED` of a chunk are such, of several values, this is another format,
    or damage.
    """

    def __init__(self, types: np.ndarray, format: str) -> None:
        self.types, self.format = types, format
        self.count, self.example = 0, 0

    def seen(self, table: np.ndarray, kind: np.ndarray) -> int:
        """Count those of a chunk; the index of the first where there are too many, else -1."""
        odd = self.types[kind]
        if not odd.any():
            return -1
        at = np.flatnonzero(odd)
        first = table[at[0]]
        share, least = MOST_RESERVED
        if len(at) > max(least, share * len(table)) and (table[at] != first).any():
            return int(at[0])
        self.example = self.example or int(first)
        self.count += len(at)
        return -1

    def notes(self) -> tuple[Note, ...]:
        if not self.count:
            return ()
        return (Note("events.unread", f"{self.count:,} words of types that {self.format} reserves "
                     f"({self.example:#x}, ...) were skipped"),)


def collect(
    path: Path,
    chunks: Iterable[Chunk],
    hints: Hints,
    size: Size | None,
    notes: Callable[[], tuple[Note, ...]] = tuple,
    native: str = "us",
) -> Recording:
    """A recording without frames, as `gather` has it; `notes` is called at the end."""
    found = gather(path, chunks, hints, size, native)
    return Recording.of_events(found.events, (*notes(), *found.notes))


def gather(
    path: Path, chunks: Iterable[Chunk], hints: Hints, size: Size | None, native: str = "us",
    offset_us: int = 0,
) -> Gathered:
    """The events that `hints` ask for.

    size: what the file says of its sensor, None where it says nothing. native: unit of t.
    offset_us: added to t.
    Raises EV001 (no event in the range), EV003 and EV007 (not whole), EV004 (order), EV005
    (outside the sensor), EV006 (polarity), EV009 (damage), EV015 (size unknown).
    """
    gathering = _Gathering(path, hints, hints.size or size, native, offset_us)
    try:
        for chunk in chunks:
            if len(chunk.t) and gathering.add(chunk):
                break
    except Damage as e:
        error = EvflowDataError(
            "EV009", f"{path} is cut off or damaged at {_place(path, e.unit, e.byte)}: {e.seen}"
            f"{gathering.so_far()}", "Copy it again" + gathering.sound_part())
        error.__cause__ = e
        gathering.notes.append(hints.forgive(error, gathering.kept > 0))
    return gathering.result(size)


class _Gathering:
    """The events kept so far. first, last: times of all events seen, in us."""

    def __init__(
        self, path: Path, hints: Hints, size: Size | None, native: str, offset: int
    ) -> None:
        self.path, self.hints, self.size = path, hints, size
        self.native, self.offset = native, offset
        self.columns = {name: Spool(KINDS[name]) for name in COLUMNS}
        self.signs: set[int] = set()  # values of p kept, where they are not bool
        self.seen = self.kept = self.first = self.last = self.outside = 0
        self.reach = (0, 0)
        self.notes: list[Note] = []
        self.start, self.stop = hints.span_us(0)

    def add(self, chunk: Chunk) -> bool:
        """Take what lies in the range; True where the rest of the file lies behind it."""
        if chunk.t.dtype.kind == "f" and not (told := np.abs(chunk.t) < 2.0**63).all():
            raise self._odd(chunk, "t", int(np.argmin(told)))
        t = self.hints.microseconds(chunk.t, self.native, self.offset)
        if not self.seen:
            self.first = self.last = int(t[0])
            self.start, self.stop = self.hints.span_us(self.first)
        x, y, p = (self._whole(chunk, name) for name in ("x", "y", "p"))
        if p.dtype != bool:  # its convention is told when all of them are there
            if p.min() < -1 or p.max() > 1:
                raise self._odd(chunk, "p", int(np.argmax((p < -1) | (p > 1))))
            p = p.astype(np.int8)
        chunk = chunk._replace(x=x, y=y, p=p)
        if self.hints.drop_outside and self.size:
            chunk, t = self._inside(chunk, t, self.size)
            if not len(t):
                return False
        wrong = self._first_wrong(chunk, t)
        self._keep(chunk, t[:wrong])
        if wrong < len(t) and self.last < self.stop:
            self.notes.append(self.hints.forgive(self._wrong(chunk, t, wrong), self.kept > 0))
            return True
        return self.last >= self.stop and self.kept > 0

    def _inside(self, chunk: Chunk, t: np.ndarray, size: Size) -> tuple[Chunk, np.ndarray]:
        """The events on the sensor alone."""
        inside = within(chunk.x, chunk.y, size)
        if inside.all():
            return chunk, t
        self.outside += int((~inside).sum())
        kept = np.flatnonzero(inside)
        return Chunk(chunk.x[kept], chunk.y[kept], chunk.t[kept], chunk.p[kept],
                     lambda i: chunk.where(int(kept[i])), chunk.unit), t[kept]

    def _whole(self, chunk: Chunk, name: str) -> np.ndarray:
        """A column without fractions as integers or bool."""
        column: np.ndarray = getattr(chunk, name)
        if column.dtype.kind in "biu":
            return column
        if column.dtype.kind != "f":
            raise EvflowDataError(
                "EV003", f"{self.path}: {name} has dtype {column.dtype}.", "Expected numbers.")
        with np.errstate(invalid="ignore"):
            whole = column.astype(np.int64)  # of NaN and infinity some integer, not equal to them
        same = whole == column
        if not same.all():
            raise self._odd(chunk, name, int(np.argmin(same)))
        return whole

    def _odd(self, chunk: Chunk, name: str, i: int) -> EvflowDataError:
        """The error for a value that no event has."""
        value = getattr(chunk, name)[i]
        code = "EV007" if not np.isfinite(value) else "EV006" if name == "p" else "EV003"
        fix = {"t": "Times are seconds or whole numbers: export it again.",
               "p": "Polarity is 0 or 1, or -1 or 1; a -1 stored as unsigned reads 255."}
        place = self._place(chunk, i) + self.so_far(chunk, i)
        return EvflowDataError(
            code, f"{self.path}: {name} is {value} at {place}",
            fix.get(name, "Coordinates are raw integer pixels: were they undistorted? Use the raw "
                    "ones."))

    def _first_wrong(self, chunk: Chunk, t: np.ndarray) -> int:
        """Index of the first event out of order or outside the sensor; len(t) for none."""
        first = 0 if t[0] < self.last else len(t)
        back = t[1:] < t[:-1]
        if back.any():
            first = min(first, int(np.argmax(back)) + 1)
        for a, limit in zip((chunk.x, chunk.y), self.size or (1 << 16, 1 << 16), strict=True):
            if a.max() >= limit or (a.dtype.kind != "u" and a.min() < 0):
                first = min(first, int(np.argmax((a >= limit) | (a < 0))))
        return first

    def _place(self, chunk: Chunk, i: int) -> str:
        return _place(self.path, chunk.unit, chunk.where(i))

    def _wrong(self, chunk: Chunk, t: np.ndarray, i: int) -> EvflowDataError:
        place, before = self._place(chunk, i), int(t[i - 1]) if i else self.last
        if t[i] < before:
            fix = ("A camera reset, or two recordings joined? Split them there"
                   if before - t[i] > RESET_US else "A damaged time? Copy it again")
            return EvflowDataError(
                "EV004", f"{self.path}: time goes back from {before:,} to {t[i]:,} us at {place}"
                f"{self.so_far()}", fix + self.sound_part())
        width, height = self.size or (1 << 16, 1 << 16)
        return EvflowDataError(
            "EV005", f"{self.path}: an event at x={chunk.x[i]}, y={chunk.y[i]} is outside "
            f"{width}x{height}, at {place}{self.so_far()}",
            "Wrong size? Pass size=(width, height), --size WxH; if it is right the file is "
            "damaged: copy it again" + self.sound_part())

    def _keep(self, chunk: Chunk, t: np.ndarray) -> None:
        if not len(t):
            return
        self.seen += len(t)
        self.last = int(t[-1])
        a, b = 0, len(t)
        if not self.hints.whole:
            a, b = (int(i) for i in np.searchsorted(t, np.array([self.start, self.stop])))
        if self.size is None:
            x, y = self.reach
            self.reach = max(x, int(chunk.x.max())), max(y, int(chunk.y.max()))
        if a < b:
            self.kept += b - a
            if chunk.p.dtype != bool:
                self.signs.update(v for v in (-1, 0, 1) if (chunk.p[a:b] == v).any())
            for name, column in zip(COLUMNS, (chunk.x, chunk.y, t, chunk.p > 0), strict=True):
                self.columns[name].append(column[a:b])

    def so_far(self, chunk: Chunk | None = None, begun: int = 0) -> str:
        """What was sound; of a chunk that was not kept, its first `begun` events too."""
        first, last = self.first, self.last
        if chunk is not None and begun:
            ends = self.hints.microseconds(chunk.t[[0, begun - 1]], self.native, self.offset)
            first, last = first if self.seen else int(ends[0]), int(ends[1])
        span = (last - first) // 1000 / 1000
        return f"; {self.seen + begun:,} events up to {span:.3f} s before that are sound."

    def sound_part(self) -> str:
        until = (self.last - self.first) // 1000 / 1000  # rounded down: up to it all is sound
        return (f", or read the sound part: stop_s={until:.3f} (--stop), or --partial."
                if until else ".")

    def result(self, size: Size | None) -> Gathered:
        if self.seen and not self.kept:
            raise self.hints.empty(self.last - self.first)
        if self.outside and self.size:
            self.notes.append(dropped(self.outside, self.seen + self.outside, self.size))
        size = self.hints.sensor(size, reach=self.reach if self.seen else None)
        self.hints.on(np.array(sorted(self.signs), np.int8))  # is it one convention?
        x, y, t, on = (self.columns.pop(name).array() for name in COLUMNS)
        if self.hints.polarity == "invert":
            np.logical_not(on, out=on)
        return Gathered(Events.unchecked(x, y, t, on, size), (self.start, self.stop),
                        tuple(self.notes))


def _place(path: Path, unit: str, number: int) -> str:
    total = f" of {os.path.getsize(path):,}" if unit == "byte" else ""
    return f"{unit} {number:,}{total}"


def hold(carried: int, values: np.ndarray, at: np.ndarray, n: int) -> np.ndarray:
    """(n,): `carried`, and from entry at[k] on values[k], until the next."""
    held = np.empty(len(values) + 1, values.dtype)
    held[0], held[1:] = carried, values
    return np.repeat(held, np.diff(at, prepend=0, append=n))
