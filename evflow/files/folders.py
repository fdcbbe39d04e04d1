"""Folders that appear completely or not at all, like the files of `files.atomic_write`."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path

from evflow.errors import EvflowDataError
from evflow.files.atomic import (
    aside,
    clear_leftovers,
    disk_errors,
    need_no_file,
    need_no_folder,
    written_aside,
)
from evflow.files.locks import lock
from evflow.files.moves import move_new, swap_folders
from evflow.process.signals import uninterrupted


@contextlib.contextmanager
def atomic_folder(
    path: str | os.PathLike, *, names: Collection[str], overwrite: bool = False
) -> Iterator[Path]:
    """Yield a new folder beside `path`; rename it into place only if the block succeeds.

    names: the files that such a folder may hold. A folder that holds anything else is never
    replaced, even with overwrite, because somebody may need it.
    Raises EV013 and EV019 like `atomic_write`; no failure leaves anything behind.
    """
    path = Path(path).resolve()

    def move(temporary: Path, path: Path, overwrite: bool) -> None:
        if overwrite and path.is_dir():
            _refuse_foreign(path, names)  # again: the block may have taken hours
            swap_folders(temporary, path, aside(path, "old"))
        else:
            need_no_file(path)
            move_new(temporary, path)

    need_no_file(path)
    _refuse_foreign(path, names)
    with written_aside(path, move, overwrite=overwrite) as temporary:
        temporary.mkdir()
        yield temporary


def _refuse_foreign(path: Path, names: Collection[str]) -> None:
    old = sorted(p.name for p in path.iterdir()) if path.is_dir() else []
    if foreign := [name for name in old if name not in names]:
        raise EvflowDataError(
            "EV013", f"{path} is a folder that holds {foreign[:5]}.", "Choose another output.",
            where=path)


@contextlib.contextmanager
def staged(folder: str | os.PathLike, *, names: Sequence[str], overwrite: bool = False
           ) -> Iterator[Path]:
    """Yield an empty folder; move what the block leaves there into `folder` once it succeeds.

    names: all files that the block may write. Those already in `folder` are removed, so that no
    stale file lies beside the new ones; other files stay. Of several processes each moves its files
    while the others wait.
    Raises EV013 if one of them is a folder, or exists and `overwrite` is false, or if `folder` is a
    file; EV019 if the folder cannot be written.
    """
    folder = Path(folder)
    need_no_file(folder)
    for name in names:
        need_no_folder(folder / name)
    if not overwrite and (old := [name for name in names if (folder / name).exists()]):
        raise EvflowDataError("EV013", f"{folder} holds {', '.join(old)}.",
                              "Pass --overwrite (overwrite=True).", where=folder)
    stage = aside(folder / "stage", "tmp")
    new = not folder.exists()
    try:
        with disk_errors(folder):  # before any long work
            folder.mkdir(parents=True, exist_ok=True)
            clear_leftovers(folder / "stage")
            stage.mkdir()
        yield stage
        with _alone(folder), uninterrupted():
            _unstage(stage, folder, names, overwrite=overwrite)
    finally:
        with uninterrupted():
            shutil.rmtree(stage, ignore_errors=True)
            if new:
                with contextlib.suppress(OSError):  # unless something was written
                    folder.rmdir()


def need_writable(folder: Path) -> None:
    """Raise EV019 where no file can be written into a folder, and EV013 where it is a file."""
    with staged(folder, names=()):
        pass


@contextlib.contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Hold the lock of a folder, which other processes wait for: files of two of them would mix.
    Systems and file systems without such locks go on without."""
    try:
        opened = os.open(folder, os.O_RDONLY)
    except OSError:  # a folder cannot be opened on Windows
        yield
        return
    try:
        lock(opened, wait=True)
        yield
    finally:
        os.close(opened)


def _unstage(stage: Path, folder: Path, names: Sequence[str], *, overwrite: bool) -> None:
    if overwrite:
        for name in names:
            (folder / name).unlink(missing_ok=True)
    for path in sorted(stage.iterdir()):  # sorted: of two processes, one wins the first and goes on
        if overwrite:
            os.replace(path, folder / path.name)
        else:
            move_new(path, folder / path.name)
