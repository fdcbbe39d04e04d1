"""The small networks whose mean corrects the stepped camera (fit.py) and gives its std.

They learn from simulated recordings of cameras as they may be: what the steps leave, given the
remaining differences between recorded and simulated events, how much was seen, and what the search
for the photoreceptor says (path_signs.py). Networks that begin with other values differ by about
1 % of theta.
"""

from __future__ import annotations

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from evflow.camera import Summary
from evflow.network.coordinates import unsquash_summary

Array = jax.Array

# Relative increase of the variance for each feature outside of training's range; measured on
# recordings of up to 8 s.
VARIANCE_PER_OUTLIER_FEATURE = 0.04


class FusionNet(nn.Module):
    """features (F,) -> correction of y (6,) and log std of y (6,): a linear map and one small
    hidden layer, as it learns from only some thousand recordings."""

    width: int = 64

    @nn.compact
    def __call__(self, x: Array) -> tuple[Array, Array]:
        hidden = nn.relu(nn.Dense(self.width)(x))
        out = nn.Dense(12, kernel_init=nn.initializers.zeros)(jnp.concatenate([hidden, x], -1))
        return out[..., :6], out[..., 6:] - 1.0


@jax.jit
def corrected(
    fusion: dict[str, Any], features: Array, stepped: Summary
) -> tuple[Array, Array]:
    """y (6,) of the stepped summary, corrected by the fusion, and its std."""
    return fused(fusion, features, unsquash_summary(stepped))


def fused(fusion: dict[str, Any], features: Array, y: Array) -> tuple[Array, Array]:
    """Correct y (..., 6) by the fusion, the mean of its networks; returns it and its std.

    Features outside of training's range are clipped to it (a longer recording counts as the
    longest in training) and widen the std.
    """
    inside = jnp.clip(features, fusion["low"], fusion["high"])
    beyond = (inside != features).sum(-1, keepdims=True)
    scaled = (inside - fusion["mean"]) / fusion["scale"]

    def output(net: Any) -> Any:
        return FusionNet().apply({"params": net}, scaled)

    correction, log_std = (v.mean(0) for v in jax.vmap(output)(fusion["net"]))
    return y + correction, (
        jnp.exp(log_std) * fusion["widen"] * jnp.sqrt(1.0 + VARIANCE_PER_OUTLIER_FEATURE * beyond))
