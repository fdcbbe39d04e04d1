"""Additive statistics of a Trace against the path: what the recorded and the simulated events
are compared by.

Balance: after its first event, a pixel's brightness change dL up to a frame is carried by its
events, dL = theta_on n_on - theta_off n_off + remainder. Sums of the three terms over pixels that
got brighter, and over those that got darker, do not care what the brightness did between the
frames (pairs of ON and OFF cancel): they hold the scale of theta where motion is too fast to
interpolate. Root counts and active pixels do care, and are the more precise where it is slow.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from evflow.estimation.refine.trace import NEVER, Trace

Array = jax.Array

LAGS = (1, 2, 4, 0)  # frames between the ends of dL; 0: from the first event on
DEAD, FULL = 0.1, 0.5  # log units: changes below do not choose a side, above weigh no more


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
    """Moments of one chunk: path (K*steps + 1, H, W), dt_s (K,), bright (H, W) bool."""
    frames = path[::steps]
    used = bright.astype(path.dtype)
    known = (trace.step != NEVER) & bright
    step = jnp.where(trace.step != NEVER, trace.step, 0)
    before = jnp.take_along_axis(path, step[None], 0)[0]
    after = jnp.take_along_axis(path, step[None] + 1, 0)[0]
    origin = before + trace.fraction * (after - before)
    since, changes = _since_first(trace, step, frames, origin, steps)
    balance = []
    for lag in LAGS:
        n = since[lag:] - since[:-lag] if lag else since[1:]
        dL = changes[lag:] - changes[:-lag] if lag else changes[1:]
        balance.append(_sides(n, dL, known, squares=False))
    counts = jnp.asarray(trace.counts) * used[None, None]
    total = counts.sum(0)
    return Moments(
        jnp.stack(balance), _sides(since[1:], changes[1:], known, squares=True),
        roots=jnp.sqrt(total).sum((1, 2)),
        active=(total > 0).sum((1, 2)).astype(path.dtype),
        events=total.sum((1, 2)),
        early=(known & (step < steps // 4)).sum().astype(path.dtype),
        pixels=used.sum(), exposure=used.sum() * dt_s.sum())


def _since_first(
    trace: Trace, step: Array, frames: Array, origin: Array, steps: int
) -> tuple[Array, Array]:
    """Counts (K+1, 2, H, W) after the first event and change (K+1, H, W) since it, up to each
    frame; 0 before it."""
    interval = step // steps
    first = jnp.stack([trace.first_on, ~trace.first_on]) & (trace.step != NEVER)[None]
    here = jnp.arange(trace.counts.shape[0])[:, None, None] == interval[None]
    counts = trace.counts - (here[:, None] & first[None]).astype(frames.dtype)
    since = jnp.concatenate([jnp.zeros_like(counts[:1]), jnp.cumsum(counts, 0)])
    begun = jnp.arange(frames.shape[0])[:, None, None] * steps > step[None]
    return since, jnp.where(begun, frames - origin[None], 0.0)


def _sides(n: Array, dL: Array, known: Array, *, squares: bool) -> Array:
    """Weighted sums over the brighter and the darker pixels, (2, 4) or (2, 7). 1/(1+n): else the
    few pixels at the threshold's clamp, with most of the events, decide alone."""
    on, off = n[:, 0], n[:, 1]
    weight = known[None] / (1.0 + on + off)
    one = jnp.ones_like(dL)
    terms = ([on * on, off * off, on * off, on * dL, off * dL, dL * dL, one] if squares
             else [on, off, dL, jnp.abs(dL)])
    sides = [weight * jnp.clip(s * dL - DEAD, 0.0, FULL) for s in (1.0, -1.0)]
    return jnp.stack([jnp.stack([(z * term).sum() for term in terms]) for z in sides])
