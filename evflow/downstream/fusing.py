"""The element-wise part of recurrent layers, written so that XLA:CPU fuses it well.

Left alone, XLA fuses two things to their harm. A chain of cheap operations goes into each of its
users: where a state is carried by such a chain and the sequence is unrolled, the gradient of a
window is computed anew, for each of its uses, from those of all windows after it. And what is
written into a concatenation of channels is computed with a branch for every number. Values and
gradients are the plain ones, on every device; differentiable in reverse mode.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jax import lax

Array = jax.Array


@jax.custom_vjp
def carried(state: Array) -> Array:
    """The state (..., C) as it is. On a CPU its gradient goes through a product with the identity,
    the cheapest operation that XLA does not fuse."""
    return state


def _cut(_: None, cotangent: Array) -> tuple[Array]:
    def by_identity(x: Array) -> Array:
        return jnp.dot(x, jnp.eye(x.shape[-1], dtype=x.dtype), precision="highest")

    return (lax.platform_dependent(cotangent, cpu=by_identity, default=lambda x: x),)


carried.defvjp(lambda state: (state, None), _cut)


def joined(*parts: Array) -> Array:
    """Arrays (..., C_i) -> (..., their channels after one another)."""
    dtype = jnp.result_type(*parts)
    whole = jnp.zeros((*parts[0].shape[:-1], sum(part.shape[-1] for part in parts)), dtype)
    at = 0
    for part in parts:
        whole = lax.dynamic_update_slice_in_dim(whole, part.astype(dtype), at, -1)
        at += part.shape[-1]
    return whole


@partial(jax.custom_vjp, nondiff_argnums=(1,))
def parted(x: Array, parts: int) -> list[Array]:
    """x (..., N C) -> its N = `parts` equal parts (..., C)."""
    return jnp.split(x, parts, -1)


parted.defvjp(lambda x, parts: (parted(x, parts), None),
              lambda parts, _, cotangents: (joined(*cotangents),))
