"""Curves, strata and picture of `coverage`."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
from jax.scipy.stats import norm

from evflow.camera import PARAMETERS
from evflow.report import plots
from evflow.report.plots import TITLES

LEVELS = np.concatenate([[0.1, 0.2, 0.3, 0.4, 0.5, 0.6], [0.68, 0.8, 0.9, 0.95, 0.99]])
EDGES = {"signal events": (0, 50, 200, 1000, 5000, np.inf),
         "seconds": (0, 0.15, 0.25, 0.5, 2.0, 10.0, np.inf)}
Rows = list[dict[str, Any]]


def deviations() -> np.ndarray:
    """Half-widths in standard deviations of the central intervals of probability LEVELS."""
    return np.asarray(norm.ppf(0.5 + 0.5 * LEVELS))


def curves(rows: Rows) -> dict[str, dict[str, list[float]]]:
    """Coverage at LEVELS per parameter: of the summary, of all pixels, of valid ones."""
    found: dict[str, dict[str, list[float]]] = {}
    for name in PARAMETERS:
        away = np.array([r[f"summary/{name}"] for r in rows])
        found[name] = {"summary": (away[:, None] < deviations()).mean(0).tolist()}
        for kind in ("pixels", "valid"):
            found[name][kind] = np.nanmean([r[f"{kind}/{name}"] for r in rows], 0).tolist()
    return found


def of_level(level: float) -> int:
    """The index of a level in LEVELS."""
    return int(np.argmin(np.abs(LEVELS - level)))


def strata(rows: Rows) -> dict[str, dict[str, float]]:
    """Coverage of the summary's 68 % and 95 % intervals by stratum."""
    found = {}
    within = {level: deviations()[of_level(0.01 * level)] for level in (68, 95)}
    for name in PARAMETERS:
        away = np.array([r[f"summary/{name}"] for r in rows])
        values = {"signal events": np.array([r[f"signal/{name}"] for r in rows]),
                  "seconds": np.array([r["seconds"] for r in rows])}
        for label, value in values.items():
            for low, high in itertools.pairwise(EDGES[label]):
                used = (np.maximum(value, 0.0) >= low) & (value < high)
                if used.any():
                    found[f"{name}, {label} {low}-{high}"] = {
                        "recordings": int(used.sum()),
                        **{f"inside {level}": float((away[used] < width).mean())
                           for level, width in within.items()}}
    return found


def table(result: dict[str, Any]) -> str:
    """Markdown: coverage of all, then by stratum."""
    lines = ["| parameter, stratum | recordings | in 68 % | in 95 % |", "|---|---|---|---|"]
    i68, i95 = of_level(0.68), of_level(0.95)
    lines += [f"| {name}, {kind} | {result['cameras']} | {c[i68]:.0%} | {c[i95]:.0%} |"
              for name, kinds in result["curves"].items() for kind, c in kinds.items()]
    lines += [f"| {name} | {s['recordings']} | {s['inside 68']:.0%} | {s['inside 95']:.0%} |"
              for name, s in result["strata"].items()]
    return "\n".join(lines)


def draw(found: dict[str, dict[str, list[float]]], path: Path) -> None:
    figure = plots.new_figure(12, 3.4)
    for i, name in enumerate(PARAMETERS):
        axis = figure.add_subplot(1, 4, i + 1)
        axis.plot([0, 1], [0, 1], color="0.7", linewidth=1)
        for kind, label in (("summary", "camera's summary"), ("pixels", "pixels"),
                            ("valid", "valid pixels")):
            axis.plot(LEVELS, found[name][kind], marker="o", markersize=3, label=label)
        axis.set(title=TITLES[name], xlabel="interval", xlim=(0, 1), ylim=(0, 1), aspect="equal")
        if i == 0:
            axis.set_ylabel("share that holds the truth")
            axis.legend(frameon=False, fontsize=8)
    plots.save_figure(figure, path)
