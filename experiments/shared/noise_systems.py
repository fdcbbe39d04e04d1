"""Noise rates by closed forms from nominal thresholds and luminance, and their errors."""

from __future__ import annotations

from typing import Any

import numpy as np

from evflow.baselines import v2e_noise, voltmeter_noise
from evflow.camera.sensors import SENSORS
from experiments.shared import alone
from experiments.shared.images import mean_ci
from experiments.shared.measured_noise import SIDES, Rates
from experiments.shared.table_two import LUX, MIDDLE, TABLE_TWO

SYSTEMS = ("v2e, r = 1", "v2e", "evolt", "evolt, θ", "constant", "counting",
           *alone.RATES, "ours")
THETA = np.stack([TABLE_TWO[p][:, 0] for p in ("on", "off")], -1)  # (6, 2)
DN = LUX / 20.0  # 4000 lx are 200 DN: a texture about them is not saturated
BENCH = (MIDDLE, 3)  # threshold, luminance: the one known rate of "v2e" and "constant"
NOMINAL = SENSORS["v2e"].theta  # the threshold at which v2e's rate is r / 2


def closed_forms(theta: np.ndarray, dn: float, bench: np.ndarray) -> Rates:
    """Rates by simulators' closed forms at nominal thresholds (2,). bench: rates (2,) of BENCH."""
    def shot(thresholds: np.ndarray, light: float) -> np.ndarray:
        return np.array([float(v2e_noise(t, light, nominal=NOMINAL)) for t in thresholds])

    rate = bench.sum() / shot(THETA[BENCH[0]], DN[BENCH[1]]).sum()
    one = shot(theta, dn)
    return {"v2e, r = 1": one, "v2e": rate * one, "constant": bench,
            "evolt": np.array([float(r) for r in voltmeter_noise(dn)]),
            "evolt, θ": np.array([float(r) for r in voltmeter_noise(dn, *theta)])}


def inside(rates: Rates) -> list[float]:
    """Shares of our answers within 1 and 2 std of the truth; NaN without an answer."""
    answered = np.isfinite(rates["ours"])
    away, std = (x[answered] for x in (np.abs(rates["ours"] - rates["truth"]), rates["std"]))
    return [float((away <= k * std).mean()) if away.size else float("nan") for k in (1, 2)]


def scored(rates: Rates, name: str) -> dict[str, Any]:
    """Mean |η - truth| over the cells, ON and OFF, with its 95 % interval over seeds; "answered" is
    the share of cells with an answer (only these are scored)."""
    error = np.abs(rates[name] - rates["truth"])
    answered = np.isfinite(error).all(-1)
    means = np.array([e[t].mean(0) for e, t in zip(error, answered, strict=True) if t.any()])
    nothing = (float("nan"), 0.0)
    return {"answered": float(answered.mean()), **{
        side: mean_ci(means[:, i]) if len(means) else nothing for i, (side, _) in enumerate(SIDES)}}
