"""A wide prior of cameras, for networks trained without knowing their camera: wider than the
estimate's prior, so that one network serves all."""

from __future__ import annotations

import dataclasses
import math

import jax
import jax.numpy as jnp

from evflow.camera import THETA_MIN, Camera
from evflow.checks import require
from evflow.errors import EvflowDataError

Array = jax.Array


@dataclasses.dataclass(frozen=True)
class WidePrior:
    """theta: range of the ON threshold, log-uniform or, if `uniform`, uniform; ratio: theta_off
    lies within this factor of it, either way, log-uniform. mismatch: range of the standard
    deviation over pixels, as a share of the threshold: an absolute one of .03 would make hot pixels
    of half of those at .05. eta: range of the noise rates in Hz, uniform, separate per polarity."""

    theta: tuple[float, float] = (0.05, 1.0)
    ratio: float = 1.5
    mismatch: tuple[float, float] = (0.02, 0.2)
    eta: tuple[float, float] = (0.0, 2.0)
    uniform: bool = False

    def __post_init__(self) -> None:
        for name, least in (("theta", THETA_MIN), ("mismatch", 0.0), ("eta", 0.0)):
            low, high = getattr(self, name)
            if not least <= low <= high < math.inf:
                raise EvflowDataError("EV020", f"WidePrior({name}={(low, high)}).",
                                      f"Give (low, high), {least} <= low <= high.")
        require(self, "ratio", 1 <= self.ratio < math.inf, ">= 1")

    def sample(self, key: Array, shape: tuple[int, int]) -> Camera:
        """One camera of (H, W) pixels."""
        k_theta, k_ratio, k_mismatch, k_pixels, k_eta = jax.random.split(key, 5)
        low, high = self.theta if self.uniform else map(math.log, self.theta)
        reach = math.log(self.ratio)
        on = jax.random.uniform(k_theta, minval=low, maxval=high)
        on = on if self.uniform else jnp.exp(on)
        off = on * jnp.exp(jax.random.uniform(k_ratio, minval=-reach, maxval=reach))
        sigma = jax.random.uniform(
            k_mismatch, (2, 1, 1), minval=self.mismatch[0], maxval=self.mismatch[1])
        draws = 1.0 + sigma * jax.random.normal(k_pixels, (2, *shape))
        eta = jax.random.uniform(k_eta, (2,), minval=self.eta[0], maxval=self.eta[1])
        ones = jnp.ones(shape, eta.dtype)
        return Camera(jnp.maximum(on * draws[0], THETA_MIN), jnp.maximum(off * draws[1], THETA_MIN),
                      eta[0] * ones, eta[1] * ones)
