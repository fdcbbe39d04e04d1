"""What every HDF5 format needs: h5py on demand, protection from hostile files and full disks."""

from __future__ import annotations

import contextlib
import errno
import io
import math
import os
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from evflow.errors import EvflowDataError
from evflow.files.limits import check_expansion
from evflow.files.whole import not_whole
from evflow.io.decode.hdf5_columns import FILTERS, Column
from evflow.io.writer import EventWriter
from evflow.process.signals import uninterrupted

MAGIC = b"\x89HDF\r\n\x1a\n"
MAX_RATIO = 1040  # DEFLATE cannot expand by more than 1032
DAMAGE = (OSError, KeyError, RuntimeError, ValueError, TypeError, AttributeError, IndexError,
          MemoryError, OverflowError)  # what h5py raises on a damaged file


def load_h5py() -> Any:
    try:
        import h5py
    except ImportError as e:
        raise EvflowDataError(
            "EV010", "HDF5 files need the package 'h5py'.", 'pip install "evflow-jax[io]"') from e
    return h5py


def plausible(path: Path, data: Any, *, spooled: bool = False) -> Any:
    """The data set; EV009 if it claims more than the file can hold, or if blocks of it are missing
    or expand too far. spooled: it is read block by block to disk, and may be of any size."""
    from evflow.io.decode.hdf5_blocks import check_blocks
    if not spooled:
        check_expansion(data.nbytes, os.path.getsize(path), f"{path}: {data.name} {data.shape}")
    if data.nbytes > MAX_RATIO * os.path.getsize(path):
        raise EvflowDataError(
            "EV009", f"{path}: {data.name} claims {data.shape} {data.dtype} in a file of "
            f"{os.path.getsize(path):,} bytes.", "Copy or write the file again.", where=path)
    check_blocks(path, data)
    return data


def filters_of(data: Any) -> list[int]:
    """The numbers of the filters applied to its blocks, in order."""
    plist = data.id.get_create_plist()
    return [plist.get_filter(i)[0] for i in range(plist.get_nfilters())]


def need_filters(path: Path, data: Any, own: int | None = None) -> None:
    """Load hdf5plugin if a compression filter is not built in; EV010. own: a filter that the caller
    undoes itself, which must be the only one."""
    h5py = load_h5py()
    filters = filters_of(data)
    if all(h5py.h5z.filter_avail(number) for number in filters) or filters == [own]:
        return
    try:
        import hdf5plugin  # noqa: F401 (registers the filters)
    except ImportError as e:
        raise EvflowDataError(
            "EV010", f"{path} is compressed by HDF5 filter {max(filters)}, which needs the package "
            "'hdf5plugin'.", 'pip install "evflow-jax[io]"', where=path) from e
    if missing := [number for number in filters if not h5py.h5z.filter_avail(number)]:
        raise EvflowDataError(
            "EV010", f"{path}: {data.name} is compressed by HDF5 filter {missing[0]}, which HDF5 "
            "and hdf5plugin lack.", "Name its plugin's folder in HDF5_PLUGIN_PATH, or repack "
            "the file on the machine that wrote it: h5repack -f GZIP=1 in.h5 out.h5.", where=path)


class Disk(io.FileIO):
    """The file under HDF5, which cannot handle a failed call: it reports some errors in
    destructors, where they are lost, and crashes at exit. So no call raises; the first error,
    including KeyboardInterrupt, is kept here, later writes are skipped, and `check` raises it.

    written: offset -> (size, CRC-32) of the last write there. sought: offset of the read or write
    that must come next; if another comes first, that one was lost.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path, "w+")
        self.error: BaseException | None = None
        self.written: dict[int, tuple[int, int]] = {}
        self.sought: int | None = None

    def write(self, data: Any) -> int:
        rest = memoryview(data).cast("B")
        total = len(rest)
        try:
            self.sought = None
            self.written[self.tell()] = total, zlib.crc32(rest)
            while len(rest) and self.error is None:
                rest = rest[super().write(rest) :]
        except BaseException as e:
            self.error = self.error or e
        return total

    def readinto(self, buffer: Any) -> int:
        self.sought = None
        return self._kept(super().readinto, len(memoryview(buffer).cast("B")), buffer)

    def seek(self, place: int, whence: int = os.SEEK_SET) -> int:
        if whence == os.SEEK_SET:
            self._note_lost()
            self.sought = place
        return self._kept(super().seek, place, place, whence)

    def truncate(self, size: int | None = None) -> int:
        return self._kept(super().truncate, size or 0, size)

    def flush(self) -> None:
        self._kept(super().flush, None)

    def _kept(self, call: Callable[..., Any], instead: Any, *arguments: Any) -> Any:
        try:
            return call(*arguments)
        except BaseException as e:
            self.error = self.error or e
            return instead

    def _note_lost(self) -> None:
        if self.sought is not None and self.error is None:
            self.error = OSError(errno.EIO, f"a call at byte {self.sought} was lost")

    def check(self) -> None:
        self._note_lost()
        if self.error is not None:
            raise self.error


class Hdf5Writer(EventWriter):
    """A writer of growing data sets, compressed by gzip, which every HDF5 can read."""

    CHUNK = 1 << 16  # events per HDF5 chunk: 256 KiB of t

    def _guard(self) -> contextlib.AbstractContextManager[None]:
        return uninterrupted()

    def _open(self, temporary: Path, stack: contextlib.ExitStack) -> None:
        h5py = load_h5py()
        self._shapes: dict[str, tuple[int, ...]] = {}  # of everything appended
        self._columns: dict[str, Column] = {}
        self._disk = Disk(temporary)
        self._file: Any = None
        stack.callback(self._close)
        # HDF5 1.10 checksums its metadata: none of 1,500 damaged files was accepted, against
        # 24 in the older layout.
        self._file = h5py.File(self._disk, "w", libver=("v110", "v110"))

    def _close(self) -> None:
        with uninterrupted(), contextlib.ExitStack() as closing:
            closing.enter_context(self._disk)
            closing.callback(self._disk.check)
            if self._file is not None:
                closing.callback(self._file.close)
                self._file.flush()

    def _verify(self, temporary: Path) -> None:
        need_whole(temporary, self._shapes, self._disk.written)

    def _finish(self) -> None:
        for name in self._columns:
            self._settle(name)

    def _create(self, name: str, item: tuple[int, ...], dtype: Any, chunk: int) -> None:
        self._shapes[name] = (0, *item)
        data = self._file.create_dataset(
            name, (0, *item), dtype, maxshape=(None, *item), chunks=(chunk, *item), **FILTERS)
        if not item:
            self._columns[name] = Column(data)

    def _extend(self, name: str, values: np.ndarray) -> None:
        rows, *item = self._shapes[name]
        self._shapes[name] = (rows + len(values), *item)
        if name in self._columns:
            self._columns[name].extend(values)
        else:
            data = self._file[name]
            data.resize(rows + len(values), axis=0)
            data[rows:] = values
        self._disk.check()

    def _settle(self, name: str) -> None:
        """Write all of a column that was appended, so that it can be read."""
        self._columns[name].settle()
        self._disk.check()

    def _store(self, name: str, values: Any, **options: Any) -> Any:
        """Create a data set of its final shape."""
        data = self._file.create_dataset(name, data=values, **options)
        self._shapes[name] = data.shape
        self._disk.check()
        return data


def need_whole(
    path: Path, shapes: Mapping[str, tuple[int, ...]], written: Mapping[int, tuple[int, int]]
) -> None:
    """Raise EV019 unless the file opens, has the data sets of `shapes` with all chunks allocated,
    and each chunk is on disk as HDF5 wrote it: offset -> (size, CRC-32).

    Detects a write, chunk or end of file that was lost, also when a signal or an error interrupted
    it. HDF5 checks its metadata itself; chunks stay compressed, so this takes about 3 % of the
    writing time. The data before compression are not compared.
    """
    try:
        with load_h5py().File(path) as f, open(path, "rb") as raw:
            for name, shape in shapes.items():
                if f[name].shape != shape:
                    raise not_whole(path, f"{name} is {f[name].shape} of {shape}")
                pieces = _pieces(f[name])
                if f[name].chunks and len(pieces) != math.prod(
                        -(-n // c) for n, c in zip(shape, f[name].chunks, strict=True)):
                    raise not_whole(path, f"{name} lacks some of its chunks")
                for begin, size in pieces:
                    raw.seek(begin)
                    if written.get(begin) != (size, zlib.crc32(raw.read(size))):
                        raise not_whole(path, f"{name} is damaged at byte {begin:,}")
    except DAMAGE as e:
        raise not_whole(path, f"{type(e).__name__}: {e}") from e


def _pieces(data: Any) -> list[tuple[int, int]]:
    """(offset, size) of all parts of a data set in the file."""
    if data.chunks is None:
        return [(data.id.get_offset(), data.id.get_storage_size())]
    pieces: list[tuple[int, int]] = []
    if hasattr(data.id, "chunk_iter"):
        with uninterrupted():  # this also calls Python from C
            data.id.chunk_iter(lambda chunk: pieces.append((chunk.byte_offset, chunk.size)))
    else:  # HDF5 before 1.12.3
        chunks = map(data.id.get_chunk_info, range(data.id.get_num_chunks()))
        pieces += [(chunk.byte_offset, chunk.size) for chunk in chunks]
    return pieces
