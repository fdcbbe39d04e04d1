"""Train the network; writes checkpoints, metrics.jsonl, and weights.safetensors at the end.

    python -m experiments.train --preset default --out runs/default --max-seconds 2400
    srun python -m experiments.train --out runs/default      # every device of every process
    python -m experiments.train --out runs/default --coordinator HOST:PORT --processes 2 \
        --process-id 0                                       # and so on, one command a process

One path for any number of devices and processes, which see the same global batches; --out is a
folder that the processes share. Ctrl-C (or SIGTERM to any process) saves a checkpoint and stops;
the same command goes on, bit for bit on as many devices. Where a process dies, the others end with
an error within half a minute, and the last complete checkpoint counts.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import FrameType
from typing import Any, Literal

import jax
import jax.numpy as jnp
import tyro
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from evflow.errors import EvflowDataError
from evflow.files.atomic import atomic_write
from evflow.network.weights import load_weights, save_weights
from evflow.process import devices
from evflow.scenes import TextureBank, make_bank
from evflow.training.checkpoint import Checkpoints
from evflow.training.config import TrainConfig, as_dict, preset
from evflow.training.step import TrainState, init_state, make_run_step, optimiser
from experiments.shared.common import end_with, provenance

Resume = Literal["auto", "never", "must"]

RECENT = 100  # steps whose mean metrics are a run's figures
Metrics = dict[str, float]


@dataclasses.dataclass(frozen=True)
class Options:
    """Train the network on simulated cameras; writes checkpoints, metrics.jsonl, and
    weights.safetensors at the end.

    Ctrl-C saves a checkpoint and stops; the same command goes on. All devices there are share the
    work, also those of several processes (srun, mpirun, or --coordinator).

    Example: evflow train --preset default --out runs/default --max-seconds 2400

    Example: evflow train --out runs/default --coordinator HOST:PORT --processes 2 --process-id 0
    """

    out: Path
    """Folder of the run."""
    preset: Literal["default", "pixels", "paper", "debug"] = "default"
    """default: all parts; pixels: those that see pixels one by one, on many small scenes; paper:
    the paper's network and losses; debug: tiny, to see that it runs."""
    steps: int | None = None
    """Number of steps (default: the preset's)."""
    scenes: int | None = None
    """Scenes per step, a multiple of the number of devices (default: the preset's)."""
    parts: tuple[str, ...] | None = None
    """Parts that learn, of: summary encoder flow spread (default: the preset's)."""
    start: str | None = None
    """Weights (a name or a file) whose parts of equal shape are the starting point."""
    seed: int = 0
    """Of scenes, cameras and the first parameters."""
    max_seconds: float = math.inf
    """Stop after this long, with a checkpoint; the schedule still spans all steps."""
    resume: Resume = "auto"
    """Go on with the run in --out: if there is one (its configuration must be this one), never
    (there must be none), or always (there must be one)."""
    save_every: int = 200
    """Steps between checkpoints."""
    coordinator: str | None = None
    """HOST:PORT of process 0, where several processes train without Slurm or Open MPI."""
    processes: int | None = None
    """How many they are."""
    process_id: int | None = None
    """Which of them this is, from 0."""


def main(options: Options) -> Metrics:
    """One run; returns the mean metrics of its last hundred steps."""
    devices.initialise(options.coordinator, options.processes, options.process_id)
    mesh = devices.make_mesh()
    config = configuration(options, mesh.size)
    if options.resume == "must" and not options.out.is_dir():  # before a folder is made
        raise EvflowDataError("EV016", f"there is no {options.out} to resume.",
                              "Check --out, or pass --resume auto.")
    tx = optimiser(config)
    with stop_requests() as requests, Checkpoints(options.out) as checkpoints:
        resumed = goes_on(checkpoints, config, options.out, options.resume)
        bank = make_bank(jax.random.fold_in(jax.random.key(config.seed), 7), config.textures)
        name = "paper" if options.preset == "paper" else "default"
        state = init_state(config, tx, bank, name)
        if options.start is not None:
            state = started_from(state, options.start)
        state, bank = devices.replicate((state, bank), mesh)
        if resumed:
            state = checkpoints.restore(state)
        step = devices.parallel(make_run_step(config, tx), mesh)
        with Log(options.out / "metrics.jsonl", config.steps, int(state.step)) as log:
            state = run(step, state, bank, config, options, checkpoints, log, requests)
    card = {"preset": options.preset, "steps": int(state.step), "seed": config.seed,
            "devices": mesh.size, "training_figures": log.figures, "config": as_dict(config),
            **provenance()}
    if devices.is_main():
        save_weights(options.out / "weights.safetensors", state.average, card, overwrite=True)
    devices.agree(True)  # leave together: a process that ends alone is a dead one to the others
    return log.figures


def configuration(options: Options, devices: int) -> TrainConfig:
    """The preset with the options' changes; EV020 where its scenes cannot be shared out."""
    changes = {k: getattr(options, k) for k in ("seed", "steps", "scenes", "parts")}
    config = dataclasses.replace(
        preset(options.preset), **{k: v for k, v in changes.items() if v is not None})
    if options.save_every < 1:
        raise EvflowDataError("EV020", f"--save-every {options.save_every}.", "Give 1 or more.")
    if config.scenes < 1:
        raise EvflowDataError("EV020", f"scenes={config.scenes}.", "A step takes one or more.")
    if config.scenes % devices:
        raise EvflowDataError(
            "EV020", f"{config.scenes} scenes a step do not divide among {devices} devices.",
            f"Pass --scenes {math.ceil(config.scenes / devices) * devices}, or use fewer devices.")
    return config


def goes_on(checkpoints: Checkpoints, config: Any, out: Path, resume: Resume) -> bool:
    """Whether the run in the folder is continued; else the folder is made this run's."""
    if resume == "never" and checkpoints.latest is not None:
        raise EvflowDataError("EV013", f"{out} already holds a run.",
                              "Pass --resume auto to go on with it, or another --out.")
    if resume == "must" or checkpoints.latest is not None:
        checkpoints.check_config(as_dict(config))
        return True
    if devices.is_main():
        checkpoints.write_config(as_dict(config))
    return False


def started_from(state: TrainState, weights: str) -> TrainState:
    """The fresh state with every part of the network whose shapes agree taken from `weights`;
    EV018 where none is."""
    (name, fresh), = state.params.items()
    known = load_weights(weights).get(name, {})
    taken = {k: known[k] for k, v in fresh.items() if k in known and shapes(known[k]) == shapes(v)}
    if not taken:
        raise EvflowDataError(
            "EV018", f"{weights} has no part of the network {name!r} of this run, in its sizes.",
            "Start from weights of the same network, or leave --start out.")
    if devices.is_main():
        print(f"from {weights}: {', '.join(taken)}")
    begun = {name: fresh | taken}
    return dataclasses.replace(state, params=begun, average=jax.tree.map(jnp.copy, begun))


def shapes(tree: Any) -> Any:
    return jax.tree.map(jnp.shape, tree)


def run(
    step_fn: Any, state: TrainState, bank: TextureBank, config: TrainConfig, options: Options,
    checkpoints: Checkpoints, log: Log, requests: list[int],
) -> TrainState:
    """Steps until the end, the time limit or a signal; the last step is saved."""
    started, step = time.monotonic(), int(state.step)
    # All processes must stop after the same step, but neither signals nor clocks are the same.
    while step < config.steps and not devices.agree(
            bool(requests) or time.monotonic() - started > options.max_seconds):
        state, metrics = step_fn(state, bank)
        step += 1
        values = {k: float(v) for k, v in jax.device_get(metrics).items()}
        log.add(step, time.monotonic() - started, values)
        if step % options.save_every == 0:
            checkpoints.save(step, state)
    checkpoints.save(step, state)
    return state


@contextlib.contextmanager
def stop_requests() -> Iterator[list[int]]:
    """A list that SIGINT and SIGTERM add themselves to; a second signal acts as usual."""
    requests: list[int] = []

    def ask(number: int, _: FrameType | None) -> None:
        requests.append(number)
        signal.signal(number, before[signal.Signals(number)])

    before = {n: signal.signal(n, ask) for n in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield requests
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class Log:
    """metrics.jsonl, one line per step, and the progress bar; only the main process has them.

    Lines beyond `step`, where the run goes on from, are dropped: no step is logged twice.
    """

    def __init__(self, path: Path, steps: int, step: int) -> None:
        self._main = devices.is_main()
        self._recent: list[Metrics] = []
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(),
                   TimeRemainingColumn())
        self._open = contextlib.ExitStack()
        self._bar = self._open.enter_context(Progress(*columns, disable=not self._main))
        self._task = self._bar.add_task("training", total=steps, completed=step)
        if self._main:
            kept = list(lines_until(path, step))
            with atomic_write(path, overwrite=True) as temporary:
                temporary.write_text("".join(f"{line}\n" for line in kept))
            # By lines: a step is logged before its checkpoint is written.
            self._file = self._open.enter_context(path.open("a", buffering=1))

    def __enter__(self) -> Log:
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def add(self, step: int, seconds: float, values: Metrics) -> None:
        """One step's metrics; seconds since the run (or its last resumption) started."""
        self._recent = [*self._recent[1 - RECENT:], values]
        if self._main:
            self._file.write(json.dumps({"step": step, "time": seconds, **values}) + "\n")
        theta = [self.figures.get(f"summary/theta_{p}", 0.0) for p in ("on", "off")]
        self._bar.update(self._task, completed=step, description=f"theta {sum(theta) / 2:.4f}")

    @property
    def figures(self) -> Metrics:
        """Mean metrics of the recent steps of this process."""
        names = self._recent[-1] if self._recent else {}
        return {k: sum(r[k] for r in self._recent) / len(self._recent) for k in names}


def lines_until(path: Path, step: int) -> Iterator[str]:
    """The lines of a log up to `step`; none where there is no log. A line that a crash cut short
    lies beyond the last checkpoint."""
    for line in path.read_text().splitlines() if path.exists() else ():
        with contextlib.suppress(json.JSONDecodeError):
            if json.loads(line)["step"] <= step:
                yield line


def command(arguments: Sequence[str], prog: str) -> None:
    """What a command line says; prog: the program's name in its help."""
    main(tyro.cli(Options, args=arguments, prog=prog))


if __name__ == "__main__":
    end_with(lambda: command(sys.argv[1:], "python -m experiments.train"))
