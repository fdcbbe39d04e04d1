"""The networks that correct the stepped camera: their mean, and what lies outside of training."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from evflow.estimation.refine import fused
from evflow.estimation.refine.fusion import FusionNet


def small_fusion(*added: float) -> dict[str, Any]:
    """Of five features; one network for each number, which is added to all its parameters."""
    net = FusionNet().init(jax.random.key(0), jnp.zeros(5))["params"]
    nets = jax.tree.map(lambda p: jnp.stack([p + more for more in added]), net)
    return {"net": nets, "mean": jnp.zeros(5), "scale": jnp.ones(5), "low": jnp.full(5, -1.0),
            "high": jnp.ones(5), "widen": jnp.ones(6)}


def test_fusion_is_the_mean_of_its_networks() -> None:
    features, y = jnp.linspace(-1.0, 1.0, 5), jnp.zeros(6)
    (one, std), (other, wider), (both, between) = (
        fused(small_fusion(*added), features, y) for added in ((0.1,), (0.3,), (0.1, 0.3)))
    assert not np.allclose(one, other)
    np.testing.assert_allclose(both, (one + other) / 2, rtol=1e-5)
    np.testing.assert_allclose(between, jnp.sqrt(std * wider), rtol=1e-5)


def test_fusion_holds_features_inside_what_it_knows_and_is_less_sure() -> None:
    features, y, fusion = jnp.linspace(-1.0, 1.0, 5), jnp.zeros(6), small_fusion(0.1)
    inside, std = fused(fusion, features, y)
    beyond, wider = fused(fusion, features.at[-1].set(9.0), y)
    np.testing.assert_array_equal(inside, beyond)
    _, widest = fused(fusion, features.at[-1].set(9.0).at[0].set(-9.0), y)
    assert bool((std > 0).all() & (std < wider).all() & (wider < widest).all())
