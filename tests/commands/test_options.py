"""Options without effect are told, names that say something else than what is written are refused,
and simulate reads a recording as the other commands do."""

from __future__ import annotations

import dataclasses
import typing
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.recordings import equal, make

from evflow.camera import Camera
from evflow.cli import command_type, main
from evflow.commands.options import Reading
from evflow.commands.writing import named
from evflow.errors import EvflowDataError
from evflow.io import read_recording, write_recording
from evflow.light.colour import PATTERNS
from evflow.recordings.rolling import Rolling, unrolled
from evflow.types import Recording


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where commands run: flight.npz, bare.npz (no frames), camera.npz, frames.npy, times.txt."""
    recording = make(3000)
    write_recording(tmp_path / "flight.npz", recording)
    write_recording(tmp_path / "bare.npz", Recording.of_events(recording.events))
    Camera.constant((48, 64)).save(tmp_path / "camera.npz")
    np.save(tmp_path / "frames.npy", recording.frames)
    (tmp_path / "times.txt").write_text("".join(f"{t}\n" for t in recording.frame_times))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(line: str, capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    """The exit code and what stderr says."""
    code = main(line.split())
    return code, capsys.readouterr().err


def test_options_without_effect_are_told(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    moved = "--frames-offset-ms 5 --response gamma --bayer rggb"
    for line, why in (
        (f"info bare.npz {moved}", "bare.npz has no frames"),
        (f"voxel bare.npz -o a.npz {moved}", "bare.npz has no frames"),
        (f"render flight.npz -o a.gif {moved}", "shows no frames without --over-frames"),
        (f"compare flight.npz bare.npz {moved}", "only the events of the streams are compared"),
    ):
        code, said = run(line, capsys)
        assert code == 0
        told = "note: --frames-offset-ms, --response, --bayer without effect: "
        assert said.count(told) == 1
        assert why in said
    assert run("info bare.npz", capsys) == (0, "")
    assert run(f"info flight.npz {moved}", capsys) == (0, "")
    assert "without effect" not in run(
        "render flight.npz -o b.gif --over-frames --response gamma", capsys)[1]
    code, said = run("info bare.npz --frames none/", capsys)
    assert (code, said[:5]) == (1, "EV016")  # frames that are looked at must be there


@pytest.mark.parametrize("line", [
    "render flight.npz -o a.png --fps 5", "render flight.npz -o a.png --codec vp9",
    "render flight.npz -o a.mp4 --at 0.1", "render flight.npz -o a.gif --codec vp9",
    "simulate flight.npz -o a.h5 --no-interpolate --max-motion 3",
    "simulate flight.npz -o a.h5 --sensor esim --no-noise-resets-memory",
    "simulate flight.npz -o a.h5 --bayer rggb --colour rggb",
    "simulate flight.npz -o a.h5 --exposure-ms -1", "estimate flight.npz -o a --exposure-ms -1",
    "simulate flight.npz -o a.h5 --exposure-ms 9 --no-interpolate",
    "simulate flight.npz -o a.h5 --exposure-ms 9 --max-motion-px 0",
    "simulate flight.npz -o a.h5 --exposure-ms 2e4", "estimate flight.npz -o a --exposure-ms 2e4",
    "simulate flight.npz -o a.h5 --exposure-ms inf",
    "simulate flight.npz -o a.h5 --start nan", "info flight.npz --timestamps-unit us",
    "info flight.npz --bayer rgb",
    "voxel flight.npz -o a.txt", "voxel flight.npz -o a", "render flight.npz -o a.avi",
    "compare flight.npz flight.npz -o a.html", "estimate flight.npz -o a.npz",
    "export camera.npz --to v2e -o a.zip", "convert flight.npz a.npz --format event_utils",
    "convert flight.npz a.h5 --format npz", "simulate flight.npz -o a.aedat4 --format dsec",
    "simulate flight.npz -o a.mp4", "convert flight.npz -", "estimate flight.npz -o -",
    "voxel flight.npz -o a.npz --window-ms 1e16", "info flight.npz --frames-offset-ms 1e18",
    "info flight.npz --frames flight.npz --frames-fps 1e-12",
    "info flight.npz --rolling-ms -5", "info flight.npz --rolling-ms 2e4",
    "info flight.npz --rolling-from left", "info flight.npz --rolling-ms auto --rolling-from left"])
def test_contradictions_and_wrong_names_are_refused(
    folder: Path, line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    before = sorted(folder.iterdir())
    code, said = run(line, capsys)
    assert (code, said[:5]) == (2, "EV020")
    assert "Traceback" not in said
    assert sorted(folder.iterdir()) == before


def test_events_are_moved_as_their_line_of_the_frames_was_read(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, said = run("convert flight.npz a.npz --rolling-ms 12 --rolling-from left", capsys)
    assert code == 0
    assert "frames were read from the left to the right in 12 ms" in said
    before, after = read_recording(folder / "flight.npz"), read_recording(folder / "a.npz")
    expected = unrolled(before, Rolling(0.012, "left"))
    np.testing.assert_array_equal(after.events.t, expected.events.t)
    np.testing.assert_array_equal(after.frame_times, expected.frame_times)
    assert run("info flight.npz --rolling-ms auto --frames-offset-ms auto", capsys) == (0, "")


@pytest.mark.parametrize("line", [
    "simulate frames.npy --fps 9 -o {}.h5", "simulate frames.npy --fps 9 -o e.h5 --preview {}.mp4",
    "convert flight.npz {}.npz", "voxel flight.npz -o {}.npz", "render flight.npz -o {}.mp4"])
@pytest.mark.parametrize("also", ["", " --overwrite"])
def test_a_folder_in_the_place_of_a_file_is_refused_before_anything_is_read(
    line: str, also: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for kind in (".h5", ".npz", ".mp4"):
        (folder / f"taken{kind}").mkdir()
    for source in ("frames.npy", "flight.npz"):
        (folder / source).write_bytes(b"unreadable")
    code, said = run(line.format("taken") + also, capsys)
    assert (code, said[:5]) == (1, "EV013")
    assert "is a folder" in said


def test_a_format_of_the_same_container_or_of_a_name_without_meaning_passes() -> None:
    assert named("event_utils", Path("a.hdf5")) == "event_utils"
    assert named("dsec", Path("a.data")) == "dsec"
    assert named("evreal", Path("run.1")) == "evreal"
    assert named("auto", Path("a.zip")) is None
    with pytest.raises(EvflowDataError, match=r"Name the output with \.zip or \.txt"):
        named("e2vid", Path("a.h5"))


def test_what_is_no_camera_is_named(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    np.savez(folder / "other.npz", gain=1.0)
    for path, code, words in (
        ("other.npz", "EV008", "holds gain but not theta_on"),
        ("flight.npz", "EV008", "is a recording. Estimate its camera"),
        ("frames.npy", "EV008", "one array"), ("times.txt", "EV008", "begins with b'16432"),
        (".", "EV016", "Pass camera.npz"), ("absent.npz", "EV016", "evflow estimate RECORDING"),
    ):
        for line in (f"export {path} --to v2e -o out",
                     f"simulate flight.npz --camera {path} -o out.h5"):
            status, said = run(line, capsys)
            assert (status, said[:5]) == (1, code)
            assert words in said
            assert code == "EV016" or path == "flight.npz" or "Expected the camera.npz" in said


def test_simulate_reads_a_recording_as_others_do(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The same part of its frames, put right in the same way, at their own times."""
    options = "--start 0.04 --stop 0.21 --response gamma --bayer grbg"
    assert run(f"convert flight.npz right.npz --flip-frames vertical {options}", capsys)[0] == 0
    assert run("simulate right.npz -o want.npz --seed 3", capsys)[0] == 0
    code, said = run(f"simulate flight.npz -o got.npz --seed 3 --flip-frames vertical {options}",
                     capsys)
    assert code == 0
    assert "note: frames linearised (gamma)" in said
    want, got = (read_recording(folder / f"{name}.npz").events for name in ("want", "got"))
    assert len(got) > 100
    equal(got, want)


def test_simulate_takes_a_part_of_a_stack(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    stack = "simulate frames.npy --timestamps times.txt --frames-too"
    assert run(f"{stack} --start 0.1 --stop 0.2 -o part.npz", capsys)[0] == 0
    whole = read_recording("flight.npz")
    part = read_recording("part.npz")
    np.testing.assert_array_equal(part.frame_times, whole.frame_times[2:4])
    np.testing.assert_array_equal(part.frames, whole.frames[2:4])
    code, said = run(f"{stack} --start 9 -o none.npz", capsys)
    assert (code, said[:5]) == (1, "EV001")
    assert "cover 0 to 0.250 s" in said


def test_a_mosaic_becomes_luma(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    grey = "convert bare.npz {} --frames frames.npy --timestamps times.txt --bayer RGGB"
    assert run(grey.format("a.npz"), capsys)[0] == 0
    assert run("convert flight.npz b.npz --bayer rggb", capsys)[0] == 0
    a, b = read_recording("a.npz"), read_recording("b.npz")
    np.testing.assert_array_equal(a.frames, b.frames)
    assert (a.frames != read_recording("flight.npz").frames).mean() > 0.5
    cv2.imwrite("0.png", np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8))
    code, said = run("simulate . --fps 9 --bayer rggb -o c.npz", capsys)
    assert (code, said[:5]) == (2, "EV020")
    assert "colours already" in said


def test_own_options_come_first_in_the_help() -> None:
    inherited = [field.name for field in dataclasses.fields(Reading)]
    commands = [typing.get_args(c)[0] for c in typing.get_args(command_type())]
    reading = [c for c in commands if issubclass(c, Reading)]
    assert len(reading) >= 7
    for command in reading:
        names = [field.name for field in dataclasses.fields(command)]
        assert names[-len(inherited):] == inherited
    assert {p.upper() for p in PATTERNS} == {"RGGB", "BGGR", "GRBG", "GBRG"}
