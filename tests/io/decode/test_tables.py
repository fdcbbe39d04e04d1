"""Events in tables (v2e, MVSEC, event_utils, E2VID, EVREAL, EVIMO2): what plain code writes comes
back exactly, over block borders; damage only raises data errors.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.recordings import SIZE, damage, equal, refused
from helpers.streams import survives
from helpers.tables import each, hint, want, write

from evflow.io import read_events, read_recording
from evflow.io.decode import tables
from evflow.io.registry import find_format
from evflow.notes import Note


@each
@pytest.mark.parametrize("block", [13, 700, 1 << 20])
def test_round_trip_over_block_borders(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, block: int
) -> None:
    monkeypatch.setattr("evflow.io.decode.tables.ROWS", block)
    monkeypatch.setattr("evflow.io.decode.text.BLOCK", 50 * block)
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
    assert "a block of" in str(refused(edited(path, lambda f: claim(f, 10, 10**8))))


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
    assert got.notes == (Note("sensor.camera", "the right camera was read"),)
    assert not got.has_frames


def test_event_utils_sizes_and_colour(tmp_path: Path) -> None:
    """Without images the order of sensor_resolution is that in which all events fit."""
    path = edited(write(tmp_path, "event_utils"), lambda f: f.pop("images"))
    assert read_recording(path).notes == ()
    swapped = edited(path, lambda f: f.attrs.__setitem__("sensor_resolution", SIZE))
    got = read_recording(swapped)
    assert got.events.size == SIZE
    assert "taken as (width, height)" in got.notes[0].text
    assert refused(edited(path, lambda f: f.attrs.pop("sensor_resolution"))).code == "EV015"
    path = write(tmp_path, "event_utils")
    blue = np.zeros((48, 64, 3), np.uint8)
    blue[..., 0] = 200  # OpenCV's first channel

    def colour(f: h5py.File) -> None:
        time = f["images/image000000000"].attrs["timestamp"]
        del f["images"]
        f["images/image000000000"] = blue
        f["images/image000000000"].attrs["timestamp"] = time

    assert read_recording(edited(path, colour)).frames[0, 0, 0] == round(200 * 0.114)
