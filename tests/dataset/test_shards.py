"""Data sets: the same bytes from any number of shards and workers, and honest about damage."""

from __future__ import annotations

import dataclasses
import errno
import functools
import json
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from helpers.datasets import CONFIG, assert_tidy, cached_compilation, contents, refused

from evflow.dataset import build, shards, verify
from evflow.dataset.manifest import Manifests
from evflow.io.decode.hdf5 import Disk


@pytest.fixture(autouse=True, scope="module")
def shared_programs() -> Iterator[None]:
    with cached_compilation():
        yield


@pytest.fixture(autouse=True, scope="module")
def sequences() -> Iterator[Any]:
    """Each is made once in this module: what it holds depends on its numbers alone."""
    made = functools.cache(shards.make_sequence)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(shards, "make_sequence", made)
        yield made


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A set made in one process; read, never changed."""
    folder = tmp_path_factory.mktemp("whole")
    assert build(folder, CONFIG) == list(CONFIG.names)
    return folder


@pytest.fixture
def copied(whole: Path, tmp_path: Path) -> Path:
    folder = tmp_path / "set"
    subprocess.run(["cp", "-r", whole, folder], check=True)
    return folder


def test_shards_make_the_same_files_in_any_order(
    whole: Path, tmp_path: Path, sequences: Any
) -> None:
    sequences.cache_clear()
    for index in (2, 0, 3, 1):
        made = build(tmp_path, CONFIG, shard=(index, 4))
        assert made == list(CONFIG.names[index::4])
    assert contents(tmp_path) == contents(whole)
    assert len(list((tmp_path / "manifests").glob("*.json"))) == 4
    ours, theirs = (json.loads((f / "manifest.json").read_text()) for f in (tmp_path, whole))
    assert ours == theirs
    assert ours["total"]["sequences"] == 6
    assert verify(tmp_path) == {}
    assert_tidy(tmp_path)
    assert build(tmp_path, CONFIG) == []


@pytest.mark.slow
def test_two_workers_make_the_same_files(whole: Path, tmp_path: Path) -> None:
    steps: list[tuple[int, int]] = []
    build(tmp_path, CONFIG, workers=2, progress=lambda *step: steps.append(step))
    assert contents(tmp_path) == contents(whole)
    assert steps == [(i, 6) for i in range(1, 7)]
    assert_tidy(tmp_path)


def test_npy_sets_are_made_and_repaired(tmp_path: Path) -> None:
    build(tmp_path, CONFIG, format="npy")
    before = contents(tmp_path)
    (tmp_path / "train/00002/changes.npy").unlink()
    assert list(verify(tmp_path)) == ["train/00002"]
    assert build(tmp_path, CONFIG, format="npy", only_missing=True) == ["train/00002"]
    assert contents(tmp_path) == before


def test_a_flipped_bit_is_named_and_repaired(copied: Path, whole: Path) -> None:
    path = copied / "train/00002.h5"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    path.write_bytes(data)
    (copied / "test/00001.h5").unlink()
    (copied / "train/00000.h5").write_bytes(b"short")
    faults = verify(copied)
    assert {k: v.split(" ")[-1] for k, v in faults.items()} == {
        "train/00002": "differs)", "test/00001": "missing",
        "train/00000": f"{(whole / 'train/00000.h5').stat().st_size:,}"}
    assert verify(copied, (0, 4)).keys() == {"train/00000"}
    with refused("EV009", "00000.h5", "--only-missing"):
        build(copied, CONFIG)
    assert build(copied, CONFIG, only_missing=True) == [
        "train/00000", "train/00002", "test/00001"]
    assert contents(copied) == contents(whole)
    assert verify(copied) == {}


@pytest.mark.parametrize(("changes", "word"), [
    ({"seed": 1}, "seed: 0 there, 1 here"), ({"format": "npy"}, "format"),
    ({"config": dataclasses.replace(CONFIG, seconds=0.2)}, "config.seconds"),
    ({"config": dataclasses.replace(CONFIG, train=9)}, "config.train: 4 there, 9 here")])
def test_another_set_is_refused(copied: Path, changes: dict[str, Any], word: str) -> None:
    before = sorted(copied.rglob("*"))
    with refused("EV013", word):
        build(copied, **{"config": CONFIG, "only_missing": True, "shard": (1, 2)} | changes)
    assert sorted(copied.rglob("*")) == before


def test_sets_that_begin_at_once_do_not_mix(tmp_path: Path, monkeypatch: pytest.MonkeyPatch
                                            ) -> None:
    """Another configuration writes its manifest between our first look and ours."""
    other = (tmp_path / "other", tmp_path / "set/manifests/00001-of-00002.json")
    build(other[0], dataclasses.replace(CONFIG, train=1, test=0))
    text = (other[0] / "manifest.json").read_text()
    check, looks = Manifests.check, iter([True])

    def late(self: Manifests, which: Any) -> None:
        check(self, which)
        if next(looks, False):
            other[1].parent.mkdir(parents=True)
            other[1].write_text(text)

    monkeypatch.setattr(Manifests, "check", late)
    with refused("EV013", "config.train: 1 there"):
        build(tmp_path / "set", CONFIG, shard=(0, 2))
    assert [p for p in (tmp_path / "set").rglob("*") if p.is_file()] == [other[1]]


def test_a_shard_that_ends_during_the_merge_is_not_lost(tmp_path: Path,
                                                        monkeypatch: pytest.MonkeyPatch) -> None:
    build(tmp_path, CONFIG, shard=(1, 2))
    theirs = (tmp_path / "manifests/00001-of-00002.json")
    hidden = tmp_path / "hidden"
    theirs.rename(hidden)
    (tmp_path / "manifest.json").unlink()
    merge = Manifests.merge

    def slow(self: Manifests, part: str) -> None:
        if hidden.exists():
            hidden.rename(theirs)
        merge(self, part)

    monkeypatch.setattr(Manifests, "merge", slow)
    build(tmp_path, CONFIG, shard=(0, 2))
    assert len(json.loads((tmp_path / "manifest.json").read_text())["sequences"]) == 6


def test_of_two_records_the_one_that_fits_counts(copied: Path, whole: Path) -> None:
    """As after a repair on another machine, whose last bits differ."""
    path = copied / "manifests/00000-of-00001.json"
    content = json.loads(path.read_text())
    content["sequences"]["train/00001"]["files"]["train/00001.h5"]["sha256"] = "0" * 64
    for other in ("00000-of-00009.json", "00008-of-00009.json"):  # read first, and last
        (copied / "manifests" / other).write_text(json.dumps(content))
        assert verify(copied) == {}
        assert build(copied, CONFIG, only_missing=True) == []
        merged = [json.loads((f / "manifest.json").read_text()) for f in (copied, whole)]
        assert merged[0] == merged[1]


def test_truncated_manifests(copied: Path, whole: Path) -> None:
    part, merged = copied / "manifests/00000-of-00001.json", copied / "manifest.json"
    for path in (merged, part):
        path.write_text(path.read_text()[:999])
        with refused("EV009", path.name, "--only-missing"):
            build(copied, CONFIG)
        if path == merged:
            assert verify(copied).keys() == {"manifest.json"}
    with refused("EV009", part.name):
        verify(copied)
    with refused("EV009"):
        build(copied, CONFIG)
    # Nobody knows any more whether the files are sound.
    assert build(copied, CONFIG, only_missing=True) == list(CONFIG.names)
    assert contents(copied) == contents(whole)
    assert verify(copied) == {}
    merged.write_text("[]")
    assert build(copied, CONFIG, only_missing=True) == []
    assert verify(copied) == {}


def test_a_file_of_unknown_origin_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "train").mkdir()
    (tmp_path / "train/00001.h5").write_text("somebody's")
    with refused("EV013", "00001.h5", "in no manifest"):
        build(tmp_path, CONFIG)
    assert (tmp_path / "train/00001.h5").read_text() == "somebody's"


def test_a_full_disk_is_a_coded_error_and_the_next_call_goes_on(
    tmp_path: Path, whole: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written = 0

    def full(self: Disk, data: Any) -> int:
        nonlocal written
        written += len(data)
        if written > 200_000 and self.error is None:
            self.error = OSError(errno.ENOSPC, "No space left on device")
        return len(data) if self.error else write(self, data)

    write = Disk.write
    monkeypatch.setattr(Disk, "write", full)
    with refused("EV019", "no space left"):
        build(tmp_path, CONFIG)
    monkeypatch.undo()
    assert 0 < len(contents(tmp_path)) < 6
    assert_tidy(tmp_path)
    build(tmp_path, CONFIG)
    assert contents(tmp_path) == contents(whole)


@pytest.mark.parametrize("call", [3, 125])
def test_a_sequence_that_a_signal_broke_off_is_not_recorded(
    tmp_path: Path, whole: Path, call: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It comes while HDF5 writes, which would drop it."""
    calls = 0

    def interrupted(self: Disk, data: Any) -> int:
        nonlocal calls
        calls += 1
        if calls == call:
            signal.raise_signal(signal.SIGINT)
        return write(self, data)

    write = Disk.write
    monkeypatch.setattr(Disk, "write", interrupted)
    with pytest.raises(KeyboardInterrupt):
        build(tmp_path, CONFIG)
    monkeypatch.undo()
    assert_tidy(tmp_path)
    made = contents(tmp_path)
    assert made.items() <= contents(whole).items()
    recorded = Manifests.read(tmp_path).claims
    assert {f"{name}.h5" for name in recorded} == made.keys()
    build(tmp_path, CONFIG)
    assert contents(tmp_path) == contents(whole)
    assert verify(tmp_path) == {}


def test_folders_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with refused("EV019"):
        build(tmp_path / "file", CONFIG)
    with refused("EV016", "no data set"):
        verify(tmp_path)
