"""Weighted statistics: identical pixels go through the network once, weighted by their number.

For callers on the host that know which pixels are identical; nothing is checked.
"""

from __future__ import annotations

import functools
import operator
from functools import partial

import jax
import numpy as np

from evflow.light.log_maps import mean_and_change
from evflow.network import pooling
from evflow.network.architecture import Params
from evflow.network.config import ModelConfig
from evflow.network.pooling import Stats
from evflow.network.summary import pooling_parts
from evflow.process.chunks import HUGE, LARGE, on_cpu

Array = jax.Array


def summarize_weighted(
    params: Params, voxels: np.ndarray, frames: np.ndarray, weight: np.ndarray, window_s: float
) -> Stats:
    """Stats as from `summarize`, float32: voxels (k, 2B) of the first k pixels (the others have no
    events); frames (n, 2), each pixel's DN in the window's two frames; weight (n,)."""
    config, net = pooling_parts(params)
    size, n = LARGE if on_cpu(params) else HUGE, len(weight)
    parts = []
    for start in range(0, n, size):
        end = min(start + size, n)
        events = np.zeros((1, size, 2 * config.bins), np.float32)
        given = voxels[start:end]
        events[0, :len(given)] = given
        shown, counts = np.ones((2, 1, size), np.float32), np.zeros((1, size), np.float32)
        shown[:, 0, :end - start], counts[0, :end - start] = frames[start:end].T, weight[start:end]
        parts.append(_pool(net["summary"], events, shown, counts, window_s, config=config))
    return functools.reduce(operator.add, parts)


@partial(jax.jit, static_argnames="config")
def _pool(
    net: Params, voxels: Array, frames: Array, weight: Array, window_s: Array, *,
    config: ModelConfig,
) -> Stats:
    intensity, dlogI = mean_and_change(*frames)
    return pooling.pool(config, net, voxels, dlogI, window_s, intensity, weight=weight)
