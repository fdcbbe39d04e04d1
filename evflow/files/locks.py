"""Locks on open files and folders, which the system releases when their process ends."""

from __future__ import annotations


def lock(descriptor: int, *, wait: bool) -> bool:
    """Lock an open file or folder against other processes, until it is closed.

    Returns:
        False if another process holds the lock, and `wait` is false. True also where the system,
        or the file system, knows no locks.
    """
    try:
        import fcntl  # not on Windows

        fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        return False
    except (ImportError, OSError):
        return True
    return True
