"""The photoreceptor of a camera, from its recording: which one explains the events best.

At an event the memory equals what the pixel sees, s of simulator/photoreceptor.py, so that s at a
pixel's events is theta_on a - theta_off b plus a constant, a and b counting its events. The pooled
regression of all pixels explains the more of s the truer (offset, tau, delay) are; tau is linear
where the pixel is fast. What cannot be told apart, as an offset from a threshold, is in the
covariance.
"""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from evflow.camera.optics import Optics
from evflow.camera.sensors import SensorModel
from evflow.estimation.refine.receptor_data import PIXELS, TILES, Sample, smeared_sample
from evflow.simulator.photoreceptor import FAST, Photoreceptor, seen_path

Array = jax.Array

OFFSETS = (-16.0, -8.0, 0.0, 6.0, 14.0, 26.0, 45.0)  # DN, where the search begins
TAUS = (FAST, 5e-4, 1e-3, 2e-3, 5e-3, 1e-2)  # s
PRIOR = np.array([25.0, 5e-3, 8e-4])  # std of offset (DN), tau and delay (s) before any data
SCALE = np.array([2.0, 2e-4, 2e-4])  # of finite differences
STEP = np.array([12.0, 3e-3, 1e-3])  # most that one step changes
LOW, HIGH = np.array([-25.0, FAST, -4e-3]), np.array([90.0, 3e-2, 4e-3])
PATTERN = (4.0, 1.0, 0.25)  # SCALEs that are tried, one coordinate at a time
MOST_STEPS, CONVERGED = 12, 0.02  # of log-likelihood
MOST_SIZE = 400.0  # events' worth of a recording, as errors of the path are alike everywhere
PLAIN = np.array([0.0, FAST, 0.0])  # an ideal pixel, frames that show light
# The path is wrong in its own way everywhere. What it explains better by less than a few per cent
# of what is left says nothing of the pixel, and so much is left open of what is found:
BELIEVED = 400.0  # events' worth, in the odds against an ideal pixel
FLOOR = np.array([0.5, 1e-4, 5e-4])
DOUBT = 6.0  # log odds, a priori and for the volume of the three, that a camera is ideal


# The less of the contrast a path keeps, the less of the events it explains. On simulated recordings
# with .8 to .98 explained, the regression's thresholds over the true ones are 1 - LACKING times the
# rest, but for a few per cent and a part of what is lacking.
LACKING, LEAST_KEPT = 1.5, 0.5
KEPT_ERROR = (0.04, 0.8)
SMEARS = (0.01, 0.02)  # s
CUTOFFS = (np.inf, 1000.0, 500.0, 300.0, 200.0, 140.0, 100.0, 70.0, 50.0, 30.0, 20.0)  # Hz


@dataclasses.dataclass(frozen=True, eq=False)
class Found:
    """seen: the most probable photoreceptor; theta, ideal_theta (2,): of the pooled
    regression, with it and with an ideal pixel; covariance
    (3, 3) of (offset, tau, delay); slope (2, 3): how log theta_on, log theta_off of the pooled
    regression change with the three; explained: shares of the variance that the regression
    explains, with an ideal pixel and as found; chance: probability that the ideal pixel is not
    enough; size: how many independent events the sample is worth; smear (2, 3): for each of SMEARS,
    by how much the memory's mean over it is explained better (log of what is left), and how the
    logs of theta_on and theta_off change with it; curve (K, 2): the share that is explained with
    each of CUTOFFS, Hz, offset and delay as found."""

    seen: Photoreceptor
    theta: np.ndarray
    ideal_theta: np.ndarray
    covariance: np.ndarray
    slope: np.ndarray
    explained: tuple[float, float]
    chance: float
    size: float
    smear: np.ndarray
    curve: np.ndarray

    @property
    def std(self) -> np.ndarray:
        """Of offset (DN), tau (s) and delay (s)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def sensor(self) -> tuple[SensorModel, dict[str, float]]:
        """The pixel circuit that was measured, and its standard deviations; a cutoff that lies
        within two of them of none is none."""
        tau, error = self.seen.tau_s, float(self.std[1])
        seen = self.needed and tau > 2.0 * error
        cutoff = self.seen.cutoff_hz if seen else 0.0
        return (SensorModel(cutoff_hz=cutoff, noise_resets_memory=True),
                {"cutoff_hz": cutoff * error / tau if seen else float("nan")})

    @property
    def least_cutoff_hz(self) -> float:
        """What the cutoff is above, by two standard deviations of tau."""
        slow = (self.seen.tau_s if self.needed else 0.0) + 2.0 * float(self.std[1])
        return float(1.0 / (2.0 * np.pi * slow))

    @property
    def optics(self) -> Optics:
        """What the frames show beside what the pixels saw."""
        offset, delay = (self.seen.offset_dn, self.seen.delay_s) if self.needed else (0.0, 0.0)
        return Optics(offset, delay, float(self.std[0]), float(self.std[2]))

    @property
    def needed(self) -> bool:
        """Whether an ideal pixel is the less probable."""
        return self.chance > 0.5

    def thresholds(self) -> tuple[np.ndarray, float]:
        """theta (2,) of the pooled regression, less what the path lacks of the contrast, and its
        relative error."""
        kept = float(np.clip(1 - LACKING * (1 - self.explained[1]), LEAST_KEPT, 1.0))
        return self.theta / kept, float(np.hypot(KEPT_ERROR[0], KEPT_ERROR[1] * (1 - kept)))

    @property
    def theta_error(self) -> np.ndarray:
        """Relative error (2,) of theta that not knowing the three leaves."""
        return np.sqrt(np.einsum("ij,jk,ik->i", self.slope, self.covariance, self.slope))


@jax.jit
def _sums(phi: Array, data: Sample) -> Array:
    """(blocks, 6): weighted sums of aa, ab, bb, as, bs, ss about each pixel's means."""
    blocks = data.dn.shape[0] * TILES[0] * TILES[1]

    def one(d: Sample) -> Array:
        s = seen_path(d.dn, d.dt_s, phi[0], phi[1])
        at = jnp.clip(d.at - phi[2] / d.dt_s.mean(), 0.0, len(d.dt_s) - 1e-3)
        step = jnp.floor(at).astype(jnp.int32)
        y = s[step, d.pixel] + (at - step) * (s[step + 1, d.pixel] - s[step, d.pixel])

        def total(v: Array) -> Array:
            return jax.ops.segment_sum(v, d.pixel, PIXELS)

        mass = jnp.maximum(total(d.weight), 1e-9)
        a, b, y = (v - (total(d.weight * v) / mass)[d.pixel] for v in (d.on, d.off, y))
        sums = jnp.stack([total(d.weight * u * v)
                          for u, v in ((a, a), (a, b), (b, b), (a, y), (b, y), (y, y))], -1)
        return jax.ops.segment_sum(sums, d.block, blocks)

    return jax.lax.map(one, data).sum(0)


_slopes = jax.jit(jax.jacfwd(_sums))


def _solved(sums: np.ndarray) -> tuple[np.ndarray, float, float]:
    """theta_on, theta_off of the pooled regression, what it leaves and what there is."""
    aa, ab, bb, ay, by, yy = sums
    theta = np.linalg.solve(np.array([[aa, ab], [ab, bb]]), np.array([ay, by]))
    return theta, float(yy - theta @ np.array([ay, by])), float(yy)


def _totals(phi: np.ndarray, data: Sample) -> np.ndarray:
    return np.asarray(_sums(jnp.asarray(phi, jnp.float32), data), np.float64).sum(0)


def _unexplained(phi: np.ndarray, data: Sample) -> float:
    """Log of the share of variance that the regression leaves."""
    _, left, all_ = _solved(_totals(phi, data))
    return float(np.log(max(left, 1e-12) / all_))


def _by_block(phi: np.ndarray, data: Sample) -> tuple[np.ndarray, np.ndarray]:
    """Derivative (blocks, 3) of `_unexplained`, block by block, and of log theta (2, 3)."""
    at = jnp.asarray(phi, jnp.float32)
    total = _totals(phi, data)
    change = np.asarray(_slopes(at, data), np.float64)
    theta, left, all_ = _solved(total)
    on, off = theta
    of_left = np.array([on * on, 2 * on * off, off * off, -2 * on, -2 * off, 1.0])
    slope = np.einsum("bkp,k->bp", change, of_left) / left - change[:, 5] / all_
    of_theta = np.linalg.solve(np.array([[total[0], total[1]], [total[1], total[2]]]),
                               change.sum(0)[3:5])
    return slope, of_theta / theta[:, None]


def find(data: Sample) -> Found:
    """The photoreceptor that is most probable, and how well it is known: the curvature, and the
    scatter of the gradient from block to block."""
    plain, phi = _unexplained(PLAIN, data), _start(data)
    for _ in range(2):
        size = _size(phi, data)
        phi = _descend(phi, data, size)
    value = _unexplained(phi, data)
    slope, of_theta = _by_block(phi, data)
    curvature = _curvature(phi, slope.sum(0), data)
    away = slope - slope.mean(0)
    units = np.outer(SCALE, SCALE)
    scatter = away.T @ away * units
    bent = curvature * units
    information = bent @ np.linalg.inv(scatter + 1e-12 * np.eye(3)) @ bent
    information += np.diag((SCALE / PRIOR) ** 2)
    covariance = np.linalg.inv(information) * units + np.diag(FLOOR**2)
    fits, ideal_fits = (_solved(_totals(at, data))[0] for at in (phi, PLAIN))
    odds = 0.5 * min(size, BELIEVED) * (plain - value) - DOUBT - 0.5 * float(
        (((phi - PLAIN) / PRIOR) ** 2).sum())
    if fits.min() <= 0:  # brightness that falls with ON events: there is no path
        odds = -np.inf
    seen = Photoreceptor(float(phi[0]), float(phi[1]) if phi[1] > 2 * FAST else 0.0, float(phi[2]))
    return Found(seen, np.abs(fits), np.abs(ideal_fits), covariance, of_theta,
                 (float(1 - np.exp(plain)), float(1 - np.exp(value))),
                 float(1.0 / (1.0 + np.exp(-np.clip(odds, -50, 50)))), size,
                 _smear(phi if odds > 0 else PLAIN, data), _curve(phi, data))


def _curve(phi: np.ndarray, data: Sample) -> np.ndarray:
    """(K, 2), as in `Found`."""
    taus = [max(1.0 / (2.0 * np.pi * cutoff), FAST) for cutoff in CUTOFFS]
    return np.array([[cutoff, 1 - np.exp(_unexplained(np.array([phi[0], tau, phi[2]]), data))]
                     for cutoff, tau in zip(CUTOFFS, taus, strict=True)])


def _smear(phi: np.ndarray, data: Sample) -> np.ndarray:
    """(2, 3), as in `Found`."""
    theta, left, _ = _solved(_totals(phi, data))
    rows = []
    for seconds in SMEARS:
        other, less, _ = _solved(_totals(phi, smeared_sample(data, seconds)))
        rows.append([np.log(left / less), *np.log(np.abs(other / theta))])
    return np.array(rows)


def _size(phi: np.ndarray, data: Sample) -> float:
    """How many independent events the sample is worth: with L the log of the unexplained share,
    the likelihood is exp(-size L / 2), whose gradient scatters as much as it is curved."""
    slope, _ = _by_block(phi, data)
    bent = np.diag(_curvature(phi, slope.sum(0), data))
    scatter = ((slope - slope.mean(0)) ** 2).sum(0)
    return float(np.clip(2.0 * np.median(bent / np.maximum(scatter, 1e-30)), 10.0, MOST_SIZE))


def explained(data: Sample, seen_by: Photoreceptor, theta: np.ndarray) -> float:
    """Share of the variance that thresholds (2,) explain behind a photoreceptor, both of another
    part of the recording."""
    aa, ab, bb, ay, by, yy = _totals(
        np.array([seen_by.offset_dn, max(seen_by.tau_s, FAST), seen_by.delay_s]), data)
    on, off = theta
    return 1.0 - float(yy - 2 * (on * ay + off * by) + on**2 * aa + 2 * on * off * ab
                       + off**2 * bb) / float(yy)


def _start(data: Sample) -> np.ndarray:
    """The best of a coarse grid, coordinate by coordinate."""
    phi = PLAIN.copy()
    for k, values in ((1, TAUS), (0, OFFSETS), (1, TAUS), (0, OFFSETS)):
        tried = [np.where(np.arange(3) == k, v, phi) for v in values]
        phi = min(tried, key=partial(_unexplained, data=data))
    return phi


def _descend(phi: np.ndarray, data: Sample, size: float) -> np.ndarray:
    """Newton's steps, damped until they lead down, and single coordinates where none does: the
    lin-log's bend at 20 DN bends the likelihood too."""
    def value(at: np.ndarray) -> float:
        away = (at - PLAIN) / PRIOR
        return 0.5 * size * _unexplained(at, data) + 0.5 * float(away @ away)

    best = value(phi)
    for _ in range(MOST_STEPS):
        slope = _by_block(phi, data)[0].sum(0)
        gradient = 0.5 * size * slope + (phi - PLAIN) / PRIOR**2
        bent = 0.5 * size * _curvature(phi, slope, data) + np.diag(PRIOR**-2.0)
        steps = [-np.linalg.solve(bent + np.diag(np.diag(bent)) * damping, gradient)
                 for damping in (0.02, 0.5, 5.0)]
        steps += [sign * much * SCALE * (np.arange(3) == k)
                  for much in PATTERN for k in range(3) for sign in (1, -1)]
        before = best
        for step in steps:
            new = np.clip(phi + np.clip(step, -STEP, STEP), LOW, HIGH)
            if (tried := value(new)) < best - 0.5 * CONVERGED:
                phi, best = new, tried
                break
        if before - best < CONVERGED:
            break
    return phi


def _curvature(phi: np.ndarray, gradient: np.ndarray, data: Sample) -> np.ndarray:
    """Of `_unexplained` (3, 3), positive definite."""
    rows = [(_by_block(phi + SCALE * (np.arange(3) == k), data)[0].sum(0) - gradient) / SCALE[k]
            for k in range(3)]
    units = np.outer(SCALE, SCALE)
    values, vectors = np.linalg.eigh(0.5 * (np.array(rows) + np.array(rows).T) * units)
    return vectors @ np.diag(np.maximum(values, 1e-9)) @ vectors.T / units
