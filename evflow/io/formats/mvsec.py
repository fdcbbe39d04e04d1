"""HDF5 of the MVSEC data set (Zhu et al. 2018), *_data.hdf5: a stereo pair of DAVIS346.

/davis/left/events float64 (N, 4): x, y, t in s since 1970, p in {-1, 1}; image_raw uint8
(T, 260, 346), image_raw_ts. The left camera is read; where it has no events, the right one.
*_gt.hdf5 holds depth, poses and flow, and no events.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from evflow.errors import EvflowDataError
from evflow.io.decode import hdf5_search, tables
from evflow.io.decode.stream import gather
from evflow.io.hints import Hints
from evflow.notes import Note
from evflow.types import Recording

NAME = "mvsec"
EXTENSIONS: tuple[str, ...] = (".hdf5", ".h5")

SIZE = (346, 260)
SIDES = ("left", "right")


def sniff(path: Path, head: bytes) -> bool:
    return tables.holds(head, path, lambda f: "davis" in f and not hdf5_search.has_columns(f))


def read(path: Path, hints: Hints) -> Recording:
    """Raises EV008 (no events), EV009, EV010 (h5py) and what `stream.gather` and `Recording`
    raise. Frame times are those of the file: MVSEC does not say where in the exposure they lie."""
    with tables.opened(path) as f:
        davis = f["davis"]
        sides = [s for s in SIDES if f"davis/{s}/events" in f]
        if not sides:
            raise EvflowDataError(
                "EV008", f"{path}: /davis holds {sorted(davis)} without events.",
                "If this is MVSEC's ground truth: events are in the file *_data.hdf5.", where=path)
        side, more = hints.camera(sides)
        camera = davis[side]
        data = tables.dataset(path, camera, "events", (None, 4))

        def rows(part: slice) -> tuple[Any, Any, Any, Any]:
            x, y, t, p = np.ascontiguousarray(data[part].T)
            return x, y, t, p

        chunks = tables.blocks(len(data), rows, tables.stored_rows(data))
        found = gather(path, chunks, hints, SIZE, "s")
        notes = more or (Note("sensor.camera", f"the {side} camera was read"),)
        if "image_raw" not in camera:
            return Recording.of_events(found.events, (*notes, *found.notes))
        images = tables.dataset_images(path, camera, "image_raw", "image_raw_ts")
        return tables.with_frames(path, found, hints, images, "s", notes)
