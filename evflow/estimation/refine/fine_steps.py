"""Positions in a stretch's fine steps, and seconds: steps of long frame intervals are longer."""

from __future__ import annotations

import numpy as np
from jax.typing import ArrayLike

Array = np.ndarray


def seconds_at(at: ArrayLike, dt_s: ArrayLike) -> Array:
    """Seconds from the first frame to positions (N,) in fine steps, which last dt_s (T,)."""
    clock = _clock(dt_s)
    return np.asarray(np.interp(np.asarray(at), np.arange(len(clock)), clock))


def later(at: ArrayLike, dt_s: ArrayLike, seconds: float) -> Array:
    """Positions (N,) in fine steps so many seconds later (earlier if negative), within the
    stretch."""
    clock = _clock(dt_s)
    return np.interp(seconds_at(at, dt_s) + seconds, clock, np.arange(len(clock)))


def evenly(path: Array, dt_s: ArrayLike) -> Array:
    """A path (T + 1, P) at as many times, evenly spaced."""
    clock = _clock(dt_s)
    at = np.interp(np.linspace(0.0, clock[-1], len(path)), clock, np.arange(len(path)))
    step = np.minimum(at.astype(int), len(path) - 2)
    share = (at - step)[:, None]
    return np.asarray((1.0 - share) * path[step] + share * path[step + 1])


def _clock(dt_s: ArrayLike) -> Array:
    """(T + 1,) seconds of the steps' edges."""
    return np.concatenate([[0.0], np.cumsum(dt_s, dtype=float)])
