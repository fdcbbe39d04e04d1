"""The networks that correct the stepped camera: their mean, and what lies outside of training."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from evflow.camera import Summary
from evflow.estimation.refine import fused
from evflow.estimation.refine.fusion import LEAST_NOISE_HZ, FusionNet, corrected
from evflow.network.coordinates import unsquash_summary


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


@pytest.mark.parametrize("eta_off", [0.5 * LEAST_NOISE_HZ, 2.0 * LEAST_NOISE_HZ])
def test_noise_rates_below_trainings_tell_nothing_of_thresholds(eta_off: float) -> None:
    """An ideal camera without noise seemed to have thresholds 6 and 8 % too high."""
    stepped = Summary(*map(jnp.float32, (0.2, 0.3, 0.4, eta_off, 0.03, 0.03)))
    features, of_noise = jnp.linspace(-1.0, 1.0, 5), jnp.arange(5) >= 3
    fusion = {**small_fusion(0.1), "mean": jnp.full(5, 0.3)}
    seen, unseen = (fused(fusion, f, unsquash_summary(stepped))
                    for f in (features, jnp.where(of_noise, 0.3, features)))
    assert not np.isclose(seen[0], unseen[0]).any()
    y, std = corrected(fusion, features, of_noise, stepped)
    others = unseen if eta_off < LEAST_NOISE_HZ else seen
    for got, rates, rest in zip((y, std), seen, others, strict=True):
        np.testing.assert_allclose(got[2:4], rates[2:4], rtol=1e-5)
        np.testing.assert_allclose(np.delete(got, [2, 3]), np.delete(rest, [2, 3]), rtol=1e-5)
