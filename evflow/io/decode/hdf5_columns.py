"""Growing HDF5 columns, compressed here in the same format as HDF5's shuffle and gzip filters, for
any reader.

HDF5 would compress all bytes in the same way, which takes twice as long: after the shuffle, bytes
of one place value are either nearly constant or, like the low bytes of coordinates, nearly random.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from typing import Any

import numpy as np

FILTERS: dict[str, Any] = {"compression": "gzip", "compression_opts": 1, "shuffle": True}
WAYS = ((0, zlib.Z_DEFAULT_STRATEGY), (1, zlib.Z_RLE), (1, zlib.Z_DEFAULT_STRATEGY))  # zlib levels
# and strategies, fastest first
SAMPLE, WORTH = 8192, 0.98  # bytes to try them on; a slower way must reach this share of the size
HEAD, END = b"\x78\x01", b"\x03\x00"  # of a zlib stream; its last block, which is empty


class Column:
    """A data set (N,) with `FILTERS`, written in whole chunks; the rest waits for
    `settle`."""

    def __init__(self, data: Any) -> None:
        self.data = data
        self._rest = np.empty(0, data.dtype)

    def extend(self, values: np.ndarray) -> None:
        """Append values (N,)."""
        begin, (chunk,) = len(self.data) - len(self._rest), self.data.chunks
        self.data.resize(len(self.data) + len(values), axis=0)
        rows = np.concatenate([self._rest, values.astype(self.data.dtype, copy=False)])
        whole = len(rows) - len(rows) % chunk
        self._write(begin, rows[:whole].reshape(-1, chunk))
        self._rest = rows[whole:].copy()

    def settle(self) -> None:
        """Write the waiting values, so that the data set can be read."""
        if len(self._rest):
            last = np.zeros((1, *self.data.chunks), self.data.dtype)
            last[0, : len(self._rest)] = self._rest
            self._write(len(self.data) - len(self._rest), last)

    def _write(self, begin: int, chunks: np.ndarray) -> None:
        ways: list[tuple[int, int]] = []
        for number, chunk in enumerate(chunks):
            planes = chunk.view(np.uint8).reshape(len(chunk), -1).T.copy()
            ways = ways or [_way(plane) for plane in planes]
            at = begin + number * len(chunk)
            self.data.id.write_direct_chunk((at,), b"".join(_stream(planes, ways)))


def _stream(planes: np.ndarray, ways: list[tuple[int, int]]) -> Iterator[bytes]:
    """A zlib stream of bytes (K, N), each row compressed in its own way."""
    yield HEAD
    yield from map(_packed, planes, ways)
    yield END + zlib.adler32(planes.data).to_bytes(4, "big")


def _packed(plane: np.ndarray, way: tuple[int, int]) -> bytes:
    """Blocks of a stream that end at a byte boundary."""
    level, strategy = way
    pack = zlib.compressobj(level, zlib.DEFLATED, -15, strategy=strategy)
    return pack.compress(plane.data) + pack.flush(zlib.Z_SYNC_FLUSH)


def _way(plane: np.ndarray) -> tuple[int, int]:
    """The fastest way that compresses bytes (N,) nearly as well as the best."""
    found = [len(_packed(plane[:SAMPLE], way)) for way in WAYS]
    return next(way for way, size in zip(WAYS, found, strict=True) if size * WORTH <= min(found))
