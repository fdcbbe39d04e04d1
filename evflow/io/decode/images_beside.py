"""Images that a file holds beside its events under names of its own, and their times: recognised by
shapes and names.

Images are arrays (T, H, W), or (T, H, W, C) with 1, 3 or 4 channels in R, G, B. Their times are an
array of T numbers, or (T, 2) begin and end of the exposure, whose name says so (`frame_times`,
`image_raw_ts`, `t`), in the same group or the one above. As none of it is certain, what cannot be
read leaves the events, with a note.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from evflow.errors import EvflowDataError
from evflow.io.decode.columns import UNIT
from evflow.io.decode.stream import Gathered
from evflow.io.decode.tables import Images, frame_size, with_frames
from evflow.io.decode.units import UNITS_US, shared_unit, written_unit
from evflow.io.hints import Hints
from evflow.io.images.streams import WORD, ImageStream
from evflow.io.images.times import mid_exposure, to_us
from evflow.notes import Note
from evflow.types import Events, Recording

LEAST_SIDE = 8  # pixels; smaller ones are no images
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
            stream = ImageStream(name, frame_size(array), why, (Note(
                "frames.stream", f"frames are from {name}, at the times in {times}"),))
            streams.append(Images(stream, _loading(
                name, times, whole, pixels, path, found.events)))
        elif array.dtype.hasobject and _words(name) & ENCODED:
            streams.append(Images(ImageStream(
                name, None, "of variable length, as encoded images are: save them as arrays, or as "
                "files for --frames"), lambda: (np.zeros(0), lambda part: ())))
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
    count, group = arrays[images].shape[0], images.rpartition("/")[0]
    for place in dict.fromkeys((group, group.rpartition("/")[0])):
        fit = [name for name, array in arrays.items() if name.rpartition("/")[0] == place
               and array.shape in ((count,), (count, 1), (1, count), (count, 2))
               and array.dtype.kind in "iuf"
               and TIMES.search(UNIT.sub("", name.rpartition("/")[2].lower()))]
        rank = {name: (-len(_words(name) & _words(images)), len(name)) for name in fit}
        best = [name for name in fit if rank[name] == min(rank.values())]
        if best:
            return best[0] if len(best) == 1 else ""
    return ""


def are_images(array: Any) -> bool:
    """Whether an array may be images."""
    shape = array.shape
    return (len(shape) in (3, 4) and min(shape[1:3]) >= LEAST_SIDE and shape[0] > 0
            and array.dtype.kind in "iuf" and (len(shape) == 3 or shape[3] in (1, 3, 4)))


def _words(name: str) -> set[str]:
    """The words of the last part of a name, singular."""
    return {word.lower().rstrip("s") for word in WORD.findall(name.rpartition("/")[2])}


def _loading(
    name: str, times: str, whole: Callable[[str], np.ndarray], pixels: Pixels, path: Path,
    events: Events,
) -> Callable[[], tuple[np.ndarray, Callable[[slice], Iterable[np.ndarray]]]]:
    def load() -> tuple[np.ndarray, Callable[[slice], Iterable[np.ndarray]]]:
        stamps = mid_exposure(whole(times), times)
        unit = written_unit(times)
        if unit == "auto" and (len(stamps) < 2 or np.isfinite(stamps).all()):
            unit = shared_unit(stamps, events.t, ["us", *UNITS_US]) or "auto"
        us, _ = to_us(stamps, f"{times} of {path}", unit)
        return us, lambda part: map(_seen, pixels(name, part))

    return load


def _seen(image: np.ndarray) -> np.ndarray:
    """An image of a dtype that frames have, with channels in B, G, R."""
    if image.ndim == 3:
        image = image[..., 0] if image.shape[-1] == 1 else image[..., [2, 1, 0]]
    if image.dtype.kind == "f":
        return image.astype(np.float32)
    if image.dtype.itemsize > 1 and image.min() >= 0 and image.max() < 1 << 16:
        return image.astype(np.uint16)
    return image
