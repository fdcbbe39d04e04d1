"""Table and plot of `experiments.ablate`: variants beside a constant and the paper's figures."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from evflow.report import plots
from experiments.shared.common import markdown
from experiments.shared.images import mean_ci
from experiments.shared.variants import Row

CONSTANT = "constant"
HEADS = ("variant", "theta, sequence", "paper", "eta, sequence", "paper", "theta, pixel",
         "to the first, theta", "shows from", "events made / true", "log p(z) + log det", "rate",
         "seconds")
PAPER = {  # Table VIII: theta_on, theta_off, eta_on, eta_off
    "L_P": (0.074, 0.064, 0.038, 0.046), "L_P + L_F + L_F'": (0.055, 0.075, 0.037, 0.054),
    "L_P + L_E": (0.037, 0.073, 0.054, 0.048),
    "L_P + L_F + L_F' + L_E": (0.032, 0.046, 0.066, 0.065),
    "the same, weights adapted": (0.018, 0.024, 0.045, 0.027)}


def theta(row: Row) -> float:
    """Mean of the two thresholds' errors."""
    return float(np.mean([row["sequence/theta_on"], row["sequence/theta_off"]]))


def table(result: dict[str, Row], steps: int) -> str:
    """ON / OFF means over seeds, the paper's figures beside ours; "shows from": the half-width of
    the difference's 95 % interval."""
    def pair(rows: list[Row], kind: str, parameter: str) -> str:
        return " / ".join(f"{np.mean([r[f'{kind}/{parameter}_{p}'] for r in rows]):.3f}"
                          for p in ("on", "off"))

    first = next(name for name in result if name != CONSTANT)
    cells = []
    for name, found in result.items():
        rows = [found] if name == CONSTANT else found["seeds"]
        on, off, eta_on, eta_off = PAPER.get(name, (np.nan,) * 4)
        more = [""] * 6
        if name != CONSTANT:
            apart, wide = mean_ci(np.array([theta(a) - theta(b) for a, b in zip(
                rows, result[first]["seeds"], strict=True)]))
            more = [*(["", ""] if name == first else [f"{apart:+.4f}", f"{wide:.4f}"]),
                    f"{np.median([r['events'] for r in rows]):.3g}",
                    f"{np.mean([r['log p(z)'] for r in rows]):.1f}", f"{found['rate']:g}",
                    f"{np.mean([r['seconds'] for r in rows]):.0f}"]
        cells.append([name, pair(rows, "sequence", "theta"), f"{on:.3f} / {off:.3f}",
                      pair(rows, "sequence", "eta"), f"{eta_on:.3f} / {eta_off:.3f}",
                      pair(rows, "pixel", "theta"), *more])
    text = f"{steps} training steps each.\n\n" + markdown(HEADS, cells)
    return text.replace("nan / nan", "")


def draw(result: dict[str, Row], path: Path) -> None:
    """Errors of every seed, the constant's as a line (Fig. 14, of thresholds and noise)."""
    figure = plots.new_figure(8, 3.2)
    names = [name for name in result if name != CONSTANT]
    for k, (parameter, letter) in enumerate((("theta", "θ"), ("eta", "η")), 1):
        axis = figure.add_subplot(1, 2, k)
        for side, marker in (("on", "o"), ("off", "s")):
            at = f"sequence/{parameter}_{side}"
            points = [(i, row[at]) for i, name in enumerate(names)
                      for row in result[name]["seeds"]]
            line, = axis.plot(*zip(*points, strict=True), marker, markersize=4,
                              label=side.upper())
            axis.axhline(result[CONSTANT][at], color=line.get_color(), linestyle=":")
        axis.set_xticks(range(len(names)), names, rotation=30, ha="right", fontsize=7)
        axis.set(ylim=(0, 1.05 * axis.get_ylim()[1]), ylabel=f"|{letter} − of the sequence|")
        axis.legend(frameon=False, fontsize=8, title="dotted: constant", title_fontsize=7)
    plots.save_figure(figure, path)
