"""Errors of the photoreceptor's constants where the likelihood is not a parabola.

Three sources. Along the offset (with the best tau and delay at each): the lin-log's knee bends the
likelihood, which is far flatter towards more light than its curvature at the maximum says, and a
threshold depends on the offset's logarithm. Between the two laws of the low-pass: the less probable
may be the true one. And an offset may be there where none was found.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from evflow.estimation.refine.receptor_descent import OFFSET, PLAIN
from evflow.estimation.refine.receptor_prior import Prior, beyond_bias
from evflow.estimation.refine.receptor_regression import Regression

Array = np.ndarray

WALK = (1.0, 1.0, 1.0, 2.0, 2.0, 4.0)  # steps to each side, in std of the offset
SHORTEST, LONGEST = 1.5, 6.0  # DN, limits of that std
POSSIBLE = np.arange(-24.0, 61.0, 4.0)  # DN, of an offset that was not found
FAR = 5.0  # drop of the log-likelihood at which a walk ends


@dataclasses.dataclass(frozen=True, eq=False)
class Other:
    """The less probable law of the low-pass: its probability, and tau (s) and theta (2,) by it."""

    chance: float
    tau_s: float
    theta: Array

    def beside(
        self, tau_s: float, theta: Array, covariance: Array, theta_error: Array
    ) -> tuple[Array, Array]:
        """Errors of the more probable law, widened by its difference from this one.

        Args:
            tau_s, theta: by the more probable law.
            covariance: (3, 3) of its constants.
            theta_error: (2,) relative errors of its theta.

        Returns:
            Covariance (3, 3) and relative errors (2,).
        """
        wider = np.zeros((3, 3))
        wider[1, 1] = self.chance * (self.tau_s - tau_s) ** 2
        apart = np.log(np.abs(self.theta) / np.abs(theta))
        return covariance + wider, np.hypot(theta_error, np.sqrt(self.chance) * apart)


def along_offset(
    phi: Array, model: Regression, covariance: Array, minus_log: Callable[[Array], float],
    step: Callable[[Array], Array],
) -> tuple[float, Array]:
    """Second moments of the posterior along the offset, about phi.

    Args:
        phi: (3,) the most probable constants.
        model: the regression.
        covariance: (3, 3) of phi, from the curvature.
        minus_log: of the posterior.
        step: maps a place to about the best tau and delay for its offset.

    Returns:
        Mean square deviation of the offset, and (2,) of log theta.
    """
    lead = covariance[:, 0] / covariance[0, 0]
    length = float(np.clip(np.sqrt(covariance[0, 0]), SHORTEST, LONGEST))
    origin = np.log(np.abs(model.solved(phi)[0]))
    best, rows = minus_log(phi), [(0.0, 0.0, *np.zeros(2))]
    for sign in (-1.0, 1.0):
        at = phi
        for much in WALK:
            guess = at + sign * much * length * lead
            value, at = min(((minus_log(place), place) for place in (guess, step(guess))),
                            key=lambda found: found[0])
            away = np.log(np.abs(model.solved(at)[0])) - origin
            rows.append((at[0] - phi[0], value - best, *away))
            if value - best > FAR:
                break
    offset, worse, *away = np.array(sorted(rows, key=lambda row: row[0])).T
    weight = np.gradient(offset) * np.exp(worse.min() - worse)
    weight /= weight.sum()
    return float(weight @ offset**2), np.array([weight @ a**2 for a in away])


def offset_open(model: Regression, size: float) -> Array:
    """(2,) relative errors of an ideal pixel's theta, as there may be an offset after all: as if
    every second camera had one. size: effective number of events that count as evidence."""
    ideal, none = model.solved(PLAIN)[0], -0.5 * size * model.unexplained(PLAIN)
    usual, log_odds, away = [], [], []
    for offset in POSSIBLE:
        at = np.where(OFFSET, offset, PLAIN)
        theta = model.solved(at)[0]
        is_possible = min(theta.min(), ideal.min()) > 0
        gain = beyond_bias(-0.5 * size * model.unexplained(at) - none, float(offset))
        usual.append(-Prior().minus_log(at))
        log_odds.append(gain + usual[-1] + model.prior.log_odds(float(offset)) if is_possible
                        else -np.inf)
        away.append(np.log(theta / ideal) if is_possible else np.zeros(2))
    weight = np.exp(np.minimum(log_odds, 50.0)) / np.exp(usual).sum()
    return np.asarray(np.sqrt(weight @ np.square(away) / (1.0 + weight.sum())))
