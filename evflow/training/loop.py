"""The loop of every training: steps, metrics.jsonl and checkpoints, until the last step, the time
limit or a signal, on any number of devices and processes.

A step is dispatched before the metrics of the one before are fetched: the device never waits for
the host, except where a checkpoint is due (the next step takes the state's buffers).
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from evflow.errors import EvflowDataError
from evflow.files.regular import is_there
from evflow.process.devices import Votes, agree, is_main
from evflow.process.signals import stop_requests
from evflow.training.checkpoint import Checkpoints
from evflow.training.config import as_dict
from evflow.training.lock import locked
from evflow.training.log import Headline, Log, Metrics
from evflow.training.options import RunOptions


class Counted(Protocol):
    """A state that counts its steps."""

    @property
    def step(self) -> jax.Array: ...


NO_FILES: Mapping[str, str] = {}
LOG = "metrics.jsonl"
State = TypeVar("State", bound=Counted)
Advance = Callable[[State], tuple[State, dict[str, jax.Array]]]


@dataclass(frozen=True)
class Ended(Generic[State]):
    """Result of a run: its last state, the mean metrics of its last hundred steps, a message if
    a signal to any process stopped it, and the steps that were made now."""

    state: State
    figures: Metrics
    stopped: str = ""
    steps: int = 0

    def completed(self) -> State:
        """The state; KeyboardInterrupt where a signal ended the run."""
        if self.stopped:
            raise KeyboardInterrupt(self.stopped)
        return self.state


def train(
    begin: Callable[[], tuple[Advance[State], State]], config: Any, options: RunOptions,
    headline: Headline = lambda _: "training", files: Mapping[str, str] = NO_FILES,
) -> Ended[State]:
    """Train for config.steps steps, from a fresh state or the run in options.out.

    Every step is logged, and the last one saved, also where time or a signal ends the run; time
    does so with a line on stderr.

    Args:
        begin: returns the step and the fresh state; called after the folder has been checked.
        config: a dataclass that identifies the run; one in the folder must be equal.
        options: where and how long to run.
        headline: text of the progress bar from metrics.
        files: digests of the files that the run rests on, by their names in config.json; they
            identify it too.

    Raises:
        EvflowDataError: EV007 where a metric or the state is not finite (it is not saved), EV013
            where the folder holds another run, or another process trains in it, EV016 where there
            is none to resume, EV020.
    """
    _check(options)
    checkpoints = Checkpoints(options.out)
    with stop_requests() as requests, locked(checkpoints.folder), checkpoints:
        identity = as_dict(config) | dict(files)
        resumed = goes_on(checkpoints, identity, options)
        advance, state = begin()
        if resumed:
            state = checkpoints.restore(state)
        path, begun = options.out / LOG, int(state.step)
        with Log(path, config.steps, begun, headline) as log:
            state, lost = _steps(advance, state, config.steps, options, checkpoints, log, requests)
    # Raised after the checkpoints have been written.
    if lost:
        raise _diverged(lost, checkpoints.latest)
    reached = int(state.step)
    again = "--resume auto goes on" if options.resume == "never" else "the same command goes on"
    stopped = f"stopped after step {reached} of {config.steps}; a checkpoint is saved, and {again}."
    by_signal = agree(bool(requests))
    if not by_signal and reached < config.steps and is_main():
        print(f"--max-seconds {options.max_seconds:g}: {stopped}", file=sys.stderr)
    return Ended(state, log.figures, stopped if by_signal else "", reached - begun)


def _check(options: RunOptions) -> None:
    """EV020 for impossible options, EV016 where there is no folder to resume; none is made yet."""
    if options.save_every < 1:
        raise EvflowDataError("EV020", f"--save-every {options.save_every}.", "Give 1 or more.")
    if not options.max_seconds >= 0:  # nor NaN, which no time reaches
        raise EvflowDataError("EV020", f"--max-seconds {options.max_seconds}.", "Give 0 or more.")
    if options.resume == "must" and not options.out.is_dir():
        raise EvflowDataError("EV016", f"there is no {options.out} to resume.",
                              "Check --out, or pass --resume auto.")


def _diverged(lost: str, latest: int | None) -> EvflowDataError:
    """EV007. lost: what is not finite; latest: the last step that was saved, if any."""
    kept = "no checkpoint was saved yet" if latest is None else (
        f"the last checkpoint is of step {latest}")
    return EvflowDataError("EV007", f"{lost}; {kept}.", "Train at a lower rate, with another "
                           "--out: this command would go on to the same step.")


def goes_on(checkpoints: Checkpoints, config: dict[str, Any], options: RunOptions) -> bool:
    """Whether the run in the folder is continued; else the folder is made this run's.

    A log with steps is a run too, though its checkpoints were removed: another configuration must
    not replace it. Without config.json it is nobody's, as after the removal that EV009 advises.
    """
    logged = checkpoints.latest is not None or _has_steps(options.out / LOG)
    if options.resume == "never" and logged:
        raise EvflowDataError("EV013", f"{options.out} already holds a run.",
                              "Pass --resume auto to go on with it, or another --out.")
    if options.resume == "must" or checkpoints.latest is not None:
        checkpoints.check_config(config)
        return True
    if logged and checkpoints.has_config:
        checkpoints.check_config(config)
    if is_main():
        checkpoints.write_config(config)
    return False


def _has_steps(log: Path) -> bool:
    """Whether a log is there and not empty."""
    return is_there(log) and log.stat().st_size > 0


def _steps(
    advance: Advance[State], state: State, steps: int, options: RunOptions,
    checkpoints: Checkpoints, log: Log, requests: list[int],
) -> tuple[State, str]:
    """The last state, and a message naming what is not finite, else ""."""
    step, votes = int(state.step), Votes()
    # All processes must stop after the same step, though signals and clocks differ.
    while step < steps and not votes.agree(bool(requests) or log.seconds >= options.max_seconds):
        state, metrics = advance(state)
        step += 1
        lost = log.add(step, metrics)
        if not lost and step % options.save_every == 0:
            lost = _save(step, state, checkpoints, log)
        if lost:
            return state, lost
    return state, _save(step, state, checkpoints, log)


def _save(step: int, state: Any, checkpoints: Checkpoints, log: Log) -> str:
    """Save a state whose metrics and arrays are finite; else the message. The metrics are those
    before the step's update, which may be what is not finite."""
    lost = log.flush() or _not_finite(step, state)
    if not lost:
        checkpoints.save(step, state)
    return lost


def _not_finite(step: int, state: Any) -> str:
    """A message naming the first array of the state with NaN or infinity, else ""."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(state):
        if jnp.issubdtype(leaf.dtype, jnp.inexact) and not np.isfinite(np.asarray(leaf)).all():
            return f"{jax.tree_util.keystr(path)} of the state is not finite after step {step}"
    return ""
