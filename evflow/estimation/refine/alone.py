"""The threshold of one polarity where the other has too few events: brightness that only rises,
or a sensor whose OFF events are switched off.

Network and fusion were trained on recordings with ON and OFF signal, and attribute few OFF events
to a high threshold. Where the cause is another, they are overconfident. Here the threshold of one
polarity and its mismatch are fitted to the balance of that polarity's own side, whatever the other
did. Where brightness changes one way only, the memory is known to lag behind it; where it changes
both ways, the memory after a missing event is unknown.
"""

from __future__ import annotations

import numpy as np

from evflow.camera import Summary
from evflow.estimation.refine.chunk import Chunk
from evflow.estimation.refine.fit import EMPTY, MODEL_ERROR, Fit, balance_residual, square_residual
from evflow.estimation.refine.moments import DEAD, Moments
from evflow.estimation.refine.noise import STRATA
from evflow.estimation.refine.trace import FRESH

Array = np.ndarray

OFFSETS = (0.2, 0.2, 0.08, 0.08, 0.05)  # log theta: finite differences of the passes
SIGMA_OFFSET, SIGMA_RANGE, LONGEST_SIGMA = 0.03, (0.002, 0.3), 0.05
SIGMA_ERROR = 0.05  # of the mismatch to start from
SQUARE_ERROR = 0.3  # log units: error of a mean square, simulated against recorded
FEW = np.array([3.0, 20.0])  # variances of balance and mean square, times the size of changes
LAGGING = (1.0, 0.5, 0.25, 0.0)  # candidates: share of theta by which the memory lags
START_ERROR = 0.4  # of the threshold to start from, relative: RMS, measured with OFF unreached
LEAST_ERROR = 0.03  # of theta, however many events: measured on scenes that get brighter
# Of theta, times the share of changes that go the other way; measured with OFF events removed and
# with OFF thresholds too high to be reached.
MEMORY_ERROR = 0.6
LEAST_AGAINST = 0.1  # share of changes below which brightness counts as monotonic
SURPRISE = 3.0  # standard deviations of a count
STILL = [i for i, s in enumerate(STRATA) if s.climb < 1.0]  # strata that change little in all
LEAST_STILL = 0.05  # share of the pixel seconds: in less, noise cannot be separated from signal


def high_threshold_explains(
    chunks: list[Chunk], summary: Summary, std: Summary, side: int, seed: int = 0
) -> bool:
    """Whether a high threshold explains the few events of the polarity opposite to `side`.

    True where brightness changes both ways and a simulated camera of this summary sends no more
    events of that polarity than were recorded, but for chance.

    Args:
        chunks: of the recording.
        summary, std: the estimate to simulate.
        side: the polarity with enough events, 0 ON, 1 OFF.
        seed: of the simulated noise and mismatch.
    """
    fit = Fit(chunks, summary, std, seed)
    fit.choose_start()
    made = fit.simulate(fit.values[None]).events[0, 1 - side]
    too_few = (made - fit.recorded.events[1 - side]) / np.sqrt(made + 1.0)
    return bool(too_few < SURPRISE and _against(fit.recorded, side) > LEAST_AGAINST)


def refine_alone(
    chunks: list[Chunk], summary: Summary, std: Summary, side: int, prior: tuple[float, float],
    seed: int = 0,
) -> tuple[float, float, bool]:
    """Fit the threshold of one polarity to its own events.

    Args:
        chunks: of the recording.
        summary, std: the estimate to start from; for the other polarity, prior knowledge.
        side: the polarity to fit, 0 ON, 1 OFF.
        prior: mean and std of thresholds before any data.
        seed: of the simulated noise and mismatch.

    Returns:
        The threshold, its std, and whether the recording determines this polarity's noise rate.
    """
    fit = Fit(chunks, summary, std, seed)
    fit.prior_std[side] = START_ERROR
    others = [FRESH]
    if _against(fit.recorded, side) <= LEAST_AGAINST:
        # The memory lags behind on one side; the network's threshold is then 25 % too low.
        fit.later, *others = [(0.0, s) if side == 0 else (s, 0.0) for s in LAGGING]
        fit.prior[side], fit.prior_std[side] = prior[0], prior[1] / prior[0]
    for offset in OFFSETS:
        fit.choose_start(others)
        variance = _step(fit, side, offset)
    theta = float(fit.values[side])
    memory = MEMORY_ERROR * _against(fit.recorded, side)
    error = np.sqrt(variance + LEAST_ERROR**2 + memory**2)
    still = fit.quiet[STILL, side, 1].max() / float(fit.recorded.exposure)
    return theta, float(theta * error), bool(still > LEAST_STILL)


def _against(recorded: Moments, side: int) -> float:
    """Share of the brightness changes in the direction opposite to polarity `side`."""
    size = np.asarray(recorded.balance)[..., 3].sum(0)
    return float(size[1 - side] / (size.sum() + EMPTY))


def _by_lag(recorded: Moments, side: int) -> tuple[Array, float]:
    """Weights of the lags (L,) by size of the changes of polarity `side`, and their weighted size:
    a slow fade has changes at long lags only."""
    size = np.asarray(recorded.balance)[:, side, 3]
    weights = size / (size.sum() + EMPTY)
    return weights, float(weights @ size)


def _noise_share(fit: Fit, side: int) -> float:
    """Contrast that the regression attributes to noise events, relative to the change after a
    pixel's first event."""
    since = float(fit.recorded.balance[-1, side, 3] / (fit.recorded.squares[side, -1] + EMPTY))
    seconds = float(fit.recorded.exposure / max(float(fit.recorded.pixels), 1.0))
    return float(fit.values[2 + side] * seconds * fit.values[side] / (since + DEAD))


def _step(fit: Fit, side: int, offset: float) -> float:
    """Take one Gauss-Newton step of (log theta, mismatch); returns the variance of log theta."""
    sigma, size = 4 + side, _by_lag(fit.recorded, side)[1]
    noise = np.array([_noise_share(fit, side), 0.0])  # events that leave the memory as it is
    precision = 1.0 / (np.square([MODEL_ERROR, SQUARE_ERROR]) + FEW / (size + EMPTY) + noise**2)
    values = np.stack([fit.values] * 3)
    values[1, side] *= np.exp(offset)
    values[2, sigma] += SIGMA_OFFSET
    excess = _excess(fit, side, values)
    jacobian = (excess[1:] - excess[0]).T / np.array([offset, SIGMA_OFFSET])
    held = np.diag([fit.prior_std[side] ** -2.0, SIGMA_ERROR**-2.0])
    away = np.array([np.log(fit.values[side] / fit.prior[side]),
                     fit.values[sigma] - fit.prior[sigma]])
    curvature = jacobian.T * precision @ jacobian + held
    change = -np.linalg.solve(curvature, jacobian.T * precision @ excess[0] + held @ away)
    fit.move(side, change[0])
    moved = fit.values[sigma] + np.clip(change[1], -LONGEST_SIGMA, LONGEST_SIGMA)
    fit.values[sigma] = np.clip(moved, *SIGMA_RANGE)
    return float(np.linalg.inv(curvature)[0, 0])


def _excess(fit: Fit, side: int, values: Array) -> Array:
    """Recorded minus simulated, for cameras of values (V, 6): (V, 2), the balance of polarity
    `side` and the log of its mean square."""
    made, seen, theta = fit.simulate(values), fit.recorded, values[:, :2]
    balance = balance_residual(seen, theta) - balance_residual(made, theta)
    square = np.log(square_residual(seen, theta) / square_residual(made, theta))
    return np.stack([balance[..., side] @ _by_lag(seen, side)[0], square[:, side]], -1)
