"""Lower bounds on a pixel's thresholds: changes of the path that triggered no event.

After an event the memory is the path's value there. If the path then rises by d before any ON
event comes, theta_on > d; likewise for falls. start.py treats the time before the first event. The
path is read at frames only: between frames its error is as large as the thresholds.
"""

from __future__ import annotations

import jax
import numpy as np
from jax.scipy import special

from evflow.estimation.refine.sightings import Sightings

Array = np.ndarray

NOTHING = -1.0  # log units: no bound
# The largest of several measured changes exceeds the true one by about EXCESS, which is subtracted.
# ERROR is the path's, from after an event to a frame. On simulated recordings two thirds of it
# suffice; but then a re-simulated Newton's cradle correlates less with the recorded counts.
EXCESS = 0.1
ERROR = 0.15
log_ndtr = jax.jit(special.log_ndtr)  # operation by operation it takes a second to compile


def unanswered(s: Sightings) -> Array:
    """(3, H, W) log units: the largest rise without an ON event, the largest fall without an OFF
    event, the path's range before the first event; `NOTHING` where there is none."""
    frames, k = np.where(s.seen, s.frames, np.nan), len(s.frames) - 1
    memory = np.full(frames.shape, np.nan, frames.dtype)  # at each frame: path at the last event
    memory[s.interval + 1, s.pixel] = np.where(s.shown, s.path, np.nan)
    fired = np.zeros(frames.shape, bool)
    fired[s.interval + 1, s.pixel] = True
    latest = np.maximum.accumulate(np.where(fired, np.arange(k + 1)[:, None], 0), 0)
    memory = np.take_along_axis(memory, latest, 0)
    following = _following(s, k)
    rise = np.where(following > 0, np.nan, frames - memory)
    fall = np.where(following < 0, np.nan, memory - frames)
    early = np.where(np.maximum.accumulate(fired, 0), np.nan, frames)
    begin = np.full(frames.shape[1], np.nan)
    begin[s.pixel[s.first]] = s.path[s.first]
    span = (np.fmax(np.fmax.reduce(early, 0), begin) - np.fmin(np.fmin.reduce(early, 0), begin))
    bounds = np.stack([np.fmax.reduce(rise, 0), np.fmax.reduce(fall, 0), span])
    return np.nan_to_num(bounds, nan=NOTHING).reshape(3, *s.shape)


def _following(s: Sightings, k: int) -> Array:
    """(K + 1, H*W): polarity of the first event after each frame, 1 or -1; 0 without one."""
    following = np.zeros((k + 1, s.frames.shape[1]), np.int8)
    # Backwards, so that the first of several events in an interval is kept.
    following[s.interval[::-1], s.pixel[::-1]] = np.where(s.on, 1, -1)[::-1]
    for j in range(k - 1, -1, -1):
        following[j] = np.where(following[j] == 0, following[j + 1], following[j])
    return following


def bounded(
    mean: Array, covariance: Array, bounds: Array, error: float = ERROR
) -> tuple[Array, Array]:
    """Condition N(mean, covariance) of (theta_on, theta_off) on lower bounds.

    Moments of the truncated Gaussian, one bound at a time.

    Args:
        mean, covariance: (2, ...) and (2, 2, ...).
        bounds: (2, ...) log units, as of `unanswered`.
        error: std of the bounds, log units.

    Returns:
        Mean (2, ...) and covariance (2, 2, ...).
    """
    for i, bound in enumerate(bounds):
        along = covariance[:, i]
        scale = np.sqrt(along[i] + error**2)
        margin = (mean[i] - (bound - EXCESS)) / scale
        # phi / Phi from logarithms: both vanish far below the bound
        log_mills = -0.5 * margin**2 - np.asarray(log_ndtr(margin.astype(np.float32)))
        pull = np.where(bound == NOTHING, 0.0, np.exp(log_mills) / np.sqrt(2 * np.pi))
        mean = mean + along * (pull / scale)
        shrink = pull * (pull + margin) / scale**2
        covariance = covariance - shrink * along[:, None] * along[None, :]
    return mean, covariance
