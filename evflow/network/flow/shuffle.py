"""Channel shuffle: a fixed random order per step, h'[j] = h[order[j]]. Log-det 0.

The orders depend on `SEED` only. They are NumPy constants: nothing to train, save or decay.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from evflow.network.flow.config import Array, FlowConfig

SEED = 0  # part of the network, not of its initialisation


def orders(config: FlowConfig) -> tuple[np.ndarray, ...]:
    """One int32 (steps, C) array per level; every row is a permutation of the C channels."""
    # Trained weights are useless with another order, and NumPy guarantees only the raw stream of a
    # bit generator across versions, not the result of Generator.permutation.
    stream = np.random.PCG64(SEED)
    return tuple(
        np.argsort(stream.random_raw((config.steps, channels)), axis=1).astype(np.int32)
        for channels in config.level_channels
    )


def inverted(order: np.ndarray) -> np.ndarray:
    """The orders (steps, C) that undo `order`."""
    return np.argsort(order, axis=1).astype(np.int32)


def apply(h: Array, order: Array) -> Array:
    """h (C, n), order (C,) -> h[order]; `order` must be a permutation (it is not checked)."""
    return jnp.asarray(h).at[order].get(mode="promise_in_bounds", unique_indices=True)
