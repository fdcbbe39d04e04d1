"""Conditional injector: h exp(s(u)) + t(u), at the start of a level.

Additive couplings have the same volume at every pixel; only the injector lets it differ between
empty and active pixels. s = 2 tanh(.) and t come from one MLP u -> hidden -> 2C whose last layer
starts at zero (the identity).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from evflow.network.flow.config import Array, FlowConfig, Params
from evflow.network.flow.dense import dense, he_normal

LOG_SCALE_BOUND = 2.0  # voxels of empty pixels vary a hundredth as much as those of active ones


def init(key: Array, channels: int, config: FlowConfig) -> Params:
    """He-normal hidden layer, zero last layer."""
    return {
        "w_1": he_normal(key, (config.condition, config.hidden), config.condition),
        "b_1": jnp.zeros(config.hidden, jnp.float32),
        "w_2": jnp.zeros((config.hidden, 2 * channels), jnp.float32),
        "b_2": jnp.zeros(2 * channels, jnp.float32),
    }


def forward(params: Params, h: Array, u: Array) -> tuple[Array, Array]:
    """h (C, n), u (condition, n) -> h (C, n), log-det (n,)."""
    s, t = _scale_and_shift(params, u)
    return h * jnp.exp(s) + t, jnp.sum(s, axis=0)


def inverse(params: Params, h: Array, u: Array) -> tuple[Array, Array]:
    """Undo `forward`; same shapes, the log-det of the inverse."""
    s, t = _scale_and_shift(params, u)
    return (h - t) * jnp.exp(-s), -jnp.sum(s, axis=0)


def _scale_and_shift(params: Params, u: Array) -> tuple[Array, Array]:
    hidden = jax.nn.relu(dense(params["w_1"], params["b_1"], u))
    raw, t = jnp.split(dense(params["w_2"], params["b_2"], hidden), 2)
    return LOG_SCALE_BOUND * jnp.tanh(raw), t
