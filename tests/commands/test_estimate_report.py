"""`evflow estimate` writes the report, and long work begins only where it can be written."""

from __future__ import annotations

import builtins
import json
import signal
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.networks import hidden

from evflow import (
    Events,
    EvflowDataError,
    Recording,
    Summary,
    write_events,
    write_recording,
)
from evflow.cli import main
from evflow.estimation import pipeline


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("rec") / "flight.npz"
    write_events(path, hidden(15, 440)[0], format="npz")
    return path


def test_estimate_writes_the_report(flight: Path, tmp_path: Path) -> None:
    out = tmp_path / "cam"
    command = ["estimate", str(flight), "-o", str(out), "--no-plots"]
    assert main(command) == 0
    text = (out / "report.html").read_text()
    assert text.count("<section") == 12
    assert "flight.npz" in text
    assert text.count("sha256 ") == 2  # of the weights and of the recording
    assert sorted(p.name for p in out.iterdir()) == ["camera.json", "camera.npz", "report.html"]


def test_without_a_report(flight: Path, tmp_path: Path) -> None:
    out = tmp_path / "cam"
    assert main(["estimate", str(flight), "-o", str(out), "--no-plots", "--no-report"]) == 0
    assert not (out / "report.html").exists()
    assert json.loads((out / "camera.json").read_text())["windows"] > 0


@pytest.mark.parametrize("command", [["estimate"], ["compare"]])
def test_without_matplotlib_it_says_so_at_once(
    flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: list[str],
    capsys: pytest.CaptureFixture[str],
) -> None:
    real = builtins.__import__

    def missing(name: str, *args: Any, **kwargs: Any) -> Any:
        if name.split(".")[0] == "matplotlib":
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", missing)
    inputs = [str(flight)] * (1 if command == ["estimate"] else 2)
    assert main([*command, *inputs, "-o", str(tmp_path / "out")]) == 1
    said = capsys.readouterr().err
    assert "EV010" in said
    assert "pass --no-plots" in said
    assert ("--no-report" in said) == (command == ["estimate"])  # compare has no such option
    assert not (tmp_path / "out").exists()


def test_all_that_is_missing_is_named_once_the_path_is_right(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.h5").write_bytes(b"\x89HDF\r\n\x1a\n")
    for name in ("h5py", "matplotlib"):
        monkeypatch.setitem(sys.modules, name, None)
    assert main(["estimate", str(tmp_path / "absent.h5"), "-o", str(tmp_path / "out")]) == 1
    assert capsys.readouterr().err.startswith("EV016")
    for command in (["estimate", "a.h5"], ["compare", "a.h5", "a.h5"]):
        inputs = [str(tmp_path / name) for name in command[1:]]
        assert main([command[0], *inputs, "-o", str(tmp_path / "out")]) == 1
        said = capsys.readouterr().err
        assert said.startswith("EV010")
        assert "h5py" in said
        assert "matplotlib" in said
        assert "evflow-jax[io,viz]" in said
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("verb", ["compare", "render"])
def test_help_has_an_example(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main([verb, "--help"])
    assert caught.value.code == 0
    assert f"Example: evflow {verb}" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(("options", "effort", "ends"), [
    ([], "normal", False),
    (["--effort", "quick", "--budget-s", "1e9"], "quick", False),
    (["--budget-s", "0"], "normal", True),
    (["--on-interrupt", "save"], "normal", True),
])
def test_how_much_is_read(
    flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: list[str], effort: str,
    ends: bool,
) -> None:
    """A budget that is spent and Ctrl-C, where that is asked for, end reading and nothing else."""
    asked: list[Any] = []

    def estimated(*_: Any, **given: Any) -> None:
        if "save" in options:
            signal.raise_signal(signal.SIGINT)
        so_far = Summary(*np.full(6, np.float32(0.2)))
        asked.append((given["effort"], given["until"](so_far, so_far)))
        raise EvflowDataError("EV017", "read.")

    monkeypatch.setattr(pipeline, "measure", estimated)
    assert main(["estimate", str(flight), "-o", str(tmp_path / "cam"), *options]) == 1
    assert asked == [(effort, ends)]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_budget_below_nothing(flight: Path, tmp_path: Path) -> None:
    command = ["estimate", str(flight), "-o", str(tmp_path / "cam")]
    assert main([*command, "--budget-s", "-1"]) == 2
    assert main([*command, "--budget-s", "nan"]) == 2
    assert main([*command, "--protocol", "static", "--effort", "full"]) == 2


@pytest.mark.parametrize("option", [None, "--thresholds", "--triggers", "--frames"])
def test_no_input_is_replaced(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], option: str | None
) -> None:
    """A recording called rec/camera.npz, or thresholds that lie where the camera is written."""
    recording = tmp_path / "rec" / ("camera.npz" if option is None else "flight.npz")
    recording.parent.mkdir()
    write_events(recording, hidden(15, 440)[0], format="npz")
    source = recording.with_name("camera.npz")
    if option:
        source.write_bytes(b"a source")
    before = source.read_bytes()
    protocol = "step" if option == "--triggers" else "static"
    command = ["estimate", str(recording), "-o", str(tmp_path / "rec"), "--protocol", protocol]
    assert main([*command, "--overwrite", *([option, str(source)] if option else [])]) == 2
    assert "EV020" in (said := capsys.readouterr().err)
    assert "is also an input" in said
    assert source.read_bytes() == before


def test_a_bench_is_told_to_say_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """And nothing else is said of frames that are alike while the light rests."""
    def ended(*_: Any, **__: Any) -> None:
        raise EvflowDataError("EV017", "so far.")

    monkeypatch.setattr(pipeline, "measure", ended)
    path, out = tmp_path / "screen.npz", tmp_path / "cam"
    light = np.repeat([30, 90, 30, 90, 200, 30], 10).astype(np.uint8)
    frames = np.broadcast_to(light[:, None, None], (60, 24, 32))
    rng = np.random.default_rng(0)
    t = np.sort(rng.integers(0, 600_000, 40_000))
    events = Events(rng.integers(0, 32, t.size), rng.integers(0, 24, t.size), t,
                    rng.random(t.size) < 0.5, (32, 24))
    write_recording(path, Recording(events, np.ascontiguousarray(frames), 10_000 * np.arange(60)))
    assert main(["estimate", str(path), "-o", str(out), "--no-checks"]) == 1
    said = capsys.readouterr().err
    assert said.count("--protocol step") == 1
    assert "EV028" not in said
