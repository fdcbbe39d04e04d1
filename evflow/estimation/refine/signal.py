"""Noise rates in moving scenes: noise separated from signal, event by event.

A small network, trained on simulated recordings, predicts the rate of signal events at any point
from its surroundings (points.py). Events are a Poisson process of rate signal + eta. eta is its
maximum a posteriori value, fitted together with a scale and an exponent of the signal's rate, by
which a scene may depart from the network's training. With random points for comparison the
likelihood is a logistic regression (Baddeley et al. 2014), without any integral.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from evflow.estimation.refine.chunk import Chunk
from evflow.estimation.refine.path import STEPS
from evflow.estimation.refine.points import Points, chunk_points

Array = np.ndarray
Params = dict[str, Any]

PIVOT = np.log(0.3)  # log Hz, near typical noise rates: scale and exponent are independent there
DEPARTURE = (0.7, 0.1)  # prior std of log scale and exponent; .5-.8 and .1-.2 on held-out scenes
# The network's error about a scene is the same everywhere in it and does not shrink with the
# recording's length. Measured on simulated recordings of .4 to 8 s:
ALIKE = 300.0  # noise events at which that error equals the counts' own
USUAL = 180.0  # noise events of the recordings that "widen" was fitted to: it includes their share
MOST_LOG = 20.0
LONGEST_STEP, CONVERGED, MOST_PASSES = 0.7, 1e-3, 50


def log_intensity(net: Params, features: Any) -> Any:
    """Log rate (N,) of signal events in Hz per pixel and polarity at features (N, F), NumPy or
    JAX arrays: layers "0", "1", ... of {"kernel", "bias"} with ReLU between."""
    x = (features - net["mean"][None]) / net["scale"][None]
    layers = [net["layers"][str(i)] for i in range(len(net["layers"]))]
    for layer in layers[:-1]:
        x = x @ layer["kernel"] + layer["bias"][None]
        x = x * (x > 0)
    return (x @ layers[-1]["kernel"])[:, 0] + layers[-1]["bias"][0]


def separated_noise_rates(
    chunks: Sequence[Chunk], theta: Array, log_eta: Array, log_std: Array, signal: Params,
    seed: int = 0,
) -> tuple[Array, Array]:
    """Log noise rates of a recording, with noise separated from signal.

    Args:
        chunks: of the recording.
        theta: (2,) thresholds.
        log_eta, log_std: (2,) prior of the log rates.
        signal: the network, and "widen" (), the calibration of the std.
        seed: of the random points.

    Returns:
        Log rates (2,) and their std.
    """
    net = jax.tree.map(np.asarray, signal)
    parts = [chunk_points(c, theta, STEPS, seed + i) for i, c in enumerate(chunks)]
    sides = map(joined, zip(*parts, strict=True))
    found = [rate_at(net, *given) for given in zip(sides, log_eta, log_std, strict=True)]
    rates, errors = np.array(found).T
    return rates, errors * float(net["widen"])


def rate_at(net: Params, points: Points, log_eta: float, log_std: float) -> tuple[float, float]:
    """Log noise rate of one polarity and its std, with the network's error, before "widen"."""
    log_signal = log_intensity(net, points.features)
    rate, error = noise_rate(log_signal, points, log_eta, log_std)
    odds = np.minimum(log_signal[points.event >= 0] - rate, MOST_LOG)  # of signal
    noise = (1.0 / (1.0 + np.exp(odds))).sum()
    return rate, error * float(np.sqrt((ALIKE + noise) / (ALIKE + USUAL)))


def joined(parts: Sequence[Points]) -> Points:
    """Points of one polarity of several chunks."""
    return Points(*(np.concatenate([getattr(p, name) for p in parts])
                    for name in ("features", "event", "density")))


def noise_rate(
    log_signal: Array, points: Points, log_eta: float, log_std: float
) -> tuple[float, float]:
    """Most probable log noise rate and its std, by Fisher scoring of (log eta, log scale,
    exponent - 1). log_signal: (N,) log rates of signal; prior: N(log_eta, log_std²)."""
    event = points.event >= 0
    mean, precision = np.array([log_eta, 0.0, 0.0]), np.array([log_std, *DEPARTURE]) ** -2.0
    away = log_signal.astype(np.float64) - PIVOT

    def objective(v: Array) -> tuple[float, Array, Array]:
        made = np.exp(np.minimum(PIVOT + v[1] + (1 + v[2]) * away, MOST_LOG))
        total = made + np.exp(v[0])
        likely = np.log(total[event]).sum() - np.log(total + points.density).sum()
        return likely - 0.5 * (precision * (v - mean) ** 2).sum(), made, total

    v = mean.copy()
    value, made, total = objective(v)
    for _ in range(MOST_PASSES):
        chance = total / (total + points.density)
        slopes = np.stack([np.exp(v[0]) / total, made / total, made * away / total])
        gradient = slopes @ (event - chance) - precision * (v - mean)
        curvature = (slopes * (chance * (1 - chance))) @ slopes.T + np.diag(precision)
        step = np.linalg.solve(curvature, gradient)
        # Scaled as a whole: clipped per component it need not lead uphill.
        step *= min(1.0, LONGEST_STEP / max(np.abs(step).max(), CONVERGED))
        while (new := objective(v + step))[0] < value - 1e-9 and np.abs(step).max() > CONVERGED:
            step = 0.5 * step
        v, (value, made, total) = v + step, new
        if np.abs(step).max() <= CONVERGED:
            break
    return float(v[0]), float(np.sqrt(np.linalg.inv(curvature)[0, 0]))
