"""Training, of the installed package alone; benchmarks, where the source tree is at hand."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import evflow
from evflow.cli import main
from evflow.commands.bench import forwarded

ROOT = Path(__file__).parents[2]


def run(
    folder: Path, *arguments: str, package: Path = ROOT
) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(package), "COLUMNS": "100"}
    return subprocess.run([sys.executable, "-m", "evflow.cli", *arguments], cwd=folder,
                          env=environment, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the package and nothing else of the source tree, amid other people's."""
    folder = tmp_path_factory.mktemp("site-packages")
    shutil.copytree(Path(evflow.__file__).parent, folder / "evflow",
                    ignore=shutil.ignore_patterns("__pycache__"))
    for other in ("experiments", "benchmarks"):
        (folder / other).mkdir()
    return folder


def test_what_follows_is_the_benchmarks_own() -> None:
    assert forwarded(["bench", "--out", "a", "--help"]) == ["bench", "--", "--out", "a", "--help"]
    assert forwarded(["bench", "--", "--out", "a"]) == ["bench", "--", "--out", "a"]
    for other in (["info", "bench"], ["--help"], []):
        assert forwarded(other) == other


def test_benchmarks_are_offered_where_there_are_any(installed: Path, tmp_path: Path) -> None:
    shown = run(tmp_path, "--help")
    alone = run(tmp_path, "--help", package=installed)
    assert shown.returncode == alone.returncode == 0
    assert "• bench" in shown.stdout
    assert "• bench" not in alone.stdout
    assert "• train" in alone.stdout
    refused = run(tmp_path, "bench", "--quick", package=installed)
    assert refused.returncode == 2
    assert "Traceback" not in refused.stderr


def test_the_benchmarks_help_and_errors_are_their_own(tmp_path: Path) -> None:
    shown = run(tmp_path, "bench", "--help")
    assert shown.returncode == 0
    assert "--quick" in shown.stdout
    wrong = run(tmp_path, "bench", "--only", "nothing")
    assert wrong.returncode == 2
    assert "EV020" in wrong.stderr
    assert "Traceback" not in wrong.stderr


@pytest.mark.parametrize("verb", ["train", "bench"])
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


def test_what_a_training_cannot_do_is_told_at_once(installed: Path, tmp_path: Path) -> None:
    for wrong in (("--scenes", "0"), ("--save-every", "0"), ("--steps", "-1")):
        refused = run(tmp_path, "train", "--preset", "debug", "--out", "run", *wrong,
                      package=installed)
        assert refused.returncode == 2, refused.stderr
        assert refused.stderr.startswith("EV020")
    absent = run(tmp_path, "train", "--out", "run", "--resume", "must", package=installed)
    assert absent.returncode == 1
    assert absent.stderr.startswith("EV016")
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_they_run_from_any_folder(installed: Path, tmp_path: Path) -> None:
    trained = run(tmp_path, "train", "--preset", "debug", "--steps", "2", "--out", "run",
                  package=installed)
    assert trained.returncode == 0, trained.stderr
    assert (tmp_path / "run/weights.safetensors").is_file()
    timed = run(tmp_path, "bench", "--quick", "--only", "voxels", "--out", "times.jsonl")
    assert timed.returncode == 0, timed.stderr
    assert all(json.loads(line) for line in (tmp_path / "times.jsonl").read_text().splitlines())
