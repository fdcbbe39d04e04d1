"""How well thresholds from the first half of a recording predict its second half."""

from __future__ import annotations

import itertools

import cv2
import numpy as np

from evflow import Recording
from evflow.baselines.base import intervals, usable

CHANGED = 0.1  # log units: pixels that change by less between two frames say little
SMOOTH = 1.0  # pixels: frames and counts are blurred alike, against noise and misregistration


def halves(recording: Recording) -> tuple[Recording, Recording]:
    """The usable part of a recording before and from its middle frame on: they share that frame
    and no event."""
    found, events = usable(recording), recording.events
    cuts = [found[0], found[(len(found) + 1) // 2], found[-1] + 1]
    times = recording.frame_times
    first, second = (
        Recording(events.slice(int(times[a]), int(times[b])), recording.frames[a:b + 1],
                  times[a:b + 1]) for a, b in itertools.pairwise(cuts))
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
