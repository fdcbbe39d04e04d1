"""Writing files so that none is ever left half-written or overwritten without permission."""

from __future__ import annotations

import contextlib
import errno
import os
import re
import secrets
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

from evflow.errors import EvflowDataError
from evflow.files.moves import move_new, remove
from evflow.files.whole import write_checked
from evflow.process.alive import is_dead, mark
from evflow.process.signals import uninterrupted

NAME_BYTES = 180  # of the target's name in its temporary file's name; file systems allow 255
LEFTOVER = re.compile(r"([0-9a-f]+-[0-9a-f]+)\.[0-9a-f]{8}\.(tmp|part)(\.\w+)?")
REASONS = {
    errno.ENOSPC: "no space left", errno.EDQUOT: "the quota is used up",
    errno.EFBIG: "larger than the file system takes", errno.EIO: "the disk failed",
    errno.EPERM: "not permitted", errno.EACCES: "permission denied",
    errno.EROFS: "read-only file system", errno.ENOENT: "no such folder",
    errno.ENOTDIR: "its folder is a file", errno.EEXIST: "its folder is a file",
    errno.EISDIR: "it is a folder", errno.ENAMETOOLONG: "the name is too long"}


def aside(path: Path, ending: str) -> Path:
    """A hidden name beside `path` that no other process uses, on any machine. If it ends in tmp or
    part and this process is killed, the next write of `path` removes it."""
    return path.with_name(f"{_begin(path)}{mark()}.{secrets.token_hex(4)}.{ending}")


def clear_leftovers(path: Path) -> None:
    """Remove what killed processes left beside `path` for it, but nothing of a live process."""
    begin = _begin(path)
    with contextlib.suppress(OSError):
        for name in os.listdir(path.parent):
            found = LEFTOVER.fullmatch(name[len(begin):]) if name.startswith(begin) else None
            if found and is_dead(found[1]):
                remove(path.with_name(name))


@contextlib.contextmanager
def atomic_write(path: str | os.PathLike, *, overwrite: bool = False) -> Iterator[Path]:
    """Yield a temporary path beside `path`; rename it into place only if the block succeeds.

    Raises EV013 if `path` exists before or after the block and `overwrite` is false, or if it is
    a folder or not a regular file; EV019 if the disk is full or the path cannot be written. The
    temporary file is removed on any failure including Ctrl-C; that of a killed process by the next
    write of `path`.
    """
    need_no_folder(path)
    with written_aside(path, put_in_place, overwrite=overwrite) as temporary:
        yield temporary


def need_no_folder(path: str | os.PathLike) -> None:
    """Raise EV013 where a file is to be written but a folder lies: it is not replaced by a file."""
    if os.path.isdir(path):
        raise EvflowDataError("EV013", f"{path} is a folder, and a file of that name would be "
                              "written.", "Choose another output.", where=path)


def need_no_file(path: str | os.PathLike) -> None:
    """Raise EV013 where a folder is to be written but a file lies: it is not replaced by a
    folder."""
    if os.path.exists(path) and not os.path.isdir(path):
        raise EvflowDataError("EV013", f"{path} is a file, and a folder of that name would be "
                              "written.", "Choose another output.", where=path)


@contextlib.contextmanager
def disk_errors(path: str | os.PathLike) -> Iterator[None]:
    """Raise EV019 where the disk is full or `path` cannot be written."""
    try:
        yield
    except OSError as e:
        if e.errno in REASONS:
            raise EvflowDataError(
                "EV019", f"{path} was not written ({REASONS[e.errno]}).",
                "Nothing is left behind; free space or choose another output.", where=path) from e
        raise


def atomic_text(path: str | os.PathLike, data: str | bytes, *, overwrite: bool = False) -> None:
    """Write text or bytes and read them back before the rename; as `atomic_write`."""
    with atomic_write(path, overwrite=overwrite) as temporary:
        write_checked(temporary, data)


@contextlib.contextmanager
def written_aside(
    path: str | os.PathLike, move: Callable[[Path, Path, bool], None], *, overwrite: bool
) -> Iterator[Path]:
    """`atomic_write` of a file or folder; move(temporary, path, overwrite) puts it in place. What
    a link leads to is written, and the link stays."""
    path = behind_links(Path(path))
    if os.path.exists(path) and not overwrite:  # False, not an error, for an impossible path
        raise EvflowDataError("EV013", f"{path} exists.", "Pass --overwrite (overwrite=True).",
                              where=path)
    if os.path.exists(path) and not (os.path.isfile(path) or os.path.isdir(path)):
        raise EvflowDataError(
            "EV013", f"{path} is a device or a pipe.", "It is never replaced: choose a file.",
            where=path)
    temporary = aside(path, "tmp")
    try:
        with disk_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            with contextlib.suppress(FileNotFoundError):
                os.lstat(path)  # fails early for a name that is too long
            clear_leftovers(path)
            yield temporary
            with uninterrupted():
                move(temporary, path, overwrite)
    finally:
        with uninterrupted():
            remove(temporary)


def behind_links(path: Path) -> Path:
    """Where a symbolic link leads, which need not exist; other paths unchanged. EV013 for a link
    that leads to itself."""
    if not os.path.islink(path):
        return path
    target = Path(os.path.realpath(path))
    if target.is_symlink():
        raise EvflowDataError("EV013", f"{path} is a link that leads to itself.",
                              "Choose another output.", where=path)
    return target


def put_in_place(temporary: Path, path: Path, overwrite: bool) -> None:
    """Rename what was written; without `overwrite`, EV013 if `path` exists by now."""
    if overwrite:
        os.replace(temporary, path)
    else:
        move_new(temporary, path)


def _begin(path: Path) -> str:
    """Prefix of the names of all temporary files of `path`; a long name is cut and made unique by
    its checksum."""
    name = os.fsencode(path.name)
    if len(name) > NAME_BYTES:
        cut = name[:NAME_BYTES].decode(errors="ignore")
        return f".{cut}~{zlib.crc32(name):08x}."
    return f".{path.name}."
