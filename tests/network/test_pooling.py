"""The camera summary's standard deviations, by hand."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from evflow.network import pooling
from evflow.network.config import ModelConfig

CONFIG = ModelConfig(summary_hidden=4, summary_features=2, rate_features=2, gates=1)


@pytest.mark.parametrize("amount", [1.0, 50.0])
def test_the_variance_falls_with_signal_pixels_and_exposure_to_a_rest(amount: float) -> None:
    """A network that says nothing gives e^-2 per unit of data and e^-2 for the rest."""
    shapes = jax.eval_shape(lambda: pooling.init(jax.random.key(0), CONFIG))
    silent = jax.tree.map(lambda s: jnp.zeros(s.shape), shapes)
    active, seconds = 400.0 * amount, 30.0 * amount
    stats = pooling.Stats(
        active=jnp.zeros(2), rates=jnp.ones(2), normal=jnp.zeros((1, 5)),
        balance=jnp.zeros((1, 2, 3)), pixels=jnp.float32(800.0),
        pixels_active=jnp.float32(active), exposure=jnp.float32(seconds),
        events_on=jnp.float32(900.0), events_off=jnp.float32(700.0))
    mean, std = jax.jit(lambda s: pooling.finish(CONFIG, silent, s))(stats)
    signal, quiet = 1000.0 / (active + 1.0), 100.0 / seconds
    scale = np.array([signal, signal, quiet, quiet, signal, signal])
    np.testing.assert_array_equal(mean, np.zeros(6))
    np.testing.assert_allclose(std, np.exp(-2.0) * np.sqrt(scale + 1.0), rtol=1e-5)
