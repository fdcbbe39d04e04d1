"""OpenEXR images of scan lines, uncompressed or by RLE, ZIPS or ZIP: half and float channels.

Many builds of OpenCV do not read EXR. Other kinds (tiles, PIZ, several parts) are named by
`unread`. EXR values are linear in light, and colours are already multiplied by their opacity.
"""

from __future__ import annotations

import struct
import zlib
from typing import NamedTuple

import numpy as np

MAGIC = b"\x76\x2f\x31\x01"
TILES, DEEP, PARTS = 0x200, 0x800, 0x1000  # bits of the version
COMPRESSIONS = ("none", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "B44", "B44A", "DWAA", "DWAB")
LINES = {"none": 1, "RLE": 1, "ZIPS": 1, "ZIP": 16}  # rows per block
KINDS = (np.dtype("<u4"), np.dtype("<f2"), np.dtype("<f4"))


class Channel(NamedTuple):
    name: str
    dtype: np.dtype
    subsampled: bool


class Header(NamedTuple):
    """first: row at which the image begins; end: offset of the end of the header."""

    size: tuple[int, int]
    first: int
    channels: list[Channel]
    compression: str
    flags: int
    end: int


def header(data: bytes) -> Header:
    """Raises ValueError, struct.error or IndexError if it is damaged."""
    flags = struct.unpack_from("<I", data, 4)[0] & ~0xFF
    at, found = 8, dict[str, bytes]()
    while data[at] != 0:
        name, length, at = _attribute(data, at)
        found[name] = data[at : at + length]
        at += length
    left, top, right, bottom = struct.unpack("<4i", found.get("dataWindow", b""))
    size = (right - left + 1, bottom - top + 1)
    if min(size) < 1:
        raise ValueError(f"a picture of {size[0]}x{size[1]}")
    return Header(size, top, _channels(found.get("channels", b"")),
                  COMPRESSIONS[found.get("compression", b"")[0]], flags, at + 1)


def claimed_size(data: bytes) -> tuple[int, int]:
    """(width, height) that the header names."""
    return header(data).size


def unread(head: Header) -> str:
    """Which feature of this image `decode` does not support; "" if it supports all."""
    for bit, what in ((TILES, "tiles"), (DEEP, "deep pixels"), (PARTS, "several parts")):
        if head.flags & bit:
            return what
    if head.compression not in LINES:
        return f"{head.compression} compression"
    return "subsampled channels" if any(c.subsampled for c in head.channels) else ""


def decode(data: bytes, head: Header) -> np.ndarray:
    """float32 (H, W), or (H, W, 3) in B, G, R. Raises ValueError, struct.error or zlib.error if it
    is damaged."""
    width, height = head.size
    row = np.dtype([(f"c{i}", c.dtype, (width,)) for i, c in enumerate(head.channels)])
    lines = LINES[head.compression]
    wanted = _shown([c.name for c in head.channels])
    image = np.zeros((height, width, len(wanted)), np.float32)
    blocks = -(-height // lines)
    for (at,) in struct.iter_unpack("<Q", data[head.end : head.end + 8 * blocks]):
        y, size = struct.unpack_from("<ii", data, at)
        first = y - head.first
        count = min(lines, height - first)
        if size < 0 or not 0 <= first < height or at + 8 + size > len(data):
            raise ValueError(f"a block of {size} bytes at row {y}")
        packed = data[at + 8 : at + 8 + size]
        raw = np.frombuffer(_unpacked(packed, head.compression, count * row.itemsize), row)
        for i, channel in enumerate(wanted):
            image[first : first + count, :, i] = raw[f"c{channel}"]
    return image[..., 0] if len(wanted) == 1 else image


def _attribute(data: bytes, at: int) -> tuple[str, int, int]:
    """Name and size of an attribute, and the offset of its value."""
    words = []
    for _ in range(2):
        end = data.index(b"\0", at, at + 256)
        words.append(data[at:end].decode("latin-1"))
        at = end + 1
    (size,) = struct.unpack_from("<i", data, at)
    if size < 0 or at + 4 + size > len(data):
        raise ValueError(f"an attribute of {size} bytes")
    return words[0], size, at + 4


def _channels(data: bytes) -> list[Channel]:
    at, found = 0, []
    while data[at] != 0:
        end = data.index(b"\0", at)
        kind, _, across, down = struct.unpack_from("<iIii", data, end + 1)
        found.append(Channel(data[at:end].decode("latin-1"), KINDS[kind], (across, down) != (1, 1)))
        at = end + 17
    return found


def _shown(names: list[str]) -> list[int]:
    """Indices of the blue, green and red channel of the first layer that has them; else of Y, or of
    the only channel."""
    layers = dict.fromkeys(name.rpartition(".")[0] for name in names)
    for layer in sorted(layers, key=len):
        of = {name.rpartition(".")[2].upper(): i for i, name in enumerate(names)
              if name.rpartition(".")[0] == layer}
        for colours in (("B", "G", "R"), ("Y",)):
            if all(c in of for c in colours):
                return [of[c] for c in colours]
    if len(names) == 1:
        return [0]
    raise ValueError(f"channels {', '.join(names[:6])}, none of which is R, G, B or Y")


def _unpacked(packed: bytes, compression: str, length: int) -> bytes:
    """`length` bytes of rows; data that compression does not shorten are stored raw."""
    if compression == "none" or len(packed) == length:
        raw = packed
    else:
        if compression == "RLE":
            coded = _runs(packed, length)
        else:
            coded = zlib.decompressobj().decompress(packed, length)
        steps = np.frombuffer(coded, np.uint8).astype(np.uint8)
        steps[1:] -= np.uint8(128)  # stored as differences, even bytes before odd ones
        values = np.cumsum(steps, dtype=np.uint8)
        order = np.empty_like(values)
        half = (len(values) + 1) // 2
        order[0::2], order[1::2] = values[:half], values[half:]
        raw = order.tobytes()
    if len(raw) != length:
        raise ValueError(f"a block of {len(raw)} bytes instead of {length}")
    return raw


def _runs(packed: bytes, length: int) -> bytes:
    out, at = bytearray(), 0
    while at < len(packed) and len(out) < length:
        count = int.from_bytes(packed[at : at + 1], signed=True)
        if count < 0:
            out += packed[at + 1 : at + 1 - count]
            at += 1 - count
        else:
            out += packed[at + 1 : at + 2] * (count + 1)
            at += 2
    return bytes(out)
