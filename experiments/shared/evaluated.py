"""Averages and tables of `evaluate`."""

from __future__ import annotations

from typing import Any

import numpy as np

from experiments.shared import alone
from experiments.shared.common import markdown
from experiments.shared.images import mean_ci
from experiments.shared.protocols import ENOUGH

PAPER = {"theta_on": 0.023, "theta_off": 0.022, "eta_on": 0.045, "eta_off": 0.027}
HEADS = ("mismatch", "parameter", "recordings", "network", r"refined \|summary - true\|", "median",
         "constant prior", "paper", "mae_sequence", "mae_pixel", "fired pixels", "constant truth",
         "map beats summary by", "within 68 %", "within 95 %")
METRICS = ("mae_sequence", "mae_pixel", "mae_fired", "median")


def inside(error: float, width: float) -> float:
    """1 if the error is within the width, else 0; NaN without a finite width."""
    return float(abs(error) < width) if np.isfinite(width) else np.nan


def mean(values: np.ndarray) -> float:
    """Mean of the finite values; NaN without any."""
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else np.nan


def averages(rows: list[dict[str, float]]) -> dict[str, Any]:
    """Mean errors over the recordings with enough events, per parameter."""
    result: dict[str, Any] = {}
    for parameter in PAPER:
        def column(key: str, parameter: str = parameter) -> np.ndarray:
            return np.array([r.get(f"{key}/{parameter}", np.nan) for r in rows])

        if not column("true").any():  # pixels that have no such parameter
            continue
        used = column("signal") >= ENOUGH
        keys = sorted({k.split("/")[0] for r in rows for k in r if k.endswith(parameter)})
        result[parameter] = {k: mean(column(k)[used]) for k in keys}
        result[parameter] |= {
            "sequences": int(used.sum()), "median": float(np.median(column("summary")[used]))}
        for name in ("summary", "map_gain"):
            known = column(name)[used]
            result[parameter][f"{name}_ci95"] = mean_ci(known)[1] if known.size else np.nan
    return result


def table(results: dict[str, dict[str, Any]]) -> str:
    """Markdown: ours beside the constant prior and the paper, and each estimator by itself."""
    heads = ("estimator", "mismatch", "parameter", *METRICS, "constant prior", "paper")
    rows = ((who, preset, name, *(cell(r[f"{who}: {metric}"]) for metric in METRICS),
             cell(r["constant"]), f"{PAPER[name]:.3f}")
            for preset, found in results.items() for name, r in found.items()
            for who in alone.ESTIMATORS if f"{who}: mae_pixel" in r)
    return "\n".join((whole(results), "", "± is the 95 % interval over recordings.", "",
                      "## Each estimator by itself", "", alone.SAID, "", markdown(heads, rows)))


def cell(value: float) -> str:
    return f"{value:.4f}" if np.isfinite(value) else "–"


def percent(value: float) -> str:
    return f"{value:.0%}" if np.isfinite(value) else "–"


def whole(results: dict[str, dict[str, Any]]) -> str:
    return markdown(HEADS, (
        (preset, name, f"{r['sequences']}", cell(r["network"]),
         f"{r['summary']:.4f} ± {r['summary_ci95']:.4f}", f"{r['median']:.4f}",
         f"{r['constant']:.4f}", f"{PAPER[name]:.3f}", f"{r['mae_sequence']:.4f}",
         f"{r['mae_pixel']:.4f}", f"{r['mae_fired']:.4f}", f"{r['constant_truth']:.4f}",
         f"{r['map_gain']:.4f} ± {r['map_gain_ci95']:.4f}", percent(r["inside_68"]),
         percent(r["inside_95"])) for preset, rows in results.items() for name, r in rows.items()))
