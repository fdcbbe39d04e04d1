"""What lies between the convolutions of a recurrent layer is what it looks like, and cheap."""

from __future__ import annotations

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from evflow.downstream.fusing import carried, joined, parted
from evflow.downstream.layers import ConvGRU


def test_what_is_joined_and_parted_is_concatenated_and_split() -> None:
    a, b = jax.random.normal(jax.random.key(0), (2, 3, 4, 4, 6))
    parts, cotangent = (a, b[..., :2]), jax.random.normal(jax.random.key(1), (3, 4, 4, 8))
    whole, back = jax.vjp(joined, *parts)
    want, want_back = jax.vjp(lambda *parts: jnp.concatenate(parts, -1), *parts)
    np.testing.assert_array_equal(whole, want)
    jax.tree.map(np.testing.assert_array_equal, back(cotangent), want_back(cotangent))
    assert joined(a, b.astype(jnp.bfloat16)).dtype == jnp.float32
    pieces, back = jax.vjp(lambda x: parted(x, 4), whole)
    want, want_back = jax.vjp(lambda x: jnp.split(x, 4, -1), whole)
    weighted = [piece * weight for weight, piece in enumerate(pieces)]
    jax.tree.map(np.testing.assert_array_equal, pieces, want)
    np.testing.assert_array_equal(*(f(weighted)[0] for f in (back, want_back)))


def test_a_carried_state_and_its_gradient_are_what_they_were() -> None:
    state, cotangent = jax.random.normal(jax.random.key(0), (2, 2, 4, 4, 8))
    kept, back = jax.vjp(carried, state)
    np.testing.assert_array_equal(kept, state)
    np.testing.assert_array_equal(jax.jit(back)(cotangent)[0], cotangent)
    lowered = jax.export.export(jax.jit(lambda x, y: jax.vjp(carried, x)[1](y)),
                                platforms=["cuda"])(state, cotangent).mlir_module()
    assert "dot_general" not in lowered


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="how XLA fuses on a CPU")
def test_no_gradient_is_computed_anew_from_those_of_all_later_windows() -> None:
    """The fused operations of an unrolled sequence twice as long have twice as many operands
    (2.0 times; without `carried` 2.6 times, and 61 operands of one operation in FireNet's ten
    windows)."""
    gru, x, start = ConvGRU(), jnp.ones((12, 12, 8)), jnp.zeros((12, 12, 8))
    params = gru.init(jax.random.key(0), x, start)

    def operands(windows: int) -> int:
        def energy(params: object) -> jax.Array:
            states = [start]
            for _ in range(windows):
                states.append(gru.apply(params, x, states[-1]))  # type: ignore[arg-type]
            return jnp.sum(jnp.stack(states) ** 2)

        text = jax.jit(jax.grad(energy)).lower(params).compile().as_text()
        found = re.findall(r" fusion\((.*?)\), kind=kLoop", text)
        return sum(given.count("%") for given in found)

    assert 0 < operands(8) < 2.2 * operands(4)
