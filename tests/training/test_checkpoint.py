"""Damaged checkpoints: the run goes on from the last sound one, says so, and leaves the folder as
a run that never had the others; where none is sound, each is named."""

from __future__ import annotations

import json
import logging
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from evflow.errors import EvflowDataError
from evflow.training.checkpoint import Checkpoints

# What orbax and tensorstore leave running when a file cannot be read.
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning",
                                        "ignore::pytest.PytestUnhandledThreadExceptionWarning")
Damage = Callable[[Path], Any]


def state(step: int) -> dict[str, Any]:
    return {"a": jnp.arange(6.0).reshape(2, 3) + step, "key": jax.random.key(3),
            "step": jnp.int32(step)}


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("sound") / "run"
    with Checkpoints(run) as checkpoints:
        checkpoints.write_config({"a": {"b": 1, "c": [2, 3]}})
        checkpoints.save(1, state(1))
        checkpoints.save(2, state(2))
    return run


@pytest.fixture
def run(tmp_path: Path, sound: Path) -> Path:
    return Path(shutil.copytree(sound, tmp_path / "run"))


def every(change: Callable[[bytes], bytes], name: str = "*") -> Damage:
    def damage(step: Path) -> None:
        for path in step.rglob(name):
            if path.is_file():
                path.write_bytes(change(path.read_bytes()))

    return damage


def without(name: str) -> Damage:
    def damage(step: Path) -> None:
        for path in [*step.rglob(name)]:
            shutil.rmtree(path) if path.is_dir() else path.unlink()

    return damage


def replaced(by: Callable[[Path], object]) -> Damage:
    def damage(step: Path) -> None:
        shutil.rmtree(step)
        by(step)

    return damage


def endless(step: Path) -> None:
    for path in step.rglob("_METADATA"):
        path.unlink()
        path.symlink_to("/dev/zero")


def sparse(step: Path) -> None:
    for path in step.rglob("_METADATA"):
        os.truncate(path, 1 << 36)


DAMAGE: dict[str, Damage] = {
    "endless": endless, "sparse": sparse,
    "truncated": every(lambda data: data[: len(data) // 2]), "emptied": every(lambda _: b""),
    "garbage": every(lambda _: os.urandom(50)), "deep": every(lambda _: b"[" * 100_000, "_*"),
    "flipped": every(lambda data: data[:-20] + bytes(20), "[0-9a-f]*"),
    "without-default": without("default"), "without-data": without("d"),
    "without-manifest": without("manifest.ocdbt"), "empty": replaced(Path.mkdir),
    "file": replaced(lambda step: step.write_text("x")),
    "another": replaced(lambda step: shutil.copytree(step.parents[2] / "other/steps/1", step))}


@pytest.mark.parametrize("kind", DAMAGE)
def test_the_step_before_a_damaged_one_is_gone_on_from(
    run: Path, kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    if kind == "another":
        with Checkpoints(run.with_name("other")) as checkpoints:
            checkpoints.save(1, state(1) | {"a": jnp.ones(4)})
    DAMAGE[kind](run / "steps" / "2")
    with Checkpoints(run) as checkpoints:
        got = checkpoints.restore(state(0))
        np.testing.assert_array_equal(got["a"], state(1)["a"])
        said = capsys.readouterr().err
        checkpoints.save(2, state(2))
    assert "step 2 cannot be read" in said
    assert "going on from step 1" in said
    moved, = run.glob("damaged-2.*")
    assert str(moved) in said
    with Checkpoints(run) as checkpoints:
        np.testing.assert_array_equal(checkpoints.restore(state(0))["a"], state(2)["a"])


def test_steps_that_all_are_damaged_are_named(run: Path) -> None:
    DAMAGE["truncated"](run / "steps")
    with Checkpoints(run) as checkpoints, pytest.raises(EvflowDataError) as caught:
        checkpoints.restore(state(0))
    assert caught.value.code == "EV009"
    assert all(f"step {i} in {run / 'steps' / str(i)}: " in caught.value.seen for i in (1, 2))
    assert f"remove {run / 'steps'} and" in caught.value.fix


@pytest.mark.parametrize("like", [
    state(0) | {"a": jnp.zeros((3, 3))}, state(0) | {"z": jnp.zeros(3)}, {"a": state(0)["a"]}])
def test_another_network_is_told_from_damage(run: Path, like: Any) -> None:
    with Checkpoints(run) as checkpoints, pytest.raises(EvflowDataError, match=r"EV018.*step 2"):
        checkpoints.restore(like)
    assert {p.name for p in (run / "steps").iterdir()} == {"1", "2"}


@pytest.mark.parametrize(("text", "code", "seen"), [
    ("", "EV009", "config.json is damaged"), ('{"a": {"b": 1', "EV009", "config.json is damaged"),
    ("[" * 100_000, "EV009", "config.json is damaged"), ("[]", "EV009", "no configuration"),
    ("\\xff", "EV009", "config.json is damaged"),
    (json.dumps({"a": {"b": 1, "c": [2, 3], "old": 1}}), "EV018", "does not know (a.old)"),
    (json.dumps({"a": {"b": 2, "c": [2, 3]}}), "EV013", "a.b: 2 there, 1 here"),
    (json.dumps({"a": {"c": [2, 3]}}), "EV013", "a.b: absent there, 1 here")])
def test_a_configuration_that_is_not_this_one(run: Path, text: str, code: str, seen: str) -> None:
    (run / "config.json").write_bytes(text.encode("latin-1"))
    with Checkpoints(run) as checkpoints, pytest.raises(EvflowDataError) as caught:
        checkpoints.check_config({"a": {"b": 1, "c": (2, 3)}})
    assert caught.value.code == code
    assert seen in str(caught.value)
    assert str(run) in str(caught.value)


def test_a_run_whose_configuration_is_lost_is_told_from_none(run: Path) -> None:
    (run / "config.json").unlink(missing_ok=True)
    with Checkpoints(run) as checkpoints, pytest.raises(EvflowDataError, match=r"EV009.*missing"):
        checkpoints.check_config({})


@pytest.mark.parametrize(("error", "said", "advice"), [
    (ValueError("RESOURCE_EXHAUSTED: Error writing local file \"/d/ocdbt/\": Failed writing: "
                f"\"/d/{'x' * 300}\" [OS error 28: ENOSPC No space left on device]\n[more]"),
     r"\(No space left on device\)", "Make space"),
    (FileNotFoundError(2, "No such file or directory", "commit_success.txt"),
     r"\(No such file or directory\)", "removed or moved"),
    (ValueError("of another kind\nand more"), r"\(of another kind\)", "Can it be written")])
def test_what_keeps_a_checkpoint_from_being_written_is_named(
    error: Exception, said: str, advice: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    def fails(*_: object, **__: object) -> None:
        logging.getLogger("absl").error("Traceback", exc_info=error)  # as orbax does
        raise error

    with Checkpoints(tmp_path) as checkpoints:
        monkeypatch.setattr(checkpoints._manager(), "save", fails)
        with pytest.raises(EvflowDataError, match=f"EV019.*{said}") as caught:
            checkpoints.save(1, state(1))
    assert advice in caught.value.fix
    assert ("space" in caught.value.fix) == ("space" in said)
    assert not caplog.records


def test_steps_that_are_a_file(tmp_path: Path) -> None:
    (tmp_path / "steps").write_text("x")
    with pytest.raises(EvflowDataError, match=r"EV019.*steps is a file"):
        Checkpoints(tmp_path)
