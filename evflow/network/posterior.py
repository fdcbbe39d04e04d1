"""What the flow says of a pixel, beside what is known of its camera.

The flow's answer is a measurement of known width. The camera's pixels lie about its summary:
thresholds with the mismatch sigma, in natural units as they are drawn; noise rates with 30 %, but
for the few that are hot. The posterior is the product of both, exact for Gaussians: a camera whose
pixels are all alike leaves nothing to say, and a map then never loses to its summary.

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
HOT_SHARE, HOT_SPREAD = 1e-3, 5.0  # pixels that fire by themselves, some e^5 times as often


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Evidence:
    """What windows said of each pixel: precisions (..., 4) of v, and v times them. Sums add up."""

    precision: Array
    weighted: Array

    def __add__(self, other: Evidence) -> Evidence:
        return jax.tree.map(jnp.add, self, other)


def evidence(y: Array, y_std: Array, shown: Array | None = None) -> Evidence:
    """Of one window: y of the flow and its std (..., 4). A threshold's width is in proportion to
    it. shown: (...,) bool, pixels that count."""
    v = _values(y)
    width = jnp.concatenate([v[..., :2] * per_channel(SCALE[:2], v), jnp.ones_like(v[..., 2:])], -1)
    precision = (width * y_std) ** -2.0
    if shown is not None:
        precision = jnp.where(shown[..., None], precision, 0.0)
    return Evidence(precision, precision * v)


@jax.jit
@jax.checkpoint  # whose way back would keep a dozen numbers a pixel
def of_window(y: Array, y_std: Array, y6: Array, y6_std: Array) -> tuple[Camera, Camera]:
    """The posterior of one window."""
    return posterior(evidence(y, y_std), y6, y6_std)


@jax.jit
def posterior(found: Evidence, y6: Array, y6_std: Array) -> tuple[Camera, Camera]:
    """Maps (...) and their std, of the camera's summary y6 (..., 6) and its own std, which all
    pixels share. Of a pixel that says less than its camera, the std is that of the camera."""
    known, centre = squash_summary(y6), _values(y6[..., :4])
    sigma = jnp.stack([known.sigma_on, known.sigma_off], -1)
    about = jnp.concatenate([sigma, jnp.full_like(sigma, ETA_SPREAD)], -1)
    told = found.precision > 0
    mean = jnp.where(told, found.weighted / jnp.where(told, found.precision, 1.0), centre)
    off = mean - centre
    share = _share(about, found.precision)
    hot = _hot(off[..., 2:], found.precision[..., 2:])
    eta = share[..., 2:] + hot * (_share(HOT_SPREAD, found.precision[..., 2:]) - share[..., 2:])
    v = centre + off * jnp.concatenate([share[..., :2], eta], -1)
    theta, y_eta = v[..., :2], v[..., 2:]
    camera = Camera(theta[..., 0], theta[..., 1], *jnp.moveaxis(_rates(y_eta), -1, 0))
    # The product's own width would take two that are wrong alike for two opinions.
    width = jnp.minimum(about, jnp.where(told, found.precision, 1e-12) ** -0.5)
    slope = jnp.concatenate([jnp.ones_like(theta), _rates(y_eta)], -1)
    shared = y6_std[..., :4] * per_channel(SCALE, v) * jnp.concatenate(
        [theta, jnp.ones_like(theta)], -1)
    std = slope * jnp.sqrt(width**2 + shared**2)
    return camera, Camera(*jnp.moveaxis(std, -1, 0))


def _values(y: Array) -> Array:
    """y (..., 4) -> v (..., 4)."""
    camera = squash(y)
    return jnp.concatenate([jnp.stack([camera.theta_on, camera.theta_off], -1), y[..., 2:4]], -1)


def _rates(y_eta: Array) -> Array:
    """Hz of the coordinates (..., 2) of noise rates, whose scale is 1."""
    return jnp.exp(y_eta + per_channel(CENTRE[2:], y_eta))


def _share(about: Array | float, precision: Array) -> Array:
    """The weight of what was measured, where values lie about another with a deviation `about`."""
    return about**2 * precision / (about**2 * precision + 1.0)


def _hot(off: Array, precision: Array) -> Array:
    """How likely a pixel is hot that was measured `off` its camera's noise rate."""
    error = 1.0 / jnp.maximum(precision, 1e-12)
    inner, outer = ETA_SPREAD**2 + error, HOT_SPREAD**2 + error
    odds = 0.5 * (off**2 * (1.0 / inner - 1.0 / outer) - jnp.log(outer / inner))
    return jax.nn.sigmoid(odds + math.log(HOT_SHARE / (1.0 - HOT_SHARE)))
