"""Frames that are read row by row (a rolling shutter): the offset at which events and frames agree
best grows steadily from row to row."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np

from evflow.files.spool import forget
from evflow.recordings.check.findings import Finding
from evflow.recordings.check.steps import SWEEP_STEP_US, Steps, codes

BANDS, LEAST_BANDS = 6, 5  # of rows; those that must agree
AGREES = 0.35  # least r of a band at its best offset
REACH_US = 40_000
LEAST_US = 8_000  # from the first row to the last
SCATTER = 0.08  # of that: the most by which offsets lie off a straight line


def rolling(steps: Steps) -> Finding | None:
    """EV024 if the frames' rows are not of one time."""
    found = [(row, steps.peak(r)[0]) for row, r in _bands(steps)
             if np.nanmax(np.nan_to_num(r, nan=-1.0)) > AGREES]
    if len(found) < LEAST_BANDS:
        return None
    rows, offsets = np.array(found, np.float64).T
    slope, level = np.polyfit(rows, offsets, 1)
    late = -slope * steps.events.size[1]
    if abs(late) < LEAST_US or np.abs(offsets - level - slope * rows).max() > SCATTER * abs(late):
        return None
    return Finding(
        "EV024", "warning", f"the bottom of the frames is {abs(late) / 1e3:.0f} ms "
        f"{'earlier' if late > 0 else 'later'} than their top: a rolling shutter?",
        "Pass --rolling-ms auto, or this time and the side that is read first, --rolling-from; "
        "else thresholds come out too high where things move (by 5 to 17 % with 10 to 30 ms in "
        "simulations).")


def _bands(steps: Steps) -> list[tuple[float, np.ndarray]]:
    """The middle row of each band, and r at each of the steps' offsets, NaN beyond REACH_US."""
    columns = -(-steps.events.size[0] // steps.cell)
    change = steps.changes[""]
    rows = change.shape[1] // columns
    if rows < BANDS:
        return []
    edges = np.linspace(0, rows, BANDS + 1).astype(int)
    middle, reach = len(steps.offsets_us) // 2, REACH_US // SWEEP_STEP_US
    near = slice(max(middle - reach, 0), middle + reach + 1)
    sums = _sums(steps, steps.offsets_us[near], columns * edges)
    bands = []
    for band, (first, last) in enumerate(itertools.pairwise(edges.tolist())):
        kept = np.full_like(change, np.nan)
        kept[:, columns * first : columns * last] = change[:, columns * first : columns * last]
        r = np.full(len(steps.offsets_us), np.nan)
        r[near] = dataclasses.replace(steps, changes={"": kept}).r_of(sums[:, :, band])
        bands.append((0.5 * steps.cell * float(first + last), r))
    return bands


def _sums(steps: Steps, offsets_us: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """As `Steps.sums`, but (K, 6, bands, offsets). edges: first cell of each band, and the end."""
    sums = np.zeros((len(steps.bounds), 6, len(edges) - 1, len(offsets_us)))
    for k, (change, (t0, t1)) in enumerate(zip(steps.changes[""], steps.bounds, strict=True)):
        known = np.isfinite(change)
        a = np.where(known, change, 0.0)
        events = steps.events
        forget(events.x, events.y, events.t, events.p)
        near = events.slice(int(t0 + offsets_us.min()), int(t1 + offsets_us.max()))
        code = codes(near, steps.cell)
        ends = np.searchsorted(near.t, np.stack([t0 + offsets_us, t1 + offsets_us]))
        for i, (first, last) in enumerate(ends.T):
            sign = np.bincount(code[first:last], minlength=2 * len(change)).reshape(-1, 2)
            b = np.where(known, (sign[:, 1] - sign[:, 0]).astype(np.float64), 0.0)
            columns = a, b, a * a, b * b, a * b, sign.sum(1).astype(np.float64)
            sums[k, :, :, i] = [np.add.reduceat(c, edges[:-1]) for c in columns]
    return sums
