"""The benchmarks: a table on the terminal, JSON lines on the disk.

    python -m benchmarks                          # everything, some minutes
    python -m benchmarks --only simulator train   # some subjects (limits are always measured)
    python -m benchmarks --quick                  # tiny inputs: does it run?
    python -m benchmarks --device gpu             # a GPU, checked against the CPU

Every case runs in a process of its own, and those of a task take turns, except with --quick. Exit
code 1 if a case failed.
"""

from __future__ import annotations

import dataclasses
import datetime
import json
import os
import sys
from pathlib import Path
from typing import Annotated, Literal

os.environ.setdefault("JAX_PLATFORMS", "cpu")  # before JAX reads it; inherited by the cases

import jax
import tyro
from rich.console import Console

from benchmarks import (
    bench_estimate,
    bench_io,
    bench_networks,
    bench_simulator,
    bench_train,
    bench_voxels,
    limits,
)
from benchmarks.harness import Case, Record, Setting, compare, facts, measure
from benchmarks.tables import table
from benchmarks.turns import by_task, in_turn
from evflow.errors import EvflowDataError
from evflow.files.atomic import atomic_write
from evflow.files.folders import need_writable

SUBJECTS: dict[str, tuple[Case, ...]] = {
    "limits": limits.CASES,
    "simulator": bench_simulator.CASES,
    "voxels": bench_voxels.CASES,
    "io": bench_io.CASES,
    "estimate": bench_estimate.CASES,
    "train": bench_train.CASES,
    "networks": bench_networks.CASES,
}


@dataclasses.dataclass(frozen=True)
class Options:
    """Time evflow on this machine, beside its limits and beside peers: a table on the terminal,
    JSON lines on the disk. Every case runs in a process of its own, and those of a task take
    turns, except with --quick. If one failed the exit code is 1.

    Example: python -m benchmarks --only simulator voxels

    Example: python -m benchmarks --quick
    """

    only: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME...")] = ()
    """Subjects: simulator, voxels, io, estimate, train, networks (default: all)."""
    quick: bool = False
    """Tiny inputs, one repeat, one process: shows that it runs, times mean nothing."""
    out: Path | None = None
    """JSON lines (default: benchmarks/results/<date>.jsonl). An existing file is kept."""
    devices: Literal[1, 2] = 1
    """JAX CPU devices; the estimate splits its pixels over them."""
    device: Literal["cpu", "gpu"] = "cpu"
    """gpu: check that a GPU computes what the CPU does, and time it, in at most eight minutes; one
    JSON document."""


def main(options: Options) -> int:
    out = options.out or default_out("json" if options.device == "gpu" else "jsonl")
    if out.exists():
        raise EvflowDataError("EV013", f"{out} exists.", "Give another --out.")
    need_writable(out.parent)
    if options.device == "gpu":
        return on_gpu(options, out)
    cases, run_facts = select(options.only), facts() | {"quick": options.quick}
    console = Console(stderr=True)
    records, complete = run(cases, options, console)
    records = compare(records)
    with atomic_write(out) as temporary:
        lines = (json.dumps(dataclasses.asdict(r) | {"run": run_facts}) for r in records)
        temporary.write_text("".join(f"{line}\n" for line in lines))
    Console(width=None if sys.stdout.isatty() else 150).print(table(records, run_facts))
    console.print(f"written to {out}")
    return int(any(r.failed for r in records)) if complete else 130


def on_gpu(options: Options, out: Path) -> int:
    """EV020 with options that belong to CPUs, or without a GPU."""
    if options.only or options.devices > 1:
        raise EvflowDataError("EV020", "--device gpu with --only or --devices.",
                              "It runs all that it has, on one GPU.")
    from benchmarks import accelerator

    device = accelerator.device_of("gpu")
    return accelerator.main(device, Setting(options.quick), out)


def run(cases: list[Case], options: Options, console: Console) -> tuple[list[Record], bool]:
    """The records, and whether they are all: Ctrl-C ends the run and keeps what it has."""
    setting = Setting(options.quick, options.devices)
    if options.quick and options.devices > 1:  # otherwise each process sets its own number
        jax.config.update("jax_num_cpu_devices", options.devices)
    records: list[Record] = []
    try:
        for task in by_task(cases):
            names = "; ".join(case.implementation for case in task)
            console.print(f"{task[0].subject}: {task[0].task}, {names}", highlight=False)
            records += ([measure(case, setting) for case in task] if options.quick
                        else in_turn(task, setting))
    except KeyboardInterrupt:
        console.print(f"interrupted after {len(records)} of {len(cases)} cases")
        return records, False
    return records, True


def default_out(extension: str) -> Path:
    now = datetime.datetime.now(datetime.UTC)
    return Path(__file__).parent / "results" / f"{now:%Y-%m-%dT%H%M%S}.{extension}"


def select(only: tuple[str, ...]) -> list[Case]:
    """The cases of the named subjects, the limits first. Unknown names raise EV020."""
    unknown = sorted(set(only) - set(SUBJECTS))
    if unknown:
        raise EvflowDataError("EV020", f"no benchmark {unknown}.", f"Choose from {list(SUBJECTS)}.")
    return [case for name, cases in SUBJECTS.items() if not only or name in {"limits", *only}
            for case in cases]


if __name__ == "__main__":
    try:
        sys.exit(main(tyro.cli(Options, prog="python -m benchmarks")))
    except EvflowDataError as e:
        sys.exit(str(e))
