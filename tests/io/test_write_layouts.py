"""What is written is what its readers elsewhere expect: published layouts, and other packages."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
import zipfile
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
from helpers.recordings import SIZE, T0, make

from evflow.io import open_writer, write_recording
from evflow.types import Recording


def test_e2vid_zip_is_one_text_that_pandas_and_numpy_read(tmp_path: Path) -> None:
    events = make(3000).events
    write_recording(tmp_path / "boxes.zip", Recording.of_events(events))
    with zipfile.ZipFile(tmp_path / "boxes.zip") as archive:
        assert archive.namelist() == ["boxes.txt"]
        lines = archive.read("boxes.txt").decode().splitlines()
    assert lines[0] == "64 48"
    t = int(events.t[0])
    assert lines[1] == (f"{t // 10**6}.{t % 10**6:06d} {events.x[0]} {events.y[0]} "
                        f"{int(events.p[0])}")
    table = np.loadtxt(lines[1:])
    np.testing.assert_array_equal(np.rint(table[:, 0] * 1e6).astype(np.int64), events.t)
    np.testing.assert_array_equal(table[:, 1:], np.stack([events.x, events.y, events.p], 1))
    write_recording(tmp_path / "boxes.txt", Recording.of_events(events))
    assert (tmp_path / "boxes.txt").read_text().splitlines() == lines


def test_event_utils_layout(tmp_path: Path) -> None:
    want = make(3000)
    write_recording(tmp_path / "a.h5", want, "event_utils")
    with h5py.File(tmp_path / "a.h5") as f:
        kinds = {name: f[f"events/{name}"].dtype.str for name in ("xs", "ys", "ts", "ps")}
        assert kinds == {"xs": "<i2", "ys": "<i2", "ts": "<f8", "ps": "|b1"}
        assert f["events/ts"].compression == "gzip"
        np.testing.assert_array_equal(np.rint(f["events/ts"][:] * 1e6), want.events.t)
        assert list(f.attrs["sensor_resolution"]) == [48, 64]
        assert f.attrs["num_events"] == f.attrs["num_pos"] + f.attrs["num_neg"] == 3000
        assert f.attrs["num_pos"] == want.events.p.sum()
        assert f.attrs["num_imgs"] == len(f["images"]) == 6
        assert f.attrs["duration"] == f.attrs["tk"] - f.attrs["t0"]
        for i, name in enumerate(sorted(f["images"])):
            image = f["images"][name]
            assert name == f"image{i:09d}"
            np.testing.assert_array_equal(image[:], want.frames[i])
            assert image.attrs["timestamp"] == want.frame_times[i] / 1e6
            before = np.searchsorted(want.events.t, want.frame_times[i])
            assert image.attrs["event_idx"] == max(before - 1, 0)


def test_evreal_layout(tmp_path: Path) -> None:
    want = make(3000)
    write_recording(tmp_path / "boxes", want)
    arrays = {p.stem: np.load(p) for p in (tmp_path / "boxes").glob("*.npy")}
    shapes = {name: (a.dtype.str, a.shape) for name, a in arrays.items()}
    assert shapes == {
        "events_ts": ("<f8", (3000,)), "events_xy": ("<i2", (3000, 2)),
        "events_p": ("|u1", (3000,)), "images": ("|u1", (6, 48, 64, 1)),
        "images_ts": ("<f8", (6, 1)), "image_event_indices": ("<i8", (6, 1))}
    np.testing.assert_array_equal(arrays["image_event_indices"][:, 0],
                                  np.searchsorted(want.events.t, want.frame_times))
    assert json.loads((tmp_path / "boxes/metadata.json").read_text()) == {
        "sensor_resolution": [48, 64]}


def test_dsec_layout_of_frames_and_index(tmp_path: Path) -> None:
    want = make(3000)
    write_recording(tmp_path / "a.h5", want)
    with h5py.File(tmp_path / "a.h5") as f:
        t, index = f["events/t"][:].astype(np.int64), f["ms_to_idx"][:]
        np.testing.assert_array_equal(t + f["t_offset"][()], want.events.t)
        for ms, i in enumerate(index.tolist()):
            assert t[i] >= 1000 * ms
            assert i == 0 or t[i - 1] < 1000 * ms
        np.testing.assert_array_equal(f["frames"][:], want.frames)
        np.testing.assert_array_equal(f["frame_times"][:], want.frame_times)


def test_npz_columns(tmp_path: Path) -> None:
    want = make(3000)
    write_recording(tmp_path / "a.npz", want)
    with np.load(tmp_path / "a.npz") as data:
        assert set(data) == {"t", "x", "y", "p", "size", "frames", "frame_times"}
        assert [data[n].dtype.str for n in "txyp"] == ["<i8", "<u2", "<u2", "|b1"]
        np.testing.assert_array_equal(data["t"], want.events.t)


def test_aedat4_by_the_aedat_package(tmp_path: Path) -> None:
    aedat = pytest.importorskip("aedat", reason="the package aedat reads AEDAT4")
    want = make(40_000)
    write_recording(tmp_path / "a.aedat4", want)
    decoder = aedat.Decoder(str(tmp_path / "a.aedat4"))
    assert decoder.id_to_stream() == {
        0: {"type": "events", "width": 64, "height": 48},
        1: {"type": "frame", "width": 64, "height": 48}}
    packets = list(decoder)
    events = np.concatenate([p["events"] for p in packets if "events" in p])
    for name in "txy":
        np.testing.assert_array_equal(events[name], getattr(want.events, name))
    np.testing.assert_array_equal(events["on"], want.events.p)
    frames = [p["frame"] for p in packets if "frame" in p]
    for frame, pixels, t in zip(frames, want.frames, want.frame_times, strict=True):
        np.testing.assert_array_equal(frame["pixels"], pixels)
        assert {frame[n] for n in ("t", "begin_t", "end_t", "exposure_begin_t",
                                   "exposure_end_t")} == {int(t)}
        assert frame["format"] == "L"


def test_where_exposure_and_white_are_written(tmp_path: Path) -> None:
    made = make(3000)
    want = dataclasses.replace(
        made, frames=made.frames.astype(np.uint16), exposure_us=4001, full_scale=4095)
    for name, kind in (("a.h5", "dsec"), ("b.h5", "event_utils"), ("a.npz", "npz"),
                       ("folder", "evreal")):
        write_recording(tmp_path / name, want, kind)
    with h5py.File(tmp_path / "a.h5") as f:
        assert dict(f["frame_times"].attrs) == {"exposure_us": 4001}
        assert dict(f["frames"].attrs) == {"full_scale": 4095}
    with h5py.File(tmp_path / "b.h5") as f:
        for name, value in (("exposure_us", 4001), ("full_scale", 4095)):
            assert {image.attrs[name] for image in f["images"].values()} == {value}
    with np.load(tmp_path / "a.npz") as data:
        assert (data["exposure_us"].shape, int(data["exposure_us"])) == ((), 4001)
        assert (data["full_scale"].shape, int(data["full_scale"])) == ((), 4095)
    assert json.loads((tmp_path / "folder/metadata.json").read_text()) == {
        "sensor_resolution": [48, 64], "exposure_us": 4001, "full_scale": 4095}


def test_aedat4_s_exposure_by_the_aedat_package(tmp_path: Path) -> None:
    aedat = pytest.importorskip("aedat", reason="the package aedat reads AEDAT4")
    want = dataclasses.replace(make(3000), exposure_us=4001)
    write_recording(tmp_path / "a.aedat4", want)
    frames = [p["frame"] for p in aedat.Decoder(str(tmp_path / "a.aedat4")) if "frame" in p]
    for frame, t in zip(frames, want.frame_times.tolist(), strict=True):
        assert (frame["t"], frame["exposure_begin_t"], frame["exposure_end_t"]) == (
            t, t - 2000, t + 2001)
        assert (frame["begin_t"], frame["end_t"]) == (t - 2000, t + 2001)


@pytest.mark.parametrize("n", [0, 1, 50_000])
def test_aedat4_ends_with_a_table_of_its_packets(tmp_path: Path, n: int) -> None:
    """The FlatBuffers by hand: each vector is aligned to 8, and the table leads to the packets."""
    want = make(max(n, 1))
    events = want.events.slice(T0, T0 + 10**6 * min(n, 1))
    with open_writer(tmp_path / "a.aedat4", SIZE) as out:
        out.append(events)
        if n > 1:
            out.append_frames(want.frames, want.frame_times)
    data = (tmp_path / "a.aedat4").read_bytes()

    def u32(at: int) -> int:
        return int.from_bytes(data[at : at + 4], "little")

    def field(table: int, slot: int) -> int:
        vtable = table - u32(table)
        return table + int.from_bytes(data[vtable + 4 + 2 * slot : vtable + 6 + 2 * slot], "little")

    def vector(root: int, slot: int) -> tuple[int, int]:
        """Its first element and its length; root: the byte of the buffer's size."""
        pointer = field(root + 4 + u32(root + 4), slot)
        first = pointer + u32(pointer) + 4
        assert (first - root) % 8 == 0
        return first, u32(first - 4)

    header = 14
    table = int.from_bytes(data[field(header + 4 + u32(header + 4), 1) :][:8], "little")
    assert data[table + 8 : table + 12] == b"FTAB"
    assert table + 4 + u32(table) == len(data)
    first, count = vector(table, 0)
    place, found = header + 4 + u32(header), []
    for i in range(count):
        entry = first + 4 * i + u32(first + 4 * i)
        assert (entry - table) % 8 == 0
        byte, rows, begin, end = (
            int.from_bytes(data[field(entry, s) :][:8], "little") for s in (0, 2, 3, 4))
        stream, size = u32(field(entry, 1)), u32(field(entry, 1) + 4)
        assert (byte, stream, size) == (place + 8, u32(place), u32(place + 4))
        elements, length = vector(byte, 10 if stream else 0)
        if stream == 0:
            t = np.frombuffer(data, "<i8", 2 * length, elements)[::2]
            assert (rows, begin, end) == (length, t[0], t[-1])
            found.append(t)
        place = byte + size
    assert place == table
    np.testing.assert_array_equal(np.concatenate([np.zeros(0, int), *found]), events.t)


def test_aedat4_cut_off_is_noticed(tmp_path: Path) -> None:
    pytest.importorskip("aedat", reason="the package aedat reads AEDAT4")
    from helpers.recordings import refused

    path = tmp_path / "a.aedat4"
    write_recording(path, make(40_000))
    data = path.read_bytes()
    packet = data.index(b"EVTS", 3000) - 16  # where the second packet begins: a clean cut
    for end in (packet, packet + 5, len(data) * 2 // 3):
        path.write_bytes(data[:end])
        assert refused(path).code == "EV009"


def test_by_other_packages_where_they_are_installed(tmp_path: Path) -> None:
    """evlib (Rust) reads DSEC and AEDAT4, dv-processing AEDAT4; in processes of their own."""
    want = make(5000)
    write_recording(tmp_path / "a.h5", want)
    write_recording(tmp_path / "a.aedat4", want)
    evlib = """
import evlib
for name in ("a.h5", "a.aedat4"):
    table = evlib.load_events({0!r} + "/" + name).collect()
    on = int((table["polarity"] > 0).sum())
    print(len(table), int(table["x"].sum()), int(table["y"].sum()), on)
"""
    dv = """
import dv_processing as dv
reader = dv.io.MonoCameraRecording({0!r} + "/a.aedat4")
n = x = y = on = 0
while (batch := reader.getNextEventBatch()) is not None:
    rows = batch.numpy()
    n, x, y = n + len(rows), x + int(rows["x"].sum()), y + int(rows["y"].sum())
    on += int(rows["polarity"].sum())
print(n, x, y, on)
"""
    e, ran = want.events, 0
    expected = f"{len(e)} {e.x.sum()} {e.y.sum()} {e.p.sum()}"
    for program in (evlib, dv):
        done = subprocess.run(
            [sys.executable, "-W", "ignore", "-c", program.format(str(tmp_path))],
            capture_output=True, text=True, timeout=120, check=False)
        if "ModuleNotFoundError" in done.stderr:
            continue
        assert set(done.stdout.splitlines()) == {expected}, done.stderr
        ran += 1
    if not ran:
        pytest.skip("neither evlib nor dv-processing is installed")


def test_frames_are_pictures_in_the_right_order(tmp_path: Path) -> None:
    """A picture keeps its rows and columns through every format that holds one."""
    picture = cv2.resize(np.eye(7, dtype=np.uint8) * 200, SIZE)
    picture[:5] = 90
    want = Recording(make(10).events, picture[None], np.array([T0 + 1]))
    from evflow.io import read_recording

    for name in ("a.h5", "a.npz", "a.aedat4", "folder"):
        if name == "a.aedat4":
            pytest.importorskip("aedat", reason="the package aedat reads AEDAT4")
        write_recording(tmp_path / name, want)
        np.testing.assert_array_equal(read_recording(tmp_path / name).frames[0], picture)
