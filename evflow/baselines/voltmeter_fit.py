"""DVS-Voltmeter's constants from a recording, where it determines them (Lin et al., ECCV 2022).

    k1, k2   threshold in log(L + k2): regression of that brightness at the events on their counts,
             all pixels together, one threshold for both polarities
    k4, k5   drift at rest, k4 + k5 L, and
    k3, k6   diffusion, k3 sqrt(L) / (L + k2) + k6: of quiet pixels' noise over the light, as the
             first passage of a Brownian motion between -1 and 1 has the rates
             mu = (ON + OFF) tanh(q), sigma^2 = mu / q, q = log(ON / OFF) / 2
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy import optimize

from evflow.camera.sensors import Voltmeter
from evflow.estimation.refine.receptor_data import Sample
from evflow.estimation.shot import LIGHTS

Array = np.ndarray

K2 = (1.0, 3.0, 6.0, 10.0, 15.0, 20.0, 26.0, 33.0, 42.0, 55.0, 75.0, 100.0)  # DN
WORTH = 400.0  # cap of the effective number of events, as path errors are shared
WIDE = 8.0  # ratio of the largest to the least probable k2, above which it is undetermined
LEAST_EVENTS, LEAST_LIGHT = 200.0, 50.0  # of quiet pixels; in a bin of light
FEW_LIGHTS, CONTRAST = 3, 2.0  # least number of bins of light, and their ratio, for its effect
THETA = (0.02, 2.0)  # log units: range of thresholds


@dataclasses.dataclass(frozen=True)
class Constants:
    """voltmeter: the constants; undetermined: names of those that the recording does not determine:
    0, or for k2 the most probable."""

    voltmeter: Voltmeter
    undetermined: tuple[str, ...]


def measured_constants(data: Sample, light: Array) -> Constants:
    """k1 to k6 of a recording. data: of `receptor_sample`; light: of `by_light`, events of quiet
    pixels."""
    fits = [regressed(data, k2, tied=True) for k2 in K2]
    likely = -0.5 * WORTH * np.log([left for _, left in fits])
    best = int(np.argmax(likely))
    probable = np.array(K2)[likely > likely[best] - 2.0]
    undetermined = ("k2",) if probable[-1] / probable[0] > WIDE else ()
    rest, more = _at_rest(light, K2[best])
    voltmeter = Voltmeter(1.0 / float(fits[best][0][0]), K2[best], *rest)
    return Constants(voltmeter, (*undetermined, *more))


def _at_rest(light: Array, k2: float) -> tuple[tuple[float, ...], tuple[str, ...]]:
    """k3 to k6, and the names of undetermined ones."""
    events, seconds = light[:, 0], light[:, 1]
    used = (events.sum(0) >= LEAST_LIGHT) & (seconds.min(0) > 0)
    dn = np.clip((np.arange(LIGHTS) + 0.5) / LIGHTS * 275.0 - 20.0, 1.0, 255.0)[used]
    if events.sum() < LEAST_EVENTS:  # without quiet pixels not even their mean rate is known
        rate = events.sum() / seconds.sum() * 1e-6 if seconds.sum() else 0.0  # per us
        return (0.0, 0.0, 0.0, float(np.sqrt(2 * rate))), ("k3", "k4", "k5", "k6")
    if used.sum() < FEW_LIGHTS or dn.max() < CONTRAST * dn.min():
        rates = (events.sum(1) + 0.5) / np.maximum(seconds.sum(1), 1e-9) * 1e-6
        drift, sigma = passage_rates(rates[:, None])
        return (0.0, float(drift[0]), 0.0, float(sigma[0])), ("k3", "k5")
    rates = (events[:, used] + 0.5) / seconds[:, used] * 1e-6
    drift, sigma = passage_rates(rates)
    root = np.sqrt(events.sum(0)[used])  # in units of the largest, as k's are 1e-4 and less
    scale, size = float(np.abs(drift).max()) + 1e-15, float(sigma.max())
    k4, k5 = scale * np.linalg.lstsq(np.stack([root, root * dn], 1), root * drift / scale)[0]
    shape = np.sqrt(dn) / (dn + k2)
    k3, k6 = size * optimize.nnls(np.stack([root * shape, root], 1), root * sigma / size)[0]
    return (float(k3), float(k4), float(k5), float(k6)), ()


def passage_rates(rates: Array) -> tuple[Array, Array]:
    """Drift and diffusion of a Brownian motion that starts at 0 and leaves (-1, 1) upwards and
    downwards at the rates (2, N)."""
    q = 0.5 * np.log(rates[0] / rates[1])
    total = rates.sum(0)
    drift = total * np.tanh(q)
    return drift, np.sqrt(np.where(np.abs(q) > 1e-3, drift / np.where(q == 0, 1.0, q), total))


def regressed(data: Sample, added: float, tied: bool) -> tuple[Array, float]:
    """Regression of log(L + added) at the events on their counts, all pixels together: theta (2,),
    ON and OFF (equal if tied), and the share of variance not explained."""
    sums = np.zeros((3, 3))
    for dn, pixel, at, on, off, weight in zip(
            *(np.asarray(getattr(data, n), np.float64) for n in
              ("dn", "pixel", "at", "on", "off", "weight")), strict=True):
        pixel = pixel.astype(np.int64)
        step = np.minimum(at.astype(np.int64), len(dn) - 2)
        logs = np.log(np.maximum(dn, 0.0) + added)
        y = logs[step, pixel] + (at - step) * (logs[step + 1, pixel] - logs[step, pixel])
        mass = np.maximum(np.bincount(pixel, weight), 1e-12)
        columns = np.stack([v - (np.bincount(pixel, weight * v) / mass)[pixel]
                            for v in (on, off, y)])
        sums += (columns * weight) @ columns.T
    if tied:
        together = np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
        sums = together.T @ sums @ together
    theta = np.linalg.solve(sums[:-1, :-1], sums[:-1, -1])
    left = float((sums[-1, -1] - theta @ sums[:-1, -1]) / sums[-1, -1])
    return np.clip(np.broadcast_to(theta, 2), *THETA), left
