"""What a pixel remembers when the recording begins, and what its first event then tells.

Where the memory is the brightness of the first frame, as in a simulation or after a rest, the
first event tells as much as any other, and what rises or falls before it bounds the thresholds.
Where a camera has been running the memory lies anywhere between its thresholds: the wider they
are apart, the less likely an event, and the likelier none in a given range of brightness. Which
of the two holds is a matter of the pixel; how many there are of each makes the first events
likely.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy import special

from evflow.estimation.refine.bounds import NOTHING
from evflow.estimation.refine.sightings import PATH_ERROR, Sightings, counted

Array = np.ndarray

MEMORY_ERRORS = (0.02, 0.04, 0.07, 0.1)  # log units, of the memory where it is the first frame's
EXPECTATIONS = 30  # steps of expectation and maximisation for the share of such pixels
FIRST_SIGNAL = 0.8  # share of signal among pixels' first events
SPAN_ERROR = 0.1  # log units, of the range before the first event
NODES, REACH = 21, 3.0  # of the integral over theta_on + theta_off (Gauss-Hermite); its reach in
# standard deviations: a wider span is the path's error
LEAST_SHARE = 0.05  # of the variance, that the nodes resolve
LEAST_SUM = 0.02  # log units
DENSITY = float(1 / np.sqrt(2 * np.pi))  # of N(0, 1) at 0; a NumPy scalar would make all float64


class Belief(NamedTuple):
    """theta (2, H, W), covariance (2, 2, H, W), and variance (H, W) of the path at a frame."""

    theta: Array
    covariance: Array
    variance: Array


def since_start(s: Sightings, weight: Array) -> Array:
    """(6, H, W): sums over a pixel's events of weight (N,), and of it times ON events, minus OFF
    events and change of the path since the first frame; the rise and the fall since then before
    the first event, `NOTHING` where the first frame does not show the pixel."""
    out = np.zeros((6, s.frames.shape[1]))
    if len(s.pixel):
        group, on, off = counted(s)
        change = s.path - s.frames[0, s.pixel]
        out[:4, s.pixel[s.first]] = [
            np.bincount(group, weight * v) for v in (np.ones_like(on), on, off, change)]
    said = np.zeros(s.frames.shape, bool)
    said[s.interval + 1, s.pixel] = True
    early = s.seen & ~np.maximum.accumulate(said, 0)
    change = np.where(early, s.frames - s.frames[:1], 0.0)
    out[4:] = change.max(0), -change.min(0)
    out[:, ~s.seen[0]] = np.array([0.0, 0.0, 0.0, 0.0, NOTHING, NOTHING])[:, None]
    return out.reshape(6, *s.shape)


def anchored(equations: Array, start: Array, error: float) -> Array:
    """The regression's sums (7, H, W) about the means, with one observation more: the memory at
    the first frame is its brightness, but for an error."""
    total, on, off, change = start[:4]
    weight = PATH_ERROR**2 / (error**2 + PATH_ERROR**2)
    share = np.divide(weight, total * (total + weight), where=total > 0, out=np.zeros_like(total))
    pairs = ((on, on), (on, off), (off, off), (on, change), (off, change), (change, change))
    return np.concatenate([equations[:6] + share * np.stack([u * v for u, v in pairs]),
                           equations[6:]])


def remembered(start: Array, running: Belief, median: Array) -> tuple[float, Array]:
    """The error of the memory where it is the first frame's brightness, and the probability
    (H, W) that it is, given what the other events say of each pixel."""
    fired = start[0] > 0
    likely = _first_events(start[:4, fired], Belief(*(a[..., fired] for a in running)), median)
    best, error, share, chance = -np.inf, MEMORY_ERRORS[0], 0.0, np.zeros(fired.sum())
    for candidate, near in zip(MEMORY_ERRORS, likely[:-1], strict=True):
        part, odds = 0.5, np.exp(near - likely[-1])
        for _ in range(EXPECTATIONS if fired.any() else 0):
            belief = part * odds / (part * odds + 1 - part)
            part = float(belief.mean())
        total = (np.log(part * odds + 1 - part) + likely[-1]).sum()
        if fired.any() and total > best:
            best, error, share, chance = total, candidate, part, belief
    result = np.where(start[4] > NOTHING, share, 0.0)
    result[fired] = chance
    return error, result


def _first_events(start: Array, running: Belief, median: Array) -> Array:
    """(errors + 1, N) log-likelihood of the brightness at the first frame for each of
    MEMORY_ERRORS, and for a memory anywhere between the thresholds."""
    total, on, off, change = start
    a, b, y = on / total, off / total, change / total
    (aa, ab), (_, bb) = running.covariance
    away = y - a * running.theta[0] - b * running.theta[1]
    variance = a * a * aa + 2 * a * b * ab + b * b * bb + running.variance / total
    anywhere = median.sum() ** 2 / 12, 0.5 * (median[1] - median[0])
    cases = [(error**2, 0.0) for error in MEMORY_ERRORS] + [anywhere]
    return np.stack([-0.5 * (np.log(variance + v) + (away - mean) ** 2 / (variance + v))
                     for v, mean in cases])


def running_on(mean: Array, covariance: Array, span: Array, fired: Array) -> tuple[Array, Array]:
    """The belief mean (2, H, W), covariance (2, 2, H, W) of a pixel whose memory at the start may
    lie anywhere between its thresholds, given the range (H, W) of its brightness up to its first
    event, and whether there is one (H, W)."""
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
    """Mean and variance of (theta_on + theta_off - centre) / scale, before N(0, 1)."""
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
