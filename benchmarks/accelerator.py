"""A GPU in at most eight minutes: that it computes what the CPU does, and how fast.

    python -m benchmarks --device gpu       # a table, and JSON in benchmarks/results/

One process, checks first. What has no time left is skipped and says so; a step that has begun is
waited for, so the limit leaves room for the longest (compiling a training step). Shares are of what
this device does at most, measured in the same run: products of float32 as the flow needs them
("highest"), and copying its memory.
"""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from rich.console import Console
from rich.table import Table

from benchmarks import bench_estimate, bench_simulator, bench_train, parity, tables
from benchmarks.harness import Case, Record, Runner, Setting, Workload, compare, facts
from benchmarks.parity import Check, Difference
from evflow.errors import EvflowDataError
from evflow.files.atomic import atomic_write

LIMIT_S = 330.0  # after which nothing begins
TURNS = 3  # of half a second
LATE = "no time left"


def product(setting: Setting) -> Workload:
    """float32 products, "highest"."""
    n = 256 if setting.quick else 8192
    a, b = jax.random.normal(jax.random.key(0), (2, n, n), jnp.float32)
    multiply = jax.jit(partial(jnp.matmul, precision="highest"))
    return Workload(lambda: multiply(a, b), lambda _: {"GFLOP": 2e-9 * n**3}, f"{n}^3")


def copy(setting: Setting) -> Workload:
    """Memory that is read and written once."""
    a = jnp.ones((1 << 16) if setting.quick else (1 << 28), jnp.float32)
    turned = jax.jit(jnp.negative)
    return Workload(lambda: turned(a), lambda _: {"GB": 2e-9 * a.nbytes}, f"{a.nbytes >> 20} MiB")


CASES = (
    Case("limits", "sgemm", "jax", product),
    Case("limits", "copy", "jax", copy),
    *(Case("simulator", f"{output}, noise {'on' if noisy else 'off'}", "evflow",
           partial(prepare, noisy=noisy))
      for output, prepare in (("events", bench_simulator.events_evflow),
                              ("voxels, 16 bins", bench_simulator.voxels_evflow))
      for noisy in (False, True)),
    Case("estimate", "whole", "evflow", bench_estimate.whole),
    Case("train", "step", "evflow, data and update", bench_train.run_step),
)


def device_of(platform: str) -> jax.Device:
    """JAX's first device of that kind, made the default; EV020 where there is none."""
    jax.config.update("jax_platforms", None)  # all that there are: checks need the CPU as well
    try:
        device = jax.devices(platform)[0]
    except RuntimeError as e:
        raise EvflowDataError(
            "EV020", f"JAX finds no {platform} here ({e}).",
            "For NVIDIA's: pip install 'evflow-jax[cuda13]', and nvidia-smi must show one.") from e
    jax.config.update("jax_default_device", device)
    return device


def main(device: jax.Device, setting: Setting, out: Path) -> int:
    """Check, time, print and write; 1 where anything failed."""
    console, began = Console(stderr=True), time.monotonic()

    def late() -> bool:
        return time.monotonic() - began > LIMIT_S

    found = checked(parity.CHECKS, device, setting, late, console.print)
    records = compare(timed(CASES, setting, late, console.print))
    run = facts() | {"device": device.device_kind, "backend": device.platform,
                     "quick": setting.quick, "seconds": round(time.monotonic() - began, 1)}
    with atomic_write(out) as temporary:
        temporary.write_text(json.dumps({
            "run": run, "parity": [dataclasses.asdict(d) for d in found],
            "speed": [dataclasses.asdict(r) for r in records]}, indent=1) + "\n")
    shown = Console(width=None if console.is_terminal else 150)
    shown.print(table(found, device.device_kind))
    shown.print(tables.table(records, run))
    console.print(f"written to {out}")
    return int(any(d.failed for d in found) or any(r.failed for r in records))


def checked(
    checks: Sequence[Check], device: jax.Device, setting: Setting, late: Callable[[], bool],
    say: Callable[..., Any],
) -> list[Difference]:
    """The differences of each check; one that raises fails, and costs no other."""
    found: list[Difference] = []
    for check in checks:
        say(f"as on the CPU: {check.name}", highlight=False)
        if late():
            found += parity.absent(check, LATE)
            continue
        try:
            results = [check.compute(d, setting) for d in (device, jax.devices("cpu")[0])]
            found += parity.differences(check, *results)
        except Exception as e:
            found += parity.absent(check, f"{type(e).__name__}: {e}", failed=True)
    return found


def timed(
    cases: Sequence[Case], setting: Setting, late: Callable[[], bool], say: Callable[..., Any]
) -> list[Record]:
    """A record of each case; an error is the record of its case."""
    records: list[Record] = []
    for case in cases:
        say(f"{case.subject}: {case.task}", highlight=False)
        if late():
            records.append(Record(*case.name, skipped=f"skipped: {LATE}"))
            continue
        try:
            runner = Runner(case, setting)
            for _ in range(1 if setting.quick else TURNS):
                runner.turn()
            records.append(runner.record())
        except Exception as e:
            records.append(Record(*case.name, failed=True, skipped=f"{type(e).__name__}: {e}"))
    return records


def table(found: Sequence[Difference], device: str) -> Table:
    """One row per difference."""
    shown = Table(title=f"{device}: differences from the CPU")
    for name in ("check", "quantity", "difference", "bound", ""):
        shown.add_column(name, justify="left" if name in ("check", "quantity") else "right")
    for d in found:
        value = d.note if d.value is None else f"{d.value:.2g}"
        shown.add_row(d.check, d.quantity, value, f"{d.bound:.2g}", "FAILED" if d.failed else "")
    return shown
