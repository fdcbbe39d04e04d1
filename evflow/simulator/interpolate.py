"""Frame interpolation by optical flow (OpenCV DIS).

The simulator takes log intensity as linear between frames, which is right only while nothing
moves by more than about a pixel. Blending 40 ms apart mis-simulates everything fast, so slower
videos are first filled up with motion-compensated frames (host code, frame pair by frame pair).
"""

from __future__ import annotations

import collections
import math
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import cv2
import numpy as np

from evflow.errors import EvflowDataError
from evflow.notes import Note

MIN_SIDE = 12  # pixels on the longer side: smaller frames show no motion
PATCHES = 16  # pixels: two of DIS' patches
MAX_STEPS = 64  # frames per pair; beyond it the motion is too fast to trust the flow anyway
MOTION_QUANTILE = 99.5  # per cent of pixels that must move less than the wanted step


def upsample(
    pairs: Iterable[tuple[np.ndarray, int]], *, max_motion_px: float = 1.0,
    warn: Callable[[Note], None] | None = None,
) -> Iterator[tuple[np.ndarray, int]]:
    """Yield (frame, time) with at most ~max_motion_px of motion between neighbours.

    pairs: (frame (H, W) in DN 0..255, time in us). Yields float32 frames; the given ones come
    out unchanged, those between lie evenly in time. `warn` is told, once, where the motion of
    a pair exceeds MAX_STEPS steps. Raises EV002 (frames too small or of changing size), EV020.
    """
    if not max_motion_px > 0:
        raise EvflowDataError("EV020", f"max_motion_px={max_motion_px}.", "It must be > 0.")
    interpolator = Interpolator()
    previous, t0, told = None, 0, False
    for frame, t1 in pairs:
        current = np.asarray(frame, np.float32)
        shape = current.shape if previous is None else previous.shape
        if current.ndim != 2 or current.shape != shape:
            raise EvflowDataError(
                "EV002", f"frame at {t1} us has shape {current.shape}, the first {shape}.",
                "Expected (H, W) of one size.")
        if max(shape) < MIN_SIDE:
            raise EvflowDataError(
                "EV002", f"frames of {shape[1]}x{shape[0]} pixels are too small to see motion in: "
                f"their longer side has less than {MIN_SIDE}.",
                "Take the frames as they are: --no-interpolate, or no upsample.")
        if previous is not None:
            there, back, motion = interpolator.motion(previous, current)
            wanted = math.ceil(motion / max_motion_px)
            steps = int(np.clip(wanted, 1, min(MAX_STEPS, max(1, t1 - t0))))
            if wanted > MAX_STEPS and warn and not told:
                told = True
                warn(Note("frames.fast", f"motion of {motion:.0f} px between the frames at {t0} "
                          f"and {t1} us is too fast to interpolate well; {steps} steps were "
                          "used."))
            for k in range(1, steps):
                s = k / steps
                yield _between(previous, current, there, back, s), t0 + round(s * (t1 - t0))
        yield current, int(t1)
        previous, t0 = current, int(t1)


class Interpolator:
    """Motion between two frames (H, W) in DN 0..255, and the frames in between."""

    def __init__(self) -> None:
        preset = cv2.DISOPTICAL_FLOW_PRESET_MEDIUM
        self._dis: Any = cv2.DISOpticalFlow_create(preset)  # type: ignore[attr-defined]

    def motion(self, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """Motion (H, W, 2) in pixels (x, y) that carries a into b, that which carries b into a,
        and how far the fast pixels move."""
        first, second = _padded(_gray8(a)), _padded(_gray8(b))
        there, back = (self._dis.calc(*pair, None)[:a.shape[0], :a.shape[1]]
                       for pair in ((first, second), (second, first)))
        return there, back, _motion(there)

    def between(self, a: np.ndarray, b: np.ndarray, steps: int) -> tuple[list[np.ndarray], float]:
        """The steps - 1 frames evenly between a and b, and how far the fast pixels move."""
        there, back, motion = self.motion(a, b)
        return [_between(a, b, there, back, k / steps) for k in range(1, steps)], motion


def _gray8(frame: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(frame), 0, 255).astype(np.uint8)


def _padded(image: np.ndarray) -> np.ndarray:
    """At least PATCHES pixels on each side: DIS ends the process at some narrower frames."""
    return np.pad(image, [(0, max(0, PATCHES - n)) for n in image.shape], mode="edge")


def _motion(flow: np.ndarray) -> float:
    return float(np.percentile(np.hypot(flow[..., 0], flow[..., 1]), MOTION_QUANTILE))


def _between(
    a: np.ndarray, b: np.ndarray, there: np.ndarray, back: np.ndarray, s: float
) -> np.ndarray:
    """The frame at fraction s, warped from both ends; the flow from the new frame is the
    quadratic blend of the two measured ones (exact for constant velocity)."""
    to_a = -(1 - s) * s * there + s * s * back
    to_b = (1 - s) ** 2 * there - s * (1 - s) * back
    return (1 - s) * _warp(a, to_a) + s * _warp(b, to_b)


def _warp(image: np.ndarray, flow: np.ndarray) -> np.ndarray:
    height, width = image.shape
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    to_x, to_y = np.moveaxis(flow.astype(np.float32), -1, 0)
    return cv2.remap(image, x + to_x, y + to_y, cv2.INTER_LINEAR,
                     borderMode=cv2.BORDER_REPLICATE)


def unzip(
    pairs: Iterable[tuple[np.ndarray, int]]
) -> tuple[Iterator[np.ndarray], Iterator[int]]:
    """Lazy (frames, times) of a stream of pairs, for `simulate_stream`, which reads a frame and
    then its time: nothing waits longer than that (itertools.tee would hold 57 pairs)."""
    source, times = iter(pairs), collections.deque[int]()

    def frames() -> Iterator[np.ndarray]:
        for frame, t in source:
            times.append(t)
            yield frame

    def waiting() -> Iterator[int]:
        while times:
            yield times.popleft()

    return frames(), waiting()
