"""Whether the process that made something still runs, told by a mark that it left."""

from __future__ import annotations

import functools
import hashlib
import os
import re
from pathlib import Path

MARK = re.compile(r"([0-9a-f]{8})-([0-9a-f]+)")


def mark() -> str:
    """Of this process: the machine since it started and its space of process ids, and its id."""
    return f"{_here() or '0' * 8}-{os.getpid():x}"


def is_dead(text: str) -> bool:
    """Has the process of this mark surely ended? False in any doubt: of another machine or
    container, whose processes cannot be seen, of one that started anew, where the system does not
    tell, or where another process has the id by now."""
    found = MARK.fullmatch(text)
    if not found or not _here() or found[1] != _here():
        return False
    try:
        os.kill(int(found[2], 16), 0)  # sends nothing
    except ProcessLookupError:
        return True
    except (OSError, OverflowError):
        return False
    return False


@functools.cache
def _here() -> str:
    """"" where Linux's /proc is absent. The id of the boot tells hosts of a shared disk apart, the
    space of process ids the containers of a host."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text()
        return hashlib.sha256((boot + os.readlink("/proc/self/ns/pid")).encode()).hexdigest()[:8]
    except OSError:
        return ""
