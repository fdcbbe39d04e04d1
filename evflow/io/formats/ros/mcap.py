"""MCAP files of ROS 2 (mcap.dev/spec): records {u8 kind, u64 size, size bytes}; messages are
records or lie in chunks, compressed by LZ4 or zstd.

What a record claims is checked against the file; indices are not used, as all records are scanned
once. Any damage raises ValueError, struct.error or a decoder's error; of a file that was cut off
the whole records can be read alone.
"""

from __future__ import annotations

import array
import heapq
import operator
import os
import struct
import zlib
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from evflow.files.compressed import unpack
from evflow.files.limits import RATIO, check_expansion

MAGIC = b"\x89MCAP0\r\n"
HEADER, SCHEMA, CHANNEL, MESSAGE, CHUNK, STATISTICS = 0x01, 0x03, 0x04, 0x05, 0x06, 0x0B
LARGEST = 1 << 28  # bytes of a record that is read into memory
LARGEST_CHUNK = 1 << 26  # bytes above which it must not expand more than recordings do
Timed = tuple[int, bytes | None]  # time in ns, message


class Chunk(NamedTuple):
    """first: its earliest time in ns; start, stored: offset and size of its compressed records."""

    first: int
    start: int
    stored: int
    size: int
    crc: int
    compression: str


class Mcap:
    """An open file. partial: read the records before the first that is not whole; counts: messages
    by (topic, type); damage: what is wrong with that record, "" if nothing is."""

    def __init__(self, path: Path, *, partial: bool = False) -> None:
        self.damage = ""
        self._file = open(path, "rb")  # noqa: SIM115 (closed by `close`)
        self._total = os.path.getsize(path)
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, tuple[str, int]] = {}
        self._loose = tuple(array.array("Q") for _ in range(3))  # outside of chunks: time, place
        self._chunks: list[Chunk] = []
        try:
            stated = self._scan(partial)
            check_expansion(sum(chunk.size for chunk in self._chunks), self._total, path)
            counted = stated if stated is not None and self._described(stated) else self._counted()
        except BaseException:
            self.close()
            raise
        self.counts: Counter[tuple[str, str]] = Counter()
        for channel, (topic, schema) in self._channels.items():
            self.counts[topic, self._schemas.get(schema, "")] += counted[channel]

    def close(self) -> None:
        self._file.close()

    def messages(self, topics: Collection[str]) -> Iterator[tuple[int, bytes]]:
        """(log time in ns, message) of the topics, in order of time."""
        wanted = {channel for channel, (topic, _) in self._channels.items() if topic in topics}
        parts = [self._part(chunk, wanted) for chunk in self._chunks]
        for time, raw in heapq.merge(self._single(wanted), *parts, key=operator.itemgetter(0)):
            if raw is not None:
                yield time, raw

    def _single(self, wanted: set[int]) -> Iterator[Timed]:
        """The messages outside chunks, in order."""
        times, starts, sizes = (np.asarray(column) for column in self._loose)
        for index in np.argsort(times, kind="stable").tolist():
            body = self._take(int(starts[index]), int(sizes[index]))
            if (pair := self._message(body, wanted)) is not None:
                yield pair

    def _part(self, chunk: Chunk, wanted: set[int]) -> Iterator[Timed]:
        """A chunk's messages in order, preceded by its first time alone, so that it is unpacked
        only when that time is reached."""
        yield chunk.first, None
        found = [pair for kind, body in self._unpacked(chunk) if kind == MESSAGE
                 and (pair := self._message(body, wanted)) is not None]
        yield from sorted(found, key=operator.itemgetter(0))

    def _message(self, body: bytes, wanted: set[int]) -> Timed | None:
        channel, _, time, _ = struct.unpack_from("<HIQQ", body)
        if channel not in self._channels:
            raise ValueError(f"a message of channel {channel}, which the file does not describe")
        return (time, body[22:]) if channel in wanted else None

    def _unpacked(self, chunk: Chunk) -> Iterator[tuple[int, bytes]]:
        data = self._take(chunk.start, chunk.stored)
        if chunk.compression:
            data = unpack(data, chunk.compression, chunk.size)
        if len(data) != chunk.size or (chunk.crc and zlib.crc32(data) != chunk.crc):
            raise ValueError("a chunk has a wrong checksum")
        at = 0
        while at < len(data):
            kind, size = struct.unpack_from("<BQ", data, at)
            at += 9
            if size > len(data) - at:
                raise ValueError("a record reaches beyond its chunk")
            yield kind, data[at : at + size]
            at += size

    def _scan(self, partial: bool) -> Counter[int] | None:
        """Index all records; returns the messages by channel if the file has statistics."""
        if self._take(0, len(MAGIC)) != MAGIC:
            raise ValueError("it lacks MCAP's first bytes")
        ended = self._take(self._total - len(MAGIC), len(MAGIC)) == MAGIC
        at, end, stated, chunks = len(MAGIC), self._total - len(MAGIC) * ended, None, 0
        try:
            while at < end:
                kind, at, size = self._index(at, end)
                if kind == STATISTICS:
                    stated, chunks = _statistics(self._take(at, size))
                at += size
            if not ended:
                raise ValueError("it lacks MCAP's last bytes")
        except (ValueError, struct.error) as e:
            if not (partial and (self._chunks or self._loose[0])):
                raise
            self.damage = f"at byte {at:,}: {e}"
        if stated is not None and chunks != len(self._chunks):
            raise ValueError(f"it has {len(self._chunks)} of {chunks} chunks")
        return stated

    def _index(self, at: int, end: int) -> tuple[int, int, int]:
        """Kind, begin and size of the content of the record at a byte, which is indexed or
        described."""
        kind, size = struct.unpack("<BQ", self._take(at, 9))
        at += 9
        if size > end - at:
            raise ValueError(f"a record claims {size:,} bytes, {end - at:,} are left")
        if kind == MESSAGE:
            _, _, time, _ = struct.unpack("<HIQQ", self._take(at, 22))
            for column, value in zip(self._loose, (time, at, size), strict=True):
                column.append(value)
        elif kind == CHUNK:
            self._chunks.append(self._chunk(at, size))
        elif kind in (HEADER, SCHEMA, CHANNEL):
            self._describe(kind, self._take(at, size))
        return kind, at, size

    def _describe(self, kind: int, body: bytes) -> None:
        if kind == HEADER and _text(body, 0)[0] != "ros2":
            raise ValueError("its profile is not that of ROS 2")
        if kind == SCHEMA:
            self._schemas[struct.unpack_from("<H", body)[0]] = _text(body, 2)[0]
        if kind == CHANNEL:
            channel, schema = struct.unpack_from("<HH", body)
            topic, at = _text(body, 4)
            encoding, _ = _text(body, at)
            if encoding != "cdr":
                raise ValueError(f"messages of {topic[:80]} are encoded as {encoding[:20]!r}")
            self._channels[channel] = topic, schema

    def _described(self, counts: Counter[int]) -> bool:
        """Whether the file describes these channels outside its chunks."""
        known = {channel for channel, (_, schema) in self._channels.items()
                 if schema in self._schemas}
        return counts.keys() <= known

    def _counted(self) -> Counter[int]:
        """Messages by channel, for a file without statistics, whose channels may be in chunks."""
        counts: Counter[int] = Counter()
        for chunk in self._chunks:
            for kind, body in self._unpacked(chunk):
                self._describe(kind, body)
                if kind == MESSAGE:
                    counts[struct.unpack_from("<H", body)[0]] += 1
        for start in self._loose[1]:
            counts[struct.unpack("<H", self._take(start, 2))[0]] += 1
        return counts

    def _chunk(self, at: int, size: int) -> Chunk:
        first, _, whole, crc = struct.unpack("<QQQI", self._take(at, 28))
        compression, behind = _text(self._take(at + 28, min(size - 28, 64)), 0)
        (stored,) = struct.unpack("<Q", self._take(at + 28 + behind, 8))
        start = at + 36 + behind
        if stored > at + size - start:
            raise ValueError(f"a chunk claims {stored:,} bytes and has {at + size - start:,}")
        if whole > LARGEST_CHUNK + RATIO * stored:
            raise ValueError(f"a chunk of {stored:,} bytes claims {whole:,}")
        return Chunk(first, start, stored, whole, crc, compression)

    def _take(self, start: int, size: int) -> bytes:
        """Bytes of the file at an offset."""
        if not 0 <= size <= min(LARGEST, self._total - start):
            raise ValueError(f"a record claims {size:,} bytes")
        self._file.seek(start)
        data = self._file.read(size)
        if len(data) != size:
            raise ValueError("it ends early")
        return data


def _text(body: bytes, at: int) -> tuple[str, int]:
    """The string at byte `at`, and its end."""
    (size,) = struct.unpack_from("<I", body, at)
    if size > len(body) - at - 4:
        raise ValueError("a string reaches beyond its record")
    return body[at + 4 : at + 4 + size].decode("utf-8", "replace"), at + 4 + size


def _statistics(body: bytes) -> tuple[Counter[int], int]:
    """Messages by channel, and the number of chunks."""
    *_, chunks, _, _, size = struct.unpack_from("<QHIIIIQQI", body)
    if size % 10 or size != len(body) - 46:
        raise ValueError("its statistics are damaged")
    return Counter(dict(struct.iter_unpack("<HQ", body[46:]))), chunks
