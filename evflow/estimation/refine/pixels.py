"""Each pixel's thresholds, from the path at its events and from changes without events.

At an event the memory equals the brightness, so at the events i of a pixel the path is
theta_on a_i - theta_off b_i plus a constant, with a and b counting its events. This is a linear
regression without quantisation noise; its only error is the path's. The gain (contrast that the
interpolated path keeps) is measured from the pixels whose events determine it. The normal equations
add over chunks. The camera's summary and mismatch are the prior; bounds.py adds bounds from changes
without events, start.py the memory at the beginning.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from evflow.camera import THETA_MIN, Summary
from evflow.estimation.refine.bounds import NOTHING, bounded, unanswered
from evflow.estimation.refine.sightings import (
    PATH_ERROR,
    Sightings,
    counts_so_far,
    path_weights,
    sight,
)
from evflow.estimation.refine.start import (
    Belief,
    fresh_probability,
    since_start,
    with_fresh_start,
    with_running_start,
)
from evflow.types import Events

Array = np.ndarray

PRIOR_COUNT = 5.0  # weight of PATH_ERROR as a prior of the error variance, in events
SHARED_ERROR = 2.2  # variance factor, as errors of consecutive events are correlated
LEAST_VARIANCE = 0.022**2  # log units squared: a path that misses all motion leaves no residuals
PASSES = 3
KNOWN = 0.15  # share of the prior's variance left, below which a pixel is used for the gain
FEW_TO_MOST = (0.3, 0.8)  # shares of such pixels at which their gain is not used, and fully used
MOST_QUANTILE = 0.725  # of the known pixels' ratios
GAIN = 0.95  # where it is not measured; of 37 simulated recordings of .3 and 2 s, .92 (median)
GAINS = (0.5, 1.1)  # a gain outside of these is not one of contrast, and is ignored
# Share of the prior's variance left, of pixels that tell something; their least share; and the
# ratio of all together where the gain is GAIN: of four recordings .75 to .8.
LEARNED, LEAST_LEARNED, POOLED = 0.6, 0.1, 0.75
GAIN_SPREAD = 0.06  # of the gain from pixel to pixel: measured on simulated recordings of 8 s
LEAST_SIGMA = 0.01  # log units
START_ERROR = 0.05  # log units, of the path from the first frame to another


@dataclasses.dataclass(frozen=True, eq=False)
class PixelEvidence:
    """Per-pixel statistics; those of several chunks add.

    equations: (7, H, W) sums of weighted aa, ab, bb, ay, by, yy about their means, and the number
    of events; bounds: (3, H, W), see `unanswered`; start: (6, H, W), see `since_start`."""

    equations: Array
    bounds: Array
    start: Array

    @staticmethod
    def nothing(shape: tuple[int, int]) -> PixelEvidence:
        return PixelEvidence(
            np.zeros((7, *shape)), np.full((3, *shape), NOTHING), _no_start(shape))

    def __add__(self, other: PixelEvidence) -> PixelEvidence:
        return PixelEvidence(
            self.equations + other.equations, np.maximum(self.bounds, other.bounds),
            np.concatenate([self.start[:4] + other.start[:4],
                            np.maximum(self.start[4:], other.start[4:])]))

    def without(self, pixels: Array) -> PixelEvidence:
        """The same, but nothing about pixels (H, W) bool."""
        if not pixels.any():
            return self  # a copy takes 100 MB of a large sensor
        none = PixelEvidence.nothing(pixels.shape)
        return PixelEvidence(*(np.where(pixels, b, a) for a, b in (
            (self.equations, none.equations), (self.bounds, none.bounds),
            (self.start, none.start))))


def _no_start(shape: tuple[int, int]) -> Array:
    """`since_start` of no events, a read-only view."""
    values = np.array([0.0, 0.0, 0.0, 0.0, NOTHING, NOTHING])
    return np.broadcast_to(values[:, None, None], (6, *shape))


def pixel_evidence(
    events: Events, times_us: Array, path: Array, steps: int, seen: Array | None = None, *,
    first: bool = False,
) -> PixelEvidence:
    """Evidence of a chunk's events about each pixel.

    Args:
        events: of the recording.
        times_us: (K + 1,) of the frames.
        path: (K*steps + 1, H, W) log brightness.
        steps: fine steps per interval.
        seen: (K + 1, H, W) bool, frames that are neither saturated nor black; events beside
            others are not used.
        first: whether the recording begins with these frames.
    """
    return evidence_of(sight(events, times_us, path, steps, seen), first=first)


def evidence_of(s: Sightings, *, first: bool = False) -> PixelEvidence:
    """`pixel_evidence` of sightings."""
    weight = path_weights(s)
    return PixelEvidence(_equations(s, weight), unanswered(s),
                         since_start(s, weight) if first else _no_start(s.shape))


def _equations(s: Sightings, weight: Array) -> Array:
    out = np.zeros((7, s.frames.shape[1]))
    if len(s.pixel) == 0:
        return out.reshape(7, *s.shape)
    group, a, b = counts_so_far(s)

    def total(v: Array) -> Array:
        return np.bincount(group, v)

    def centred(v: Array) -> Array:
        return v - (total(weight * v) / total(weight))[group]

    a, b, y = (centred(v) for v in (a, b, s.path))
    sums = [total(weight * u * v) for u, v in ((a, a), (a, b), (b, b), (a, y), (b, y), (y, y))]
    out[:, s.pixel[s.first]] = [*sums, total(s.shown.astype(np.float64))]
    return out.reshape(7, *s.shape)


def pixel_posterior(evidence: PixelEvidence, summary: Summary) -> tuple[Array, Array]:
    """Posterior of each pixel's thresholds.

    The prior is N(median, sigma²) of the camera. The regression's error variance is estimated per
    pixel from its residuals; bounds from changes without events truncate the result. It is a
    mixture over the two cases of the memory at the start (start.py). The path's gain is common to
    all pixels, up to GAIN_SPREAD.

    Args:
        evidence: summed over chunks.
        summary: of the camera.

    Returns:
        theta (2, H, W), ON and OFF, and its std, float32.
    """
    median = np.array([float(summary.theta_on), float(summary.theta_off)])
    sigma = np.maximum([float(summary.sigma_on), float(summary.sigma_off)], LEAST_SIGMA)
    precision, unanswered = sigma**-2.0, evidence.bounds[:2]
    running = _regression(evidence.equations, median, precision)
    belief = bounded(running.theta, running.covariance, unanswered)
    belief = with_running_start(*belief, evidence.bounds[2], evidence.equations[6] > 0)
    mean, variance = _with_gain_error(*belief, precision)
    error, chance = fresh_probability(evidence.start, running, median)
    if chance.any():
        known = _regression(
            with_fresh_start(evidence.equations, evidence.start, error), median, precision)
        belief = bounded(known.theta, known.covariance, unanswered)
        belief = bounded(*belief, evidence.start[4:], float(np.hypot(START_ERROR, error)))
        mean, variance = _either(chance, _with_gain_error(*belief, precision), (mean, variance))
    return np.maximum(mean, THETA_MIN).astype(np.float32), np.sqrt(variance).astype(np.float32)


def _either(
    chance: Array, one: tuple[Array, Array], other: tuple[Array, Array]
) -> tuple[Array, Array]:
    """Mean and variance of a mixture: `one` with probability `chance` (H, W), else `other`."""
    mean = chance * one[0] + (1 - chance) * other[0]
    variance = [v + (m - mean) ** 2 for m, v in (one, other)]
    return mean, chance * variance[0] + (1 - chance) * variance[1]


def _with_gain_error(mean: Array, covariance: Array, precision: Array) -> tuple[Array, Array]:
    """Mean and variance (2, H, W), including the spread of the gain from pixel to pixel."""
    variance = np.stack([covariance[0, 0], covariance[1, 1]])
    learned = 1.0 - variance * precision[:, None, None]
    return mean, variance + (GAIN_SPREAD * mean * learned) ** 2


def _regression(equations: Array, median: Array, precision: Array) -> Belief:
    """The belief from prior N(median, 1 / precision) and events, without bounds."""
    aa, ab, bb, ay, by, yy, count = equations
    gain, theta = 1.0, median  # a start at the regression's theta would fit a path without motion
    for _ in range(PASSES):
        on, off = gain * theta  # on the path's scale
        residual = (yy - 2 * on * ay - 2 * off * by + on**2 * aa + off**2 * bb
                    + 2 * on * off * ab)
        variance = ((PRIOR_COUNT * PATH_ERROR**2 + np.maximum(residual, 0.0))
                    / (PRIOR_COUNT + np.maximum(count - 1.0, 0.0)))
        s = SHARED_ERROR * np.maximum(variance, LEAST_VARIANCE) / gain**2
        covariance = _inverse(aa / s + precision[0], ab / s, bb / s + precision[1])
        gain = _gain(equations, covariance, median, precision)
        right = np.stack([ay, by]) / (gain * s) + (precision * median)[:, None, None]
        theta = np.einsum("ij...,j...->i...", covariance, right)
    return Belief(theta, covariance, s)


def _pooled_gain(seen: Array, due: Array, left: Array) -> float:
    """The gain where no pixel's events determine its thresholds: GAIN, but less where all of them
    together see much less contrast than is due, as frames are too far apart for the motion. left:
    share of the prior's variance."""
    used = left < LEARNED
    if used.mean() < LEAST_LEARNED:
        return GAIN
    return GAIN * min(1.0, max(float(seen[used].sum() / due[used].sum()), GAINS[0] / 2) / POOLED)


def _inverse(a: Array, b: Array, c: Array) -> Array:
    """(2, 2, H, W) the inverses of [[a, b], [b, c]]."""
    return np.stack([np.stack([c, -b]), np.stack([-b, a])]) / (a * c - b**2)


def _gain(equations: Array, covariance: Array, median: Array, precision: Array) -> float:
    """Share of the contrast that the path keeps, as interpolated frames are blurred: a pixel's
    regression relative to the camera's median, where the median pixel is, of those whose events
    determine their thresholds. The others either have higher thresholds, or saw too little."""
    aa, ab, bb, ay, by = equations[:5]
    u, v = np.einsum("i,ij...->j...", median * precision, covariance)
    left = np.maximum(covariance[0, 0] * precision[0], covariance[1, 1] * precision[1])
    known = left < KNOWN
    share = float(known.mean())
    trust = float(np.interp(share, FEW_TO_MOST, (0.0, 1.0)))
    due = u * (aa * median[0] + ab * median[1]) + v * (ab * median[0] + bb * median[1])
    if trust == 0:
        return _pooled_gain(u * ay + v * by, due, left)
    # Midway between the two cases: at 0.5 / share of the known ones, or at 0.5.
    middle = min(0.25 + 0.25 / share, MOST_QUANTILE)
    gain = float(np.quantile((u * ay + v * by)[known] / due[known], middle))
    return GAIN + trust * (gain - GAIN) if GAINS[0] < gain < GAINS[1] else GAIN
