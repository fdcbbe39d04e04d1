"""Regression of the light behind a photoreceptor on the event counts, pooled over pixels.

At an event the memory equals the pixel's signal s (simulator/photoreceptor.py), so s at a pixel's
events is theta_on a - theta_off b plus a constant, with a and b counting its events (b negatively).
The squares of all pixels, about each one's means, are summed over blocks of the image.
"""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from evflow.camera.sensors import LogMap
from evflow.estimation.refine.receptor_data import EVENTS, TILES, Sample
from evflow.estimation.refine.receptor_prior import Prior
from evflow.simulator.photoreceptor import FAST, seen_path

Array = jax.Array

SCALE = np.array([2.0, 2e-4, 2e-4])  # small changes of offset (DN), tau and delay (s)
LEAST_BENT = 1e-9  # minimal eigenvalue of the curvature in units of SCALE
LEAST_VARIED = 1e-6  # of the counts' squares about their means, and of their determinant's share


@dataclasses.dataclass(frozen=True, eq=False)
class Slopes:
    """Derivatives of the log unexplained share by (offset, tau, delay). by_block: (blocks, 3)
    gradient, as a sum over blocks; bent: (3, 3) approximate curvature, positive definite; of_theta:
    (2, 3) gradient of log theta_on and log theta_off."""

    by_block: np.ndarray
    bent: np.ndarray
    of_theta: np.ndarray

    @property
    def gradient(self) -> np.ndarray:
        return np.asarray(self.by_block.sum(0))


@dataclasses.dataclass(frozen=True, eq=False)
class Regression:
    """The regression of a sample. by_light: whether the low-pass's cutoff is proportional to light;
    log_map: of the light. phi (3,) of its methods: offset (DN), tau and delay (s)."""

    data: Sample
    by_light: bool = True
    log_map: LogMap = "linlog"

    @property
    def prior(self) -> Prior:
        return Prior.of(self.data, self.log_map)

    def determines(self) -> bool:
        """Whether both thresholds follow from the sample: pixels of several events, whose numbers
        of ON and of OFF events so far vary, each by itself."""
        (on, both), (_, off) = self._total(np.array([0.0, FAST, 0.0]))[:2, :2]
        return bool(min(on, off) > LEAST_VARIED and on * off - both**2 > LEAST_VARIED * on * off)

    def solved(self, phi: np.ndarray) -> tuple[np.ndarray, float, float]:
        """theta (2,) ON and OFF of the regression, residual and total sum of squares."""
        products = self._total(phi)
        theta = np.linalg.solve(products[:2, :2], products[:2, 2])
        return theta, left_over(products, theta), float(products[2, 2])

    def unexplained(self, phi: np.ndarray) -> float:
        """Log of the share of variance that the regression does not explain."""
        _, left, all_ = self.solved(phi)
        return float(np.log(max(left, 1e-12) / all_))

    def explained_by(self, phi: np.ndarray, theta: np.ndarray) -> float:
        """Share of the variance explained by given thresholds (2,)."""
        products = self._total(phi)
        return 1.0 - left_over(products, theta) / float(products[2, 2])

    def slopes(self, phi: np.ndarray) -> Slopes:
        """Gauss-Newton derivatives. The unexplained share is |My|² of the unit vector y, where M
        projects out the counts; second derivatives of y itself are neglected, except along y, as
        its length is constant."""
        blocks = self._by_block(phi, slopes=True)
        total = blocks.sum(0)
        counts, seen, all_ = total[:2, :2], total[:2, 2], float(total[2, 2])
        theta = np.linalg.solve(counts, seen)
        left = max(left_over(total, theta), 1e-12 * all_)
        rest = np.array([*-theta, 1.0])
        along = total[2, 3:] / all_
        turned = total[3:, 3:] / all_ - np.outer(along, along)
        of_counts = (total[:2, 3:] - np.outer(seen, along)) / np.sqrt(all_)
        free = turned - of_counts.T @ np.linalg.solve(counts, of_counts)
        return Slopes(
            2 * (blocks[:, :3, 3:].transpose(0, 2, 1) @ rest / left - blocks[:, 2, 3:] / all_),
            _positive(2 * (free * (all_ / left) - turned)),
            np.linalg.solve(counts, total[:2, 3:]) / theta[:, None])

    def curvature(self, phi: np.ndarray) -> np.ndarray:
        """(3, 3), positive definite, by finite differences: the lin-log has second derivatives,
        which Gauss-Newton neglects."""
        steps = np.diag(0.5 * SCALE)
        rows = np.array([self.slopes(phi + step).gradient - self.slopes(phi - step).gradient
                         for step in steps]) / SCALE[:, None]
        return _positive(0.5 * (rows + rows.T))

    def _total(self, phi: np.ndarray) -> np.ndarray:
        return np.asarray(self._by_block(phi, slopes=False).sum(0))

    def _by_block(self, phi: np.ndarray, *, slopes: bool) -> np.ndarray:
        sums = _slopes if slopes else _sums
        law = self.by_light, self.log_map == "log_eps"
        return np.asarray(sums(phi.astype(np.float32), *law, self.data), np.float64)


def left_over(products: np.ndarray, theta: np.ndarray) -> float:
    """Residual sum of squares of y at thresholds (2,), from products (>= 3, >= 3) of (a, b, y)."""
    rest = np.array([*-theta, 1.0])
    return float(rest @ products[:3, :3] @ rest)


def _products(
    phi: Array, by_light: Array, logarithmic: Array, data: Sample, *, slopes: bool
) -> Array:
    """(blocks, M, M): weighted products of a, b, y and, with `slopes`, the derivatives of y, about
    each group's means."""
    blocks = data.dn.shape[0] * TILES[0] * TILES[1]

    def one(d: Sample) -> Array:
        step_s = d.dt_s[jnp.minimum(d.at.astype(jnp.int32), len(d.dt_s) - 1)]
        at = jnp.clip(d.at - phi[2] / step_s, 0.0, len(d.dt_s) - 1e-3)
        step = jnp.floor(at).astype(jnp.int32)

        def path(two: Array) -> Array:
            return seen_path(d.dn, d.dt_s, two[0], two[1], by_light, logarithmic)

        def looked_up(s: Array) -> tuple[Array, Array]:
            before, after = s[step, d.pixel], s[step + 1, d.pixel]
            return before + (at - step) * (after - before), before - after

        if slopes:
            s, along = jax.linearize(path, phi[:2])
            y, fall = looked_up(s)
            y = y if d.lost is None else y - d.lost
            tangents = [looked_up(along(e))[0] for e in jnp.eye(2, dtype=phi.dtype)]
            columns = [d.on, d.off, y, *tangents, fall / step_s]
        else:
            y = looked_up(path(phi[:2]))[0]
            columns = [d.on, d.off, y if d.lost is None else y - d.lost]

        def total(v: Array) -> Array:
            return jax.ops.segment_sum(v, d.group, EVENTS)

        v = jnp.stack(columns, -1)
        mass = jnp.maximum(total(d.weight), 1e-9)[:, None]
        v = v - (total(d.weight[:, None] * v) / mass)[d.group]
        squares = d.weight[:, None, None] * v[:, :, None] * v[:, None, :]
        return jax.ops.segment_sum(squares, d.block[d.pixel], blocks)

    return jax.lax.map(one, data).sum(0)


_sums, _slopes = (jax.jit(partial(_products, slopes=slopes)) for slopes in (False, True))


def _positive(curvature: np.ndarray) -> np.ndarray:
    """The curvature (3, 3) with eigenvalues raised to at least LEAST_BENT."""
    units = np.outer(SCALE, SCALE)
    values, vectors = np.linalg.eigh(curvature * units)
    return np.asarray(vectors @ np.diag(np.maximum(values, LEAST_BENT)) @ vectors.T / units)
