"""Each pixel's thresholds, from the path at the pixel's own events and from those it did not send.

At the instant of an event the memory equals the brightness, so over the events i of a pixel the
path at t_i is theta_on a_i - theta_off b_i plus a constant, a and b counting its events: a linear
regression without quantisation noise, whose only error is the path's. Its normal equations add
over chunks; the camera's summary and mismatch are the prior, and bounds.py has the last word.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from evflow.camera import THETA_MIN, Summary
from evflow.refine.bounds import NOTHING, bounded, unanswered
from evflow.refine.sightings import Sightings, sight
from evflow.types import Events

Array = np.ndarray

PATH_ERROR = 0.04  # log units: error of the path at a frame, from the frame's noise
RANGE_ERROR = 0.2  # of the path's range in an interval: its error half-way between two frames
TYPICAL_THETA = 0.25  # log units: turns events into a range, where the path may have missed it
PRIOR_COUNT = 3.0  # events' worth of belief in PATH_ERROR, against the residuals seen
SHARED_ERROR = 2.0  # errors of neighbouring events go together: variance is this much larger
LEAST_VARIANCE = 0.3 * PATH_ERROR**2  # a path that misses all motion leaves no residuals
PASSES = 3
HIDDEN = 1e-9  # weight of an event whose brightness no frame shows: nothing, yet no 0 / 0


@dataclasses.dataclass(frozen=True, eq=False)
class PixelEvidence:
    """equations: (7, H, W) sums of weighted aa, ab, bb, ay, by, yy about their means, and the
    number of events. bounds: (3, H, W), see `unanswered`. Evidence of several chunks adds."""

    equations: Array
    bounds: Array

    @staticmethod
    def nothing(shape: tuple[int, int]) -> PixelEvidence:
        return PixelEvidence(np.zeros((7, *shape)), np.full((3, *shape), NOTHING))

    def __add__(self, other: PixelEvidence) -> PixelEvidence:
        return PixelEvidence(
            self.equations + other.equations, np.maximum(self.bounds, other.bounds))


def pixel_evidence(
    events: Events, times_us: Array, path: Array, steps: int, seen: Array | None = None
) -> PixelEvidence:
    """What the events between frames at times_us (K + 1,) say about each pixel, given the path
    (K*steps + 1, H, W) of its log brightness. seen: (K + 1, H, W) bool, frames that show what
    the pixel saw; events of intervals that are not shown are not used."""
    return evidence_of(sight(events, times_us, path, steps, seen))


def evidence_of(s: Sightings) -> PixelEvidence:
    """The same of events that are placed beside the path already."""
    return PixelEvidence(_equations(s), unanswered(s))


def _equations(s: Sightings) -> Array:
    out = np.zeros((7, s.frames.shape[1]))
    if len(s.pixel) == 0:
        return out.reshape(7, *s.shape)
    span = np.maximum(s.inner[s.interval, s.pixel], TYPICAL_THETA * _net_range(s))
    between = 4 * s.fraction * (1 - s.fraction)
    weight = 1.0 / (1.0 + (RANGE_ERROR / PATH_ERROR * span) ** 2 * between)
    weight *= np.where(s.shown, 1.0, HIDDEN)
    group = np.cumsum(np.diff(s.pixel, prepend=-1) != 0) - 1

    def total(v: Array) -> Array:
        return np.bincount(group, v)

    def centred(v: Array) -> Array:
        return v - (total(weight * v) / total(weight))[group]

    a, b = np.cumsum(s.on.astype(np.float64)), np.cumsum(1.0 - s.on)
    a, b, y = (centred(v) for v in (a - a[s.first][group], b[s.first][group] - b, s.path))
    sums = [total(weight * u * v) for u, v in ((a, a), (a, b), (b, b), (a, y), (b, y), (y, y))]
    out[:, s.pixel[s.first]] = [*sums, total(s.shown.astype(np.float64))]
    return out.reshape(7, *s.shape)


def _net_range(s: Sightings) -> Array:
    """(N,): how many net events the pixel went up and down in the interval of each event. What
    moves there and back between two frames is seen by the events alone."""
    sign = np.where(s.on, 1, -1)
    net = np.cumsum(sign)
    new = (np.diff(s.pixel, prepend=-1) != 0) | (np.diff(s.interval, prepend=-1) != 0)
    begin = np.flatnonzero(new)
    before = (net - sign)[begin]
    high = np.maximum(np.maximum.reduceat(net, begin), before)
    low = np.minimum(np.minimum.reduceat(net, begin), before)
    return (high - low)[np.cumsum(new) - 1]


def pixel_posterior(evidence: PixelEvidence, summary: Summary) -> tuple[Array, Array]:
    """theta (2, H, W) and its std, given the camera: N(median, sigma²) per pixel times the
    regression, whose error variance each pixel learns from its own residuals, within the bounds."""
    aa, ab, bb, ay, by, yy, count = evidence.equations
    median = np.array([float(summary.theta_on), float(summary.theta_off)])
    prior = np.array([float(summary.sigma_on), float(summary.sigma_off)])
    p_on, p_off = 1.0 / np.maximum(prior, 0.01) ** 2
    on, off = median  # a start from the regression could explain a path that missed all motion
    for _ in range(PASSES):
        residual = (yy - 2 * on * ay - 2 * off * by + on**2 * aa + off**2 * bb
                    + 2 * on * off * ab)
        variance = ((PRIOR_COUNT * PATH_ERROR**2 + np.maximum(residual, 0.0))
                    / (PRIOR_COUNT + np.maximum(count - 1.0, 0.0)))
        s = SHARED_ERROR * np.maximum(variance, LEAST_VARIANCE)
        m11, m12, m22 = aa / s + p_on, ab / s, bb / s + p_off
        r1, r2 = ay / s + p_on * median[0], by / s + p_off * median[1]
        det = m11 * m22 - m12**2
        on, off = (m22 * r1 - m12 * r2) / det, (m11 * r2 - m12 * r1) / det
    covariance = np.stack([np.stack([m22, -m12]), np.stack([-m12, m11])]) / det
    mean, covariance = bounded(np.stack([on, off]), covariance, evidence.bounds)
    std = np.sqrt(np.stack([covariance[0, 0], covariance[1, 1]]))
    return np.maximum(mean, THETA_MIN).astype(np.float32), std.astype(np.float32)
