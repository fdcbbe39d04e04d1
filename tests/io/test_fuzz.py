"""Damaged and hostile files of every format: only an `EvflowDataError` that names the file comes
out, in bounded time and memory, and what is read without complaint is right.

Every case is read in a process of its own (see fuzz.py), so that a crash is a failure as well. Many
more cases: `python tests/helpers/fuzz_readers.py`.
"""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import fuzz, fuzz_readers
from helpers.fuzz import Bench, wrong
from helpers.fuzz_hostile import HOSTILE
from helpers.fuzz_samples import SAMPLES, Sample
from helpers.recordings import make, refused

from evflow.errors import EvflowDataError
from evflow.files.archives import npy_header
from evflow.files.compressed import most_bytes
from evflow.io import read_recording
from evflow.io.images.pictures import claimed_size
from evflow.io.source import open_frames
from evflow.types import Events, Recording

pytestmark = pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="needs Linux")


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    with Bench(tmp_path_factory.mktemp("fuzz")) as bench:
        yield bench


def run(bench: Bench, kind: str, first: int, count: int) -> None:
    outcomes = [bench.run(kind, 1, index) for index in range(first, first + count)]
    bad = [str(outcome) for outcome in outcomes if outcome.bad]
    assert not bad, "\n".join(bad[:5])
    assert any(outcome.verdict != "ok" for outcome in outcomes)


@pytest.mark.parametrize("kind", SAMPLES)
def test_damaged_files(bench: Bench, kind: str) -> None:
    run(bench, kind, 0, 10)


@pytest.mark.slow
@pytest.mark.parametrize("kind", SAMPLES)
def test_many_damaged_files(bench: Bench, kind: str) -> None:
    run(bench, kind, 10, 200)


@pytest.mark.parametrize("kind", HOSTILE)
def test_hostile_files_are_refused(bench: Bench, kind: str) -> None:
    outcome = bench.run(kind)
    assert outcome.verdict.startswith("EV"), str(outcome)


@pytest.mark.parametrize("kind", SAMPLES)
def test_sound_files_are_read(tmp_path: Path, kind: str) -> None:
    made = SAMPLES[kind](tmp_path)
    assert not wrong(made.read(made.path), made.read(made.path), made, "cut")


# ------------------------------------------------------------------------- does the bench see it?


def ends(path: Path) -> Any:
    os.kill(os.getpid(), signal.SIGSEGV)


def waits(path: Path) -> Any:
    time.sleep(60)


def takes(path: Path) -> Any:
    return np.ones(1 << 27)  # 1 GiB


def hides(path: Path) -> Any:
    try:
        takes(path)
    except MemoryError as e:
        raise EvflowDataError("EV009", f"{path} is damaged.") from e


def slips(path: Path) -> Any:
    raise KeyError("x")


def forgets(path: Path) -> Any:
    raise EvflowDataError("EV009", "it is damaged.")


def lies(path: Path) -> Recording:
    x, y, t, p = (np.array([70], kind) for kind in ("u2", "u2", "i8", "?"))
    bad = Events.unchecked(x, y, t, p, (64, 48))
    return Recording.of_events(bad)


@pytest.mark.parametrize(("read", "verdict"), [
    (ends, "crash"), (waits, "hang"), (takes, "memory"), (hides, "memory"), (slips, "foreign"),
    (forgets, "pathless"), (lies, "wrong")])
def test_the_bench_sees_every_fault(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, read: Any, verdict: str
) -> None:
    monkeypatch.setattr(fuzz, "LIMIT_S", 1.0)
    path = tmp_path / "a"
    path.write_bytes(b"x")
    with Bench(tmp_path, {"faulty": Faulty(read)}) as bench:
        assert bench.run("faulty").verdict == verdict
        assert bench.run("npz", 1, 0).verdict not in fuzz.BAD  # and goes on


class Faulty:
    """A maker of a sample that is read by `read`."""

    def __init__(self, read: Any) -> None:
        self.read = read

    def __call__(self, folder: Path) -> Sample:
        path = folder / "a"
        path.write_bytes(b"x")
        return Sample(path, (path,), self.read)


def test_a_beginning_is_told_from_other_data(tmp_path: Path) -> None:
    made, whole = SAMPLES["evt2"](tmp_path), make(100)
    ev = whole.events
    part = Recording(Events(ev.x[:50], ev.y[:50], ev.t[:50], ev.p[:50], ev.size),
                     whole.frames[:1], whole.frame_times[:1])
    turned = Recording(Events(ev.x[:50], ev.y[:50], ev.t[:50], ~ev.p[:50], ev.size),
                       whole.frames[:1], whole.frame_times[:1])
    assert not wrong(part, whole, made, "cut")
    assert "not a beginning" in wrong(turned, whole, made, "cut")
    assert not wrong(turned, whole, made, "flip")  # nothing in EVT2 tells
    npz = SAMPLES["npz"](tmp_path)
    assert "other data" in wrong(turned, whole, npz, "flip")
    assert "other data" in wrong(part, whole, npz, "cut")


def test_the_script_goes_on_where_it_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "fuzz.json"
    for cases in (3, 5):
        monkeypatch.setattr("sys.argv", ["x", "--cases", str(cases), "--formats", "npz", "evt3",
                                         "--out", str(out)])
        assert fuzz_readers.main() == 0
        formats = json.loads(out.read_text())["formats"]
        assert [formats[kind]["cases"] for kind in ("npz", "evt3")] == [cases, cases]
        assert all(sum(f["verdicts"].values()) == cases for f in formats.values())
    monkeypatch.setattr("sys.argv", ["x", "--seed", "7", "--out", str(out)])
    with pytest.raises(SystemExit, match="--seed 0"):
        fuzz_readers.main()


# ---------------------------------------------------------------------------- what has been found


@pytest.mark.parametrize("path", ["a\0b", "x" * 5000, "/dev/null/x"])
def test_impossible_paths(path: str) -> None:
    assert refused(Path(path)).code == "EV016"
    with pytest.raises(EvflowDataError, match="EV016"):
        open_frames(path)


@pytest.mark.parametrize("name", ["png", "jpg", "tif", "bmp", "pgm", "webp"])
def test_the_size_of_a_picture_is_read_from_its_header(tmp_path: Path, name: str) -> None:
    target = SAMPLES[f"images-{name}"](tmp_path).targets[0]
    assert claimed_size(target.read_bytes()) == (64, 48)
    assert claimed_size(target.read_bytes()[:7]) is None


@pytest.mark.parametrize(("data", "size"), [
    (b"P5 64 48 255\n", (64, 48)),
    (b"P6\n# a comment\n64 # another\n# and one\n48\n255\n", (64, 48)),
    (b"P5 30000#30000 255\n 1 255 ", None)])  # OpenCV reads 30000x30000
def test_comments_in_a_pgm_hide_no_size(data: bytes, size: tuple[int, int] | None) -> None:
    assert claimed_size(data) == size


def test_an_npy_header_is_read_no_further_than_numpy_would(tmp_path: Path) -> None:
    path = tmp_path / "a.npy"
    path.write_bytes(b"\x93NUMPY\x02\x00\xff\xff\xff\xff" + bytes(64))
    with open(path, "rb") as f, pytest.raises(ValueError, match="header"):
        npy_header(f)
    np.save(path, np.zeros((3, 4), "<f4", order="F"))
    with open(path, "rb") as f:
        assert npy_header(f) == ((3, 4), True, np.dtype("<f4"))
        assert f.tell() == path.stat().st_size - 48


@pytest.mark.parametrize(("data", "most"), [
    (b"plain" * 9, 45),
    (b"\x28\xb5\x2f\xfd\x20\x05" + b"\x29\0\0hello", 14),  # raw; never less than is there
    (b"\x28\xb5\x2f\xfd\0\x38" + b"\x02\0\x10\0" * 9 + b"\x03\0\x10\0", 10 << 17),  # one byte each
    (b"\x28\xb5\x2f\xfd\0\x38" + b"\x25\0\0" + bytes(4), 1 << 17),
    (b"\x5a\x2a\x4d\x18\x02\0\0\0ab\x28\xb5\x2f\xfd\0\x38" + b"\x03\0\x10\0", 1 << 17),
    (b"\x04\x22\x4d\x18\x60\x40\0" + b"\x0a\0\0\0" + bytes(10) + bytes(4), 2550),
    (b"\x04\x22\x4d\x18\x60\x40\0" + b"\0\x04\0\0" + bytes(1024) + bytes(4), 1 << 16),
    (b"\x04\x22\x4d\x18\x60\x40\0" + b"\xe8\3\0\x80" + bytes(1000) + bytes(4), 1015)])
def test_what_frames_expand_to_at_most(data: bytes, most: int) -> None:
    assert most_bytes(data) == most


@pytest.mark.parametrize("n", [0, 1, 1000, 10**6])
def test_no_lz4_frame_holds_more(n: int) -> None:
    lz4 = pytest.importorskip("lz4.frame")
    for data in (bytes(n), np.random.default_rng(0).bytes(n)):
        packed = lz4.compress(data) + lz4.compress(data, store_size=False, block_checksum=True)
        assert 2 * n <= most_bytes(packed) <= max(len(packed), 2 * n + (1 << 23))


def test_what_expands_far_but_honestly_is_read(tmp_path: Path) -> None:
    """A silent, dark scene compresses a thousandfold."""
    from evflow.io import write_events

    none = np.zeros(0, int)
    dark = Recording(Events(none, none, none, none, (346, 260)),
                     np.zeros((400, 260, 346), np.uint8), np.arange(400) * 40_000)
    for kind in ("npz", "dsec"):
        path = tmp_path / f"a.{kind}"
        write_events(path, dark, kind)
        assert path.stat().st_size < dark.frames.nbytes / 100
        assert len(read_recording(path).frames) == 400


@pytest.mark.parametrize("suffix", ["avi", "mp4"])
def test_a_video_that_lacks_the_end_of_its_last_frame(tmp_path: Path, suffix: str) -> None:
    made = SAMPLES[f"video-{suffix}"](tmp_path)
    data = made.path.read_bytes()
    made.path.write_bytes(data[:-40])
    with pytest.raises(EvflowDataError, match=r"EV00[89]"):
        open_frames(made.path)
