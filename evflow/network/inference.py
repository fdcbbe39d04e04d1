"""The network on all pixels of images whose camera is known: the inner part of `estimate`.

Optimised for CPUs. Pixels are columns, weights are folded beforehand, and what all pixels of an
image share (the camera's summary and usually the context) goes into the biases.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from evflow.network import architecture, encoder, flow
from evflow.network.architecture import Params
from evflow.network.config import ModelConfig
from evflow.network.coordinates import squash
from evflow.process import chunks

Array = jax.Array


def estimate(
    config: ModelConfig, net: Params, voxels: Array, dlogI: Array, context: Array, y6: Array
) -> tuple[Array, Array]:
    """y and its std (..., H, W, 4) from voxels (..., H, W, 32), dlogI (..., H, W), the camera's y6
    (..., 6), and context (..., H, W, 3) or, if it is the same everywhere, (..., 1, 1, 3). The std
    is NaN if the network does not estimate it."""
    inputs, pixels = (net, voxels, dlogI, context, y6), math.prod(dlogI.shape[-2:])
    shares = chunks.executions(pixels, inputs)
    results = chunks.at_once([
        partial(_share, *inputs, i, shares=shares, config=config) for i in range(shares)])
    y, std = (chunks.joined(r, pixels) for r in zip(*results, strict=True))
    return y.reshape(*dlogI.shape, 4), std.reshape(*dlogI.shape, 4)


@partial(jax.jit, static_argnames=("config", "shares"))
def _share(
    net: Params, voxels: Array, dlogI: Array, context: Array, y6: Array, share: Any, *,
    shares: int, config: ModelConfig,
) -> tuple[Array, Array]:
    """y and its std, (images, n, 4), for n pixels of every image from number share * n on; the last
    share starts early enough to have n, too."""
    images, pixels = math.prod(dlogI.shape[:-2]), math.prod(dlogI.shape[-2:])
    size = -(-pixels // shares)
    start = jnp.minimum(share * size, pixels - size)

    def part(a: Array, channels: int) -> Array:
        rows = a.reshape(images, -1, channels)
        if rows.shape[1] < pixels:
            return rows
        return jax.lax.dynamic_slice_in_dim(rows, start, size, 1)

    folded = {**net, "encoder": encoder.fold(net["encoder"]),
              "flow": flow.fold(net["flow"], config.flow)}
    inputs = (part(voxels, 2 * config.bins), part(dlogI, 1), part(context, 3),
              y6.reshape(images, 6))
    return jax.lax.map(lambda a: _image(config, folded, *a, alone=shares == 1), inputs)


def _image(
    config: ModelConfig, folded: Params, voxels: Array, dlogI: Array, context: Array, y: Array, *,
    alone: bool,
) -> tuple[Array, Array]:
    """One image: voxels (n, 32), dlogI (n, 1), context (n, 3) or (1, 3), y (6,) -> (n, 4) each."""
    same = len(context) < len(voxels)
    if config.code == "changes":
        known = jnp.concatenate([y, context[0]]) if same else y
        folded = {**folded, "flow": flow.settle(folded["flow"], known, 2 * config.changes)}

    rows, shared = {"voxels": voxels, "dlogI": dlogI}, {"y": y}
    (shared if same else rows)["context"] = context
    # The backward pass recomputes each chunk: stored for all pixels it would take 250 kB each.
    chunk = jax.checkpoint(lambda rows: _chunk(config, folded, **rows, **shared), prevent_cse=False)
    return chunks.by_platform(chunk, rows, alone=alone)


def _chunk(
    config: ModelConfig, folded: Params, voxels: Array, dlogI: Array, context: Array, y: Array
) -> tuple[Array, Array]:
    """voxels (n, 32), dlogI (n, 1), context (n, 3) or (1, 3), y (6,) -> y and std (n, 4)."""
    n, same, dlogI = len(voxels), len(context) < len(voxels), dlogI[:, 0]
    ys, contexts = jnp.broadcast_to(y, (n, 6)), jnp.broadcast_to(context, (n, 3))
    features = architecture.encoder_features(config, voxels, dlogI, contexts, ys)
    feature = encoder.feature_columns(folded["encoder"], features.T)
    if config.code == "feature":
        u, full = feature, feature.T
    else:
        camera = squash(y[:4])
        changes = encoder.change_columns(folded["encoder"], feature, config)
        u = architecture.expected_events(changes, camera.theta_on, camera.theta_off, axis=0)
        full = jnp.concatenate([u.T, ys, contexts], 1)
        u = u if same else jnp.concatenate([u, contexts.T])
    residual, _ = flow.forward_columns(folded["flow"], voxels.T, u, config.flow)
    y = residual.T + architecture.centre(config, ys)
    if not config.spread:
        return y, jnp.full_like(y, jnp.nan)
    return y, architecture.spread(folded, voxels, dlogI, contexts, full)
