"""Pictures of several pages as a video: TIFF stacks, and animated PNG and WebP with their own
times.

Pages are frames only if the second has the size of the first: others are reduced copies of it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from evflow.errors import EvflowDataError
from evflow.files.limits import check_expansion
from evflow.io.images.exposures import Stamps
from evflow.io.images.frames import FrameHints, Image
from evflow.io.images.stacks import frame_times
from evflow.notes import Note

TIFF, ANIMATED = (".tif", ".tiff"), (".png", ".webp", ".apng")
PIXEL = 8  # maximum bytes of one
TAKEN = 16  # pages decoded at a time


def pages(path: Path) -> int:
    """How many pages of a picture are frames: 1 for all others."""
    if path.suffix.lower() not in (*TIFF, *ANIMATED) or not path.is_file():
        return 1
    try:
        count = cv2.imcount(str(path), cv2.IMREAD_UNCHANGED)
        if count < 2:
            return 1
        first = _decoded(path, 0, 2)
    except cv2.error:
        return 1
    return int(count) if len(first) == 2 and first[0].shape == first[1].shape else 1


@dataclasses.dataclass(frozen=True)
class Pages:
    """The pages of a picture: first, its first page; times_us (T,) int64; exposure_us: 0 if it is
    unknown."""

    path: Path
    first: np.ndarray
    times_us: np.ndarray
    notes: tuple[Note, ...]
    exposure_us: int

    def images(self) -> Iterator[Image]:
        """The pages in OpenCV's channel order; EV009 if one cannot be decoded."""
        count = len(self.times_us)
        for begin in range(0, count, TAKEN):
            part = _decoded(self.path, begin, min(TAKEN, count - begin))
            if len(part) < min(TAKEN, count - begin):
                raise EvflowDataError(
                    "EV009", f"page {begin + len(part)} of {self.path} cannot be decoded.",
                    "Copy it again.", where=self.path)
            for index, pixels in enumerate(part, begin):
                yield Image(pixels, int(self.times_us[index]), f"page {index} of {self.path}")


def open_pages(path: Path, count: int, hints: FrameHints) -> Pages:
    """Raises EV002 (number of times), EV009 (damaged), EV020 (a TIFF without times)."""
    first, steps_ms = _decoded(path, 0, 1), None
    if not first:
        raise EvflowDataError("EV009", f"{path} cannot be decoded.", "Copy it again.", where=path)
    check_expansion(count * first[0].shape[0] * first[0].shape[1] * PIXEL, path.stat().st_size,
                    f"{path}, {count:,} pages")
    if path.suffix.lower() in ANIMATED:
        steps_ms = _durations(path, count)
    shown = None if steps_ms is None else Stamps(1000 * np.cumsum([0, *steps_ms[:-1]]))
    found = frame_times(path, count, hints, shown, "us")
    return Pages(path, first[0], found.us, found.notes, found.exposure_us)


def _decoded(path: Path, begin: int, count: int) -> list[np.ndarray]:
    """Pages begin to begin + count, as many as can be decoded."""
    try:
        if path.suffix.lower() in ANIMATED:
            return list(cv2.imreadanimation(str(path), begin, count)[1].frames)
        return list(cv2.imreadmulti(str(path), begin, count, flags=cv2.IMREAD_UNCHANGED)[1])
    except cv2.error:
        return []


def _durations(path: Path, count: int) -> list[int]:
    """How long each page of an animation is shown, in ms, at least 1."""
    found = list(cv2.imreadanimation(str(path), 0, count)[1].durations)
    return [max(1, int(ms)) for ms in found]
