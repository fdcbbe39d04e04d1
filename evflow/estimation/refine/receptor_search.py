"""The photoreceptor of a camera, from its recording: the one that explains the events best.

The share of variance that the pooled regression (receptor_regression.py) explains is maximal at the
true offset, tau, delay and law of the low-pass. Constants that cannot be distinguished, such as an
offset and a threshold, show in the covariance.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from evflow.estimation.refine.receptor_data import Sample, smeared_sample
from evflow.estimation.refine.receptor_descent import (
    BELIEVED,
    HIGH,
    LOW,
    OFFSET,
    PLAIN,
    STEP,
    descend,
    minus_log,
    newton,
    receptor,
    without_offset,
    worth,
)
from evflow.estimation.refine.receptor_maps import left_open, with_map
from evflow.estimation.refine.receptor_noise import split_at_noise
from evflow.estimation.refine.receptor_prior import (
    DOUBT,
    Prior,
    beyond_bias,
    small_sample_odds,
)
from evflow.estimation.refine.receptor_profile import Other, along_offset, offset_open
from evflow.estimation.refine.receptor_regression import SCALE, Regression, Slopes
from evflow.estimation.refine.receptor_result import Found
from evflow.simulator.photoreceptor import FAST, TYPICAL, Photoreceptor

FLOOR = np.array([0.5, 1e-4, 5e-4])  # std of offset, tau and delay
# Log odds required, beside the evidence of net changes, for an offset in the frames of an ideal
# pixel:
ALONE = 2.0
# Where the path explains so large a share of the variance, little of what is left is due to its own
# errors, and the gain of an offset alone is evidence of so many times as many events. Of 81 cameras
# without an offset (two simulators) one of 12 DN or more gained .3 % of what is left at most, and
# in one camera .6 %; of 54 of −16 to 24 DN that DOUBT had missed, more than .6 % in 25.
CLEAN, CLEANER, TRUSTED = 0.7, 0.8, 5.0
BY_PATH = 4.0  # log odds required for it, beside those of its prior
BY_LIGHT = 1.0  # prior log odds of a low-pass whose cutoff is proportional to light
SMEARS = (0.01, 0.02)  # s
CUTOFFS = (np.inf, 1000.0, 500.0, 300.0, 200.0, 140.0, 100.0, 70.0, 50.0, 30.0, 20.0)  # Hz


def find(data: Sample) -> Found | None:
    """Search for the most probable photoreceptor; errors follow from the curvature and from the
    scatter of the gradient over blocks. None where noise divides the events so finely that no
    threshold follows from them."""
    begun = with_map(data)
    if begun is None:
        return None
    first, other_map = begun
    by_light, phi, size = first.model, first.phi, first.size
    plain = by_light.unexplained(PLAIN)
    believed = min(size, BELIEVED)
    model, phi, other_law = _with_law(phi, by_light, believed)
    odds = _odds(phi, model, believed, plain)
    if odds > 0 and phi[1] > 2 * FAST:
        phi = without_offset(phi, model, believed)
        odds = _odds(phi, model, believed, plain)
    for way in (_offset_by_net, _offset_by_path):
        alone, alone_odds = way(by_light, believed, plain)
        if odds <= 0 < alone_odds:
            model, phi = by_light, alone
        odds = max(odds, alone_odds)
    value = model.unexplained(phi)
    covariance, open_ = _errors(phi, model, believed)
    fits, ideal_fits = (model.solved(at)[0] for at in (phi, PLAIN))
    if other_law is not None and phi[1] > 2 * FAST:
        covariance, open_ = other_law.beside(phi[1], fits, covariance, open_)
    if fits.min() <= 0:  # brightness falls at ON events: the path is wrong
        odds = -np.inf
    used = phi if odds > 0 else PLAIN
    return Found(receptor(phi, model), np.abs(fits), np.abs(ideal_fits),
                 covariance, open_,
                 (float(1 - np.exp(plain)), float(1 - np.exp(value))),
                 float(1.0 / (1.0 + np.exp(-np.clip(odds, -50, 50)))),
                 small_sample_odds(data), size,
                 _smear(used, model), _curve(phi, model),
                 left_open(model, used, other_map, believed),
                 np.zeros(2) if odds > 0 else offset_open(by_light, believed))


def explained(data: Sample, seen_by: Photoreceptor, theta: np.ndarray) -> float:
    """Share of a sample's variance explained by a photoreceptor and thresholds (2,) that were
    measured on another part of the recording; NaN where no threshold follows from the sample."""
    at = np.array([seen_by.offset_dn, max(seen_by.tau_s, FAST), seen_by.delay_s])
    model = Regression(split_at_noise(data, seen_by, theta), seen_by.by_light, seen_by.log_map)
    return model.explained_by(at, theta) if model.determines() else float("nan")


def _with_law(
    phi: np.ndarray, by_light: Regression, size: float
) -> tuple[Regression, np.ndarray, Other | None]:
    """The more probable law of the low-pass, its most probable constants, and the other law."""
    if phi[1] <= 2 * FAST:
        return by_light, phi, None
    even = dataclasses.replace(by_light, by_light=False)
    other = descend(np.where(np.arange(3) == 1, phi[1] / TYPICAL, phi), even, size)
    odds = minus_log(phi, by_light, size) - minus_log(other, even, size) - BY_LIGHT
    laws = [(by_light, phi), (even, other)]
    (model, at), (left, there) = laws[::-1] if odds > 0 else laws
    chance = 1.0 / (1.0 + np.exp(min(abs(odds), 50.0)))
    return model, at, Other(chance, float(there[1]), left.solved(there)[0])


def _odds(phi: np.ndarray, model: Regression, size: float, plain: float) -> float:
    """Log odds of the constants against an ideal pixel, whose log unexplained share is `plain`."""
    gain = 0.5 * worth(phi, model, size) * (plain - model.unexplained(phi))
    return _given_prior(gain - DOUBT - small_sample_odds(model.data), phi, model)


def _given_prior(gain: float, phi: np.ndarray, model: Regression) -> float:
    """Log odds of the constants, by their gain and what was known of them before."""
    return gain - Prior().minus_log(phi) + model.prior.log_odds(float(phi[0]))


def _offset_by_net(model: Regression, size: float, plain: float) -> tuple[np.ndarray, float]:
    """The constants of an ideal pixel whose frames have the offset measured from net changes, and
    their log odds. plain: log unexplained share of an ideal pixel."""
    evidence = model.prior.evidence()
    if evidence <= 0.0:
        return PLAIN, -np.inf
    phi = descend(np.where(OFFSET, model.prior.centre, PLAIN), model, size, OFFSET)
    gain = 0.5 * worth(phi, model, size) * (plain - model.unexplained(phi))
    return phi, gain - ALONE + evidence


def _offset_by_path(model: Regression, size: float, plain: float) -> tuple[np.ndarray, float]:
    """The same with the offset by which a path that is nearly right explains the events best."""
    phi = descend(PLAIN, model, TRUSTED * size, OFFSET)
    left = model.unexplained(phi)
    clean = np.clip((1.0 - np.exp(left) - CLEAN) / (CLEANER - CLEAN), 0.0, 1.0)
    size *= float(1.0 + (TRUSTED - 1.0) * clean)
    gain = beyond_bias(0.5 * size * (plain - left), float(phi[0]))
    gain -= BY_PATH + small_sample_odds(model.data)
    return phi, _given_prior(gain, phi, model) if clean else -np.inf


def _errors(phi: np.ndarray, model: Regression, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Covariance (3, 3) of (offset, tau, delay), and relative errors (2,) of theta: from the
    derivatives at phi, or along the offset from the likelihood if that is wider."""
    slopes = model.slopes(phi)
    near = _covariance(slopes, model.curvature(phi), model.prior)
    lead = near[:, 0] / near[0, 0]

    def step(at: np.ndarray) -> np.ndarray:
        gradient, bent = newton(at, model, size)
        change = np.clip(-np.linalg.solve(bent[1:, 1:], gradient[1:]), -STEP[1:], STEP[1:])
        return np.clip(at + np.concatenate([[0.0], change]), LOW, HIGH)

    offset, theta = along_offset(phi, model, near, lambda at: minus_log(at, model, size), step)
    farther = max(offset - near[0, 0], 0.0)
    others = near - near[0, 0] * np.outer(lead, lead)  # given the offset
    linear, rest = (np.einsum("ij,jk,ik->i", slopes.of_theta, c, slopes.of_theta)
                    for c in (near, others))
    return near + farther * np.outer(lead, lead), np.sqrt(np.maximum(linear, rest + theta))


def _covariance(slopes: Slopes, curvature: np.ndarray, prior: Prior) -> np.ndarray:
    """Of (offset, tau, delay), (3, 3)."""
    away, units = slopes.by_block - slopes.by_block.mean(0), np.outer(SCALE, SCALE)
    bent = curvature * units
    information = bent @ np.linalg.inv(away.T @ away * units + 1e-12 * np.eye(3)) @ bent
    information += np.diag((SCALE / prior.std) ** 2)
    return np.asarray(np.linalg.inv(information) * units + np.diag(FLOOR**2))


def _curve(phi: np.ndarray, model: Regression) -> np.ndarray:
    """(K, 2), as in `Found`."""
    taus = [max(1.0 / (2.0 * np.pi * cutoff), FAST) for cutoff in CUTOFFS]
    return np.array([[cutoff, 1 - np.exp(model.unexplained(np.array([phi[0], tau, phi[2]])))]
                     for cutoff, tau in zip(CUTOFFS, taus, strict=True)])


def _smear(phi: np.ndarray, model: Regression) -> np.ndarray:
    """(2, 3), as in `Found`."""
    theta, left, _ = model.solved(phi)
    rows = []
    for seconds in SMEARS:
        smeared = dataclasses.replace(model, data=smeared_sample(model.data, seconds))
        other, less, _ = smeared.solved(phi) if smeared.determines() else (theta, left, 0.0)
        rows.append([np.log(left / less), *np.log(np.abs(other / theta))])
    return np.array(rows)

