"""Writing: every format is read back bit for bit, in any parts, and all or nothing."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.recordings import SIZE, T0, equal, make

from evflow.errors import EvflowDataError
from evflow.io import open_writer, read_events, read_recording, write_events, write_recording
from evflow.io.images.white import stated_white
from evflow.io.registry import WRITERS, WRITTEN, find_format, writer_of
from evflow.io.writer import EventWriter
from evflow.types import Events, Recording

EXTENSION = {name: suffix for suffix, name in reversed(WRITTEN.items())} | {"event_utils": ".h5"}
ANY = [name for name in WRITERS if name != "aedat2"]  # whose chips and times are few
each = pytest.mark.parametrize("kind", ANY)
LATEST = {"e2vid": 2**31 * 10**6, "evreal": 2**31 * 10**6, "event_utils": 2**31 * 10**6}


@pytest.fixture(autouse=True)
def _reader(request: pytest.FixtureRequest) -> None:
    if "kind" in request.fixturenames and request.getfixturevalue("kind") == "aedat4":
        pytest.importorskip("aedat", reason="the package aedat reads AEDAT4")


def place(tmp_path: Path, kind: str) -> Path:
    return tmp_path / f"out{EXTENSION[kind]}"


def fitting(kind: str, recording: Recording) -> Recording:
    """Without frames where the format has none."""
    return recording if WRITERS[kind].DEPTHS else Recording.of_events(recording.events)


def same(got: Recording, want: Recording) -> None:
    equal(got.events, want.events)
    assert got.frames.dtype == want.frames.dtype
    np.testing.assert_array_equal(got.frames, want.frames)
    np.testing.assert_array_equal(got.frame_times, want.frame_times)


def refusal(path: Path, recording: Recording, kind: str | None, **options: Any) -> EvflowDataError:
    with pytest.raises(EvflowDataError) as raised:
        write_recording(path, recording, kind, **options)
    return raised.value


@each
def test_events_and_frames_come_back(tmp_path: Path, kind: str) -> None:
    path, want = place(tmp_path, kind), fitting(kind, make(70_000))
    write_recording(path, want, kind)
    assert kind == find_format(path).NAME
    same(read_recording(path), want)
    first, stop = T0 + 100_000 - int(want.events.t[0]), T0 + 200_000 - int(want.events.t[0])
    part = read_recording(path, start_s=first / 1e6, stop_s=stop / 1e6)
    equal(part.events, want.events.slice(T0 + 100_000, T0 + 200_000))
    if want.has_frames:  # those at 101 and 151 ms
        np.testing.assert_array_equal(part.frames, want.frames[2:4])


@pytest.mark.parametrize("kind", [name for name in ANY if WRITERS[name].DEPTHS])
@pytest.mark.parametrize("exposure_us", [1, 4001, 20_000])
def test_an_exposure_comes_back_twice(tmp_path: Path, kind: str, exposure_us: int) -> None:
    """Also that of a frame whose exposure begins before the clock."""
    events = make(3000).events
    for start in (0, T0):
        want = Recording(Events(events.x, events.y, events.t - T0 + start, events.p, SIZE),
                         make(10).frames, start + 50_000 * np.arange(6), exposure_us=exposure_us)
        path = place(tmp_path, kind)
        write_recording(path, want, kind, overwrite=True)
        for found in (read_recording(path), read_recording(path, start_s=0.08, stop_s=0.18)):
            assert found.exposure_us == exposure_us
            assert [note.code for note in found.notes].count("frames.exposure") == 1
        np.testing.assert_array_equal(found.frames, want.frames[2:4])
        found = read_recording(path)
        write_recording(path, found, kind, overwrite=True)
        again = read_recording(path)
        same(again, want)
        assert (again.exposure_us, again.notes) == (exposure_us, found.notes)


@pytest.mark.parametrize("kind", [name for name in ANY if WRITERS[name].DEPTHS])
def test_without_frames_there_is_no_exposure(tmp_path: Path, kind: str) -> None:
    path, events = place(tmp_path, kind), make(300).events
    with open_writer(path, SIZE, kind, exposure_us=4001) as out:
        out.append(events)
    found = read_recording(path)
    equal(found.events, events)
    assert (found.exposure_us, found.notes) == (0, ())
    with pytest.raises(EvflowDataError, match="EV020"):
        open_writer(path, SIZE, kind, exposure_us=-1)


@pytest.mark.parametrize("kind", [n for n in ANY if "uint16" in WRITERS[n].DEPTHS])
@pytest.mark.parametrize("white", [4095, 1000])
def test_white_of_16_bits_comes_back(tmp_path: Path, kind: str, white: int) -> None:
    """Frames of a dark scene, or of a part, do not show it; bytes and floats have 255."""
    path, made = place(tmp_path, kind), make(3000)
    frames = np.linspace(0, 900, made.frames.size).astype(np.uint16).reshape(made.frames.shape)
    want = Recording(made.events, frames, made.frame_times, full_scale=white)
    write_recording(path, want, kind)
    whole, part = read_recording(path), read_recording(path, stop_s=0.08)
    assert len(part.frames) == 2
    assert part.frames.max() < 400
    assert whole.full_scale == part.full_scale == want.full_scale == max(white, 1023)
    same(whole, want)
    for dtype in (np.uint8, np.float32):
        write_recording(path, Recording(
            made.events, (frames // 4).astype(dtype), made.frame_times), kind, overwrite=True)
        assert read_recording(path).full_scale == 255
    with pytest.raises(EvflowDataError, match="EV020"):
        open_writer(path, SIZE, kind, full_scale=-1)


@pytest.mark.parametrize(("value", "white"), [
    (4095, 4095), (np.uint16(4095), 4095), (np.array([4095]), 4095), (65536, 0), (-1, 0),
    (10**30, 0), (True, 0), (4095.0, 0), ("4095", 0), (None, 0), ([[1], [1, 2]], 0),
    (np.array([1, 2]), 0), (np.zeros(0, int), 0)])
def test_what_is_no_white_states_none(value: Any, white: int) -> None:
    assert stated_white(value) == white


@pytest.mark.parametrize("kind", ["npz", "e2vid"])
def test_archives_do_not_say_when_they_were_written(tmp_path: Path, kind: str) -> None:
    path = place(tmp_path, kind)
    write_events(path, make(50).events, kind)
    with zipfile.ZipFile(path) as archive:
        assert {info.date_time[0] for info in archive.infolist()} == {1980}


@each
def test_depths(tmp_path: Path, kind: str) -> None:
    for dtype in (np.uint8, np.uint16, np.float32):
        want, path = make(50, dtype=dtype), place(tmp_path / dtype.__name__, kind)
        if dtype.__name__ in WRITERS[kind].DEPTHS:
            write_recording(path, want, kind)
            same(read_recording(path), want)
        else:
            error = refusal(path, want, kind)
            assert error.code == ("EV003" if WRITERS[kind].DEPTHS else "EV020")
            assert "Leave the frames out" in str(error)
            assert not path.parent.exists() or os.listdir(path.parent) == []


@each
def test_dark_float_frames_are_no_mistake(tmp_path: Path, kind: str) -> None:
    """One frame alone would look like 0..1; the recording as a whole does not."""
    if "float32" not in WRITERS[kind].DEPTHS:
        pytest.skip(f"{kind} holds no float frames")
    frames = np.stack([np.full(SIZE[::-1], v, np.float32) for v in (0.5, 200.0)])
    want = Recording(make(50).events, frames, np.array([T0, T0 + 10]))
    write_recording(place(tmp_path, kind), want, kind)
    same(read_recording(place(tmp_path, kind)), want)


@each
@pytest.mark.parametrize("flush", [1, 700, 1 << 20])
def test_parts_of_any_size(
    tmp_path: Path, kind: str, flush: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("evflow.io.writer.FLUSH", flush)
    want, path = fitting(kind, make(300)), place(tmp_path, kind)
    cuts = [T0, T0, T0 + 1, T0 + 40_000, T0 + 40_000, T0 + 130_000, T0 + 10**6]
    with open_writer(path, SIZE, kind) as out:
        assert kind == out.NAME
        for a, b in itertools.pairwise(cuts):
            out.append(want.events.slice(a, b))
            keep = (want.frame_times >= a) & (want.frame_times < b)
            if want.has_frames:
                out.append_frames(want.frames[keep], want.frame_times[keep])
        assert not path.exists()
    same(read_recording(path), want)
    assert os.listdir(tmp_path) == [path.name]


@each
@pytest.mark.parametrize("flush", [25, 1 << 20])
def test_arrays_that_the_caller_reuses(
    tmp_path: Path, kind: str, flush: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each part is written as it was when it was appended."""
    monkeypatch.setattr("evflow.io.writer.FLUSH", flush)
    want, path = fitting(kind, make(60)), place(tmp_path, kind)
    x, y, t, p = (getattr(want.events, name)[:10].copy() for name in "xytp")
    frame, time = want.frames[:1].copy(), want.frame_times[:1].copy()
    with open_writer(path, SIZE, kind) as out:
        for k in range(6):
            for name, buffer in zip("xytp", (x, y, t, p), strict=True):
                buffer[:] = getattr(want.events, name)[10 * k : 10 * k + 10]
            out.append(Events(x, y, t, p, SIZE))
            if want.has_frames:
                frame[:], time[:] = want.frames[k], want.frame_times[k]
                out.append_frames(frame, time)
    same(read_recording(path), want)


@each
def test_frames_behind_all_events(tmp_path: Path, kind: str) -> None:
    """Appended last: the indices of events at the images are those of the whole."""
    want, path = make(3000), place(tmp_path, kind)
    with open_writer(path, SIZE, kind) as out:
        out.append(want.events)
        if WRITERS[kind].DEPTHS:
            out.append_frames(want.frames, want.frame_times)
    same(read_recording(path), fitting(kind, want))


@each
def test_silence(tmp_path: Path, kind: str) -> None:
    silent = Events([], [], [], [], SIZE)
    write_events(place(tmp_path, kind), silent, kind)
    equal(read_events(place(tmp_path, kind)), silent)


@each
def test_the_first_and_last_times(tmp_path: Path, kind: str) -> None:
    """What fits comes back to the microsecond; what does not is refused."""
    low, high = WRITERS[kind].TIMES_US
    assert high == LATEST.get(kind, 2**63 - 1)
    for t in {max(low, -(2**53)), -1, 0, 2**31 * 10**6 - 1, min(high, 2**62)}:
        if t < low:
            continue
        events = Events([1, 2], [3, 4], [t, t], [0, 1], SIZE)
        path = place(tmp_path / str(t), kind)
        write_events(path, events, kind)
        equal(read_events(path), events)
    for t in (low - 1, high + 1):
        if not -(2**63) <= t < 2**63:
            continue
        late = Recording.of_events(Events([1], [1], [t], [1], SIZE))
        error = refusal(tmp_path / "late", late, kind)
        assert error.code == "EV003"
        assert "--time-unit" in str(error)
    assert not (tmp_path / "late").exists()


@each
def test_the_largest_sensor(tmp_path: Path, kind: str) -> None:
    side = WRITERS[kind].MAX_SIDE
    corner = Events([0, side - 1], [0, 1], [0, 1], [1, 0], (side, 2))
    write_events(place(tmp_path, kind), corner, kind)
    equal(read_events(place(tmp_path, kind)), corner)
    if side < 65536:
        wide = Recording.of_events(Events([side], [0], [0], [1], (side + 1, 2)))
        assert "EV003" in str(refusal(tmp_path / "wide", wide, kind))


@each
def test_what_does_not_follow_is_refused(tmp_path: Path, kind: str) -> None:
    one, path = make(10), place(tmp_path, kind)
    later = one.frame_times + 10**6

    def write(out: EventWriter, code: str) -> None:
        out.append(one.events)
        frames = bool(WRITERS[kind].DEPTHS)
        if frames:
            out.append_frames(one.frames, one.frame_times)
        if code == "EV004":
            out.append(one.events)
        if code == "EV015":
            out.append(Events([], [], [], [], (9, 9)))
        if code == "EV004 frames" and frames:
            out.append_frames(one.frames, one.frame_times)
        if code == "EV003" and frames:
            out.append_frames(one.frames.astype(np.uint16), later)
        if code == "EV002" and frames:
            out.append_frames(one.frames, later[:2])
        if code == "EV007" and frames:
            out.append_frames(np.full((1, 48, 64), np.nan, np.float32), later[:1])
        raise KeyboardInterrupt

    for code in ("EV004", "EV015", "EV004 frames", "EV003", "EV002", "EV007", "none"):
        with (pytest.raises((EvflowDataError, KeyboardInterrupt)) as raised,
              open_writer(path, SIZE, kind) as out):
            write(out, code)
        if WRITERS[kind].DEPTHS or code in ("EV004", "EV015"):
            assert code == "none" or code[:5] in str(raised.value)
        assert list(tmp_path.iterdir()) == []


@each
def test_nothing_is_overwritten_unasked(tmp_path: Path, kind: str) -> None:
    path = place(tmp_path, kind)
    write_recording(path, fitting(kind, make(500)), kind)
    error = refusal(path, Recording.of_events(make(5).events), kind)
    assert error.code == "EV013"
    assert len(read_events(path)) == 500
    write_events(path, make(5).events, kind, overwrite=True)
    same(read_recording(path), Recording.of_events(make(5).events))
    assert os.listdir(tmp_path) == [path.name]


def test_a_folder_of_somebody_is_never_replaced(tmp_path: Path) -> None:
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "thesis.tex").write_text("dear to me")
    recording = Recording.of_events(make(5).events)
    error = refusal(folder, recording, "evreal", overwrite=True)
    assert error.code == "EV013"
    assert "thesis.tex" in str(error)
    assert (folder / "thesis.tex").read_text() == "dear to me"
    (tmp_path / "file").write_text("dear to me")
    assert refusal(tmp_path / "file", recording, "evreal", overwrite=True).code == "EV013"
    assert sorted(os.listdir(tmp_path)) == ["file", "mine"]
    assert refusal(tmp_path / "file" / "new", recording, "evreal").code == "EV019"


@each
@pytest.mark.parametrize("limit", [3_000, 40_000])
def test_full_disk_leaves_nothing(tmp_path: Path, kind: str, limit: int) -> None:
    """RLIMIT_FSIZE stands in for a full disk: writes past it fail in the kernel."""
    program = f"""
import resource, signal, sys
sys.path.insert(0, {str(Path(__file__).parents[1])!r})
from helpers.recordings import make
from evflow.io import write_recording
from evflow.io.registry import WRITERS
from evflow.types import Recording
recording = make(50_000)
if not WRITERS[{kind!r}].DEPTHS:
    recording = Recording.of_events(recording.events)
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, ({limit}, {limit}))
try:
    write_recording({str(place(tmp_path, kind))!r}, recording, {kind!r})
except Exception as e:
    print(type(e).__name__, getattr(e, "errno", ""))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True,
                          timeout=120, check=True)
    assert done.stdout.split()[0] in ("EvflowDataError", "OSError")
    assert done.stderr == ""
    assert list(tmp_path.iterdir()) == []


@each
def test_errno_of_a_full_disk_is_ev019(
    tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(WRITERS[kind], "_write", full)
    error = refusal(place(tmp_path, kind), Recording.of_events(make(10).events), kind)
    assert error.code == "EV019"
    assert list(tmp_path.iterdir()) == []


def test_the_extension_tells_the_format(tmp_path: Path) -> None:
    events = make(20).events
    for suffix, kind in WRITTEN.items():
        assert kind == writer_of(f"a{suffix}").NAME
        assert kind == writer_of(f"a.b{suffix.upper()}" if suffix else "a").NAME
        if kind in ANY and kind != "aedat4":
            write_recording(tmp_path / f"{kind}{suffix}", Recording.of_events(events))
            equal(read_events(tmp_path / f"{kind}{suffix}"), events)
    assert set(WRITTEN.values()) | {"event_utils"} == set(WRITERS)
    for path, kind in (("a.csv", None), ("a.h5", "csv"), ("a.raw", None)):
        with pytest.raises(EvflowDataError) as raised:
            writer_of(path, kind)
        assert raised.value.code == "EV020"
        assert all(name in str(raised.value) for name in WRITERS)
    with pytest.raises(EvflowDataError, match="EV020"):
        open_writer(tmp_path / "a.h5", (0, 5))
    with pytest.raises(EvflowDataError, match=r"EV020.*path is of type NoneType"):
        write_events(None, events)


@pytest.mark.parametrize("kind", ["npz", "dsec", "event_utils", "evreal"])
def test_a_dark_part_of_float_frames_is_read_as_it_was_written(tmp_path: Path, kind: str) -> None:
    made = make(2000)
    frames = np.full((len(made.frame_times), *made.events.size[::-1]), 90, np.float32)
    frames[-2:] = 0.4
    write_recording(tmp_path / "a", Recording(made.events, frames, made.frame_times), kind)
    begin = 1e-6 * float(made.frame_times[-2] - made.events.t[0]) - 1e-5
    part = read_recording(tmp_path / "a", start_s=begin)
    np.testing.assert_array_equal(part.frames, frames[-2:])
