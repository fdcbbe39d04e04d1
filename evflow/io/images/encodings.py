"""Image encodings of ROS messages (sensor_msgs/image_encodings) in one table: the meaning of their
bytes, and how they become grey frames.

Depths of 8 and 16 bits are kept. Colour becomes luma, and so does a Bayer mosaic, by the pattern
that its encoding names, unless the mosaic itself is requested. `8UC3` etc. are OpenCV's, in B, G,
R. Physical quantities (32FC1: depth, flow) are not frames.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from evflow.errors import EvflowDataError
from evflow.light.colour import mosaic_luma, mosaic_note
from evflow.notes import Note


class Encoding(NamedTuple):
    """dtype of a value; values per pixel; their order ("grey", "bgr", "rgb") or a pattern."""

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
    """Why images of an encoding cannot be frames; "" if they can."""
    if encoding.lower() in ENCODINGS:
        return ""
    name = encoding[:20]
    if "FC" in encoding.upper():
        return f"{name}: floats, as for depth and flow"
    return f"unknown encoding {name!r}"


def notes(encoding: str, seen: str = "luma") -> tuple[Note, ...]:
    """Notes on the conversion of frames in this encoding; none if the mosaic itself is kept
    (`Hints.colour`)."""
    known = ENCODINGS.get(encoding.lower())
    mosaic = known is not None and known.order not in GREYS and seen == "luma"
    return (mosaic_note(known.order),) if known and mosaic else ()


def unpacked(encoding: str, image: np.ndarray, seen: str = "luma") -> np.ndarray:
    """Convert an image (H, W) or (H, W, C) that was in `encoding` before it was compressed; mosaics
    are compressed unchanged."""
    known = ENCODINGS.get(encoding)
    if known is None or known.order in GREYS or image.ndim != 2 or min(image.shape) < 2:
        return image
    return _of_mosaic(image, known.order, seen)


def _of_mosaic(values: np.ndarray, pattern: str, seen: str) -> np.ndarray:
    """What pixels see of a mosaic; EV020 if another pattern was requested."""
    if seen == "luma":
        return mosaic_luma(values, pattern)
    if seen != pattern:
        raise EvflowDataError(
            "EV020", f"colour={seen} (--colour), but the images are a mosaic that begins "
            f"{pattern.upper()}.", f"Pass --colour {pattern}, or leave it out for luma.")
    return values


def decode(
    encoding: str, data: bytes, size: tuple[int, int], step: int, *, big_endian: bool,
    seen: str = "luma",
) -> np.ndarray:
    """Pixels (H, W), or (H, W, 3) in B, G, R, u8 or u16, of rows of `step` bytes.

    size: (width, height). ValueError if the bytes do not match.
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
            raise ValueError(f"a mosaic of {width}x{height} is smaller than a cell")
        return _of_mosaic(values, order, seen)
    if channels == 1:
        return values
    colour = values.reshape(height, width, channels)[..., :3]
    return colour if order == "bgr" else colour[..., ::-1]
