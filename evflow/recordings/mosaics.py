"""Frames that are a raw colour mosaic: their four planes, every other pixel of every other row, are
unlike bright."""

from __future__ import annotations

import numpy as np

from evflow.light.colour import CELLS
from evflow.types import Recording

SOME = 8  # frames that are looked at, evenly spread
LEAST_DN = 2.0  # median of a plane that tells something
UNEVEN = 1.15  # ratio of two planes' medians: that of a grey scene is within a few per cent
ALIKE = 1.05  # of those of a mosaic's two green planes, which lie diagonally


def planes(recording: Recording) -> np.ndarray:
    """(4,) medians in DN of the planes, row by row from the top left, over some frames."""
    count = len(recording.frame_times)
    chosen = np.unique(np.linspace(0, count - 1, min(count, SOME)).astype(int))
    frames = [recording.frame_dn(int(i)) for i in chosen]
    return np.array([np.median([frame[cell] for frame in frames]) for cell in CELLS])


def mosaic_planes(recording: Recording) -> np.ndarray | None:
    """`planes`, if two that lie diagonally are alike, as the green ones, and another is not; else
    None."""
    if min(recording.frames.shape[1:]) < 2:
        return None
    medians = planes(recording)
    if medians.min() < LEAST_DN:
        return None
    for green, others in ((medians[[0, 3]], medians[[1, 2]]), (medians[[1, 2]], medians[[0, 3]])):
        away = np.maximum(others / green.mean(), green.mean() / others)
        if green.max() < ALIKE * green.min() and away.max() > UNEVEN:
            return medians
    return None
