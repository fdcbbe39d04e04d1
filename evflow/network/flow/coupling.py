"""Conditional coupling (Eq. 5): h_A stays, h_B becomes h_B + f(h_A, u).

f is an MLP [h_A, u] -> hidden -> hidden -> C/2 with ReLU. Its last layer starts at zero, so a new
flow is linear. A is the first half of the channels, B the second. The log-det is 0 and does not
include the condition's own Jacobian: the map is a bijection in h at fixed u.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from evflow.network.flow.config import Array, FlowConfig, Params
from evflow.network.flow.dense import dense, dot, he_normal


def init(key: Array, channels: int, config: FlowConfig) -> Params:
    """One level's steps, stacked: He-normal hidden layers, zero last layer."""
    steps, half, hidden = config.steps, channels // 2, config.hidden
    fan_in = half + config.condition
    k_h, k_u, k_2 = jax.random.split(key, 3)
    return {
        # The first layer's weight in two parts: two products are faster than joining [h_A, u].
        "w_h": he_normal(k_h, (steps, half, hidden), fan_in),
        "w_u": he_normal(k_u, (steps, config.condition, hidden), fan_in),
        "b_1": jnp.zeros((steps, hidden), jnp.float32),
        "w_2": he_normal(k_2, (steps, hidden, hidden), hidden),
        "b_2": jnp.zeros((steps, hidden), jnp.float32),
        "w_3": jnp.zeros((steps, hidden, half), jnp.float32),
        "b_3": jnp.zeros((steps, half), jnp.float32),
    }


def forward(params: Params, h: Array, u: Array) -> Array:
    """h (C, n), u (condition, n) -> h (C, n)."""
    h_a, h_b = jnp.split(h, 2)
    return jnp.concatenate([h_a, h_b + _shift(params, h_a, u)])


def inverse(params: Params, h: Array, u: Array) -> Array:
    """Undo `forward`; same shapes."""
    h_a, h_b = jnp.split(h, 2)
    return jnp.concatenate([h_a, h_b - _shift(params, h_a, u)])


def _shift(params: Params, h_a: Array, u: Array) -> Array:
    """f(h_A, u), (C/2, n)."""
    first = dot(params["w_h"], h_a) + dense(params["w_u"], params["b_1"], u)
    second = dense(params["w_2"], params["b_2"], jax.nn.relu(first))
    return dense(params["w_3"], params["b_3"], jax.nn.relu(second))
