"""Frames cropped and scaled to a sensor, and times of slow-motion videos corrected.

Scaling averages light over the area of each new pixel, as a sensor pixel does.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable

import cv2
import numpy as np

from evflow.camera.sensors import SENSOR_SIZES
from evflow.checks import Size, check_size
from evflow.errors import EvflowDataError
from evflow.io.images.exposures import noted
from evflow.io.images.frames import Frames, FrameSource
from evflow.notes import Note

Array = np.ndarray


@dataclasses.dataclass(frozen=True)
class Cropping:
    """The part of a frame that is used, and the size to which it is scaled."""

    left: int
    top: int
    used: Size
    size: Size

    def __call__(self, frame: Array) -> Array:
        """The frame (H, W) or (H, W, 3); float32 if it is scaled."""
        part = frame[self.top : self.top + self.used[1], self.left : self.left + self.used[0]]
        return np.ascontiguousarray(part) if self.used == self.size else scaled(part, self.size)


def cropped(
    source: FrameSource, *, crop: str | None = None, resize: str | None = None,
    sensor_size: str | None = None,
) -> FrameSource:
    """The source with its frames cropped ("WxH" from the middle, or "WxH+X+Y") and then scaled
    ("WxH"); or scaled and cropped to fill a sensor (a name, or "WxH"). Raises EV020 if the crop
    does not fit, or if a raw mosaic would be scaled."""
    cropping = cropping_of(source.size, crop, resize, sensor_size)
    if cropping == Cropping(0, 0, source.size, source.size):
        return source
    used, size = cropping.used, cropping.size
    note = Note("frames.laid", f"of {source.size[0]}x{source.size[1]} pixels, {used[0]}x{used[1]} "
                f"from column {cropping.left}, row {cropping.top} are mapped to "
                f"{size[0]}x{size[1]} sensor pixels.")

    def frames() -> Frames:
        for frame, time in source.open():
            check_mosaic(cropping, frame, source.notes)
            yield cropping(frame), time

    source.notes.append(note)
    return dataclasses.replace(source, size=cropping.size, open=frames)


def cropping_of(
    size: Size, crop: str | None, resize: str | None, sensor_size: str | None
) -> Cropping:
    """Which part of frames of this size (width, height) is mapped to how many pixels; EV020."""
    left, top, *used = (0, 0, *size) if crop is None else _part(crop, size)
    if resize is not None and sensor_size is not None:
        raise EvflowDataError("EV020", f"--resize {resize} and --sensor-size {sensor_size} are "
                              "two sizes.", "Give only one of them.")
    if sensor_size is None:
        wanted = (used[0], used[1]) if resize is None else _size(resize, "--resize")
        return Cropping(left, top, (used[0], used[1]), wanted)
    wanted = _sensor(sensor_size)
    ratio = min(used[0] / wanted[0], used[1] / wanted[1])  # the largest part with its aspect ratio
    part = [max(1, min(n, round(ratio * w))) for n, w in zip(used, wanted, strict=True)]
    return Cropping(left + (used[0] - part[0]) // 2, top + (used[1] - part[1]) // 2,
               (part[0], part[1]), wanted)


def check_mosaic(cropping: Cropping, frame: Array, notes: list[Note]) -> None:
    """Raise EV020 if a raw mosaic would be scaled, or cut within a cell."""
    raw = any(note.code == "frames.raw" for note in notes) and frame.ndim == 2
    if raw and (cropping.used != cropping.size or cropping.left % 2 or cropping.top % 2):
        raise EvflowDataError(
            "EV020", "a raw mosaic cannot be scaled, nor cropped from an odd column or row.",
            "Crop from an even one, or convert it to luma: --bayer instead of --colour.")


def scaled(frame: Array, size: Size) -> Array:
    """float32 (H, W) or (H, W, 3) resized to (width, height), by area averages when shrinking."""
    light = frame.astype(np.float32)
    shrinks = size[0] <= frame.shape[1] and size[1] <= frame.shape[0]
    out: Array = cv2.resize(light, size, interpolation=cv2.INTER_AREA if shrinks else
                            cv2.INTER_LINEAR)
    return np.minimum(out, 255, out=out)  # an average is no brighter than white, but for rounding


def slowed(source: FrameSource, factor: float) -> FrameSource:
    """The source with its times divided by the slow-motion factor of the video. Raises EV004
    (frames less than a microsecond apart), EV020."""
    if not 1e-6 <= factor <= 1e6:
        raise EvflowDataError("EV020", f"--slow-motion {factor:g}.", "Give a factor from 1e-6 to "
                              "1e6; 10 if the video is ten times slower than life.")

    def frames() -> Frames:
        first, last = None, -1
        for frame, time in source.open():
            first = time if first is None else first
            now = first + round((time - first) / factor)
            if now <= last and last >= 0:
                raise EvflowDataError(
                    "EV004", f"frames are less than a microsecond apart (at {now} us) with "
                    f"--slow-motion {factor:g}.", "Give a smaller factor.")
            last = now
            yield frame, now

    source.notes.append(Note("frames.slowed", f"the video is {factor:g} times slower than life: "
                             "its times were divided by this factor."))
    if exposure_us := round(source.exposure_us / factor):
        source.notes[:] = noted(source.notes, exposure_us, "in the time of the scene")
    return dataclasses.replace(source, open=frames, exposure_us=exposure_us)


def _part(text: str, size: Size) -> tuple[int, int, int, int]:
    """(left, top, width, height) from "WxH" or "WxH+X+Y"."""
    match = re.fullmatch(r"(\d{1,6})[xX](\d{1,6})(?:\+(\d{1,6})\+(\d{1,6}))?", text)
    if match is None:
        raise EvflowDataError("EV020", f"--crop {text!r}.", "Give it as WxH or WxH+X+Y: 346x260, "
                              "346x260+10+0.")
    width, height = int(match[1]), int(match[2])
    left, top = ((size[0] - width) // 2, (size[1] - height) // 2) if match[3] is None else (
        int(match[3]), int(match[4]))
    if min(width, height) < 1 or min(left, top) < 0 or (
            left + width > size[0] or top + height > size[1]):
        raise EvflowDataError("EV020", f"--crop {text} reaches beyond frames of "
                              f"{size[0]}x{size[1]}.", "The crop must lie within the frame.")
    return left, top, width, height


def _size(text: str, option: str) -> Size:
    match = re.fullmatch(r"(\d{1,6})[xX](\d{1,6})", text)
    if match is None:
        raise EvflowDataError("EV020", f"{option} {text!r}.", "Give it as WxH: 346x260.")
    return check_size((int(match[1]), int(match[2])))


def _sensor(text: str) -> Size:
    known: Callable[[str], Size | None] = SENSOR_SIZES.get
    plain = known(re.sub(r"[^a-z0-9]", "", text.lower()))
    if plain is None and not re.fullmatch(r"\d+[xX]\d+", text):
        raise EvflowDataError("EV020", f"--sensor-size {text!r}.", "Give it as WxH, or one of "
                              f"{', '.join(SENSOR_SIZES)}.")
    return plain or _size(text, "--sensor-size")
