"""Freed memory: what the process keeps of it, and what it returns to the system."""

from __future__ import annotations

import ctypes
import functools
import os
from pathlib import Path
from typing import Any

TRIM_ABOVE, MAP_ABOVE = -1, -3  # glibc's M_TRIM_THRESHOLD and M_MMAP_THRESHOLD
KEPT, LARGEST = 1 << 29, 1 << 25  # bytes; glibc allows no larger threshold
SMALL = 1 << 30  # bytes of a process; modules and programs take a third of that


def give_back() -> None:
    """Return freed memory that the allocator keeps to the system: after large arrays of several
    sizes it can equal what is in use. Does nothing while the process is small, because the next
    arrays would have to get the memory back, or without glibc."""
    trim = _of_c("malloc_trim")
    if trim is not None and held() >= SMALL:
        trim(0)


def held() -> float:
    """Bytes of memory that the process holds; inf if the system does not say."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError):
        return float("inf")


def keep() -> None:
    """Let the allocator keep up to KEPT bytes of freed arrays until the process ends: otherwise
    work that makes arrays of the same sizes again and again waits for the system to clear them.
    Does nothing without glibc."""
    mallopt = _of_c("mallopt")
    if mallopt is not None:
        mallopt(MAP_ABOVE, LARGEST)
        mallopt(TRIM_ABOVE, KEPT)


@functools.cache
def _of_c(name: str) -> Any:
    """A function of the C library; None if it has none of that name."""
    try:
        return getattr(ctypes.CDLL(None), name)
    except (AttributeError, OSError, TypeError):  # macOS, musl; on Windows there is no library None
        return None
