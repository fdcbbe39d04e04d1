"""atomic_write: all or nothing, and never over something else."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from evflow.errors import EvflowDataError
from evflow.files.atomic import atomic_write
from evflow.files.folders import staged


def write(path: Path, text: str, *, overwrite: bool = False) -> None:
    with atomic_write(path, overwrite=overwrite) as temporary:
        temporary.write_text(text)


def refusal(path: Path, *, overwrite: bool = False) -> EvflowDataError:
    with pytest.raises(EvflowDataError) as raised:
        write(path, "new", overwrite=overwrite)
    return raised.value


def test_writes_into_a_new_folder_and_leaves_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "a" / "b" / "out.txt"
    write(path, "text")
    assert path.read_text() == "text"
    assert os.listdir(path.parent) == ["out.txt"]


def test_nothing_appears_before_the_block_ends(tmp_path: Path) -> None:
    path = tmp_path / "out.txt"
    with atomic_write(path) as temporary:
        temporary.write_text("text")
        assert temporary.parent == tmp_path  # same file system, so that the rename is atomic
        assert not path.exists()
    assert path.exists()


def test_overwrites_only_when_asked(tmp_path: Path) -> None:
    path = tmp_path / "out.txt"
    write(path, "old")
    error = refusal(path)
    assert error.code == "EV013"
    assert str(path) in str(error)
    assert path.read_text() == "old"
    write(path, "newer", overwrite=True)
    assert path.read_text() == "newer"
    assert os.listdir(tmp_path) == ["out.txt"]


@pytest.mark.parametrize("problem", [ValueError, KeyboardInterrupt, MemoryError, FileNotFoundError])
@pytest.mark.parametrize("before", [None, "old"])
def test_failure_leaves_things_as_they_were(
    tmp_path: Path, problem: type[BaseException], before: str | None
) -> None:
    path = tmp_path / "out.txt"
    if before:
        path.write_text(before)

    def fail() -> None:
        with atomic_write(path, overwrite=True) as temporary:
            temporary.write_text("half")
            raise problem("stop")

    with pytest.raises(problem, match="stop"):
        fail()
    assert os.listdir(tmp_path) == (["out.txt"] if before else [])
    assert (path.read_text() if before else None) == before


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EACCES, errno.EROFS,
                                    errno.EDQUOT, errno.EIO, errno.EFBIG])
def test_full_disk_is_ev019_and_leaves_nothing(tmp_path: Path, number: int) -> None:
    path = tmp_path / "out.txt"

    def fail() -> None:
        with atomic_write(path) as temporary:
            temporary.write_text("half")
            raise OSError(number, os.strerror(number))

    with pytest.raises(EvflowDataError, match=r"EV019.*out\.txt was not written") as raised:
        fail()
    assert isinstance(raised.value.__cause__, OSError)
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("parts", [("file", "out.txt"), ("file", "sub", "out.txt"),
                                   ("x" * 300,), ("sub", "x" * 300)])
def test_impossible_paths_are_ev019(tmp_path: Path, parts: tuple[str, ...]) -> None:
    (tmp_path / "file").write_text("in the way")
    error = refusal(tmp_path.joinpath(*parts))
    assert error.code == "EV019"
    assert (tmp_path / "file").read_text() == "in the way"


def test_what_a_killed_run_left_is_in_nobodys_way(tmp_path: Path) -> None:
    """Process ids repeat in containers and on the hosts of a shared disk."""
    path = tmp_path / "out.txt"
    with atomic_write(path) as first, atomic_write(path) as second:
        assert first != second
        first.touch()
        second.touch()


def test_a_folder_is_never_replaced(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    assert refusal(tmp_path / "out").code == "EV013"
    assert refusal(tmp_path / "out", overwrite=True).code == "EV019"
    assert (tmp_path / "out").is_dir()
    assert os.listdir(tmp_path) == ["out"]


def test_devices_are_never_replaced() -> None:
    with pytest.raises(EvflowDataError, match="EV013"), atomic_write("/dev/null", overwrite=True):
        pytest.fail("a device was opened for writing")


def test_a_staged_folder_is_new_as_a_whole(tmp_path: Path) -> None:
    folder, names = tmp_path / "out", ("a.txt", "b.txt")
    def interrupted() -> None:
        with staged(folder, names=names) as stage:
            (stage / "a.txt").write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert not folder.exists()
    with staged(folder, names=names) as stage:
        (stage / "a.txt").write_text("one")
        (stage / "b.txt").write_text("one")
    (folder / "mine.txt").write_text("dear to me")
    with pytest.raises(EvflowDataError, match="EV013"), staged(folder, names=names):
        pytest.fail("files were there")
    with staged(folder, names=names, overwrite=True) as stage:
        (stage / "a.txt").write_text("two")
    assert sorted(p.name for p in folder.iterdir()) == ["a.txt", "mine.txt"]  # b.txt was stale
    assert (folder / "a.txt").read_text() == "two"
