"""Events decoded in chunks: time range, order, sensor and damage are handled in one place.

A decoder yields `Chunk`s and raises `Damage` where the bytes stop making sense; `gather` makes
`Events` of them. It keeps only what lies between start_s and stop_s, reads no further than stop_s,
and names the position of the first event that cannot be right; damage after stop_s does not matter.
Memory: the temporaries of a chunk, and what `spool` keeps in memory of the columns (13 bytes per
event).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from evflow.checks import Size
from evflow.io.decode.chunk import Chunk
from evflow.io.decode.gathering import Gathering
from evflow.io.decode.late import Dropped
from evflow.io.hints import Hints
from evflow.notes import Note
from evflow.types import Events, Recording

CHUNK = 1 << 18  # bytes decoded at a time: temporaries of 64k words fit a core's cache
MOST_RESERVED = 0.125, 16  # share of a chunk's words, and minimum; a third of random words are


class Gathered(NamedTuple):
    """events: those requested; span: the requested range [start, stop) in us; notes: what was left
    out or assumed."""

    events: Events
    span: tuple[int, int]
    notes: tuple[Note, ...]


class Damage(Exception):
    """The point from which a decoder cannot continue: what was seen, and its byte or other unit."""

    def __init__(self, byte: int, seen: str, unit: str = "byte") -> None:
        super().__init__(seen)
        self.byte, self.seen, self.unit = byte, seen, unit


class Clock:
    """Extends a counter of `bits` bits to int64, across chunks.

    The smaller of the two possible steps is assumed, so that a step back (damage, a reset) stays
    one and a wraparound is recognised as long as the counter is read twice per turn.
    """

    def __init__(self, bits: int) -> None:
        self.turn = 1 << bits
        self.value: int | None = None  # the last reading

    def unwrap(self, raw: np.ndarray) -> np.ndarray:
        """Readings (n,) unsigned -> int64 (n,), continuing earlier calls."""
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
    """(byte, whole words) of a file from byte `start`; Damage if it ends inside a word."""
    size = np.dtype(dtype).itemsize
    with open(path, "rb") as f:
        f.seek(start)
        while data := f.read(CHUNK // size * size):
            n = len(data) // size
            if n:
                yield start, np.frombuffer(data, dtype, n)
            if len(data) % size:
                raise Damage(start + n * size, f"the file ends {len(data) % size} bytes into a "
                             f"word of {size} bytes")
            start += len(data)


def cut_at(wrong: np.ndarray, table: np.ndarray) -> tuple[np.ndarray, int]:
    """The rows before the first wrong one, and its index (-1 if none is wrong)."""
    if not wrong.any():
        return table, -1
    first = int(np.argmax(wrong))
    return table[:first], first


def typed(
    source: Iterable[tuple[int, np.ndarray]], reserved: Reserved,
    decode: Callable[[np.ndarray, np.ndarray, int], Chunk], unit: str = "byte",
) -> Iterator[Chunk]:
    """decode(words, their types, byte) of (byte, words) whose top four bits are a type. Words of
    reserved types are included, and `decode` skips them."""
    for byte, table in source:
        size = table.dtype.itemsize
        kind = (table >> (8 * size - 4)).astype(np.uint8)
        wrong = reserved.seen(table, kind)
        sound = len(table) if wrong < 0 else wrong
        yield decode(table[:sound], kind[:sound], byte)
        if wrong >= 0:
            raise Damage(byte + size * wrong, f"word {table[wrong]:#0{2 * size + 2}x} is of type "
                         f"{kind[wrong]:#x}, which {reserved.format} does not define; so are "
                         "many after it", unit)


class Reserved:
    """Words of types that a format reserves or does not define: skipped and counted, because
    firmware pads with them. types: (16,) bool, which types those are.

    If more than `MOST_RESERVED` of a chunk are such, with several values, the file has another
    format or is damaged.
    """

    def __init__(self, types: np.ndarray, format: str) -> None:
        self.types, self.format = types, format
        self.count, self.example = 0, 0

    def seen(self, table: np.ndarray, kind: np.ndarray) -> int:
        """Count those of a chunk; returns the index of the first if there are too many, else -1."""
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
    """A recording without frames from `gather`; `notes` is called at the end."""
    found = gather(path, chunks, hints, size, native)
    return Recording.of_events(found.events, (*notes(), *found.notes))


def gather(
    path: Path, chunks: Iterable[Chunk], hints: Hints, size: Size | None, native: str = "us",
    offset_us: int = 0,
) -> Gathered:
    """The events that `hints` ask for.

    size: what the file says about its sensor, None if nothing. native: unit of t. offset_us: added
    to t.
    Raises EV001 (no event in the range), EV003 and EV007 (not whole), EV004 (order), EV005
    (outside the sensor), EV006 (polarity), EV009 (damage), EV015 (size unknown).
    """
    gathering = Gathering(path, hints, hints.size or size, native, offset_us)
    dropped = Dropped(_sound(chunks, gathering)) if hints.late == "drop" else None
    for chunk in _sound(chunks, gathering) if dropped is None else dropped:
        if len(chunk.t) and gathering.add(chunk):
            break
    gathering.check_damage()
    if dropped is not None:
        gathering.notes += dropped.notes()
    return Gathered(*gathering.result(size))


def _sound(chunks: Iterable[Chunk], gathering: Gathering) -> Iterator[Chunk]:
    """The chunks before any damage."""
    try:
        for chunk in chunks:  # noqa: UP028 (`yield from` would close them: others go on reading)
            yield chunk
    except Damage as e:
        gathering.damaged(e.byte, e.seen, e.unit, e)


def hold(carried: int, values: np.ndarray, at: np.ndarray, n: int) -> np.ndarray:
    """(n,): `carried`, then values[k] from index at[k] on until the next."""
    held = np.empty(len(values) + 1, values.dtype)
    held[0], held[1:] = carried, values
    return np.repeat(held, np.diff(at, prepend=0, append=n))
