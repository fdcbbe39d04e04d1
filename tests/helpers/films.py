"""A film, and pixels that see it: one instant at a time, independent of the package's own."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from evflow.estimation.refine.path import STEPS
from evflow.types import Events

INTERVALS, SHAPE, FRAME_S = 16, (20, 26), 0.02
SUB = 8  # instants of the independent pixel in a fine step
DEAD_S = 5e-3


def lin_log(dn: np.ndarray) -> np.ndarray:
    return np.where(dn <= 20, dn * np.log(20) / 20, np.log(np.maximum(dn, 1)))


def log_eps(dn: np.ndarray) -> np.ndarray:
    return np.log(dn / 255 + 1e-3)


def film(seed: int = 0) -> np.ndarray:
    """(T + 1, H, W) DN: stripes and blobs that drift, change pace and breathe."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0, INTERVALS * FRAME_S, INTERVALS * STEPS + 1)[:, None, None]
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    total = np.zeros((len(t), *SHAPE))
    for _ in range(6):
        angle, phase = rng.uniform(0, 2 * np.pi, 2)
        length, pace = rng.uniform(5, 14), rng.uniform(3, 11)
        along = (np.cos(angle) * x + np.sin(angle) * y)[None] / length
        total += np.sin(2 * np.pi * (along + pace * t + 0.4 * np.sin(9 * t)) + phase)
    return 20 + 190 / (1 + np.exp(-1.5 * total))


def view(seed: int = 0) -> np.ndarray:
    """(T + 1, 48, 64) DN: a rigid texture that swings past."""
    rng = np.random.default_rng(seed)
    texture = cv2.GaussianBlur(rng.normal(size=(160, 160)), None, 2.0)
    texture = np.clip(110 + 45 * texture / texture.std(), 20, 230).astype(np.float32)
    t = FRAME_S * np.arange(INTERVALS * STEPS + 1) / STEPS
    y, x = np.mgrid[:48, :64].astype(np.float32) + 48
    swing = 20 * np.sin(2 * np.pi * 3.0 * t), 20 * np.cos(2 * np.pi * 2.0 * t)
    return np.stack([cv2.remap(texture, x + np.float32(dx), y + np.float32(dy), cv2.INTER_CUBIC)
                     for dx, dy in zip(*swing, strict=True)]).astype(np.float64)


def integrated(
    dn: np.ndarray, dt_s: float, offset: float, tau_s: float, sub: int, by_light: bool = True,
    log: Callable[[np.ndarray], np.ndarray] = lin_log,
) -> np.ndarray:
    """The photoreceptor at `sub` instants of each step, by short explicit steps."""
    light = np.maximum(dn + offset, 0.1)
    u = log(light)
    s, out = u[0].copy(), [u[0]]
    for i in range(len(dn) - 1):
        share = ((light[i] + light[i + 1]) / 2 + 20) / 275 if by_light else 1.0
        rate = share / max(tau_s, 1e-12)
        for k in range(1, sub + 1):
            now = u[i] + (u[i + 1] - u[i]) * k / sub
            s = now + (s - now) * np.exp(-rate * dt_s / sub) if tau_s else now
            out.append(s)
    return np.stack(out)


def dead_events(path: np.ndarray, dt_s: float, law: str) -> Events:
    """Events of pixels, of .25 and .2, that are dead for DEAD_S after each: one instant at a time.
    "keeps" fires for what changed meanwhile, "drops" loses events, "resets" begins anew."""
    memory, last = path[0].copy(), np.full(path.shape[1:], -1.0)
    rows = []
    for i, now in enumerate(path[1:], 1):
        ready = i * dt_s - last >= DEAD_S
        if law == "resets":
            memory = np.where(ready, memory, now)
        while (crossed := (now - memory > 0.25) | (memory - now > 0.2)).any():
            crossed &= ready | (law == "drops")
            if not crossed.any():
                break
            up, fires = now > memory, crossed & ready
            memory = memory + np.where(up, 0.25, -0.2) * crossed
            last, ready = np.where(fires, i * dt_s, last), ready & ~fires
            y, x = np.nonzero(fires)
            rows.append(np.stack([x, y, np.full(len(x), round(i * dt_s * 1e6)), up[fires]]))
    x, y, t, p = np.concatenate(rows, 1)
    return Events(x, y, t + 10_000, p > 0, path.shape[:0:-1])
