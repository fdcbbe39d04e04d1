"""How every benchmark is timed, what it leaves behind, and what it is compared with.

A `Case` names a workload; `prepare(setting)` builds its inputs (not timed) and returns the
`Workload` to call. `measure` times the calls and returns a `Record`; `compare` adds what only the
whole run can know: the share of the machine's limits, and the time relative to evflow's.
Times are wall-clock seconds per call, results ready (`jax.block_until_ready`).
"""

from __future__ import annotations

import dataclasses
import datetime
import importlib.metadata
import importlib.util
import multiprocessing
import os
import platform
import re
import statistics
import subprocess
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import jax

import evflow

PACKAGES = ("jax", "jaxlib", "numpy", "numba", "torch")
BUDGET_S = 20.0  # per case, beyond the least number of repeats
REPEATS, MOST_REPEATS = 5, 15


@dataclasses.dataclass(frozen=True)
class Setting:
    """quick: tiny inputs, one repeat. devices: JAX CPU devices that pixels may be split over."""

    quick: bool = False
    devices: int = 1


@dataclasses.dataclass(frozen=True)
class Workload:
    """call: what is timed. count: amounts of work per call from its last result, such as
    {"frames": 299, "events": 1e6}; "GFLOP" and "GB" meet the machine's limits, GB being what
    must be read and written at least: inputs once, outputs once."""

    call: Callable[[], Any]
    count: Callable[[Any], dict[str, float]]
    note: str = ""


@dataclasses.dataclass(frozen=True)
class Case:
    """implementation: "evflow...", a peer or a limit; the first of a task is what its others are
    compared with. prepare: a function of a module, so that a fresh process can find it. needs: a
    package without which the case is skipped. splits: whether it uses more than one device."""

    subject: str
    task: str
    implementation: str
    prepare: Callable[[Setting], Workload]
    needs: str = ""
    splits: bool = False


@dataclasses.dataclass(frozen=True)
class Record:
    """One measured case, one line of JSON.

    seconds: median of `repeats` calls; fastest: the least; first_call: the first, compilation
    included. peak_mb: highest resident memory during the timed calls, less that before the first
    call (so it holds what compilation leaves behind); None where the system cannot tell.
    others: CPU cores that other processes kept busy meanwhile, on average; above ~.1 the times are
    theirs too (None where the system cannot tell).
    rates: work per second of the median. of_limit: share of the best "sgemm" and "copy" of the
    same run. relative: seconds over those of the task's first case (above 1 = slower).
    devices: JAX devices that shared the pixels. skipped: why there are no figures; failed:
    whether that is an error.
    """

    subject: str
    task: str
    implementation: str
    seconds: float | None = None
    fastest: float | None = None
    first_call: float | None = None
    repeats: int = 0
    peak_mb: float | None = None
    others: float | None = None
    work: dict[str, float] = dataclasses.field(default_factory=dict)
    rates: dict[str, float] = dataclasses.field(default_factory=dict)
    of_limit: dict[str, float] = dataclasses.field(default_factory=dict)
    relative: float | None = None
    devices: int = 1
    note: str = ""
    skipped: str = ""
    failed: bool = False


def measure(case: Case, setting: Setting) -> Record:
    """Build the case's inputs and time its calls; a skipped record where a package is absent."""
    name = (case.subject, case.task, case.implementation)
    if case.needs and importlib.util.find_spec(case.needs) is None:
        return Record(*name, skipped=f"skipped: {case.needs} is not installed "
                                     "(pip install 'evflow-jax[bench]')")
    if not case.splits:
        setting = dataclasses.replace(setting, devices=1)
    workload = case.prepare(setting)
    before, began = resident_mb("VmRSS"), time.perf_counter()
    result = jax.block_until_ready(workload.call())
    first = time.perf_counter() - began
    least, most = (1, 1) if setting.quick else (REPEATS, MOST_REPEATS)
    _reset_peak()
    times: list[float] = []
    start = _clocks()
    while len(times) < least or (len(times) < most and sum(times) < BUDGET_S):
        del result  # or two results would be alive at once, and counted
        began = time.perf_counter()
        result = jax.block_until_ready(workload.call())
        times.append(time.perf_counter() - began)
    peak, others = resident_mb("VmHWM"), _others(start, _clocks())
    work, seconds = workload.count(result), statistics.median(times)
    return Record(
        *name, seconds=seconds, fastest=min(times), first_call=first, repeats=len(times),
        peak_mb=None if before is None or peak is None else max(peak - before, 0.0),
        others=others, work=work, rates={unit: amount / seconds for unit, amount in work.items()},
        devices=setting.devices, note=workload.note)


def isolated(case: Case, setting: Setting) -> Record:
    """`measure` in a process of its own: memory is the case's alone, thread pools of JAX, torch
    and numba do not meet, and the number of JAX devices is free. An error becomes the record."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        try:
            return pool.submit(_child, case, setting).result()
        except Exception as e:  # one broken case must not cost the others
            return Record(case.subject, case.task, case.implementation, failed=True,
                          skipped=f"{type(e).__name__}: {e}")


def _child(case: Case, setting: Setting) -> Record:
    jax.config.update("jax_num_cpu_devices", setting.devices if case.splits else 1)
    return measure(case, setting)


def compare(records: Sequence[Record]) -> list[Record]:
    """Fill of_limit and relative, from the limits and the first cases found in `records`."""
    units = {"sgemm": "GFLOP", "copy": "GB"}
    limits = {task: max((r.rates[unit] for r in records if r.subject == "limits" and r.task == task
                         and r.rates), default=None) for task, unit in units.items()}
    first: dict[tuple[str, str], Record] = {}
    out = []
    for r in records:
        reference = first.setdefault((r.subject, r.task), r)
        shares = {task: r.rates[unit] / limit for task, unit in units.items()
                  if (limit := limits[task]) and unit in r.rates}
        relative = r.seconds / reference.seconds if r.seconds and reference.seconds else None
        out.append(dataclasses.replace(r, of_limit=shares, relative=relative))
    return out


def resident_mb(field: str) -> float | None:
    """Resident memory of this process in MB: "VmRSS" now, "VmHWM" at its highest (Linux)."""
    status = Path("/proc/self/status")
    found = re.search(rf"{field}:\s+(\d+) kB", status.read_text()) if status.exists() else None
    return int(found[1]) / 1024 if found else None


def _reset_peak() -> None:
    """Let VmHWM start again from the memory in use (Linux; getrusage could not forget a peak)."""
    control = Path("/proc/self/clear_refs")
    if control.exists():
        control.write_text("5")


def _clocks() -> tuple[float, float, float | None]:
    """Seconds: wall clock, CPU time of this process, CPU time of all (Linux) since it started."""
    stat, busy = Path("/proc/stat"), None
    if stat.exists():
        user, nice, system, _, _, irq, softirq, *_ = map(int, stat.read_text().split()[1:9])
        busy = (user + nice + system + irq + softirq) / os.sysconf("SC_CLK_TCK")
    return time.perf_counter(), time.process_time(), busy


def _others(start: tuple[float, float, float | None], end: tuple[float, float, float | None],
            ) -> float | None:
    """Cores busy with other processes between two `_clocks`; None below .1 s (a tick is .01 s)."""
    wall, own = end[0] - start[0], end[1] - start[1]
    if start[2] is None or end[2] is None or wall < 0.1:
        return None
    return max(end[2] - start[2] - own, 0.0) / wall


def facts() -> dict[str, Any]:
    """Machine, versions and load of a run, saved on every line."""
    versions = {"evflow": evflow.__version__, "commit": _commit()}
    for name in PACKAGES:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    return {
        "time": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "platform": platform.platform(), "python": platform.python_version(),
        "cpu": _cpu_model(), "cpus": cores(),
        "memory_gb": round(memory, 1), "load_before": round(os.getloadavg()[0], 2),
        "versions": versions,
    }


def cores() -> int:
    """CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _commit() -> str:
    """The measured source: its git commit, "-dirty" where files differ from it; "" without git."""
    try:
        return subprocess.run(
            ["git", "describe", "--always", "--dirty"], cwd=Path(__file__).parent, text=True,
            capture_output=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return ""


def _cpu_model() -> str:
    info = Path("/proc/cpuinfo")
    found = re.search(r"model name\s*:\s*(.+)", info.read_text()) if info.exists() else None
    return found[1] if found else platform.processor()
