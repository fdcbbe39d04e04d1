"""How probable a photoreceptor's constants phi = (offset, tau, delay) are, and the most probable.

With L the log of the share of variance that the regression leaves unexplained, the likelihood is
exp(-size L / 2) (`effective_size`); the prior is that of receptor_prior.py.
"""

from __future__ import annotations

import numpy as np

from evflow.estimation.refine.receptor_regression import SCALE, Regression
from evflow.simulator.photoreceptor import FAST, Photoreceptor

OFFSETS = (-16.0, -8.0, 0.0, 6.0, 14.0, 26.0, 45.0)  # DN, starting grid of the search
TAUS = (FAST, 5e-4, 1e-3, 2e-3, 5e-3, 1e-2)  # s
STEP = np.array([12.0, 3e-3, 1e-3])  # largest change in one step
LOW, HIGH = np.array([-25.0, FAST, -4e-3]), np.array([90.0, 3e-2, 4e-3])
PATTERN = (4.0, 1.0, 0.25)  # multiples of SCALE tried, one coordinate at a time
MOST_STEPS, CONVERGED = 12, 0.02  # of log-likelihood
MOST_SIZE = 400.0  # cap of a recording's effective number of events, as path errors are shared
ALL, OFFSET = np.full(3, True), np.arange(3) == 0
PLAIN = np.array([0.0, FAST, 0.0])  # an ideal pixel, frames that show light
# The path has systematic errors. A gain of less than a few per cent of the unexplained variance is
# no evidence about the pixel, which limits the odds and adds a floor to the errors:
BELIEVED = 400.0  # cap of the effective number of events in the odds against an ideal pixel
# Share of the variance: where the path explains less, its errors are so large that the cap falls
# with the share. Of 60 ideal cameras before fast scenes, three had false offsets of 15 to 23 DN:
CLEAR = 0.6
BY_OFFSET = 5.0  # log odds required for an offset in the frames of a slow pixel


def receptor(phi: np.ndarray, model: Regression) -> Photoreceptor:
    """The photoreceptor of these constants."""
    return Photoreceptor(float(phi[0]), float(phi[1]) if phi[1] > 2 * FAST else 0.0, float(phi[2]),
                         model.by_light, model.log_map)


def minus_log(phi: np.ndarray, model: Regression, size: float) -> float:
    """Minus the log of the posterior of phi."""
    return 0.5 * size * model.unexplained(phi) + model.prior.minus_log(phi)


def newton(phi: np.ndarray, model: Regression, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Gradient and Gauss-Newton curvature of `minus_log`."""
    slopes, prior = model.slopes(phi), model.prior
    return (0.5 * size * slopes.gradient + (phi - prior.centre) / prior.std**2,
            0.5 * size * slopes.bent + np.diag(prior.std**-2.0))


def worth(phi: np.ndarray, model: Regression, size: float) -> float:
    """The effective number of events, `size` at most, whose gain is evidence about the pixel."""
    explained = 1.0 - float(np.exp(model.unexplained(phi)))
    return min(size, BELIEVED * min(1.0, explained / CLEAR))


def effective_size(phi: np.ndarray, model: Regression) -> float:
    """Effective number of independent events. With L the log unexplained share, the likelihood is
    exp(-size L / 2); size is such that its gradient's scatter over blocks equals its curvature."""
    slopes = model.slopes(phi)
    scatter = ((slopes.by_block - slopes.by_block.mean(0)) ** 2).sum(0)
    size = 2.0 * np.median(np.diag(model.curvature(phi)) / np.maximum(scatter, 1e-30))
    return float(np.clip(size, 10.0, MOST_SIZE))


def start(model: Regression) -> np.ndarray:
    """The best point of a coarse grid, coordinate by coordinate."""
    phi = PLAIN.copy()
    for k, values in ((1, TAUS), (0, OFFSETS), (1, TAUS), (0, OFFSETS)):
        tried = [np.where(np.arange(3) == k, v, phi) for v in values]
        phi = min(tried, key=model.unexplained)
    return phi


def descend(
    phi: np.ndarray, model: Regression, size: float, free: np.ndarray = ALL
) -> np.ndarray:
    """Minimise `minus_log` over the free constants by damped Newton steps, and by steps of single
    constants where none of these descends (the lin-log's knee at 20 DN bends the likelihood)."""
    phi = np.clip(phi, LOW, HIGH)
    best = minus_log(phi, model, size)
    for _ in range(MOST_STEPS):
        gradient, bent = newton(phi, model, size)
        bent = np.where(np.outer(free, free), bent, np.diag(model.prior.std**-2.0))
        steps = [-np.linalg.solve(bent + np.diag(np.diag(bent)) * damping, gradient * free)
                 for damping in (0.02, 0.5, 5.0)]
        steps += [sign * much * SCALE * (np.arange(3) == k)
                  for much in PATTERN for k in np.flatnonzero(free) for sign in (1, -1)]
        before = best
        for step in steps:
            new = np.clip(phi + np.clip(step, -STEP, STEP), LOW, HIGH)
            if (tried := minus_log(new, model, size)) < best - 0.5 * CONVERGED:
                phi, best = new, tried
                break
        if before - best < CONVERGED:
            break
    return phi


def without_offset(phi: np.ndarray, model: Regression, size: float) -> np.ndarray:
    """The constants with offset 0, unless an offset makes the events much more probable."""
    none = descend(np.where(OFFSET, 0.0, phi), model, size, free=~OFFSET)
    gain = minus_log(none, model, size) - minus_log(phi, model, size)
    return phi if gain > BY_OFFSET else none
