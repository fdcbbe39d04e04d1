"""A pixel's memory when the recording begins, and the information in its first event.

Two cases. Fresh: the memory is the brightness of the first frame, as in a simulation or after a
rest; then the first event is as informative as any other, and changes before it bound the
thresholds. Running: the memory lies anywhere between the thresholds; then a wide range of
brightness without an event indicates high thresholds. Each pixel is a mixture of the two; the
mixing weight is fitted by EM.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy import special

from evflow.estimation.refine.bounds import NOTHING
from evflow.estimation.refine.sightings import PATH_ERROR, Sightings, counts_so_far

Array = np.ndarray

MEMORY_ERRORS = (0.02, 0.04, 0.07, 0.1)  # candidates, log units: std of a fresh memory
EM_STEPS = 30
FIRST_SIGNAL = 0.8  # share of signal among pixels' first events
SPAN_ERROR = 0.1  # log units, of the range before the first event
NODES = 21  # of the Gauss-Hermite integral over theta_on + theta_off
REACH = 3.0  # standard deviations; a wider span is attributed to the path's error
LEAST_SHARE = 0.05  # of the variance: what the nodes resolve
LEAST_SUM = 0.02  # log units
DENSITY = float(1 / np.sqrt(2 * np.pi))  # of N(0, 1) at 0; a NumPy scalar would make all float64


class Belief(NamedTuple):
    """theta (2, H, W), covariance (2, 2, H, W), and variance (H, W) of the path at a frame."""

    theta: Array
    covariance: Array
    variance: Array


def since_start(s: Sightings, weight: Array) -> Array:
    """Statistics of the time since the first frame, (6, H, W).

    Sums over a pixel's events of the weight (N,), and of the weight times ON count, minus OFF count
    and change of the path since the first frame; largest rise and largest fall before the first
    event. No events and `NOTHING` where the first frame is saturated or black.
    """
    out = np.zeros((6, s.frames.shape[1]))
    if len(s.pixel):
        group, on, off = counts_so_far(s)
        change = s.path - s.frames[0, s.pixel]
        out[:4, s.pixel[s.first]] = [
            np.bincount(group, weight * v) for v in (np.ones_like(on), on, off, change)]
    fired = np.zeros(s.frames.shape, bool)
    fired[s.interval + 1, s.pixel] = True
    early = s.seen & ~np.maximum.accumulate(fired, 0)
    change = np.where(early, s.frames - s.frames[:1], 0.0)
    out[4:] = change.max(0), -change.min(0)
    out[:, ~s.seen[0]] = np.array([0.0, 0.0, 0.0, 0.0, NOTHING, NOTHING])[:, None]
    return out.reshape(6, *s.shape)


def with_fresh_start(equations: Array, start: Array, error: float) -> Array:
    """The regression's sums with one more observation, of a fresh memory: at the first frame it is
    the brightness.

    Args:
        equations: (7, H, W) sums about the means.
        start: of `since_start`.
        error: std of the memory, log units.
    """
    total, on, off, change = start[:4]
    weight = PATH_ERROR**2 / (error**2 + PATH_ERROR**2)
    share = np.divide(weight, total * (total + weight), where=total > 0, out=np.zeros_like(total))
    pairs = ((on, on), (on, off), (off, off), (on, change), (off, change), (change, change))
    return np.concatenate([equations[:6] + share * np.stack([u * v for u, v in pairs]),
                           equations[6:]])


def fresh_probability(start: Array, running: Belief, median: Array) -> tuple[float, Array]:
    """Fit the mixture of fresh and running pixels to the first events.

    Args:
        start: (6, H, W) of `since_start`.
        running: the belief from all other events.
        median: (2,) thresholds of the camera.

    Returns:
        Std of a fresh memory, the best of MEMORY_ERRORS; probability (H, W) that a pixel is fresh.
    """
    fired = start[0] > 0
    likely = _first_events(start[:4, fired], Belief(*(a[..., fired] for a in running)), median)
    best, error, share, chance = -np.inf, MEMORY_ERRORS[0], 0.0, np.zeros(fired.sum())
    for candidate, near in zip(MEMORY_ERRORS, likely[:-1], strict=True):
        part, odds = 0.5, np.exp(near - likely[-1])
        for _ in range(EM_STEPS if fired.any() else 0):
            belief = part * odds / (part * odds + 1 - part)
            part = float(belief.mean())
        total = (np.log(part * odds + 1 - part) + likely[-1]).sum()
        if fired.any() and total > best:
            best, error, share, chance = total, candidate, part, belief
    result = np.where(start[4] > NOTHING, share, 0.0)
    result[fired] = chance
    return error, result


def _first_events(start: Array, running: Belief, median: Array) -> Array:
    """(errors + 1, N) log-likelihood of the brightness at the first frame, for a fresh memory with
    each of MEMORY_ERRORS, and for a running one."""
    total, on, off, change = start
    a, b, y = on / total, off / total, change / total
    (aa, ab), (_, bb) = running.covariance
    away = y - a * running.theta[0] - b * running.theta[1]
    variance = a * a * aa + 2 * a * b * ab + b * b * bb + running.variance / total
    anywhere = median.sum() ** 2 / 12, 0.5 * (median[1] - median[0])
    cases = [(error**2, 0.0) for error in MEMORY_ERRORS] + [anywhere]
    return np.stack([-0.5 * (np.log(variance + v) + (away - mean) ** 2 / (variance + v))
                     for v, mean in cases])


def with_running_start(
    mean: Array, covariance: Array, span: Array, fired: Array
) -> tuple[Array, Array]:
    """Condition the belief of running pixels on their first event.

    Args:
        mean, covariance: (2, H, W), (2, 2, H, W).
        span: (H, W) range of the brightness up to the first event.
        fired: (H, W) bool, whether there is one.

    Returns:
        Mean and covariance.
    """
    along = covariance.sum(1)
    variance, centre = along.sum(0), mean.sum(0)
    moments = _moments(*(v.astype(np.float32)
                         for v in (centre, np.sqrt(variance), np.maximum(span, 0.0))), fired)
    moved, shrunk = (np.asarray(m, np.float64) for m in moments)
    covariance = covariance - along[:, None] * along[None] * ((1 - shrunk) / variance)
    return mean + along * (moved / np.sqrt(variance)), covariance


@jax.jit
def _moments(
    centre: jax.Array, scale: jax.Array, span: jax.Array, fired: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Posterior mean and variance of (theta_on + theta_off - centre) / scale, a priori N(0, 1)."""
    span = jnp.minimum(span, centre + REACH * scale)

    def node(sums: jax.Array, at: tuple[jax.Array, ...]) -> tuple[jax.Array, None]:
        z, weight = at
        width = jnp.maximum(centre + z * scale, LEAST_SUM)
        margin = (width - span) / SPAN_ERROR
        room = margin * special.ndtr(margin) + DENSITY * jnp.exp(-0.5 * margin**2)
        silent = jnp.where(span > 0, SPAN_ERROR * room / width, 1.0)
        signal = special.ndtr(margin) / width
        likely = jnp.where(fired, FIRST_SIGNAL * signal + (1 - FIRST_SIGNAL) * silent, silent)
        return sums + weight * jnp.stack([likely, likely * z, likely * z**2]), None

    nodes = [jnp.asarray(v, centre.dtype) for v in np.polynomial.hermite_e.hermegauss(NODES)]
    zeros = jnp.full((3, *centre.shape), jnp.finfo(centre.dtype).tiny)
    (total, first, second), _ = jax.lax.scan(node, zeros, tuple(nodes))
    return first / total, jnp.maximum(second / total - (first / total) ** 2, LEAST_SHARE)
