"""Each pixel's thresholds, from the path at the pixel's own events and from those it did not send.

At the instant of an event the memory equals the brightness, so over the events i of a pixel the
path at t_i is theta_on a_i - theta_off b_i plus a constant, a and b counting its events: a linear
regression without quantisation noise, whose only error is the path's; the contrast that the path
lacks is measured where most pixels tell. Its normal equations add over chunks; the camera's
summary and mismatch are the prior, and bounds.py has the last word.
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
KNOWN = 0.15  # share of the prior's variance that is left
FEW_TO_MOST = (0.5, 0.9)  # share of pixels: from where their gain is used, and fully
GAINS = (0.7, 1.1)  # beyond, the path shows something else
GAIN_SPREAD = 0.06  # of the gain from pixel to pixel: measured on simulated recordings of 8 s
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
    regression, whose error variance each pixel learns from its own residuals, within the bounds.
    What the path lacks of the brightness' contrast is alike in all pixels, but for GAIN_SPREAD."""
    aa, ab, bb, ay, by, yy, count = evidence.equations
    median = np.array([float(summary.theta_on), float(summary.theta_off)])
    sigma = np.maximum([float(summary.sigma_on), float(summary.sigma_off)], 0.01)
    precision, gain = sigma**-2.0, 1.0
    theta = median  # a start from the regression could explain a path that missed all motion
    for _ in range(PASSES):
        on, off = gain * theta  # on the path's scale
        residual = (yy - 2 * on * ay - 2 * off * by + on**2 * aa + off**2 * bb
                    + 2 * on * off * ab)
        variance = ((PRIOR_COUNT * PATH_ERROR**2 + np.maximum(residual, 0.0))
                    / (PRIOR_COUNT + np.maximum(count - 1.0, 0.0)))
        s = SHARED_ERROR * np.maximum(variance, LEAST_VARIANCE) / gain**2
        covariance = _inverse(aa / s + precision[0], ab / s, bb / s + precision[1])
        gain = _gain(evidence.equations, covariance, median, precision)
        right = np.stack([ay, by]) / (gain * s) + (precision * median)[:, None, None]
        theta = np.einsum("ij...,j...->i...", covariance, right)
    mean, covariance = bounded(theta, covariance, evidence.bounds)
    variance = np.stack([covariance[0, 0], covariance[1, 1]])
    learned = 1.0 - variance * precision[:, None, None]
    std = np.sqrt(variance + (GAIN_SPREAD * mean * learned) ** 2)
    return np.maximum(mean, THETA_MIN).astype(np.float32), std.astype(np.float32)


def _inverse(a: Array, b: Array, c: Array) -> Array:
    """(2, 2, H, W) the inverses of [[a, b], [b, c]]."""
    return np.stack([np.stack([c, -b]), np.stack([-b, a])]) / (a * c - b**2)


def _gain(equations: Array, covariance: Array, median: Array, precision: Array) -> float:
    """How much of the brightness' contrast the path keeps, as frames filled in by optical flow are
    blurred: what the regression of a pixel gives over the camera's median, the median over
    pixels that know their thresholds. Where those are few they have low thresholds, and do not
    tell."""
    aa, ab, bb, ay, by = equations[:5]
    u, v = np.einsum("i,ij...->j...", median * precision, covariance)
    known = np.maximum(covariance[0, 0] * precision[0], covariance[1, 1] * precision[1]) < KNOWN
    trust = float(np.interp(known.mean(), FEW_TO_MOST, (0.0, 1.0)))
    if trust == 0:
        return 1.0
    due = u * (aa * median[0] + ab * median[1]) + v * (ab * median[0] + bb * median[1])
    gain = float(np.median((u * ay + v * by)[known] / due[known]))
    return 1.0 + trust * (gain - 1.0) if GAINS[0] < gain < GAINS[1] else 1.0
