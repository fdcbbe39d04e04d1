"""What a file to fuzz is: its path, how it is read, and how much of it is under checksums."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from evflow.io import read_recording

N, FRAMES = 300, 2  # events and frames of most


@dataclasses.dataclass(frozen=True)
class Sample:
    """path: what the reader gets; targets: the files of it that are damaged, most often the
    first. read(path): what the reader returns.

    sealed: every byte is under a checksum, so what is read is what was written or nothing.
    counted: the file says how much it holds, so that a cut is seen.
    text: of lines of words.
    """

    path: Path
    targets: tuple[Path, ...]
    read: Callable[..., Any]
    sealed: bool = False
    counted: bool = False
    text: bool = False


def sample(path: Path, *targets: Path, text: bool = False, sealed: bool = False,
           counted: bool = False, **hints: Any) -> Sample:
    """A recording."""
    return Sample(path, targets or (path,), partial(read_recording, **hints), sealed,
                  counted or sealed, text)
