"""Errors on each path between the frames, by number of events and speed."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from experiments.shared.protocols import ENOUGH

KINDS = ("ours", "path", "straight", "blended", "known")
EDGES = {"signal": (200, 1000, 5000, np.inf), "speed": (0, 2, 6, np.inf)}


def mean(values: Any) -> float:
    return float(np.mean(values)) if len(values) else np.nan


def strata(rows: list[dict[str, float]]) -> dict[str, dict[str, float]]:
    """Mean errors per figure of whatever a row has them for ("ours", "known", ...), and the ratio
    of ours to the true video's; all recordings with enough events, then by stratum."""
    found: dict[str, dict[str, float]] = {}
    for figure in [k.split("/")[1] for k in rows[0] if k.startswith("ours/")]:
        polarity = "off" if "off" in figure else "on"
        signal = np.array([r[f"signal/theta_{polarity}"] for r in rows])
        speed = np.array([r["speed"] for r in rows])
        choices = {"all": signal >= ENOUGH}
        for name, value in (("signal", signal), ("speed", speed)):
            for low, high in itertools.pairwise(EDGES[name]):
                choices[f"{name} {low}-{high}"] = (
                    (signal >= ENOUGH) & (value >= low) & (value < high))
        errors = {kind: np.array([r[f"{kind}/{figure}"] for r in rows])
                  for kind in KINDS if f"{kind}/{figure}" in rows[0]}
        for label, used in choices.items():
            if used.any():
                means = {kind: float(np.nanmean(error[used])) for kind, error in errors.items()}
                found[f"{figure}, {label}"] = {
                    "recordings": int(used.sum()), **means,
                    "ratio": means["ours"] / means["known"]}
    return found
