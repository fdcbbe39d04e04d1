"""How much of a measured camera's noise is leak: its eta counts all noise events."""

from __future__ import annotations

from typing import Any

STEPS = 8  # fixed-point iterations, each of which at least halves the error
LEAST = 1e-4  # of a leak period that other events interrupt


def without_leak(eta_on: Any, eta_off: Any, leak_hz: Any, resets: bool = True) -> Any:
    """ON noise (NumPy or JAX arrays, Hz) without its leak, which alone would fire every 1 / leak_hz
    seconds. resets: other events reset the memory, so that many of them leave little leak to be
    seen."""
    xp = eta_on.__array_namespace__()
    left, leak_hz = eta_on, xp.maximum(xp.asarray(leak_hz, dtype=eta_on.dtype), 1e-12)
    for _ in range(STEPS):
        waited = xp.maximum((left + eta_off) / leak_hz, LEAST)
        seen = leak_hz * waited / xp.expm1(waited) if resets else leak_hz
        left = xp.maximum(eta_on - seen, 0.0)
    return left
