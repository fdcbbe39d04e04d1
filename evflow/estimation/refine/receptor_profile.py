"""How far the constants may be off where the likelihood is no parabola.

Along the offset, with tau and delay at their best everywhere: at the knee of the lin-log the
likelihood bends, and is far flatter to the side of more light than its curvature at the top says;
and a threshold goes with the offset's logarithm, not in proportion. Between the two laws of the
low-pass, of which the less probable may be the true one.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from evflow.estimation.refine.receptor_regression import Regression

Array = np.ndarray

WALK = (1.0, 1.0, 1.0, 2.0, 2.0, 4.0)  # lengths of the steps to either side, in std of the offset
SHORTEST, LONGEST = 1.5, 6.0  # DN, of that std
FAR = 5.0  # below the best log-likelihood, where a walk ends


@dataclasses.dataclass(frozen=True, eq=False)
class Other:
    """The less probable law of a low-pass: its probability, and tau (s) and theta (2,) by it."""

    chance: float
    tau_s: float
    theta: Array

    def beside(
        self, tau_s: float, theta: Array, covariance: Array, theta_error: Array
    ) -> tuple[Array, Array]:
        """Covariance (3, 3) of the constants and relative errors (2,) of theta, of the more
        probable law with tau_s and theta, widened by how far this one lies from it."""
        wider = np.zeros((3, 3))
        wider[1, 1] = self.chance * (self.tau_s - tau_s) ** 2
        apart = np.log(np.abs(self.theta) / np.abs(theta))
        return covariance + wider, np.hypot(theta_error, np.sqrt(self.chance) * apart)


def along_offset(
    phi: Array, model: Regression, covariance: Array, minus_log: Callable[[Array], float],
    step: Callable[[Array], Array],
) -> tuple[float, Array]:
    """Mean squares of how far the offset lies from phi's, and of how far the logs of theta (2,) do.

    covariance: of phi (3,) near the best; minus_log: of the posterior; step: from a place to where
    tau and delay are about the best for its offset.
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
