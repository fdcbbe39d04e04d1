"""Reading and writing recordings: the registry of formats.

A format is a module with a NAME, its EXTENSIONS, `sniff` and `read`, and `write` where it can;
adding one is a new file and one entry in `FORMATS`. A file is recognised by its content, and by
its extension only where several formats claim it. Whatever is wrong with a file comes out as an
`EvflowDataError`.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, Protocol

from evflow.errors import EvflowDataError
from evflow.io import (
    aedat2,
    aedat4,
    dat,
    dsec,
    e2vid,
    event_utils,
    evimo2,
    evreal,
    evt2,
    evt3,
    ijrr,
    mvsec,
    npz,
    rosbag,
    v2e,
    v2e_text,
)
from evflow.io.hints import Hints
from evflow.types import Events, Recording

HEAD = 4096  # bytes of a file that `sniff` sees


class Format(Protocol):
    """What a format module offers."""

    NAME: str
    EXTENSIONS: tuple[str, ...]

    def sniff(self, path: Path, head: bytes) -> bool:
        """Does this look like mine? `head` is the file's beginning, b"" for a folder."""

    def read(self, path: Path, hints: Hints) -> Recording:
        """The recording, every hint obeyed; a file without frames gives an empty stack."""


class Writer(Protocol):
    """What a format module offers that can also write."""

    def write(
        self, path: str | os.PathLike, recording: Recording, *, overwrite: bool = False
    ) -> None: ...


FORMATS: tuple[Format, ...] = (  # of two that claim a file and its extension, the first
    aedat4, aedat2, evt2, evt3, dat, v2e, mvsec, event_utils, dsec, npz, evimo2, evreal, e2vid,
    v2e_text, ijrr, rosbag)
WRITERS: dict[str, Writer] = {"dsec": dsec, "npz": npz}


def find_format(path: str | os.PathLike) -> Format:
    """The format of a file or folder; EV008 (unknown), EV009 (empty file), EV016 (not there)."""
    path = Path(path)
    try:
        head = b"" if path.is_dir() else _head(path)
    except OSError as e:
        raise EvflowDataError("EV016", f"{path} cannot be opened ({e.strerror}).") from e
    claims = [f for f in FORMATS if f.sniff(path, head)]
    claims.sort(key=lambda f: path.suffix.lower() not in f.EXTENSIONS)
    if claims:
        return claims[0]
    if not path.is_dir() and not head:
        raise EvflowDataError("EV009", f"{path} is empty (0 bytes).", "Copy it again.")
    seen = (f"the folder holds {sorted(p.name for p in path.iterdir())[:5]}" if path.is_dir()
            else f"it begins with {head[:16]!r}")
    raise EvflowDataError(
        "EV008", f"{path} is none of {', '.join(f.NAME for f in FORMATS)}: {seen}.",
        "Convert it, or check that it was copied completely.")


def read_recording(path: str | os.PathLike, **hints: Any) -> Recording:
    """Read events and frames of any known format; without frames the stack is (0, H, W).

    hints: start_s, stop_s, time_unit, polarity, size (see `Hints`).
    Raises EV008 (unknown format), EV009 (damaged), EV010 (a package is missing), EV016 (not
    there), EV020 (unknown hint), and what `Events` and `Recording` raise.
    """
    told = Hints.parse(hints)
    path = Path(path)
    found = find_format(path)
    try:
        return found.read(path, told)
    except MemoryError as e:
        raise EvflowDataError(
            "EV009", f"{path} asks for more memory than there is.",
            "If it is sound, read a part: start_s, stop_s (--start, --stop).") from e
    except OSError as e:
        raise EvflowDataError("EV009", f"{path} cannot be read ({e}).", "Copy it again.") from e


def read_events(path: str | os.PathLike, **hints: Any) -> Events:
    """The events alone; hints and errors as in `read_recording`."""
    return read_recording(path, **hints).events


def write_events(
    path: str | os.PathLike,
    events: Events | Recording,
    format: str = "dsec",
    *,
    overwrite: bool = False,
) -> None:
    """Write events, and the frames of a `Recording`, as "dsec" or "npz"; all or nothing.

    Raises EV010 (a package is missing), EV013 (exists), EV019 (cannot be written), EV020
    (unknown format).
    """
    if format not in WRITERS:
        raise EvflowDataError("EV020", f"format={format!r}.", f"Choose from {sorted(WRITERS)}.")
    recording = events if isinstance(events, Recording) else Recording.of_events(events)
    WRITERS[format].write(path, recording, overwrite=overwrite)


def _head(path: Path) -> bytes:
    with open(path, "rb") as f:
        return f.read(HEAD)
