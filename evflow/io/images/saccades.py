"""One picture as a video: the sensor makes three saccades over it, as in N-Caltech101 (Orchard et
al. 2015), where a camera in front of a screen moves along a triangle, 100 ms a side.

Each saccade starts and ends at rest, with a raised-cosine velocity. The picture is shifted on a
grid four times finer than the sensor's pixels, which average over it, so that a subpixel shift does
not blur. Beyond its edges the picture is mirrored.
"""

from __future__ import annotations

import dataclasses
import math

import cv2
import numpy as np

from evflow.errors import EvflowDataError
from evflow.io.images.cropping import check_mosaic, cropping_of, scaled
from evflow.io.images.frames import Frames, FrameSource
from evflow.notes import Note

Array = np.ndarray

SACCADE_US = 100_000
FINE = 4  # grid cells per pixel for shifting the picture
STEP_PX = 0.5  # maximum shift from frame to frame
LONGEST_PX = 1000.0
CORNERS = ((0.0, 0.0), (0.5, math.sqrt(3) / 2), (1.0, 0.0), (0.0, 0.0))  # of a triangle of side 1


def swept(
    source: FrameSource, side_px: float, *, start_s: float | None = None,
    stop_s: float | None = None, crop: str | None = None, resize: str | None = None,
    sensor_size: str | None = None,
) -> FrameSource:
    """The video for a source with one frame, from start_s to stop_s of the sweep; other arguments
    as in `cropping.cropped`. Raises EV001 (nothing lies between them), EV020 (several frames, a
    side out of range, or a raw mosaic)."""
    if not STEP_PX <= side_px <= LONGEST_PX:
        raise EvflowDataError("EV020", f"--saccades {side_px:g}.",
                              f"Give a side from {STEP_PX:g} to {LONGEST_PX:g} pixels.")
    if source.count != 1:
        raise EvflowDataError("EV020", f"--saccades over {source.count or 'several'} frames.",
                              "It needs a single picture: a video has its own motion.")
    cropping = cropping_of(source.size, crop, resize, sensor_size)
    path = saccades(side_px).part(start_s, stop_s)

    def frames() -> Frames:
        (picture, _), = source.open()
        check_mosaic(cropping, picture, source.notes)
        if any(note.code == "frames.raw" for note in source.notes):
            raise EvflowDataError("EV020", "a raw mosaic cannot be shifted.",
                                  "Convert it to luma: --bayer instead of --colour.")
        width, height = cropping.size
        seen = dataclasses.replace(cropping, size=(FINE * width, FINE * height))
        fine = seen(picture).astype(np.float32)
        for (x, y), time in zip(path.at_px, path.times_us.tolist(), strict=True):
            yield _shifted(fine, FINE * x, FINE * y), time

    source.notes.append(Note(
        "frames.swept", f"the picture is seen during three saccades of {SACCADE_US / 1e3:g} ms "
        f"along a triangle with sides of {side_px:g} px, {len(path.times_us)} frames; beyond its "
        "edges it is mirrored."))
    return dataclasses.replace(source, size=cropping.size, count=len(path.times_us), open=frames)


@dataclasses.dataclass(frozen=True, eq=False)
class Path:
    """at_px: (T, 2) where the sensor looks, columns and rows; times_us: (T,) int64."""

    at_px: Array
    times_us: Array

    def part(self, start_s: float | None, stop_s: float | None) -> Path:
        """What lies between, in seconds; None for its ends. EV001 if nothing does."""
        seconds = 1e-6 * self.times_us
        kept = (seconds >= (start_s or 0.0)) & (seconds < (np.inf if stop_s is None else stop_s))
        if not kept.any():
            raise EvflowDataError("EV001", "no part of the saccades is left.", "They last "
                                  f"{seconds[-1]:g} s: --start and --stop within them.")
        return Path(self.at_px[kept], self.times_us[kept])


def saccades(side_px: float) -> Path:
    """Three saccades along a triangle with sides of `side_px`."""
    steps = math.ceil(2 * side_px / STEP_PX)  # the peak velocity is twice the mean
    s = np.arange(steps + 1) / steps
    gone = s - np.sin(2 * np.pi * s) / (2 * np.pi)
    at, times = [np.zeros((1, 2))], [np.zeros(1)]
    for k, (a, b) in enumerate(zip(np.array(CORNERS[:-1]), np.array(CORNERS[1:]), strict=True)):
        at.append(side_px * (a + gone[1:, None] * (b - a)))
        times.append((k + s[1:]) * SACCADE_US)
    return Path(np.concatenate(at), np.rint(np.concatenate(times)).astype(np.int64))


def _shifted(fine: Array, x: float, y: float) -> Array:
    """What a sensor sees that is displaced by (x, y) fine pixels."""
    move = np.array([[1, 0, x], [0, 1, y]], np.float64)
    height, width = fine.shape[:2]
    moved = cv2.warpAffine(fine, move, (width, height), borderMode=cv2.BORDER_REFLECT_101,
                           flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    return scaled(moved, (width // FINE, height // FINE))
