"""Prophesee RAW, encoding EVT 2.1 (docs.prophesee.ai, data encoding formats): a `% ` header, then
64-bit words, whose upper half is a word of EVT 2.0.

Types 0 and 1 stand for up to 32 events of one row, time and polarity: at x + i for each bit i set
in the lower half. The GenX320 sends each word as a whole, the IMX636 its upper half first
("endianness=legacy"); if the header does not say, the order in which the first words make sense is
used.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from evflow.io.decode import prophesee
from evflow.io.decode.stream import Chunk, Reserved, collect, words
from evflow.io.formats import evt2
from evflow.io.hints import Hints
from evflow.notes import Note
from evflow.types import Recording

NAME = "evt2.1"
EXTENSIONS: tuple[str, ...] = (".raw",)

HALF = np.uint64(32)
TRIED = 1 << 15  # words that decide the order of halves

# The positions of the bits set in each byte, concatenated, and where those of a byte begin.
_BITS = (np.arange(1 << 8)[:, None] >> np.arange(8)) & 1
PLACES = np.nonzero(_BITS)[1].astype(np.uint16)
PLACES_FROM = np.cumsum(_BITS.sum(1)) - _BITS.sum(1)


def sniff(path: Path, head: bytes) -> bool:
    return prophesee.sniffed(path, head) == "EVT2.1"


def read(path: Path, hints: Hints) -> Recording:
    """Raises what `stream.collect` raises."""
    header, _, guessed = prophesee.raw(path)
    size, notes = header.size()
    swapped, more = _halves_swapped(path, header)
    decoder = Decoder()
    source = _whole(words(path, header.start, f"{header.order}u8"), swapped)
    return collect(path, decoder.chunks(source), hints, size,
                   lambda: (*notes, *guessed, *more, *decoder.notes()))


def triggers(path: Path) -> np.ndarray:
    """Times (N,) int64 us of the trigger words, for rising and falling edges."""
    header = prophesee.raw(path)[0]
    swapped = _halves_swapped(path, header)[0]
    source = _whole(words(path, header.start, f"{header.order}u8"), swapped)
    return evt2.trigger_times((byte, (table >> HALF).astype(np.uint32)) for byte, table in source)


class Decoder(evt2.Decoder):
    """The decoder of EVT 2.0, for words that stand for several events."""

    def __init__(self) -> None:
        super().__init__()
        self.reserved = Reserved(evt2.RESERVED, "EVT2.1")

    def decode(self, table: np.ndarray, kind: np.ndarray, byte: int) -> Chunk:
        upper, mask = (table >> HALF).astype(np.uint32), table.astype(np.uint32)
        rows, sent, t, early = self.timed(upper, kind)
        self.timeless += int(np.bitwise_count(mask[early]).sum())
        x, y, p = evt2.fields(sent)
        of, place = _bits_set(mask[rows])
        return Chunk(x[of] + place, y[of], t[of], p[of], lambda i: byte + 8 * int(rows[of[i]]))


def _bits_set(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For each bit set in masks (n,) uint32, lowest first: the index of its mask and its position
    (uint16). Works byte by byte, as most bytes are 0."""
    parts = mask.astype("<u4").view(np.uint8)
    some = np.flatnonzero(parts)
    count = np.bitwise_count(parts[some])
    ends = np.cumsum(count, dtype=np.int64)
    first = PLACES_FROM[parts[some]] - (ends - count)
    at = np.repeat(some, count)
    place = PLACES[np.arange(len(at)) + np.repeat(first, count)]
    return at >> 2, place + ((at & 3) << 3).astype(np.uint16)


def _whole(
    source: Iterator[tuple[int, np.ndarray]], swapped: bool
) -> Iterator[tuple[int, np.ndarray]]:
    """Words whose halves are exchanged in the file."""
    for byte, table in source:
        yield byte, _swap(table) if swapped else table


def _swap(table: np.ndarray) -> np.ndarray:
    swapped: np.ndarray = table << HALF | table >> HALF
    return swapped


def _halves_swapped(path: Path, header: prophesee.Header) -> tuple[bool, tuple[Note, ...]]:
    """Whether the upper half of each word comes first; and a note if the words contradict the
    header (OpenEB reads its silence as no) or there is none."""
    layout = header.fields.get("format", "").lower()
    if "endianness=" in layout:
        return "endianness=legacy" in layout, ()
    with open(path, "rb") as f:
        f.seek(header.start)
        data = f.read(8 * TRIED)
    table = np.frombuffer(data, f"{header.order}u8", len(data) // 8)
    swapped = _sense(_swap(table)) > _sense(table)
    if layout and not swapped:
        return False, ()
    order = "legacy (IMX636)" if swapped else "little"
    return swapped, (Note("events.layout", "the header does not say which half of a word comes "
                          f"first: inferred from the first words to be {order}"),)


def _sense(table: np.ndarray) -> tuple[int, int]:
    """How steadily the words of type time advance (those made of mask bits do not), and how many
    words have a known type."""
    kind = (table >> np.uint64(60)).astype(np.uint8)
    high = (table[kind == evt2.TIME] >> HALF) & np.uint64(0xFFFFFFF)
    back = int((high[1:] < high[:-1]).sum())
    return len(high) - 3 * back, int((~evt2.RESERVED[kind]).sum())
