"""Zip archives and .npy headers of unknown origin: damage becomes EV009 whatever Python's readers
raise, zip bombs are refused before they are unpacked, pickles are never loaded."""

from __future__ import annotations

import contextlib
import io
import math
import os
import zipfile
import zlib
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import IO, Any

import numpy as np

from evflow.errors import EvflowDataError
from evflow.files.limits import check_expansion
from evflow.files.regular import need_opened
from evflow.files.spool import Spool

MAX_HEADER = 10_000  # bytes, NumPy's own bound
BLOCK = 1 << 20  # bytes, or values, read at a time
DAMAGE = (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, EOFError, ValueError,
          OSError)  # what zipfile raises on a damaged archive


class Pickled(ValueError):
    """An array of Python objects, which only a pickle could load."""


def is_zip(path: Path) -> bool:
    """Whether a file is a zip archive, or a damaged one, for which `unzipped` raises."""
    try:
        return zipfile.is_zipfile(path)
    except zipfile.BadZipFile:  # its last record claims several disks
        return True


@contextlib.contextmanager
def unzipped(path: Path, streamed: Collection[str] = ()) -> Iterator[zipfile.ZipFile]:
    """Open an archive; EV016 if it cannot be opened, EV009 if it, or anything the block reads from
    it, is damaged or a bomb, EV008 if an array that it reads is pickled.

    streamed: members that are read in pieces and may therefore be of any size."""
    need_opened(path)
    try:
        with zipfile.ZipFile(path) as archive:
            found, there = archive.infolist(), os.path.getsize(path)
            if (most := max((info.compress_size for info in found), default=0)) > there:
                # zipfile would allocate memory for all of them
                raise ValueError(f"a member of {most} bytes in a file of {there}")
            sizes = [info.file_size for info in found if info.filename not in streamed]
            check_expansion(sum(sizes), there, path)
            yield archive
    except Pickled as e:
        raise EvflowDataError("EV008", f"{path} cannot be read: {e}.", "Save it as numbers.",
                              where=path) from e
    except DAMAGE as e:
        raise EvflowDataError(
            "EV009", f"{path} is damaged ({e or type(e).__name__}).", "Copy it again.",
            where=path) from e


def npy_header(
    f: IO[bytes], pickled: bool = False
) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Shape, Fortran order and dtype from the header of the .npy at f; ValueError if it is damaged,
    Pickled if it holds Python objects. pickled: whether it may."""
    begin = f.read(8)  # magic and version
    first = begin[6:7] == b"\x01"
    length = f.read(2 if first else 4)
    if int.from_bytes(length, "little") > MAX_HEADER:  # NumPy would allocate all of it
        raise ValueError("its header is damaged")
    whole = io.BytesIO(begin + length + f.read(int.from_bytes(length, "little")))
    try:
        np.lib.format.read_magic(whole)
        read: Any = (np.lib.format.read_array_header_1_0 if first
                     else np.lib.format.read_array_header_2_0)
        shape, fortran, dtype = read(whole)
    except Exception as e:  # many types: tokenize's, MemoryError for deeply nested brackets
        raise ValueError(str(e) or f"its header is damaged ({type(e).__name__})") from None
    if dtype.hasobject and not pickled:
        raise Pickled("it holds Python objects: pickles are refused")
    if min(shape, default=0) < 0:
        raise ValueError(f"its shape is {shape}")
    return shape, fortran, dtype


def load_npz(path: Path) -> dict[str, np.ndarray]:
    """All arrays of an .npz by key; EV016 without the file, EV009 if any of them is damaged, EV008
    if one is pickled."""
    with members(path) as found:
        return {name: member.whole() for name, member in found.items()}


@contextlib.contextmanager
def members(path: Path, streamed: Collection[str] = ()) -> Iterator[dict[str, Member]]:
    """The arrays of an .npz by key, readable within the block; streamed, EV008 and EV009 as
    in `unzipped`."""
    with unzipped(path, streamed) as archive:
        found = {info.filename.removesuffix(".npy"): Member(archive, info)
                 for info in archive.infolist()}
        try:
            yield found
        finally:
            for member in found.values():
                member.close()


class Member:
    """An array of an open .npz, read whole or in order by rows; ValueError or zipfile's errors if
    it is damaged, Pickled if it holds Python objects. The checksum is verified at its end."""

    def __init__(self, archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> None:
        if not info.filename.endswith(".npy"):  # skipping it could silently lose the frames
            raise ValueError(f"{info.filename} is not an array")
        self._archive, self._info = archive, info
        self._file: IO[bytes] | None = None  # opened when read: an open one takes 50 kB
        with archive.open(info) as f:
            self.shape, self.fortran, self.dtype = npy_header(f, pickled=True)
        if not self.pickled and math.prod(self.shape) * self.dtype.itemsize > info.file_size:
            raise ValueError(f"{info.filename} is cut off: {self.dtype} {self.shape}")

    @property
    def pickled(self) -> bool:
        """Whether it holds Python objects, which are never loaded."""
        return self.dtype.hasobject

    def need_numbers(self) -> None:
        if self.pickled:
            raise Pickled(f"{self._info.filename.removesuffix('.npy')} holds Python objects, and "
                          "pickles are never loaded")

    def take(self, count: int) -> np.ndarray:
        """The next `count` values, (count,), in file order."""
        return np.frombuffer(self._data().read(count * self.dtype.itemsize), self.dtype, count)

    def finish(self) -> None:
        """Read the rest, to verify the checksum."""
        while self._data().read(BLOCK):
            pass
        self.close()

    def whole(self) -> np.ndarray:
        """The whole array, in memory."""
        try:
            flat = self.take(math.prod(self.shape))
            self.finish()
        finally:
            self.close()
        return flat.reshape(self.shape, order="F" if self.fortran else "C")

    def spooled(self) -> np.ndarray:
        """The array, in memory or on disk as `Spool` decides."""
        spool, left = Spool(self.dtype), math.prod(self.shape)
        while left:
            spool.append(self.take(min(left, BLOCK)))
            left -= min(left, BLOCK)
        self.finish()
        return spool.array().reshape(self.shape, order="F" if self.fortran else "C")

    def close(self) -> None:
        """Close it; a later read starts from the beginning."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def _data(self) -> IO[bytes]:
        self.need_numbers()
        if self._file is None:
            self._file = self._archive.open(self._info)
            npy_header(self._file)
        return self._file
