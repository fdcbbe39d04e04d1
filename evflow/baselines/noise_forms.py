"""Closed-form noise rates of two simulators for a static scene (paper, Table IV).

v2e's shot noise falls linearly with light and inversely with a pixel's threshold; the leak of
DVS-Voltmeter is a Brownian motion with drift between two levels, with known exit times. Arrays
broadcast; rates are in Hz per pixel and polarity, light in DN on 0..255.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from evflow.camera.sensors import DVS346, Voltmeter
from evflow.light.log_maps import noise_factor, normalised_intensity
from evflow.simulator.voltmeter import exit_against

Array = jax.Array

DRIFTLESS = 1e-4  # 2 mu (A + B) / sigma² below which the mean exit time is its limit A B / sigma²


def v2e_noise(
    theta: ArrayLike, dn: ArrayLike, *, nominal: ArrayLike, rate_hz: float = 1.0
) -> Array:
    """v2e's rate of one polarity: r/2 ((F - 1) I01 + 1) nominal / theta, F = .25.

    theta, nominal: a pixel's threshold and the camera's median; rate_hz: r, both polarities
    together (v2e's --shot_noise_rate_hz). Hu, Liu, Delbruck, "v2e" (CVPRW 2021).
    """
    factor = noise_factor(normalised_intensity(_float(dn)))
    return 0.5 * rate_hz * factor * _float(nominal) / _float(theta)


def voltmeter_noise(
    dn: ArrayLike, theta_on: ArrayLike | None = None, theta_off: ArrayLike | None = None, *,
    constants: Voltmeter = DVS346,
) -> tuple[Array, Array]:
    """DVS-Voltmeter's rates of both polarities (ON, OFF) at rest.

    A voltage with drift mu = k4 + k5 L and diffusion sigma = k3 sqrt(L) / (L + k2) + k6 starts at
    0 and leaves (-B, A), A = k1 theta_ON and B = k1 theta_OFF: with p the probability of A, the
    mean time is (p A - (1 - p) B) / mu, and the rates are p and 1 - p over it. The thresholds are
    the published pixel's (A = B = 1) unless given. Lin et al. (ECCV 2022), Eq. 10 and 11.
    """
    k, dn = constants, _float(dn)
    one = jnp.ones_like(dn)
    a, b = (one if t is None else k.k1 * _float(t) for t in (theta_on, theta_off))
    drift = k.k4 + k.k5 * dn  # per us
    variance = (k.k3 * jnp.sqrt(dn) / (dn + k.k2) + k.k6) ** 2
    speed = jnp.abs(drift)
    ahead, behind = jnp.where(drift >= 0, a, b), jnp.where(drift >= 0, b, a)
    against = exit_against(speed, variance, ahead, behind)
    drifting = 2.0 * speed * (ahead + behind) > DRIFTLESS * variance
    mean = ((1.0 - against) * ahead - against * behind) / jnp.where(drifting, speed, 1.0)
    mean_us = jnp.where(drifting, mean, ahead * behind / jnp.maximum(variance, 1e-30))
    on = jnp.where(drift >= 0, 1.0 - against, against)
    return 1e6 * on / mean_us, 1e6 * (1.0 - on) / mean_us


def _float(x: ArrayLike) -> Array:
    x = jnp.asarray(x)
    return x if jnp.issubdtype(x.dtype, jnp.floating) else x.astype(jnp.float32)
