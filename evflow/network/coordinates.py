"""Camera parameters <-> the unbounded coordinates y in which the networks work.

y = (log parameter - centre) / scale for (theta_on, theta_off, eta_on, eta_off), so thresholds stay
positive and noise rates unbounded above. (The paper's tanh, kept as an option, allows negative
thresholds, caps rates at 1 Hz and is no bijection at its edges.)
"""

from __future__ import annotations

from typing import Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np

from evflow.camera import Camera, Summary
from evflow.camera.arguments import real_maps
from evflow.errors import EvflowDataError

Array = jax.Array
Output = Literal["log", "tanh"]

ETA_FLOOR = 1e-3  # Hz: one event per pixel in 17 minutes; a silent pixel is mapped here
SIGMA_OFFSET = 0.01  # allows a mismatch of 0
CENTRE = np.log(np.array([0.22, 0.22, 0.12, 0.12], np.float32))
SCALE = np.array([0.6, 0.6, 1.0, 1.0], np.float32)
SIGMA_CENTRE, SIGMA_SCALE = np.float32(np.log(0.06)), np.float32(0.8)
TANH_EDGE = 0.999


def check_output(output: str) -> None:
    """Raise EV020 unless it names one of the coordinates."""
    if output not in get_args(Output):
        raise EvflowDataError("EV020", f"output={output!r:.60}.", "Give 'log', or 'tanh' for the "
                              "paper's network.")


def per_channel(values: np.ndarray, like: Array) -> Array:
    """Constants (C,) reshaped to broadcast with like (..., C): rank promotion stays explicit."""
    return jnp.asarray(values, like.dtype).reshape((1,) * (like.ndim - 1) + (-1,))


def squash(y: Array, output: Output = "log") -> Camera:
    """y (..., 4) -> Camera of maps (...)."""
    y = jnp.asarray(y)
    log_values = y * per_channel(SCALE, y) + per_channel(CENTRE, y)
    values = jnp.tanh(y) if output == "tanh" else jnp.exp(log_values)
    return Camera(*jnp.moveaxis(values, -1, 0))


def unsquash(camera: Camera, output: Output = "log") -> Array:
    """Camera of maps (...) -> y (..., 4); eta below 1e-3 Hz is taken as 1e-3 Hz, one below 0 is
    NaN."""
    camera = real_maps(camera)
    if output == "tanh":
        values = jnp.stack([camera.theta_on, camera.theta_off, camera.eta_on, camera.eta_off], -1)
        return jnp.arctanh(jnp.clip(values, -TANH_EDGE, TANH_EDGE))
    eta = [jnp.where(e < 0, jnp.nan, jnp.maximum(e, ETA_FLOOR))
           for e in (camera.eta_on, camera.eta_off)]
    values = jnp.stack([camera.theta_on, camera.theta_off, *eta], -1)
    return (jnp.log(values) - per_channel(CENTRE, values)) / per_channel(SCALE, values)


def unsquash_summary(summary: Summary) -> Array:
    """Summary of (...,) -> (..., 6): y of the medians, then the two mismatches."""
    medians = Camera(summary.theta_on, summary.theta_off, summary.eta_on, summary.eta_off)
    sigma = jnp.stack([summary.sigma_on, summary.sigma_off], -1)
    sigma_y = (jnp.log(sigma + SIGMA_OFFSET) - SIGMA_CENTRE) / SIGMA_SCALE
    return jnp.concatenate([unsquash(medians), sigma_y], -1)


def squash_summary(y: Array) -> Summary:
    """(..., 6) -> Summary of (...,)."""
    medians = squash(y[..., :4])
    sigma = jnp.exp(y[..., 4:] * SIGMA_SCALE + SIGMA_CENTRE) - SIGMA_OFFSET
    sigma = jnp.maximum(sigma, 0.0)
    return Summary(medians.theta_on, medians.theta_off, medians.eta_on, medians.eta_off,
                   sigma[..., 0], sigma[..., 1])


@jax.jit
def _scaled(y: Array, y_std: Array) -> tuple[Array, Array]:
    scale = per_channel(np.array([*SCALE, SIGMA_SCALE, SIGMA_SCALE]), y)
    return y * scale, y_std * scale


@jax.jit
def _natural(log_y: Array, s: Array) -> tuple[Summary, Summary]:
    medians = jnp.exp(log_y[..., :4] + per_channel(CENTRE, log_y))
    sigma = jnp.maximum(jnp.exp(log_y[..., 4:] + SIGMA_CENTRE) - SIGMA_OFFSET, 0.0)
    found = Summary(*jnp.moveaxis(jnp.concatenate([medians, sigma], -1), -1, 0))
    added = jnp.concatenate([medians, sigma + SIGMA_OFFSET], -1)
    return found, Summary(*jnp.moveaxis(added * s, -1, 0))


def squashed_summary(y: Array, y_std: Array) -> tuple[Summary, Summary]:
    """`squash_summary` and `summary_std` as two programs: a single one would round differently from
    the operations one by one."""
    return _natural(*_scaled(y, y_std))


def summary_std(summary: Summary, y_std: Array) -> Summary:
    """Standard deviation in natural units from that of y (..., 6), to first order."""
    s = y_std * per_channel(np.array([*SCALE, SIGMA_SCALE, SIGMA_SCALE]), y_std)
    return Summary(
        summary.theta_on * s[..., 0], summary.theta_off * s[..., 1], summary.eta_on * s[..., 2],
        summary.eta_off * s[..., 3], (summary.sigma_on + SIGMA_OFFSET) * s[..., 4],
        (summary.sigma_off + SIGMA_OFFSET) * s[..., 5])


def camera_std(y: Array, y_std: Array, output: Output = "log") -> Camera:
    """Standard deviation maps in natural units from those of y (..., 4), to first order."""
    values = jnp.stack(jax.tree.leaves(squash(y, output)), -1)
    slope = 1.0 - values**2 if output == "tanh" else values * per_channel(SCALE, values)
    return Camera(*jnp.moveaxis(slope * y_std, -1, 0))
