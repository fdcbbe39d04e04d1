"""JAER: thresholds as gains, updated online so that integrated events match the next frame.

Brandli, Muller, Delbruck, "Real-time, high-speed video decompression using a frame- and
event-based DAVIS sensor" (ISCAS 2014). Each event adds its gain to a log display buffer; at a new
frame the error err = theta_ON n_ON - theta_OFF n_OFF - dL is distributed to the gains by their
share of the events: theta_ON -= a err n_ON / n, theta_OFF += a err n_OFF / n. The camera's
thresholds are averages over the pixels that fired, low-passed by m. Inter-event-time bins are left
out, as practically every event falls into the last.

The loop gain of a pixel is a n, which diverges beyond 8 events per frame at a = .25. Tied gains are
one value for all pixels, updated by means over pixels: K updates for a recording of K frames in
each pass.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from evflow.baselines.base import Interval, Solution, System, constant, intervals
from evflow.camera import THETA_MIN
from evflow.types import Recording

Array = jax.Array

RATE, MIXING = 0.25, 0.1  # a and m, as published
RUNAWAY = 10.0  # log units: a gain of no sensor


@dataclasses.dataclass(frozen=True)
class Jaer(System):
    """passes: over the frames. tied: one gain per polarity for all pixels, the published default;
    else one per pixel. normalised: divide by n_ON² + n_OFF² (NLMS), which never diverges. start: of
    the gains, log units (published: .001 of the converter's own scale). From a start above the
    threshold a busy pixel's update is negative, and discarded by the rule; the gain is then stuck
    and marked invalid."""

    passes: int = 3
    tied: bool = True
    normalised: bool = False
    start: float = 0.2

    def solve(self, recording: Recording) -> Solution:
        width, height = recording.events.size
        parts = intervals(recording)
        if self.tied:
            theta, moved = self._tied(parts)
            found = moved & (np.abs(theta) < RUNAWAY)
            notes = [] if found.all() else [f"{name} did not converge" for name, good in zip(
                ("ON", "OFF"), found, strict=True) if not good]
            return constant((height, width), np.where(found, theta, self.start), found, *notes)
        n, d = zip(*((p.counts, p.after - p.before) for p in parts), strict=True)
        theta, fired, away = (np.asarray(a) for a in self._untied(
            jnp.asarray(np.stack(n)), jnp.asarray(np.stack(d))))
        sound = fired & ~away[None] & (theta >= THETA_MIN)
        diverged = (f"{away.mean():.1%} of the pixels diverged",) if away.any() else ()
        return Solution(np.where(sound, theta, self.start), sound, notes=diverged)

    def _tied(self, parts: Iterable[Interval]) -> tuple[np.ndarray, np.ndarray]:
        """theta (2,), and whether it was ever updated (2,); one interval in memory at a time."""
        rows = [_means(p.counts, p.after - p.before, self.normalised) for p in parts]
        matrix, vector, fired = (jnp.stack(column) for column in zip(*rows, strict=True))
        theta = jnp.full(2, self.start, matrix.dtype)
        for _ in range(self.passes):
            theta = _pass(theta, matrix, vector, fired)
        return np.asarray(theta), np.asarray(theta != jnp.full_like(theta, self.start))

    def _untied(self, n: Array, d: Array) -> tuple[Array, Array, Array]:
        """theta (2, H, W), whether each pixel fired (2, H, W), and whether it diverged (H, W); such
        a pixel keeps its last value. n: counts (K, 2, H, W); d: dL (K, H, W)."""
        theta = jnp.full(n.shape[1:], self.start, d.dtype)
        away = jnp.zeros(d.shape[1:], bool)
        for _ in range(self.passes):
            theta, away = _untied_pass(theta, away, n, d, self.normalised)
        return theta, (n > 0).any(0), away


def _blame(n: Array, normalised: bool) -> Array:
    """Share of the error (..., 2, H, W) for each polarity."""
    size = (n * n if normalised else n).sum(-3, keepdims=True)
    return n / jnp.maximum(size, 1.0)


@partial(jax.jit, static_argnames="normalised")
def _means(n: Array, d: Array, normalised: bool) -> tuple[Array, Array, Array]:
    """Mean update of each polarity over the pixels where it fired, as matrix (2, 2) theta - vector
    (2,), and whether it fired (2,). n: counts (2, H, W); d: dL (H, W)."""
    blame, touched = _blame(n, normalised), (n > 0).sum((1, 2))
    share = 1.0 / jnp.maximum(touched, 1).astype(d.dtype)

    def mean(values: Array) -> Array:
        return (blame * values[None]).sum((1, 2)) * share

    return jnp.stack([mean(n[0]), -mean(n[1])], -1), mean(d), touched > 0


@jax.jit
def _pass(theta: Array, matrix: Array, vector: Array, fired: Array) -> Array:
    def frame(theta: Array, x: tuple[Array, Array, Array]) -> tuple[Array, None]:
        m, v, some = x
        error = (m * theta[None]).sum(-1) - v
        moved = theta - RATE * error * jnp.array([1.0, -1.0], theta.dtype)
        mixed = (1.0 - MIXING) * theta + MIXING * moved
        return jnp.where(some & (moved > 0), mixed, theta), None

    return jax.lax.scan(frame, theta, (matrix, vector, fired))[0]


@partial(jax.jit, static_argnames="normalised")
def _untied_pass(
    theta: Array, away: Array, n: Array, d: Array, normalised: bool
) -> tuple[Array, Array]:
    def frame(carry: tuple[Array, Array], x: tuple[Array, Array]) -> tuple[tuple, None]:
        (theta, away), (n, d) = carry, x
        error = theta[0] * n[0] - theta[1] * n[1] - d
        sign = jnp.array([1.0, -1.0], d.dtype)[:, None, None]
        moved = theta - RATE * sign * error[None] * _blame(n, normalised)
        away = away | (jnp.abs(moved) > RUNAWAY).any(0) | ~jnp.isfinite(moved).all(0)
        return (jnp.where(away[None], theta, moved), away), None

    return jax.lax.scan(frame, (theta, away), (n, d))[0]
