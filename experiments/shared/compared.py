"""Averages, table and picture of `compare_systems`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from evflow.report import plots

OURS, CONSTANT, KNOWN = "ours", "constant .3", "match, true video"
POLARITIES = ("on", "off")
METRICS = ("mae_sequence", "mae_pixel", "median")
# Table III, synthetic data, ON and OFF.
PAPER = {"ecc": (0.043, 0.128), "s2r": (0.049, 0.131), "jaer": (0.025, 0.055),
         "lgan": (0.117, 0.128), OURS: (0.023, 0.022)}


def averages(found: list[dict[str, Any]]) -> dict[str, Any]:
    """Means per system over its recordings, with the standard error of |median - θ|."""
    result: dict[str, Any] = {}
    for name in (n for n in found[0] if n != "signal"):
        mine = [r[name] for r in found if name in r]
        one = {k: float(np.mean([r[k] for r in mine])) for k in mine[0] if "/" in k}
        one |= {f"error/{p}": standard_error([r[f"median/{p}"] for r in mine]) for p in POLARITIES}
        # A median: the first recording compiles.
        one["seconds"] = float(np.median([r["seconds"] for r in mine]))
        one["determined"] = float(np.mean([r["determined"] for r in mine]))
        result[name] = one | {"recordings": len(mine)}
    return result


def standard_error(values: list[float]) -> float:
    """Of their mean; 0 of a single value."""
    return float(np.std(values, ddof=1) / np.sqrt(len(values))) if len(values) > 1 else 0.0


def table(result: dict[str, Any]) -> str:
    """Markdown: a table of the simulated recordings, one of each real recording."""
    lines = ["| recordings | system | \\|median - θ\\| ON | OFF | mae_sequence ON | OFF | "
             "mae_pixel ON | OFF | bias ON | OFF | determined | s | paper ON | OFF |",
             "|" + "---|" * 14]
    for protocol, systems in result["simulated"].items():
        for name, r in systems.items():
            paper = PAPER.get(name)
            cells = [f"{r[f'median/{p}']:.3f} ± {r[f'error/{p}']:.3f}" for p in POLARITIES]
            cells += [f"{r[f'{m}/{p}']:.3f}" for m in METRICS[:2] for p in POLARITIES]
            cells += [f"{r[f'signed/{p}']:+.3f}" for p in POLARITIES]
            cells += [f"{r['determined']:.0%}", f"{r['seconds']:.2f}"]
            cells += [f"{x:.3f}" for x in paper] if paper else ["", ""]
            lines.append(f"| {protocol} ({r['recordings']}) | {name} | {' | '.join(cells)} |")
    lines += ["", "± is the standard error over recordings."]
    for recording, systems in result["real"].items():
        lines += ["", f"| {recording} | θ ON | θ OFF | change left over | s |", "|" + "---|" * 5]
        lines += [f"| {name} | {r['theta'][0]:.3f} | {r['theta'][1]:.3f} | {r['left']:.1%} | "
                  f"{r['seconds']:.2f} |" for name, r in systems.items()]
    return "\n".join(lines)


def picture(result: dict[str, Any], path: Path) -> None:
    """|median - θ| of every system, one panel per protocol; crosses are the paper's figures,
    which are of mae_sequence."""
    panels = result["simulated"]
    figure = plots.new_figure(5.5 * len(panels), 5.5)
    axes = np.atleast_1d(figure.subplots(1, len(panels), sharey=True))
    for axis, (protocol, systems) in zip(axes, panels.items(), strict=True):
        names = list(systems)[::-1]
        for i, (p, colour) in enumerate(zip(POLARITIES, (plots.ON_COLOUR, plots.OFF_COLOUR),
                                            strict=True)):
            y = np.arange(len(names)) + 0.2 * (0.5 - i)
            axis.errorbar([systems[n][f"median/{p}"] for n in names], y,
                          xerr=[systems[n][f"error/{p}"] for n in names], fmt="o", color=colour,
                          label=f"θ {p.upper()}")
            known = [(PAPER[n][i], at) for n, at in zip(names, y, strict=True) if n in PAPER]
            axis.plot(*zip(*known, strict=True), "x", color=colour)
        axis.set_yticks(np.arange(len(names)), names)
        axis.set_xscale("log")
        axis.set_xlabel("|median − θ|  (x: paper, mae_sequence)")
        axis.set_title(f"mismatch {protocol}")
        axis.grid(alpha=0.3)
    axes[0].legend()
    plots.save_figure(figure, path)
