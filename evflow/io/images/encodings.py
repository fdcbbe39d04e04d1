"""Encodings of images in messages of ROS (sensor_msgs/image_encodings), in one table: what their
bytes are, and how they become grey frames.

Depths stay as they are, 8 or 16 bits. Colour becomes luma, as does a Bayer mosaic by the pattern
that its encoding names. `8UC3` and the like are OpenCV's, in B, G, R. Numbers that are measures
(32FC1: depth, flow) are no frames.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from evflow.light.colour import mosaic_luma, mosaic_note
from evflow.notes import Note


class Encoding(NamedTuple):
    """dtype of a value, values of a pixel, their order ("grey", "bgr", "rgb") or a pattern."""

    dtype: str
    channels: int
    order: str


ENCODINGS: dict[str, Encoding] = {
    **{name: Encoding(dtype, 1, "grey") for dtype, names in (
        ("u1", ("mono8", "8uc1")), ("u2", ("mono16", "16uc1"))) for name in names},
    **{f"{order}{'a' * alpha}{8 * size}": Encoding(f"u{size}", 3 + alpha, order)
       for order in ("rgb", "bgr") for alpha in (0, 1) for size in (1, 2)},
    **{f"{8 * size}uc{channels}": Encoding(f"u{size}", channels, "bgr")
       for channels in (3, 4) for size in (1, 2)},
    **{f"bayer_{pattern}{8 * size}": Encoding(f"u{size}", 1, pattern)
       for pattern in ("rggb", "bggr", "gbrg", "grbg") for size in (1, 2)}}
GREYS = ("grey", "bgr", "rgb")


def unreadable(encoding: str) -> str:
    """Why images of an encoding are no frames; "" where they are."""
    if encoding.lower() in ENCODINGS:
        return ""
    name = encoding[:20]
    if "FC" in encoding.upper():
        return f"{name}: floats, as depth and flow have"
    return f"encoded as {name!r}, which is not known"


def notes(encoding: str) -> tuple[Note, ...]:
    """What is to be said of frames that were so encoded and are converted here."""
    known = ENCODINGS.get(encoding.lower())
    return () if known is None or known.order in GREYS else (mosaic_note(known.order),)


def unpacked(encoding: str, image: np.ndarray) -> np.ndarray:
    """An image (H, W) or (H, W, C) that had an encoding before it was compressed: a mosaic is
    compressed as it is, and becomes its luma."""
    known = ENCODINGS.get(encoding)
    if known is None or known.order in GREYS or image.ndim != 2 or min(image.shape) < 2:
        return image
    return mosaic_luma(image, known.order)


def decode(
    encoding: str, data: bytes, size: tuple[int, int], step: int, *, big_endian: bool
) -> np.ndarray:
    """Pixels (H, W), or (H, W, 3) in B, G, R, u8 or u16, of rows of `step` bytes.

    size: (width, height). ValueError where the bytes are not those of such an image.
    """
    kind, channels, order = ENCODINGS[encoding.lower()]
    width, height = size
    row = width * channels * np.dtype(kind).itemsize
    if not (0 < row <= step and step * height == len(data)):
        raise ValueError(f"an image of {width}x{height} {encoding} in rows of {step} bytes has "
                         f"{len(data):,} bytes")
    rows = np.ascontiguousarray(np.frombuffer(data, np.uint8).reshape(height, step)[:, :row])
    values = rows.view((">" if big_endian else "<") + kind).astype(kind)
    if order not in GREYS:
        if min(size) < 2:
            raise ValueError(f"a mosaic of {width}x{height} has no cell")
        return mosaic_luma(values, order)
    if channels == 1:
        return values
    colour = values.reshape(height, width, channels)[..., :3]
    return colour if order == "bgr" else colour[..., ::-1]
