"""HDF5's global heap, where variable-length text is stored, checked before HDF5 walks it.

A collection is "GCOL", version u8, 3 bytes, its size u64; then objects {index u16, references u16,
4 bytes, size u64, data up to a multiple of 8}; index 0 is free space, whose size includes its
header (HDF5 file format, III.E). HDF5 advances by each size: it loops forever at free space of size
0, and goes backwards at one near 2^64.
"""

from __future__ import annotations

import io
import os
import struct
from pathlib import Path
from typing import Any

SIGNATURE = b"GCOL"
HEAD = 16  # bytes of the header of a collection, and of an object
MOST = 1 << 16  # objects per collection: their index has 16 bits


class Heaps(io.FileIO):
    """A file under HDF5 in which the signature of a collection that never ends is blanked, so that
    HDF5 refuses it."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, "r")

    def readinto(self, buffer: Any) -> int:
        view, begin = memoryview(buffer).cast("B"), self.tell()
        count = super().readinto(view)
        edge = min(begin, len(SIGNATURE) - 1)  # a signature may begin before the part being read
        seen = os.pread(self.fileno(), count + edge + len(SIGNATURE) - 1, begin - edge)
        at = seen.find(SIGNATURE)
        while at >= 0:
            if not ends(self.fileno(), begin - edge + at):
                first = max(at - edge, 0)
                last = min(at - edge + len(SIGNATURE), count)
                view[first:last] = bytes(last - first)
            at = seen.find(SIGNATURE, at + 1)
        return count


def ends(file: int, begin: int) -> bool:
    """Whether walking the objects of the collection at an offset of an open file reaches its
    end."""
    head = os.pread(file, HEAD, begin)
    if len(head) < HEAD:
        return False
    at, end = begin + HEAD, begin + struct.unpack_from("<Q", head, 8)[0]
    for _ in range(MOST):
        if at + HEAD > end:
            return True
        head = os.pread(file, HEAD, at)
        if len(head) < HEAD:
            return False
        index, _, _, size = struct.unpack("<HHIQ", head)
        step = HEAD + -(-size // 8) * 8 if index else size
        if step < HEAD or at + step > end:
            return False
        at += step
    return False
