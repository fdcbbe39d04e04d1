"""HDF5 as the simulator v2e writes it (v2ecore/emulator.py, --dvs_h5 and --ddd_output).

/events uint32 (N, 4): t us, x, y, p in {0, 1}; other tools use other orders, inferred from the
values. With frames: /frame uint8 (T, H, W), /frame_ts uint32 us. Without them the file does not
contain the sensor's size, and images under other names are its frames if their times can be found
(`images_beside`).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from evflow.io.decode import arrays, columns, tables
from evflow.io.decode.hdf5_search import declared_size, images_beside
from evflow.io.hints import Hints
from evflow.types import Recording

NAME = "v2e"
EXTENSIONS: tuple[str, ...] = (".h5", ".hdf5")


def sniff(path: Path, head: bytes) -> bool:
    """Integers only; floats of that shape have another order."""
    return tables.holds(head, path, lambda f: getattr(f.get("events"), "shape", ())[1:] == (4,)
                        and f["events"].dtype.kind != "f")


def read(path: Path, hints: Hints) -> Recording:
    """Raises EV008, EV009, EV010 (h5py) and what `stream.gather` and `Recording` raise."""
    with tables.opened(path) as f:
        data = tables.dataset(path, f, "events", (None, 4))
        size = tables.frame_size(f.get("frame")) or declared_size(f, f)

        def rows(part: slice) -> tuple[Any, Any, Any, Any]:
            t, x, y, p = np.ascontiguousarray(data[part].T)
            return x, y, t, p

        table = arrays.matrix("events", data)
        if table is None or table.notes == (columns.inferred("txyp"),):
            table = arrays.Table("events", len(data), rows, "us", tables.stored_rows(data))
        found = table.gather(path, hints, size)
        if "frame" not in f:
            return images_beside(path, f, found, hints, "events")
        return tables.with_frames(
            path, found, hints, tables.dataset_images(path, f, "frame", "frame_ts"), "us")
