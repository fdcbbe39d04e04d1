"""DSEC HDF5: the layout, chunked writing, filters, data sets that lie."""

from __future__ import annotations

import itertools
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.recordings import SIZE, T0, equal, make, refused

from evflow.errors import EvflowDataError
from evflow.io import DsecWriter, read_events, read_recording, write_events, write_recording
from evflow.io.decode.hdf5 import Disk
from evflow.types import Events, Recording


@pytest.mark.parametrize("pieces", [1, 7, 300])
def test_dsec_layout_and_chunked_writing(tmp_path: Path, pieces: int,
                                         monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("evflow.io.writer.FLUSH", 500)
    events = make(3000, span=40_000).events
    cuts = np.linspace(T0, T0 + 40_000, pieces + 1).astype(int)
    with DsecWriter(tmp_path / "a.h5", SIZE) as out:
        for a, b in itertools.pairwise(cuts):
            out.append(events.slice(int(a), int(b)))
    equal(read_events(tmp_path / "a.h5"), events)
    with h5py.File(tmp_path / "a.h5") as f:
        kinds = {name: f[f"events/{name}"].dtype.str for name in "xypt"}
        assert kinds == {"x": "<u2", "y": "<u2", "p": "|u1", "t": "<u4"}
        assert f["events/t"].compression == "gzip"
        t, index = f["events/t"][:].astype(int), f["ms_to_idx"][:].astype(int)
        assert f["t_offset"][()] == events.t[0]
    assert len(index) == t[-1] // 1000 + 1
    for ms, i in enumerate(index):
        assert t[i] >= ms * 1000
        assert i == 0 or t[i - 1] < ms * 1000


def test_dsec_time_widens_past_71_minutes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("evflow.io.formats.dsec.FLUSH", 2)
    t = T0 + np.array([0, 5, 2**32 - 1, 2**32, 2**32 + 9_000])
    events = Events(np.arange(5), np.arange(5), t, np.ones(5, bool), SIZE)
    with DsecWriter(tmp_path / "a.h5", SIZE) as out:
        for i in range(5):
            out.append(events.slice(int(t[i]), int(t[i]) + 1))
    equal(read_events(tmp_path / "a.h5"), events)
    equal(read_events(tmp_path / "a.h5", start_s=4294.967296), events.slice(T0 + 2**32, T0 + 2**33))
    with h5py.File(tmp_path / "a.h5") as f:
        assert f["events/t"].dtype == np.int64
        assert sorted(f["events"]) == ["p", "t", "x", "y"]
        assert f["ms_to_idx"][-1] == 4


def test_a_range_of_a_single_event(tmp_path: Path) -> None:
    """Between neighbours as irregular as these, the range of smoothed times is empty."""
    t = np.array([0, 1000, 1001, 1002, 9000, 9001, 20_000, 20_001, 20_002, 20_003])
    events = Events(np.arange(10), np.arange(10), t, np.ones(10, bool), SIZE)
    write_events(tmp_path / "a.h5", events)
    for start in t.tolist()[1:]:
        got = read_events(tmp_path / "a.h5", start_s=start / 1e6, stop_s=(start + 1) / 1e6)
        assert got.t.tolist() == [start]
    with pytest.raises(EvflowDataError, match="EV001"):
        read_events(tmp_path / "a.h5", start_s=0.002, stop_s=0.008)


@pytest.mark.parametrize("name", ["a.h5", "a.npz"])
def test_frames_that_compress_well_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """They go to disk block by block; 64-fold is the limit of what is held in memory."""
    recording = make(200)
    frames = np.zeros((300, *SIZE[::-1]), np.uint8)
    frames[:, 3, 5] = np.arange(300) % 256
    times = recording.events.t[0] + 100 * np.arange(300)
    write_recording(tmp_path / name, Recording(recording.events, frames, times))
    monkeypatch.setattr("evflow.files.limits.FREE", 1 << 19)
    monkeypatch.setattr("evflow.files.limits.RATIO", 4)
    np.testing.assert_array_equal(read_recording(tmp_path / name).frames, frames)


def test_dsec_writer_refuses_what_does_not_follow(tmp_path: Path) -> None:
    one = make(10)
    other = Events([], [], [], [], (9, 9))
    far = Events([1], [1], [T0 + 10**12], [1], SIZE)

    def write(events: Events, frames: np.ndarray, times: np.ndarray) -> None:
        with DsecWriter(tmp_path / "a.h5", SIZE) as out:
            out.append(one.events)
            out.append_frames(one.frames, one.frame_times)
            out.append(events)
            out.append_frames(frames, times)

    none, later = Events([], [], [], [], SIZE), one.frame_times + 10**6
    for bad, code in (
        ((one.events, one.frames, later), "EV004"),
        ((other, one.frames, later), "EV015"),
        ((far, one.frames, later), "EV004"),
        ((none, one.frames, one.frame_times), "EV004"),
        ((none, one.frames.astype(np.uint16), later), "EV003"),
    ):
        with pytest.raises(EvflowDataError, match=code):
            write(*bad)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_disk_keeps_the_first_error() -> None:
    with Disk(Path("/dev/full")) as disk:
        disk.check()
        assert disk.write(b"abc") == 3  # HDF5 must not see it
        with pytest.raises(OSError, match="No space left"):
            disk.check()


@pytest.mark.parametrize("absent", ["ms_to_idx", "t_offset", None])
def test_only_dsecs_own_layout_has_dsecs_size(tmp_path: Path, absent: str | None) -> None:
    write_events(tmp_path / "a.h5", make().events)
    with h5py.File(tmp_path / "a.h5", "r+") as f:
        del f.attrs["height"]
        if absent:
            del f[absent]
    if absent:
        with pytest.raises(EvflowDataError, match=r"EV015.*--size"):
            read_recording(tmp_path / "a.h5")
    else:
        assert any("640x480" in note.text for note in read_recording(tmp_path / "a.h5").notes)
    told = read_recording(tmp_path / "a.h5", size=SIZE)
    assert told.events.size == SIZE
    assert told.notes == ()


def test_dsec_without_attributes_is_640x480(tmp_path: Path) -> None:
    write_events(tmp_path / "a.h5", make().events)
    with h5py.File(tmp_path / "a.h5", "a") as f:
        del f.attrs["width"], f.attrs["height"]
    assert read_events(tmp_path / "a.h5").size == (640, 480)
    assert read_events(tmp_path / "a.h5", size=SIZE).size == SIZE


def test_an_attribute_of_the_times_names_their_unit(tmp_path: Path) -> None:
    events = make(300).events
    with h5py.File(tmp_path / "a.h5", "w") as f:
        for name in "xyp":
            f[f"events/{name}"] = getattr(events, name)
        f["events/t"] = events.t * 1000
        f["events/t"].attrs["unit"] = "ns"
        f.attrs.update(width=SIZE[0], height=SIZE[1])
    equal(read_events(tmp_path / "a.h5"), events)
    equal(read_events(tmp_path / "a.h5", time_unit="ns"), events)


def test_dsec_folders_have_a_rectify_map_that_is_told(tmp_path: Path) -> None:
    events = make().events
    write_events(tmp_path / "events.h5", events)
    assert read_recording(tmp_path).notes == ()
    with h5py.File(tmp_path / "rectify_map.h5", "w") as f:
        f["rectify_map"] = np.zeros((480, 640, 2), np.float32)
    for path in (tmp_path, tmp_path / "events.h5"):
        recording = read_recording(path)
        np.testing.assert_array_equal(recording.events.t, events.t)
        assert "rectify_map.h5 is not applied" in recording.notes[0].text


def test_blosc_needs_hdf5plugin_which_loads_by_itself(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("hdf5plugin")
    path, events = tmp_path / "a.h5", make().events
    with h5py.File(path, "w") as f:
        import hdf5plugin
        for name in "xypt":
            values = getattr(events, name) - (T0 if name == "t" else 0)
            f.create_dataset(f"events/{name}", data=values, **hdf5plugin.Blosc(cname="zstd"))
        f["t_offset"] = T0
        f.attrs["width"], f.attrs["height"] = SIZE
    # in a fresh process, where nothing has loaded the filter
    program = f"import evflow.io, sys; print(len(evflow.io.read_events({str(path)!r})))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True,
                          timeout=120, check=True)
    assert done.stdout.strip() == "2000"
    monkeypatch.setattr(h5py.h5z, "filter_avail", lambda number: False)
    monkeypatch.setitem(sys.modules, "hdf5plugin", None)
    assert refused(path).code == "EV010"


def test_dsec_with_a_column_missing_or_lying(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    write_events(path, make().events)
    with h5py.File(path, "a") as f:
        del f["events/y"]
    assert "['y']" in str(refused(path))
    with h5py.File(path, "a") as f:
        f.create_dataset("events/y", (3,), "u2")
    assert refused(path).code == "EV009"
    with h5py.File(path, "w") as f:
        for name, dtype in (("x", "u2"), ("y", "u2"), ("p", "u1"), ("t", "i8")):
            f.create_dataset(f"events/{name}", (10**7,), dtype, chunks=(1000,))
    assert "claims (10000000,)" in str(refused(path))
    with h5py.File(path, "w") as f:
        f["images"] = 1
    assert refused(path).code == "EV008"
