"""`evflow check`, and the reading options that put right what it finds."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers.networks import hidden

from evflow import Recording, read_recording, write_events
from evflow.cli import main
from evflow.recordings.adjust import shifted


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """flight.npz, late.npz (frames 50 ms late), bare.npz (no frames), frames.npy."""
    folder = tmp_path_factory.mktemp("check")
    recording = hidden(14, 440)[0]
    write_events(folder / "flight.npz", recording, format="npz")
    write_events(folder / "late.npz", shifted(recording, 50_000), format="npz")
    write_events(folder / "bare.npz", Recording.of_events(recording.events), format="npz")
    np.save(folder / "frames.npy", recording.frames)
    (folder / "times.txt").write_text("".join(f"{t}\n" for t in recording.frame_times))
    return folder


def run(*arguments: object) -> int:
    """The exit code of a command line."""
    try:
        return main([str(a) for a in arguments])
    except SystemExit as e:
        return int(e.code or 0)


def found(capsys: pytest.CaptureFixture[str]) -> dict[str, list[str]]:
    report = json.loads(capsys.readouterr().out)
    return {kind: [f["code"] for f in rows] for kind, rows in report.items() if rows}


def test_what_a_reader_doubts_is_said_once(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = read_recording(folder / "flight.npz")
    events = recording.events
    slow = dataclasses.replace(recording, events=dataclasses.replace(events, t=1000 * events.t))
    write_events(tmp_path / "slow.npz", slow, format="npz")
    assert run("check", tmp_path / "slow.npz") == 1
    assert "".join(capsys.readouterr()).count("pass --time-unit ns") == 1


def test_a_sound_recording_is_clean(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("check", folder / "flight.npz", "--strict") == 0
    assert "nothing found" in capsys.readouterr().out
    assert run("check", folder / "flight.npz", "--json") == 0
    assert found(capsys) == {}


def test_errors_exit_1_and_warnings_only_when_strict(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("check", folder / "flight.npz", "--polarity", "invert") == 1
    text = capsys.readouterr().out
    assert "error: EV021 polarity inverted" in text
    assert "--polarity invert" in text
    assert run("check", folder / "bare.npz", "--json") == 0
    assert found(capsys) == {"warnings": ["EV011"]}
    assert run("check", folder / "bare.npz", "--json", "--strict") == 1
    assert found(capsys) == {"errors": ["EV011"]}


def test_what_cannot_be_read_is_the_finding(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    damaged = tmp_path / "cut.npz"
    damaged.write_bytes((folder / "flight.npz").read_bytes()[:3000])
    for path, code in ((damaged, "EV009"), (tmp_path / "absent.raw", "EV016")):
        assert run("check", path, "--json") == 1
        assert found(capsys) == {"errors": [code]}


@pytest.mark.parametrize("offset", ["-50", "auto"])
def test_late_frames_are_put_right(
    folder: Path, offset: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("check", folder / "late.npz", "--json") == 1
    assert found(capsys) == {"errors": ["EV024"]}
    assert run("check", folder / "late.npz", "--json", "--frames-offset-ms", offset) == 0
    assert found(capsys) == {}
    assert run("info", folder / "late.npz", "--frames-offset-ms", offset) == 0
    assert "frame times shifted by -" in capsys.readouterr().out


def test_frames_from_elsewhere(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bare = ("check", folder / "bare.npz", "--json", "--frames", folder / "frames.npy")
    assert run(*bare, "--timestamps", folder / "times.txt") == 0
    assert found(capsys) == {}
    assert run(*bare, "--frames-fps", 25, "--frames-offset-ms", 20) == 0
    assert found(capsys) == {}
    assert run(*bare, "--frames-fps", 25, "--frames-offset-ms", 20, "--flip-frames", "both") == 1
    assert found(capsys) == {"errors": ["EV029"]}
    assert run("check", folder / "bare.npz", "--timestamps", folder / "times.txt") == 2
    assert "Pass --frames too" in capsys.readouterr().err


def test_frames_without_a_clock_join_events_of_wall_clock_time(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The offset that EV012 names is taken, also where another one was given."""
    bare = read_recording(folder / "bare.npz").events
    late = dataclasses.replace(bare, t=bare.t + 1_643_243_628_737_093)
    write_events(tmp_path / "wall.npz", Recording.of_events(late), format="npz")
    check = ("check", tmp_path / "wall.npz", "--json", "--frames", folder / "frames.npy",
             "--frames-fps", 25)
    for given in ((), ("--frames-offset-ms", 30.6)):
        assert run(*check, *given) == 1
        (finding,) = json.loads(capsys.readouterr().out)["errors"]
        assert finding["code"] == "EV012"
        offset = finding["fix"].split("--frames-offset-ms ")[1].split()[0]
        assert float(offset) == pytest.approx(late.t[0] / 1e3, abs=2e-3)
    run(*check, "--frames-offset-ms", offset)
    assert "EV012" not in capsys.readouterr().out


def test_events_outside_the_sensor(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    smaller = ("check", folder / "bare.npz", "--size", "60x48", "--json")
    assert run(*smaller) == 1
    assert found(capsys) == {"errors": ["EV005"]}
    assert run(*smaller, "--drop-outside") == 0
    assert found(capsys) == {"warnings": ["EV011"]}


def test_estimate_stops_at_errors_and_keeps_warnings(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "cam"
    estimate = ("estimate", folder / "late.npz", "-o", out, "--no-plots")
    assert run(*estimate, "--polarity", "invert", "--frames-offset-ms", "-50") == 1
    assert "EV021" in capsys.readouterr().err
    assert not out.exists()
    assert run(*estimate) == 1
    assert "EV024" in capsys.readouterr().err
    assert not out.exists()
    assert run(*estimate, "--no-checks") == 0
    assert "warning: EV024" in capsys.readouterr().err
    saved = json.loads((out / "camera.json").read_text())
    assert [note["code"] for note in saved["notes"]].count("EV024") == 1
    assert run(*estimate, "--overwrite", "--frames-offset-ms", "auto") == 0
    saved = json.loads((out / "camera.json").read_text())
    assert not any(note["code"].startswith("EV0") for note in saved["notes"])
    assert saved["recording_notes"][-1]["code"] == "frames.moved"


def test_estimate_of_noise_alone(
    data_file: Callable[[str], Path], folder: Path, tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert run("estimate", folder / "bare.npz", "-o", tmp_path / "no") == 1
    assert "EV011" in (error := capsys.readouterr().err)
    assert "--frames DIR" in error
    static = ("--protocol", "static", "-o", tmp_path / "no")
    assert run("estimate", folder / "flight.npz", *static) == 1
    assert "--protocol motion" in capsys.readouterr().err
    static = data_file("data/recordings/noise_static_dvxplorer640/events.npz")
    pytest.importorskip("matplotlib")
    assert run("estimate", static, "-o", tmp_path / "cam", "--json") == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["summary"]["eta_on"] == pytest.approx(0.232, rel=0.2)
    assert facts["summary"]["eta_off"] == pytest.approx(0.198, rel=0.2)
    assert facts["valid_fraction"] == 0
    assert facts["undetermined"] == ["theta_on", "theta_off"]
    assert "frames.none" in [note["code"] for note in facts["notes"]]
    assert (tmp_path / "cam" / "maps.png").stat().st_size > 10_000
