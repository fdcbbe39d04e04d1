"""Noise of the frames: its standard deviation, and denoised frames.

The path between noisy frames changes where the scene does not. The regression reads this as
contrast without events and returns thresholds that are too high, by up to 40 % at 3 DN of noise,
and by 30 % at 1 DN where most of the scene is below 30 DN.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from evflow.recordings.glitches import exposed
from evflow.types import Recording

LEAST_DN = 0.8  # frames with less are not denoised; moving fine textures look like 1.5 DN
ENOUGH = 10  # quiet tiles needed for a measurement
TILE, EVEN = 12, 0.1  # side in pixels; quantile over tiles
PAIRS = 8  # of frames that are measured
PATCH, SEARCH = 5, 15  # pixels: sides of the patch and of the search window of non-local means


def frame_noise(intervals: Sequence[tuple[Recording, int]]) -> float:
    """Standard deviation of the frames' noise.

    Noise is the same everywhere, motion is not: the noise is a low quantile over tiles without
    events.

    Args:
        intervals: (recording, i) of frames i and i + 1.

    Returns:
        DN; 0 where fewer than ENOUGH tiles are quiet.
    """
    chosen = np.unique(np.linspace(0, len(intervals) - 1, min(PAIRS, len(intervals))).round())
    found = []
    for k in chosen.astype(int):
        recording, i = intervals[k]
        first, second = (recording.frame_dn(i + j) for j in (0, 1))
        t0, t1 = recording.frame_times[i:i + 2].tolist()
        counts = recording.events.slice(t0, t1).count_map().sum(0)
        quiet = exposed(first, second) & (cv2.blur(counts.astype(np.float32), (3, 3)) == 0)
        found += _noise(first, second, quiet)
    return float(np.quantile(found, EVEN)) if len(found) >= ENOUGH else 0.0


def _noise(first: np.ndarray, second: np.ndarray, quiet: np.ndarray) -> list[float]:
    """Noise of two frames in DN, of each tile with enough quiet pixels."""
    change = second - first
    away = np.abs(change - cv2.blur(change, (3, 3)))
    height, width = change.shape
    tiles = [(slice(y, y + TILE), slice(x, x + TILE))
             for y in range(0, height, TILE) for x in range(0, width, TILE)]
    return [1.4826 * float(np.median(away[tile][quiet[tile]])) / np.sqrt(2 * 8 / 9)
            for tile in tiles if quiet[tile].sum() >= TILE**2 // 4]


def denoised(frame: np.ndarray, noise_dn: float) -> np.ndarray:
    """A frame (H, W) in DN, float32, denoised by non-local means (Buades et al., CVPR 2005) where
    its noise is at least LEAST_DN."""
    if noise_dn < LEAST_DN:
        return frame
    whole = np.clip(np.rint(frame), 0, 255).astype(np.uint8)
    return cv2.fastNlMeansDenoising(whole, None, noise_dn, PATCH, SEARCH).astype(np.float32)
