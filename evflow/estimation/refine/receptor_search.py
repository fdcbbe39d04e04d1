"""The photoreceptor of a camera, from its recording: the one that explains the events best.

The share of variance that the pooled regression (receptor_regression.py) explains is maximal at the
true offset, tau, delay and law of the low-pass. Constants that cannot be distinguished, such as an
offset and a threshold, show in the covariance.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from evflow.camera.sensors import LogMap
from evflow.estimation.refine.receptor_data import Sample, smeared_sample
from evflow.estimation.refine.receptor_noise import split_at_noise
from evflow.estimation.refine.receptor_prior import DOUBT, Prior, small_sample_odds
from evflow.estimation.refine.receptor_profile import Other, along_offset
from evflow.estimation.refine.receptor_regression import SCALE, Regression, Slopes
from evflow.estimation.refine.receptor_result import Found
from evflow.light.log_maps import LINLOG_KNEE
from evflow.simulator.photoreceptor import FAST, TYPICAL, Photoreceptor

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
FLOOR = np.array([0.5, 1e-4, 5e-4])  # std of offset, tau and delay
# Log odds required, beside the evidence of net changes, for an offset in the frames of an ideal
# pixel:
ALONE = 2.0
BY_OFFSET = 5.0  # log odds required for an offset in the frames of a slow pixel
DARK = 0.01  # share of light below lin-log's knee from which the log maps are compared
SHOWN = 0.01  # share of light that may be darker than a black level
# Log odds required for another map than lin-log, beside those of a small sample: where lin-log is
# right, the other gained .4 at most in 63 recordings of 1 s, 3 in 31 small ones of .2 s.
OTHER_MAP = 2.0
BY_LIGHT = 1.0  # prior log odds of a low-pass whose cutoff is proportional to light
SMEARS = (0.01, 0.02)  # s
CUTOFFS = (np.inf, 1000.0, 500.0, 300.0, 200.0, 140.0, 100.0, 70.0, 50.0, 30.0, 20.0)  # Hz


def find(data: Sample) -> Found | None:
    """Search for the most probable photoreceptor; errors follow from the curvature and from the
    scatter of the gradient over blocks. None where noise divides the events so finely that no
    threshold follows from them."""
    begun = _with_map(data)
    if begun is None:
        return None
    by_light, phi, size = begun
    plain = by_light.unexplained(PLAIN)
    believed = min(size, BELIEVED)
    model, phi, other = _with_law(phi, by_light, believed)
    odds = _odds(phi, model, believed, plain)
    if odds > 0 and phi[1] > 2 * FAST:
        phi = _without_offset(phi, model, believed)
        odds = _odds(phi, model, believed, plain)
    alone, alone_odds = _offset_alone(by_light, believed, plain)
    if odds <= 0 < alone_odds:
        model, phi = by_light, alone
    odds = max(odds, alone_odds)
    value = model.unexplained(phi)
    covariance, open_ = _errors(phi, model, believed)
    fits, ideal_fits = (model.solved(at)[0] for at in (phi, PLAIN))
    if other is not None and phi[1] > 2 * FAST:
        covariance, open_ = other.beside(phi[1], fits, covariance, open_)
    if fits.min() <= 0:  # brightness falls at ON events: the path is wrong
        odds = -np.inf
    return Found(_receptor(phi, model), np.abs(fits), np.abs(ideal_fits),
                 covariance, open_,
                 (float(1 - np.exp(plain)), float(1 - np.exp(value))),
                 float(1.0 / (1.0 + np.exp(-np.clip(odds, -50, 50)))),
                 small_sample_odds(data), size,
                 _smear(phi if odds > 0 else PLAIN, model), _curve(phi, model))


def _with_map(data: Sample) -> tuple[Regression, np.ndarray, float] | None:
    """The more probable log map, its most probable constants, and the effective number of events;
    None where no threshold follows from them. The maps differ in dim light alone. Each divides the
    events at noise in its own way, and another one must be the better with both: what is divided
    more finely is explained better by any map. Nor may it need a black level above what the frames
    show: log_eps less an offset is much like lin-log in dim light."""
    begun, light = _begin(data, "linlog"), _light(data)
    if begun is None or (light < LINLOG_KNEE).mean() < DARK:
        return begun
    model, phi, size = begun
    other = _begin(data, "log_eps", np.where(OFFSET, 0.0, phi))
    if other is None:
        return begun
    rival, there, _ = other
    if there[0] < -np.quantile(light, SHOWN):
        return begun
    size = _worth(there, rival, min(size, BELIEVED))
    gain = min(_value(phi, dataclasses.replace(model, data=divided), size)
               - _value(there, dataclasses.replace(rival, data=divided), size)
               for divided in (rival.data, model.data))
    return other if gain > OTHER_MAP + small_sample_odds(data) else begun


def _light(data: Sample) -> np.ndarray:
    """The light (N,) in DN of the used pixels, over time."""
    stretches = zip(*map(np.asarray, (data.dn, data.pixel, data.weight)), strict=True)
    return np.concatenate([
        dn[:, np.unique(pixel[weight > 0])].ravel() for dn, pixel, weight in stretches])


def _begin(
    data: Sample, log_map: LogMap, *near: np.ndarray
) -> tuple[Regression, np.ndarray, float] | None:
    """`_with_map`, of one map. near: places to search from, beside the best of the grid."""
    ideal = Photoreceptor(log_map=log_map)
    model = Regression(split_at_noise(data, ideal), log_map=log_map)
    if not model.determines():
        return None
    starts = [_start(model), *near]
    for _ in range(2):
        size = _size(starts[0], model)
        phi = min((_descend(start, model, size) for start in starts),
                  key=lambda at: _value(at, model, size))
        starts = [phi]
        theta = np.abs(model.solved(phi)[0])
        divided = dataclasses.replace(
            model, data=split_at_noise(data, _receptor(phi, model), theta))
        model = divided if divided.determines() else model
    return model, phi, size


def _receptor(phi: np.ndarray, model: Regression) -> Photoreceptor:
    return Photoreceptor(float(phi[0]), float(phi[1]) if phi[1] > 2 * FAST else 0.0, float(phi[2]),
                         model.by_light, model.log_map)


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
    other = _descend(np.where(np.arange(3) == 1, phi[1] / TYPICAL, phi), even, size)
    odds = _value(phi, by_light, size) - _value(other, even, size) - BY_LIGHT
    laws = [(by_light, phi), (even, other)]
    (model, at), (left, there) = laws[::-1] if odds > 0 else laws
    chance = 1.0 / (1.0 + np.exp(min(abs(odds), 50.0)))
    return model, at, Other(chance, float(there[1]), left.solved(there)[0])


def _odds(phi: np.ndarray, model: Regression, size: float, plain: float) -> float:
    """Log odds of the constants against an ideal pixel, whose log unexplained share is `plain`."""
    gain = 0.5 * _worth(phi, model, size) * (plain - model.unexplained(phi))
    gain -= DOUBT + small_sample_odds(model.data)
    return gain - Prior().minus_log(phi) + model.prior.log_odds(float(phi[0]))


def _offset_alone(model: Regression, size: float, plain: float) -> tuple[np.ndarray, float]:
    """The constants of an ideal pixel whose frames have the offset measured from net changes, and
    their log odds. plain: log unexplained share of an ideal pixel."""
    evidence = model.prior.evidence()
    if evidence <= 0.0:
        return PLAIN, -np.inf
    phi = _descend(np.where(OFFSET, model.prior.centre, PLAIN), model, size, OFFSET)
    gain = 0.5 * _worth(phi, model, size) * (plain - model.unexplained(phi))
    return phi, gain - ALONE + evidence


def _worth(phi: np.ndarray, model: Regression, size: float) -> float:
    """The effective number of events, `size` at most, whose gain is evidence about the pixel."""
    explained = 1.0 - float(np.exp(model.unexplained(phi)))
    return min(size, BELIEVED * min(1.0, explained / CLEAR))


def _without_offset(phi: np.ndarray, model: Regression, size: float) -> np.ndarray:
    """The constants with offset 0, unless an offset makes the events much more probable."""
    none = _descend(np.where(np.arange(3) == 0, 0.0, phi), model, size, free=np.arange(3) > 0)
    gain = _value(none, model, size) - _value(phi, model, size)
    return phi if gain > BY_OFFSET else none


def _value(phi: np.ndarray, model: Regression, size: float) -> float:
    """Minus the log of the posterior of phi."""
    return 0.5 * size * model.unexplained(phi) + model.prior.minus_log(phi)


def _errors(phi: np.ndarray, model: Regression, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Covariance (3, 3) of (offset, tau, delay), and relative errors (2,) of theta: from the
    derivatives at phi, or along the offset from the likelihood if that is wider."""
    slopes = model.slopes(phi)
    near = _covariance(slopes, model.curvature(phi), model.prior)
    lead = near[:, 0] / near[0, 0]

    def step(at: np.ndarray) -> np.ndarray:
        gradient, bent = _newton(at, model, size)
        change = np.clip(-np.linalg.solve(bent[1:, 1:], gradient[1:]), -STEP[1:], STEP[1:])
        return np.clip(at + np.concatenate([[0.0], change]), LOW, HIGH)

    offset, theta = along_offset(phi, model, near, lambda at: _value(at, model, size), step)
    farther = max(offset - near[0, 0], 0.0)
    others = near - near[0, 0] * np.outer(lead, lead)  # given the offset
    linear, rest = (np.einsum("ij,jk,ik->i", slopes.of_theta, c, slopes.of_theta)
                    for c in (near, others))
    return near + farther * np.outer(lead, lead), np.sqrt(np.maximum(linear, rest + theta))


def _newton(phi: np.ndarray, model: Regression, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Gradient and Gauss-Newton curvature of `_value`."""
    slopes, prior = model.slopes(phi), model.prior
    return (0.5 * size * slopes.gradient + (phi - prior.centre) / prior.std**2,
            0.5 * size * slopes.bent + np.diag(prior.std**-2.0))


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


def _size(phi: np.ndarray, model: Regression) -> float:
    """Effective number of independent events. With L the log unexplained share, the likelihood is
    exp(-size L / 2); size is such that its gradient's scatter over blocks equals its curvature."""
    slopes = model.slopes(phi)
    scatter = ((slopes.by_block - slopes.by_block.mean(0)) ** 2).sum(0)
    worth = 2.0 * np.median(np.diag(model.curvature(phi)) / np.maximum(scatter, 1e-30))
    return float(np.clip(worth, 10.0, MOST_SIZE))


def _start(model: Regression) -> np.ndarray:
    """The best point of a coarse grid, coordinate by coordinate."""
    phi = PLAIN.copy()
    for k, values in ((1, TAUS), (0, OFFSETS), (1, TAUS), (0, OFFSETS)):
        tried = [np.where(np.arange(3) == k, v, phi) for v in values]
        phi = min(tried, key=model.unexplained)
    return phi


def _descend(
    phi: np.ndarray, model: Regression, size: float, free: np.ndarray = ALL
) -> np.ndarray:
    """Minimise `_value` over the free constants by damped Newton steps, and by steps of single
    constants where none of these descends (the lin-log's knee at 20 DN bends the likelihood)."""
    phi = np.clip(phi, LOW, HIGH)
    best = _value(phi, model, size)
    for _ in range(MOST_STEPS):
        gradient, bent = _newton(phi, model, size)
        bent = np.where(np.outer(free, free), bent, np.diag(model.prior.std**-2.0))
        steps = [-np.linalg.solve(bent + np.diag(np.diag(bent)) * damping, gradient * free)
                 for damping in (0.02, 0.5, 5.0)]
        steps += [sign * much * SCALE * (np.arange(3) == k)
                  for much in PATTERN for k in np.flatnonzero(free) for sign in (1, -1)]
        before = best
        for step in steps:
            new = np.clip(phi + np.clip(step, -STEP, STEP), LOW, HIGH)
            if (tried := _value(new, model, size)) < best - 0.5 * CONVERGED:
                phi, best = new, tried
                break
        if before - best < CONVERGED:
            break
    return phi
