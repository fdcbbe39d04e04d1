"""Colour frames -> what one pixel sees: luma, or one colour under a Bayer mosaic; and raw mosaic ->
luma.

Frames are (H, W, 3) in OpenCV's order B, G, R, of dtype uint8, uint16 or float32, and keep that
dtype. Luma has the weights of Rec. 601, as OpenCV's grey conversion does, which v2e, ESIM and
OpenEB use: a colour video gives the same events there and here, whatever reader it comes through.
A pattern names the four corners of the mosaic's cell from the top left, row by row: under "rggb"
pixel (0, 0) sees red and pixel (1, 1) blue. All later steps treat a mosaic as a grey frame.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator
from typing import Literal, get_args

import numpy as np

from evflow.errors import EvflowDataError
from evflow.notes import Note

Frames = Iterator[tuple[np.ndarray, int]]

Colour = Literal["luma", "rggb", "bggr", "grbg", "gbrg"]
COLOURS: tuple[str, ...] = get_args(Colour)
PATTERNS = COLOURS[1:]
CONVERTED = Note("frames.luma", "colour frames were converted to luma; if the events come from "
                 "behind a colour mosaic (a colour DAVIS), pass --colour rggb (or its own pattern)")
LUMA = ("frames.luma", "frames.mosaic")  # note codes that say that frames are luma

CELLS = tuple(np.s_[row::2, column::2] for row in (0, 1) for column in (0, 1))
WEIGHTS = {"r": 0.299, "g": 0.587, "b": 0.114}  # of `luma`
BETWEEN = {  # bilinear interpolation of a colour known at one pixel of a cell, or at two
    "r": np.array([[1, 2, 1], [2, 4, 2], [1, 2, 1]], np.float32) / 4,
    "g": np.array([[0, 1, 0], [1, 4, 1], [0, 1, 0]], np.float32) / 4}
BETWEEN["b"] = BETWEEN["r"]
PLANE_MARGIN = 32  # rows of repeated edge around a plane: more than motion between frames


def luma(bgr: np.ndarray) -> np.ndarray:
    """Luma .299 R + .587 G + .114 B (..., H, W) of frames (..., H, W, 3) in B, G, R order:
    bit-exact with OpenCV's BGR2GRAY. Integers are rounded. Pass RGB frames as frames[..., ::-1].

    Raises EV002 (not (..., H, W, 3)), EV003 (dtype).
    """
    import cv2

    lead, width = bgr.shape[:-2], bgr.shape[-2:-1]
    rows = bgr.reshape(-1, *bgr.shape[-2:]) if bgr.ndim > 3 else bgr
    return cv2.cvtColor(_checked(rows), cv2.COLOR_BGR2GRAY).reshape(*lead, *width)


def mosaic(bgr: np.ndarray, pattern: str) -> np.ndarray:
    """The Bayer mosaic (H, W) of colour frames (H, W, 3): each pixel keeps one channel.

    Raises EV002 (not (H, W, 3)), EV003 (dtype), EV020 (pattern).
    """
    pattern, bgr = parse_pattern(pattern), _checked(bgr)
    seen = np.empty(bgr.shape[:2], bgr.dtype)
    for cell, letter in zip(CELLS, pattern, strict=True):
        seen[cell] = bgr[..., "bgr".index(letter)][cell]
    return seen


def mosaic_luma(seen: np.ndarray, pattern: str, where: str = "a mosaic") -> np.ndarray:
    """Luma (H, W) of a mosaic (H, W) at its own resolution, of the same dtype.

    Missing colours are interpolated bilinearly, as the mean of the 2 or 4 nearest pixels; the
    mosaic is mirrored at its edges, which keeps cells whole. If a frame has three equal channels,
    as videos store grey, one of them is used. where: names the frame in messages.
    Raises EV002 (not (H, W), or smaller than a cell), EV003 (dtype), EV020 (pattern, or the frame
    has colours already).
    """
    import cv2

    pattern = parse_pattern(pattern)
    if seen.ndim == 3:
        if (seen[..., 1:] != seen[..., :1]).any():
            raise EvflowDataError(
                "EV020", f"{where} has colours already: it is not a {pattern.upper()} mosaic.",
                "Leave out --bayer.")
        seen = np.ascontiguousarray(seen[..., 0])
    if seen.ndim != 2 or min(seen.shape) < 2:
        raise EvflowDataError("EV002", f"{where} has shape {seen.shape}.", "Expected (H, W).")
    if seen.dtype not in (np.uint8, np.uint16, np.float32):
        raise EvflowDataError(
            "EV003", f"{where} is {seen.dtype}.", "Expected uint8, uint16 or float32.")
    total = np.zeros(seen.shape, np.float32)
    for letter, weight in WEIGHTS.items():
        alone = np.zeros(seen.shape, np.float32)
        for cell, name in zip(CELLS, pattern, strict=True):
            if name == letter:
                alone[cell] = seen[cell]
        kernel = BETWEEN[letter] * np.float32(weight)
        total += cv2.filter2D(alone, -1, kernel, borderType=cv2.BORDER_REFLECT_101)
    return total if seen.dtype == np.float32 else np.rint(total).astype(seen.dtype)


def as_seen(
    pairs: Frames, colour: str, interpolated: Callable[[Frames, float], Frames] | None = None
) -> Frames:
    """The frames (H, W) that the pixels see, from (frame, time) pairs.

    pairs: frames (H, W), or (H, W, 3) if `colour` is a pattern. interpolated(pairs, pixel) adds
    frames to a grey video whose pixels are `pixel` sensor pixels wide. It works on the planes of
    `stack_planes`: interpolating between pixels of different colours would create flicker.
    """
    first = next(pairs, None)
    pairs = pairs if first is None else itertools.chain([first], pairs)
    if colour == "luma":
        return pairs if interpolated is None else interpolated(pairs, 1.0)
    raw = first is not None and first[0].ndim == 2
    if interpolated is not None:
        planes = interpolated(((stack_planes(f), t) for f, t in pairs), 0.5 if raw else 1.0)
        pairs = ((unstack_planes(f, 4 if raw else 3), t) for f, t in planes)
    return pairs if raw else ((mosaic(f, colour), t) for f, t in pairs)


def stack_planes(frame: np.ndarray) -> np.ndarray:
    """The planes of a frame stacked vertically as one grey frame.

    A colour frame (H, W, 3) has three planes, its channels; a mosaic (H, W) has four, one for each
    pixel of its cell, (H/2, W/2) each. Interpolation between frames warps pixels and must not mix
    colours: stacked like this, each plane is interpolated as a grey video. Every plane is padded
    above and below by `PLANE_MARGIN` repeated rows, so that none moves into the next.
    Raises EV002 (a mosaic of odd size).
    """
    if frame.ndim == 2:
        if frame.shape[0] % 2 or frame.shape[1] % 2:
            raise EvflowDataError(
                "EV002", f"a mosaic of shape {frame.shape} is not a whole number of 2x2 cells.",
                "Crop it to even sides, or do not interpolate (--no-interpolate).")
        planes = np.stack([frame[cell] for cell in CELLS])
    else:
        planes = np.moveaxis(_checked(frame), -1, 0)
    margin = ((0, 0), (PLANE_MARGIN, PLANE_MARGIN), (0, 0))
    return np.pad(planes, margin, mode="edge").reshape(-1, planes.shape[-1])


def unstack_planes(stacked: np.ndarray, count: int) -> np.ndarray:
    """The inverse of `stack_planes`: (H, W, 3) for count = 3, a mosaic (H, W) for 4."""
    planes = stacked.reshape(count, -1, stacked.shape[1])[:, PLANE_MARGIN:-PLANE_MARGIN]
    if count == 3:
        return np.moveaxis(planes, 0, -1)
    frame = np.empty((2 * planes.shape[1], 2 * planes.shape[2]), planes.dtype)
    for cell, plane in zip(CELLS, planes, strict=True):
        frame[cell] = plane
    return frame


def parse_pattern(text: str) -> str:
    """The pattern from `PATTERNS`, in any letter case; raises EV020."""
    if text.lower() not in PATTERNS:
        raise EvflowDataError(
            "EV020", f"{text!r} is not a Bayer pattern.", f"Choose from {', '.join(PATTERNS)}.")
    return text.lower()


def mosaic_note(pattern: str) -> Note:
    """The note on frames that were a mosaic."""
    return Note(
        "frames.mosaic", f"frames were a colour mosaic ({pattern.upper()}), converted to luma; if "
        f"the events also come from behind it (a colour DAVIS), pass --colour {pattern.lower()}")


def seen_note(pattern: str, colour: bool) -> Note:
    """The note on grey or colour frames that are used as pixels see them under a mosaic."""
    return Note("frames.raw", f"colour frames were sampled by a {pattern} mosaic: each pixel has "
                "one colour only." if colour else
                f"frames have one channel: used as they are, as a {pattern} mosaic.")


def are_luma(notes: Iterable[Note]) -> bool:
    """Whether the notes on a recording say that its frames are luma of colour frames."""
    return any(note.code in LUMA for note in notes)


def _checked(bgr: np.ndarray) -> np.ndarray:
    if bgr.ndim != 3 or bgr.shape[-1] != 3 or not bgr.size:
        raise EvflowDataError(
            "EV002", f"a colour frame has shape {bgr.shape}.", "Expected (H, W, 3) in B, G, R.")
    if bgr.dtype not in (np.uint8, np.uint16, np.float32):
        raise EvflowDataError(
            "EV003", f"a colour frame is {bgr.dtype}.", "Expected uint8, uint16 or float32.")
    return np.ascontiguousarray(bgr)
