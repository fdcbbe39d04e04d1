"""Similarity of two event streams in space and time: correlation of events in small cubes."""

from __future__ import annotations

import numpy as np

from evflow.types import Events

CELL, STEP_US = 3, 2_000  # pixels, microseconds: side and duration of a cube


def space_time_r(a: Events, b: Events, t0: int, t1: int) -> float | None:
    """Pearson's r of ON minus OFF events over cubes of CELL x CELL pixels and STEP_US in [t0, t1);
    None where a stream does not vary. Memory is proportional to the events, not to the cubes."""
    width, height = a.size
    columns, rows = -(-width // CELL), -(-height // CELL)
    cubes = columns * rows * -(-(t1 - t0) // STEP_US)
    (where_a, net_a), (where_b, net_b) = (_cubes(e, t0, columns, rows) for e in (a, b))
    _, at_a, at_b = np.intersect1d(where_a, where_b, assume_unique=True, return_indices=True)
    mean_a, mean_b = net_a.sum() / cubes, net_b.sum() / cubes
    together = net_a[at_a] @ net_b[at_b] / cubes - mean_a * mean_b
    spread = (net_a @ net_a / cubes - mean_a**2) * (net_b @ net_b / cubes - mean_b**2)
    return float(np.clip(together / np.sqrt(spread), -1.0, 1.0)) if spread > 0 else None


def _cubes(events: Events, t0: int, columns: int, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of the cubes that hold events, ascending, and their ON less OFF events."""
    cell = (events.y // CELL).astype(np.int64) * columns + events.x // CELL
    cube = (events.t - t0) // STEP_US * (columns * rows) + cell
    where, index = np.unique(cube, return_inverse=True)
    return where, np.bincount(index, np.where(events.p, 1.0, -1.0), len(where))
