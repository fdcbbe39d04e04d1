"""Files that end: to open a pipe waits for its writer, a device may give bytes without end."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import TypeVar

from evflow.errors import EvflowDataError

AnyPath = TypeVar("AnyPath", bound=Path | zipfile.Path)


def need_regular(path: AnyPath) -> AnyPath:
    """The path, where there is a file, a folder or nothing; EV016 for pipes, devices, sockets."""
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise EvflowDataError("EV016", f"{path} is a pipe, a device or a socket.",
                              "Only files are read: save it to one first.", where=path)
    return path


def is_there(path: AnyPath) -> bool:
    """Whether there is such a file; EV016 as `need_regular`, as what is no file is not absent."""
    return need_regular(path).is_file()
