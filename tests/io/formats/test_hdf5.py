"""HDF5 of other layouts: M3ED, RVT, e2calib, compounds, N x 4; and what is said where none fits."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from helpers.recordings import SIZE, equal, make, refused

from evflow.errors import EvflowDataError
from evflow.io import read_events, read_recording
from evflow.io.registry import find_format
from evflow.io.source import open_frames
from evflow.types import Events

EVENTS = make(300, 0).events
COLUMNS = {"x": EVENTS.x, "y": EVENTS.y, "t": EVENTS.t, "p": EVENTS.p.astype(np.uint8)}
SIGNED = np.where(EVENTS.p, 1, -1).astype(np.int8)


def group(place: Any, names: str = "x y t p", **changed: Any) -> None:
    for name, column in zip(names.split(), "xytp", strict=True):
        place.create_dataset(name, data=changed.get(column, COLUMNS[column]))


def rvt(f: Any) -> None:
    group(f.create_group("events"))
    f["events/width"], f["events/height"], f["events/divider"] = *SIZE, 10**6


def m3ed(f: Any) -> None:
    for side in ("right", "left"):
        group(f.create_group(f"prophesee/{side}"), y=EVENTS.y * (side == "left"))
        f[f"prophesee/{side}/calib/resolution"] = SIZE
        f[f"prophesee/{side}/ms_map_idx"] = np.arange(9)
    f["ovc/left/data"] = np.zeros((3, 4, 5, 1), np.uint8)


def flat(f: Any) -> None:
    group(f)
    f.attrs["sensor_resolution"] = SIZE[::-1]


def words(f: Any) -> None:
    group(f.create_group("cam0/dvs"), "x y timestamp polarity", p=SIGNED)
    f["cam0/dvs"].attrs.update(width=SIZE[0], height=SIZE[1])


def nanoseconds(f: Any) -> None:
    group(f.create_group("events"), "xs ys t_ns ps", t=EVENTS.t * 1000)
    f.attrs["geometry"] = "64x48"


def milliseconds(f: Any) -> None:
    group(f, "u v time pol", t=EVENTS.t / 1e3)
    f["time"].attrs["units"] = b"ms"
    f["resolution"] = SIZE


def eventcv(f: Any) -> None:
    group(f, t=EVENTS.t * 1000)
    f.attrs.update(width=SIZE[0], height=SIZE[1], timestamp_scale_ms=1e-6)


def eventcv_group(f: Any) -> None:
    group(f.create_group("events"), t=EVENTS.t * 1000)
    f.attrs.update(width=SIZE[0], height=SIZE[1], timestamp_scale_ms=1e-6)


def offset(f: Any) -> None:
    group(f.create_group("dvs"), t=(EVENTS.t - EVENTS.t[0]).astype(np.uint32))
    f["dvs/t_offset"] = EVENTS.t[0]
    f["dvs/size"] = SIZE


def offset_in_ns(f: Any) -> None:
    """The offset has the unit of the times."""
    group(f.create_group("dvs"), t=(EVENTS.t - EVENTS.t[0]) * 1000)
    f["dvs/t"].attrs["unit"] = "ns"
    f["dvs/t_offset"] = EVENTS.t[0] * 1000
    f["dvs/size"] = SIZE


def compound(f: Any) -> None:
    kind = [("t", "i8"), ("x", "u2"), ("y", "u2"), ("on", "?")]
    f["events"] = np.array(list(zip(EVENTS.t, EVENTS.x, EVENTS.y, EVENTS.p, strict=True)), kind)
    f["events"].attrs["unit"] = "us"
    f.attrs["width"], f.attrs["height"] = SIZE


def matrix(f: Any) -> None:
    """MVSEC's order at the root, whole us in floats."""
    f["events"] = np.stack([EVENTS.x, EVENTS.y, EVENTS.t, SIGNED], 1).astype(np.float64)
    f.attrs["resolution"] = SIZE


def xypt(f: Any) -> None:
    """v2e's place and integers, in Prophesee's order."""
    f["events"] = np.stack([EVENTS.x, EVENTS.y, EVENTS.p, EVENTS.t], 1).astype(np.int64)
    f["frame"] = np.zeros((1, 48, 64), np.uint8)
    f["frame_ts"] = EVENTS.t[:1]


def across(f: Any) -> None:
    f["davis240/all"] = np.stack([EVENTS.t, EVENTS.x, EVENTS.y, EVENTS.p])
    f.attrs["resolution"] = SIZE


LAYOUTS: dict[str, Callable[[Any], None]] = {make.__name__: make for make in (
    rvt, m3ed, flat, words, nanoseconds, milliseconds, eventcv, eventcv_group, offset,
    offset_in_ns, compound, matrix, xypt, across)}


def write(folder: Path, kind: str) -> Path:
    with h5py.File(folder / "a.h5", "w") as f:
        LAYOUTS[kind](f)
    return folder / "a.h5"


@pytest.mark.parametrize("kind", LAYOUTS)
def test_layouts(tmp_path: Path, kind: str) -> None:
    path = write(tmp_path, kind)
    name = find_format(path).NAME
    other = {"rvt": "dsec", "eventcv_group": "dsec", "xypt": "v2e"}
    assert name == other.get(kind, "hdf5")
    found = read_recording(path)
    equal(found.events, EVENTS)
    first = int(EVENTS.t[0])
    part = read_events(path, start_s=0.1, stop_s=0.2)
    equal(part, EVENTS.slice(first + 10**5, first + 2 * 10**5))
    codes = {"m3ed": ["sensor.camera"], "matrix": ["events.layout"], "across": ["events.layout"],
             "xypt": ["events.layout"]}
    assert [note.code for note in found.notes] == codes.get(kind, [])


def test_the_camera_that_was_read_is_named(tmp_path: Path) -> None:
    note, = read_recording(write(tmp_path, "m3ed")).notes
    assert "/prophesee/left were read; not read: /prophesee/right" in note.text


def test_other_layouts_are_listed_and_the_advice_holds(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as f:
        group(f.create_group("raw"), "column_index line stamp sign")
        f["raw/gyro"] = np.zeros((7, 3))
        f["elsewhere"] = h5py.ExternalLink("/etc/passwd", "/x")
    error = refused(path, size=SIZE)
    assert error.code == "EV008"
    for seen in ("/raw/column_index uint16 (300,)", "/raw/stamp int64", "/raw/gyro float64 (7, 3)"):
        assert seen in error.seen
    with h5py.File(path, "a") as f:
        for name, old in zip("xytp", ("column_index", "line", "stamp", "sign"), strict=True):
            f[f"events/{name}"] = f[f"raw/{old}"]
    equal(read_events(path, size=SIZE), EVENTS)


@pytest.mark.parametrize(("change", "code", "seen"), [
    ({"t": EVENTS.t[::-1]}, "EV004", "goes back"),
    ({"x": np.full(300, 64)}, "EV005", "outside 64x48"),
    ({"x": EVENTS.x / 7}, "EV003", "undistorted"),
    ({"p": np.full(300, 255, np.uint8)}, "EV006", "255"),
    ({"t": np.full(300, np.nan)}, "EV007", "nan"),
    ({"p": COLUMNS["p"][:-1]}, "EV008", "/p uint8 (299,)")])
def test_values_that_cannot_be(tmp_path: Path, change: Any, code: str, seen: str) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as f:
        group(f, **change)
    error = refused(tmp_path / "a.h5", size=SIZE)
    assert error.code == code
    assert seen in str(error)


def test_a_matrix_that_is_none_of_events(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as f:
        f["poses"] = np.random.default_rng(0).normal(size=(50, 4))
    assert refused(tmp_path / "a.h5", size=SIZE).code == "EV008"


@pytest.mark.parametrize("channels", [(), (1,)])
def test_images_without_events_become_a_stack_as_the_message_says(
    tmp_path: Path, channels: tuple[int, ...]
) -> None:
    path, frames = tmp_path / "a.h5", np.arange(3 * 48 * 64, dtype=np.uint8).reshape(3, 48, 64)
    with h5py.File(path, "w") as f:
        f["cam/images"], f["cam/ts"] = frames.reshape(3, *channels, 48, 64), [0, 40_000, 80_000]
    fix = refused(path).fix
    with h5py.File(path) as f:
        exec(fix[fix.index("np.savez"): fix.index(" with f =")].replace("'a.npz'", "out"),
             {"np": np, "f": f, "out": tmp_path / "a.npz"})
    found = open_frames(tmp_path / "a.npz", response="linear").open()
    np.testing.assert_array_equal([frame for frame, _ in found], frames)


def test_no_event_at_all(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as f:
        group(f, **{name: column[:0] for name, column in COLUMNS.items()})
    equal(read_events(tmp_path / "a.h5", size=SIZE), Events([], [], [], [], SIZE))


@pytest.mark.parametrize("place", ["", "cam/", "cam/events/"])
def test_an_offset_of_the_times_may_be_of_a_group_around_them(tmp_path: Path, place: str) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as f:
        for name, column in {"x": [1, 2], "y": [3, 4], "t": [0, 5], "p": [0, 1]}.items():
            f[f"cam/events/{name}"] = np.array(column)
        f[f"{place}t_offset"] = np.int64(7_000_000)
        f["cam"].attrs["resolution"] = (64, 48)
    assert read_recording(tmp_path / "a.h5").events.t.tolist() == [7_000_000, 7_000_005]


@pytest.mark.parametrize("names", ["x y t p", "xs ys ts ps"])
def test_a_second_camera_beside_the_usual_one_is_read_by_its_name(
    tmp_path: Path, names: str
) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as f:
        for group, first in (("events", 0), ("right", 100)):
            for name, column in zip(names.split(), ([1, 2], [3, 4], [0, 5], [0, 1]), strict=True):
                f[f"{group}/{name}"] = np.array(column) + first * (name in ("t", "ts"))
        f.attrs["sensor_resolution"] = (48, 64)
    path = tmp_path / "a.h5"
    assert read_recording(path).events.t.tolist() == [0, 5]
    assert read_recording(path, events_topic="right").events.t.tolist() == [100, 105]
    with pytest.raises(EvflowDataError, match=r"EV020.*left.*There are: /events, /right"):
        read_recording(path, events_topic="left")
