"""Noise rates from quiet pixels, and whether they follow Eq. 12.

At a moving edge many neighbouring pixels send the same polarity at about the same time. Noise
events are isolated. A pixel without events of a polarity in its neighbourhood is an unbiased sample
of that polarity's noise, as the pixel's own events do not enter the choice. A wider neighbourhood
and a stricter limit on brightness changes leave less signal in the sample, and fewer pixels; the
STRATA range from strict to permissive.
"""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np

from evflow.camera import noise_of_threshold
from evflow.estimation.refine.chunk import Chunk

ANY = 1e9  # log units: no limit


@dataclasses.dataclass(frozen=True)
class Stratum:
    """One rule for quiet pixels.

    size: side of the neighbourhood in pixels; intervals: frame intervals that it spans;
    in_interval, in_chunk: largest range of the path (log units, over 3x3 pixels); climb: largest
    movement in the polarity's direction within the chunk (mean of 5x5 pixels, as a drift below a
    pixel's frame noise still triggers events); contamination: typical share of signal among the
    events, measured on simulated recordings."""

    size: int
    intervals: int
    in_interval: float
    in_chunk: float
    climb: float
    contamination: float


STRATA = (
    Stratum(9, 1, 0.03, 0.08, 0.02, 0.05), Stratum(9, 3, 0.03, ANY, 0.02, 0.08),
    Stratum(9, 1, 0.03, ANY, 0.02, 0.1), Stratum(5, 1, 0.03, ANY, 0.01, 0.15),
    Stratum(9, 3, ANY, ANY, 0.02, 0.25), Stratum(9, 1, ANY, ANY, 0.02, 0.4),
    Stratum(9, 1, ANY, ANY, ANY, 0.8))
LEAST_PRIOR, MOST_PRIOR = 1.0, 30.0  # weight of the network's noise rate as a prior, in events

# "Tied" noise follows Eq. 12; free rates are log-uniform over a factor of a hundred.
FREE_RANGE = np.log(100.0)
TIED_ODDS = 0.1  # prior odds; larger ones increase the error where the noise is free
TIED_ERROR = 0.05  # log units: of the intensity factor


def quiet_events(chunk: Chunk, steps: int) -> np.ndarray:
    """(strata, 2 polarities, 2): events and pixel seconds of the quiet pixels of one chunk. steps:
    fine steps per interval."""
    counts = np.asarray(chunk.recorded.counts, np.float32)
    shape = counts.shape[2:]
    inner = chunk.path[1:].reshape(len(chunk.dt_s), steps, *shape)
    start = chunk.path[:-1:steps]
    span = np.maximum(inner.max(1), start) - np.minimum(inner.min(1), start)
    span = np.stack([_widest(s) for s in span])
    overall = _widest(chunk.path.max(0) - chunk.path.min(0))
    climbs = _climbs(chunk.path[::steps])
    near = {size: _neighbours(counts, size) for size in {s.size for s in STRATA}}
    rows = []
    for stratum in STRATA:
        company = near[stratum.size]
        if stratum.intervals > 1:
            company = _over_time(company)
        still = (span < stratum.in_interval) & (overall < stratum.in_chunk) & chunk.bright
        alone = (company < 0.5) & still[:, None] & (climbs < stratum.climb)
        seconds = chunk.dt_s.astype(np.float64) @ alone.sum((2, 3))
        rows.append(np.stack([(counts * alone).sum((0, 2, 3)), seconds], -1))
    return np.stack(rows)


def _widest(span: np.ndarray) -> np.ndarray:
    return cv2.dilate(np.ascontiguousarray(span, np.float32), np.ones((3, 3), np.uint8))


def _climbs(frames: np.ndarray) -> np.ndarray:
    """(2, H, W): largest rise and largest fall of the smoothed frames (K+1, H, W)."""
    smooth = np.stack([cv2.blur(np.ascontiguousarray(f, np.float32), (5, 5)) for f in frames])
    rise = (smooth - np.minimum.accumulate(smooth)).max(0)
    fall = (np.maximum.accumulate(smooth) - smooth).max(0)
    return np.stack([rise, fall])


def _neighbours(counts: np.ndarray, size: int) -> np.ndarray:
    """Events (K, 2, H, W) in the size x size pixels around each, its own left out."""
    images = counts.reshape(-1, *counts.shape[2:])
    boxes = [cv2.boxFilter(i, -1, (size, size), normalize=False, borderType=cv2.BORDER_CONSTANT)
             for i in images]
    return np.stack(boxes).reshape(counts.shape) - counts


def _over_time(near: np.ndarray) -> np.ndarray:
    """Sums with the intervals before and after."""
    padded = np.pad(near, ((1, 1), (0, 0), (0, 0), (0, 0)))
    return padded[:-2] + padded[1:-1] + padded[2:]


def stratum_rates(quiet: np.ndarray, prior: np.ndarray, relative_std: np.ndarray) -> np.ndarray:
    """Rates (strata, 2) in Hz, each combined with the network's `prior` (2,) as with 1/std² events
    (std relative, (2,))."""
    worth = np.clip(relative_std**-2.0, LEAST_PRIOR, MOST_PRIOR)
    return (quiet[..., 0] + worth) / (quiet[..., 1] + worth / prior)


def combined_rate(quiet: np.ndarray, prior: np.ndarray, relative_std: np.ndarray) -> np.ndarray:
    """Noise rates (2,) in Hz: log mean over the strata, weighted by their event counts and typical
    contamination. Arguments as of `stratum_rates`."""
    rates = stratum_rates(quiet, prior, relative_std)
    contamination = np.array([[s.contamination] for s in STRATA])
    weight = 1.0 / (1.0 / (quiet[..., 0] + 1.0) + contamination**2)
    return np.exp((weight * np.log(rates)).sum(0) / weight.sum(0))


def rate_error(quiet: np.ndarray) -> np.ndarray:
    """Relative error (2,) of the combined rates: of the counts, and a tenth for residual signal."""
    return np.sqrt(1.0 / (quiet[:, :, 0].max(0) + 1.0) + 0.1**2)


def tied_rates(
    theta: np.ndarray, theta_std: np.ndarray, factor: float
) -> tuple[np.ndarray, np.ndarray]:
    """Noise rates (2,) in Hz by Eq. 12 at theta (2,), and their relative error. factor: intensity
    factor of Eq. 12."""
    rates = np.asarray(noise_of_threshold(theta.astype(np.float32)), np.float64) * factor
    slope = 90.0 / np.maximum(90.0 * theta - 5.0, 4.0) * (theta > 0.1)  # -dlog R/dtheta
    return rates, np.sqrt((slope * theta_std) ** 2 + TIED_ERROR**2)


def tied_probability(away: np.ndarray, error: np.ndarray) -> float:
    """Probability that the noise follows Eq. 12, against rates independent of the thresholds. away:
    (2,) log rates minus those of Eq. 12; error: (2,) of that difference."""
    log_odds = np.log(TIED_ODDS) + (
        -0.5 * (away / error) ** 2 - np.log(error * np.sqrt(2 * np.pi) / FREE_RANGE)).sum()
    return float(1.0 / (1.0 + np.exp(-np.clip(log_odds, -50.0, 50.0))))


def with_tie(
    theta: np.ndarray, theta_std: np.ndarray, log_eta: np.ndarray, log_std: np.ndarray,
    factor: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Shrink log noise rates towards Eq. 12 where they are consistent with it.

    The result is the mean and std of a mixture of "tied to the thresholds by Eq. 12" and "free",
    weighted by their posterior probability.

    Args:
        theta, theta_std: (2,) thresholds.
        log_eta, log_std: (2,) measured log rates.
        factor: intensity factor of Eq. 12.

    Returns:
        Log noise rates (2,) and their std.
    """
    rates, error = tied_rates(theta, theta_std, factor)
    predicted = np.log(rates)
    tied = tied_probability(log_eta - predicted, np.hypot(error, log_std))
    precision = error**-2.0 + log_std**-2.0
    both = (predicted * error**-2.0 + log_eta * log_std**-2.0) / precision
    variance = (tied / precision + (1 - tied) * log_std**2
                + tied * (1 - tied) * (both - log_eta) ** 2)
    return tied * both + (1 - tied) * log_eta, np.sqrt(variance)
