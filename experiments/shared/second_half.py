"""How well thresholds from the first half of a recording predict its second half."""

from __future__ import annotations

import dataclasses
import itertools
import time
from typing import Any

import cv2
import numpy as np

from evflow import Recording
from evflow.baselines import System
from evflow.baselines.base import intervals, usable
from evflow.errors import EvflowDataError
from experiments.shared.compared import POLARITIES
from experiments.shared.fits import all_fits

CHANGED = 0.1  # log units: pixels that change by less between two frames say little
SMOOTH = 1.0  # pixels: frames and counts are blurred alike, against noise and misregistration


def halves(recording: Recording) -> tuple[Recording, Recording]:
    """The usable part of a recording before and from its middle frame on: they share that frame
    and no event. EV017 if there are too few."""
    found, events = usable(recording), recording.events
    if len(found) < 2:
        raise EvflowDataError("EV017", f"{len(found) or 'no'} usable interval between frames.",
                              "Two halves need two: record longer.")
    cuts = [found[0], found[(len(found) + 1) // 2], found[-1] + 1]
    times = recording.frame_times
    first, second = (
        dataclasses.replace(
            recording, events=events.slice(int(times[a]), int(times[b])),
            frames=recording.frames[a:b + 1], frame_times=times[a:b + 1])
        for a, b in itertools.pairwise(cuts))
    return first, second


def changes(recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """ON and OFF events (N, 2, H, W) and log changes (N, H, W) between usable frames, blurred."""
    parts = [(p.counts, p.after - p.before) for p in intervals(recording)]
    n, d = (np.stack(x) for x in zip(*parts, strict=True))
    return np.stack([[blurred(c) for c in pair] for pair in n]), np.stack([blurred(x) for x in d])


def blurred(image: np.ndarray) -> np.ndarray:
    return cv2.GaussianBlur(np.ascontiguousarray(image, np.float32), (0, 0), SMOOTH)


def carried(n: np.ndarray, on: np.ndarray, off: np.ndarray) -> np.ndarray:
    """What the events carry (N, H, W) at thresholds (H, W)."""
    return n[:, 0] * on[None] - n[:, 1] * off[None]


def held_out(
    params: Any, recording: Recording, systems: dict[str, System]
) -> dict[str, Any]:
    """Each system's thresholds from the first half, and how well they predict the second:
    residual over the change, root mean squares, of pixels that changed; `frame regression` is
    fitted to the second half itself and bounds what two numbers can do."""
    first, second = halves(recording)
    n, d = changes(second)
    used = np.abs(d) > CHANGED
    design = np.stack([n[:, 0][used], -n[:, 1][used]], -1).astype(np.float64)
    start = time.perf_counter()
    best, *_ = np.linalg.lstsq(design, d[used].astype(np.float64), rcond=None)
    seconds = time.perf_counter() - start
    size = float(np.sqrt(np.mean(d[used] ** 2)))

    def left(on: np.ndarray, off: np.ndarray) -> float:
        rest = d - carried(n, on, off)
        return float(np.sqrt(np.mean(rest[used] ** 2)) / size)

    result = {"frame regression": {"theta": best.tolist(), "left": left(*(np.full(
        d.shape[1:], t, np.float32) for t in best)), "seconds": seconds, "notes": [
            f"{used.sum()} changes of {len(usable(second))} frame intervals"]}}
    for name, fit in all_fits(params, first, systems).items():
        maps = (np.asarray(getattr(fit.camera, f"theta_{p}")) for p in POLARITIES)
        result[name] = {"theta": fit.theta.tolist(), "left": left(*maps),
                        "seconds": fit.seconds, "notes": list(fit.notes)}
    return result
