"""Prophesee RAW, encoding EVT 2.0 (docs.prophesee.ai, data encoding formats): a `% ` header, then
32-bit words, their type in bits 31-28.

0, 1: an event, OFF or ON: time [27:22] (the low 6 bits), x [21:11], y [10:0]. 8: the high 28 bits
of time, in 64 us; they wrap after 4.8 hours. A: trigger; E, F: other: counted but not read. Other
types are reserved: counted and skipped. Times stay on the sensor's clock. Events before the first
time word have no time and are left out.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from evflow.errors import EvflowDataError
from evflow.io.decode import prophesee
from evflow.io.decode.stream import Chunk, Clock, Damage, Reserved, collect, typed, words
from evflow.io.hints import Hints
from evflow.notes import Note
from evflow.types import Recording

NAME = "evt2"
EXTENSIONS: tuple[str, ...] = (".raw",)

TIME, TRIGGER, NEITHER = 0x8, 0xA, 0xF
RESERVED = np.array([kind not in (0, 1, TIME, TRIGGER, 0xE, 0xF) for kind in range(16)])


def sniff(path: Path, head: bytes) -> bool:
    """EVT 2.0, and encodings without a reader, which `read` names in its error."""
    return prophesee.sniffed(path, head) not in ("", "EVT2.1", "EVT3")


def read(path: Path, hints: Hints) -> Recording:
    """Raises EV008 (another encoding) and what `stream.collect` raises."""
    header, encoding, more = prophesee.raw(path)
    if encoding != "EVT2":
        raise EvflowDataError(
            "EV008", f"{path} is Prophesee RAW of encoding {encoding}; supported are EVT2, "
            "EVT2.1 and EVT3.", "Convert it with Metavision: metavision_file_to_dat or "
            "metavision_file_to_csv.", where=path)
    size, notes = header.size()
    decoder = Decoder()
    source = words(path, header.start, f"{header.order}u4")
    return collect(path, decoder.chunks(source), hints, size,
                   lambda: (*notes, *more, *decoder.notes()))


def triggers(path: Path) -> np.ndarray:
    """Times (N,) int64 us of the trigger words, for rising and falling edges."""
    header = prophesee.raw(path)[0]
    return trigger_times(words(path, header.start, f"{header.order}u4"))


def trigger_times(source: Iterator[tuple[int, np.ndarray]]) -> np.ndarray:
    """Trigger times from 32-bit words, up to any damage."""
    decoder, found = Decoder(), [np.zeros(0, np.int64)]
    with contextlib.suppress(Damage):
        for _, table in source:
            kind = (table >> 28).astype(np.uint8)
            found.append(decoder.timed(table, np.where(
                kind == TRIGGER, 0, np.where(kind == TIME, TIME, NEITHER)))[2])
    return np.concatenate(found)


class Decoder:
    """The state between chunks: the high time bits, and what was not read."""

    def __init__(self) -> None:
        self.clock = Clock(28)
        self.timeless = self.triggers = 0
        self.reserved = Reserved(RESERVED, "EVT2")

    def chunks(self, source: Iterator[tuple[int, np.ndarray]]) -> Iterator[Chunk]:
        return typed(source, self.reserved, self.decode)

    def decode(self, table: np.ndarray, kind: np.ndarray, byte: int) -> Chunk:
        rows, sent, t, early = self.timed(table, kind)
        self.timeless += len(early)
        x, y, p = fields(sent)
        return Chunk(x, y, t, p, lambda i: byte + 4 * int(rows[i]))

    def timed(
        self, table: np.ndarray, kind: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Indices (n,) of event words, these words (n,), their times (n,) int64 us, and indices of
        events before the first time word."""
        marks = np.flatnonzero(kind == TIME)
        rows = np.flatnonzero(kind < 2)
        before = self.clock.value
        high = np.append(before or 0, self.clock.unwrap(table[marks] & 0xFFFFFFF))
        edges = np.searchsorted(rows, marks)
        lost = 0
        if before is None:
            lost = int(edges[0]) if len(edges) else len(rows)
            edges = edges - lost
        self.triggers += int(np.count_nonzero(kind == TRIGGER))
        early, rows = rows[:lost], rows[lost:]
        t = np.repeat(high << 6, np.diff(edges, prepend=0, append=len(rows)))
        sent = table[rows]
        t += (sent >> 22) & 63
        return rows, sent, t, early

    def notes(self) -> tuple[Note, ...]:
        return (*self.reserved.notes(), *leftovers(self.timeless, self.triggers))


def fields(words: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """x, y and polarity of event words (n,)."""
    return ((words >> 11) & 0x7FF).astype(np.uint16), (words & 0x7FF).astype(np.uint16), (
        words >= 1 << 28)


def leftovers(timeless: int, triggers: int) -> tuple[Note, ...]:
    """Notes on the content of a RAW stream that the recording does not contain."""
    notes = []
    if timeless:
        notes.append(Note("events.timeless", f"{timeless:,} events before the first time or row "
                          "word were left out: the file begins in the middle of the stream"))
    if triggers:
        notes.append(Note("events.unread", f"external triggers ({triggers:,}) are "
                          "no events: evflow estimate --protocol step --triggers uses them"))
    return tuple(notes)
