"""Event networks that need no training, for the tests of what uses them."""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jnp

from evflow.downstream import EVFlowNet, FireNet, Network, Trained, save_network

EVEN = 0.4  # brightness of every image of `even`
MOTION = (3.0, -1.0)  # px a window, of every pixel of `steady`


def _silent(network: Network, bias: tuple[float, ...]) -> Trained:
    """A network all of whose parameters are 0 but the last bias."""
    shapes = jax.eval_shape(lambda: network.init(jax.random.key(0), (16, 16)))
    params = jax.tree.map(lambda s: jnp.zeros(s.shape), shapes)
    params["prediction"]["conv"]["bias"] = jnp.array(bias)
    return Trained(network, params, False, {})


def even() -> Trained:
    return _silent(FireNet(base=2), (EVEN,))


def steady() -> Trained:
    return _silent(EVFlowNet(base=2), MOTION)


def saved(folder: Path, trained: Trained) -> Path:
    name = f"{type(trained.network).__name__}.safetensors"
    return save_network(folder / name, trained.network, trained.params, {})
