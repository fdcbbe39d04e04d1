"""Options of commands that write, and what is refused before long work: outputs that exist, and
names that say something else than what is written."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from evflow.errors import EvflowDataError

Format = Literal["auto", "dsec", "e2vid", "event_utils", "evreal", "npz", "aedat4", "aedat2"]

FILES = frozenset((  # endings that nobody gives a folder
    ".npz", ".npy", ".json", ".html", ".htm", ".png", ".jpg", ".pdf", ".svg", ".txt", ".csv",
    ".md", ".zip", ".h5", ".hdf5", ".aedat4", ".aedat", ".mp4", ".gif", ".py", ".yaml"))


def named(format: Format, out: Path) -> str | None:
    """The format as `evflow.io` takes it: None for what the extension stands for. EV020 where the
    extension stands for another one."""
    from evflow.io.registry import writer_of

    refuse_stdout(out)
    if format == "auto":
        return None
    writer_of(out, format)
    return format


def refuse_stdout(out: Path) -> None:
    """EV020 for `-`, by which others mean the standard output."""
    if str(out) == "-":
        raise EvflowDataError("EV020", "the output is called -.",
                              "Nothing is written to standard output: name a file or folder.")


def need_suffix(out: Path, suffix: str) -> None:
    """EV020 where a file that is always of one kind is to be named as another."""
    if out.suffix.lower() != suffix:
        raise EvflowDataError("EV020", f"{out} does not end in {suffix}, which is what is written.",
                              f"Name it {out.with_suffix(suffix)}.")


def need_folder(out: Path) -> None:
    """EV020 where the name of a folder to be made is that of a file."""
    refuse_stdout(out)
    if out.suffix.lower() in FILES and not out.is_dir():
        raise EvflowDataError("EV020", f"{out} has the name of a file, but a folder is written.",
                              f"Name a folder: -o {out.with_suffix('')}/.")


def _part_of(path: Path, source: Path) -> bool:
    """Films lie beside what they show, and are none of it."""
    inside = source.is_dir() and path.resolve().is_relative_to(source.resolve())
    return path.samefile(source) or (inside and path.suffix.lower() not in (".mp4", ".gif"))


def need_absent(path: Path, overwrite: bool, *sources: Path | None) -> None:
    """EV013 before long work, where its output exists already; EV020 where it is one of the
    sources, or a file in a folder that is one: what is read may be the only one there is."""
    if not path.exists():
        return
    if any(source is not None and source.exists() and _part_of(path, source)
           for source in sources):
        raise EvflowDataError("EV020", f"the output {path} is what is read, or lies in it.",
                              "Name another one: no command replaces what it reads.")
    if not overwrite:
        raise EvflowDataError("EV013", f"{path} exists.", "Pass --overwrite.")
