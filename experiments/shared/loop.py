"""The loop of the small trainings: steps, metrics.jsonl and checkpoints, until the last step, the
time limit or a signal. One process; `experiments.train` has the loop for many."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol, TypeVar

import jax

from evflow.errors import EvflowDataError
from evflow.files.atomic import atomic_write
from evflow.process.terminal import bar
from evflow.training.checkpoint import Checkpoints
from experiments.shared.common import at_least
from experiments.train import Resume, goes_on, lines_until, stop_requests

State = TypeVar("State", bound="Counted")
Advance = Callable[[State], tuple[State, dict[str, jax.Array]]]


class Counted(Protocol):
    """A state knows how many steps it is."""

    @property
    def step(self) -> jax.Array: ...


class Options(Protocol):
    """What the loop reads of a command's options."""

    @property
    def out(self) -> Path: ...
    @property
    def max_seconds(self) -> float: ...
    @property
    def resume(self) -> Resume: ...
    @property
    def save_every(self) -> int: ...


def train(advance: Advance, fresh: State, config: Any, options: Options) -> State:
    """The state after config.steps calls of `advance`, from `fresh` or the run in options.out.

    config: a dataclass that says what the run is; one in the folder must be the same. The state
    has `step`; every one is logged, and the last is saved, also where time ends it, or a signal,
    after which this raises KeyboardInterrupt. Raises EV007 where a metric is no longer finite: that
    state is not saved.
    """
    at_least(1, save_every=options.save_every)
    if options.resume == "must" and not options.out.is_dir():  # before a folder is made
        raise EvflowDataError("EV016", f"there is no {options.out} to resume.",
                              "Check --out, or pass --resume auto.")
    with stop_requests() as requests, Checkpoints(options.out) as checkpoints:
        state = fresh
        resumed = goes_on(checkpoints, config, options.out, options.resume)
        if resumed and checkpoints.latest is not None:
            state = checkpoints.restore(state)
        state, lost = _run(advance, state, config.steps, options, checkpoints, requests)
    # Raised out here, where checkpoints are written.
    if lost:
        raise EvflowDataError("EV007", f"{', '.join(lost)} after step {int(state.step)}.",
                              f"Checkpoints before it are in {options.out}; train at a lower rate.")
    if requests:
        raise KeyboardInterrupt(f"stopped after step {int(state.step)} of {config.steps}; a "
                                "checkpoint is saved, and the same command goes on.")
    return state


def _run(
    advance: Advance, state: State, steps: int, options: Options, checkpoints: Checkpoints,
    requests: list[int],
) -> tuple[State, list[str]]:
    """The last state, and its metrics that are not finite, if any."""
    started, step = time.monotonic(), int(state.step)
    path = options.out / "metrics.jsonl"
    kept = "".join(f"{line}\n" for line in lines_until(path, step))
    with atomic_write(path, overwrite=True) as temporary:
        temporary.write_text(kept)
    with bar("training") as progress, path.open("a", buffering=1) as log:
        while (step < steps and not requests
               and time.monotonic() - started < options.max_seconds):
            state, metrics = advance(state)
            step += 1
            values = {k: float(v) for k, v in jax.device_get(metrics).items()}
            seconds = time.monotonic() - started
            log.write(json.dumps({"step": step, "time": seconds, **values}) + "\n")
            progress(step, steps)
            if lost := [f"{k} = {v}" for k, v in values.items() if not math.isfinite(v)]:
                return state, lost
            if step % options.save_every == 0:
                checkpoints.save(step, state)
    checkpoints.save(step, state)
    return state, []
