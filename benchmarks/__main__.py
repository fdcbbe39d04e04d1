"""The benchmarks: a table on the terminal, JSON lines on the disk.

    python -m benchmarks                          # everything, some minutes
    python -m benchmarks --only simulator train   # some subjects (limits are always measured)
    python -m benchmarks --quick                  # tiny inputs: does it run?

Every case runs in a process of its own, and those of a task take turns, except with --quick. Exit
code 1 if a case failed.
"""

from __future__ import annotations

import dataclasses
import datetime
import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import tyro
from rich.console import Console
from rich.table import Table

from evflow.errors import EvflowDataError
from evflow.files.atomic import atomic_write

os.environ.setdefault("JAX_PLATFORMS", "cpu")

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
from benchmarks.turns import by_task, in_turn

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

    Example: evflow bench --only simulator voxels

    Example: evflow bench --quick
    """

    only: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME...")] = ()
    """Subjects: simulator, voxels, io, estimate, train, networks (default: all)."""
    quick: bool = False
    """Tiny inputs, one repeat, one process: shows that it runs, times mean nothing."""
    out: Path | None = None
    """JSON lines (default: benchmarks/results/<date>.jsonl). An existing file is kept."""
    devices: Literal[1, 2] = 1
    """JAX CPU devices; the estimate splits its pixels over them."""


def main(options: Options) -> int:
    out = options.out or default_out()
    if out.exists():
        raise EvflowDataError("EV013", f"{out} exists.", "Give another --out.")
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


def default_out() -> Path:
    now = datetime.datetime.now(datetime.UTC)
    return Path(__file__).parent / "results" / f"{now:%Y-%m-%dT%H%M%S}.jsonl"


def select(only: tuple[str, ...]) -> list[Case]:
    """The cases of the named subjects, the limits first. Unknown names raise EV020."""
    unknown = sorted(set(only) - set(SUBJECTS))
    if unknown:
        raise EvflowDataError("EV020", f"no benchmark {unknown}.", f"Choose from {list(SUBJECTS)}.")
    return [case for name, cases in SUBJECTS.items() if not only or name in {"limits", *only}
            for case in cases]


def table(records: list[Record], run: dict[str, Any]) -> Table:
    """One row per record; a line between subjects."""
    title = f"{run['cpu']}, {run['cpus']} cores, load {run['load_before']} before; " + ", ".join(
        f"{name} {version}" for name, version in run["versions"].items())
    shown = Table(title=title, caption="x first: time against the first case of the same task, "
                  "turn by turn, above 1 = slower. % of sgemm, copy: of the best measured in this "
                  "run. others: cores busy with other processes meanwhile.")
    for name in ("task", "implementation", "median s", "min s", "CPU s", "per second", "% sgemm",
                 "% copy", "x first", "peak MB", "others"):
        shown.add_column(name, justify="left" if name in ("task", "implementation") else "right")
    for r, following in zip(records, [*records[1:], None], strict=True):
        shown.add_row(*row(r), end_section=following is None or following.subject != r.subject)
    return shown


def row(r: Record) -> tuple[str, ...]:
    split = f", {r.devices} devices" if r.devices > 1 else ""
    start = (f"{r.subject}: {r.task}", r.implementation + split)
    if r.seconds is None or r.fastest is None:
        return (*start, r.skipped)
    rates = "\n".join(f"{quantity(rate)} {unit}" for unit, rate in r.rates.items()
                      if unit != "GB" or r.subject == "limits")
    shares = (f"{100 * r.of_limit[k]:.1f}" if k in r.of_limit else "" for k in ("sgemm", "copy"))
    return (*start, f"{r.seconds:.3g}", f"{r.fastest:.3g}",
            "" if r.cpu is None else f"{r.cpu:.3g}", rates, *shares,
            "" if r.relative is None else f"{r.relative:.2f}",
            "" if r.peak_mb is None else f"{r.peak_mb:.0f}",
            "" if r.others is None else f"{r.others:.2f}")


def quantity(value: float) -> str:
    """1234567.0 -> "1.23 M"."""
    for scale, prefix in ((1e9, "G"), (1e6, "M"), (1e4, "k")):
        if value >= scale:
            return f"{value / (1e3 if prefix == 'k' else scale):.3g} {prefix}"
    return f"{value:.4g}"


def command(arguments: Sequence[str], prog: str) -> None:
    """What a command line says; prog: the program's name in its help. Leaves with the exit code."""
    sys.exit(main(tyro.cli(Options, args=arguments, prog=prog)))


if __name__ == "__main__":
    os.environ.setdefault("JAX_PLATFORMS", "cpu")  # inherited by the cases' processes
    try:
        command(sys.argv[1:], "python -m benchmarks")
    except EvflowDataError as e:
        sys.exit(str(e))
