"""A column that grows in parts: in memory, and above a limit in a temporary file.

A recording larger than memory is thus read like any other: its columns are memory-mapped, and a
window loads what it needs. The file lies in the system's temporary folder (TMPDIR) and disappears
with the last array that uses it, or with the process.
"""

from __future__ import annotations

import contextlib
import contextvars
import mmap
import os
import tempfile
from collections.abc import Iterator
from typing import IO, Any

import numpy as np

from evflow.errors import EvflowDataError
from evflow.files.atomic import REASONS

LIMIT = 1 << 29  # bytes of a column in memory: 67 million int64 times
SOME = 1 << 25  # the same for columns of which little is used again: 4 million times
LITTLE = 1 << 24  # and for columns that are read once
JOINED = 1 << 25  # bytes of parts; malloc reuses warm memory for smaller arrays


_limit: contextvars.ContextVar[int | None] = contextvars.ContextVar("limit", default=None)


@contextlib.contextmanager
def on_disk(limit: int = LITTLE) -> Iterator[None]:
    """Columns begun in this block keep only `limit` bytes each in memory, for work that reads them
    once and in order, such as a conversion."""
    before = _limit.set(limit)
    try:
        yield
    finally:
        _limit.reset(before)


def forget(*arrays: np.ndarray) -> None:
    """Release the memory pages of mapped arrays: their data stay on disk and are read again on
    demand. Other arrays are unaffected, and so are maps whose changes are in memory alone (mode
    "c")."""
    for array in arrays:
        base: Any = array
        while isinstance(base, np.ndarray):
            mapped = getattr(base, "_mmap", None)
            if mapped is not None and hasattr(mmap, "MADV_DONTNEED"):
                if getattr(base, "mode", "") != "c":
                    mapped.madvise(mmap.MADV_DONTNEED)
                break
            base = base.base


def put_aside(array: np.ndarray) -> np.ndarray:
    """The array, moved to disk until it is used; EV019 if the disk is full."""
    spool = Spool(array.dtype, 0)
    spool.append(array.ravel())
    aside = np.asarray(spool.array()).reshape(array.shape)
    forget(aside)
    return aside


@contextlib.contextmanager
def temporary_folder() -> Iterator[None]:
    """Raise EV019 where the system's temporary folder is full, absent or may not be used."""
    try:
        yield
    except OSError as e:
        why = REASONS.get(e.errno or 0, e.strerror or str(e))
        raise EvflowDataError(
            "EV019", "the recording is larger than memory, and the temporary folder "
            f"{tempfile.tempdir or os.environ.get('TMPDIR', '')} cannot be used ({why}).",
            "Set TMPDIR to a folder with more space, or read a part: --start, --stop.") from e


class Spool:
    """Parts (n,) of one dtype, joined by `array`. Memory: the rows below the limit, up to an eighth
    more that is unused, and `JOINED` bytes of parts."""

    def __init__(self, dtype: Any, limit: int | None = None) -> None:
        self.dtype, self.rows = np.dtype(dtype), 0
        self.limit = (_limit.get() or LIMIT) if limit is None else limit
        self._memory, self._filled = np.empty(0, self.dtype), 0
        self._parts: list[np.ndarray] = []  # rows after those of _memory or _file
        self._file: IO[bytes] | None = None

    def append(self, part: np.ndarray) -> None:
        """Add a part, cast to the dtype, copied if it is a view; EV019 if the disk is full."""
        self._parts.append(part.astype(self.dtype, copy=part.base is not None))
        self.rows += len(part)
        if self._file is None and self.rows * self.dtype.itemsize > self.limit:
            with temporary_folder():
                self._file = tempfile.TemporaryFile(prefix="evflow-")  # noqa: SIM115 (mapped later)
            self._parts.insert(0, self._memory[: self._filled])
            self._memory = np.empty(0, self.dtype)
        if self._file is not None:
            self._write(self._file)
        elif (self.rows - self._filled) * self.dtype.itemsize > JOINED:
            self._join()

    def _join(self) -> None:
        """Append the parts to the rows in memory, which grow by realloc: it moves large arrays
        without copying, so nothing exists twice."""
        if self.rows > len(self._memory):
            self._memory.resize(max(self.rows, len(self._memory) * 9 // 8), refcheck=False)
        parts, self._parts = self._parts, []
        np.concatenate(parts, out=self._memory[self._filled : self.rows])
        self._filled = self.rows

    def _write(self, file: IO[bytes]) -> None:
        parts, self._parts = self._parts, []
        try:
            with temporary_folder():
                for part in parts:
                    file.write(np.ascontiguousarray(part).data.cast("B"))
                file.flush()
        except EvflowDataError:
            file.close()
            raise

    def array(self) -> np.ndarray:
        """All rows, in one array or mapped from the file. The spool is empty afterwards."""
        if self._file is not None:
            with self._file as file:  # the map outlives the open file
                return np.memmap(file, self.dtype, "r+", shape=(self.rows,))
        if self._parts and not self._filled:
            parts, self._parts = self._parts, []
            return np.concatenate(parts)
        if self._parts:
            self._join()
        memory, self._memory = self._memory, np.empty(0, self.dtype)
        memory.resize(self.rows, refcheck=False)
        return memory
