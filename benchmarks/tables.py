"""Records as a table on the terminal."""

from __future__ import annotations

from typing import Any

from rich.table import Table

from benchmarks.harness import Record


def table(records: list[Record], run: dict[str, Any]) -> Table:
    """One row per record; a line between subjects."""
    machine = [run[name] for name in ("device", "cpu") if name in run] + [f"{run['cpus']} cores"]
    versions = ", ".join(f"{name} {version}" for name, version in run["versions"].items())
    title = f"{', '.join(machine)}, load {run['load_before']} before; {versions}"
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
