"""Checks the blocks of an HDF5 data set before HDF5 decodes them: a block that was never written
reads as zeros, and HDF5 decompresses a block completely, however large, before it compares the
result with the expected size. 20 kB of zeros compressed three times fill a gigabyte.
"""

from __future__ import annotations

import bz2
import math
import os
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py

from evflow.errors import EvflowDataError
from evflow.files.limits import FREE, RATIO, check_expansion

CHECKSUM, DEFLATE, BZIP2, BLOSC, LZ4, BITSHUFFLE, ZSTD = 3, 1, 307, 32001, 32004, 32008, 32015
UNPACKING_BITSHUFFLE = (2, 3)  # values of its fifth option with which it also compresses
HEAD = 18  # bytes of a block in which the filters of TOLD state its decompressed size


def _big(head: bytes) -> int:
    return int.from_bytes(head[:8], "big")


def _blosc(head: bytes) -> int:
    return int.from_bytes(head[4:8], "little")


def _zstd(head: bytes) -> int:
    """Size from the frame's header (RFC 8878, 3.1.1.1); 0 if it is not stated, which the filter
    refuses."""
    flag, single = head[4] >> 6, head[4] >> 5 & 1
    size = 1 << flag if flag or single else 0
    at = 5 + (1 - single) + (0, 1, 2, 4)[head[4] & 3]
    return int.from_bytes(head[at : at + size], "little") + 256 * (size == 2)


TOLD: dict[int, Callable[[bytes], int]] = {
    BLOSC: _blosc, LZ4: _big, BITSHUFFLE: _big, ZSTD: _zstd}
UNPACKED: dict[int, tuple[int, Callable[[], Any]]] = {  # maximum expansion per byte
    DEFLATE: (1032, zlib.decompressobj), BZIP2: (1 << 16, bz2.BZ2Decompressor)}


def check_blocks(path: Path, data: Any) -> None:
    """Raise EV009 if blocks of a data set are missing, or expand beyond their size and limits."""
    if not data.size:
        return
    made, stored = data.id.get_create_plist(), os.path.getsize(path)
    if made.get_layout() != h5py.h5d.CHUNKED:
        if data.id.get_space_status() == h5py.h5d.SPACE_STATUS_NOT_ALLOCATED:
            raise _damaged(path, data, "was never written")
        return
    block = math.prod(data.chunks) * data.dtype.itemsize
    check_expansion(block, stored, f"{path}: a block of {data.name}")
    found: list[Any] = []
    data.id.chunk_iter(found.append)
    sides = zip(data.shape, data.chunks, strict=True)
    if len(found) < (expected := math.prod(-(-side // part) for side, part in sides)):
        raise _damaged(path, data, f"has {len(found):,} of its {expected:,} blocks")
    for number, skipped in _packing(path, data, made):
        for info in found:
            size = 0 if info.filter_mask & skipped else _expanded(
                data, info, number, block, FREE + RATIO * stored)
            if size > block:
                raise _damaged(path, data, f"has a block of {info.size:,} bytes that expands to "
                               f"{size:,} or more, not {block:,}")


def _packing(path: Path, data: Any, made: Any) -> list[tuple[int, int]]:
    """The compression filter, if it is a known one, with the flag of blocks that skip it; EV009 if
    other filters come after it, whose blocks would be decompressed first."""
    filters = [made.get_filter(i) for i in range(made.get_nfilters())]
    known = [(number, 1 << i) for i, (number, _, options, _) in enumerate(filters)
             if number in {*TOLD, *UNPACKED} and (
                 number != BITSHUFFLE or (*options, *(0,) * 5)[4] in UNPACKING_BITSHUFFLE)]
    behind = [number for number, *_ in filters[known[0][1].bit_length():]] if known else []
    if any(number != CHECKSUM for number in behind):
        raise _damaged(path, data, f"went through filter {known[0][0]} and then {behind}")
    return known


def _expanded(data: Any, info: Any, number: int, block: int, most: int) -> int:
    """Decompressed bytes of a stored block, as far as they need to be known."""
    if number not in TOLD and UNPACKED[number][0] * info.size <= most:
        return 0
    _, raw = data.id.read_direct_chunk(info.chunk_offset)
    if number in TOLD:
        return TOLD[number](raw[:HEAD].ljust(HEAD, b"\0"))
    try:
        return len(UNPACKED[number][1]().decompress(raw, max_length=block + 1))
    except (zlib.error, OSError, EOFError, ValueError):  # HDF5 will report it
        return 0


def _damaged(path: Path, data: Any, what: str) -> EvflowDataError:
    return EvflowDataError("EV009", f"{path}: {data.name} {what}.",
                           "Its writer was interrupted, or it is hostile: write it again.",
                           where=path)
