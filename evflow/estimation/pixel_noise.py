"""Each pixel's noise rate, beside the camera's: what the pixel sends while nothing happens near it.

Over pixels the rates are gamma-distributed around the camera's, counts are Poisson: given the
spread, the posterior of a pixel's rate is a gamma distribution again. The spread itself is what
makes the counts of all pixels likely (a negative binomial), so that pixels differ by as much as
the recording shows them to, and a short one leaves all of them at the camera's rate. Where it
makes the counts likelier, rates go as one over the pixel's threshold, as v2e's shot noise does.
"""

from __future__ import annotations

import cv2
import numpy as np

Array = np.ndarray

SPREADS = np.geomspace(0.02, 2.0, 41)  # standard deviations of the rate over its mean
SPREAD, SPREAD_ERROR = 0.05, 0.6  # expected before any data, and the std of its log
NEGLIGIBLE = 1e-4  # probability of a spread that is left out
LEAST_THETA = 0.01  # log units: thresholds are clamped there
LAW_ODDS = 5.0  # log odds that it takes to let rates follow the thresholds
LAW_EVENTS = 100  # and events: a pixel's few also lower the threshold that is found for it
SIGNAL = 0.5  # of the events of quiet pixels may be what is left of the signal
PLAIN_THETA, PLAIN_ODDS = 0.1, 1.0  # log units: twice STILL; log odds among pixels above it alone

AROUND = 9  # pixels: side of the neighbourhood in which events are company
CHANCE = 4.0  # standard deviations of the noise around a pixel, that it may have
STILL = 0.05  # log units: of 3x3 pixels from frame to frame; less than any threshold of use
DRIFT = 0.1  # log units per second, of 5x5 pixels: slower than a frame's noise, yet it sends events


def threshold_law(quiet: Array, theta: Array, hot: Array) -> Array:
    """Rates (2, H, W), ON and OFF, relative to the camera's: 1, or as one over the thresholds
    theta (2, H, W) where quiet (2, 2, H, W) of `quiet_time` makes that the likelier. Signal that
    is left near what moves follows the thresholds too: noise that does not, and a share of SIGNAL,
    must be the less likely as well, by LAW_EVENTS or more; and pixels of thresholds that no still
    place reaches must say so too."""
    watched = quiet[:, 1] * ~hot
    if (quiet[:, 0] * ~hot).sum() < LAW_EVENTS:
        return np.ones(theta.shape)
    law = 1.0 / np.maximum(np.asarray(theta, np.float64), LEAST_THETA)
    law *= (watched.sum((1, 2)) / np.maximum((watched * law).sum((1, 2)), 1e-30))[:, None, None]

    def log_p(share: float, left_out: Array) -> float:
        return sum(_likelihood(n, w * (1.0 + share * (r - 1.0)), out) for n, w, r, out in zip(
            quiet[:, 0], quiet[:, 1], law, left_out, strict=True))

    every, low = np.stack([hot] * 2), hot | (np.asarray(theta) < PLAIN_THETA)
    odds = log_p(1.0, every) - max(log_p(0.0, every), log_p(SIGNAL, every))
    follows = odds > LAW_ODDS and log_p(1.0, low) - log_p(0.0, low) > PLAIN_ODDS
    return law if follows else np.ones_like(law)


def _likelihood(events: Array, expected: Array, hot: Array) -> float:
    """Log of the probability of events (H, W) that are expected in this proportion."""
    used = ~hot & (expected > 0)
    n, expected = events[used].astype(np.float64), expected[used].astype(np.float64)
    if not n.sum():
        return 0.0
    expected *= n.sum() / expected.sum()
    log_p = _log_shapes(n, expected)
    return float(np.logaddexp.reduce(log_p) + (n * np.log(expected)).sum())


def pixel_rates(
    events: Array, seconds: Array, rate_hz: float, hot: Array, relative: Array | float = 1.0
) -> tuple[Array, Array]:
    """Noise rates (H, W) in Hz and their std, around the camera's, which is rate_hz.

    events (H, W): sent in the seconds (H, W) for which the pixel was watched, 0 for never. Pixels
    are compared with each other, so that what few events are not noise cancel. hot (H, W) bool:
    pixels unlike the others, whose rates follow from their own events alone. relative (H, W):
    rates expected before, of `threshold_law`.
    """
    n, seconds = events.astype(np.float64), np.asarray(seconds, np.float64)
    law, seconds = np.broadcast_to(relative, n.shape), seconds * relative
    sent, watched = float(n[~hot].sum()), float(seconds[~hot].sum())
    expected = seconds * (sent / watched if watched > 0 else 0.0)
    mean, square = np.zeros(n.shape), np.zeros(n.shape)
    for shape, weight in zip(*_shapes(n[~hot], expected[~hot]), strict=True):
        relative = (n + shape) / (expected + shape)
        mean += weight * relative
        square += weight * relative * (relative + 1.0 / (expected + shape))
    rate, std = rate_hz * law * mean, rate_hz * law * np.sqrt(square - mean**2)
    own = hot & (n > 0)
    alone = seconds[own] / law[own]
    rate[own], std[own] = n[own] / alone, np.sqrt(n[own] + 1.0) / alone
    return rate, std


def _shapes(n: Array, expected: Array) -> tuple[Array, Array]:
    """Shapes of the gamma distribution, and how probable the counts (N,) make each."""
    shapes, log_p = SPREADS**-2.0, _log_shapes(n, expected)
    weights = np.exp(log_p - log_p.max())
    weights /= weights.sum()
    used = weights > NEGLIGIBLE
    return shapes[used], weights[used] / weights[used].sum()


def _log_shapes(n: Array, expected: Array) -> Array:
    """Log probability of the counts (N,) and of each spread, but for what all share."""
    shapes = SPREADS**-2.0
    above = np.bincount(n.astype(np.int64), minlength=1)[::-1].cumsum()[::-1][1:]
    k = np.arange(len(above))  # `above`: how many pixels sent more than k
    log_p = np.array([(above * np.log(a + k)).sum()
                      - (a * np.log1p(expected / a) + n * np.log(a + expected)).sum()
                      for a in shapes])
    return log_p - 0.5 * (np.log(SPREADS / SPREAD) / SPREAD_ERROR) ** 2


def quiet_time(
    counts: Array, dlog: Array, seen: Array, hot: Array, seconds: float, rates: Array
) -> Array:
    """(2, 2, H, W) float32, ON and OFF: events of pixels around which nothing happens in a window
    between two frames, and the seconds for which they were watched.

    counts (2, H, W): ON and OFF events; dlog (H, W): change of log intensity; seen (H, W) bool:
    where the frames show what the pixel saw; rates (2,): the camera's noise in Hz, whose events
    are no company, nor are those of hot (H, W) pixels. A pixel's own events do not enter the
    choice, so that what it sends is a fair sample.
    """
    still = _still(dlog, seen, seconds)
    found = []
    for own, rate in zip(counts, rates, strict=True):
        near = _company(own, hot)
        alone = still & (near < max(0.5, rate * seconds * AROUND**2))
        found.append([own * alone, seconds * alone])
    return np.array(found, np.float32)


def calm(
    counts: Array, dlog: Array, seen: Array, hot: Array, seconds: float, rates: Array
) -> Array:
    """(H, W) bool: pixels around which no more happens in a window than noise may send. Arguments
    as of `quiet_time`, which takes those with less than usual: of many windows in a row none is."""
    expected = float(np.sum(rates)) * seconds * AROUND**2
    near = _company(counts.sum(0), hot)
    return _still(dlog, seen, seconds) & ~hot & (near < expected + CHANCE * np.sqrt(expected) + 1.5)


def _still(dlog: Array, seen: Array, seconds: float) -> Array:
    """(H, W) bool: where the frames show no change."""
    change = np.ascontiguousarray(np.abs(dlog), np.float32)
    still = seen & (cv2.dilate(change, np.ones((3, 3), np.uint8)) < STILL)
    drift = np.abs(cv2.blur(np.ascontiguousarray(dlog, np.float32), (5, 5)))
    return np.asarray(still & (drift < DRIFT * seconds))


def _company(own: Array, hot: Array) -> Array:
    """Events (H, W) around each pixel, its own and those of hot ones left out."""
    others = np.where(hot, 0, own).astype(np.float32)
    return cv2.boxFilter(others, -1, (AROUND, AROUND), normalize=False,
                         borderType=cv2.BORDER_CONSTANT) - others
