"""The command line, end to end, in this process; exit codes, messages, files."""

from __future__ import annotations

import dataclasses
import errno
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.networks import hidden

from evflow import Camera, Recording, SensorModel, Summary, cli, read_events, write_events
from evflow.camera.optics import Optics, as_arrays, summary_arrays
from evflow.cli import main


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("rec") / "flight.h5"
    write_events(path, hidden(15, 440)[0])
    return path


def test_info(flight: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(flight), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["size"] == [64, 48]
    assert facts["frames"] == 11
    assert facts["windows"] == 10


def test_estimate_then_simulate(
    flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "cam"
    assert main(["estimate", str(flight), "-o", str(out), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["windows"] == 10
    assert Camera.load(out / "camera.npz").shape == (48, 64)
    assert json.loads((out / "camera.json").read_text())["summary"] == facts["summary"]
    for name in ("maps.png", "histograms.png"):
        assert cv2.imread(str(out / name)).std() > 5
    made = tmp_path / "made.h5"
    command = ["simulate", str(flight), "--camera", str(out / "camera.npz"), "-o", str(made)]
    assert main(command) == 0
    again, recorded = read_events(made), read_events(flight)
    assert 0.6 < len(again) / len(recorded) < 1.6
    assert main(command) == 1
    assert "EV013" in capsys.readouterr().err
    assert main([*command, "--overwrite"]) == 0
    assert np.array_equal(read_events(made).t, again.t)


def test_simulate_a_video(tmp_path: Path) -> None:
    video = tmp_path / "disc.avi"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"MJPG"), 50.0, (64, 48))
    for i in range(6):
        frame = np.full((48, 64, 3), 60, np.uint8)
        cv2.circle(frame, (12 + 5 * i, 24), 8, (220, 220, 220), -1)
        writer.write(frame)
    writer.release()
    assert main(["simulate", str(video), "-o", str(tmp_path / "disc.h5")]) == 0
    events = read_events(tmp_path / "disc.h5")
    assert events.size == (64, 48)
    assert len(events) > 500
    assert events.t[-1] <= 100_000
    # The disc moves right: ON ahead of it, OFF behind.
    late = events.slice(60_000, 100_001)
    assert late.x[late.p].mean() > late.x[~late.p].mean() + 5


def test_data_errors_are_one_line_and_exit_1(
    flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    empty = tmp_path / "nothing.txt"
    empty.write_text("hello")
    small = tmp_path / "small.npz"
    Camera.constant((4, 4)).save(small)
    bare = tmp_path / "bare.h5"
    write_events(bare, Recording.of_events(read_events(flight)))
    out = str(tmp_path / "out")
    for code, command in (
        ("EV016", ["info", str(tmp_path / "absent.aedat4")]),
        ("EV008", ["info", str(empty)]),
        ("EV011", ["estimate", str(bare), "-o", out]),
        ("EV016", ["estimate", str(flight), "-o", out, "--weights", "absent"]),
        ("EV015", ["simulate", str(flight), "--camera", str(small), "-o", out + ".h5"]),
        ("EV014", ["simulate", str(flight), "--theta-on", "0", "-o", out + ".h5"]),
        ("EV011", ["simulate", str(bare), "-o", out + ".h5"]),
    ):
        assert main(command) == 1
        error = capsys.readouterr().err
        assert code in error
        assert "Traceback" not in error
    assert not Path(out + ".h5").exists()


def test_a_name_that_is_too_long_exits_3(
    flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["convert", str(flight), str(tmp_path / f"{'a' * 300}.npz")]) == 3
    error = capsys.readouterr().err
    assert error.startswith("EV019")
    assert "the name is too long" in error


def test_options_follow_the_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--json", "info", "a b.npz"]) == 2
    assert "Options follow it: evflow info --json 'a b.npz'." in capsys.readouterr().err


def test_usage_errors_exit_2() -> None:
    with pytest.raises(SystemExit) as caught:
        main(["estimate"])
    assert caught.value.code == 2


@pytest.mark.parametrize(("line", "said"), [
    ("simulate -i r.mp4 --pos_thres .2 --dvs346", "v2e's -i is VIDEO without an option here. v2e's "
     "--pos_thres is --theta-on here. v2e's --dvs346 is --sensor-size davis346 here."),
    ("simulate r.mp4 --timestamp_resolution .001 --dvs_exposure duration", "--max-motion-px, as "
     "far as anything moves, here. v2e's --dvs_exposure has no counterpart here."),
    ("simulate r.mp4 -o r.h5 --sensr=v2e", "no option --sensr. Did you mean --sensor?"),
    ("render r.h5 -o r.png --slow-motion 3", "Did you mean --slow?"),
    ("render r.h5 -o r.mp4 --events 9", "Did you mean --events-topic or --window-events?"),
    ("estimate r.h5 -out cam", "no option -out. Did you mean --out?"),
    ("train --presett debug --loss.flow 1", "Did you mean --preset?"),
    ("convert a.h5 b.h5 --pos_thres -3", "no option --pos_thres. evflow convert --help"),
    ("convert a.h5 b.h5 c.h5", "one word too many: 'c.h5'"),
])
def test_an_unknown_option_is_named_with_the_nearest(
    line: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(line.split()) == 2
    assert said in capsys.readouterr().err


def test_options_are_spelled_in_every_way(flight: Path, tmp_path: Path) -> None:
    assert main(["render", str(flight), f"-o{tmp_path / 'part.png'}", "--window_ms=20",
                 "--no_caption"]) == 0


def test_help_breaks_lines_at_the_margin_alone(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "400")
    with pytest.raises(SystemExit):
        main(["convert", "--help"])
    rows = capsys.readouterr().out.splitlines()
    wide = next(row for row in rows if "Of a damaged or truncated file" in row)
    assert "a time that goes back). (default: False)" in wide


@pytest.mark.parametrize("verb", ["info", "estimate", "simulate", "version"])
def test_every_command_has_help_with_an_example(
    verb: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as caught:
        main([verb, "--help"])
    assert caught.value.code == 0
    assert f"Example: evflow {verb}" in " ".join(capsys.readouterr().out.split())


def test_help_loads_no_jax() -> None:
    code = ("import sys; from evflow.cli import main\n"
            "try: main(['--help'])\nexcept SystemExit: pass\n"
            "assert 'jax' not in sys.modules and 'cv2' not in sys.modules")
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


def test_words_that_the_terminal_has_no_letters_for() -> None:
    ascii_only = os.environ | {"PYTHONIOENCODING": "ascii:strict"}
    subprocess.run([sys.executable, "-m", "evflow", "estimate", "--help"], check=True,
                   capture_output=True, env=ascii_only)


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["version"]) == 0
    assert "evflow 0.1.0" in capsys.readouterr().out
    assert main(["version", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["evflow"] == "0.1.0"


@pytest.mark.parametrize("line", ["voxel -o {}/v.npz", "render -o {}/r.png"])
def test_facts_for_programs(
    line: str, flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    verb, *rest = line.format(tmp_path).split()
    assert main([verb, str(flight), *rest, "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert Path(facts["out"]).is_file()


def test_an_interrupted_process_ends_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """While XLA compiles in another thread, the usual end is a segmentation fault."""
    def end(code: int) -> None:
        raise SystemExit(f"at once: {code}")

    def interrupted(_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("os._exit", end)
    monkeypatch.setattr("sys.argv", ["evflow", "version"])
    with pytest.raises(SystemExit) as usual:
        cli.run()
    assert usual.value.code == 0
    monkeypatch.setattr("evflow.commands.version.Version.run", interrupted)
    with pytest.raises(SystemExit, match="at once: 130"):
        cli.run()


@pytest.mark.parametrize(("line", "word"), [
    ("estimat flight.h5", "evflow estimate"), ("simulte", "evflow simulate"),
    ("whatever", "Commands: info")])
def test_no_such_command(line: str, word: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(line.split()) == 2
    error = capsys.readouterr().err
    assert "EV020" in error
    assert word in error


def test_a_recording_without_a_command(flight: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(flight)]) == 2
    assert "evflow estimate RECORDING" in capsys.readouterr().err


def test_version_by_option(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("evflow ")


def test_two_cameras(tmp_path: Path, capsys: pytest.CaptureFixture[str], flight: Path) -> None:
    rng = np.random.default_rng(0)
    even = Camera.constant((20, 30), 0.2, 0.3, 0.1, 0.1)
    theta = (0.25 + 0.02 * rng.normal(size=(20, 30))).astype(np.float32)
    uneven = dataclasses.replace(even, theta_on=theta)
    flat = {f"{n}_std": np.full((20, 30), 0.005, np.float32)
            for n in ("theta_on", "theta_off", "eta_on", "eta_off")}
    a, b = tmp_path / "a" / "camera.npz", tmp_path / "b" / "camera.npz"
    for path, camera in ((a, even), (b, uneven)):
        path.parent.mkdir()
        camera.save(path, **flat)
    assert main(["compare", str(a), str(b)]) == 0
    text = capsys.readouterr().out
    assert "They differ in theta_on." in text
    assert main(["compare", str(b), str(b), "--json"]) == 0
    same = json.loads(capsys.readouterr().out)["theta_on"]
    assert same["r"] == pytest.approx(1.0)
    assert same["ratio"] == 1.0
    assert same["apart"] == 0.0
    assert main(["compare", str(a), str(flight)]) == 2
    assert "is a camera" in capsys.readouterr().err


@pytest.mark.parametrize("other", ["keeps", "resets"])
def test_dead_times_of_two_kinds_are_not_alike(
    other: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    paths = [tmp_path / "a.npz", tmp_path / "b.npz"]
    for path, law in zip(paths, ("resets", other), strict=True):
        sensor = SensorModel(refractory_s=5e-3, dead_contrast=law)
        Camera.constant((4, 6)).save(path, **as_arrays(sensor, {"refractory_s": 1e-4}, Optics()))
    assert main(["compare", *map(str, paths)]) == 0
    told = "the first's, reset at its end; the second's, contrast kept" in capsys.readouterr().err
    assert told == (other == "keeps")


def test_two_cameras_beside_each_other_with_their_errors(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As they were measured, not as their median pixel is; and no value of a prior."""
    paths = tmp_path / "static" / "camera.npz", tmp_path / "steps" / "camera.npz"
    for path, theta, noise in zip(paths, (0.2, 0.25), (0.5, 0.6), strict=True):
        path.parent.mkdir()
        summary = Summary(*np.float32([theta, theta, noise, noise, 0.03, 0.03]))
        std = Summary(*np.float32([0.003, 0.003, 0.005, 0.005, 0.001, 0.001]))
        Camera.constant((20, 30), theta + 0.01, theta, noise, noise).save(
            path, **{f"{n}_std": np.full((20, 30), 0.1) for n in (
                "theta_on", "theta_off", "eta_on", "eta_off")},
            **summary_arrays(summary, std),
            **as_arrays(SensorModel(refractory_s=1e-3), {"refractory_s": 2e-5}, Optics()),
            **({"undetermined": ["theta_off"]} if path == paths[0] else {}))
    out = tmp_path / "both"
    assert main(["compare", *map(str, paths), "-o", str(out)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert " ".join(lines[1].split()).startswith("theta_on 0.2000 ± 0.0030 0.2500 ± 0.0030 1.25")
    assert lines[2].split()[:2] == ["theta_off", "–"]
    assert lines[-1] == "They differ in theta_on, eta_on, eta_off."
    kept = json.loads((out / "compare.json").read_text())
    assert (kept["theta_off"]["a"], kept["theta_off"]["b"]) == (None, pytest.approx(0.25))
    assert kept["refractory_s"]["a_std"] == pytest.approx(2e-5)
    page = (out / "compare.html").read_text()
    assert "22.14 ± 0.37" in page  # percent of contrast
    times = [(out / f"compare.{kind}").stat().st_mtime_ns for kind in ("html", "json")]
    assert times == sorted(times)  # interrupted in the page, a command can be given again
    assert page.count("sha256 ") == 2


def test_an_input_that_may_not_be_read_is_not_called_an_output(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "camera.npz"
    path.write_bytes(b"PK")

    def refused(self: object) -> None:
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    monkeypatch.setattr(cli.Info, "run", refused)
    monkeypatch.setattr(cli.os, "access", lambda name, mode: False)
    assert main(["info", str(path)]) == 1
    assert re.search(r"EV016.*cannot be opened \(permission denied\)", capsys.readouterr().err)
