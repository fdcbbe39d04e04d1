"""What the header of a picture claims, before a decoder allocates memory for it.

OpenCV allocates as many pixels as a header names, up to 2^30, whatever follows it. Supported are
the formats of `images.SUFFIXES`: PNG, JPEG, TIFF, BMP, PGM and PPM, WebP, and the radiance formats
HDR, EXR and PFM.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable

from evflow.io.images import exr

Size = tuple[int, int]

PIXEL, PIXEL_OF_FLOATS = 8, 16  # maximum bytes: four channels
# Some decoders take `#` directly after a number for a comment: blanks must come first.
NETPBM = re.compile(rb"P[1-6](?:\s+|#[^\n]*\n)+(\d{1,9})\s(?:\s+|#[^\n]*\n)*(\d{1,9})\s")
MAXVAL = re.compile(NETPBM.pattern + rb"(?:\s+|#[^\n]*\n)*(\d{1,5})\s")
PFM = re.compile(rb"P[Ff]\s+(\d{1,9})\s+(\d{1,9})\s")
RADIANCE = re.compile(rb"\n[-+]Y (\d{1,9}) [-+]X (\d{1,9})\n")
TIFF_SIZE = (256, 257)  # tags ImageWidth, ImageLength
TIFF_KINDS = {3: "H", 4: "I", 16: "Q"}
JPEG_FRAMES = frozenset({*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC})


def claimed_size(data: bytes) -> Size | None:
    """(width, height) in the header; None for other formats or a truncated header."""
    for magic, read in READERS.items():
        if data.startswith(magic):
            try:
                return read(data)
            except (struct.error, IndexError, ValueError):
                return None
    return None


def claimed_bytes(data: bytes) -> int | None:
    """Memory that the decoded picture may need."""
    size = claimed_size(data)
    pixel = PIXEL_OF_FLOATS if data.startswith(FLOATS) else PIXEL
    return None if size is None else size[0] * size[1] * pixel


def stated_white(data: bytes) -> int | None:
    """What a PGM or PPM names as its largest value, as OpenCV returns it: of text, 8 bits are
    scaled to 255. None for other formats."""
    match = MAXVAL.match(data) if data.startswith((b"P2", b"P3", b"P5", b"P6")) else None
    if match is None:
        return None
    return 255 if data[:2] in (b"P2", b"P3") and int(match[3]) <= 255 else int(match[3])


def _png(data: bytes) -> Size:
    width, height = struct.unpack_from(">II", data, 16)
    return width, height


def _bmp(data: bytes) -> Size:
    old = struct.unpack_from("<I", data, 14)[0] == 12
    width, height = struct.unpack_from("<HH" if old else "<ii", data, 18)
    return abs(width), abs(height)


def _netpbm(data: bytes) -> Size | None:
    match = NETPBM.match(data)
    return None if match is None else (int(match[1]), int(match[2]))


def _pfm(data: bytes) -> Size | None:
    match = PFM.match(data)
    return None if match is None else (int(match[1]), int(match[2]))


def _radiance(data: bytes) -> Size | None:
    match = RADIANCE.search(data, 0, 1 << 16)
    return None if match is None else (int(match[2]), int(match[1]))


def _webp(data: bytes) -> Size | None:
    if data[8:12] != b"WEBP":
        return None
    kind = data[12:16]
    if kind == b"VP8X":
        width, height = (int.from_bytes(data[i : i + 3], "little") for i in (24, 27))
        return 1 + width, 1 + height
    if kind == b"VP8L":
        (bits,) = struct.unpack_from("<I", data, 21)
        return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    width, height = struct.unpack_from("<HH", data, 26)
    return width & 0x3FFF, height & 0x3FFF


def _jpeg(data: bytes) -> Size | None:
    """Size from the last frame header before the pixels; skips non-markers, as decoders do."""
    at, found = 2, None
    while (at := data.find(b"\xff", at)) >= 0 and at + 9 <= len(data):
        kind = data[at + 1]
        if kind in JPEG_FRAMES:
            height, width = struct.unpack_from(">HH", data, at + 5)
            found = width, height
        if kind == 0xDA:
            break
        bare = kind == 0xFF or kind in range(0xD0, 0xD9) or kind == 0x01
        at += 1 if kind == 0xFF else 2 if bare else 2 + struct.unpack_from(">H", data, at + 2)[0]
    return found


def _tiff(data: bytes) -> Size | None:
    order = "<" if data.startswith(b"II") else ">"
    big = data[2:4] in (b"+\0", b"\0+")  # 43: 64-bit offsets
    at: int = struct.unpack_from(order + ("Q" if big else "I"), data, 8 if big else 4)[0]
    (count,) = struct.unpack_from(order + ("Q" if big else "H"), data, at)
    first, step = (at + 8, 20) if big else (at + 2, 12)
    sides: dict[int, int] = {}
    for entry in range(first, min(first + step * count, len(data) - step + 1), step):
        tag, kind = struct.unpack_from(order + "HH", data, entry)
        if tag in TIFF_SIZE and kind in TIFF_KINDS:
            place = entry + (12 if big else 8)
            (sides[tag],) = struct.unpack_from(order + TIFF_KINDS[kind], data, place)
    return (sides[256], sides[257]) if len(sides) == 2 else None


FLOATS = (b"PF", b"Pf", b"#?", exr.MAGIC)
READERS: dict[bytes, Callable[[bytes], Size | None]] = {
    b"\x89PNG\r\n\x1a\n": _png, b"\xff\xd8": _jpeg, b"BM": _bmp, b"RIFF": _webp,
    b"II*\0": _tiff, b"MM\0*": _tiff, b"II+\0": _tiff, b"MM\0+": _tiff,
    **{b"P%d" % kind: _netpbm for kind in range(1, 7)}, b"PF": _pfm, b"Pf": _pfm,
    b"#?": _radiance, exr.MAGIC: exr.claimed_size}
