"""How many events a pixel should send: closed forms that the simulator is held against.

NumPy only, and nothing of the simulator: a pixel whose contrast rises steadily, whose memory
leaks, whose memory is reset by noise, or whose voltage diffuses. Rates are in Hz, times in
seconds, contrasts in natural-log units; arrays of pixels are (N,).
"""

from __future__ import annotations

import numpy as np
from scipy.special import log_ndtr, ndtri

from evflow.camera.sensors import SensorModel, Voltmeter

Values = np.ndarray | float


def dimmed(dn: Values) -> np.ndarray:
    """(F - 1) N01 + 1 of Eq. 12, F = .25, N01 = (DN + 20) / 275: v2e's noise falls with light."""
    return 1 - 0.75 * (np.asarray(dn) + 20) / 275


def low_passed(model: SensorModel, dn: np.ndarray, dt_s: float) -> np.ndarray:
    """Log intensity behind v2e's low-pass, frame by frame; dn: (T,) above 20 DN."""
    log_i = np.log(dn)
    if model.cutoff_hz <= 0:
        return log_i
    out = log_i.copy()
    for k in range(1, len(out)):
        share = min((dn[k] + 20) / 275 * dt_s * 2 * np.pi * model.cutoff_hz, 1.0)
        out[k] = out[k - 1] + share * (log_i[k] - out[k - 1])
    return out


def voltage(v: Voltmeter, dn: np.ndarray, dt_s: float) -> np.ndarray:
    """DVS-Voltmeter's mean voltage over k1, (T,): what a contrast threshold is compared with."""
    mean = (dn[1:] + dn[:-1]) / 2
    rise = np.diff(dn) / (mean + v.k2) + (v.k4 + v.k5 * mean) * (dt_s * 1e6) / v.k1
    return np.concatenate([[0.0], np.cumsum(rise)])


def steady_rise(
    theta: np.ndarray, total: np.ndarray, progress: np.ndarray, resets: np.ndarray,
    weight: np.ndarray,
) -> np.ndarray:
    """Expected events (N,) of pixels whose contrast rises by `total` (N,) without turning.

    progress: (K,) share of it reached at K times; resets: (K,) mean number of noise events up to
    then, times weight (N,), each of which sets the contrast back to zero. With L the mean number
    up to a share x of the way, and s = theta / total, the j-th event after a restart counts
    sum_j exp(-L(js)) + int exp(-(L(x + js) - L(x))) dL(x), x <= 1 - js; floor(1/s) without noise.
    """
    found, share, from_here = np.floor(total / theta), theta / total, np.linspace(0, 1, 65)
    if resets[-1] <= 0:
        return found
    found = np.zeros(len(theta))
    for j in range(1, int(1 / share.min()) + 1):
        at = np.flatnonzero(j * share <= 1)
        step, w = j * share[at, None], weight[at, None]
        begin = from_here * (1 - step)
        before, after = (w * np.interp(x, progress, resets) for x in (begin, begin + step))
        survives = np.exp(before - after)
        mean = 0.5 * (survives[:, 1:] + survives[:, :-1])
        found[at] += np.exp(-w * np.interp(step, progress, resets))[:, 0]
        found[at] += (np.diff(before, axis=1) * mean).sum(1)
    return found


def leaked(model: SensorModel, noise_hz: float, seconds: float) -> float:
    """Leak events of a pixel in `seconds`, mean over the fixed pattern: one every T, where no
    noise event comes between, sum_j exp(-j T noise) (1 + noise (seconds - j T))."""
    if model.leak_hz <= 0:
        return 0.0
    quantiles = (np.arange(4000) + 0.5) / 4000
    period = 10 ** (-model.leak_fpn_decades * ndtri(quantiles)) / model.leak_hz
    noise_hz = noise_hz if model.noise_resets_memory else 0.0
    j = np.arange(1, int(seconds / period.min()) + 1)[:, None]
    left = seconds - j * period
    return float(np.where(left >= 0, np.exp(-j * period * noise_hz) * (1 + noise_hz * left), 0)
                 .sum(0).mean())


def passage(times: Values, mean: Values, shape: Values) -> np.ndarray:
    """P(T <= times) of an inverse Gaussian: first passages of Brownian motion with drift."""
    root = np.sqrt(np.asarray(shape) / times)
    return (np.exp(log_ndtr(root * (times / mean - 1)))
            + np.exp(2 * shape / mean + log_ndtr(-root * (times / mean + 1))))


def diffused(v: Voltmeter, theta: np.ndarray, dn: float, seconds: float) -> np.ndarray:
    """ON events (N,) of DVS-Voltmeter's pixels at rest: the j-th comes when the voltage first
    passes j levels, sum_j P(T_j <= seconds)."""
    drift = (v.k4 + v.k5 * dn) * 1e6
    variance = (v.k3 * np.sqrt(dn) / (dn + v.k2) + v.k6) ** 2 * 1e6
    most = 5 + int(1.2 * seconds * drift / (v.k1 * theta.min()))
    level = v.k1 * theta[:, None] * np.arange(1, 2 + most)
    return passage(seconds, level / drift, level**2 / variance).sum(1)
