"""Memory that is free: what the process still holds, and what it gives back."""

from __future__ import annotations

import ctypes
import functools
import os
from pathlib import Path
from typing import Any

TRIM_ABOVE, MAP_ABOVE = -1, -3  # glibc's M_TRIM_THRESHOLD and M_MMAP_THRESHOLD
KEPT, LARGEST = 1 << 29, 1 << 25  # bytes; glibc keeps none larger
SMALL = 1 << 30  # bytes of a process, a third of them its modules and programs


def give_back() -> None:
    """Give the system back what the allocator keeps of freed arrays: after large ones of several
    sizes that is as much again. Does nothing while the process is small, as the next arrays would
    wait for the same memory, nor where it cannot be asked to (other than glibc)."""
    trim = _of_c("malloc_trim")
    if trim is not None and held() >= SMALL:
        trim(0)


def held() -> float:
    """Bytes of memory that the process holds; inf where the system does not tell."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError):
        return float("inf")


def keep() -> None:
    """Let the allocator keep freed arrays for the next ones, up to KEPT bytes: work that makes
    arrays of the same sizes again and again would else wait for the system to clear them. Until the
    process ends; does nothing where it cannot be asked to (other than glibc)."""
    tell = _of_c("mallopt")
    if tell is not None:
        tell(MAP_ABOVE, LARGEST)
        tell(TRIM_ABOVE, KEPT)


@functools.cache
def _of_c(name: str) -> Any:
    """A function of the C library, None where it has none of that name."""
    try:
        return getattr(ctypes.CDLL(None), name)
    except (AttributeError, OSError, TypeError):  # macOS and musl; Windows has no library None
        return None
