"""Prophesee RAW, encoding EVT 3.0 (docs.prophesee.ai, data encoding formats): a `% ` header, then
16-bit words, their type in bits 15-12, that change a state or emit events.

0: row y [10:0]. 2: an event at x [10:0], polarity [11]. 3: vector base, x and polarity the same.
4, 5: events at base + i where bit i of 12 (8) is set; the base advances by 12 (8). 6, 8: low and
high 12 bits of time in us, which wraps every 16.8 s; a new high word starts at low 0. expelliarmus
1.1 writes one high word in all: low bits that begin anew mean the next. A: trigger; 7, E, F: other:
not read. 1, 9, B, C, D are reserved, and pad some recordings (0x9999): counted and skipped, as are
events before the first row, time or base.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from evflow.io.decode import prophesee
from evflow.io.decode.stream import Chunk, Clock, Damage, Reserved, collect, hold, typed, words
from evflow.io.formats.evt2 import leftovers
from evflow.io.hints import Hints
from evflow.notes import Note
from evflow.types import Recording

NAME = "evt3"
EXTENSIONS: tuple[str, ...] = (".raw",)

ROW, SINGLE, BASE, VECTOR_12, VECTOR_8, LOW, HIGH, TRIGGER = 0, 2, 3, 4, 5, 6, 8, 10
RESERVED = np.array([kind in (1, 9, 11, 12, 13) for kind in range(16)])
EMITS = np.array([kind in (SINGLE, VECTOR_12, VECTOR_8) for kind in range(16)])
ADVANCE = np.array([12 * (kind == VECTOR_12) + 8 * (kind == VECTOR_8) for kind in range(16)])
MASK = np.array([{VECTOR_12: 0xFFF, VECTOR_8: 0xFF}.get(kind, 0) for kind in range(16)], np.uint16)
UNKNOWN = -(1 << 24)  # row or base not yet known; stays negative however far a chunk advances it
NEVER = np.iinfo(np.int64).min  # time not yet known
FAR = 1 << 20  # a base beyond any sensor, for vectors without a base word

# The positions of the bits set in each 12-bit mask, concatenated, and where those of a mask begin.
_BITS = (np.arange(1 << 12)[:, None] >> np.arange(12)) & 1
PLACES = np.nonzero(_BITS)[1].astype(np.int16)
PLACES_FROM = (np.cumsum(_BITS.sum(1)) - _BITS.sum(1)).astype(np.int32)


def sniff(path: Path, head: bytes) -> bool:
    return prophesee.sniffed(path, head) == "EVT3"


def read(path: Path, hints: Hints) -> Recording:
    """Raises what `stream.collect` raises."""
    header, _, more = prophesee.raw(path)
    size, notes = header.size()
    decoder = Decoder()
    source = words(path, header.start, f"{header.order}u2")
    return collect(path, decoder.chunks(source), hints, size,
                   lambda: (*notes, *more, *decoder.notes()))


def triggers(path: Path) -> np.ndarray:
    """Times (N,) int64 us of the trigger words, for rising and falling edges."""
    header = prophesee.raw(path)[0]
    return trigger_times(words(path, header.start, f"{header.order}u2"))


def trigger_times(source: Iterator[tuple[int, np.ndarray]]) -> np.ndarray:
    """The same of words (position, uint16), until the first damage."""
    decoder, found = Decoder(), [np.zeros(0, np.int64)]
    with contextlib.suppress(Damage):
        for _, table in source:
            kind = table >> 12
            asked = kind == TRIGGER
            found.append(decoder.times(table, kind, np.cumsum(asked, dtype=np.int32),
                                       int(asked.sum())))
    times = np.concatenate(found)
    return times[times != NEVER]


class Decoder:
    """The state between chunks: time, row, vector base, and what was not read. unit: what the
    source's positions count."""

    def __init__(self, unit: str = "byte") -> None:
        self.clock, self.unit = Clock(12), unit
        self.time, self.row, self.base, self.on = NEVER, UNKNOWN, UNKNOWN, False
        self.stateless = self.triggers = 0
        self.turns = self.turned = 0  # of the low bits: since the last high word, and in all
        self.reserved = Reserved(RESERVED, "EVT3")

    def chunks(self, source: Iterator[tuple[int, np.ndarray]]) -> Iterator[Chunk]:
        return typed(source, self.reserved, self.decode, self.unit)

    def decode(self, table: np.ndarray, kind: np.ndarray, byte: int) -> Chunk:
        self.triggers += int(np.count_nonzero(kind == TRIGGER))
        emits = EMITS[kind]
        rows = np.flatnonzero(emits)
        before = np.cumsum(emits, dtype=np.int32)  # emitting words before each word
        word, kind_of = table[rows], kind[rows]
        single = kind_of == SINGLE
        t = self.times(table, kind, before, len(rows))
        y = self._rows(table, kind, before, len(rows))
        x, p = self._columns(table, kind, before, kind_of)
        value = word & 0x7FF
        x = np.where(single, value, x)
        p = np.where(single, word >= 0x2800, p)  # bit 11 of 0x2xxx
        mask = np.where(single, np.uint16(1), word & MASK[kind_of])
        return self._expand(x, y, t, p, mask, rows, byte)

    def times(
        self, table: np.ndarray, kind: np.ndarray, before: np.ndarray, n: int
    ) -> np.ndarray:
        """Time (n,) int64 us of each emitting word."""
        marks = np.flatnonzero((kind == LOW) | (kind == HIGH))
        is_high = kind[marks] == HIGH
        value = (table[marks] & 0xFFF).astype(np.int64)
        known = self.clock.value
        turn = np.cumsum(is_high)  # high words read, this one included
        high = np.append(known or 0, self.clock.unwrap(value[is_high]))[turn]
        # a high word that repeats the last keeps the low bits; a new one starts at 0
        renews = ~is_high | (np.diff(high, prepend=-1 if known is None else known) != 0)
        last = np.maximum.accumulate(np.where(renews, np.arange(len(marks)), -1))
        before_low = 0 if self.time == NEVER else self.time & 0xFFF
        low = np.where(last < 0, before_low, np.where(is_high, 0, value)[last])
        falls = np.append(before_low, low[:-1]) - low
        if known is None:
            falls[turn == 0] = 0
        turns = self._turns(falls, is_high & renews)
        time = (high + turns << 12) + low
        if known is None:
            time[turn == 0] = NEVER
        out = hold(self.time, time, before[marks], n)
        self.time = int(time[-1]) if len(time) else self.time
        return out

    def _turns(self, falls: np.ndarray, new: np.ndarray) -> np.ndarray:
        """How often the low bits began anew since the last new high word, (n,). falls: (n,) by how
        much each time word lowers them; new: (n,) whether it is a new high word."""
        falls = falls * ~new
        if not len(falls) or (falls.max() <= 0 and not self.turns):
            return np.zeros(len(falls), np.int64)
        epoch = np.cumsum(new)
        carried = np.where(epoch == 0, self.turns, 0)
        far = np.cumsum(falls > 1 << 11)
        since = far - np.append(0, far[new])[epoch] + carried
        # A small fall is time that goes back, unless high words are known to be missing here.
        turn = np.cumsum((falls > 0) & (since > 0))
        turns = turn - np.append(0, turn[new])[epoch] + carried
        self.turns, self.turned = int(turns[-1]), self.turned + int(turn[-1])
        return turns

    def _rows(self, table: np.ndarray, kind: np.ndarray, before: np.ndarray, n: int) -> np.ndarray:
        """y (n,) int32 of each emitting word."""
        marks = np.flatnonzero(kind == ROW)
        row = (table[marks] & 0x7FF).astype(np.int32)
        out = hold(self.row, row, before[marks], n)
        self.row = int(row[-1]) if len(row) else self.row
        return out

    def _columns(
        self, table: np.ndarray, kind: np.ndarray, before: np.ndarray, kind_of: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """x (n,) int32 of bit 0 and polarity of each vector word."""
        marks = np.flatnonzero(kind == BASE)
        width = ADVANCE[kind_of]
        reached = np.cumsum(width)  # columns passed since the chunk began
        passed = np.append(0, reached).astype(np.int32)
        base = (table[marks] & 0x7FF).astype(np.int32) - passed[before[marks]]
        on = (table[marks] & 0x800) != 0
        x = hold(self.base, base, before[marks], len(kind_of)) + passed[:-1]
        p = hold(self.on, on, before[marks], len(kind_of))
        if len(marks):
            self.base, self.on = int(base[-1]), bool(on[-1])
        if self.base != UNKNOWN:
            self.base = min(self.base + int(passed[-1]), FAR)
        return x, p

    def _expand(
        self, x: np.ndarray, y: np.ndarray, t: np.ndarray, p: np.ndarray, mask: np.ndarray,
        rows: np.ndarray, byte: int
    ) -> Chunk:
        """One event per bit of each emitting word's mask."""
        known = (x >= 0) & (y >= 0) & (t != NEVER)
        count = np.bitwise_count(mask)
        if not known.all():
            self.stateless += int(count[~known].sum())
            count = np.where(known, count, 0)
        of = np.repeat(np.arange(len(count), dtype=np.int32), count)
        ends = np.cumsum(count, dtype=np.int64)
        first = PLACES_FROM[mask] - (ends - count)
        place = PLACES[np.arange(len(of)) + first[of]]
        return Chunk(x[of] + place, y[of], t[of], p[of],
                     lambda i: byte + 2 * int(rows[of[i]]), self.unit)

    def notes(self) -> tuple[Note, ...]:
        return (*self._said_of_turns(), *self.reserved.notes(),
                *leftovers(self.stateless, self.triggers))

    def _said_of_turns(self) -> tuple[Note, ...]:
        if not self.turned:
            return ()
        return (Note("events.turns", f"{self.turned:,} times the low 12 bits of time began anew "
                     "without a high word, as expelliarmus writes EVT3: each counts as 4096 us, "
                     "and what a pause was longer than that is lost"),)
