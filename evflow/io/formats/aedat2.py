"""AEDAT 2 (jAER; inivation.com, AEDAT file formats): `#` lines, then big-endian pairs of a 32-bit
address and a 32-bit time in us.

DAVIS: bit 31 clear, bit 10 clear = an event: y [30:22], x [21:12], ON [11]. DVS128: y [14:8],
x [7:1], OFF [0], bit 15 = sync. jAER counts x from the right and y from the bottom: both are
turned. APS samples, IMU samples and sync words are counted, not read. The chip is in the header;
where it is not, `size` tells it: 128x128 is a DVS128, anything else a DAVIS.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from evflow.checks import Size
from evflow.errors import EvflowDataError
from evflow.io.decode.stream import Chunk, Clock, collect, words
from evflow.io.hints import Hints
from evflow.notes import Note
from evflow.types import Recording

NAME = "aedat2"
EXTENSIONS: tuple[str, ...] = (".aedat", ".aedat2", ".dat")

MAGIC = b"#!AER-DAT2.0"
LINE = re.compile(rb"#[\x20-\x7e\t\x80-\xff]*\r?\n")  # a `#` that begins data meets a zero soon
MAX_HEADER = 1 << 22  # bytes; jAER writes its preferences there, 170 kB of them
RECORD = np.dtype([("address", ">u4"), ("t", ">u4")])
DVS128: Size = (128, 128)
CHIPS: dict[str, Size] = {
    "DAVIS240": (240, 180), "DAVIS346": (346, 260), "DAVIS640": (640, 480),
    "DAVIS208": (208, 192), "DVS128": DVS128, "TMPDIFF128": DVS128,
}


def sniff(path: Path, head: bytes) -> bool:
    return head.startswith(MAGIC)


def read(path: Path, hints: Hints) -> Recording:
    """Raises EV015 (the chip is not known) and what `stream.collect` raises."""
    with open(path, "rb") as f:
        head = f.read(MAX_HEADER)
    start, chip = 0, None
    while line := LINE.match(head, start):
        start = line.end()
        if line[0].startswith(b"# AEChip:"):
            chip = line[0][9:].decode("latin-1").strip().rsplit(".", 1)[-1]
        elif line[0].lower().startswith(b"#end of ascii header"):
            break
    known = next((size for name, size in CHIPS.items() if chip and name in chip.upper()), None)
    size = hints.size or known
    if size is None:
        raise EvflowDataError(
            "EV015", f"the header of {path} ({start:,} bytes) "
            + (f"names the chip {chip!r}, which is not known." if chip else "names no chip."),
            f"Pass size=(width, height), --size WxH; known chips: {', '.join(CHIPS)}.")
    decoder = Decoder(size, (known or size) == DVS128)
    return collect(path, decoder.chunks(path, start), hints, size, decoder.notes)


class Decoder:
    """The address layout of a chip, its clock, and what was not read."""

    def __init__(self, size: Size, dvs128: bool) -> None:
        self.size, self.dvs128, self.clock = size, dvs128, Clock(32)
        self.skipped = {"APS samples": 0, "IMU samples": 0, "sync or special words": 0}

    def chunks(self, path: Path, start: int) -> Iterator[Chunk]:
        for byte, table in words(path, start, RECORD):
            yield self.decode(table, byte)

    def decode(self, table: np.ndarray, byte: int) -> Chunk:
        address = table["address"].astype(np.uint32)
        rows = np.flatnonzero(self._is_event(address))
        events = address[rows].astype(np.int32)
        x, y = ((events >> s) & m for s, m in (
            ((1, 127), (8, 127)) if self.dvs128 else ((12, 1023), (22, 511))))
        on = (events & 1) == 0 if self.dvs128 else (events & 0x800) != 0
        width, height = self.size
        return Chunk(width - 1 - x, height - 1 - y, self.clock.unwrap(table["t"][rows]), on,
                     lambda i: byte + 8 * int(rows[i]))

    def _is_event(self, address: np.ndarray) -> np.ndarray:
        special = np.uint32(0x8000 if self.dvs128 else 0x400)
        sample = (address >> 31 != 0) & (not self.dvs128)
        sync = ~sample & (address & special != 0)
        imu = sample & (address & 0xC00 == 0xC00)
        for name, words_of in (("APS samples", sample & ~imu), ("IMU samples", imu),
                               ("sync or special words", sync)):
            self.skipped[name] += int(np.count_nonzero(words_of))
        return ~(sample | sync)

    def notes(self) -> tuple[Note, ...]:
        return tuple(Note("events.unread", f"{n:,} {name} were not read")
                     for name, n in self.skipped.items() if n)
