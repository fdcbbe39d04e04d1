"""One threshold where the other polarity tells nothing: brightness that only rises, OFF that is
switched off.

Network and fusion know recordings that tell both, and few OFF events for one reason alone: a high
threshold. Where that is not what happened they are too sure. Here the threshold and its mismatch
are moved until their own side of the balance agrees, whatever the other polarity did. Where
brightness goes one way only, the memory is known to lag behind; where it goes both ways, nobody
knows what it did.
"""

from __future__ import annotations

import numpy as np

from evflow.camera import Summary
from evflow.estimation.refine.fit import EMPTY, MODEL_ERROR, Fit, balance_residual, square_residual
from evflow.estimation.refine.moments import DEAD, Moments
from evflow.estimation.refine.noise import STRATA
from evflow.estimation.refine.path import Chunk
from evflow.estimation.refine.trace import FRESH

Array = np.ndarray

OFFSETS = (0.2, 0.2, 0.08, 0.08, 0.05)  # log theta: finite differences of the passes
SIGMA_OFFSET, SIGMA_RANGE, LONGEST_SIGMA = 0.03, (0.002, 0.3), 0.05
SIGMA_ERROR = 0.05  # of the mismatch to start from
SQUARE_ERROR = 0.3  # log units, what a simulation leaves of a mean square
FEW = np.array([3.0, 20.0])  # variances of balance and mean square, times the size of changes
LAGGING = (1.0, 0.5, 0.25, 0.0)  # shares of theta by which memory lags, to choose from
START_ERROR = 0.4  # of the threshold to start from, relative: RMS, measured with OFF unreached
LEAST_ERROR = 0.03  # of theta, however many events: measured on scenes that get brighter
MEMORY_ERROR = 0.6  # of theta, for the share of changes that go the other way: measured with OFF
# events taken away and with OFF thresholds that nothing reaches
LEAST_AGAINST = 0.1  # share of changes: below, brightness only rises, or only falls
SURPRISE = 3.0  # standard deviations of a count
STILL = [i for i, s in enumerate(STRATA) if s.climb < 1.0]  # strata that change little in all
LEAST_STILL = 0.05  # share of the pixel seconds: in less, noise cannot be told from signal


def foreseen(chunks: list[Chunk], summary: Summary, std: Summary, told: int, seed: int = 0) -> bool:
    """Whether brightness goes both ways and a camera of this summary sends as few events of the
    other polarity than `told` (0 ON, 1 OFF): then its threshold is high, and that is all."""
    fit = Fit(chunks, summary, std, seed)
    fit.choose_start()
    made = fit.simulate(fit.values[None]).events[0, 1 - told]
    too_few = (made - fit.recorded.events[1 - told]) / np.sqrt(made + 1.0)
    return bool(too_few < SURPRISE and _against(fit.recorded, told) > LEAST_AGAINST)


def refine_alone(
    chunks: list[Chunk], summary: Summary, std: Summary, told: int, prior: tuple[float, float],
    seed: int = 0,
) -> tuple[float, float, bool]:
    """Threshold of polarity `told` (0 ON, 1 OFF), its std, and whether its noise rate is told.

    summary, std: where to start from; of the other polarity what is known beforehand. prior: mean
    and std of thresholds.
    """
    fit = Fit(chunks, summary, std, seed)
    fit.prior_std[told] = START_ERROR
    others = [FRESH]
    if _against(fit.recorded, told) <= LEAST_AGAINST:
        # The memory lags behind on one side, and the network is a quarter too low.
        fit.later, *others = [(0.0, s) if told == 0 else (s, 0.0) for s in LAGGING]
        fit.prior[told], fit.prior_std[told] = prior[0], prior[1] / prior[0]
    for offset in OFFSETS:
        fit.choose_start(others)
        variance = _step(fit, told, offset)
    theta = float(fit.values[told])
    memory = MEMORY_ERROR * _against(fit.recorded, told)
    error = np.sqrt(variance + LEAST_ERROR**2 + memory**2)
    still = fit.quiet[STILL, told, 1].max() / float(fit.recorded.exposure)
    return theta, float(theta * error), bool(still > LEAST_STILL)


def _against(recorded: Moments, told: int) -> float:
    """Share of the changes that go the other way than those that polarity `told` reports."""
    size = np.asarray(recorded.balance)[..., 3].sum(0)
    return float(size[1 - told] / (size.sum() + EMPTY))


def _by_lag(recorded: Moments, told: int) -> tuple[Array, float]:
    """Weights of the lags (L,) and the weighted size of the told side's changes: slow fades have
    them over long lags alone."""
    size = np.asarray(recorded.balance)[:, told, 3]
    weights = size / (size.sum() + EMPTY)
    return weights, float(weights @ size)


def _noise_share(fit: Fit, told: int) -> float:
    """Contrast that noise events are taken for, relative to the change after a pixel's first."""
    since = float(fit.recorded.balance[-1, told, 3] / (fit.recorded.squares[told, -1] + EMPTY))
    seconds = float(fit.recorded.exposure / max(float(fit.recorded.pixels), 1.0))
    return float(fit.values[2 + told] * seconds * fit.values[told] / (since + DEAD))


def _step(fit: Fit, told: int, offset: float) -> float:
    """One Gauss-Newton step of (log theta, mismatch); the variance of the first."""
    sigma, size = 4 + told, _by_lag(fit.recorded, told)[1]
    noise = np.array([_noise_share(fit, told), 0.0])  # events that leave the memory as it is
    precision = 1.0 / (np.square([MODEL_ERROR, SQUARE_ERROR]) + FEW / (size + EMPTY) + noise**2)
    values = np.stack([fit.values] * 3)
    values[1, told] *= np.exp(offset)
    values[2, sigma] += SIGMA_OFFSET
    excess = _excess(fit, told, values)
    jacobian = (excess[1:] - excess[0]).T / np.array([offset, SIGMA_OFFSET])
    held = np.diag([fit.prior_std[told] ** -2.0, SIGMA_ERROR**-2.0])
    away = np.array([np.log(fit.values[told] / fit.prior[told]),
                     fit.values[sigma] - fit.prior[sigma]])
    curvature = jacobian.T * precision @ jacobian + held
    change = -np.linalg.solve(curvature, jacobian.T * precision @ excess[0] + held @ away)
    fit.move(told, change[0])
    moved = fit.values[sigma] + np.clip(change[1], -LONGEST_SIGMA, LONGEST_SIGMA)
    fit.values[sigma] = np.clip(moved, *SIGMA_RANGE)
    return float(np.linalg.inv(curvature)[0, 0])


def _excess(fit: Fit, told: int, values: Array) -> Array:
    """What is recorded less what cameras of values (V, 6) send, (V, 2): balance of the told side,
    log of its mean square."""
    made, seen, theta = fit.simulate(values), fit.recorded, values[:, :2]
    balance = balance_residual(seen, theta) - balance_residual(made, theta)
    square = np.log(square_residual(seen, theta) / square_residual(made, theta))
    return np.stack([balance[..., told] @ _by_lag(seen, told)[0], square[:, told]], -1)
