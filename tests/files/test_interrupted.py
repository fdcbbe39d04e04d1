"""Writing that is broken off at any instant: the file is absent, or whole; nothing else is left."""

from __future__ import annotations

import itertools
import os
import random
import signal
import subprocess
import sys
import time
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.recordings import SIZE, equal, make

from evflow.errors import EvflowDataError
from evflow.io import open_writer, read_events, write_recording
from evflow.io.decode import hdf5
from evflow.io.decode.hdf5 import Disk
from evflow.io.registry import WRITERS
from evflow.io.writer import EventWriter
from evflow.process.terminal import stoppable
from evflow.types import Events, Recording

HDF5 = ("dsec", "event_utils")
SUFFIXES = {"dsec": ".h5", "event_utils": ".h5", "e2vid": ".zip", "npz": ".npz",
            "aedat4": ".aedat4"}
CALLS = ("write", "seek", "readinto", "truncate", "flush")  # that HDF5 makes of a file
Act = Callable[[], None]


class Odd(BaseException):
    """What nobody expects."""


def written(path: Path, kind: str) -> None:
    """In two parts with frames between them, so that data sets grow."""
    recording = make(3000)
    half = int(recording.events.t[1500])
    with open_writer(path, SIZE, kind) as out:
        out.append(recording.events.slice(int(recording.events.t[0]), half))
        out._flush()
        out.append_frames(recording.frames, recording.frame_times)
        out.append(recording.events.slice(half, int(recording.events.t[-1]) + 1))


def outcome(path: Path, kind: str) -> BaseException | None:
    try:
        written(path, kind)
    except (Exception, KeyboardInterrupt, Odd) as e:
        return e
    return None


def at_call(monkeypatch: pytest.MonkeyPatch, name: str, index: int, act: Act | None) -> list[int]:
    """Let the index-th call of a method of Disk begin with `act`, or not happen at all (None);
    counts the calls."""
    real, calls = getattr(Disk, name), [0]

    def call(self: Disk, *arguments: Any) -> Any:
        calls[0] += 1
        if calls[0] == index:
            if act is None:
                return len(arguments[0])
            act()
        return real(self, *arguments)

    monkeypatch.setattr(Disk, name, call)
    return calls


@pytest.mark.parametrize("kind", HDF5)
@pytest.mark.parametrize("name", CALLS)
def test_a_signal_in_any_call_of_hdf5_comes_out_and_leaves_nothing(
    tmp_path: Path, kind: str, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        calls = at_call(patch, name, 0, None)
        written(tmp_path / "reference", kind)
    (tmp_path / "reference").unlink()
    assert calls[0] or name == "readinto"
    for index in range(1, calls[0] + 1):
        number = (signal.SIGINT, signal.SIGTERM)[index % 2]
        with monkeypatch.context() as patch, stoppable():
            at_call(patch, name, index, lambda number=number: signal.raise_signal(number))
            assert isinstance(outcome(tmp_path / "out.h5", kind), KeyboardInterrupt), index
        assert os.listdir(tmp_path) == [], index


@pytest.mark.parametrize("kind", HDF5)
def test_any_exception_in_a_call_of_hdf5_is_kept_and_raised(
    tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for index in range(1, 40, 3):
        count = iter(range(1, 10**6))

        def checksum(data: Any, count: Any = count, index: int = index) -> int:
            if next(count) == index:
                raise Odd
            return 0

        with monkeypatch.context() as patch:
            patch.setattr(hdf5, "zlib", types.SimpleNamespace(crc32=checksum))
            assert isinstance(outcome(tmp_path / "out.h5", kind), Odd)
        assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("kind", HDF5)
def test_a_write_that_was_lost_is_found_before_the_file_has_its_name(
    tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Any one write of all. What is written over later may be lost."""
    path = tmp_path / "out.h5"
    with monkeypatch.context() as patch:
        calls = at_call(patch, "write", 0, None)
        written(path, kind)
    reference = path.read_bytes()
    path.unlink()
    found = 0
    for index in range(1, calls[0] + 1):
        with monkeypatch.context() as patch:
            at_call(patch, "write", index, None)
            error = outcome(path, kind)
        assert (error is None) == path.exists()
        if path.exists():
            assert path.read_bytes() == reference, index
            path.unlink()
        else:
            found += 1
        assert os.listdir(tmp_path) == []
    assert found > calls[0] / 2


@pytest.mark.parametrize("kind", SUFFIXES)
@pytest.mark.parametrize("damage", ["cut", "middle"])
def test_what_is_not_whole_gets_no_name(
    tmp_path: Path, kind: str, damage: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    verify = WRITERS[kind]._verify
    if damage == "middle" and kind not in HDF5:
        pytest.skip("only sizes and contents are looked at")

    def damaged(self: EventWriter, temporary: Path) -> None:
        size = temporary.stat().st_size
        with open(temporary, "r+b") as f:
            if damage == "cut":
                f.truncate(size - 1)
            else:
                f.seek(size // 2)
                f.write(bytes(64))
        verify(self, temporary)

    monkeypatch.setattr(WRITERS[kind], "_verify", damaged)
    recording = make(3000) if WRITERS[kind].DEPTHS else Recording.of_events(make(3000).events)
    with pytest.raises(EvflowDataError, match=r"EV019.*not written completely"):
        write_recording(tmp_path / f"out{SUFFIXES[kind]}", recording, kind)
    assert os.listdir(tmp_path) == []


def test_rows_that_are_not_in_an_array_are_missed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from evflow.files.arrays import GrowingArray

    append = GrowingArray.append

    def short(self: GrowingArray, rows: np.ndarray) -> None:
        append(self, rows[1:])
        self.rows += 1

    monkeypatch.setattr(GrowingArray, "append", short)
    for name in ("out", "out.npz"):
        with pytest.raises(EvflowDataError, match=r"EV019.*not written completely"):
            write_recording(tmp_path / name, Recording.of_events(make(50).events))
    assert os.listdir(tmp_path) == []


PROGRAM = """
import sys
import numpy as np
from evflow.io import write_events
from evflow.types import Events
rng = np.random.default_rng(0)
n = 400_000
events = Events(rng.integers(0, 64, n), rng.integers(0, 48, n), np.arange(n), rng.integers(0, 2, n),
                (64, 48))
write_events(sys.argv[1], events, sys.argv[2], overwrite=True)  # the first loads h5py
print("ready", flush=True)
while True:
    write_events(sys.argv[1], events, sys.argv[2], overwrite=True)
    print("written", flush=True)
"""
UNHEARD = 20  # files that are written after a signal that came to nothing


def killed(path: Path, kind: str, number: signal.Signals, after_s: float) -> int:
    """The exit code of a process that writes one file over and over, killed in the midst of it;
    again where it goes on writing: Python ignores what is raised in a destructor."""
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, str(path), kind], text=True, stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL, env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)})
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    time.sleep(after_s)
    try:
        for _ in range(5):
            process.send_signal(number)
            if sum(1 for _ in itertools.islice(process.stdout, UNHEARD)) < UNHEARD:
                return process.wait()
        raise AssertionError("it never ended")
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


def attack(path: Path, kind: str, kills: int) -> None:
    reference: Events | None = None
    for index in range(kills):
        number = (signal.SIGINT, signal.SIGINT, signal.SIGKILL)[index % 3]
        assert killed(path, kind, number, random.Random(index).uniform(0, 0.15)) == -number
        found = read_events(path)
        reference = reference or found
        equal(found, reference)
        if number == signal.SIGINT:
            assert os.listdir(path.parent) == [path.name]


@pytest.mark.parametrize("kind", ["dsec", "npz"])
def test_killed_at_random_instants(tmp_path: Path, kind: str) -> None:
    attack(tmp_path / f"out{SUFFIXES[kind]}", kind, 6)


@pytest.mark.slow
@pytest.mark.parametrize("kind", HDF5)
def test_killed_at_many_random_instants(tmp_path: Path, kind: str) -> None:
    attack(tmp_path / "out.h5", kind, 60)
