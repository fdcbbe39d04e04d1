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
from evflow.light.log_maps import lin_log
from evflow.light.logarithm import LIN_LOG, Logarithm
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


@dataclasses.dataclass(frozen=True, eq=False)
class Changes:
    """Between the usable frames of a recording: counts (N, 2, H, W) of ON and OFF events; before
    (N, H, W), DN; and changes (N, H, W), lin-log and blurred."""

    counts: np.ndarray
    before: np.ndarray
    seen: np.ndarray

    def left(self, on: np.ndarray, off: np.ndarray, logarithm: Logarithm) -> np.ndarray:
        """What thresholds (H, W), added to the frames in their own logarithm, leave of the changes
        (N, H, W): measured in lin-log, for all systems alike."""
        state = logarithm.of(self.before) + carried(self.counts, on, off)
        predicted = np.clip(np.asarray(logarithm.dn(state)), 0.0, 255.0)
        made = np.asarray(lin_log(predicted)) - np.asarray(lin_log(self.before))
        return self.seen - np.stack([blurred(image) for image in made])


def changes(recording: Recording) -> Changes:
    """Those of a recording."""
    parts = [(p.counts, p.before, p.after) for p in intervals(recording, np.asarray)]
    n, before, after = (np.stack(x) for x in zip(*parts, strict=True))
    seen = np.asarray(lin_log(after)) - np.asarray(lin_log(before))
    return Changes(n, before, np.stack([blurred(image) for image in seen]))


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
    fitted to the second half itself and bounds what two numbers can do in lin-log."""
    first, second = halves(recording)
    found = changes(second)
    used = np.abs(found.seen) > CHANGED
    n = np.stack([[blurred(c) for c in pair] for pair in found.counts])
    design = np.stack([n[:, 0][used], -n[:, 1][used]], -1).astype(np.float64)
    start = time.perf_counter()
    best, *_ = np.linalg.lstsq(design, found.seen[used].astype(np.float64), rcond=None)
    seconds = time.perf_counter() - start
    size = float(np.sqrt(np.mean(found.seen[used] ** 2)))

    def left(on: np.ndarray, off: np.ndarray, logarithm: Logarithm) -> float:
        return float(np.sqrt(np.mean(found.left(on, off, logarithm)[used] ** 2)) / size)

    on, off = (np.full(found.seen.shape[1:], t, np.float32) for t in best)
    result = {"frame regression": {
        "theta": best.tolist(), "left": left(on, off, LIN_LOG), "seconds": seconds, "notes": [
            f"{used.sum()} changes of {len(usable(second))} frame intervals"]}}
    for name, fit in all_fits(params, first, systems).items():
        on, off = (np.asarray(getattr(fit.camera, f"theta_{p}")) for p in POLARITIES)
        result[name] = {"theta": fit.theta.tolist(), "left": left(on, off, fit.logarithm),
                        "seconds": fit.seconds, "notes": list(fit.notes)}
    return result
