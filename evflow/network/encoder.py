"""The intensity-change encoder (Section IV-C): events and the frames' total change ->
m intensity changes within the window, pixel by pixel.

Stage 1 is a two-layer MLP whose output is cut into m pieces; stage 2 reads each piece with a
96-96-1 MLP (two outputs here: the rising and the falling change, so the sign survives).
LayerNorm and ReLU follow each linear layer except the last.

For inference `fold`, `feature_columns` and `change_columns` compute the same on columns of pixels,
(C, n): sums over channels then add whole rows, and a piece of the feature is a block of rows. With
the means folded into the weights a 346x260 frame takes .38 s of one core, otherwise .58 s.
"""

from __future__ import annotations

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from evflow.network.config import ModelConfig
from evflow.network.flow.dense import dense

Array = jax.Array
Params = dict[str, Any]

LOG_RANGE = 5.541263545158426  # ln 255: changes are scaled to 0..1 by log_255 e (Eq. 6)
LOGIT_BIAS = -4.0  # most changes are ~.01 of the range; starting at sigmoid(0) = .5 is far off
NORMS, NORM_EPSILON = 4, 1e-6  # LayerNorms, after all layers except the last


class IntensityEncoder(nn.Module):
    """(..., F) -> logits (..., outputs, m) and the hidden feature (..., m * piece)."""

    config: ModelConfig
    outputs: int

    @nn.compact
    def __call__(self, x: Array) -> tuple[Array, Array]:
        c = self.config

        def layer(x: Array, width: int) -> Array:
            return nn.relu(nn.LayerNorm(NORM_EPSILON)(nn.Dense(width)(x)))

        feature = layer(layer(x, c.encoder_hidden), c.changes * c.piece)
        x = feature.reshape(*feature.shape[:-1], c.changes, c.piece)
        x = layer(layer(x, c.encoder_hidden), c.encoder_hidden)
        logits = nn.Dense(self.outputs, bias_init=nn.initializers.constant(LOGIT_BIAS))(x)
        return jnp.moveaxis(logits, -1, -2), feature


def fold(params: Params) -> Params:
    """Params for the functions on columns. Layers that a LayerNorm follows give outputs without
    their mean, which the norm would subtract."""
    folded = dict(params)
    for index in range(NORMS):
        folded[f"Dense_{index}"] = jax.tree.map(
            lambda a: a - a.mean(-1, keepdims=True), params[f"Dense_{index}"])
    return folded


def feature_columns(folded: Params, x: Array) -> Array:
    """x (F, n) -> the hidden feature (m * piece, n)."""
    return _norm_columns(folded, 1, _norm_columns(folded, 0, x))


def change_columns(folded: Params, feature: Array, config: ModelConfig) -> Array:
    """feature (m * piece, n) -> log-intensity changes (outputs * m, n), natural log; in pieces,
    because the activations of all of them would not fit the cache."""
    last = folded[f"Dense_{NORMS}"]

    def logits(piece: Array) -> tuple[Array, ...]:
        x = _norm_columns(folded, 3, _norm_columns(folded, 2, piece))
        return tuple(dense(last["kernel"], last["bias"], x))

    pieces = feature.reshape(config.changes, config.piece, -1)
    return LOG_RANGE * nn.sigmoid(jnp.concatenate(jax.lax.map(logits, pieces)))


def _norm_columns(folded: Params, index: int, x: Array) -> Array:
    """Linear layer, LayerNorm, ReLU: x (i, n) -> (o, n)."""
    layer, norm = folded[f"Dense_{index}"], folded[f"LayerNorm_{index}"]
    x = dense(layer["kernel"], layer["bias"], x)
    scale = jax.lax.rsqrt(jnp.mean(x * x, 0, keepdims=True) + NORM_EPSILON)
    return nn.relu(x * (scale * norm["scale"][:, None]) + norm["bias"][:, None])


def changes_of_logits(logits: Array) -> Array:
    """Logits (..., outputs, m) -> log-intensity changes (..., outputs * m), natural log."""
    changes = LOG_RANGE * nn.sigmoid(logits)
    return changes.reshape(*changes.shape[:-2], -1)


def split_sign(changes: Array) -> Array:
    """Signed changes (..., m) -> (..., 2m): [relu(+dL), relu(-dL)]."""
    return jnp.concatenate([nn.relu(changes), nn.relu(-changes)], -1)


def targets(config: ModelConfig, changes: Array) -> Array:
    """Training targets of the logits: signed changes (..., m) -> (..., outputs, m) in 0..1.

    The paper's target is the magnitude (one output); ours separates rise and fall.
    """
    parts = [jnp.abs(changes)] if config.code == "feature" else [
        nn.relu(changes), nn.relu(-changes)]
    return jnp.clip(jnp.stack(parts, -2) / LOG_RANGE, 0.0, 1.0)
