"""What every HDF5 format needs: h5py on demand, hostile files kept out, full disks survived."""

from __future__ import annotations

import io
import os
from pathlib import Path
from typing import Any

from evflow.errors import EvflowDataError

MAGIC = b"\x89HDF\r\n\x1a\n"
MAX_RATIO = 1040  # DEFLATE cannot expand by more than 1032; a data set that claims more lies
DAMAGE = (OSError, KeyError, RuntimeError, ValueError, TypeError, AttributeError, IndexError,
          MemoryError, OverflowError)  # what h5py raises on a damaged file


def load_h5py() -> Any:
    try:
        import h5py
    except ImportError as e:
        raise EvflowDataError(
            "EV010", "HDF5 files need the package 'h5py'.", 'pip install "evflow-jax[io]"') from e
    return h5py


def plausible(path: Path, data: Any) -> Any:
    """The data set, unless it claims more than the file can hold; EV009."""
    if data.nbytes > MAX_RATIO * os.path.getsize(path):
        raise EvflowDataError(
            "EV009", f"{path}: {data.name} claims {data.shape} {data.dtype} in a file of "
            f"{os.path.getsize(path):,} bytes.", "Copy or write the file again.")
    return data


def need_filters(path: Path, data: Any) -> None:
    """Load hdf5plugin where a compression filter is not built in; EV010."""
    h5py = load_h5py()
    plist = data.id.get_create_plist()
    filters = [plist.get_filter(i)[0] for i in range(plist.get_nfilters())]
    if all(h5py.h5z.filter_avail(number) for number in filters):
        return
    try:
        import hdf5plugin  # noqa: F401 (registers the filters)
    except ImportError as e:
        raise EvflowDataError(
            "EV010", f"{path} is compressed by HDF5 filter {max(filters)}, which needs the package "
            "'hdf5plugin'.", 'pip install "evflow-jax[io]"') from e


class Disk(io.FileIO):
    """The file under HDF5, which cannot live with a failed write: it reports some in destructors,
    where they are lost, and crashes at exit. So the first error is kept here, what follows it is
    not written, and `check` raises it."""

    error: OSError | None = None

    def write(self, data: Any) -> int:
        rest = memoryview(data).cast("B")
        total = len(rest)
        try:
            while len(rest) and self.error is None:
                rest = rest[super().write(rest) :]
        except OSError as e:
            self.error = e
        return total

    def check(self) -> None:
        if self.error is not None:
            raise self.error
