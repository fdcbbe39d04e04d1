"""Frames of zstd, LZ4 and bzip2, unpacked up to a limit; and how large zstd and LZ4 frames may
become, from their block headers alone.

A zstd block of 4 bytes stands for 128 KiB of one byte, so 1 MB of them expands to 32 GB (RFC 8878,
3.1.1; lz4_Frame_format.md). Decoders without a limit are called only after `most_bytes`.
"""

from __future__ import annotations

import struct
from typing import Any

ZSTD, LZ4 = b"\x28\xb5\x2f\xfd", b"\x04\x22\x4d\x18"
SKIPPED = b"\x2a\x4d\x18"  # after a byte 0x50 to 0x5f: a skippable frame of either format
ZSTD_BLOCK = 1 << 17
LZ4_RATIO = 255


def decoder_of(kind: str) -> Any:
    """A decoder for "zstd", "lz4" or "bz2" with decompress(data, max_length), eof and unused_data;
    ImportError if its package is missing, ValueError for other names."""
    if kind == "zstd":
        try:
            from compression import zstd  # type: ignore[import-not-found, unused-ignore]
        except ImportError:
            from backports import zstd
        return zstd.ZstdDecompressor()
    if kind == "lz4":
        from lz4.frame import LZ4FrameDecompressor

        return LZ4FrameDecompressor()
    if kind == "bz2":
        import bz2

        return bz2.BZ2Decompressor()
    raise ValueError(f"compression {kind[:20]!r} is unknown")


def unpack(data: bytes, kind: str, most: int) -> bytes:
    """The content of all frames in `data`; ValueError if it exceeds `most` bytes or is cut off, and
    the decoder's own errors on damage."""
    parts, left, rest = list[bytes](), most, data
    while rest:
        decoder = decoder_of(kind)
        parts.append(decoder.decompress(rest, max_length=left + 1))
        left -= len(parts[-1])
        if left < 0 or not decoder.eof:
            raise ValueError(f"{len(data):,} bytes of {kind} are cut off, or expand to more than "
                             f"{most:,}")
        rest = decoder.unused_data or b""
    return b"".join(parts)


def most_bytes(data: bytes) -> int:
    """Upper bound on the bytes that the frames in `data` hold; its length if it is not compressed.
    Nothing after damage counts: no decoder gets there."""
    read = {ZSTD: _zstd, LZ4: _lz4}
    at = total = 0
    try:
        while magic := bytes(data[at : at + 4]):
            if magic[:1] and magic[0] >> 4 == 5 and magic[1:] == SKIPPED:
                at += 8 + struct.unpack_from("<I", data, at + 4)[0]
            elif magic in read:
                at, size = read[magic](data, at + 4)
                total += size
            else:
                break
    except (struct.error, IndexError):
        pass
    return max(total, len(data))


def _zstd(data: bytes, at: int) -> tuple[int, int]:
    """(offset of the end of the frame whose magic is before `at`, upper bound on its bytes)."""
    flags = data[at]
    single, checksum = flags >> 5 & 1, flags >> 2 & 1
    dictionary, content = (0, 1, 2, 4)[flags & 3], (single, 2, 4, 8)[flags >> 6]
    at += 1 + (1 - single) + dictionary + content
    total = last = 0
    while not last and at < len(data):
        header = int.from_bytes(data[at : at + 3], "little")
        last, kind, size = header & 1, header >> 1 & 3, header >> 3
        total += ZSTD_BLOCK if kind == 2 else min(size, ZSTD_BLOCK)  # 0: raw, 1: one byte repeated
        at += 3 + (1 if kind == 1 else size)
    return at + 4 * checksum, total


def _lz4(data: bytes, at: int) -> tuple[int, int]:
    flags, block = data[at], 1 << 8 + 2 * (data[at + 1] >> 4 & 7)  # 64 KiB to 4 MiB
    per_block, content, checksum, dictionary = (flags >> shift & 1 for shift in (4, 3, 2, 0))
    at += 3 + 8 * content + 4 * dictionary
    total = 0
    while size := struct.unpack_from("<I", data, at)[0]:
        packed, stored = size >> 31 == 0, size & 0x7FFFFFFF
        total += min(block, LZ4_RATIO * stored) if packed else stored
        at += 4 + stored + 4 * per_block
    return at + 4 + 4 * checksum, total
