"""Train the network; writes checkpoints, metrics.jsonl, and weights.safetensors at the end.

    python -m experiments.train --preset default --out runs/default --max-seconds 2400
    python -m experiments.train --preset default --out runs/default --resume

Ctrl-C (or SIGTERM) saves a checkpoint and stops; --resume goes on bit for bit.
"""

from __future__ import annotations

import dataclasses
import json
import signal
import time
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import tyro
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from evflow.checkpoint import Checkpoints
from evflow.config import TrainConfig, as_dict, preset
from evflow.errors import EvflowDataError
from evflow.scenes import make_bank
from evflow.train import TrainState, init_state, make_run_step, optimiser
from evflow.weights import load_weights, save_weights
from experiments.common import provenance


@dataclasses.dataclass(frozen=True)
class Options:
    """Train the network on simulated cameras."""

    out: Path
    """Folder of the run."""
    preset: Literal["default", "paper", "debug"] = "default"
    steps: int | None = None
    """Number of steps (default: the preset's)."""
    parts: tuple[str, ...] | None = None
    """Parts that learn, of: summary encoder flow spread (default: the preset's, all)."""
    start: str | None = None
    """Weights (a name or a file) whose parts of equal shape are the starting point."""
    seed: int = 0
    max_seconds: float = float("inf")
    """Stop after this long, with a checkpoint; the schedule still spans all steps."""
    resume: bool = False
    save_every: int = 200
    """Steps between checkpoints."""


def main(options: Options) -> dict[str, Any]:
    config = dataclasses.replace(preset(options.preset), seed=options.seed)
    if options.steps is not None:
        config = dataclasses.replace(config, steps=options.steps)
    if options.parts is not None:
        config = dataclasses.replace(config, parts=options.parts)
    name = "paper" if options.preset == "paper" else "default"
    tx = optimiser(config)
    bank = make_bank(jax.random.fold_in(jax.random.key(config.seed), 7), config.textures)
    state = init_state(config, tx, bank, name)
    if options.start is not None:
        state = started_from(state, options.start)
    with Checkpoints(options.out) as checkpoints:
        if options.resume:
            state = checkpoints.restore(state)
        elif checkpoints.latest is not None:
            raise EvflowDataError("EV013", f"{options.out} already holds a run.",
                                  "Pass --resume to go on with it, or another --out.")
        checkpoints.write_config(as_dict(config))
        state, figures = run(state, bank, config, tx, options, checkpoints)
    card = {"preset": options.preset, "steps": int(state.step), "seed": config.seed,
            "training_figures": figures, "config": as_dict(config), **provenance()}
    save_weights(options.out / "weights.safetensors", state.average, card, overwrite=True)
    return figures


def started_from(state: TrainState, weights: str) -> TrainState:
    """The fresh state with every part of the network whose shapes agree taken from `weights`."""
    (name, fresh), = state.params.items()
    known = load_weights(weights).get(name, {})
    taken = {k: known[k] if k in known and shapes(known[k]) == shapes(v) else v
             for k, v in fresh.items()}
    return dataclasses.replace(
        state, params={name: taken}, average=jax.tree.map(jnp.copy, {name: taken}))


def shapes(tree: Any) -> Any:
    return jax.tree.map(jnp.shape, tree)


def run(
    state: TrainState, bank: Any, config: TrainConfig, tx: Any, options: Options,
    checkpoints: Checkpoints,
) -> tuple[TrainState, dict[str, float]]:
    """Steps until the end, the time limit or a signal; returns the state and mean metrics of
    the last hundred steps."""
    step_fn = jax.jit(make_run_step(config, tx), donate_argnums=0)
    stop: list[int] = []
    before = {n: signal.signal(n, lambda n, _: stop.append(n))
              for n in (signal.SIGINT, signal.SIGTERM)}
    started, recent, step = time.monotonic(), [], int(state.step)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(),
               TimeRemainingColumn())
    with Progress(*columns) as bar, open(options.out / "metrics.jsonl", "a") as log:
        task = bar.add_task("training", total=config.steps, completed=step)
        while step < config.steps and not stop:
            if time.monotonic() - started > options.max_seconds:
                break
            state, metrics = step_fn(state, bank)
            step += 1
            values = {k: float(v) for k, v in metrics.items()}
            recent = [*recent[-99:], values]
            log.write(json.dumps({"step": step, "time": time.monotonic() - started, **values})
                      + "\n")
            bar.update(task, completed=step, description=f"theta {values_of(recent):.4f}")
            if step % options.save_every == 0:
                log.flush()
                checkpoints.save(step, state)
    for number, handler in before.items():
        signal.signal(number, handler)
    checkpoints.save(step, state)
    names = recent[-1] if recent else {}
    return state, {k: sum(r[k] for r in recent) / len(recent) for k in names}


def values_of(recent: list[dict[str, float]]) -> float:
    """Mean summary error of theta over the recent steps (0 where the preset has none)."""
    keys = ("summary/theta_on", "summary/theta_off")
    return sum(r.get(k, 0.0) for r in recent for k in keys) / (2 * len(recent))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
