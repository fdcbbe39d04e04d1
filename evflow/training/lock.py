"""The lock on the folder of a run: of two processes that train there, the second is refused.

Otherwise each would clear away the other's half-written checkpoints, and count the other's for its
own. The system releases the lock when its process ends, however it ends: after a crash nothing has
to be removed, whichever machine the run goes on on.
"""

from __future__ import annotations

import contextlib
import os
import platform
from collections.abc import Iterator
from pathlib import Path

from evflow.errors import EvflowDataError
from evflow.files.locks import lock
from evflow.process.devices import agree, is_main

NAME = ".lock"


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold the lock of `folder`, for all processes of this run, while the block runs.

    Raises EV013 where another run holds it, EV019 where the lock's file cannot be opened. File
    systems without locks hold none.
    """
    with contextlib.ExitStack() as opened:
        holder = _taken(opened, folder) if is_main() else ""
        if agree(bool(holder)):
            raise EvflowDataError(
                "EV013", f"{holder or 'another process'} is training in {folder}.",
                "Wait until it has ended, or choose another --out.", where=folder)
        yield


def _taken(opened: contextlib.ExitStack, folder: Path) -> str:
    """Take the lock until `opened` closes, and return ""; else the name of who holds it."""
    try:
        file = opened.enter_context((folder / NAME).open("a+"))  # not emptied: it names the holder
    except OSError as e:
        raise EvflowDataError("EV019", f"{folder / NAME} cannot be opened ({e.strerror}).",
                              "Choose another --out.") from e
    if not lock(file.fileno(), wait=False):
        file.seek(0)
        return file.read(200).strip() or "another process"
    with contextlib.suppress(OSError):  # a full disk: its name is all that is missing
        file.truncate(0)
        file.write(f"process {os.getpid()} on {platform.node()}\n")
        file.flush()
    return ""
