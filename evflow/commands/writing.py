"""Options of commands that write, and what is refused before long work: existing outputs, and names
that do not match what is written."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Literal

from evflow.errors import EvflowDataError
from evflow.files.atomic import need_no_file, need_no_folder

Format = Literal["auto", "dsec", "e2vid", "event_utils", "evreal", "npz", "aedat4", "aedat2"]

FILES = frozenset((  # extensions that folders do not have
    ".npz", ".npy", ".json", ".html", ".htm", ".png", ".jpg", ".pdf", ".svg", ".txt", ".csv",
    ".md", ".zip", ".h5", ".hdf5", ".aedat4", ".aedat", ".mp4", ".gif", ".py", ".yaml",
    ".safetensors"))


def named(format: Format, out: Path) -> str | None:
    """The format as `evflow.io` expects it: None for the one that the extension stands for. EV020
    if the extension stands for another one."""
    from evflow.io.registry import writer_of

    refuse_stdout(out)
    if format == "auto":
        return None
    writer_of(out, format)
    return format


def refuse_stdout(out: Path) -> None:
    """Raise EV020 for `-`, which elsewhere means standard output."""
    if str(out) == "-":
        raise EvflowDataError("EV020", "the output is called -.",
                              "Nothing is written to standard output: name a file or folder.")


def need_suffix(out: Path, suffix: str) -> None:
    """Raise EV020 if the output's extension does not match the only format that is written."""
    if out.suffix.lower() != suffix:
        raise EvflowDataError("EV020", f"{out} does not end in {suffix}, which is what is written.",
                              f"Name it {out.with_suffix(suffix)}.")


def need_folder(out: Path) -> None:
    """Raise EV020 if a folder to be created has the name of a file, EV013 if it is one."""
    refuse_stdout(out)
    if out.suffix.lower() in FILES and not out.is_dir():
        raise EvflowDataError("EV020", f"{out} has the name of a file, but a folder is written.",
                              f"Name a folder: -o {out.with_suffix('')}/.")
    need_no_file(out)


def _part_of(path: Path, source: Path) -> bool:
    """Whether `path` is part of the source folder, unless it is a film beside what it shows, or a
    folder that the source is part of."""
    here, there = path.resolve(), source.resolve()
    inside = source.is_dir() and here.is_relative_to(there)
    return (path.samefile(source) or there.is_relative_to(here)
            or (inside and path.suffix.lower() not in (".mp4", ".gif")))


def need_absent(path: Path, overwrite: bool, *sources: Path | None) -> None:
    """Raise EV013 before long work if the output exists, or is a folder with the name of a file;
    EV020 if it is one of the sources, a file in a source folder, or a folder around a source: what
    is read may be the only copy."""
    if not path.exists():
        return
    if any(source is not None and source.exists() and _part_of(path, source)
           for source in sources):
        raise EvflowDataError("EV020", f"the output {path} is the input, lies in it, or holds it.",
                              "Choose another: no command replaces its input.")
    if path.suffix.lower() in FILES:
        need_no_folder(path)
    if not overwrite:
        raise EvflowDataError(
            "EV013", f"{path} exists.", "Pass --overwrite if this command made that folder; "
            "choose another if not." if path.is_dir() else "Pass --overwrite.")


def need_apart(files: Iterable[Path], *sources: Path | None) -> None:
    """Raise EV020 if one of the files that a command writes into a folder is one of its sources:
    with --overwrite it would be replaced, and may be the only copy."""
    for path in files:
        if path.exists() and any(source is not None and source.exists() and path.samefile(source)
                                 for source in sources):
            raise EvflowDataError("EV020", f"{path}, an output, is also an input.",
                                  "Choose another folder: no command replaces its input.")
