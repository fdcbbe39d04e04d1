"""How every benchmark is timed, what it leaves behind, and what it is compared with.

A `Case` names a workload; `prepare(setting)` builds its inputs (not timed) and returns the
`Workload` to call. A `Runner` times its calls and makes a `Record` of them; `compare` adds what
only the whole run can know: the share of the machine's limits, and the time relative to evflow's.
Times are wall-clock seconds per call, results ready (`jax.block_until_ready`).
"""

from __future__ import annotations

import dataclasses
import datetime
import importlib.metadata
import importlib.util
import os
import platform
import re
import statistics
import subprocess
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax

import evflow

PACKAGES = ("jax", "jaxlib", "numpy", "numba", "torch")
# Variables that change how fast the same code is.
TUNING = ("GLIBC_TUNABLES", "LD_PRELOAD", "NPROC", "OMP_NUM_THREADS", "XLA_FLAGS")
Clocks = tuple[float, float, float | None]
TURN_S = 0.5  # at least


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

    @property
    def name(self) -> tuple[str, str, str]:
        return self.subject, self.task, self.implementation


@dataclasses.dataclass(frozen=True)
class Record:
    """One measured case, one line of JSON.

    seconds: median of `times`, a call's in each turn; fastest: the least; cpu: median of the CPU
    seconds of a call, of all threads of the process; first_call: the first call, compilation
    included. peak_mb: highest resident memory during the timed calls, less that before
    the first call (so it holds what compilation leaves behind); None where the system cannot tell.
    others: CPU cores that other processes kept busy meanwhile, on average; above ~.1 the times are
    theirs too (None where the system cannot tell).
    rates: work per second of the median. of_limit: share of the best "sgemm" and "copy" of the
    same run. relative: times over those of the task's first case, turn by turn, the median (above
    1 = slower).
    devices: JAX devices that shared the pixels. skipped: why there are no figures; failed:
    whether that is an error.
    """

    subject: str
    task: str
    implementation: str
    seconds: float | None = None
    fastest: float | None = None
    cpu: float | None = None
    first_call: float | None = None
    times: tuple[float, ...] = ()
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


def absent(case: Case) -> Record | None:
    """The record of a case whose package is not installed."""
    if not case.needs or importlib.util.find_spec(case.needs) is not None:
        return None
    extra = "bench" if case.needs in ("numba", "torch") else "io"
    return Record(*case.name, skipped=f"skipped: {case.needs} is not installed "
                                      f"(pip install 'evflow-jax[{extra}]')")


class Runner:
    """A case in this process: built and called once; then each `turn` is calls for half a second,
    one at least, after one that is not timed: the first after a pause, or another process, finds
    cold caches, and memory that a virtual machine has given away (a training step of 1 GB: 1.5
    times as long)."""

    def __init__(self, case: Case, setting: Setting) -> None:
        self.case = case
        self.setting = setting if case.splits else dataclasses.replace(setting, devices=1)
        self.workload = case.prepare(self.setting)
        self.before = resident_mb("VmRSS")
        self.times: list[float] = []
        self.cpu: list[float] = []
        self.clocks: list[tuple[Clocks, Clocks]] = []
        began = time.perf_counter()
        self._call()
        self.first = time.perf_counter() - began
        _reset_peak()

    def turn(self) -> float:
        """Make a turn, whose mean call joins `times`; the seconds that were timed."""
        if not self.setting.quick:
            self._call()
        start, now, calls = _clocks(), 0.0, 0
        least = 0.0 if self.setting.quick else TURN_S
        while not calls or now - start[0] < least:
            self._call()
            now, calls = time.perf_counter(), calls + 1
        self.clocks.append((start, end := _clocks()))
        self.cpu.append((end[1] - start[1]) / calls)
        self.times.append((now - start[0]) / calls)
        return now - start[0]

    def _call(self) -> None:
        self.result: Any = None  # or two results would be alive at once, and counted
        self.result = jax.block_until_ready(self.workload.call())

    def record(self) -> Record:
        peak = resident_mb("VmHWM")
        work, seconds = self.workload.count(self.result), statistics.median(self.times)
        return Record(
            *self.case.name, seconds=seconds, fastest=min(self.times),
            cpu=statistics.median(self.cpu), first_call=self.first, times=tuple(self.times),
            peak_mb=(None if self.before is None or peak is None
                     else max(peak - self.before, 0.0)),
            others=_others(self.clocks), work=work,
            rates={unit: amount / seconds for unit, amount in work.items()},
            devices=self.setting.devices, note=self.workload.note)


def measure(case: Case, setting: Setting) -> Record:
    """One turn of a case in this process; a skipped record where its package is absent."""
    if missing := absent(case):
        return missing
    runner = Runner(case, setting)
    runner.turn()
    return runner.record()


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
        ratios = [a / b for a, b in zip(r.times, reference.times, strict=False)]
        relative = statistics.median(ratios) if ratios else None
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


def _clocks() -> Clocks:
    """Seconds: wall clock, CPU time of this process, CPU time of all (Linux) since it started."""
    stat, busy = Path("/proc/stat"), None
    if stat.exists():
        user, nice, system, _, _, irq, softirq, *_ = map(int, stat.read_text().split()[1:9])
        busy = (user + nice + system + irq + softirq) / os.sysconf("SC_CLK_TCK")
    return time.perf_counter(), time.process_time(), busy


def _others(turns: Sequence[tuple[Clocks, Clocks]]) -> float | None:
    """Cores busy with other processes between pairs of `_clocks`; None below .1 s altogether (a
    tick is .01 s)."""
    wall, own, busy = 0.0, 0.0, 0.0
    for start, end in turns:
        if start[2] is None or end[2] is None:
            return None
        wall, own = wall + end[0] - start[0], own + end[1] - start[1]
        busy += end[2] - start[2]
    return max(busy - own, 0.0) / wall if wall >= 0.1 else None


def facts() -> dict[str, Any]:
    """Machine, versions, load and tuning of a run, saved on every line."""
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
        "environment": {name: os.environ[name] for name in TUNING if name in os.environ},
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
