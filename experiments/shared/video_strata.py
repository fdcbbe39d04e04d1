"""Errors with and without the true video, by number of events and speed."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from experiments.shared.protocols import ENOUGH

EDGES = {"signal": (200, 1000, 5000, np.inf), "speed": (0, 2, 6, np.inf)}


def mean(values: Any) -> float:
    return float(np.mean(values)) if len(values) else np.nan


def strata(rows: list[dict[str, float]]) -> dict[str, dict[str, float]]:
    """Ours, with the true video and their ratio, per figure; all recordings with enough events,
    then by stratum."""
    found: dict[str, dict[str, float]] = {}
    for figure in [k.split("/")[1] for k in rows[0] if k.startswith("ours/")]:
        polarity = "off" if "off" in figure else "on"
        signal = np.array([r[f"signal/theta_{polarity}"] for r in rows])
        speed = np.array([r["speed"] for r in rows])
        ours, known = (np.array([r[f"{k}/{figure}"] for r in rows]) for k in ("ours", "known"))
        choices = {"all": signal >= ENOUGH}
        for name, value in (("signal", signal), ("speed", speed)):
            for low, high in itertools.pairwise(EDGES[name]):
                choices[f"{name} {low}-{high}"] = (
                    (signal >= ENOUGH) & (value >= low) & (value < high))
        for label, used in choices.items():
            if used.any():
                a, b = float(np.nanmean(ours[used])), float(np.nanmean(known[used]))
                found[f"{figure}, {label}"] = {
                    "recordings": int(used.sum()), "ours": a, "known": b, "ratio": a / b}
    return found
