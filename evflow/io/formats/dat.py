"""Prophesee DAT (docs.prophesee.ai, file formats): a `% ` header, one byte of event type, one of
event size (8), then records of two little-endian 32-bit words: time in us, which wraps after
71.6 minutes, and x [13:0], y [27:14], polarity [31:28].

Types 0x0C and 0x00 (of older files, such as N-CARS) hold events; others are refused.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from evflow.errors import EvflowDataError
from evflow.io.decode import prophesee
from evflow.io.decode.stream import Chunk, Clock, Damage, collect, cut_at, words
from evflow.io.hints import Hints
from evflow.types import Recording

NAME = "dat"
EXTENSIONS: tuple[str, ...] = (".dat",)

RECORD = np.dtype([("t", "<u4"), ("data", "<u4")])
TYPES = {0x00: "events (2D)", 0x0C: "events (CD)", 0x0E: "triggers"}


def sniff(path: Path, head: bytes) -> bool:
    header = prophesee.parse(head)
    kind = head[header.start : header.start + 2]
    return bool(header.fields) and not header.encoding and (
        "version" in header.fields or (len(kind) == 2 and kind[1] == RECORD.itemsize
                                       and kind[0] in TYPES))


def read(path: Path, hints: Hints) -> Recording:
    """Raises EV008 (not events, or of another version), EV009 (damaged) and what
    `stream.collect` raises."""
    header = prophesee.read_header(path)
    version = header.fields.get("version", "2")
    if version not in ("2", "2.0"):
        raise EvflowDataError(
            "EV008", f"{path} is DAT of version {version[:20]!r}; only version 2 is read.",
            "Its layout differs: convert it with the camera's software.", where=path)
    with open(path, "rb") as f:
        f.seek(header.start)
        kind = f.read(2)
    if len(kind) < 2 or kind[1] != RECORD.itemsize:
        raise EvflowDataError(
            "EV009", f"{path}: after its header, at byte {header.start:,}, are {kind!r}; expected "
            f"an event type and the size {RECORD.itemsize}.", "Cut off? Copy it again.", where=path)
    if kind[0] not in (0x00, 0x0C):
        raise EvflowDataError(
            "EV008", f"{path} holds {TYPES.get(kind[0], 'records of an unknown type')} "
            f"({kind[0]:#04x} at byte {header.start:,}), not events.", "Pass the file of events.",
            where=path)
    size, notes = header.size()
    return collect(path, _chunks(path, header.start + 2), hints, size, lambda: notes)


def _chunks(path: Path, start: int) -> Iterator[Chunk]:
    clock = Clock(32)
    for byte, table in words(path, start, RECORD):
        sound, wrong = cut_at(table["data"] >= 2 << 28, table)
        yield _decode(sound, byte, clock)
        if wrong >= 0:
            raise Damage(byte + 8 * wrong, f"polarity {table['data'][wrong] >> 28} is neither 0 "
                         "nor 1")


def _decode(table: np.ndarray, byte: int, clock: Clock) -> Chunk:
    data = table["data"]
    return Chunk((data & 0x3FFF).astype(np.uint16), ((data >> 14) & 0x3FFF).astype(np.uint16),
                 clock.unwrap(table["t"]), data >= 1 << 28, lambda i: byte + 8 * i)
