"""Images under other names beside the events of HDF5 and npz, and columns in odd shapes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from helpers.recordings import SIZE, T0, equal, make, refused
from helpers.tables import based

from evflow.io import read_recording
from evflow.io.decode.images_beside import times_of

SOUND = based(make(500), T0)
E, FRAMES, TIMES = SOUND.events, SOUND.frames, SOUND.frame_times
COLUMNS = {"x": E.x, "y": E.y, "t": E.t, "p": E.p}
EXPOSED = np.stack([TIMES - 3000, TIMES + 3000], 1)
RGB = np.stack([FRAMES] * 3, -1)

BESIDE: dict[str, dict[str, Any]] = {
    "usual names": {"images": FRAMES, "image_ts": TIMES},
    "in a group": {"frames/data": FRAMES, "frames/t": TIMES},
    "times one above": {"cam/left/data": FRAMES, "cam/ts": TIMES},
    "the nearer name": {"images": FRAMES, "image_times": TIMES, "pose_times": TIMES + 7},
    "seconds": {"images": FRAMES, "image_timestamps": TIMES / 1e6},
    "nanoseconds": {"images": FRAMES, "stamps_ns": TIMES * 1000},
    "begin and end": {"images": FRAMES, "exposure_timestamps": EXPOSED},
    "one channel": {"images": FRAMES[..., None], "image_ts": TIMES[:, None]},
    "colour": {"images": RGB, "image_ts": TIMES},
    "one channel first": {"images": FRAMES[:, None], "image_ts": TIMES},
    "colour first": {"images": np.moveaxis(RGB, -1, 1), "image_ts": TIMES},
    "wide integers": {"images": FRAMES.astype(np.int64), "image_ts": TIMES},
    "float64": {"images": FRAMES.astype(float), "image_ts": TIMES},
    "big-endian": {"images": FRAMES.astype(">u2"), "image_ts": TIMES.astype(">i8")}}


def h5(events: str) -> Callable[[Path, dict[str, Any]], Path]:
    """Writes arrays and the events, in columns x, y, t, p of those names."""
    def write(folder: Path, arrays: dict[str, Any]) -> Path:
        with h5py.File(folder / "a.h5", "w") as f:
            for name, old in zip(events.split(), "xytp", strict=True):
                f[name] = COLUMNS[old]
            for name, array in arrays.items():
                f[name] = array
            f.attrs["resolution" if "xs" not in events else "sensor_resolution"] = (
                SIZE if "xs" not in events else SIZE[::-1])
        return folder / "a.h5"
    return write


def npz(folder: Path, arrays: dict[str, Any]) -> Path:
    np.savez(folder / "a.npz", size=SIZE, **({**COLUMNS} | arrays))
    return folder / "a.npz"


LAYOUTS = [h5("x y t p"), h5("events/x events/y events/t events/p"),
           h5("events/xs events/ys events/ts events/ps"), npz]


@pytest.mark.parametrize("write", LAYOUTS)
@pytest.mark.parametrize("kind", BESIDE)
def test_images_of_other_names_are_the_frames(
    tmp_path: Path, write: Callable[[Path, dict[str, Any]], Path], kind: str
) -> None:
    found = read_recording(write(tmp_path, BESIDE[kind]))
    equal(found.events, E)
    np.testing.assert_array_equal(found.frames, FRAMES)
    np.testing.assert_array_equal(found.frame_times, TIMES)
    assert "frames are from" in found.notes[0].text


def test_colours_are_red_green_and_blue_wherever_their_axis_is(tmp_path: Path) -> None:
    colour = np.stack([FRAMES, FRAMES // 2, 255 - FRAMES], -1)
    last, first = (read_recording(npz(tmp_path, {"images": images, "image_ts": TIMES})).frames
                   for images in (colour, np.moveaxis(colour, -1, 1)))
    np.testing.assert_array_equal(first, last)
    assert not np.array_equal(last, FRAMES)


@pytest.mark.parametrize("kind", BESIDE)
def test_events_in_rows_of_four_have_images_beside_them(tmp_path: Path, kind: str) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as f:
        f["events"] = np.stack([E.x, E.y, E.t, E.p], 1).astype(np.int32)
        for name, array in BESIDE[kind].items():
            f[name] = array
    found = read_recording(tmp_path / "a.h5", size=SIZE)
    equal(found.events, E)
    np.testing.assert_array_equal(found.frames, FRAMES)
    np.testing.assert_array_equal(found.frame_times, TIMES)


def test_our_own_frames_may_have_channels(tmp_path: Path) -> None:
    path = h5("events/x events/y events/t events/p")(
        tmp_path, {"frames": FRAMES[:, None], "frame_times": TIMES, "ms_to_idx": np.zeros(9)})
    found = read_recording(path, size=SIZE)
    np.testing.assert_array_equal(found.frames, FRAMES)


@pytest.mark.parametrize(("arrays", "said"), [
    ({"images": FRAMES}, "without an array of 6 times"),
    ({"images": FRAMES, "a_ts": TIMES, "b_ts": TIMES}, "without an array of 6 times"),
    ({"depth": FRAMES, "depth_ts": TIMES}, "not brightness"),
    ({"images": FRAMES[:, :40], "image_ts": TIMES}, "64x40"),
    ({"images": FRAMES, "image_ts": TIMES[::-1]}, "Frame times must increase"),
    ({"images": FRAMES / 255.0, "image_ts": TIMES}, "Multiply by 255"),
    ({"images": FRAMES - 300.0, "image_ts": TIMES}, "expected DN")])
def test_what_cannot_be_frames_leaves_the_events_and_is_told(
    tmp_path: Path, arrays: dict[str, Any], said: str
) -> None:
    for write in (npz, h5("x y t p")):
        found = read_recording(write(tmp_path, arrays))
        equal(found.events, E)
        assert not found.has_frames
        assert said in found.notes[0].text
        assert not read_recording(write(tmp_path, arrays), no_frames=True).notes


ODD = np.stack([TIMES - 2000, TIMES + 2001], 1)
STATED: dict[str, dict[str, Any]] = {
    "begin and end": {"images": FRAMES, "exposure_ts": ODD},
    "in seconds": {"images": FRAMES, "exposure_ts": (ODD - 0.5) / 1e6},
    "in nanoseconds": {"images": FRAMES, "exposure_ts_ns": 1000 * ODD - 500},
    "a number": {"images": FRAMES, "image_ts": TIMES, "exposure_us": np.array(4001)},
    "one per image": {"images": FRAMES, "image_ts": TIMES, "exposure_time_ms": np.full(6, 4.001)},
    "above": {"cam/left/data": FRAMES, "cam/ts": TIMES, "cam/exposure_ns": np.array([4_001_000])}}


@pytest.mark.parametrize("write", LAYOUTS)
@pytest.mark.parametrize("kind", STATED)
def test_exposures_beside_images(
    tmp_path: Path, write: Callable[[Path, dict[str, Any]], Path], kind: str
) -> None:
    path = write(tmp_path, STATED[kind])
    whole, part = read_recording(path), read_recording(path, start_s=0.1, stop_s=0.2)
    assert whole.frame_times.tolist() == TIMES.tolist()
    assert 0 < len(part.frames) < 6
    for found in (whole, part):
        assert found.exposure_us == 4001
        said = [note.text for note in found.notes if note.code == "frames.exposure"]
        assert len(said) == 1
        assert "4.001 ms, as the file says" in said[0]


@pytest.mark.parametrize("named", ["images", "image_ts"])
def test_an_attribute_states_an_exposure(tmp_path: Path, named: str) -> None:
    path = h5("x y t p")(tmp_path, {"images": FRAMES, "image_ts": TIMES})
    for attribute, exposure_us in (("exposure", 0), ("exposure_time_ms", 4001)):
        with h5py.File(path, "a") as f:
            f[named].attrs[attribute] = 4.001
        assert read_recording(path).exposure_us == exposure_us


def test_an_exposure_longer_than_the_interval_is_noted_and_not_used(tmp_path: Path) -> None:
    for names in (("images", "image_ts"), ("frames", "frame_times")):
        arrays = dict(zip(names, (FRAMES, TIMES), strict=True)) | {"exposure_us": np.array(60_000)}
        for path in (npz(tmp_path, arrays), h5("x y t p")(tmp_path, arrays)):
            found = read_recording(path)
            assert (len(found.frames), found.exposure_us) == (6, 0)
            said = [note.text for note in found.notes if note.code == "frames.exposure"]
            assert len(said) == 1
            assert "60 ms, longer than the 50 ms between frames: it is not used" in said[0]


def test_an_exposure_without_unit_is_not_guessed_nor_taken_for_times(tmp_path: Path) -> None:
    for name in ("exposure", "exposure_time", "exposure_time_us"):
        path = npz(tmp_path, {"frames": RGB, "stamps_of_images_ts": TIMES, name: np.arange(6)})
        found = read_recording(path)
        assert found.frame_times.tolist() == TIMES.tolist()
        assert found.exposure_us == (2 if name.endswith("_us") else 0)


def test_encoded_images_are_told(tmp_path: Path) -> None:
    path = h5("x y t p")(tmp_path, {"image_ts": TIMES})
    with h5py.File(path, "a") as f:
        f.create_dataset("images", 6, h5py.vlen_dtype(np.uint8))
    assert "images (of variable length" in read_recording(path).notes[0].text
    path = npz(tmp_path, {"frames": FRAMES > 100, "frame_times": TIMES})
    assert "frames (bool, " in read_recording(path).notes[0].text


def test_a_stream_that_is_named_is_read_or_refused(tmp_path: Path) -> None:
    path = h5("x y t p")(tmp_path, {"blurred": FRAMES, "blurred_ts": TIMES, "raw": FRAMES // 2,
                                    "raw_ts": TIMES})
    assert read_recording(path).frames.max() <= 127
    np.testing.assert_array_equal(read_recording(path, frames_topic="blurred").frames, FRAMES)
    assert refused(path, frames_topic="other").code == "EV020"


def test_times_are_told_by_their_names() -> None:
    times, other = np.zeros(6), np.zeros((6, 9, 9))
    for name in ("t", "timestamps_us", "frameTimes", "image_ts"):
        assert times_of("images", {"images": other, name: times}) == name
    for name in ("events", "counts", "gain", "ts_map"):
        assert times_of("images", {"images": other, name: times}) == ""


@pytest.mark.parametrize("turn", [lambda a: a[:, None], lambda a: a[None]])
@pytest.mark.parametrize("write", [
    h5("x y t p"), h5("events/x events/y events/t events/p"), npz])
def test_columns_as_matlab_writes_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, write: Any, turn: Callable[[Any], Any]
) -> None:
    for name in "xytp":
        monkeypatch.setitem(COLUMNS, name, turn(getattr(E, name)))
    equal(read_recording(write(tmp_path, {})).events, E)


def test_size_and_offset_in_attributes_around(tmp_path: Path) -> None:
    path = h5("a/b/events/x a/b/events/y a/b/events/t a/b/events/p")(tmp_path, {})
    with h5py.File(path, "a") as f:
        del f.attrs["resolution"]
        f["a"].attrs["resolution"] = SIZE
        f["a/b/events"].attrs["t_offset"] = 5000
    found = read_recording(path).events
    assert (found.size, int(found.t[0])) == (SIZE, int(E.t[0]) + 5000)


@pytest.mark.parametrize("write", LAYOUTS)
def test_images_beside_a_part_are_at_their_times(
    tmp_path: Path, write: Callable[[Path, dict[str, Any]], Path]
) -> None:
    """Of frames over a hundred times as long, those beside the first events."""
    images = np.resize(FRAMES, (1000, *FRAMES.shape[1:]))
    times = TIMES[0] + 50_000 * np.arange(1000)
    path = write(tmp_path, {"images": images, "image_ts": times})
    stop_s = 1e-6 * (float(E.t[-1] - E.t[0]) + 1)
    found = read_recording(path, stop_s=stop_s)
    kept = times < E.t[0] + round(1e6 * stop_s)
    np.testing.assert_array_equal(found.frame_times, times[kept])
