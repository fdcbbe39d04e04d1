"""Events in tables (v2e, MVSEC, event_utils, E2VID, EVREAL, EVIMO2): what plain code writes comes
back exactly, over block borders; damage only raises data errors.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from recordings import SIZE, T0, damage, equal, make, refused
from test_io_stream import survives

from evflow.io import read_events, read_recording, tables
from evflow.io.base import find_format
from evflow.types import Events, Recording

DAVIS = (346, 260)
BASE = {"v2e": T0, "v2e-text": T0, "e2vid": T0, "evreal": T0, "evimo2": T0}
# the epoch of MVSEC, 1.5e9 s, leaves float64 0.24 us: still the right microsecond


def based(recording: Recording, zero: int, size: tuple[int, int] = SIZE) -> Recording:
    ev = recording.events
    frames = np.zeros((len(recording.frames), size[1], size[0]), np.uint8)
    frames[:, : SIZE[1], : SIZE[0]] = recording.frames
    return Recording(Events(ev.x, ev.y, ev.t - zero, ev.p, size), frames,
                     recording.frame_times - zero)


def want(kind: str, n: int = 2000) -> Recording:
    """What the file written by `write(..., kind)` must read as."""
    recording = based(make(n), BASE.get(kind, 0), DAVIS if kind == "mvsec" else SIZE)
    return recording if kind in ("v2e", "mvsec", "event_utils", "evreal") else Recording.of_events(
        recording.events)


def rows(recording: Recording) -> list[tuple[int, int, int, int]]:
    ev = recording.events
    return [(int(t), int(x), int(y), int(p))
            for t, x, y, p in zip(ev.t, ev.x, ev.y, ev.p, strict=True)]


def write_v2e(folder: Path, r: Recording) -> Path:
    with h5py.File(folder / "a.h5", "w", libver=("v110", "v110")) as f:
        f.create_dataset("events", data=np.array(rows(r), "u4").reshape(-1, 4), compression="gzip")
        f.create_dataset("frame", data=r.frames, compression="gzip")
        f["frame_ts"] = r.frame_times.astype("u4")
        f["frame_idx"] = np.zeros(len(r.frames), "u8")
    return folder / "a.h5"


def write_mvsec(folder: Path, r: Recording) -> Path:
    table = [(x, y, t / 1e6, 2.0 * p - 1) for t, x, y, p in rows(r)]
    with h5py.File(folder / "a.hdf5", "w", libver=("v110", "v110")) as f:
        f["davis/left/events"] = np.array(table, float).reshape(-1, 4)
        f.create_dataset("davis/left/image_raw", data=r.frames, compression="gzip")
        f["davis/left/image_raw_ts"] = r.frame_times / 1e6
        f["davis/right/imu"] = np.zeros(3)
    return folder / "a.hdf5"


def write_event_utils(folder: Path, r: Recording) -> Path:
    with h5py.File(folder / "a.h5", "w", libver=("v110", "v110")) as f:
        f["events/xs"], f["events/ys"] = r.events.x, r.events.y
        f["events/ts"], f["events/ps"] = r.events.t / 1e6, r.events.p
        for i, (frame, t) in enumerate(zip(r.frames, r.frame_times, strict=True)):
            f[f"images/image{i:09d}"] = frame
            f[f"images/image{i:09d}"].attrs["timestamp"] = t / 1e6
        f.attrs["sensor_resolution"] = (SIZE[1], SIZE[0])
    return folder / "a.h5"


def write_text(folder: Path, r: Recording) -> Path:
    lines = ["#!events.txt", "# This is a text DVS created by v2e", "# User name: a"]
    lines += [f"{t / 1e6} {x} {y} {p} {x % 2}" for t, x, y, p in rows(r)]
    (folder / "a.txt").write_text("\n".join(lines) + "\n")
    return folder / "a.txt"


def write_csv(folder: Path, r: Recording) -> Path:
    lines = ["polarity,timestamp_us,x,y", *(f"{p},{t},{x},{y}" for t, x, y, p in rows(r))]
    (folder / "a.csv").write_text("\n".join(lines) + "\n")
    return folder / "a.csv"


def write_e2vid(folder: Path, r: Recording) -> Path:
    lines = [f"{r.events.size[0]} {r.events.size[1]}"]
    lines += [f"{t / 1e6:.9f} {x} {y} {p}" for t, x, y, p in rows(r)]
    with zipfile.ZipFile(folder / "a.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("dynamic_6dof.txt", "\n".join(lines) + "\n")
    return folder / "a.zip"


def write_evreal(folder: Path, r: Recording) -> Path:
    folder = folder / "boxes"
    folder.mkdir(exist_ok=True)
    np.save(folder / "events_ts.npy", r.events.t / 1e6)
    np.save(folder / "events_xy.npy", np.stack([r.events.x, r.events.y], 1))
    np.save(folder / "events_p.npy", r.events.p.astype(np.uint8))
    np.save(folder / "images.npy", r.frames[..., None])
    np.save(folder / "images_ts.npy", r.frame_times[:, None] / 1e6)
    (folder / "metadata.json").write_text(json.dumps({"sensor_resolution": [SIZE[1], SIZE[0]]}))
    return folder


def write_evimo2(folder: Path, r: Recording) -> Path:
    folder = folder / "samsung_mono/imo/eval/scene_00"
    folder.mkdir(parents=True, exist_ok=True)
    np.save(folder / "dataset_events_t.npy", r.events.t[:, None] / 1e6)
    np.save(folder / "dataset_events_xy.npy", np.stack([r.events.x, r.events.y], 1))
    np.save(folder / "dataset_events_p.npy", 1 - r.events.p.astype(np.int16)[:, None])
    return folder


WRITERS: dict[str, Callable[[Path, Recording], Path]] = {
    "v2e": write_v2e, "mvsec": write_mvsec, "event_utils": write_event_utils,
    "v2e-text": write_text, "text": write_csv, "e2vid": write_e2vid, "evreal": write_evreal,
    "evimo2": write_evimo2}
each = pytest.mark.parametrize("kind", WRITERS)


def write(folder: Path, kind: str, n: int = 2000) -> Path:
    recording = based(make(n), BASE.get(kind, 0), DAVIS if kind == "mvsec" else SIZE)
    return WRITERS[kind](folder, recording)


def hint(kind: str) -> dict[str, tuple[int, int]]:
    return {"size": SIZE} if kind in ("v2e-text", "text", "evimo2") else {}


@each
@pytest.mark.parametrize("block", [13, 700, 1 << 20])
def test_round_trip_over_block_borders(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, block: int
) -> None:
    monkeypatch.setattr("evflow.io.tables.ROWS", block)
    monkeypatch.setattr("evflow.io.text.BLOCK", 50 * block)
    path = write(tmp_path, kind)
    assert kind == find_format(path).NAME
    got, expected = read_recording(path, **hint(kind)), want(kind)
    equal(got.events, expected.events)
    np.testing.assert_array_equal(got.frames, expected.frames)
    np.testing.assert_array_equal(got.frame_times, expected.frame_times)


@each
def test_hints(tmp_path: Path, kind: str) -> None:
    path, whole = write(tmp_path, kind), want(kind)
    first = int(whole.events.t[0])
    part = read_recording(path, start_s=0.1, stop_s=0.2, **hint(kind))
    equal(part.events, whole.events.slice(first + 100_000, first + 200_000))
    kept = (whole.frame_times >= first + 100_000) & (whole.frame_times < first + 200_000)
    np.testing.assert_array_equal(part.frames, whole.frames[kept])
    np.testing.assert_array_equal(part.frame_times, whole.frame_times[kept])
    inverted = read_events(path, polarity="invert", **hint(kind))
    np.testing.assert_array_equal(inverted.p, ~whole.events.p)
    assert "0.000 to 0.299 s" in str(refused(path, start_s=7, **hint(kind)))
    assert refused(path, size=(60, 40)).code in ("EV005", "EV015")
    wrong = "01" if kind == "mvsec" else "pm1"
    if kind not in ("event_utils",):  # there polarity is bool
        assert refused(path, polarity=wrong, **hint(kind)).code == "EV006"


@each
def test_no_events_are_a_silent_camera(tmp_path: Path, kind: str) -> None:
    assert len(read_events(write(tmp_path, kind, 0), **hint(kind))) == 0


@each
def test_damaged_copies_only_raise_data_errors(tmp_path: Path, kind: str) -> None:
    path = write(tmp_path, kind, 400)
    target = path if path.is_file() else next(iter(sorted(path.glob("*events_xy.npy"))))
    damage(target, 200, lambda: survives(path, **hint(kind)))


def edited(path: Path, edit: Callable[[h5py.File], object]) -> Path:
    with h5py.File(path, "a") as f:
        edit(f)
    return path


def changed(name: str, row: int, column: int, value: float) -> Callable[[h5py.File], None]:
    def edit(f: h5py.File) -> None:
        f[name][row, column] = value

    return edit


@pytest.mark.parametrize(("kind", "edit", "code", "seen"), [
    ("v2e", changed("events", 700, 1, 64), "EV005", "x=64"),
    ("v2e", changed("events", 700, 0, 0), "EV004", "event 700"),
    ("v2e", changed("events", 700, 3, 2**32 - 1), "EV006", "p is 4294967295 at event 700"),
    ("v2e", lambda f: f.pop("frame_ts"), "EV008", "frame_ts"),
    ("mvsec", changed("davis/left/events", 700, 0, 12.5), "EV003", "event 700"),
    ("mvsec", changed("davis/left/events", 700, 3, 0.5), "EV006", "p is 0.5 at event 700"),
    ("mvsec", changed("davis/left/events", 700, 1, np.nan), "EV007", "y is nan at event 700"),
    ("mvsec", changed("davis/left/events", 700, 2, np.inf), "EV007", "t is inf at event 700"),
    ("mvsec", lambda f: f["davis/left"].pop("events"), "EV008", "*_data.hdf5"),
    ("mvsec", lambda f: f["davis/left"].pop("image_raw_ts"), "EV008", "image_raw_ts"),
    ("event_utils", lambda f: f["events"].pop("ps"), "EV008", "'ps'"),
    ("event_utils", lambda f: f["images/image000000001"].attrs.pop("timestamp"), "EV008",
     "timestamp")])
def test_contents_that_cannot_be_right(
    tmp_path: Path, kind: str, edit: Callable[[h5py.File], object], code: str, seen: str
) -> None:
    error = refused(edited(write(tmp_path, kind), edit))
    assert error.code == code
    assert seen in str(error)


@pytest.mark.parametrize("kind", ["v2e", "mvsec", "event_utils"])
def test_claims_beyond_the_file(tmp_path: Path, kind: str) -> None:
    name = {"v2e": "events", "mvsec": "davis/left/events", "event_utils": "events/xs"}[kind]

    def claim(f: h5py.File, shape: int, chunk: int) -> None:
        width = (4,) if kind != "event_utils" else ()
        del f[name]
        f.create_dataset(
            name, (shape, *width), "f8", chunks=(chunk, *width), maxshape=(None, *width))

    path = write(tmp_path, kind, 10)
    assert "claims" in str(refused(edited(path, lambda f: claim(f, 10**9, 1000))))
    assert "claims blocks" in str(refused(edited(path, lambda f: claim(f, 10, 10**8))))


def test_blocks_of_hdf5_are_each_read_once(tmp_path: Path) -> None:
    """A block beyond HDF5's cache of 1 MiB would be decoded again by every part read of it."""
    assert [c.t.tolist() for c in tables.blocks(5, numbers, 1 << 20)] == [[0, 1, 2, 3, 4]]
    steps = [len(c.t) for c in tables.blocks(100_000, numbers, 10_000)]
    assert steps == [30_000, 30_000, 30_000, 10_000]
    path = write(tmp_path, "v2e")

    def rechunk(f: h5py.File) -> None:
        data = f["events"][:]
        del f["events"]
        f.create_dataset("events", data=data, chunks=(700, 3), compression="gzip")

    equal(read_events(edited(path, rechunk)), want("v2e").events)


def numbers(part: slice) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    values = np.arange(part.start, part.stop)
    return values, values, values, values


def test_v2e_without_frames(tmp_path: Path) -> None:
    path = edited(write(tmp_path, "v2e"), lambda f: [f.pop(k) for k in ("frame", "frame_ts")])
    assert refused(path).code == "EV015"
    equal(read_events(path, size=SIZE), want("v2e").events)


def test_mvsec_right_camera(tmp_path: Path) -> None:
    path = edited(write(tmp_path, "mvsec"), lambda f: (f.move("davis/left", "davis/other"),
                                                       f.move("davis/other", "davis/right/x")))
    assert refused(path).code == "EV008"
    path = edited(path, lambda f: f.copy("davis/right/x/events", "davis/right/events"))
    got = read_recording(path)
    equal(got.events, want("mvsec").events)
    assert got.notes == ("the right camera was read",)
    assert not got.has_frames


def test_event_utils_sizes_and_colour(tmp_path: Path) -> None:
    """Without images the order of sensor_resolution is that in which all events fit."""
    path = edited(write(tmp_path, "event_utils"), lambda f: f.pop("images"))
    assert read_recording(path).notes == ()
    swapped = edited(path, lambda f: f.attrs.__setitem__("sensor_resolution", SIZE))
    got = read_recording(swapped)
    assert got.events.size == SIZE
    assert "taken as (width, height)" in got.notes[0]
    assert refused(edited(path, lambda f: f.attrs.pop("sensor_resolution"))).code == "EV015"
    path = write(tmp_path, "event_utils")
    blue = np.zeros((48, 64, 3), np.uint8)
    blue[..., 0] = 200  # OpenCV's first channel

    def colour(f: h5py.File) -> None:
        time = f["images/image000000000"].attrs["timestamp"]
        del f["images"]
        f["images/image000000000"] = blue
        f["images/image000000000"].attrs["timestamp"] = time

    assert read_recording(edited(path, colour)).frames[0, 0, 0] == pytest.approx(200 * 0.0722)
