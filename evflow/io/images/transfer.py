"""The transfer curve of an HDR video, from its container: PQ or HLG (ITU-R BT.2100).

OpenCV 5 tone-maps such a video, OpenCV 4 uses its code values unchanged, and neither says so. The
colour boxes of MP4 and MOV and the colour elements of Matroska are read, not the bitstream (VUI).
"""

from __future__ import annotations

from pathlib import Path
from shlex import quote
from typing import IO

import cv2

from evflow.notes import Note

CURVES = {16: "PQ", 18: "HLG"}  # transfer characteristics of ITU-T H.273
BOXES = (b"colrnclx", b"colrnclc")  # followed by primaries, transfer, matrix: u16 each
MATROSKA, ELEMENT = b"\x1a\x45\xdf\xa3", b"\x55\xba\x81"  # TransferCharacteristics of one byte
HEAD, INDEX = 1 << 18, 1 << 26  # bytes to search for them


def hdr_note(path: Path) -> tuple[Note, ...]:
    """The note on an HDR video; none for others."""
    curve = hdr_curve(path)
    return () if curve is None else (Note(
        "frames.hdr", f"{path} is HDR ({curve}), which OpenCV {cv2.__version__} decodes to 8 bits "
        + ("and tone-maps" if int(cv2.__version__.split(".")[0]) > 4 else
           "without undoing its curve") + f": light is approximate. Exactly: ffmpeg -i "
        f"{quote(path.name)} -vf zscale=transfer=linear:npl=1000,format=gbrpf32le,format=gray16le "
        "frames/%06d.png, and the folder with --fps."),)


def hdr_curve(path: Path) -> str | None:
    """ "PQ", "HLG", or None if the container names neither."""
    with open(path, "rb") as f:
        head = f.read(HEAD)
        if head.startswith(MATROSKA):
            at = head.find(ELEMENT)
            return CURVES.get(head[at + len(ELEMENT)]) if 0 <= at < len(head) - 4 else None
        if head[4:8] == b"ftyp":
            return _of_boxes(f)
    return None


def _of_boxes(f: IO[bytes]) -> str | None:
    index = box(f, b"moov")
    for colours in BOXES:
        at = index.find(colours)
        if at >= 0:
            return CURVES.get(int.from_bytes(index[at + 10:at + 12], "big"))
    return None


def box(f: IO[bytes], name: bytes) -> bytes:
    """The first INDEX bytes of a box of the file; empty if there is none."""
    at = 0
    while True:
        f.seek(at)
        head = f.read(16)
        size = int.from_bytes(head[:4], "big")
        size = int.from_bytes(head[8:], "big") if size == 1 else size
        if len(head) < 16 or (size < 8 and size != 0):
            return b""
        if head[4:8] == name:
            f.seek(at + 8)
            return f.read(min(size - 8, INDEX) if size else INDEX)
        if size == 0:
            return b""
        at += size
