"""Each pixel's noise rate relative to the camera's: what the pixel sends while nothing happens near
it.

Rates are gamma-distributed around the camera's over pixels, and counts are Poisson: given the
spread, the posterior of a pixel's rate is again a gamma distribution. The spread itself is inferred
from the counts of all pixels (a negative binomial), so pixels differ by as much as the recording
supports, and a short one leaves all of them at the camera's rate. If it makes the counts likelier,
rates are taken as inversely proportional to the pixel's threshold, as for v2e's shot noise.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy import special

Array = np.ndarray

SPREADS = np.geomspace(0.02, 2.0, 41)  # standard deviations of the rate, relative to its mean
SPREAD, SPREAD_ERROR = 0.1, 0.8  # prior median of the spread, and std of its log
NEGLIGIBLE = 1e-4  # probability below which a spread is left out, and spread that is none
# Pixels that are noisier than the others without being hot: their share, and the shape and mean of
# their rates relative to the camera's.
ODD, ODD_SHAPE, ODD_MEAN = 1e-3, 0.5, 5.0
PASSES = 3
LEAST_THETA = 0.01  # log units: thresholds are clamped there
LAW_ODDS = 5.0  # log odds required to let rates follow the thresholds
LAW_EVENTS = 100  # and events: few events of a pixel also lower its estimated threshold
SIGNAL = 0.5  # maximum share of residual signal among the events of quiet pixels
SHARES = np.linspace(SIGNAL, 1.0, 6)  # of the noise, that follows the thresholds if any does
# Where rates follow the thresholds, few pixels send most of the noise, and near them nothing is
# quiet: log error of the camera's rate there, times log(mean / median of the rates) to the power of
# 1.5, and log error of counts by residual signal. Measured on 30 cameras of mismatch .15, and on
# four of .08 whose rates seem to follow but do not.
UNEVEN_ERROR, COUNTS_ERROR = 0.3, 0.15
PLAIN_THETA, PLAIN_ODDS = 0.1, 1.0  # log units: twice STILL; log odds among pixels above it only

HOT_SHARE, CLEARLY = 1e-3, 2.0  # of pixels, that are hot a priori; std that more events are
BESIDE = 5  # pixels: side of the neighbourhood that sees what a hot pixel does
AROUND = 9  # pixels: side of the neighbourhood in which other events are counted
CHANCE = 4.0  # standard deviations of noise allowed around a pixel
STILL = 0.05  # log units: 3x3 pixels from frame to frame; less than any useful threshold
DRIFT = 0.1  # log units per second, 5x5 pixels: below the frames' noise, but enough for events


def threshold_law(quiet: Array, theta: Array, hot: Array) -> Array | None:
    """Rates (2, H, W), ON and OFF, relative to the camera's, of which the most probable share is
    inversely proportional to the thresholds theta (2, H, W), if quiet (2, 2, H, W) from
    `quiet_time` makes that likelier than equal rates, else None. Residual signal near moving
    objects follows the thresholds too: so noise that does not, mixed with a share SIGNAL of it,
    must also be less likely, with at least LAW_EVENTS events; and pixels whose threshold exceeds
    what calm places reach must agree."""
    watched = quiet[:, 1] * ~hot
    if (quiet[:, 0] * ~hot).sum() < LAW_EVENTS:
        return None
    law = 1.0 / np.maximum(np.asarray(theta, np.float64), LEAST_THETA)
    law *= (watched.sum((1, 2)) / np.maximum((watched * law).sum((1, 2)), 1e-30))[:, None, None]

    def log_p(share: float, left_out: Array) -> float:
        return sum(_likelihood(n, w * (1.0 + share * (r - 1.0)), out) for n, w, r, out in zip(
            quiet[:, 0], quiet[:, 1], law, left_out, strict=True))

    every, low = np.stack([hot] * 2), hot | (np.asarray(theta) < PLAIN_THETA)
    with_shares = np.array([log_p(share, every) for share in SHARES])
    odds = with_shares[-1] - max(log_p(0.0, every), with_shares[0])
    if odds <= LAW_ODDS or log_p(1.0, low) - log_p(0.0, low) <= PLAIN_ODDS:
        return None
    share = np.average(SHARES, weights=np.exp(with_shares - with_shares.max()))
    return np.asarray(1.0 + share * (law - 1.0))


def uneven_rate(
    events: Array, seconds: Array, rate_hz: float, error: float, hot: Array, law: Array
) -> tuple[float, float]:
    """The mean rate in Hz of pixels with rates in proportion to law (H, W), and its relative error:
    the camera's, known up to `error`, combined with the events (H, W) sent in the seconds (H, W) of
    quiet."""
    sent, watched = float((events * ~hot).sum()) + 1.0, float((seconds * ~hot).sum())
    counted = sent / (watched + 1.0 / rate_hz)
    uneven = float(np.log(max(law.mean() / np.median(law), 1.0)))
    errors = np.array([np.hypot(0.01, UNEVEN_ERROR * uneven**1.5),
                       np.hypot(sent**-0.5, COUNTS_ERROR)])
    mean = np.average(np.log([rate_hz, counted]), weights=errors**-2.0)
    return float(np.exp(mean)), float(np.hypot(error, np.sum(errors**-2.0) ** -0.5))


def _likelihood(events: Array, expected: Array, hot: Array) -> float:
    """Log probability of events (H, W), given expected ones up to a common factor."""
    used = ~hot & (expected > 0)
    n, expected = events[used].astype(np.float64), expected[used].astype(np.float64)
    if not n.sum():
        return 0.0
    expected *= n.sum() / expected.sum()
    log_p = _log_shapes(n, expected)
    return float(np.logaddexp.reduce(log_p) + (n * np.log(expected)).sum())


def pixel_rates(
    events: Array, seconds: Array, rate_hz: float, hot: Array, relative: Array | float = 1.0,
    *, error: float, odd: float = 0.0,
) -> tuple[Array, Array]:
    """Noise rates (H, W) in Hz and their std, around the camera's, which is rate_hz, with this
    relative error.

    events (H, W): sent in the seconds (H, W) for which the pixel was observed, 0 for never. Pixels
    are compared with each other, so residual signal, common to all pixels, cancels. hot (H, W)
    bool: pixels unlike the others, whose rates follow from their own events alone. relative (H, W):
    rates expected a priori, from `threshold_law`. odd: share of pixels that may have any rate
    without being hot, of which a scene at rest tells; what is likelier to be one has its own.
    """
    n, seconds = events.astype(np.float64), np.asarray(seconds, np.float64)
    law, alone = np.broadcast_to(relative, n.shape), seconds
    seconds, apart = seconds * relative, np.zeros(n.shape, bool)
    for _ in range(PASSES):  # odd pixels widen the spread that they are compared with
        of_usual = _mean_rate(n, seconds, ~(hot | apart))
        expected = seconds * of_usual
        shapes, weights = _shapes(n[~(hot | apart)], expected[~(hot | apart)])
        found = _unlike(n, expected, shapes, weights, odd) if odd else apart
        if (found == apart).all():
            break
        apart = found
    mean, square = np.zeros(n.shape), np.zeros(n.shape)
    for shape, weight in zip(shapes, weights, strict=True):
        relative = (n + shape) / (expected + shape)
        mean += weight * relative
        square += weight * relative * (relative + 1.0 / (expected + shape))
    scale = rate_hz * law
    if apart.any():
        scale = scale * of_usual / _mean_rate(n, seconds, ~hot)
    rate, std = scale * mean, scale * np.sqrt(square - mean**2 + (error * mean) ** 2)
    free = alone[apart] + ODD_SHAPE / (ODD_MEAN * scale[apart])
    rate[apart] = (n[apart] + ODD_SHAPE) / free
    std[apart] = np.sqrt(n[apart] + ODD_SHAPE) / free
    own = hot & (n > 0)
    rate[own], std[own] = n[own] / alone[own], np.sqrt(n[own] + 1.0) / alone[own]
    return rate, std


def hot_rates(
    quiet: Array, sent: Array, seconds: float, hot: Array, mismatch: Array, *, alone: bool = False
) -> tuple[Array, Array]:
    """Noise rates (2, N) in Hz of the hot (H, W) pixels, and their std; NaN where they are unknown.

    What they send while nothing happens near them, quiet (2, 2, H, W) of `quiet_time`, and, as
    where the whole scene moves nothing ever rests, what they send in the rest of the `seconds`
    beyond the median of their neighbours, whose spread is in its error; both weighted by their
    precision. The former alone where a low threshold explains the latter, which it does if hot ones
    are rarer than pixels whose threshold is as much lower, of this relative mismatch (2,). sent
    (2, H, W): ON and OFF events. alone: the former alone where there is any, as its rates are at
    another light than the latter."""
    rates, stds = [], []
    for (events, watched), own, uneven in zip(
            quiet, sent.astype(np.float32), mismatch, strict=True):
        usual = cv2.medianBlur(np.where(hot, 0.0, own).astype(np.float32), BESIDE)
        spread = cv2.medianBlur(np.abs(own - usual), BESIDE)[hot]
        n, rested = events[hot].astype(np.float64), watched[hot].astype(np.float64)
        busy = np.maximum(seconds - rested, 1e-9)
        left = np.maximum(own[hot] - n, 0.0)
        beyond = np.maximum(left - usual[hot], 0.0) / busy
        error = np.sqrt(left + 1.0 + (1.5 * spread) ** 2) / busy
        weight = np.stack([rested**2 / (n + 1.0), error**-2.0])
        lower = usual[hot] / np.maximum(own[hot], 1.0) - 1.0  # threshold that sends as much
        as_likely = special.ndtr(np.minimum(lower, 0.0) / max(uneven, NEGLIGIBLE)) > HOT_SHARE
        weight[1, as_likely & (beyond > CLEARLY * error)] = 0.0
        if alone:
            weight[1, rested > 0] = 0.0
        total = np.where(weight.any(0), weight.sum(0), np.nan)
        rates.append((weight * [n / np.maximum(rested, 1e-9), beyond]).sum(0) / total)
        stds.append(total**-0.5)
    return np.stack(rates), np.stack(stds)


def _mean_rate(n: Array, seconds: Array, used: Array) -> float:
    watched = float(seconds[used].sum())
    return float(n[used].sum()) / watched if watched > 0 else 0.0


def _shapes(n: Array, expected: Array) -> tuple[Array, Array]:
    """Shapes of the gamma distribution, and their probabilities given the counts (N,)."""
    shapes, log_p = SPREADS**-2.0, _log_shapes(n, expected)
    weights = np.exp(log_p - log_p.max())
    weights /= weights.sum()
    used = weights > NEGLIGIBLE
    return shapes[used], weights[used] / weights[used].sum()


def _unlike(n: Array, expected: Array, shapes: Array, weights: Array, odd: float) -> Array:
    """(H, W) bool: pixels that rather are among the share `odd`, with rates of ODD_SHAPE around
    ODD_MEAN times the camera's, than among the others."""
    usual = np.logaddexp.reduce([np.log(weight) + _log_chance(n, expected, shape)
                                 for shape, weight in zip(shapes, weights, strict=True)])
    return np.asarray(np.log(odd) + _log_chance(n, ODD_MEAN * expected, ODD_SHAPE) > usual)


def _log_chance(n: Array, expected: Array, shape: float) -> Array:
    """Log probability of counts n, up to their factorial, where rates are gamma-distributed."""
    return np.asarray(special.gammaln(n + shape) - special.gammaln(shape)
                      - shape * np.log1p(expected / shape)
                      + special.xlogy(n, expected / (shape + expected)))


def _log_shapes(n: Array, expected: Array) -> Array:
    """Log probability of the counts (N,) for each spread, up to a constant."""
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
    between two frames, and the seconds for which they were observed.

    counts (2, H, W): ON and OFF events; dlog (H, W): change of log intensity; seen (H, W) bool:
    where the frames show what the pixel saw; rates (2,): the camera's noise in Hz, which does not
    count as activity, nor do events of hot (H, W) pixels. A pixel's own events do not affect
    whether it is selected, so that its noise is sampled without bias.
    """
    still = _still(dlog, seen, seconds)
    found = []
    for own, rate in zip(counts, rates, strict=True):
        near = _near(own, hot)
        alone = still & (near < max(0.5, rate * seconds * AROUND**2))
        found.append([own * alone, seconds * alone])
    return np.array(found, np.float32)


def calm(
    counts: Array, dlog: Array, seen: Array, hot: Array, seconds: float, rates: Array
) -> Array:
    """(H, W) bool: pixels around which no more happens in a window than noise explains. Arguments
    as for `quiet_time`, whose criterion (fewer events than the mean) is too strict for pixels that
    must be calm in many successive windows."""
    expected = float(np.sum(rates)) * seconds * AROUND**2
    near = _near(counts.sum(0), hot)
    return _still(dlog, seen, seconds) & ~hot & (near < expected + CHANCE * np.sqrt(expected) + 1.5)


def _still(dlog: Array, seen: Array, seconds: float) -> Array:
    """(H, W) bool: where the frames do not change."""
    change = np.ascontiguousarray(np.abs(dlog), np.float32)
    still = seen & (cv2.dilate(change, np.ones((3, 3), np.uint8)) < STILL)
    drift = np.abs(cv2.blur(np.ascontiguousarray(dlog, np.float32), (5, 5)))
    return np.asarray(still & (drift < DRIFT * seconds))


def _near(own: Array, hot: Array) -> Array:
    """Events (H, W) around each pixel, without its own and those of hot ones."""
    others = np.where(hot, 0, own).astype(np.float32)
    return cv2.boxFilter(others, -1, (AROUND, AROUND), normalize=False,
                         borderType=cv2.BORDER_CONSTANT) - others
