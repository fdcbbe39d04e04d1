"""Whether the process that made something is still running, judged by a mark that it left."""

from __future__ import annotations

import functools
import hashlib
import os
import re
from pathlib import Path

MARK = re.compile(r"([0-9a-f]{8})-([0-9a-f]+)")


def mark() -> str:
    """The mark of this process: its machine's boot and process-id namespace, and its process id."""
    return f"{_here() or '0' * 8}-{os.getpid():x}"


def is_dead(text: str) -> bool:
    """Whether the process of this mark has certainly ended. False if in doubt: for another machine
    or container, whose processes are invisible, after a reboot, if the system does not say, or if
    another process has the id by now."""
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
    """Hash of boot id and process-id namespace, which distinguish hosts that share a disk and
    containers on one host; "" without Linux's /proc."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text()
        return hashlib.sha256((boot + os.readlink("/proc/self/ns/pid")).encode()).hexdigest()[:8]
    except OSError:
        return ""
