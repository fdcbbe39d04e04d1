"""Single .npy arrays on disk: memory-mapped with their headers checked and pickles refused, and
written row by row.
"""

from __future__ import annotations

import math
import os
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from evflow.errors import EvflowDataError
from evflow.files.archives import npy_header
from evflow.files.regular import need_opened
from evflow.files.whole import need_size


def mapped(path: Path, shape: tuple[int | None, ...], *, fields: bool = False) -> np.ndarray:
    """A memory-mapped .npy of numbers; trailing axes of length 1 beyond `shape` are dropped.
    fields: expect a structured array instead.

    Raises EV009 (damaged, pickled, another shape), EV016 (absent, or not to be opened).
    """
    if not path.is_file():
        raise EvflowDataError("EV016", f"{path} does not exist.", "Is the folder complete?",
                              where=path)
    need_opened(path)
    try:
        with open(path, "rb") as f:
            found, fortran, dtype = npy_header(f)
            start = f.tell()
    except (OSError, EOFError, ValueError) as e:
        raise EvflowDataError(
            "EV009", f"{path} is not a valid .npy ({e or type(e).__name__}).",
            "Copy or export it again.", where=path) from e
    need, size = start + math.prod(found) * dtype.itemsize, os.path.getsize(path)
    if not (dtype.fields if fields else dtype.kind in "biuf") or need > size:
        raise EvflowDataError(
            "EV009", f"{path} claims {found} {dtype}, {need:,} bytes, but has {size:,}.",
            "Cut off? Copy or export it again.", where=path)
    kept = found
    while len(kept) > len(shape) and kept[-1] == 1:
        kept = kept[:-1]
    if len(kept) != len(shape) or any(
            want is not None and want != got for want, got in zip(shape, kept, strict=True)):
        raise EvflowDataError(
            "EV009", f"{path} has shape {found}; expected {shape}.", "Export it again.", where=path)
    if math.prod(found) == 0:
        return np.zeros(kept, dtype)
    data = np.memmap(path, dtype, "r", start, found, "F" if fortran else "C")
    return data.reshape(kept)


class GrowingArray:
    """A .npy file of rows of shape `item`, appended in any number."""

    def __init__(self, path: Path, dtype: Any, item: tuple[int, ...] = ()) -> None:
        self.dtype, self.item, self.rows = np.dtype(dtype), item, 0
        self._file = open(path, "wb")  # noqa: SIM115 (closed by `close`)
        self._header()

    def __enter__(self) -> GrowingArray:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, e: BaseException | None, tb: TracebackType | None
    ) -> None:
        self._file.close()

    def append(self, rows: np.ndarray) -> None:
        """Add rows (n, *item), cast to the dtype."""
        # not tofile, which raises the error of a full disk without its errno
        self._file.write(np.ascontiguousarray(rows, self.dtype).data.cast("B"))
        self.rows += len(rows)

    def close(self) -> None:
        """Write the number of rows into the header (0 until then); EV019 unless all rows were
        written."""
        self._file.seek(0)
        self._header()
        size = self._file.tell() + self.rows * math.prod(self.item) * self.dtype.itemsize
        self._file.close()
        need_size(Path(self._file.name), size)

    def _header(self) -> None:
        # NumPy reserves room for the first axis to grow: the header keeps its length.
        np.lib.format.write_array_header_1_0(self._file, {
            "descr": np.lib.format.dtype_to_descr(self.dtype), "fortran_order": False,
            "shape": (self.rows, *self.item)})
