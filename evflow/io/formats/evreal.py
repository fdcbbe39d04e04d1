"""The folder of an EVREAL sequence (ercanburak/EVREAL): events_ts.npy (N,) s, events_xy.npy (N, 2),
events_p.npy (N,); images.npy (T, H, W) or (T, H, W, 1 or 3), images_ts.npy (T,) s; metadata.json
with sensor_resolution = (height, width), to which evflow adds exposure_us if it is known, and
full_scale (white) of uint16 and float32 images.
"""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
from typing import Any

import numpy as np

from evflow.checks import Size
from evflow.errors import EvflowDataError
from evflow.files.arrays import GrowingArray, mapped
from evflow.files.folders import atomic_folder
from evflow.files.json_text import parse_json
from evflow.files.regular import is_there
from evflow.files.whole import write_checked
from evflow.io.decode import tables
from evflow.io.decode.stream import gather
from evflow.io.hints import Hints
from evflow.io.images.exposures import KEY, Stamps, stated
from evflow.io.images.streams import ImageStream
from evflow.io.images.white import WHITE, stated_white
from evflow.io.writer import SECONDS_US, EventWriter
from evflow.types import Events, Recording

NAME = "evreal"
EXTENSIONS: tuple[str, ...] = ("",)

IMAGES, METADATA = "images.npy", "metadata.json"


def sniff(path: Path, head: bytes) -> bool:
    return path.is_dir() and (path / "events_ts.npy").is_file()


def read(path: Path, hints: Hints) -> Recording:
    """Raises EV009 (damaged), EV016 (a file is absent) and what `stream.gather` and `Recording`
    raise."""
    ts, ps = (mapped(path / f"events_{name}.npy", (None,)) for name in ("ts", "p"))
    xy = mapped(path / "events_xy.npy", (None, 2))
    n = tables.same_length(path, {"ts": ts, "p": ps, "xy": xy})
    seen = _image_size(path)
    found = gather(
        path, tables.blocks(n, lambda part: (xy[part, 0], xy[part, 1], ts[part], ps[part])),
        hints, _size(path, seen), _unit(ts))
    if not is_there(path / IMAGES):
        return Recording.of_events(found.events, found.notes)

    def load() -> tables.Loaded:
        images = _images(path)
        stamps = np.asarray(mapped(path / "images_ts.npy", (len(images),)))
        exposure_us, white = _stated(path)
        return tables.Loaded(Stamps(stamps, stated_us=exposure_us),
                             lambda keep: map(np.array, images[keep]), white)

    images = tables.Images(ImageStream(IMAGES, seen), load)
    return tables.with_frames(path, found, hints, images, _unit(ts))


def _unit(times: np.ndarray) -> str:
    return "s" if times.dtype.kind == "f" else "us"


def _images(path: Path) -> np.ndarray:
    try:
        return mapped(path / IMAGES, (None, None, None))
    except EvflowDataError:
        return mapped(path / IMAGES, (None, None, None, 3))


def _image_size(path: Path) -> Size | None:
    with contextlib.suppress(EvflowDataError):  # `load` explains what is wrong
        return tables.frame_size(_images(path))
    return None


def _size(path: Path, images: Size | None) -> Size | None:
    """Size of the sensor from metadata.json, in whichever order fits the images; else theirs."""
    try:
        declared = _declared_size(path)
    except EvflowDataError:
        if images is None:
            raise
        return images
    return images if declared is None or images == declared[::-1] else declared


def _declared_size(path: Path) -> Size | None:
    file = path / METADATA
    if not is_there(file) or file.stat().st_size > 1 << 20:
        return None
    try:
        height, width = parse_json(file.read_text("utf-8"))["sensor_resolution"][:2]
        return int(width), int(height)
    except (ValueError, KeyError, TypeError) as e:
        raise EvflowDataError(
            "EV009", f"{file} does not contain sensor_resolution = [height, width] ({e}).",
            "Correct it, or move it away and pass size=(width, height), --size WxH.",
            where=file) from e


def _stated(path: Path) -> tuple[int, int]:
    """The exposure of the images in us and their white from metadata.json, 0 for what it does not
    state."""
    file = path / METADATA
    if not is_there(file) or file.stat().st_size > 1 << 20:
        return 0, 0
    with contextlib.suppress(ValueError):
        held = parse_json(file.read_text("utf-8"))
        if isinstance(held, dict):
            return stated(held, held.__getitem__), stated_white(held.get(WHITE))
    return 0, 0


class EvrealWriter(EventWriter):
    """xy int16, p uint8; images (T, H, W, 1) as EVREAL indexes them, images_ts and
    image_event_indices (events before the image) (T, 1). Its metrics divide images by 255."""

    NAME = NAME
    MAX_SIDE = 2**15
    TIMES_US = (-SECONDS_US, SECONDS_US)
    FILES = ("events_ts", "events_xy", "events_p", "images", "images_ts", "image_event_indices")

    def _place(self) -> contextlib.AbstractContextManager[Path]:
        names = {*(f"{name}.npy" for name in self.FILES), METADATA}
        return atomic_folder(self.path, names=names, overwrite=self.overwrite)

    def _open(self, temporary: Path, stack: contextlib.ExitStack) -> None:
        self._folder = temporary
        self._arrays = {
            "events_ts": self._array("events_ts", "f8", stack),
            "events_xy": self._array("events_xy", "i2", stack, (2,)),
            "events_p": self._array("events_p", "u1", stack)}

    def _array(
        self, name: str, dtype: Any, stack: contextlib.ExitStack, item: tuple[int, ...] = ()
    ) -> GrowingArray:
        return stack.enter_context(GrowingArray(self._folder / f"{name}.npy", dtype, item))

    def _write(self, events: Events) -> None:
        self._arrays["events_ts"].append(events.t / 1e6)
        self._arrays["events_xy"].append(np.stack([events.x, events.y], 1))
        self._arrays["events_p"].append(events.p)

    def _write_frames(self, frames: np.ndarray, times: np.ndarray) -> None:
        if "images" not in self._arrays:
            item = (*frames.shape[1:], 1)
            self._arrays["images"] = self._array("images", frames.dtype, self._stack, item)
            self._arrays["images_ts"] = self._array("images_ts", "f8", self._stack, (1,))
        self._arrays["images"].append(frames[..., None])
        self._arrays["images_ts"].append(times[:, None] / 1e6)

    def _verify(self, temporary: Path) -> None:
        """Each array has already been checked when its file was written."""

    def _finish(self) -> None:
        for array in self._arrays.values():
            array.close()
        if "images" in self._arrays:
            ts, stamps = (mapped(self._folder / f"{name}_ts.npy", (None,))
                          for name in ("events", "images"))
            with GrowingArray(self._folder / "image_event_indices.npy", "i8", (1,)) as out:
                out.append(np.searchsorted(ts, stamps)[:, None])
                out.close()
        facts: dict[str, Any] = {"sensor_resolution": self.size[::-1]}
        if "images" in self._arrays and self.exposure_us:
            facts[KEY] = self.exposure_us
        if self.white:
            facts[WHITE] = self.white
        write_checked(self._folder / METADATA, json.dumps(facts) + "\n")
