"""The logarithm in which a system's thresholds are contrast, of light in DN."""

from __future__ import annotations

import dataclasses
from typing import Literal

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from evflow.light.log_maps import (
    LINLOG_KNEE,
    LINLOG_SLOPE,
    LOG_EPS_DN,
    lin_log,
    lin_log_inverse,
)

Array = jax.Array
LEAST_DN = 0.1  # of light, before a logarithm of measured pixels


@dataclasses.dataclass(frozen=True)
class Logarithm:
    """Of the light that pixels see, DN + offset_dn.

    offset_dn: light beside that of the frames, DN. log_map: "linlog" and "log_eps" as of a
    `SensorModel`, with the light held above LEAST_DN where there is an offset; "log": the plain
    logarithm, as published systems have it.
    """

    offset_dn: float = 0.0
    log_map: Literal["linlog", "log_eps", "log"] = "linlog"

    def of(self, dn: ArrayLike) -> Array:
        """Log intensity of DN 0..255."""
        light = self._light(dn)
        if self.log_map == "linlog":
            return lin_log(light)
        return jnp.log(light + self._more)

    def dn(self, log: ArrayLike) -> Array:
        """The inverse of `of`; below black it goes on to negative DN."""
        log = jnp.asarray(log)
        light = lin_log_inverse(log) if self.log_map == "linlog" else jnp.exp(log) - self._more
        return light - self.offset_dn

    def slope(self, dn: ArrayLike) -> Array:
        """d log / d DN of `of`."""
        light = self._light(dn)
        if self.log_map == "linlog":
            return jnp.where(light <= LINLOG_KNEE, LINLOG_SLOPE,
                             1.0 / jnp.maximum(light, LINLOG_KNEE))
        return 1.0 / (light + self._more)

    @property
    def _more(self) -> float:
        return LOG_EPS_DN if self.log_map == "log_eps" else 0.0

    def _light(self, dn: ArrayLike) -> Array:
        dn = jnp.asarray(dn)
        dn = dn if jnp.issubdtype(dn.dtype, jnp.floating) else dn.astype(jnp.float32)
        if not self.offset_dn:
            return dn
        light = dn + self.offset_dn
        return light if self.log_map == "log" else jnp.maximum(light, LEAST_DN)


LIN_LOG = Logarithm()
