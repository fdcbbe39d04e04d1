"""Training, of the installed package alone."""

from __future__ import annotations

import dataclasses
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import tyro

import evflow
from evflow.camera import CameraPrior
from evflow.cli import main
from evflow.commands.arguments import attributes
from evflow.commands.train import with_configuration
from evflow.errors import EvflowDataError
from evflow.network.config import ModelConfig
from evflow.network.flow.config import FlowConfig
from evflow.scenes import sources
from evflow.scenes.config import SceneConfig
from evflow.training import run as runs
from evflow.training.config import PRESETS, LossConfig, NuisanceConfig, TrainConfig
from evflow.training.run import configuration

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


def test_help_is_of_the_command_and_has_an_example(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(["train", "--help"])
    assert caught.value.code == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "usage: evflow train [-h]" in shown
    assert "Example: evflow train" in shown
    assert "python -m" not in shown


def test_what_a_training_cannot_do_is_told_at_once(
    installed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for wrong in (("--scenes", "0"), ("--save-every", "0"), ("--steps", "-1")):
        assert main(["train", "--preset", "debug", "--out", str(tmp_path / "run"), *wrong]) == 2
        assert capsys.readouterr().err.startswith("EV020")
    absent = run(tmp_path, "train", "--out", "run", "--resume", "must", package=installed)
    assert absent.returncode == 1
    assert absent.stderr.startswith("EV016")
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_it_runs_from_any_folder(installed: Path, tmp_path: Path) -> None:
    trained = run(tmp_path, "train", "--preset", "debug", "--steps", "2", "--out", "run",
                  package=installed)
    assert trained.returncode == 0, trained.stderr
    assert (tmp_path / "run/weights.safetensors").is_file()
    assert "written to run/: " in trained.stdout


def parsed(*words: str, preset: str = "debug") -> TrainConfig:
    """The configuration of a command line."""
    arguments = ["train", "--preset", preset, "--out", "run", *words]
    return configuration(tyro.cli(with_configuration(arguments), args=arguments[1:]), 1)


def test_every_number_of_the_configuration_is_an_option() -> None:
    assert parsed() == PRESETS["debug"]
    changed = parsed("--loss.flow", "0.1", "--model.flow.steps", "1", "--prior.theta", "0.1", "0.4",
                     "--steps", "3", "--loss.no-adaptive", "--block", "8", "8", "--seed", "4")
    base = PRESETS["debug"]
    assert changed == dataclasses.replace(
        base, loss=dataclasses.replace(base.loss, flow=0.1, adaptive=False), steps=3, block=(8, 8),
        model=dataclasses.replace(base.model, flow=dataclasses.replace(base.model.flow, steps=1)),
        prior=dataclasses.replace(base.prior, theta=(0.1, 0.4)), seed=4)


def test_scenes_are_made_of_ones_own_images(monkeypatch: pytest.MonkeyPatch) -> None:
    for kind in ("coco", "folder"):
        monkeypatch.setattr(sources, f"{kind}_bank", lambda _, path, kind=kind: (kind, path))
    for given, kind in (("instances.json", "coco"), ("pictures", "folder")):
        assert runs.bank_of(parsed("--images", given), photos=False) == (kind, given)
    monkeypatch.undo()
    with pytest.raises(EvflowDataError, match="EV016"):
        runs.bank_of(parsed("--images", "nowhere/pictures"), photos=False)


def test_each_change_of_the_paper_is_an_option() -> None:
    """What makes the literal preset of ours can be said on a command line."""
    words = ("--block 64 64 --scenes 10 --cameras 1 --windows 8 --sequences 300 --steps 9000 "
             "--warmup 300 --clip inf --ema 0 --loss.condition 2 --loss.inverse-flow 1 "
             "--loss.dequantise 0 --loss.patches 8 16 32 --loss.edges gradient --loss.elu "
             "--learning-rate 1e-4 --flow-rate 1e-4")
    assert parsed(*words.split(), preset="paper") == PRESETS["literal"]


@pytest.mark.parametrize(("words", "said"), [
    (["--model.flow.coupling", "affine"], "no option --model.flow.coupling. model.flow has"),
    (["--los.flow", "1"], "no option --los.flow. A configuration has model, loss"),
    (["--steps.flow", "1"], "no option --steps.flow. steps has no fields"),
    (["--model.flow.levels", "3"], "unlike any of .*: its weights could not be read again"),
    (["--prior.theta", "0.5", "0.1"], "Give .low, high."),
])
def test_what_is_no_configuration_is_refused(words: list[str], said: str) -> None:
    with pytest.raises(EvflowDataError, match=f"EV020.*{said}"):
        parsed(*words)


def test_presets_are_the_choices(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(PRESETS, "mine", dataclasses.replace(PRESETS["debug"], clip=0.25))
    with pytest.raises(SystemExit):
        main(["train", "--preset", "mine", "--help"])
    shown = " ".join(capsys.readouterr().out.split())
    assert f"{{{','.join(PRESETS)}}}" in shown  # those of documents that ran, too
    assert re.search(r"--clip FLOAT [^(]*\(default: 0\.25\)", shown.replace(" │ │ ", " "))
    assert "--model.flow.hidden INT" in shown


@pytest.mark.parametrize("held", [
    TrainConfig, LossConfig, NuisanceConfig, ModelConfig, FlowConfig, SceneConfig, CameraPrior])
def test_every_number_of_a_training_is_explained(held: type) -> None:
    named = {f.name for f in dataclasses.fields(held)
             if not dataclasses.is_dataclass(getattr(held(), f.name))}
    assert set(attributes(held)) == named
