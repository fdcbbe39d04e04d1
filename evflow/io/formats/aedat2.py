"""AEDAT 2 (jAER; inivation.com, AEDAT file formats): `#` lines, then big-endian pairs of a 32-bit
address and a 32-bit time in us.

DAVIS: bit 31 clear, bit 10 clear = an event: y [30:22], x [21:12], ON [11]; bit 31 set = a sample
with value [9:0] and kind [11:10]: 0 a pixel after its reset, 1 after its exposure (see
`decode.aps`), 3 the IMU. DVS128: y [14:8], x [7:1], OFF [0], bit 15 = sync. DVS640: y [20:11],
x [10:1], ON [0]. y is counted from the bottom, and x of events (not of samples) from the right. IMU
samples and sync words are counted but not read. AEDAT 1 is the same for a DVS128, with addresses of
16 bits.

The chip is named in the header, or else inferred from `size`: 128x128 is a DVS128, anything else a
DAVIS. The simulator v2e (v2ecore/output/aedat2_output.py) names itself instead: its events of
640x480 are those of a DVS640, others those of a DAVIS, and bit 10 marks noise if it labels it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from evflow.checks import Size
from evflow.errors import EvflowDataError
from evflow.io.decode.aps import Aps
from evflow.io.decode.chips import CHIPS, DVS128, chip_size, known_chip
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


class Header(NamedTuple):
    """start: where the data begin; chip: as named, None if it is not; v2e: whether v2e wrote the
    file; labels: whether it marked noise."""

    start: int
    chip: str | None
    v2e: bool
    labels: bool


class Layout(NamedTuple):
    """What the bits of an address mean. x, y: shift and mask; on: shift of the polarity, and its
    value for ON; special: set in words that are no events; samples: whether bit 31 marks samples;
    noise: set in events that v2e labels as noise."""

    chip: str
    x: tuple[int, int]
    y: tuple[int, int]
    on: tuple[int, int]
    special: int = 0
    samples: bool = False
    noise: int = 0


DAVIS = Layout("DAVIS", (12, 1023), (22, 511), (11, 1), special=0x400, samples=True)
DVS = Layout("DVS128", (1, 127), (8, 127), (0, 0), special=0x8000)
VGA = Layout("DVS640", (1, 1023), (11, 1023), (0, 1))
LAYOUTS = {"DVS128": DVS, "TMPDIFF128": DVS, "DVS640": VGA}  # of other chips: DAVIS
V2E_SIZES: tuple[Size, ...] = ((346, 260), (240, 180), (640, 480))


def read(path: Path, hints: Hints) -> Recording:
    """Raises EV003 (labels that overwrote coordinates), EV008 (AEDAT 1 of another chip), EV015
    (unknown chip) and what `Aside.collect` raises."""
    with open(path, "rb") as f:
        head = f.read(MAX_HEADER)
    old, header = head.startswith(OLD), _header(head)
    if old and LAYOUTS.get(known_chip(header.chip or "DVS128") or "") != DVS:
        raise EvflowDataError(
            "EV008", f"{path} is AEDAT 1 of the chip {header.chip!r}; only that of a DVS128 is "
            "read.", "Open it in jAER, and log it again: that writes AEDAT 2.", where=path)
    header = header._replace(chip="DVS128") if old else header
    size = hints.size or chip_size(header.chip)
    if size is None:
        raise _no_size(path, header)
    layout, notes = _layout(path, header, size)
    aside = Aside(path, hints, size)
    chosen = choose([ImageStream("aps", size)] if layout.samples else [], hints, size)
    decoder = Decoder(size, layout, aside, chosen.notes)
    if chosen.stream:
        decoder.aps = Aps(size, aside.append)
    return aside.collect(decoder.chunks(path, header.start, OLD_RECORD if old else RECORD),
                         lambda: (*notes, *decoder.notes()))


def _header(head: bytes) -> Header:
    start, chip, v2e, labels = 0, None, False, False
    while line := LINE.match(head, start):
        start = line.end()
        v2e |= b"AEDat2Output in v2e" in line[0]
        labels |= b"label_signal_noise" in line[0]
        if line[0].startswith(b"# AEChip:"):
            chip = line[0][9:].decode("latin-1").strip().rsplit(".", 1)[-1]
        elif line[0].lower().startswith(b"#end of ascii header"):
            break
    return Header(start, chip, v2e, v2e and labels)


def _no_size(path: Path, header: Header) -> EvflowDataError:
    """EV015 for a header that does not tell the sensor."""
    sizes = ", ".join(f"{width}x{height}" for width, height in V2E_SIZES)
    return EvflowDataError(
        "EV015", f"the header of {path} ({header.start:,} bytes) " + (
            f"names the chip {header.chip!r}, which is unknown." if header.chip else
            "names v2e, but no size." if header.v2e else "names no chip."),
        "Pass size=(width, height), --size WxH; " + (
            f"v2e writes {sizes}." if header.v2e else f"known chips: {', '.join(CHIPS)}."),
        where=path)


def _layout(path: Path, header: Header, size: Size) -> tuple[Layout, tuple[Note, ...]]:
    """The layout by the chip or v2e, else by the size, with a note."""
    if known := known_chip(header.chip):
        return LAYOUTS.get(known, DAVIS), ()
    if header.v2e and size != CHIPS["DVS640"]:
        return DAVIS._replace(special=0, noise=DAVIS.special), ()
    if header.labels:
        raise EvflowDataError(
            "EV003", f"{path} has v2e's labels of noise, which at 640x480 overwrite the highest "
            "bit of x.", "Run v2e without --label_signal_noise, or read its --dvs_h5 or "
            "--dvs_text.", where=path)
    if header.v2e:
        return VGA, ()
    layout = DVS if size == DVS128 else DAVIS
    named = f"the chip {header.chip!r}, which is unknown" if header.chip else "no chip"
    return layout, (Note("events.layout", f"the addresses are assumed to be those of a "
                         f"{layout.chip}, by the size {size[0]}x{size[1]}: the header names "
                         f"{named}"),)


class Decoder:
    """The address layout of a chip, its clock, its frames, and what was not read. aps: the frame
    builder, None if frames are not wanted; chosen: notes on frames, if there are any."""

    def __init__(
        self, size: Size, layout: Layout, aside: Aside, chosen: tuple[Note, ...]
    ) -> None:
        self.size, self.layout, self.aside, self.chosen = size, layout, aside, chosen
        self.clock, self.sample_clock = Clock(32), Clock(32)
        self.aps: Aps | None = None
        self.sampled, self.noise = False, 0
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
        x, y = (events >> shift & mask for shift, mask in (self.layout.x, self.layout.y))
        shift, value = self.layout.on
        on = (events >> shift & 1) == value
        if self.layout.noise:
            self.noise += int(np.count_nonzero(events & self.layout.noise))
        width, height = self.size
        t = self.clock.unwrap(table["t"][rows])
        self.aside.follow(t)
        size = table.dtype.itemsize
        return Chunk(width - 1 - x, height - 1 - y, t, on, lambda i: byte + size * int(rows[i]))

    def _is_event(self, t: np.ndarray, address: np.ndarray) -> np.ndarray:
        sample = (address >> 31 != 0) & self.layout.samples
        sync = ~sample & (address & np.uint32(self.layout.special) != 0)
        kind = address >> 10 & 3
        imu = sample & (kind == 3)
        pixels = sample & (kind < 2)
        self.sampled |= bool(pixels.any())
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
        labels = (Note("events.unread", f"v2e's labels, by which {self.noise:,} events are noise, "
                       "were not read: no command uses or keeps them"),) if self.noise else ()
        return (*(self.chosen if self.sampled else ()),
                *(self.aps.notes() if self.aps else ()), *labels, *notes)
