"""Renaming that never replaces a file, and swapping folders, each in one file-system operation."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import shutil
from pathlib import Path

from evflow.errors import EvflowDataError
from evflow.process.signals import uninterrupted

NOREPLACE, EXCHANGE = 1, 2  # from linux/fs.h
AT_FDCWD = -100
UNKNOWN = (errno.ENOSYS, errno.EINVAL, errno.ENOTSUP, errno.EPERM)  # not supported here


def move_new(source: Path, target: Path) -> None:
    """Rename a file or folder to an unused name; EV013 if the name is taken by then: of two
    processes that write one name at once, only the first succeeds."""
    try:
        if _renameat2(source, target, NOREPLACE):
            return
        (_move_folder if source.is_dir() else _move_file)(source, target)
    except FileExistsError as e:
        raise EvflowDataError(
            "EV013", f"{target} was created meanwhile.",
            "It was left untouched: another process writes there.", where=target) from e


def swap_folders(new: Path, old: Path, aside: Path) -> None:
    """Replace the folder `old`, which is removed, by `new`. aside: a free name beside it, for file
    systems that cannot exchange names."""
    if _renameat2(new, old, EXCHANGE):
        shutil.rmtree(new, ignore_errors=True)
        return
    os.replace(old, aside)
    try:
        os.replace(new, old)
    except BaseException:
        os.replace(aside, old)
        raise
    shutil.rmtree(aside, ignore_errors=True)


def remove(path: Path) -> None:
    """Remove a file or folder if it exists and can be removed; signals wait until it is done."""
    with uninterrupted(), contextlib.suppress(OSError):  # even the folder around it may be missing
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink()


def _renameat2(source: Path, target: Path, flag: int) -> bool:
    """Linux's rename with a flag; False if the kernel or file system does not support it."""
    call = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None) if (
        os.name == "posix") else None
    if call is None:
        return False
    if call(AT_FDCWD, os.fsencode(source), AT_FDCWD, os.fsencode(target), flag) == 0:
        return True
    if (number := ctypes.get_errno()) in UNKNOWN:
        return False
    raise OSError(number, os.strerror(number), str(target))


def _move_file(source: Path, target: Path) -> None:
    try:
        os.link(source, target)  # unlike rename, fails if the name is taken
    except OSError as e:
        if e.errno not in (*UNKNOWN, errno.EMLINK):
            raise
        if os.path.lexists(target):  # no hard links here (FAT): checking first must do
            raise FileExistsError(errno.EEXIST, "exists", str(target)) from e
        os.rename(source, target)
    else:
        source.unlink()


def _move_folder(source: Path, target: Path) -> None:
    target.mkdir()  # fails if the name is taken; rename then replaces our own empty folder
    try:
        os.replace(source, target)
    except BaseException:
        target.rmdir()
        raise
