"""atomic_write: all or nothing, and never over something else."""

from __future__ import annotations

import errno
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from evflow.errors import EvflowDataError
from evflow.files import moves
from evflow.files.atomic import atomic_write
from evflow.files.folders import atomic_folder, staged
from evflow.process.alive import mark


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


def test_through_a_link_its_target_is_written_and_the_link_stays(tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    target, link = tmp_path / "disk/kept.txt", tmp_path / "out.txt"
    link.symlink_to(target)
    write(link, "one")  # the target is not there yet
    assert refusal(link).code == "EV013"
    write(link, "two", overwrite=True)
    assert link.is_symlink()
    assert target.read_text() == "two"
    assert os.listdir(target.parent) == ["kept.txt"]
    assert sorted(os.listdir(tmp_path)) == ["disk", "out.txt"]
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    assert "leads to itself" in str(refusal(loop, overwrite=True))


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_folder_is_never_replaced_by_a_file(tmp_path: Path, overwrite: bool) -> None:
    (tmp_path / "out.txt").mkdir()
    error = refusal(tmp_path / "out.txt", overwrite=overwrite)
    assert error.code == "EV013"
    assert "is a folder" in str(error)
    assert "--overwrite" not in str(error)
    with pytest.raises(EvflowDataError, match=r"EV013.*is a folder"), staged(
            tmp_path, names=["out.txt"], overwrite=overwrite):
        pytest.fail("work began")
    assert os.listdir(tmp_path) == ["out.txt"]


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


linked = pytest.mark.parametrize("way", ["renameat2", "link", "neither"])


def restrict(monkeypatch: pytest.MonkeyPatch, way: str) -> None:
    """A file system that knows no flags of rename, and no links either."""
    def unknown(*_: object) -> None:
        raise OSError(errno.EPERM, "no links here")

    if way != "renameat2":
        monkeypatch.setattr(moves, "_renameat2", lambda *_: False)
    if way == "neither":
        monkeypatch.setattr(os, "link", unknown)


@linked
def test_of_two_writers_of_one_name_the_first_stays(
    tmp_path: Path, way: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    restrict(monkeypatch, way)
    path = tmp_path / "out.txt"

    def both() -> None:
        with atomic_write(path) as second:
            second.write_text("second")
            with atomic_write(path) as first:
                assert first != second
                first.write_text("first")

    with pytest.raises(EvflowDataError, match=r"EV013.*out\.txt was created"):
        both()
    assert path.read_text() == "first"
    assert os.listdir(tmp_path) == ["out.txt"]


@linked
@pytest.mark.parametrize("before", [["a.txt"], []])
def test_of_two_writers_of_one_folder_the_first_stays(
    tmp_path: Path, way: str, before: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    restrict(monkeypatch, way)
    path = tmp_path / "out"

    def both() -> None:
        with atomic_folder(path, names=["a.txt"]) as second:
            (second / "a.txt").write_text("second")
            with atomic_folder(path, names=["a.txt"]) as first:
                for name in before:
                    (first / name).write_text("first")

    with pytest.raises(EvflowDataError, match=r"EV013.*out was created"):
        both()
    assert os.listdir(path) == before
    assert os.listdir(tmp_path) == ["out"]


@linked
def test_an_old_folder_is_replaced_whole(
    tmp_path: Path, way: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    restrict(monkeypatch, way)
    path = tmp_path / "out"
    for text in ("old", "new"):
        with atomic_folder(path, names=["a.txt"], overwrite=True) as folder:
            (folder / "a.txt").write_text(text)
    assert (path / "a.txt").read_text() == "new"
    assert os.listdir(tmp_path) == ["out"]
    with pytest.raises(EvflowDataError, match=r"EV013.*thesis"), \
            atomic_folder(path, names=["a.txt"], overwrite=True):
        (path / "thesis.tex").touch()  # somebody's, meanwhile
    assert sorted(os.listdir(path)) == ["a.txt", "thesis.tex"]
    assert os.listdir(tmp_path) == ["out"]


@linked
def test_of_two_stages_of_one_folder_the_first_stays(
    tmp_path: Path, way: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    restrict(monkeypatch, way)
    names = ("a.txt", "b.txt")

    def both() -> None:
        with staged(tmp_path / "out", names=names) as second:
            for name in names:
                (second / name).write_text("second")
            with staged(tmp_path / "out", names=names) as first:
                (first / "a.txt").write_text("first")

    with pytest.raises(EvflowDataError, match=r"EV013.*a\.txt was created"):
        both()
    assert os.listdir(tmp_path / "out") == ["a.txt"]
    assert (tmp_path / "out" / "a.txt").read_text() == "first"


@pytest.mark.parametrize("name", [*("x" * n for n in (179, 181, 240, 252, 255)), "θ" * 127,
                                  "x" + "流" * 84, "y" * 254 + "."])
def test_long_names(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    write(path, "text")
    write(path, "again", overwrite=True)
    assert path.read_text() == "again"
    assert refusal(tmp_path / f"{name}{'z' * (256 - len(os.fsencode(name)))}").code == "EV019"
    path.unlink()
    with atomic_folder(path, names=()) as folder:
        assert len(os.fsencode(folder.name)) <= 255
    assert os.listdir(tmp_path) == [name]


@pytest.mark.parametrize("name", ["out.txt", "x" * 255])
def test_what_a_killed_run_left_goes_with_the_next(tmp_path: Path, name: str) -> None:
    """But nothing that a live process writes, or one that cannot be seen from here."""
    program = ("import os, signal, sys\n"
               "from evflow.files.atomic import aside, atomic_write\n"
               "from pathlib import Path\n"
               "path = Path(sys.argv[1])\n"
               "with atomic_write(path, overwrite=True) as temporary:\n"
               "    temporary.touch()\n"
               "    aside(path, 'part').mkdir()\n"
               "    aside(path, 'part.mp4').touch()\n"
               "    (path.parent / 'begun').touch()\n"
               "    signal.pause()\n")
    path, begun = tmp_path / name, tmp_path / "begun"
    def start() -> subprocess.Popen[bytes]:
        process = subprocess.Popen([sys.executable, "-c", program, str(path)],
                                   env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)})
        while not begun.exists():
            assert process.poll() is None
            time.sleep(0.01)
        begun.unlink()
        return process

    dead = start()
    left = set(os.listdir(tmp_path))
    assert len(left) == 3
    write(path, "beside a live one")
    assert set(os.listdir(tmp_path)) == {name, *left}
    path.unlink()
    dead.kill()
    dead.wait()
    elsewhere = [n.replace(f".{mark().partition('-')[0]}-", ".12345678-") for n in left]
    old = f".{name[:200]}.12345678.tmp"  # of no known process
    for other in (*elsewhere, old):
        (tmp_path / other).touch()
    write(tmp_path / "other.txt", "has another name")
    assert left < set(os.listdir(tmp_path))
    write(path, "new")
    assert set(os.listdir(tmp_path)) == {name, "other.txt", old, *elsewhere}


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


def test_two_that_replace_one_folder_do_not_mix(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, names, real = tmp_path / "out", ("a.txt", "b.txt"), os.replace
    others: list[threading.Thread] = []

    def put(words: str) -> None:
        with staged(folder, names=names, overwrite=True) as stage:
            for name in names:
                (stage / name).write_text(words)

    def slow(source: Path, target: Path) -> None:
        real(source, target)
        if not others and target.parent == folder and target.name in names:
            others.append(threading.Thread(target=put, args=("other",)))
            others[0].start()
            others[0].join(0.3)  # it waits, or is done meanwhile

    monkeypatch.setattr(os, "replace", slow)
    put("one")
    others[0].join()
    assert {(folder / name).read_text() for name in names} == {"other"}


def test_an_interrupt_leaves_no_half_removed_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    (folder / "a").touch()
    rmtree = shutil.rmtree

    def slow(path: Path, **options: Any) -> None:
        signal.raise_signal(signal.SIGINT)
        rmtree(path, **options)

    monkeypatch.setattr(shutil, "rmtree", slow)
    with pytest.raises(KeyboardInterrupt):
        moves.remove(folder)
    assert not folder.exists()


@pytest.mark.parametrize("folder", [
    lambda path: staged(path, names=("x",), overwrite=True),
    lambda path: atomic_folder(path, names=("x",), overwrite=True)], ids=["staged", "atomic"])
def test_a_file_where_a_folder_is_written_is_refused_before_any_work(
    tmp_path: Path, folder: Callable[[Path], Any]
) -> None:
    (tmp_path / "out").write_text("dear to me")
    with pytest.raises(EvflowDataError, match=r"EV013.*is a file"), folder(tmp_path / "out"):
        pytest.fail("the work began")
    assert (tmp_path / "out").read_text() == "dear to me"


def test_a_staged_folder_keeps_every_other_file(tmp_path: Path) -> None:
    for name in (".probe", ".stage", "stage"):
        (tmp_path / name).write_text("dear to me")
    with staged(tmp_path, names=("x",)) as stage:
        (stage / "x").write_text("new")
    assert sorted(p.name for p in tmp_path.iterdir()) == [".probe", ".stage", "stage", "x"]
    assert {(tmp_path / name).read_text() for name in (".probe", ".stage", "stage")} == {
        "dear to me"}
