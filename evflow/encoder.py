"""The intensity-change encoder (Section IV-C): events and the frames' total change ->
m intensity changes within the window, pixel by pixel.

Stage 1 is a two-layer MLP whose output is cut into m pieces; stage 2 reads each piece with a
96-96-1 MLP (two outputs here: the rising and the falling change, so the sign survives).
LayerNorm and ReLU follow each linear layer but the last (after it they would fix the output).
"""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp

from evflow.config import ModelConfig

Array = jax.Array

LOG_RANGE = 5.541263545158426  # ln 255: changes are scaled to 0..1 by log_255 e (Eq. 6)
LOGIT_BIAS = -4.0  # most changes are ~.01 of the range; sigmoid(0) = .5 would start far off


class IntensityEncoder(nn.Module):
    """(..., F) -> logits (..., outputs, m) and the hidden feature (..., m * piece)."""

    config: ModelConfig
    outputs: int

    @nn.compact
    def __call__(self, x: Array) -> tuple[Array, Array]:
        c = self.config

        def layer(x: Array, width: int) -> Array:
            return nn.relu(nn.LayerNorm()(nn.Dense(width)(x)))

        feature = layer(layer(x, c.encoder_hidden), c.changes * c.piece)
        x = feature.reshape(*feature.shape[:-1], c.changes, c.piece)
        x = layer(layer(x, c.encoder_hidden), c.encoder_hidden)
        logits = nn.Dense(self.outputs, bias_init=nn.initializers.constant(LOGIT_BIAS))(x)
        return jnp.moveaxis(logits, -1, -2), feature


def changes_of_logits(logits: Array) -> Array:
    """Logits (..., outputs, m) -> log-intensity changes (..., outputs * m), natural log."""
    changes = LOG_RANGE * nn.sigmoid(logits)
    return changes.reshape(*changes.shape[:-2], -1)


def split_sign(changes: Array) -> Array:
    """Signed changes (..., m) -> (..., 2m): [relu(+dL), relu(-dL)]."""
    return jnp.concatenate([nn.relu(changes), nn.relu(-changes)], -1)


def targets(config: ModelConfig, changes: Array) -> Array:
    """What the logits are trained for: signed changes (..., m) -> (..., outputs, m) in 0..1.

    The paper's target is the magnitude (one output); ours keeps rise and fall apart.
    """
    parts = [jnp.abs(changes)] if config.code == "feature" else [
        nn.relu(changes), nn.relu(-changes)]
    return jnp.clip(jnp.stack(parts, -2) / LOG_RANGE, 0.0, 1.0)
