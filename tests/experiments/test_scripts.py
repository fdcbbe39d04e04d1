"""The scripts as a set: each stands alone, is short or known to be long, and has a small preset."""

from __future__ import annotations

import ast
import dataclasses
import importlib
import runpy
import sys
import typing
from pathlib import Path
from typing import Any

import jax
import pytest

import experiments
from evflow.training.config import PRESETS
from experiments import evaluate, template
from experiments.shared import eventgan_scores, network_figures, targets
from experiments.shared.cameras import Protocol
from experiments.shared.common import StudyOptions, markdown
from experiments.shared.many import Setup, study

FOLDER = Path(next(iter(experiments.__path__)))
SCRIPTS = sorted(p.stem for p in FOLDER.glob("*.py") if p.stem != "__init__")
LINES = 120
NO_DEBUG = {
    "quickstart": "one small recording, whose size is asked for",
    "evaluate_network": "as long as the recordings it is given",
    "guessed_frames": "as many cameras as are asked for",
    "combine": "computes next to nothing",
    "gallery": "as many pictures as are asked for",
    "calibrate": "as many steps as are asked for",
    "long_recordings": "as long as is asked for",
    "fuse": "as many recordings as are asked for",
    "tell_apart": "as many recordings as are asked for"}


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_script_is_in_the_document(name: str) -> None:
    rows = (FOLDER.parent / "docs" / "experiments.md").read_text().split("\n| ")
    assert any(f"`{name}`" in row.split("|")[0] or f"`{name} " in row.split("|")[0]
               for row in rows)


def tree(name: str) -> ast.Module:
    return ast.parse((FOLDER / f"{name}.py").read_text())


def modules(path: Path) -> set[str]:
    """What a file imports of experiments, in full."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return {name for name in found if name.split(".")[0] == "experiments"}


@pytest.mark.parametrize("path", sorted(FOLDER.rglob("*.py")),
                         ids=lambda p: str(p.relative_to(FOLDER)))
def test_nothing_imports_a_script(path: Path) -> None:
    for name in modules(path):
        assert name.startswith("experiments.shared."), f"{path} imports {name}"


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_script_has_options_a_main_and_few_lines(name: str) -> None:
    script = importlib.import_module(f"experiments.{name}")
    assert dataclasses.is_dataclass(script.Options)
    assert callable(script.main)
    assert ast.get_docstring(tree(name))
    assert f"python -m experiments.{name}" in script.__doc__
    assert len((FOLDER / f"{name}.py").read_text().splitlines()) <= LINES


def test_the_script_that_trains_has_the_options_of_the_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    given: list[Any] = []
    monkeypatch.setattr("evflow.training.run.train_network", given.append)
    monkeypatch.delitem(sys.modules, "experiments.train", raising=False)
    for option, code in (("--loss.flow", 0), ("--loss.flw", 1)):
        monkeypatch.setattr(sys, "argv", ["train", "--preset", "debug", option, ".25",
                                          "--out", str(tmp_path)])
        with pytest.raises(SystemExit) as ended:
            runpy.run_module("experiments.train", run_name="__main__")
        assert (ended.value.code != 0) == code
    assert [(run.preset, run.loss.flow, run.out) for run in given] == [("debug", .25, tmp_path)]
    assert f"written to {tmp_path}" in capsys.readouterr().out
    assert "EV020" in str(ended.value)


def test_held_out_means_held_out() -> None:
    """No script scores weights on the seed that one trains them by; the targets' scenes, whose
    keys are folded from names, are others than those of a study by the same seed."""
    training = {"calibrate", "fuse", "tell_apart", "train", "train_eventgan",
                "train_network"}
    draws_none = {"real_recordings", "guessed_frames"}  # real scenes; its seeds begin at 1000
    seeds: dict[bool, dict[int, str]] = {True: {}, False: {}}
    for name in set(SCRIPTS) - draws_none:
        fields = {f.name: f.default for f in dataclasses.fields(
            importlib.import_module(f"experiments.{name}").Options)}
        if "seed" in fields and (name in training or "weights" in fields):
            seeds[name in training][fields["seed"]] = name
    assert training <= {*seeds[True].values(), "train", "train_eventgan", "train_network"}
    assert len(seeds[False]) > 8
    assert not seeds[True].keys() & seeds[False].keys()
    held_out = {network_figures.HELD_OUT, eventgan_scores.HELD_OUT}
    assert not held_out & seeds[True].keys()
    study, folded = jax.random.split(jax.random.key(targets.SEED)), targets._key("textures")
    assert jax.random.key_data(folded).tolist() not in jax.random.key_data(study).tolist()


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_script_has_a_debug_preset_or_a_reason(name: str) -> None:
    script = importlib.import_module(f"experiments.{name}")
    hint = typing.get_type_hints(script.Options).get("preset")
    choices = PRESETS if hint is str else typing.get_args(hint)
    assert ("debug" in choices) == (name not in NO_DEBUG)


def test_reasons_are_of_scripts() -> None:
    assert set(NO_DEBUG) <= set(SCRIPTS)


def test_a_table_has_a_line_a_row() -> None:
    assert markdown(("a", "b"), [("1", "2"), ("3", "4")]) == (
        "| a | b |\n|---|---|\n| 1 | 2 |\n| 3 | 4 |")


def test_a_study_counts_as_the_preset_does() -> None:
    options = StudyOptions(out=Path(), seed=0)
    assert options.count(None, debug=3, full=9) == 3
    assert dataclasses.replace(options, preset="full").count(None, debug=3, full=9) == 9
    assert options.count(5, debug=3, full=9) == 5


def nothing(_params: object, _hidden: object, protocol: Protocol) -> int | None:
    return protocol.intervals if protocol.intervals > 2 else None


def test_a_study_leaves_out_what_tells_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("hidden_recording", "load_weights", "make_bank"):
        monkeypatch.setattr(f"experiments.shared.many.{name}", lambda *_, **__: None)
    monkeypatch.setattr("experiments.shared.many._SHARED", {})
    protocols = [Protocol(intervals=n) for n in (2, 4, 3)]
    assert study(nothing, Setup("default", 0), protocols, 1, "recordings") == [4, 3]


@pytest.mark.slow
def test_the_template_runs(tmp_path: Path) -> None:
    result = template.main(template.Options(out=tmp_path))
    assert result.keys() == {"theta_on", "theta_off"}
    assert all(0 < v < 0.2 for v in result.values())
    assert {p.name for p in tmp_path.iterdir()} == {"template.json", "template.md"}
    assert evaluate.Options().weights == template.Options().weights
