"""Reading and writing: round trips, hints, damaged files. Only EvflowDataError may come out of a
bad file.
"""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
import typing
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.recordings import SIZE, T0, damage, equal, make, refused, survives, write_ijrr, zipped

import evflow
from evflow import io
from evflow.errors import EvflowDataError
from evflow.io import DsecWriter, read_events, read_recording, write_events
from evflow.io.hints import HintArguments, Hints
from evflow.io.registry import find_format, open_writer
from evflow.recordings.windows import iter_windows
from evflow.types import Events, Recording


@pytest.fixture
def sources(tmp_path: Path) -> dict[str, Path]:
    """One sound recording in every format that can be made here."""
    recording = make()
    for name in ("dsec", "npz"):
        write_events(tmp_path / f"a.{name}", recording, name)
    folder = write_ijrr(tmp_path / "a", recording)
    return {"dsec": tmp_path / "a.dsec", "npz": tmp_path / "a.npz", "ijrr": folder,
            "zip": zipped(folder, "nested/deep/")}


@pytest.mark.parametrize("kind", ["dsec", "npz", "ijrr", "zip"])
def test_round_trip(sources: dict[str, Path], kind: str) -> None:
    want, got = make(), read_recording(sources[kind])
    shift = T0 if kind in ("ijrr", "zip") else 0
    equal(want.events, Events(got.events.x, got.events.y, got.events.t + shift, got.events.p,
                              got.events.size))
    np.testing.assert_array_equal(want.frames, got.frames)
    np.testing.assert_array_equal(want.frame_times, got.frame_times + shift)


def test_events_are_read_without_their_frames(tmp_path: Path) -> None:
    """Whatever is wrong with one, and whichever are named."""
    folder = write_ijrr(tmp_path / "a", make())
    (folder / "images" / "frame_00000003.png").write_bytes(b"no image")
    assert "--no-frames" in refused(folder).fix
    equal(read_events(folder, frames_topic="images.txt"), read_recording(
        folder, no_frames=True).events)


@pytest.mark.parametrize("kind", ["dsec", "npz"])
@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_frames_keep_their_depth(tmp_path: Path, kind: str, dtype: Any) -> None:
    write_events(tmp_path / "a", make(count=2, dtype=dtype), kind)
    got = read_recording(tmp_path / "a")
    assert got.frames.dtype == dtype
    np.testing.assert_array_equal(got.frames, make(count=2, dtype=dtype).frames)


@pytest.mark.parametrize("kind", ["dsec", "npz"])
def test_silent_camera_round_trip(tmp_path: Path, kind: str) -> None:
    write_events(tmp_path / "a", Events([], [], [], [], SIZE), kind)
    equal(read_events(tmp_path / "a"), Events([], [], [], [], SIZE))


def test_format_is_told_by_content_not_by_name(sources: dict[str, Path]) -> None:
    for kind, name in (("dsec", "a.npz.txt"), ("npz", "b.h5"), ("zip", "c.npz")):
        path = sources[kind].rename(sources[kind].with_name(name))
        found = find_format(path).NAME
        assert found == {"zip": "ijrr"}.get(kind, kind)


def test_extension_decides_where_two_formats_claim_a_file(sources: dict[str, Path]) -> None:
    with zipfile.ZipFile(sources["zip"], "a") as archive:
        archive.writestr("mask.npy", b"")
    assert find_format(sources["zip"]).NAME == "ijrr"
    assert find_format(sources["zip"].rename(sources["zip"].with_suffix(".npz"))).NAME == "npz"


@pytest.mark.parametrize("kind", ["dsec", "npz", "ijrr", "zip"])
def test_every_reader_obeys_every_hint(sources: dict[str, Path], kind: str) -> None:
    path, whole = sources[kind], read_recording(sources[kind])
    first = int(whole.events.t[0])
    part = read_recording(path, start_s=0.1, stop_s=0.2)
    equal(part.events, whole.events.slice(first + 100_000, first + 200_000))
    kept = (whole.frame_times >= first + 100_000) & (whole.frame_times < first + 200_000)
    np.testing.assert_array_equal(part.frames, whole.frames[kept])
    np.testing.assert_array_equal(part.frame_times, whole.frame_times[kept])
    np.testing.assert_array_equal(read_events(path, polarity="invert").p, ~whole.events.p)
    equal(read_events(path, polarity="01"), whole.events)
    if kind in ("dsec", "npz"):
        np.testing.assert_array_equal(read_events(path, time_unit="ms").t, whole.events.t * 1000)
    assert refused(path, start_s=7, stop_s=9).code == "EV001"
    assert "0.000 to 0.299 s" in str(refused(path, start_s=7))
    assert refused(path, size=(60, 48)).code in ("EV005", "EV015")
    for wrong in ({"strat_s": 1}, {"start_s": -1}, {"start_s": "1"}, {"stop_s": float("nan")},
                  {"start_s": 2, "stop_s": 1}, {"time_unit": "min"}, {"polarity": "on"},
                  {"size": "64x48"}):
        assert refused(path, **wrong).code == "EV020"


def test_writing_is_all_or_nothing(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"

    def interrupted() -> None:
        with DsecWriter(path, SIZE) as out:
            out.append(make().events)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert list(tmp_path.iterdir()) == []
    write_events(path, make().events)
    before = path.read_bytes()
    with pytest.raises(EvflowDataError, match="EV013"):
        write_events(path, make(5).events)
    assert path.read_bytes() == before
    write_events(path, make(5).events, overwrite=True)
    assert len(read_events(path)) == 5
    with pytest.raises(EvflowDataError, match="EV020"):
        write_events(path, make().events, "csv")


@pytest.mark.parametrize(("name", "format"), [
    ("a.npz", "dsec"), ("a.txt", "dsec"), ("a.aedat4", "dsec"), ("a.h5", "npz"), ("a.zip", "npz")])
def test_a_format_that_the_extension_denies_is_refused(
    tmp_path: Path, name: str, format: str
) -> None:
    """`dsec` is the format unless told: a file called a.npz would hold HDF5."""
    with pytest.raises(EvflowDataError, match=r"EV020.*or pass format="):
        write_events(tmp_path / name, make(5).events, format)
    assert not list(tmp_path.iterdir())
    write_events(tmp_path / "a.hdf5", make(5).events, "event_utils")
    write_events(tmp_path / "a.anything", make(5).events, "npz")


@pytest.mark.parametrize("call", [
    lambda events: io.write_events(events, "a.h5"), lambda events: iter_windows("a.h5"),
    lambda events: io.write_recording("a.h5", events), lambda events: evflow.check(events),
    lambda events: evflow.compare("a.h5", events), lambda events: evflow.compare(events, None),
    lambda events: evflow.voxelize("a.npz", 0, 1000), lambda events: Recording.of_events("a.npz"),
    lambda events: Recording("a.npz", np.zeros((0, 2, 2), np.uint8), np.zeros(0, int))])
def test_paths_and_recordings_in_each_others_place(call: Callable[[Events], Any]) -> None:
    with pytest.raises(EvflowDataError, match=r"EV020.*is of type (str|Events|NoneType)"):
        call(make(5).events)


@pytest.mark.parametrize("kind", ["dsec", "npz"])
def test_full_disk_leaves_nothing(tmp_path: Path, kind: str) -> None:
    """RLIMIT_FSIZE stands in for a full disk: writes past 40 kB fail in the kernel."""
    program = f"""
import resource, signal, sys
sys.path.insert(0, {str(Path(__file__).parents[1])!r})
from helpers.recordings import make
from evflow.io import write_events
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (40_000, 40_000))
try:
    write_events({str(tmp_path / 'a')!r}, make(50_000), {kind!r})
except Exception as e:
    print(type(e).__name__, getattr(e, "errno", ""))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True,
                          timeout=120, check=True)
    assert done.stdout.split()[0] in ("EvflowDataError", "OSError")
    assert done.stderr == ""
    assert list(tmp_path.iterdir()) == []


def save_npz(path: Path, **changed: Any) -> Path:
    events = make(100).events
    arrays = {n: getattr(events, n) for n in "txyp"} | {"size": np.array(SIZE)} | changed
    np.savez(path, **{k: v for k, v in arrays.items() if v is not None})
    return path


def test_npz_reads_the_conventions_of_others(tmp_path: Path) -> None:
    want = make(100).events
    equal(read_events(save_npz(tmp_path / "a.npz", size=None, wh=np.array(SIZE))), want)
    for size in (np.array([64.0, 48.0]), np.array("64x48"), np.array(["64", "48"])):
        equal(read_events(save_npz(tmp_path / "a.npz", size=size)), want)
    signed = np.where(want.p, 1, -1).astype(np.int8)
    equal(read_events(save_npz(tmp_path / "b.npz", p=signed), polarity="pm1"), want)
    equal(read_events(save_npz(tmp_path / "c.npz", t=want.t * 1000 + 400), time_unit="ns"), want)
    seconds = (want.t - T0) / 1e6
    got = read_events(save_npz(tmp_path / "d.npz", t=seconds), time_unit="s")
    np.testing.assert_array_equal(got.t, want.t - T0)


@pytest.mark.parametrize(("changed", "code", "seen"), [
    ({"t": np.linspace(0, 0.1, 100)}, "EV003", "time_unit='s'"),
    ({"t": np.arange(100) * 1e4}, "EV003", "time_unit='us'"),
    ({"t": np.full(100, np.nan)}, "EV007", "nan"),
    ({"t": np.full(100, 2**63, np.uint64)}, "EV003", "beyond 2^62 microseconds"),
    ({"t": np.arange(100)[::-1]}, "EV004", "at event 1"),
    ({"x": np.full(100, 64)}, "EV005", "64x48"),
    ({"p": np.full(100, 3)}, "EV006", "3"),
    ({"p": np.full((100, 2), 1)}, "EV002", "(100, 2)"),
    ({"x": np.arange(100) / 2}, "EV003", "undistorted"),
    ({"y": None}, "EV008", "['y']"),
    ({"size": None}, "EV015", "--size WxH"),
    ({"size": np.array([1, 2, 3])}, "EV015", "holds 1 2 3. "),
    ({"size": np.array([64.5, 48])}, "EV015", "--size WxH"),
    ({"size": np.array("large")}, "EV015", "holds large"),
    ({"frames": np.zeros((1, 48, 64), np.uint8)}, "EV008", "no frame_times"),
    ({"p": np.array([None] * 100)}, "EV008", "pickle"),
])
def test_npz_with_bad_contents(tmp_path: Path, changed: dict, code: str, seen: str) -> None:
    error = refused(save_npz(tmp_path / "a.npz", **changed))
    assert error.code == code
    assert seen in str(error)


def test_npz_that_claims_more_than_it_holds(tmp_path: Path) -> None:
    path = save_npz(tmp_path / "a.npz", size=None)
    header = b"\x93NUMPY\x01\x00\x76\x00" + b"{'descr': '<i8', 'fortran_order': False, " \
        b"'shape': (1000000000000,), }".ljust(117) + b"\n"
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("size.npy", header + bytes(16))
    assert "size.npy is cut off" in str(refused(path))
    with zipfile.ZipFile(save_npz(path), "a") as archive:
        archive.writestr("frames.npx", b"")
    assert "frames.npx is not an array" in str(refused(path))


def test_npz_checksums_are_compared_whatever_is_asked_for(tmp_path: Path) -> None:
    """A byte is changed in the last time, which then is the first: order is wrong as well."""
    path = save_npz(tmp_path / "a.npz")
    last = make(100).events.t[-1:].tobytes()
    data = path.read_bytes()
    assert data.count(last) == 1
    path.write_bytes(data.replace(last, last[:-1] + b"\x80"))
    for hints in ({}, {"stop_s": 0.01}, {"partial": True}):
        assert "CRC" in str(refused(path, **hints))


@pytest.mark.parametrize(("name", "count", "size", "on"), [
    ("recordings/emlb_newton_cradle/events.npz", 319_512, (346, 260), 0.5218),
    ("recordings/gen3_vga_person/events.npz", 343_474, (640, 480), 0.3645),
    ("recordings/noise_static_dvxplorer640/events.npz", 334_331, (640, 480), 0.5441),
    ("formats/dvxplorer320.aedat4", 111_954, (320, 240), 0.491)])
def test_real_events(data_file: Callable[[str], Path], name: str, count: int,
                     size: tuple[int, int], on: float) -> None:
    if name.endswith("aedat4"):
        pytest.importorskip("aedat")
    got = read_events(data_file(f"data/{name}"))
    assert (len(got), got.size) == (count, size)
    assert got.p.mean() == pytest.approx(on, abs=5e-4)
    assert got.count_map().sum() == count


def test_a_file_of_an_unknown_format(tmp_path: Path) -> None:
    (tmp_path / "a.bin").write_bytes(b"\x07unknown" * 9)
    error = refused(tmp_path / "a.bin")
    assert error.code == "EV008"
    assert "it begins with b'" in str(error)


def test_paths_that_lead_nowhere(tmp_path: Path) -> None:
    assert refused(tmp_path / "none.h5").code == "EV016"
    assert "a folder of nothing" in str(refused(tmp_path))
    (tmp_path / "zero.h5").write_bytes(b"")
    assert refused(tmp_path / "zero.h5").code == "EV009"
    (tmp_path / "text.txt").write_text("hello")
    assert refused(tmp_path / "text.txt").code == "EV008"


@pytest.mark.parametrize("kind", ["dsec", "npz", "zip", "events.txt", "images.txt", "image"])
def test_damaged_copies_only_raise_data_errors(sources: dict[str, Path], kind: str) -> None:
    folder = sources["ijrr"]
    target = {"image": folder / "images/frame_00000001.png"}.get(
        kind, sources[kind] if kind in sources else folder / kind)
    path = target if kind in sources else folder
    damage(target, 60, lambda: survives(path))


def test_reading_imports_neither_jax_nor_optional_packages(sources: dict[str, Path]) -> None:
    program = ("import sys, evflow.io as io; "
               f"io.read_events({str(sources['npz'])!r}); "
               "print([m for m in ('jax', 'h5py', 'aedat', 'cv2') if m in sys.modules])")
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True,
                          timeout=120, check=True, env={**os.environ})
    assert done.stdout.strip() == "[]"


def test_the_typed_hints_are_those_that_readers_know() -> None:
    fields, told = typing.get_type_hints(Hints), typing.get_type_hints(HintArguments)
    assert told == {f.name: fields[f.name] for f in dataclasses.fields(Hints) if f.init}


@pytest.mark.parametrize("format", ["dsec", "npz"])
def test_a_range_counts_from_the_first_event_even_if_that_is_dropped(
    tmp_path: Path, format: str
) -> None:
    """Events outside of the sensor, that fill the first part that is read."""
    rng, t = np.random.default_rng(0), 1_000_000 + np.arange(20_000) * 200
    x, y = rng.integers(0, 60, 20_000), rng.integers(0, 48, 20_000)
    x[0] = 63
    events = Events(x, y, t, rng.random(20_000) < 0.5, (64, 48))
    write_events(tmp_path / "a", events, format)
    found = read_events(tmp_path / "a", size=(60, 48), drop_outside=True, start_s=1.0, stop_s=3.0)
    np.testing.assert_array_equal(found.t, t[(t >= 2_000_000) & (t < 4_000_000)])


def test_times_that_know_their_unit_are_rounded_like_others(tmp_path: Path) -> None:
    counts = np.array([0, 999, 1500, 1999, 2600])
    for kind in "mM":
        us = Hints().microseconds(counts.astype(f"{kind}8[ns]"), "us", 0)
        np.testing.assert_array_equal(us, [0, 1, 2, 2, 3])
        coarse = Hints().microseconds(counts.astype(f"{kind}8[ms]"), "us", 0)
        np.testing.assert_array_equal(coarse, 1000 * counts)


def test_a_writer_writes_within_its_block_alone(tmp_path: Path) -> None:
    out = open_writer(tmp_path / "a.h5", (64, 48))
    events = Events([1], [1], [1], [1], (64, 48))
    for write in (lambda: out.append(events),
                  lambda: out.append_frames(np.zeros((1, 48, 64), np.uint8), np.array([1]))):
        with pytest.raises(EvflowDataError, match=r"EV020.*not open.*with ef.open_writer"):
            write()


def test_an_event_outside_can_be_left_out_as_the_message_says(tmp_path: Path) -> None:
    x, path = np.arange(100) % 64, tmp_path / "a.npz"
    x[50] = 64
    np.savez(path, x=x, y=x % 48, t=1000 * np.arange(100), p=x % 2, size=(64, 48))
    error = refused(path)
    assert "--drop-outside" in str(error)
    assert "--partial" not in str(error)
    assert len(read_recording(path, drop_outside=True).events) == 99
