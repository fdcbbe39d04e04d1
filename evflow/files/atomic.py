"""Writing files so that nothing is ever half-written or overwritten unasked."""

from __future__ import annotations

import contextlib
import errno
import os
import secrets
from collections.abc import Iterator
from pathlib import Path

from evflow.errors import EvflowDataError


def aside(path: Path, ending: str) -> Path:
    """A hidden name beside `path` that no other process has, on whatever machine it runs."""
    return path.with_name(f".{path.name}.{secrets.token_hex(4)}.{ending}")


@contextlib.contextmanager
def atomic_write(path: str | os.PathLike, *, overwrite: bool = False) -> Iterator[Path]:
    """Yield a temporary path beside `path`; rename it into place only if the block succeeds.

    Raises EV013 where `path` exists and `overwrite` is false, or is no file, EV019 where the disk
    is full or the path cannot be written. The temporary file is removed on any failure, Ctrl-C
    included.
    """
    path = Path(path)
    if os.path.exists(path) and not overwrite:  # false, not an error, for an impossible path
        raise EvflowDataError("EV013", f"{path} exists.", "Pass --overwrite (overwrite=True).")
    if os.path.exists(path) and not (os.path.isfile(path) or os.path.isdir(path)):
        raise EvflowDataError(
            "EV013", f"{path} is a device or a pipe.", "It is never replaced: choose a file.")
    temporary = aside(path, "tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        os.replace(temporary, path)
    except OSError as e:
        reasons = {errno.ENOSPC: "no space left", errno.EDQUOT: "the quota is used up",
                   errno.EFBIG: "larger than the file system takes", errno.EIO: "the disk failed",
                   errno.EPERM: "not permitted", errno.EACCES: "permission denied",
                   errno.EROFS: "read-only file system", errno.ENOENT: "no such folder",
                   errno.ENOTDIR: "its folder is a file", errno.EEXIST: "its folder is a file",
                   errno.EISDIR: "it is a folder", errno.ENAMETOOLONG: "the name is too long"}
        if e.errno in reasons:
            raise EvflowDataError(
                "EV019", f"{path} was not written ({reasons[e.errno]}).",
                "Nothing is left behind; free space or choose another output.") from e
        raise
    finally:
        with contextlib.suppress(OSError):  # where even the folder is missing
            temporary.unlink()
