"""Regular files only: opening a pipe waits for its writer, a device may never end."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import TypeVar

from evflow.errors import EvflowDataError

AnyPath = TypeVar("AnyPath", bound=Path | zipfile.Path)


def need_regular(path: AnyPath) -> AnyPath:
    """The path, if it is a file, a folder or absent; EV016 for pipes, devices, sockets."""
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise EvflowDataError("EV016", f"{path} is a pipe, a device or a socket.",
                              "Save it to a regular file first.", where=path)
    return path


def need_opened(path: Path) -> None:
    """Raise EV016 where a file cannot be opened, as where it may not be read."""
    try:
        with open(path, "rb"):
            pass
    except OSError as e:
        raise EvflowDataError("EV016", f"{path} cannot be opened ({e.strerror or e}).",
                              "Check its name and its permissions.", where=path) from e


def is_there(path: AnyPath) -> bool:
    """Whether the file exists; EV016 as in `need_regular`, so that a pipe is not called absent."""
    return need_regular(path).is_file()
