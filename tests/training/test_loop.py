"""The loop of every training: it goes on where it stopped, keeps the device busy, and saves nothing
that diverged."""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
import os
import re
import shutil
import signal
import types
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from evflow import cli
from evflow.errors import EvflowDataError
from evflow.network.weights import load_weights
from evflow.process.devices import Votes
from evflow.training import run
from evflow.training.loop import Ended, train
from evflow.training.options import RunOptions
from evflow.training.run import digests

Stepped = tuple["Walk", dict[str, Any]]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Walk:
    step: jax.Array
    at: jax.Array


@dataclasses.dataclass(frozen=True)
class Plan:
    steps: int = 7
    seed: int = 0


def given(out: Path, **changes: Any) -> RunOptions:
    return RunOptions(out=out, **{"save_every": 3, **changes})


def advance(state: Walk) -> Stepped:
    key = jax.random.fold_in(jax.random.key(0), state.step)
    at = state.at + jax.random.normal(key)
    return Walk(state.step + 1, at), {"at": at}


def start() -> Walk:
    return Walk(jnp.zeros((), jnp.int32), jnp.zeros(()))


def saved(out: Path) -> set[str]:
    return {p.name for p in (out / "steps").iterdir()}


def test_it_goes_on_where_it_stopped(tmp_path: Path) -> None:
    straight = train(lambda: (advance, start()), Plan(), given(tmp_path / "a"))
    assert int(straight.completed().step) == 7

    def stopped_early(state: Walk) -> Stepped:
        if int(state.step) == 4:
            os.kill(os.getpid(), signal.SIGTERM)
        return advance(state)

    ended = train(lambda: (stopped_early, start()), Plan(), given(tmp_path / "b"))
    with pytest.raises(KeyboardInterrupt, match=r"stopped after step 5 of 7.*goes on"):
        ended.completed()
    assert int(ended.state.step) == 5
    assert saved(tmp_path / "b") == {"3", "5"}
    with (tmp_path / "b" / "metrics.jsonl").open("a") as log:  # a crash after the checkpoint
        log.write('{"step": 6, "time": 1.0, "at": 0.0}\n{"step": 7, "ti')
    again = train(lambda: (advance, start()), Plan(), given(tmp_path / "b", resume="must"))
    np.testing.assert_array_equal(again.state.at, straight.state.at)
    logs = [[json.loads(line) for line in text.splitlines()] for text in (
        (tmp_path / name / "metrics.jsonl").read_text() for name in "ab")]
    for row in itertools.chain(*logs):
        del row["time"]
    assert logs[0] == logs[1]
    assert [row["step"] for row in logs[0]] == list(range(1, 8))
    assert straight.figures["at"] == pytest.approx(np.mean([row["at"] for row in logs[0]]))


def test_a_finished_run_that_is_repeated_makes_no_step_and_has_the_same_figures(
    tmp_path: Path
) -> None:
    first, again = (train(lambda: (advance, start()), Plan(), given(tmp_path)) for _ in range(2))
    assert (first.steps, again.steps) == (7, 0)
    assert again.figures == pytest.approx(first.figures)


def test_weights_to_start_from_identify_a_run(tmp_path: Path) -> None:
    begin = lambda: (advance, start())  # noqa: E731
    train(begin, Plan(), given(tmp_path / "a", max_seconds=0.0), files={"start": "abc"})
    train(begin, Plan(), given(tmp_path / "a"), files={"start": "abc"})
    for there, here in (("abc", None), ("abc", "def")):
        with pytest.raises(EvflowDataError, match=f"EV013.*start: {there} there, {here} here"):
            train(begin, Plan(), given(tmp_path / "a"), files={"start": here} if here else {})
    train(begin, Plan(), given(tmp_path / "b"))
    with pytest.raises(EvflowDataError, match=r"EV013.*start: None there, abc here"):
        train(begin, Plan(), given(tmp_path / "b"), files={"start": "abc"})


def test_pictures_identify_a_run(tmp_path: Path) -> None:
    """By their names and sizes, or a json by its bytes, not by the path alone."""
    begin = lambda: (advance, start())  # noqa: E731
    pictures, objects = tmp_path / "pictures", tmp_path / "objects.json"
    pictures.mkdir()
    (pictures / "0.png").write_bytes(b"one")
    objects.write_text("[]")
    changes = ((pictures, lambda: (pictures / "0.png").write_bytes(b"another")),
               (objects, lambda: objects.write_text("[1]")))
    for images, change in changes:
        out = tmp_path / f"run of {images.name}"
        assert train(begin, Plan(), given(out), files=digests(None, str(images))).steps == 7
        assert train(begin, Plan(), given(out), files=digests(None, str(images))).steps == 0
        change()
        with pytest.raises(EvflowDataError, match=r"EV013.*images_sha256: \w+ there, \w+ here"):
            train(begin, Plan(), given(out), files=digests(None, str(images)))
        config = json.loads((out / "config.json").read_text())
        del config["images_sha256"]  # as of an earlier version
        (out / "config.json").write_text(json.dumps(config))
        assert train(begin, Plan(), given(out), files=digests(None, str(images))).steps == 0


def test_it_stops_in_time_and_keeps_runs_apart(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    none = given(tmp_path / "a", max_seconds=0.0)
    assert int(train(lambda: (advance, start()), Plan(), none).completed().step) == 0
    assert re.search("--max-seconds 0: stopped after step 0 of 7.*goes on", capsys.readouterr().err)
    with pytest.raises(EvflowDataError, match=r"EV013.*seed"):
        train(lambda: (advance, start()), Plan(seed=1), none)
    with pytest.raises(EvflowDataError, match="EV013"):
        train(lambda: (advance, start()), Plan(), dataclasses.replace(none, resume="never"))
    with pytest.raises(EvflowDataError, match="EV016"):
        train(lambda: (advance, start()), Plan(), given(tmp_path / "none", resume="must"))
    for name, value in (("save_every", 0), ("max_seconds", -5.0), ("max_seconds", math.nan)):
        with pytest.raises(EvflowDataError, match=rf"EV020.*--{name.replace('_', '-')} {value}"):
            train(lambda: (advance, start()), Plan(), given(tmp_path / "none", **{name: value}))
    assert not (tmp_path / "none").exists()


def test_nothing_is_begun_in_the_folder_of_another_run(tmp_path: Path) -> None:
    train(lambda: (advance, start()), Plan(), given(tmp_path))

    def begin() -> Any:
        raise AssertionError("begun")

    for plan, options in ((Plan(seed=1), given(tmp_path)),
                          (Plan(), given(tmp_path, resume="never"))):
        with pytest.raises(EvflowDataError, match="EV013"):
            train(begin, plan, options)


def test_a_run_without_its_checkpoints_is_not_replaced(tmp_path: Path) -> None:
    begin = lambda: (advance, start())  # noqa: E731
    train(begin, Plan(), given(tmp_path))
    log = (tmp_path / "metrics.jsonl").read_text()
    shutil.rmtree(tmp_path / "steps")
    for plan, options, seen in ((Plan(seed=1), given(tmp_path), "seed: 0 there, 1 here"),
                                (Plan(), given(tmp_path, resume="never"), "already holds a run")):
        with pytest.raises(EvflowDataError, match=f"EV013.*{seen}"):
            train(begin, plan, options)
    assert (tmp_path / "metrics.jsonl").read_text() == log
    assert train(begin, Plan(), given(tmp_path)).steps == 7  # the same run, from its beginning
    shutil.rmtree(tmp_path / "steps")
    (tmp_path / "config.json").unlink()  # as EV009 advises where the steps are damaged
    assert train(begin, Plan(seed=1), given(tmp_path)).steps == 7


def test_only_one_process_trains_in_a_folder(tmp_path: Path) -> None:
    """A second run would remove what the first is writing, and overwrite its configuration."""
    def meanwhile(state: Walk) -> Stepped:
        with pytest.raises(EvflowDataError, match=rf"EV013.*process {os.getpid()} on .*training"):
            train(lambda: (advance, start()), Plan(seed=1), given(tmp_path))
        return advance(state)

    assert train(lambda: (meanwhile, start()), Plan(), given(tmp_path)).steps == 7
    assert json.loads((tmp_path / "config.json").read_text())["seed"] == 0
    assert train(lambda: (advance, start()), Plan(), given(tmp_path)).steps == 0  # it was released


@pytest.mark.parametrize(("bad", "kept"), [
    (2, set()), (3, set()), (4, {"3"}), (5, {"3"}), (6, {"3"}), (7, {"3", "6"})])
def test_what_diverges_is_not_saved(bad: int, kept: set[str], tmp_path: Path) -> None:
    def diverges(state: Walk) -> Stepped:
        state, metrics = advance(state)
        if int(state.step) != bad:
            return state, metrics
        return Walk(state.step, state.at * jnp.nan), {"at": state.at * jnp.nan}

    last = max(kept, default=None)
    with pytest.raises(EvflowDataError, match=rf"EV007.*at = nan after step {bad}; (.*)\. Train at"
                       ) as caught:
        train(lambda: (diverges, start()), Plan(), given(tmp_path))
    assert (f"last checkpoint is of step {last}" if last else "no checkpoint") in caught.value.seen
    assert saved(tmp_path) == kept
    lines = (tmp_path / "metrics.jsonl").read_text().splitlines()
    assert json.loads(lines[-1])["step"] == bad


@pytest.mark.parametrize(("bad", "kept"), [(3, set()), (6, {"3"}), (7, {"3", "6"})])
def test_an_update_that_is_not_finite_is_not_saved(
    bad: int, kept: set[str], tmp_path: Path
) -> None:
    """Its metrics are those before it; saved, it would end every later attempt."""
    def diverges(state: Walk) -> Stepped:
        state, metrics = advance(state)
        return (Walk(state.step, state.at * jnp.inf) if int(state.step) == bad else state), metrics

    with pytest.raises(EvflowDataError, match=rf"EV007.*\.at of the state.*after step {bad};"):
        train(lambda: (diverges, start()), Plan(), given(tmp_path))
    assert saved(tmp_path) == kept


def test_the_next_step_is_on_its_way_before_metrics_are_fetched(tmp_path: Path) -> None:
    order: list[str] = []

    class Metric:
        def __init__(self, step: int) -> None:
            self.step = step

        def __float__(self) -> float:
            order.append(f"fetch {self.step}")
            return 0.0

    def step(state: Walk) -> Stepped:
        state, _ = advance(state)
        order.append(f"step {state.step}")
        return state, {"loss": Metric(int(state.step))}

    train(lambda: (step, start()), Plan(steps=5), given(tmp_path))
    # A checkpoint waits for its metrics: what diverged is not saved.
    assert order == ["step 1", "step 2", "fetch 1", "step 3", "fetch 2", "fetch 3", "step 4",
                     "step 5", "fetch 4", "fetch 5"]


@pytest.mark.parametrize("vote", [True, False])
def test_alone_a_vote_counts_at_once(vote: bool) -> None:
    votes = Votes()
    assert [votes.agree(v) for v in (False, vote)] == [False, vote]


def test_weights_of_another_run_in_the_folder_are_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Though they are of as many steps; those of a run that is only repeated stay."""
    def command(at: float, steps: int, *options: str) -> bool:
        average = {"default": {"a": jnp.full(3, at)}}
        state = types.SimpleNamespace(step=jnp.int32(5), average=average)
        monkeypatch.setattr(run, "train", lambda *_: Ended(state, {"loss": 1.0}, "", steps))
        assert cli.main(["train", "--preset", "debug", "--out", str(tmp_path), *options]) == 0
        kept, = jax.tree.leaves(load_weights(tmp_path / "weights.safetensors"))
        return bool(kept[0] == at)

    assert command(1.0, 5)
    assert not command(2.0, 0)
    assert command(3.0, 0, "--seed", "1")


@pytest.mark.parametrize(("stopped", "code"), [("", 0), ("stopped after step 5 of 20.", 130)])
def test_a_training_that_a_signal_ends_says_so(
    stopped: str, code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """So that what a script does next does not take its weights for those of the whole run."""
    state = types.SimpleNamespace(step=jnp.int32(5), average={"default": {"a": jnp.ones(3)}})
    monkeypatch.setattr(run, "train", lambda *_: Ended(state, {"loss": 1.0}, stopped))
    assert cli.main(["train", "--preset", "debug", "--out", str(tmp_path)]) == code
    assert (tmp_path / "weights.safetensors").exists()
    said = capsys.readouterr().err
    assert (f"{stopped} {tmp_path / 'weights.safetensors'} is of that step." in said) == (code > 0)
