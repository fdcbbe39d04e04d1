"""Events in one .npy: records with fields (tonic, Metavision, dv-processing), or N x 4 numbers,
whose order is inferred from the values. The file does not contain the size of the sensor.
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from evflow.errors import EvflowDataError
from evflow.files.archives import npy_header
from evflow.files.arrays import mapped
from evflow.io.decode import arrays, columns
from evflow.io.hints import Hints
from evflow.types import Recording

NAME = "npy"
EXTENSIONS: tuple[str, ...] = (".npy",)

MAGIC = b"\x93NUMPY"


def sniff(path: Path, head: bytes) -> bool:
    """True for records that name the columns, and for any N x 4 numbers; `read` checks them."""
    if not head.startswith(MAGIC):
        return False
    try:
        shape, _, dtype = npy_header(io.BytesIO(head))
    except ValueError:
        return False
    if dtype.fields:
        return len(shape) == 1 and bool(columns.by_name(dtype.names or ()))
    return len(shape) == 2 and 4 in shape and dtype.kind in "biuf"


def read(path: Path, hints: Hints) -> Recording:
    """Raises EV008 (no events), EV009 (damaged), EV015 (unknown size) and what `stream.gather`
    raises."""
    with open(path, "rb") as f:
        _, _, dtype = npy_header(f)
    data = mapped(path, (None,) if dtype.fields else (None, None), fields=bool(dtype.fields))
    table = arrays.structured(path.name, data) if dtype.fields else arrays.matrix(path.name, data)
    if table is None:
        first = np.array2string(data[:2], precision=6, max_line_width=10**6)
        raise EvflowDataError(
            "EV008", f"{path} holds {data.dtype} {data.shape}, not events: {first[:120]} ...",
            "Columns are t, x, y and p: whole pixels, times that never fall, a polarity of two "
            "values.", where=path)
    found = table.gather(path, hints, None)
    return Recording.of_events(found.events, found.notes)
