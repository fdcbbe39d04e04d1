"""The encoder on columns of pixels is the module that is trained."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.networks import drawn

from evflow.network import encoder
from evflow.network.config import ModelConfig

CONFIG = ModelConfig(changes=4, piece=6, encoder_hidden=24)


def made(module: encoder.IntensityEncoder) -> Any:
    """Params whose norms and biases lie .3 N(0, 1) about theirs."""
    shapes = jax.eval_shape(module.init, jax.random.key(1), jnp.ones((1, 10)))
    return drawn(shapes["params"], 0.3)


@pytest.mark.parametrize("outputs", [1, 2])
@pytest.mark.parametrize("changes", [4, 1])
def test_columns_are_the_module(outputs: int, changes: int) -> None:
    config = dataclasses.replace(CONFIG, changes=changes)
    module = encoder.IntensityEncoder(config, outputs)
    x = np.float32(3.0 * np.random.default_rng(0).standard_normal((50, 10)) + 1.0)
    params = made(module)

    @jax.jit
    def both(params: Any, x: jax.Array) -> Any:
        logits, feature = module.apply({"params": params}, x)
        folded = encoder.fold(params)
        got = encoder.feature_columns(folded, x.T)
        return (feature, encoder.changes_of_logits(logits)), (
            got.T, encoder.change_columns(folded, got, config).T)

    expected, columns = both(params, x)
    assert columns[1].shape == (len(x), outputs * changes)
    np.testing.assert_allclose(columns[0], expected[0], atol=2e-5)
    np.testing.assert_allclose(columns[1], expected[1], atol=5e-5)


def test_folded_layers_have_no_mean_to_take_off() -> None:
    module = encoder.IntensityEncoder(CONFIG, 2)
    params = made(module)
    folded = encoder.fold(params)
    for index in range(encoder.NORMS):
        layer = folded[f"Dense_{index}"]
        np.testing.assert_allclose(layer["kernel"].mean(-1), 0.0, atol=1e-6)
        np.testing.assert_allclose(layer["bias"].mean(), 0.0, atol=1e-6)
    last = f"Dense_{encoder.NORMS}"
    np.testing.assert_array_equal(folded[last]["kernel"], params[last]["kernel"])
