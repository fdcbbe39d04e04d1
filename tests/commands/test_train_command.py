"""Commands that live in the source tree: found there, missed with a code where there is none."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import evflow
from evflow.cli import main
from evflow.commands.source_tree import FORWARDED, forwarded

ROOT = Path(__file__).parents[2]


def run(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "100"}
    return subprocess.run([sys.executable, "-m", "evflow.cli", *arguments], cwd=folder,
                          env=environment, capture_output=True, text=True, check=False)


def test_what_follows_is_the_modules_own() -> None:
    assert forwarded(["train", "--out", "a", "--help"]) == ["train", "--", "--out", "a", "--help"]
    assert forwarded(["train", "--", "--out", "a"]) == ["train", "--", "--out", "a"]
    for other in (["info", "bench"], ["--help"], []):
        assert forwarded(other) == other


@pytest.mark.parametrize("verb", FORWARDED)
def test_without_the_source_tree_it_says_where_to_get_it(
    verb: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "evflow").mkdir()
    (tmp_path / "experiments").mkdir()  # of somebody else
    (tmp_path / "benchmarks").mkdir()
    monkeypatch.setattr(evflow, "__file__", str(tmp_path / "evflow/__init__.py"))
    assert main([verb, "--quick"]) == 1
    error = capsys.readouterr().err
    assert "EV016" in error
    assert "pip install -e ." in error


def test_help_and_errors_are_the_modules_own(tmp_path: Path) -> None:
    shown = run(tmp_path, "bench", "--help")
    assert shown.returncode == 0
    assert "--quick" in shown.stdout
    wrong = run(tmp_path, "bench", "--only", "nothing")
    assert wrong.returncode == 2
    assert "EV020" in wrong.stderr
    assert "Traceback" not in wrong.stderr


@pytest.mark.parametrize("verb", FORWARDED)
def test_help_is_of_the_command_and_has_an_example(
    verb: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as caught:
        main([verb, "--help"])
    assert caught.value.code == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert f"usage: evflow {verb} [-h]" in shown
    assert f"Example: evflow {verb}" in shown
    assert "python -m" not in shown


@pytest.mark.slow
def test_they_run_from_any_folder(tmp_path: Path) -> None:
    trained = run(tmp_path, "train", "--preset", "debug", "--steps", "2", "--out", "run")
    assert trained.returncode == 0, trained.stderr
    assert (tmp_path / "run/weights.safetensors").is_file()
    timed = run(tmp_path, "bench", "--quick", "--only", "voxels", "--out", "times.jsonl")
    assert timed.returncode == 0, timed.stderr
    assert all(json.loads(line) for line in (tmp_path / "times.jsonl").read_text().splitlines())
