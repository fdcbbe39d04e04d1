"""Recordings larger than memory: their columns lie on disk, and are the same."""

from __future__ import annotations

import errno
import mmap
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.fuzz import flat, same
from helpers.fuzz_samples import SAMPLES
from helpers.recordings import equal, make

from evflow import io
from evflow.errors import EvflowDataError
from evflow.files import spool
from evflow.files.spool import Spool, put_aside
from evflow.io import writer
from evflow.types import Events, Recording

EVENTS = 4_000_000


@pytest.mark.parametrize("joined", [0, 50, 1 << 25])
@pytest.mark.parametrize("limit", [0, 100, 10_000])
def test_rows_come_back_from_memory_and_from_disk(
    monkeypatch: pytest.MonkeyPatch, limit: int, joined: int
) -> None:
    monkeypatch.setattr(spool, "JOINED", joined)
    rng = np.random.default_rng(0)
    parts = [rng.integers(0, 1000, n) for n in (0, 7, 40, 1, 300)]
    column = Spool(np.int64, limit)
    for part in parts:
        block = np.concatenate([part, part])
        column.append(block[: len(part)])
        block[:] = -1  # what was a view is a copy
    joined_rows = column.array()
    assert isinstance(joined_rows, np.memmap) == (limit < 8 * 348)
    np.testing.assert_array_equal(joined_rows, np.concatenate(parts))
    assert joined_rows.dtype == np.int64


def test_nothing_is_an_empty_array() -> None:
    assert Spool(bool).array().shape == (0,)


def test_a_full_disk_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full on this system")
    monkeypatch.setattr(spool.tempfile, "TemporaryFile",
                        lambda prefix: open("/dev/full", "wb", buffering=0))  # noqa: SIM115
    column = Spool(np.int64, 0)
    with pytest.raises(EvflowDataError, match=r"EV019.*TMPDIR"):
        column.append(np.arange(10))


RECORDINGS = [kind for kind in SAMPLES if not kind.startswith(
    ("images", "times", "stack", "video", "camera", "weights", "coco"))]


def on_disk(array: np.ndarray) -> bool:
    base: Any = array
    while isinstance(base, np.ndarray):
        base = base.base
    return isinstance(base, mmap.mmap)


@pytest.mark.parametrize("kind", RECORDINGS)
def test_every_format_is_the_same_from_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    made = SAMPLES[kind](tmp_path)
    want = made.read(made.path)
    monkeypatch.setattr(spool, "LIMIT", 0)
    got = made.read(made.path)
    columns = [getattr(got.events, name) for name in "xytp"]
    assert all(map(on_disk, columns + [got.frames] * got.has_frames))
    assert not any(map(on_disk, flat(want)))
    assert same(got, want)
    assert [a.dtype for a in flat(got)] == [a.dtype for a in flat(want)]
    assert got.notes == want.notes


READING = """
import resource, sys
from pathlib import Path
import numpy as np
from evflow import io
from evflow.files import spool

path, limit, room = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
io.read_recording(path, stop_s=0.01)  # all that reading imports
spool.LIMIT = limit
used = int(Path("/proc/self/status").read_text().split("VmData:")[1].split()[0]) * 1024
resource.setrlimit(resource.RLIMIT_DATA, (used + room,) * 2)
events = io.read_recording(path).events
windows = (events.slice(t, t + 100_000) for t in range(0, 3_000_000, 100_000))
print(len(events), sum(int(window.count_map().sum()) for window in windows))
"""


def large(folder: Path, kind: str) -> Path:
    rng = np.random.default_rng(0)
    t = np.sort(rng.integers(0, 3_000_000, EVENTS))
    x, y = rng.integers(0, 320, EVENTS), rng.integers(0, 240, EVENTS)
    events = Events(x, y, t, rng.random(EVENTS) < 0.5, (320, 240))
    path = folder / f"large.{kind}"
    if kind == "dat":
        words = np.stack([t, events.p * 2**28 + y * 2**14 + x], 1).astype("<u4")
        header = b"% Data file containing CD events\n% Width 320\n% Height 240\n"
        path.write_bytes(header + bytes([12, 8]) + words.tobytes())
    else:
        io.write_events(path, events, kind)
    return path


@pytest.mark.skipif(sys.platform != "linux", reason="needs RLIMIT_DATA")
@pytest.mark.parametrize("kind", ["dat", "dsec", "npz", "aedat4"])
def test_windows_of_a_file_larger_than_memory(tmp_path: Path, kind: str) -> None:
    """Four million events, whose columns take 52 MB, in 40 MB (RLIMIT_DATA does not count what is
    mapped from disk)."""
    if kind == "aedat4":
        pytest.importorskip("aedat")
    path = large(tmp_path, kind)
    for limit, fits in ((1 << 20, True), (1 << 29, False)):
        done = subprocess.run(
            [sys.executable, "-c", READING, str(path), str(limit), str(40_000_000)],
            capture_output=True, text=True, timeout=120)
        if fits:
            assert done.stdout.split() == [str(EVENTS)] * 2, done.stderr
        else:  # a library may die of it instead of saying so; filters of HDF5 do not say why
            said = done.stderr.lower()
            assert done.returncode < 0 or "memory" in said or "filter returned failure" in said
            assert not done.stdout


def test_columns_that_are_read_once_lie_on_the_disk(tmp_path: Path) -> None:
    events = make(1000).events
    io.write_events(tmp_path / "a.npz", events, "npz")
    with spool.on_disk(100):
        found = io.read_events(tmp_path / "a.npz")
    for name in "xytp":
        column = getattr(found, name)
        assert on_disk(column)
        spool.forget(column)
        np.testing.assert_array_equal(column, getattr(events, name))
    assert not on_disk(io.read_events(tmp_path / "a.npz").t)
    spool.forget(events.t)
    assert repr(found) == repr(events)


def test_a_copy_never_holds_all_events(monkeypatch: pytest.MonkeyPatch) -> None:
    class Out:
        def __init__(self) -> None:
            self.parts: list[Events] = []

        def append(self, events: Events) -> None:
            self.parts.append(events)

    monkeypatch.setattr(writer, "FLUSH", 64)
    out, recording = Out(), Recording.of_events(make(1000).events)
    writer.copy(recording, out)  # type: ignore[arg-type]
    assert max(map(len, out.parts)) == 64
    equal(Events.concatenate(out.parts), recording.events)


def test_an_array_that_is_put_aside_is_the_same_on_the_disk() -> None:
    array = np.arange(24, dtype=np.float32).reshape(2, 3, 4)
    aside = put_aside(array)
    np.testing.assert_array_equal(aside, array)
    assert (aside.shape, aside.dtype) == (array.shape, array.dtype)
    assert isinstance(aside.base.base if aside.base.base is not None else aside.base, np.memmap)


@pytest.mark.parametrize(("number", "why"), [(errno.EDQUOT, "quota"), (errno.ENOENT, "no such")])
def test_a_temporary_folder_that_cannot_be_used_is_not_called_a_damaged_recording(
    monkeypatch: pytest.MonkeyPatch, number: int, why: str
) -> None:
    def refused(prefix: str) -> None:
        raise OSError(number, "refused")

    monkeypatch.setattr(spool.tempfile, "TemporaryFile", refused)
    with pytest.raises(EvflowDataError, match=rf"EV019.*{why}.*TMPDIR"):
        Spool(np.int64, 0).append(np.arange(10))


def test_changes_of_a_copy_on_write_map_are_kept(tmp_path: Path) -> None:
    """They are in memory alone."""
    np.save(tmp_path / "p.npy", np.arange(100_000))
    column = np.load(tmp_path / "p.npy", mmap_mode="c")
    column[:] = -column
    spool.forget(column[10:])
    np.testing.assert_array_equal(column, -np.arange(100_000))
