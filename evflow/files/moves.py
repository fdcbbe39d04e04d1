"""Renaming that replaces nothing, and that swaps, each in one step of the file system."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import shutil
from pathlib import Path

from evflow.errors import EvflowDataError

NOREPLACE, EXCHANGE = 1, 2  # of linux/fs.h
AT_FDCWD = -100
UNKNOWN = (errno.ENOSYS, errno.EINVAL, errno.ENOTSUP, errno.EPERM)  # to the system or its disk


def move_new(source: Path, target: Path) -> None:
    """Rename a file or folder to a name that nothing has; EV013 where something has it by now, as
    of two processes that write one name at once only the first may."""
    try:
        if _renameat2(source, target, NOREPLACE):
            return
        (_move_folder if source.is_dir() else _move_file)(source, target)
    except FileExistsError as e:
        raise EvflowDataError(
            "EV013", f"{target} has appeared meanwhile.",
            "It was left as it is: another process writes there.", where=target) from e


def swap_folders(new: Path, old: Path, aside: Path) -> None:
    """`new` takes the place of the folder `old`, which is removed. aside: a name beside it, for
    disks that cannot exchange names."""
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
    """A file or folder, where it is there and can be removed."""
    with contextlib.suppress(OSError):  # where even the folder around it is missing
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink()


def _renameat2(source: Path, target: Path, flag: int) -> bool:
    """Linux's rename with a flag; False where it, or the file system, does not know it."""
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
        os.link(source, target)  # fails where the name is taken, as rename does not
    except OSError as e:
        if e.errno not in (*UNKNOWN, errno.EMLINK):
            raise
        if os.path.lexists(target):  # no links here (FAT): what is left is to look first
            raise FileExistsError(errno.EEXIST, "exists", str(target)) from e
        os.rename(source, target)
    else:
        source.unlink()


def _move_folder(source: Path, target: Path) -> None:
    target.mkdir()  # fails where the name is taken; an empty folder of our own is then replaced
    try:
        os.replace(source, target)
    except BaseException:
        target.rmdir()
        raise
