"""When the pictures of a Matroska or WebM file begin.

OpenCV counts times from the first picture but frames from 0: for a film that begins late it claims
more frames than there are. Only element headers are read, up to the film's first block.
"""

from __future__ import annotations

from pathlib import Path
from typing import IO

EBML, SEGMENT, INFO, SCALE, TRACKS, TRACK, NUMBER, KIND, CLUSTER, STAMP, GROUP = (
    0x1A45DFA3, 0x18538067, 0x1549A966, 0x2AD7B1, 0x1654AE6B, 0xAE, 0xD7, 0x83, 0x1F43B675, 0xE7,
    0xA0)
BLOCKS = (0xA3, 0xA1)  # simple, or in a group
INSIDE = (SEGMENT, INFO, TRACKS, TRACK, CLUSTER, GROUP)  # elements that are entered
VIDEO = 1
MOST_ELEMENTS = 10_000  # before the first block: a film has some dozens


def first_stamp_s(path: Path) -> float:
    """Time in seconds of the film's first block; 0 if the file is of another format, or unclear."""
    with open(path, "rb") as f:
        if int.from_bytes(f.read(4), "big") != EBML:
            return 0.0
        f.seek(0)
        try:
            return max(0.0, _first(f))
        except (EOFError, ValueError, OSError):  # OSError: an impossible seek
            return 0.0


def _first(f: IO[bytes]) -> float:
    scale_ns, cluster, number, film = 1_000_000, 0, 0, set[int]()
    for _ in range(MOST_ELEMENTS):
        name, size = _number(f, marked=True), _number(f, marked=False)
        if name in INSIDE:
            continue
        if name in BLOCKS:
            begin = f.tell()
            track, offset = _number(f, marked=False), f.read(2)
            if track in film or not film:
                return (cluster + int.from_bytes(offset, "big", signed=True)) * scale_ns / 1e9
            f.seek(begin + size)
        elif name in (SCALE, NUMBER, KIND, STAMP) and size <= 8:
            value = int.from_bytes(f.read(size), "big")
            scale_ns = value if name == SCALE else scale_ns
            cluster = value if name == STAMP else cluster
            number = value if name == NUMBER else number
            film |= {number} if name == KIND and value == VIDEO else set()
        else:
            f.seek(size, 1)
    return 0.0


def _number(f: IO[bytes], *, marked: bool) -> int:
    """A variable-length number of 1 to 8 bytes; the leading zeros of the first byte give its
    length.
    marked: keep the marker bit after them, as in element ids."""
    first = f.read(1)
    if not first or not first[0]:
        raise EOFError
    length = 9 - first[0].bit_length()
    value = int.from_bytes(first + f.read(length - 1), "big")
    return value if marked else value - (1 << 7 * length)
