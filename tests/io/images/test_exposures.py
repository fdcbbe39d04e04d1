"""Exposures of frames: begin and end in files of times, stacks and videos, and numbers by name."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.sources import message
from helpers.videos import drifting

from evflow import Events, Recording, read_recording, write_recording
from evflow.io.images.exposures import Stamps, mid_exposure, noted, stated
from evflow.io.images.times import read_times
from evflow.io.source import open_frames
from evflow.notes import Note

BEGIN = 1_643_243_628_000_000 + 40_000 * np.arange(5)  # us since 1970
ODD = 8_001
PAIRS = np.stack([BEGIN, BEGIN + ODD], 1)
MIDDLE = (BEGIN + ODD // 2).tolist()


def lines(pairs: np.ndarray, form: str = "{}") -> str:
    return "".join(f"{form.format(b)}, {form.format(e)}\n" for b, e in pairs.tolist())


def video(root: Path) -> Path:
    writer = cv2.VideoWriter(str(root / "v.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 25, (32, 24))
    for frame in drifting(5, (24, 32)):
        writer.write(np.repeat(frame.astype(np.uint8)[..., None], 3, -1))
    writer.release()
    return root / "v.avi"


def folder(root: Path) -> Path:
    (root / "f").mkdir()
    for i, frame in enumerate(drifting(5, (24, 32))):
        cv2.imwrite(str(root / f"f/{i}.png"), frame)
    return root / "f"


def stack(root: Path) -> Path:
    np.save(root / "s.npy", drifting(5, (24, 32)).astype(np.float32))
    return root / "s.npy"


def pages(root: Path) -> Path:
    cv2.imwritemulti(str(root / "p.tif"), list(drifting(5, (24, 32)).astype(np.uint8)))
    return root / "p.tif"


FILES: dict[str, tuple[str, Any]] = {
    "DSEC": ("t.txt", "# exposure_start_timestamp_us, exposure_end_timestamp_us\n" + lines(PAIRS)),
    "bare us": ("t.txt", lines(PAIRS)),
    "ns": ("t.txt", lines(1000 * PAIRS)),
    "ns by name": ("t.txt", "# begin [ns], end [ns]\n" + lines(1000 * PAIRS)),
    "an exposure beside": ("t.csv", "timestamp_ns,exposure_ms,gain\n" + "".join(
        f"{1000 * t},{ODD / 1e3},1.5\n" for t in MIDDLE)),
    "pairs": ("t.npy", PAIRS),
    "pairs of ns": ("t.npy", 1000 * PAIRS),
    "begin and end beside their begin": ("t.csv", "t,exposure_start,exposure_end\n" + "".join(
        f"{b},{b},{e}\n" for b, e in PAIRS.tolist())),
    "begin and end in ns by name": ("t.csv", "i,t,exposure_end_ns,exposure_start_ns\n" + "".join(
        f"{i},{e},{1000 * e},{1000 * b}\n" for i, (b, e) in enumerate(PAIRS.tolist()))),
    "start and end beside the middle": ("t.npz", {
        "t": np.array(MIDDLE), "start": PAIRS[:, 0], "end": PAIRS[:, 1]}),
    "begin and end": ("t.npz", {"exposure_begin": PAIRS[:, 0], "exposure_end": PAIRS[:, 1]}),
    "a number beside": ("t.npz", {"t": np.array(MIDDLE), "exposure_time_ns": 1000 * ODD})}


def write(root: Path, kind: str) -> Path:
    name, what = FILES[kind]
    if isinstance(what, str):
        (root / name).write_text(what)
    elif isinstance(what, dict):
        np.savez(root / name, **what)
    else:
        np.save(root / name, what)
    return root / name


@pytest.mark.parametrize("kind", FILES)
def test_files_of_times_tell_the_exposure(tmp_path: Path, kind: str) -> None:
    """Where half a microsecond is known, the middle is rounded up."""
    found = read_times(write(tmp_path, kind))
    halves = "ns" in kind
    assert (found.us.tolist(), found.exposure_us) == ([t + halves for t in MIDDLE], ODD)


def test_begin_and_end_stand_above_another_time(tmp_path: Path) -> None:
    """With a note; what is not called an exposure must lie at the time to be one."""
    ends = dict(zip(("exposure_start", "exposure_end"), PAIRS.T, strict=True))
    np.savez(tmp_path / "t.npz", t=BEGIN - 5_000, **ends)
    found = read_times(tmp_path / "t.npz", "us")
    assert (found.us.tolist(), found.exposure_us) == (MIDDLE, ODD)
    assert [(n.code, "t differs from all three" in n.text) for n in found.notes] == [
        ("frames.clock", True)]
    rows = np.arange(5)
    for others in ({"start": BEGIN, "end": BEGIN + ODD}, {"row_start": rows, "row_end": rows + 1},
                   {"exposure_start": BEGIN, "exposure_end": BEGIN}):
        np.savez(tmp_path / "t.npz", t=BEGIN - 5_000, **others)
        found = read_times(tmp_path / "t.npz", "us")
        assert (found.us.tolist(), found.exposure_us) == ((BEGIN - 5_000).tolist(), 0)


def test_seconds_and_milliseconds(tmp_path: Path) -> None:
    path = tmp_path / "t.txt"
    for unit, part, form in (("s", 1e-6, "{:.6f}"), ("ms", 1e-3, "{:.3f}")):
        path.write_text(lines((PAIRS - BEGIN[0]) * part, form))
        assert read_times(path, unit).exposure_us == ODD
        np.save(tmp_path / "t.npy", (PAIRS - BEGIN[0]) * part)
        assert read_times(tmp_path / "t.npy").exposure_us == ODD


@pytest.mark.parametrize("made", [folder, stack, video, pages])
def test_every_source_has_the_exposure_of_its_times_and_one_note(tmp_path: Path, made: Any) -> None:
    path, times = made(tmp_path), write(tmp_path, "DSEC")
    source = open_frames(path, timestamps=times)
    assert [time for _, time in source.open()] == MIDDLE
    assert source.exposure_us == ODD
    said = [note.text for note in source.notes if note.code == "frames.exposure"]
    assert len(said) == 1
    assert "8.001 ms, as the file says" in said[0]
    assert open_frames(path, fps=25).exposure_us == 0
    (tmp_path / "t.txt").write_text(lines(np.stack([BEGIN, BEGIN], 1)))  # nothing is known
    source = open_frames(path, timestamps=times)
    assert [time for _, time in source.open()] == BEGIN.tolist()
    assert source.exposure_us == 0
    assert all(note.code != "frames.exposure" for note in source.notes)


@pytest.mark.parametrize("arrays", [
    {"frame_times": PAIRS}, {"exposure_ts": 1000 * PAIRS - 500},
    {"t": np.array(MIDDLE), "exposure_us": np.full(5, ODD)},
    {"t": BEGIN, "exposure_begin": BEGIN, "exposure_end": BEGIN + ODD},
    {"timestamps": np.array(MIDDLE), "exposure_times_ms": np.array([ODD / 1e3])}])
def test_stacks_in_npz(tmp_path: Path, arrays: dict[str, np.ndarray]) -> None:
    path = tmp_path / "a.npz"
    np.savez(path, frames=drifting(5, (24, 32)), **arrays)
    source = open_frames(path)
    assert [time for _, time in source.open()] == MIDDLE
    assert source.exposure_us == ODD
    assert open_frames(path, fps=25).exposure_us == 0


def test_the_exposure_is_the_frames_median() -> None:
    lengths = np.array([100, 100, 7_000, 7_001, 30_000])
    found = mid_exposure(np.stack([BEGIN, BEGIN + lengths], 1), "them")
    assert found.times.dtype == np.int64
    assert found.exposure_us("us") == 7_000
    assert mid_exposure(BEGIN, "them").exposure_us("us") == 0
    for wrong in (PAIRS[:, ::-1], np.stack([BEGIN, BEGIN + 40_001], 1)):
        assert "not begin and end" in message(lambda wrong=wrong: mid_exposure(wrong, "them"))


@pytest.mark.parametrize(("unit", "length"), [
    ("s", 0.008001), ("ms", 8.001), ("us", 8001), ("ns", 8_001_499)])
def test_the_unit_of_the_times_is_that_of_the_length(unit: str, length: float) -> None:
    assert Stamps(np.zeros(1), length).exposure_us(unit) == ODD
    assert Stamps(np.zeros(1), length, 5).exposure_us(unit) == 5


def test_names_state_an_exposure_only_with_a_unit() -> None:
    for name, value in (("exposure_us", 8001), ("cam/frame_exposure_time_ms", 8.001),
                        ("Exposures_ns", [8_001_000] * 3), ("exposure_duration_s", 0.008001),
                        ("Exposure [us]", 8001), ("exposure time (ms)", 8.001)):
        assert stated([name, "gain"], {name: value, "gain": 3}.__getitem__) == ODD
    for names, value in ((["exposure"], 8001), (["exposure_time"], 8001), (["exposed_us"], 8001),
                         (["exposure_us", "exposure_ms"], 8001), (["exposure_us"], np.nan),
                         (["exposure_us"], -1), (["exposure_us"], "8001"), (["exposure_us"], []),
                         (["exposure_s"], 1e300)):
        assert stated(names, lambda name, value=value: value) == 0


def test_what_is_longer_than_the_interval_is_noted_and_not_used(tmp_path: Path) -> None:
    for length, exposure_us, said in ((40_000, 40_000, "exposed for 40 ms"), (
            43_000, 0, "states an exposure of 43 ms, longer than the 40 ms between frames")):
        np.savez(tmp_path / "t.npz", t=BEGIN, exposure_us=length)
        (tmp_path / "t.csv").write_text("time_us,exposure_ns\n" + "".join(
            f"{t},{1000 * length}\n" for t in BEGIN.tolist()))
        np.savez(tmp_path / "v.npz", frames=drifting(5, (24, 32)), t=BEGIN, exposure_us=length)
        np.save(tmp_path / "v.npy", drifting(5, (24, 32)))
        for source in (open_frames(tmp_path / "v.npy", timestamps=tmp_path / "t.npz"),
                       open_frames(tmp_path / "v.npy", timestamps=tmp_path / "t.csv"),
                       open_frames(tmp_path / "v.npz")):
            found = [note.text for note in source.notes if note.code == "frames.exposure"]
            assert source.exposure_us == exposure_us
            assert len(found) == 1
            assert said in found[0]


def test_one_note_at_most() -> None:
    old, other = noted((), 5, "as the file says")[0], Note("frames.unit", "in us")
    assert [note.text[:32] for note in noted((old, other), 7_001, "as was given")] == [
        "in us", "frames are exposed for 7.001 ms,"]
    assert noted((old, other), 0) == (other,)


@pytest.mark.parametrize("name", ["a.npz", "a.h5", "a.aedat4"])
def test_an_exposure_longer_than_the_interval_is_not_believed(tmp_path: Path, name: str) -> None:
    pytest.importorskip("aedat" if name.endswith("4") else "h5py")
    events = Events(np.arange(20), np.arange(20), 20_000 * np.arange(20), np.ones(20, bool),
                    (32, 24))
    frames, times = np.stack(list(drifting(4, (24, 32)))).astype(np.uint8), 100_000 * np.arange(4)
    write_recording(tmp_path / name, Recording(events, frames, times, exposure_us=150_000))
    found = read_recording(tmp_path / name)
    assert found.exposure_us == 0
    assert any("longer than" in note.text for note in found.notes)


@pytest.mark.parametrize("kind", ["u4", "i4", "i8", "u8", "f8"])
def test_begin_and_end_in_ticks_have_a_middle_in_ticks(tmp_path: Path, kind: str) -> None:
    begin = 2_000_000 + 40_000 * np.arange(30)
    np.save(tmp_path / "t.npy", np.stack([begin, begin + 5001], 1).astype(kind))
    np.testing.assert_array_equal(read_times(tmp_path / "t.npy").us, begin + 2500)
