"""Small videos with a known truth, and what the simulator tests ask of their events."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from evflow.errors import EvflowDataError
from evflow.types import Events

SHAPE = (12, 16)


def drifting(count: int = 40, shape: tuple[int, int] = SHAPE, speed: float = 0.5) -> np.ndarray:
    """Float32 DN 5..250 (T, H, W): a smooth random texture that moves `speed` px per frame, so
    that both parts of the lin-log map and both polarities are met at every pixel."""
    rng = np.random.default_rng(7)
    waves = rng.normal(size=(12, 2)) * 0.5
    phases = rng.uniform(0, 2 * np.pi, 12)
    y, x = np.mgrid[: shape[0], : shape[1]]
    t = speed * np.arange(count)[:, None, None]
    total = sum(np.sin(kx * (x - t) + ky * (y + 0.3 * t) + phase)
                for (kx, ky), phase in zip(waves, phases, strict=True))
    return (127.5 + 122.5 * np.tanh(total / 2.5)).astype(np.float32)


def milliseconds(count: int, start: int = 0) -> np.ndarray:
    return start + 1000 * np.arange(count)


def by_pixel(events: Events) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(pixel, t, p) sorted by pixel, then time."""
    pixel = events.y.astype(np.int64) * events.size[0] + events.x
    order = np.lexsort((events.t, pixel))
    return pixel[order], events.t[order], events.p[order]


def code_of(call: Callable[[], Any]) -> str:
    """The code of the EvflowDataError that `call` raises; "" if it raises none."""
    try:
        call()
    except EvflowDataError as e:
        return e.code
    return ""
