"""The folder of an EVREAL sequence (ercanburak/EVREAL): events_ts.npy (N,) s, events_xy.npy (N, 2),
events_p.npy (N,); images.npy (T, H, W) or (T, H, W, 1 or 3), images_ts.npy (T,) s; metadata.json
with sensor_resolution = (height, width).
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from evflow.checks import Size
from evflow.errors import EvflowDataError
from evflow.io import tables
from evflow.io.arrays import mapped
from evflow.io.hints import Hints
from evflow.io.stream import gather
from evflow.types import Recording

NAME = "evreal"
EXTENSIONS: tuple[str, ...] = ("",)


def sniff(path: Path, head: bytes) -> bool:
    return path.is_dir() and (path / "events_ts.npy").is_file()


def read(path: Path, hints: Hints) -> Recording:
    """Raises EV009 (damaged), EV016 (a file is absent) and what `stream.gather` and `Recording`
    raise."""
    ts, ps = (mapped(path / f"events_{name}.npy", (None,)) for name in ("ts", "p"))
    xy = mapped(path / "events_xy.npy", (None, 2))
    n = tables.same_length(path, {"ts": ts, "p": ps, "xy": xy})
    images = _images(path)
    size = _told_size(path) if images is None else tables.frame_size(images)
    events, span = gather(
        path, tables.blocks(n, lambda part: (xy[part, 0], xy[part, 1], ts[part], ps[part])),
        hints, size, _unit(ts))
    if images is None:
        return Recording.of_events(events)
    stamps = mapped(path / "images_ts.npy", (len(images),))
    times = hints.microseconds(np.asarray(stamps), _unit(stamps))
    return tables.with_frames(path, events, span, times,
                              lambda keep: [_rgb(image) for image in images[keep]], ())


def _unit(times: np.ndarray) -> str:
    return "s" if times.dtype.kind == "f" else "us"


def _images(path: Path) -> np.ndarray | None:
    if not (path / "images.npy").is_file():
        return None
    try:
        return mapped(path / "images.npy", (None, None, None))
    except EvflowDataError:
        return mapped(path / "images.npy", (None, None, None, 3))


def _rgb(image: np.ndarray) -> np.ndarray:
    """A copy of its own; the writers' OpenCV orders colours B, G, R."""
    return np.array(image if image.ndim == 2 else image[..., ::-1])


def _told_size(path: Path) -> Size | None:
    file = path / "metadata.json"
    if not file.is_file() or file.stat().st_size > 1 << 20:
        return None
    try:
        height, width = json.loads(file.read_text("utf-8"))["sensor_resolution"][:2]
        return int(width), int(height)
    except (ValueError, KeyError, TypeError, RecursionError) as e:
        raise EvflowDataError(
            "EV009", f"{file} does not tell sensor_resolution = [height, width] ({e}).",
            "Correct it, or move it away and pass size=(width, height), --size WxH.") from e
