"""What of a measured camera's noise is leak: its eta is all events, of whatever kind."""

from __future__ import annotations

from typing import Any

STEPS = 8  # of a fixed point, each of which halves the error at least
LEAST = 1e-4  # of a period that others interrupt


def beside_leak(eta_on: Any, eta_off: Any, leak_hz: Any, resets: bool = True) -> Any:
    """ON noise (arrays of NumPy or JAX, Hz) without its leak, which pixels send every 1 / leak_hz
    seconds if nothing else is. resets: other events reset the memory, so that little of it is
    seen among many."""
    xp = eta_on.__array_namespace__()
    left, leak_hz = eta_on, xp.maximum(xp.asarray(leak_hz, dtype=eta_on.dtype), 1e-12)
    for _ in range(STEPS):
        waited = xp.maximum((left + eta_off) / leak_hz, LEAST)
        seen = leak_hz * waited / xp.expm1(waited) if resets else leak_hz
        left = xp.maximum(eta_on - seen, 0.0)
    return left
