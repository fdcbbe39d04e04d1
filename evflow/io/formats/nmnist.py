"""The .bin of N-MNIST and N-Caltech101 (Orchard et al. 2015): 5 bytes per event, x, y, then 24
bits: the highest is the polarity (ON), the others are us, most significant byte first. An event at
y = 240 is not an event: it adds 2^13 us to all later times.

There is no header: N-MNIST has 34x34 pixels, N-Caltech101 at most 240x180.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from evflow.checks import Size
from evflow.io.decode.stream import Chunk, Damage, collect, words
from evflow.io.hints import Hints
from evflow.notes import Note
from evflow.types import Recording

NAME = "nmnist"
EXTENSIONS: tuple[str, ...] = (".bin",)

RECORD = np.dtype([("x", "u1"), ("y", "u1"), ("t", "u1", (3,))])
OVERFLOW, STEP_US = 240, 1 << 13
NMNIST, NCALTECH = (34, 34), (240, 180)
RISING = 0.9  # of the time steps; in random bytes, half of them rise


def sniff(path: Path, head: bytes) -> bool:
    """Recognised by its name and by times that rarely decrease."""
    if path.suffix.lower() not in EXTENSIONS or len(head) < 2 * RECORD.itemsize:
        return False
    table = np.frombuffer(head, RECORD, len(head) // RECORD.itemsize)
    kept = table[table["y"] != OVERFLOW]
    if len(kept) < 2 or kept["x"].max() >= NCALTECH[0] or kept["y"].max() >= OVERFLOW:
        return False
    return bool((np.diff(_times(kept)) >= 0).mean() >= RISING)


def read(path: Path, hints: Hints) -> Recording:
    """Raises what `stream.collect` raises."""
    size, note = _size(path)
    return collect(path, _chunks(path), hints, size,
                   lambda: () if hints.size else (note,))


def _chunks(path: Path) -> Iterator[Chunk]:
    added = 0
    for byte, table in words(path, 0, RECORD):
        over = table["y"] == OVERFLOW
        rows = np.flatnonzero(~over)
        late = added + STEP_US * np.cumsum(over)
        added = int(late[-1])
        kept = table[rows]
        yield Chunk(kept["x"], kept["y"], _times(kept) + late[rows], kept["t"][:, 0] >= 128,
                    lambda i, byte=byte, rows=rows:  # type: ignore[misc]
                    byte + RECORD.itemsize * int(rows[i]))


def _times(table: np.ndarray) -> np.ndarray:
    high, middle, low = table["t"].T.astype(np.int64)
    us: np.ndarray = (high & 127) << 16 | middle << 8 | low
    return us


def _size(path: Path) -> tuple[Size, Note]:
    """The smaller of the two sizes that fits all events, and the note that says so."""
    reach = 0
    with contextlib.suppress(Damage):  # `read` reports it
        for _, table in words(path, 0, RECORD):
            kept = table[table["y"] != OVERFLOW]
            reach = max([reach, *(int(kept[name].max()) for name in "xy" if len(kept))])
    size, name = (NMNIST, "N-MNIST") if reach < NMNIST[0] else (NCALTECH, "N-Caltech101")
    return size, Note("sensor.size", f"assumed the sensor size of {name}, {size[0]}x{size[1]}: "
                      f"events reach {reach}")
