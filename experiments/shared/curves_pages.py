"""Points, table and picture of `curves`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from evflow.report import plots
from experiments.shared.protocols import ENOUGH


def point(rows: list[dict[str, np.ndarray]], key: str, low: float = ENOUGH,
          high: float = np.inf) -> dict[str, float]:
    """Mean error of theta and of eta over polarities with low <= signal events < high, and the
    number of recordings with such a polarity."""
    rows = [r for r in rows if key in r]
    errors, signal = (np.array([r[k] for r in rows]).reshape(-1, 4) for k in (key, "signal"))
    used = (np.maximum(signal, 0.0) >= low) & (signal < high)
    return {"recordings": int(used.any(1).sum()), **{
        name: float(errors[:, part][used[:, part]].mean()) if used[:, part].any() else np.nan
        for name, part in (("theta", slice(0, 2)), ("eta", slice(2, 4)))}}


def table(result: dict[str, Any]) -> str:
    """Markdown. recordings: those used, two numbers where the network alone has fewer."""
    lines = ["| setting | value | recordings | theta, refined | theta, network | eta, refined | "
             "eta, network |", "|" + "---|" * 7]
    for name, points in result.items():
        for value, kinds in points.items():
            figures = [kinds.get(kind, {}).get(p, np.nan)
                       for p in ("theta", "eta") for kind in ("refined", "network")]
            counts = dict.fromkeys(str(k["recordings"]) for k in kinds.values())
            lines.append(f"| {name} | {value} | {' / '.join(counts)} | " + " | ".join(
                f"{v:.4f}" for v in figures) + " |")
    return "\n".join(lines) + "\n\nPaper: theta .023 / .022, eta .045 / .027."


def draw(result: dict[str, Any], path: Path) -> None:
    figure = plots.new_figure(3.2 * len(result), 5.6)
    for i, (name, points) in enumerate(result.items()):
        for j, parameter in enumerate(("theta", "eta")):
            axis = figure.add_subplot(2, len(result), j * len(result) + i + 1)
            for kind in ("refined", "network"):
                shown = {v: k[kind][parameter] for v, k in points.items() if kind in k}
                axis.plot(list(shown), list(shown.values()), marker="o", markersize=3, label=kind)
            axis.set(xscale="log", ylim=(0, None), xlabel=name if j else None)
            axis.set_xticks(list(points), [f"{v:g}" for v in points], rotation=60)
            axis.minorticks_off()
            if i == 0:
                axis.set_ylabel(f"|{'θ' if parameter == 'theta' else 'η'} − true|")
                axis.legend(frameon=False, fontsize=8)
    plots.save_figure(figure, path)
