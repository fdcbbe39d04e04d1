"""A column that grows part by part: in memory, and from a limit on in a temporary file.

So a recording larger than memory is read like any other: its columns are mapped from disk, and a
window takes what it needs. The file lies in the system's temporary folder (TMPDIR) and is gone
with the last array that shows it, or with the process.
"""

from __future__ import annotations

import errno
import tempfile
from typing import IO, Any

import numpy as np

from evflow.errors import EvflowDataError

LIMIT = 1 << 29  # bytes of a column in memory: 67 million int64 times


class Spool:
    """Parts (n,) of one dtype, joined by `array`."""

    def __init__(self, dtype: Any, limit: int | None = None) -> None:
        self.dtype, self.rows = np.dtype(dtype), 0
        self.limit = LIMIT if limit is None else limit
        self._parts: list[np.ndarray] = []
        self._file: IO[bytes] | None = None

    def append(self, part: np.ndarray) -> None:
        """Add a part, which is kept as it is while all fits into memory; EV019 where the disk
        is full."""
        part = part.astype(self.dtype, copy=False)
        self.rows += len(part)
        self._parts.append(part)
        if self._file is None and self.rows * self.dtype.itemsize > self.limit:
            self._file = tempfile.TemporaryFile(prefix="evflow-")  # noqa: SIM115 (mapped later)
        if self._file is not None:
            self._write(self._file)

    def _write(self, file: IO[bytes]) -> None:
        parts, self._parts = self._parts, []
        try:
            for part in parts:
                file.write(np.ascontiguousarray(part).data.cast("B"))
            file.flush()
        except OSError as e:
            file.close()
            if e.errno != errno.ENOSPC:
                raise
            raise EvflowDataError(
                "EV019", f"the recording is larger than memory, and {tempfile.gettempdir()}, where "
                "it is kept meanwhile, is full.",
                "Set TMPDIR to a folder with room, or read a part: --start, --stop.") from e

    def array(self) -> np.ndarray:
        """All rows: one array in memory, or a map of the file. The spool is empty afterwards."""
        parts, self._parts = self._parts, []
        if self._file is not None:
            with self._file as file:  # the map outlives it
                return np.memmap(file, self.dtype, "r+", shape=(self.rows,))
        return np.concatenate(parts) if parts else np.zeros(0, self.dtype)
