"""Memory that is free, and that the process still holds."""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Callable


def give_back() -> None:
    """Give the system back what the allocator keeps of freed arrays: after large ones of several
    sizes that is as much again. Does nothing where it cannot be asked to (other than glibc)."""
    trim = _trim()
    if trim is not None:
        trim(0)


@functools.cache
def _trim() -> Callable[[int], int] | None:
    try:
        return ctypes.CDLL(None).malloc_trim
    except (AttributeError, OSError, TypeError):  # macOS and musl; Windows has no library None
        return None
