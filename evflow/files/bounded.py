"""Files for libraries that trust whatever size a damaged file claims."""

from __future__ import annotations

import io
import os
from pathlib import Path
from typing import Any

LITTLE = 1 << 16  # bytes that are read without asking for the file's size, which takes longer


class BoundedPath(type(Path())):  # type: ignore[misc]
    """A path whose binary file never allocates more memory than it has bytes left."""

    def open(self, mode: str = "r", *rest: Any, **named: Any) -> Any:
        if mode == "rb":
            return _BoundedFile(io.FileIO(self, "r"))
        return super().open(mode, *rest, **named)


class _BoundedFile(io.BufferedReader):
    def read(self, size: int | None = -1, /) -> bytes:
        if size is not None and 0 <= size <= LITTLE:
            return super().read(size)
        left = max(os.fstat(self.fileno()).st_size - self.tell(), 0)
        return super().read(left if size is None or size < 0 else min(size, left))
