"""Combines the flow's estimate of a pixel with what is known of its camera.

The flow gives a measurement of known width. The camera's pixels are distributed around its summary:
thresholds with the mismatch sigma, in natural units as they are drawn; noise rates with 30 %,
except for a few hot ones. The posterior is the product of both, exact for Gaussians: if all pixels
of a camera are alike, the flow adds nothing, so a map is never worse than its summary.

Measured values v (..., 4) are theta_on, theta_off and the coordinates y of eta_on, eta_off.
"""

from __future__ import annotations

import dataclasses
import math

import jax
import jax.numpy as jnp

from evflow.camera import Camera
from evflow.network.coordinates import CENTRE, SCALE, per_channel, squash, squash_summary

Array = jax.Array

ETA_SPREAD = 0.3  # of log eta over a camera's pixels, at most
HOT_SHARE, HOT_SPREAD = 1e-3, 5.0  # hot pixels: their share, and spread of the log of their rates


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Evidence:
    """Measurements of each pixel: precisions (..., 4) of v, and v times them. Sums add up."""

    precision: Array
    weighted: Array

    def __add__(self, other: Evidence) -> Evidence:
        return jax.tree.map(jnp.add, self, other)


def evidence(y: Array, y_std: Array, shown: Array | None = None) -> Evidence:
    """From one window: y of the flow and its std (..., 4). A threshold's width is proportional to
    it. shown: (...,) bool, pixels that count."""
    v = _values(y)
    width = jnp.concatenate([v[..., :2] * per_channel(SCALE[:2], v), jnp.ones_like(v[..., 2:])], -1)
    precision = (width * y_std) ** -2.0
    if shown is not None:
        precision = jnp.where(shown[..., None], precision, 0.0)
    return Evidence(precision, precision * v)


@jax.jit
@jax.checkpoint  # otherwise the backward pass would store a dozen numbers per pixel
def of_window(y: Array, y_std: Array, y6: Array, y6_std: Array) -> tuple[Camera, Camera]:
    """The posterior of one window."""
    return posterior(evidence(y, y_std), y6, y6_std)


@jax.jit
def posterior(found: Evidence, y6: Array, y6_std: Array) -> tuple[Camera, Camera]:
    """Maps (...) and their std, given the camera's summary y6 (..., 6) and its own std, which all
    pixels share. A pixel with less information than its camera has the camera's std."""
    known, centre = squash_summary(y6), _values(y6[..., :4])
    sigma = jnp.stack([known.sigma_on, known.sigma_off], -1)
    about = jnp.concatenate([sigma, jnp.full_like(sigma, ETA_SPREAD)], -1)
    informed = found.precision > 0
    mean = jnp.where(informed, found.weighted / jnp.where(informed, found.precision, 1.0), centre)
    off = mean - centre
    share = _share(about, found.precision)
    hot = _hot(off[..., 2:], found.precision[..., 2:])
    eta = share[..., 2:] + hot * (_share(HOT_SPREAD, found.precision[..., 2:]) - share[..., 2:])
    v = centre + off * jnp.concatenate([share[..., :2], eta], -1)
    theta, y_eta = v[..., :2], v[..., 2:]
    camera = Camera(theta[..., 0], theta[..., 1], *jnp.moveaxis(_rates(y_eta), -1, 0))
    # The product's own width would count two estimates with the same error as independent.
    width = jnp.minimum(about, jnp.where(informed, found.precision, 1e-12) ** -0.5)
    slope = jnp.concatenate([jnp.ones_like(theta), _rates(y_eta)], -1)
    shared = y6_std[..., :4] * per_channel(SCALE, v) * jnp.concatenate(
        [theta, jnp.ones_like(theta)], -1)
    # Pixels that are all alike, of a known camera, have no error: the gradient there is 0.
    std = slope * jnp.sqrt(jnp.maximum(width**2 + shared**2, 1e-30))
    return camera, Camera(*jnp.moveaxis(std, -1, 0))


def _values(y: Array) -> Array:
    """y (..., 4) -> v (..., 4)."""
    camera = squash(y)
    return jnp.concatenate([jnp.stack([camera.theta_on, camera.theta_off], -1), y[..., 2:4]], -1)


def _rates(y_eta: Array) -> Array:
    """Noise rates in Hz from coordinates (..., 2), whose scale is 1."""
    return jnp.exp(y_eta + per_channel(CENTRE[2:], y_eta))


def _share(about: Array | float, precision: Array) -> Array:
    """The weight of a measurement, for values that scatter around another by `about`."""
    return about**2 * precision / (about**2 * precision + 1.0)


def _hot(off: Array, precision: Array) -> Array:
    """The probability that a pixel is hot whose measured noise rate differs by `off`."""
    error = 1.0 / jnp.maximum(precision, 1e-12)
    inner, outer = ETA_SPREAD**2 + error, HOT_SPREAD**2 + error
    odds = 0.5 * (off**2 * (1.0 / inner - 1.0 / outer) - jnp.log(outer / inner))
    return jax.nn.sigmoid(odds + math.log(HOT_SHARE / (1.0 - HOT_SHARE)))
