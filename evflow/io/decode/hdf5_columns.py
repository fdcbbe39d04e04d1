"""Columns in HDF5 that grow, compressed here as its filters shuffle and gzip would, for any reader.

HDF5 would look for repeats in all bytes alike, which takes twice as long: those of one place in
their numbers are much the same or, as the lower ones of coordinates, nearly random.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from typing import Any

import numpy as np

FILTERS: dict[str, Any] = {"compression": "gzip", "compression_opts": 1, "shuffle": True}
WAYS = ((0, zlib.Z_DEFAULT_STRATEGY), (1, zlib.Z_RLE), (1, zlib.Z_DEFAULT_STRATEGY))  # the fastest
# first: level and strategy of zlib
SAMPLE, WORTH = 8192, 0.98  # bytes on which they are tried; of the size, what more time must save
HEAD, END = b"\x78\x01", b"\x03\x00"  # of a stream of zlib; its last block, which is empty


class Column:
    """A data set (N,) of `FILTERS` whose chunks are written whole; the rest waits until
    `settle`."""

    def __init__(self, data: Any) -> None:
        self.data = data
        self._rest = np.empty(0, data.dtype)

    def extend(self, values: np.ndarray) -> None:
        """Add values (N,) behind the others."""
        begin, (chunk,) = len(self.data) - len(self._rest), self.data.chunks
        self.data.resize(len(self.data) + len(values), axis=0)
        rows = np.concatenate([self._rest, values.astype(self.data.dtype, copy=False)])
        whole = len(rows) - len(rows) % chunk
        self._write(begin, rows[:whole].reshape(-1, chunk))
        self._rest = rows[whole:].copy()

    def settle(self) -> None:
        """Write what waits, so that the data set can be read."""
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
    """A stream of zlib that holds bytes (K, N), each row in its own way."""
    yield HEAD
    yield from map(_packed, planes, ways)
    yield END + zlib.adler32(planes.data).to_bytes(4, "big")


def _packed(plane: np.ndarray, way: tuple[int, int]) -> bytes:
    """Blocks of a stream, whole bytes long."""
    level, strategy = way
    pack = zlib.compressobj(level, zlib.DEFLATED, -15, strategy=strategy)
    return pack.compress(plane.data) + pack.flush(zlib.Z_SYNC_FLUSH)


def _way(plane: np.ndarray) -> tuple[int, int]:
    """The fastest that packs bytes (N,) about as small as the best."""
    found = [len(_packed(plane[:SAMPLE], way)) for way in WAYS]
    return next(way for way, size in zip(WAYS, found, strict=True) if size * WORTH <= min(found))
