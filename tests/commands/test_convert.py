"""evflow convert and voxel, and simulate into every format, end to end."""

from __future__ import annotations

import json
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from helpers.recordings import SIZE, equal, make, write_ijrr
from helpers.videos import drifting

from evflow.cli import main
from evflow.commands.writing import Format
from evflow.io import read_events, read_recording, write_events, write_recording
from evflow.io.registry import WRITERS
from evflow.light.log_maps import delta_log_intensity
from evflow.recordings import plan_windows
from evflow.types import Events, Recording
from evflow.voxel import voxelize


def run(capsys: pytest.CaptureFixture[str], *command: object) -> tuple[int, str, str]:
    code = main([str(word) for word in command])
    printed = capsys.readouterr()
    return code, printed.out, printed.err


@pytest.fixture
def flight(tmp_path: Path) -> Path:
    write_recording(tmp_path / "flight.h5", make(3000))
    return tmp_path / "flight.h5"


def test_formats_of_the_command_line_are_those_of_the_library() -> None:
    assert set(get_args(Format)) == {"auto", *WRITERS}


@pytest.mark.parametrize("name", ["a.npz", "a.h5", "folder", "a.zip", "a.aedat4"])
def test_convert_there_and_back(
    tmp_path: Path, flight: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    if name == "a.aedat4":
        pytest.importorskip("aedat", reason="the package aedat reads AEDAT4")
    code, out, err = run(capsys, "convert", flight, tmp_path / name, "--json")
    assert code == 0
    facts = json.loads(out)
    got, want = read_recording(tmp_path / name), make(3000)
    equal(got.events, want.events)
    assert facts["events"] == 3000
    assert facts["frames"] == len(got.frames) == (0 if name == "a.zip" else 6)
    if name == "a.zip":
        assert "holds events only: the 6 frames were left out" in err
        assert [note["text"] for note in facts["notes"]] == [err.removeprefix("note: ").strip()]
    assert run(capsys, "convert", tmp_path / name, flight, "--overwrite")[0] == 0
    equal(read_events(flight), want.events)


def test_convert_a_part_as_another_format(
    tmp_path: Path, flight: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "part.h5"
    code, text, _ = run(capsys, "convert", flight, out, "--format", "event_utils", "--start",
                        "0.1", "--stop", "0.2", "--polarity", "invert")
    assert code == 0
    assert "(event_utils)" in text
    events = make(3000).events
    first = int(events.t[0])
    want = events.slice(first + 100_000, first + 200_000)
    got = read_recording(out)
    np.testing.assert_array_equal(got.events.t, want.t)
    np.testing.assert_array_equal(got.events.p, ~want.p)
    assert len(got.frames) == 2


def test_frames_that_a_format_cannot_hold_are_left_out_with_a_note(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_recording(tmp_path / "deep.h5", make(50, dtype=np.uint16))
    code, _, err = run(capsys, "convert", tmp_path / "deep.h5", tmp_path / "a.aedat4")
    assert code == 0
    assert "aedat4 holds frames of uint8, not uint16: the 6 frames were left out" in err


@pytest.mark.parametrize("name", ["a.npz", "a.h5", "folder", "a.aedat4"])
def test_an_exposure_is_kept(
    tmp_path: Path, flight: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    if name == "a.aedat4":
        pytest.importorskip("aedat", reason="the package aedat reads AEDAT4")
    for options, exposure_us, said in ((("--exposure-ms", 2.501), 2501, "as was given"),
                                       ((), 0, "")):
        out = tmp_path / name
        _, _, err = run(capsys, "convert", flight, out, "--overwrite", *options)
        assert err.count("exposed for") == len(options) / 2
        assert said in err
        assert read_recording(out).exposure_us == exposure_us
        assert run(capsys, "convert", out, tmp_path / "b.npz", "--overwrite")[0] == 0
        assert read_recording(tmp_path / "b.npz").exposure_us == exposure_us
        assert run(capsys, "convert", out, tmp_path / "c.h5", "--exposure-ms", 0,
                   "--overwrite")[0] == 0
        assert read_recording(tmp_path / "c.h5").exposure_us == 0


def test_begin_and_end_beside_a_recording_are_its_exposure(
    tmp_path: Path, flight: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    want, times, out = read_recording(flight), tmp_path / "times.txt", tmp_path / "a.npz"
    np.save(tmp_path / "f.npy", want.frames)
    times.write_text("".join(
        f"{1000 * (t - 4000)} {1000 * (t + 4001)}\n" for t in want.frame_times.tolist()))
    beside = ("--frames", tmp_path / "f.npy", "--timestamps", times, "--overwrite")
    for options, exposure_us in (((), 8001), (("--exposure-ms", 7), 7000), (
            ("--start", 0.1, "--stop", 0.2), 8001)):
        _, _, err = run(capsys, "convert", flight, out, *beside, *options)
        assert err.count(f"exposed for {exposure_us / 1e3:g} ms") == err.count("exposed for") == 1
        assert read_recording(out).exposure_us == exposure_us


def test_convert_errors(
    tmp_path: Path, flight: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = Recording.of_events(Events([1], [1], [-5], [1], SIZE))
    write_recording(tmp_path / "before.npz", before)
    (tmp_path / "there.npz").write_text("dear to me")
    for code, command in (
        ("EV020", [flight, tmp_path / "a.csv"]),
        ("EV016", [tmp_path / "no.h5", tmp_path / "a.npz"]),
        ("EV013", [flight, tmp_path / "there.npz"]),
        ("EV001", [flight, tmp_path / "a.npz", "--start", "9"]),
        ("EV003", [tmp_path / "before.npz", tmp_path / "a.zip"]),
        ("EV003", [tmp_path / "before.npz", tmp_path / "a.aedat4"]),
    ):
        status, _, err = run(capsys, "convert", *command)
        assert status == (2 if code == "EV020" else 1)
        assert err.splitlines()[-1].startswith(code)
        assert "Traceback" not in err
    assert not list(tmp_path.glob("*a.*"))
    assert (tmp_path / "there.npz").read_text() == "dear to me"


@pytest.mark.parametrize("verb", ["convert", "voxel", "simulate", "link"])
def test_what_is_read_is_never_replaced(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], verb: str
) -> None:
    source = out = tmp_path / "only.npz"
    write_recording(source, make(3000))
    if verb == "link":
        verb, out = "convert", tmp_path / "other.npz"
        out.symlink_to(source)
    before = source.read_bytes()
    target = [out] if verb == "convert" else ["-o", out]
    status, _, err = run(capsys, verb, source, *target, "--overwrite")
    assert status == 2
    assert "EV020" in err
    assert "is the input" in err
    assert source.read_bytes() == before


def test_parts_of_what_is_read_are_never_replaced(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, times = tmp_path / "ijrr", tmp_path / "times.txt"
    write_ijrr(folder, make(300))
    times.write_text("\n".join(str(0.05 * i) for i in range(6)))
    before = {path: path.read_bytes() for path in (folder / "events.txt", times)}
    for command in (["convert", folder, folder / "events.txt"],
                    ["simulate", folder / "images", "--timestamps", times, "-o", times]):
        status, _, err = run(capsys, *command, "--overwrite")
        assert status == 2
        assert "is the input" in err
    assert before == {path: path.read_bytes() for path in before}


@pytest.mark.parametrize("name", ["a.h5", "a.npz", "folder", "a.zip", "a.aedat4"])
def test_simulate_into_any_format(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    """The same events in each, and the video's frames where they are asked for."""
    if name == "a.aedat4":
        pytest.importorskip("aedat", reason="the package aedat reads AEDAT4")
    frames = drifting(8, (24, 32)).astype(np.uint8)
    np.save(tmp_path / "video.npy", frames)
    command = ["simulate", tmp_path / "video.npy", "--fps", "100", "--json"]
    assert run(capsys, *command, "-o", tmp_path / "want.h5")[0] == 0
    want = read_recording(tmp_path / "want.h5")
    assert len(want.events) > 100
    assert not want.has_frames
    out = tmp_path / "out" / name
    code, text, err = run(capsys, *command, "-o", out, "--frames-too")
    if name == "a.zip":
        assert code == 2
        assert "EV020" in err
        assert list(out.parent.iterdir()) == []
        assert run(capsys, *command, "-o", out)[0] == 0
        equal(read_events(out), want.events)
        return
    assert code == 0
    got = read_recording(out)
    equal(got.events, want.events)
    assert json.loads(text)["frames"] == 8
    np.testing.assert_array_equal(got.frames, frames)
    np.testing.assert_array_equal(got.frame_times, 10_000 * np.arange(8))


def test_simulate_refuses_an_unknown_extension(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    np.save(tmp_path / "video.npy", drifting(4, (24, 32)))
    command = ["simulate", tmp_path / "video.npy", "--fps", "100"]
    code, _, err = run(capsys, *command, "-o", tmp_path / "a.raw")
    assert code == 2
    assert "EV020" in err
    code, _, _ = run(capsys, *command, "-o", tmp_path / "a.raw", "--format", "npz")
    assert code == 0
    assert len(read_events(tmp_path / "a.raw")) > 0


def covered() -> Recording:
    """Events that span six frames, 50 ms apart."""
    recording = make(3000)
    return Recording(recording.events, recording.frames, recording.frame_times + 9_000)


def test_voxels_of_windows_between_frames(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = covered()
    write_recording(tmp_path / "a.npz", recording)
    code, text, _ = run(capsys, "voxel", tmp_path / "a.npz", "-o", tmp_path / "v.npz",
                        "--bins", "5", "--window-ms", "60")
    assert code == 0
    pairs = plan_windows(recording, 60_000).pairs
    assert len(pairs) == 2
    assert "2 windows" in text
    with np.load(tmp_path / "v.npz") as data:
        assert data["voxels"].shape == (2, 48, 64, 10)
        assert data["voxels"].dtype == data["dlogI"].dtype == np.float32
        for i, (first, last) in enumerate(pairs):
            t0, t1 = recording.frame_times[[first, last]]
            assert (data["t0_us"][i], data["window_us"][i]) == (t0, t1 - t0)
            np.testing.assert_array_equal(
                data["voxels"][i], voxelize(recording.events, t0, t1 - t0, 5))
            np.testing.assert_array_equal(data["dlogI"][i], delta_log_intensity(
                recording.frame_dn(first), recording.frame_dn(last)))


def test_voxels_without_frames(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Every event but those of the last, unfinished window is in exactly one grid."""
    events = make(3000).events
    write_recording(tmp_path / "a.npz", Recording.of_events(events))
    code, _, err = run(capsys, "voxel", tmp_path / "a.npz", "-o", tmp_path / "v.npz")
    assert code == 0
    assert "without dlogI" in err
    first = int(events.t[0])
    with np.load(tmp_path / "v.npz") as data:
        assert set(data) == {"voxels", "t0_us", "window_us"}
        assert data["t0_us"].tolist() == [first + 40_000 * i for i in range(7)]
        count = len(events.slice(first, first + 280_000))
        assert data["voxels"].sum(dtype=float) == pytest.approx(count, abs=0.01)


def test_voxel_errors(tmp_path: Path, flight: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_recording(tmp_path / "bare.npz", Recording.of_events(make(50).events))
    write_recording(tmp_path / "none.npz", Recording.of_events(Events([], [], [], [], SIZE)))
    events = make(50).events
    jump = Events(events.x, events.y, np.where(np.arange(len(events)) < 9, 0, 1 << 51), events.p,
                  events.size)
    write_recording(tmp_path / "jump.npz", Recording.of_events(jump))
    for code, command in (
        ("EV026", [tmp_path / "jump.npz"]),
        ("EV020", [flight, "--bins", "1"]), ("EV020", [flight, "--window-ms", "0"]),
        ("EV020", [flight, "--window-ms", "nan"]), ("EV017", [flight, "--window-ms", "900"]),
        ("EV017", [tmp_path / "bare.npz", "--window-ms", "900"]),
        ("EV001", [tmp_path / "none.npz"]),
    ):
        status, _, err = run(capsys, "voxel", *command, "-o", tmp_path / "v.npz")
        assert status == (2 if code == "EV020" else 1)
        assert err.splitlines()[-1].startswith(code), err
    assert not list(tmp_path.glob("*v.npz*"))


@pytest.mark.parametrize("verb", ["convert", "voxel", "export"])
def test_help_has_an_example(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main([verb, "--help"])
    assert caught.value.code == 0
    assert f"Example: evflow {verb}" in " ".join(capsys.readouterr().out.split())


def test_a_folder_that_holds_an_input_is_not_replaced(tmp_path: Path) -> None:
    recording = make(2000)
    write_recording(tmp_path / "seq", recording)
    write_events(tmp_path / "e.h5", recording.events)
    before = (tmp_path / "seq" / "images.npy").read_bytes()
    assert main(["convert", str(tmp_path / "e.h5"), str(tmp_path / "seq"), "--overwrite",
                 "--frames", str(tmp_path / "seq" / "images.npy"),
                 "--timestamps", str(tmp_path / "seq" / "images_ts.npy"),
                 "--timestamps-unit", "s"]) != 0
    assert (tmp_path / "seq" / "images.npy").read_bytes() == before
