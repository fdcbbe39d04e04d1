"""Additive statistics of a Trace against the path, for comparing recorded and simulated events.

Balance: after a pixel's first event, its brightness change dL up to a frame equals the contrast of
its events, dL = theta_on n_on - theta_off n_off + remainder. Sums of these terms over pixels that
got brighter, and over those that got darker, are independent of the path between the frames (pairs
of ON and OFF cancel). They fix the scale of theta where motion is too fast to interpolate. Root
counts and numbers of active pixels depend on the path, and are more precise where motion is slow.
"""

from __future__ import annotations

import dataclasses

import jax
import numpy as np

from evflow.estimation.refine.trace import NEVER, Trace

Array = np.ndarray

LAGS = (1, 2, 4, 0)  # frames between the ends of dL; 0: from the first event on
DEAD, FULL = 0.1, 0.5  # log units: smaller changes belong to no side; the weight saturates


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Moments:
    """Sums over pixels; the Moments of chunks add.

    balance: (lags, 2 sides, 4) weighted n_on, n_off, dL, |dL|; squares: (2 sides, 7) weighted
    n_on², n_off², n_on n_off, n_on dL, n_off dL, dL², 1, from the first event to each frame;
    roots, active, events: (2,) sum of sqrt(count), pixels with events, events, per polarity;
    early: pixels that fire within the first quarter of the first interval; pixels, exposure:
    pixels, pixel seconds.
    """

    balance: Array
    squares: Array
    roots: Array
    active: Array
    events: Array
    early: Array
    pixels: Array
    exposure: Array


def measure(trace: Trace, path: Array, dt_s: Array, bright: Array, steps: int) -> Moments:
    """Moments of one chunk.

    Args:
        trace: of its events.
        path: (K*steps + 1, H, W) log intensity.
        dt_s: (K,) interval lengths.
        bright: (H, W) bool, the pixels to use.
        steps: fine steps per interval.
    """
    flat, first = path.reshape(len(path), -1), trace.step.ravel()
    counts = trace.counts.reshape(len(dt_s), 2, -1)
    known = np.flatnonzero((first != NEVER) & bright.ravel())
    step = first[known]
    at = step.astype(np.int64) * flat.shape[1] + known  # `take` is faster than a pair of indices
    origin, after = flat.take(at), flat.take(at + flat.shape[1])
    origin = origin + trace.fraction.ravel()[known] * (after - origin)
    since = _since_first(counts.take(known, -1), trace.first_on.ravel()[known], step // steps)
    begun = np.arange(len(since))[:, None] * steps > step
    changes = np.where(begun, flat[::steps].take(known, 1) - origin, np.float32(0.0))
    balance = []
    for lag in LAGS:
        n = since[lag:] - since[:-lag] if lag else since[1:]
        dL = changes[lag:] - changes[:-lag] if lag else changes[1:]
        balance.append(_sides(n, dL, squares=False))
    total = counts.sum(0) * bright.ravel()
    return Moments(
        np.stack(balance), _sides(since[1:], changes[1:], squares=True),
        roots=np.sqrt(total).sum(1, dtype=np.float64),
        active=(total > 0).sum(1).astype(np.float64), events=total.sum(1, dtype=np.float64),
        early=np.asarray((step < steps // 4).sum(), float), pixels=np.asarray(bright.sum(), float),
        exposure=np.asarray(bright.sum() * dt_s.sum(dtype=np.float64)))


def _since_first(counts: Array, first_on: Array, interval: Array) -> Array:
    """Counts (K+1, 2, N) after the first event up to each frame; 0 before it."""
    counts[interval, np.where(first_on, 0, 1), np.arange(len(interval))] -= 1
    return np.concatenate([np.zeros_like(counts[:1]), np.cumsum(counts, 0)])


def _sides(n: Array, dL: Array, *, squares: bool) -> Array:
    """Weighted sums over the brighter and the darker pixels, (2, 4) or (2, 7). The weight 1/(1+n)
    keeps the few pixels at the threshold's clamp, with most of the events, from dominating."""
    rows = []
    for side in (1, -1):
        at = np.flatnonzero(dL > DEAD if side > 0 else dL < -DEAD)
        on, off, change = (a.take(at).astype(np.float64) for a in (n[:, 0], n[:, 1], dL))
        weight = np.minimum(side * change - DEAD, FULL) / (1 + on + off)
        terms = ((on * on, off * off, on * off, on * change, off * change, change * change, 1.0)
                 if squares else (on, off, change, np.abs(change)))
        rows.append([float((weight * term).sum()) for term in terms])
    return np.array(rows)
