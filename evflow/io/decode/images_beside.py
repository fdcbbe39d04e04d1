"""Images that a file holds beside its events under names of its own, and their times: recognised by
shapes and names.

Images are arrays (T, H, W), or (T, H, W, C) or (T, C, H, W) with 1, 3 or 4 channels in R, G, B.
Their times are an array of T numbers, or (T, 2) begin and end of the exposure, whose name says so
(`frame_times`, `image_raw_ts`, `t`), in the same group or the one above. Their exposure is that of
begin and end, or a number, or one per image, in such an array or in an attribute of both, under a
name with a unit (`exposure_us`). As none of it is certain, what cannot be read leaves the events,
with a note.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from evflow.checks import Size
from evflow.errors import EvflowDataError
from evflow.io.decode.columns import UNIT
from evflow.io.decode.columns import whole as whole_valued
from evflow.io.decode.stream import Gathered
from evflow.io.decode.tables import Images, Loaded, with_frames
from evflow.io.decode.units import other_unit, shared_unit, written_unit
from evflow.io.hints import Hints
from evflow.io.images.exposures import (
    Stamps,
    beside_times,
    mid_exposure,
    names_exposure,
    stated,
    stated_by,
)
from evflow.io.images.streams import WORD, ImageStream
from evflow.io.images.times import to_us
from evflow.notes import Note
from evflow.types import Events, Recording

LEAST_SIDE = 8  # pixels; smaller ones are no images
CHANNELS = (1, 3, 4)
ENCODED = {"frame", "image", "img", "picture", "photo", "jpeg", "jpg", "png"}
TIMES = re.compile(r"(?:^|_)ts?$|(?:time|stamp)s?$")

Pixels = Callable[[str, slice], Iterable[np.ndarray]]


def beside(
    path: Path, arrays: Mapping[str, Any], whole: Callable[[str], np.ndarray], pixels: Pixels,
    found: Gathered, hints: Hints, events: str = "", notes: tuple[Note, ...] = (),
) -> Recording:
    """The recording of events that were found, with the images beside them that are its frames.

    arrays: what the file holds by name ("cam/images"), with `shape` and `dtype`; whole(name): an
    array; pixels(name, part): its images one by one; events: the name of the events. Raises EV020
    (no images of the requested name), and what `streams.choose` raises.
    """
    streams: list[Images] = []
    for name, array in arrays.items():
        if are_images(array):
            times = times_of(name, arrays)
            why = "" if times else f"without an array of {array.shape[0]} times"
            stream = ImageStream(name, _size(array.shape), why, (Note(
                "frames.stream", f"frames are from {name}, at the times in {times}"),))
            streams.append(Images(stream, _loading(
                name, times, arrays, whole, pixels, path, found.events)))
        elif array.dtype.kind == "b" and _shaped(array.shape) and _words(name) & ENCODED:
            streams.append(Images(ImageStream(
                name, _size(array.shape), "bool, black and white only: save brightness, as uint8 "
                "0 to 255"), lambda: Loaded(Stamps(np.zeros(0)), lambda part: ())))
        elif array.dtype.hasobject and _words(name) & ENCODED:
            streams.append(Images(ImageStream(
                name, None, "of variable length, as encoded images are: save them as arrays, or as "
                "files for --frames"), lambda: Loaded(Stamps(np.zeros(0)), lambda part: ())))
    try:
        return with_frames(path, found, hints, streams, "us", notes, events=events)
    except EvflowDataError as e:
        if e.code == "EV020" or hints.frames_topic is not None:
            raise
        return Recording.of_events(found.events, (*notes, *found.notes, Note(
            "frames.unused", f"images beside the events were not read: {e.seen}"
            f" {e.fix}".rstrip(" ."))))


def times_of(images: str, arrays: Mapping[str, Any]) -> str:
    """The array that holds the times of `images`, "" if there is none or no clear one."""
    count = arrays[images].shape[0]
    return _near(images, arrays, lambda name, shape: shape in (
        (count,), (count, 1), (1, count), (count, 2)) and not names_exposure(name) and bool(
        TIMES.search(UNIT.sub("", name.rpartition("/")[2].lower()))))


def stamps_of(
    images: str, times: str, arrays: Mapping[str, Any], whole: Callable[[str], np.ndarray],
    path: Path,
) -> Stamps:
    """The stamps of `images`, whose times are the array `times`, unless begin and end of the
    exposures stand beside it. EV008 (two columns that are not begin and end)."""
    count = arrays[images].shape[0]
    ends = [name for name, array in arrays.items() if array.shape == (count,) and (
        name.rpartition("/")[0] == times.rpartition("/")[0] and "expos" in name.lower())]
    beside = _near(images, arrays, lambda name, shape: shape in (
        (), (1,), (count,), (count, 1), (1, count)) and names_exposure(name) and (
        written_unit(name) != "auto"))
    clock = whole(times)
    pair = beside_times(times, clock, ends, whole) or mid_exposure(clock, f"{times} in {path}")
    return pair._replace(
        stated_us=stated([beside], whole) or stated_by(arrays[images], arrays[times]))


def _near(
    images: str, arrays: Mapping[str, Any], fits: Callable[[str, tuple[int, ...]], bool]
) -> str:
    """The array of numbers beside `images`, or else in the group above, whose name and shape fit;
    of several the one whose name is nearest, "" if there is none or no clear one."""
    group = images.rpartition("/")[0]
    for place in dict.fromkeys((group, group.rpartition("/")[0])):
        fit = [name for name, array in arrays.items() if name.rpartition("/")[0] == place
               and array.dtype.kind in "iuf" and fits(name, array.shape)]
        rank = {name: (-len(_words(name) & _words(images)), len(name)) for name in fit}
        best = [name for name in fit if rank[name] == min(rank.values())]
        if best:
            return best[0] if len(best) == 1 else ""
    return ""


def are_images(array: Any) -> bool:
    """Whether an array may be images."""
    return array.dtype.kind in "iuf" and _shaped(array.shape)


def _shaped(shape: tuple[int, ...]) -> bool:
    """Whether a shape may be that of images."""
    last = len(shape) in (3, 4) and min(shape[1:3]) >= LEAST_SIDE and (
        len(shape) == 3 or shape[3] in CHANNELS)
    return bool((last or channels_first(shape)) and shape[0])


def channels_first(shape: tuple[int, ...]) -> bool:
    """Whether images of a shape are (T, C, H, W), as PyTorch holds them."""
    return len(shape) == 4 and shape[1] in CHANNELS and min(shape[2:]) >= LEAST_SIDE


def _size(shape: tuple[int, ...]) -> Size:
    """(width, height) of images of a shape."""
    height, width = shape[2:] if channels_first(shape) else shape[1:3]
    return width, height


def _words(name: str) -> set[str]:
    """The words of the last part of a name, singular."""
    return {word.lower().rstrip("s") for word in WORD.findall(name.rpartition("/")[2])}


def _loading(
    name: str, times: str, arrays: Mapping[str, Any], whole: Callable[[str], np.ndarray],
    pixels: Pixels, path: Path, events: Events,
) -> Callable[[], Loaded]:
    def load() -> Loaded:
        stamps, unit = stamps_of(name, times, arrays, whole, path), written_unit(times)
        if unit == "auto" and (len(stamps.times) < 2 or np.isfinite(stamps.times).all()):
            native = "us" if whole_valued(stamps.times) else "s"
            unit = other_unit(stamps.times, events.t, native) or shared_unit(
                stamps.times, events.t, [native]) or "auto"
        us, notes, exposure_us, _ = to_us(stamps, f"{times} of {path}", unit)
        return Loaded(Stamps(us, stated_us=exposure_us, notes=notes),
                      lambda part: map(_seen, pixels(name, part)))

    return load


def _seen(image: np.ndarray) -> np.ndarray:
    """An image of a dtype that frames have, with channels in B, G, R."""
    if channels_first((1, *image.shape)):
        image = np.moveaxis(image, 0, -1)
    if image.ndim == 3:
        image = image[..., 0] if image.shape[-1] == 1 else image[..., [2, 1, 0]]
    if image.dtype.kind == "f":
        return image.astype(np.float32)
    if image.dtype.itemsize > 1 and image.min() >= 0 and image.max() < 1 << 16:
        return image.astype(np.uint16)
    return image
