"""AEDAT 2 (jAER; inivation.com, AEDAT file formats): `#` lines, then big-endian pairs of a 32-bit
address and a 32-bit time in us.

DAVIS: bit 31 clear, bit 10 clear = an event: y [30:22], x [21:12], ON [11]; bit 31 set = a sample
with value [9:0] and kind [11:10]: 0 a pixel after its reset, 1 after its exposure (see
`decode.aps`), 3 the IMU. DVS128: y [14:8], x [7:1], OFF [0], bit 15 = sync. jAER counts y from the
bottom, and x of events (not of samples) from the right. IMU samples and sync words are counted but
not read. The chip is named in the header, or else inferred from `size`: 128x128 is a DVS128,
anything else a DAVIS. AEDAT 1 is the same for a DVS128, with addresses of 16 bits.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from evflow.checks import Size
from evflow.errors import EvflowDataError
from evflow.io.decode.aps import Aps
from evflow.io.decode.chips import CHIPS, DVS128, chip_size
from evflow.io.decode.stream import Chunk, Clock, words
from evflow.io.hints import Hints
from evflow.io.images.aside import Aside
from evflow.io.images.streams import ImageStream, choose
from evflow.notes import Note
from evflow.types import Recording

NAME = "aedat2"
EXTENSIONS: tuple[str, ...] = (".aedat", ".aedat2", ".dat")

MAGIC, OLD = b"#!AER-DAT2.0", b"#!AER-DAT1.0"
LINE = re.compile(rb"#[\x20-\x7e\t\x80-\xff]*\r?\n")  # data that begin with `#` soon have a zero
MAX_HEADER = 1 << 22  # bytes; jAER writes its preferences there, 170 kB of them
RECORD = np.dtype([("address", ">u4"), ("t", ">u4")])
OLD_RECORD = np.dtype([("address", ">u2"), ("t", ">u4")])


def sniff(path: Path, head: bytes) -> bool:
    return head.startswith((MAGIC, OLD))


def read(path: Path, hints: Hints) -> Recording:
    """Raises EV008 (AEDAT 1 of another chip), EV015 (unknown chip) and what `Aside.collect`
    raises."""
    with open(path, "rb") as f:
        head = f.read(MAX_HEADER)
    start, chip = 0, None
    while line := LINE.match(head, start):
        start = line.end()
        if line[0].startswith(b"# AEChip:"):
            chip = line[0][9:].decode("latin-1").strip().rsplit(".", 1)[-1]
        elif line[0].lower().startswith(b"#end of ascii header"):
            break
    old = head.startswith(OLD)
    known = chip_size(chip) or (DVS128 if old and chip is None else None)
    if old and known != DVS128:
        raise EvflowDataError(
            "EV008", f"{path} is AEDAT 1 of the chip {chip!r}; only that of a DVS128 is read.",
            "Open it in jAER, and log it again: that writes AEDAT 2.", where=path)
    size = hints.size or known
    if size is None:
        raise EvflowDataError(
            "EV015", f"the header of {path} ({start:,} bytes) "
            + (f"names the chip {chip!r}, which is unknown." if chip else "names no chip."),
            f"Pass size=(width, height), --size WxH; known chips: {', '.join(CHIPS)}.", where=path)
    dvs128 = (known or size) == DVS128
    aside = Aside(path, hints, size)
    decoder = Decoder(size, dvs128, aside)
    record = OLD_RECORD if old else RECORD
    chosen = choose([] if dvs128 else [ImageStream("aps", size)], hints, size)
    if chosen.stream:
        decoder.aps = Aps(size, aside.append)
    return aside.collect(decoder.chunks(path, start, record), decoder.notes)


class Decoder:
    """The address layout of a chip, its clock, its frames, and what was not read. aps: the frame
    builder; None if frames are not wanted."""

    def __init__(self, size: Size, dvs128: bool, aside: Aside) -> None:
        self.size, self.dvs128, self.aside = size, dvs128, aside
        self.clock, self.sample_clock = Clock(32), Clock(32)
        self.aps: Aps | None = None
        self.skipped = {"APS samples": 0, "IMU samples": 0, "sync or special words": 0}

    def chunks(self, path: Path, start: int, record: np.dtype) -> Iterator[Chunk]:
        for byte, table in words(path, start, record):
            if self.aside.done:
                return
            yield self.decode(table, byte)
        if self.aps:
            self.aps.finish()

    def decode(self, table: np.ndarray, byte: int) -> Chunk:
        address = table["address"].astype(np.uint32)
        rows = np.flatnonzero(self._is_event(table["t"], address))
        events = address[rows].astype(np.int32)
        x, y = ((events >> s) & m for s, m in (
            ((1, 127), (8, 127)) if self.dvs128 else ((12, 1023), (22, 511))))
        on = (events & 1) == 0 if self.dvs128 else (events & 0x800) != 0
        width, height = self.size
        t = self.clock.unwrap(table["t"][rows])
        self.aside.follow(t)
        size = table.dtype.itemsize
        return Chunk(width - 1 - x, height - 1 - y, t, on, lambda i: byte + size * int(rows[i]))

    def _is_event(self, t: np.ndarray, address: np.ndarray) -> np.ndarray:
        special = np.uint32(0x8000 if self.dvs128 else 0x400)
        sample = (address >> 31 != 0) & (not self.dvs128)
        sync = ~sample & (address & special != 0)
        kind = address >> 10 & 3
        imu = sample & (kind == 3)
        pixels = sample & (kind < 2)
        event = ~(sample | sync)
        read = np.zeros(len(address), bool)
        if self.aps and pixels.any():
            read = pixels
            self._sampled(self.aps, address[pixels], t, event, pixels)
        for name, words_of in (("APS samples", sample & ~imu & ~read), ("IMU samples", imu),
                               ("sync or special words", sync)):
            self.skipped[name] += int(np.count_nonzero(words_of))
        return event

    def _sampled(
        self, aps: Aps, samples: np.ndarray, t: np.ndarray, event: np.ndarray, pixels: np.ndarray
    ) -> None:
        """Samples (n,) passed to the frame builder, with times on the events' clock."""
        if self.sample_clock.value is None:
            near = self.clock.value
            if near is None and event.any():
                near = int(t[event][0])
            self.sample_clock.value = near
        bits = samples.astype(np.int32)
        aps.add(bits >> 10 & 3, bits >> 12 & 1023, self.size[1] - 1 - (bits >> 22 & 511),
                self.sample_clock.unwrap(t[pixels]), bits & 1023)

    def notes(self) -> tuple[Note, ...]:
        notes = tuple(Note("events.unread", f"{n:,} {name} were not read")
                     for name, n in self.skipped.items() if n)
        return (*(self.aps.notes() if self.aps else ()), *notes)
