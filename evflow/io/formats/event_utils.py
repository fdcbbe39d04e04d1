"""HDF5 of the E2VID family (event_utils, event_cnn_minimal, the ECOCO and HQF data sets).

/events/{xs, ys, ts, ps}: ts float64 s (integers: us), ps bool, {0, 1} or {-1, 1};
/images/image000000000 ... with an attribute `timestamp` in s; attribute sensor_resolution is
(height, width) by its authors, though files with (width, height) exist: the images decide, and
without images the order in which all events fit.
"""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import numpy as np

from evflow.checks import Size
from evflow.errors import EvflowDataError
from evflow.io.decode import tables
from evflow.io.decode.hdf5 import Hdf5Writer
from evflow.io.decode.hdf5_columns import FILTERS
from evflow.io.decode.hdf5_search import declared_size, images_beside
from evflow.io.decode.stream import gather
from evflow.io.hints import Hints
from evflow.io.images.exposures import KEY, Stamps, stated_by
from evflow.io.images.numbers import natural
from evflow.io.images.streams import ImageStream
from evflow.io.images.white import WHITE, stated_white
from evflow.io.writer import FLUSH, SECONDS_US
from evflow.notes import Note
from evflow.types import Events, Recording

NAME = "event_utils"
EXTENSIONS: tuple[str, ...] = (".h5", ".hdf5")

COLUMNS = ("xs", "ys", "ts", "ps")


def sniff(path: Path, head: bytes) -> bool:
    return tables.holds(head, path, lambda f: "events/xs" in f and "events/ts" in f)


def read(path: Path, hints: Hints) -> Recording:
    """Raises EV008, EV009, EV010 (h5py) and what `stream.gather` and `Recording` raise."""
    with tables.opened(path) as f:
        columns = {name: tables.dataset(path, f["events"], name, (None,)) for name in COLUMNS}
        n = tables.same_length(path, columns)
        xs, ys, ts, ps = columns.values()
        seen = _image_size(f)
        size, notes = _size(f, seen, columns)
        native = "s" if ts.dtype.kind == "f" else "us"
        chunks = tables.blocks(n, lambda part: (xs[part], ys[part], ts[part], ps[part]),
                               max(tables.stored_rows(column) for column in columns.values()))
        found = gather(path, chunks, hints, size, native)
        if not _names(f):
            return images_beside(path, f, found, hints, "events/ts", notes)

        def load() -> tables.Loaded:
            images = [_image(path, f["images"], name) for name in _names(f)]
            stamps = Stamps(np.array([_time(path, image) for image in images]),
                            stated_us=round(np.median([stated_by(image) for image in images])))
            return tables.Loaded(
                stamps, lambda keep: (_pixels(image[:]) for image in images[keep]),
                stated_white(images[0].attrs.get(WHITE)))

        images = tables.Images(ImageStream("images", seen), load)
        return tables.with_frames(path, found, hints, images, native, notes)


def _names(f: Any) -> list[str]:
    return sorted(f["images"], key=natural) if hasattr(f.get("images"), "keys") else []


def _image_size(f: Any) -> Size | None:
    """(width, height) of the first image; None if there is none or it is no image."""
    shape: tuple[int, ...] = getattr(f["images"][_names(f)[0]], "shape", ()) if _names(f) else ()
    return (int(shape[1]), int(shape[0])) if len(shape) in (2, 3) and all(shape[:2]) else None


def _image(path: Path, group: Any, name: str) -> Any:
    colour = len(getattr(group[name], "shape", ())) == 3
    return tables.dataset(path, group, name, (None, None, None) if colour else (None, None))


def _time(path: Path, image: Any) -> Any:
    if "timestamp" not in image.attrs:
        raise EvflowDataError(
            "EV008", f"{path}: {image.name} has no attribute 'timestamp'.",
            "Write the file again, with the time of each image in seconds.", where=path)
    return np.asarray(image.attrs["timestamp"]).reshape(-1)[0]


def _pixels(image: np.ndarray) -> np.ndarray:
    """Drop a single channel; three are in OpenCV's order B, G, R."""
    return image[..., 0] if image.ndim == 3 and image.shape[-1] == 1 else image


def _size(
    f: Any, images: Size | None, columns: dict[str, Any]
) -> tuple[Size | None, tuple[Note, ...]]:
    """Size of the sensor: that of the images, unless sensor_resolution differs in either order;
    without both, what else the file says of it."""
    stated = np.asarray(f.attrs.get("sensor_resolution", ())).ravel()
    if len(stated) < 2 or stated.dtype.kind not in "iuf" or not (stated[:2] > 0).all():
        return images or declared_size(f, f["events"]), ()
    height, width = (int(v) for v in stated[:2])
    if images in ((width, height), (height, width)):
        return images, ()
    if height <= width:  # the usual case: events cannot contradict it, so columns are read once
        return (width, height), ()
    reach = [0, 0]
    for first in range(0, len(columns["xs"]), tables.ROWS):
        for i, name in enumerate(("xs", "ys")):
            reach[i] = max(reach[i], int(columns[name][first : first + tables.ROWS].max()))
    if reach[0] >= width and reach[0] < height and reach[1] < width:
        return (height, width), (Note(
            "sensor.size", f"sensor_resolution {height}, {width} was taken as (width, height): "
            f"events reach x={reach[0]}, y={reach[1]}"),)
    return (width, height), ()


class EventUtilsWriter(Hdf5Writer):
    """xs, ys int16, as their loaders expect; ts float64 s; ps bool. Every image has `timestamp`,
    `event_idx`, the last event before it, and `exposure_us` and `full_scale` if they are known."""

    NAME = NAME
    MAX_SIDE = 2**15
    TIMES_US = (-SECONDS_US, SECONDS_US)

    def _open(self, temporary: Path, stack: contextlib.ExitStack) -> None:
        super()._open(temporary, stack)
        self._on, self._first_s = 0, 0.0
        self._image_s: list[float] = []
        for name, dtype in zip(COLUMNS, ("i2", "i2", "f8", "?"), strict=True):
            self._create(f"events/{name}", (), dtype, self.CHUNK)

    def _write(self, events: Events) -> None:
        seconds = events.t / 1e6
        if not len(self._file["events/ts"]):
            self._first_s = float(seconds[0])
        for name, values in zip(COLUMNS, (events.x, events.y, seconds, events.p), strict=True):
            self._extend(f"events/{name}", values)
        self._on += int(events.p.sum())

    def _write_frames(self, frames: np.ndarray, times: np.ndarray) -> None:
        for frame, second in zip(frames, times / 1e6, strict=True):
            image = self._store(
                f"images/image{len(self._image_s):09d}", frame, chunks=frame.shape, **FILTERS)
            image.attrs.update(size=frame.shape, timestamp=second, type="greyscale")
            if self.exposure_us:
                image.attrs[KEY] = np.int64(self.exposure_us)
            if self.white:
                image.attrs[WHITE] = np.int64(self.white)
            self._image_s.append(float(second))
            self._disk.check()

    def _finish(self) -> None:
        super()._finish()
        ts, count = self._file["events/ts"], len(self._image_s)
        before = np.zeros(count, np.int64)
        for first in range(0, len(ts) if count else 0, FLUSH):
            before += np.searchsorted(ts[first : first + FLUSH], self._image_s)
        for index, events in enumerate(before):
            self._file[f"images/image{index:09d}"].attrs["event_idx"] = max(events - 1, 0)
        last_s = float(ts[-1]) if len(ts) else 0.0
        self._file.attrs.update(
            sensor_resolution=self.size[::-1], num_events=len(ts), num_pos=self._on,
            num_neg=len(ts) - self._on, t0=self._first_s, tk=last_s,
            duration=last_s - self._first_s, num_imgs=count, num_flow=0)
