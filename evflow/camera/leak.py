"""How much of a measured camera's noise is leak: its eta counts all noise events."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

MOST_SHOT = 20.0  # times the camera's shot noise: what exceeds it is a fault's, in any light
STEPS = 8  # fixed-point iterations, each of which at least halves the error
LEAST = 1e-4  # of a leak period that other events interrupt


def without_leak(eta_on: Any, eta_off: Any, leak_hz: Any, resets: bool = True) -> Any:
    """ON noise (NumPy or JAX arrays, Hz) without its leak, which alone would fire every 1 / leak_hz
    seconds. resets: other events reset the memory, so that many of them leave little leak to be
    seen."""
    xp = eta_on.__array_namespace__()
    left, leak_hz = eta_on, xp.maximum(xp.asarray(leak_hz, dtype=eta_on.dtype), 1e-12)
    for _ in range(STEPS):
        seen = leak_among(leak_hz, left + eta_off) if resets else leak_hz
        left = xp.maximum(eta_on - seen, 0.0)
    return left


def leak_among(leak_hz: Any, others_hz: Any) -> Any:
    """ON events per second of a leak of `leak_hz` (> 0) among others (an array, Hz), which reset
    the memory: of its periods, those in which none of them comes."""
    xp = others_hz.__array_namespace__()
    waited = xp.maximum(others_hz / leak_hz, LEAST)
    return leak_hz * waited / xp.expm1(waited)


def shot_eta(eta_on: float, eta_off: float, leak_hz: float) -> float:
    """A camera's noise rate without its leak, mean of ON and OFF, in Hz: what its shot noise is the
    rate of (`SensorModel.shot_eta_hz`)."""
    on = np.float64(eta_on)
    return 0.5 * (float(without_leak(on, eta_off, leak_hz) if leak_hz else on) + eta_off)


def leak_behind(seen_hz: float, others_hz: float) -> float:
    """The leak in Hz of which `seen_hz` are seen among other noise events, which reset the memory:
    the inverse of `without_leak`. Of its periods of 1 / leak seconds, only those are seen in which
    none of the others comes.

    Args:
        seen_hz: ON events of the leak per second.
        others_hz: all other noise events per second, ON and OFF.

    Returns:
        The leak in Hz; `seen_hz` itself where nothing resets the memory.
    """
    if min(seen_hz, others_hz) <= 0:
        return max(seen_hz, 0.0)
    return others_hz / math.log1p(others_hz / seen_hz)
