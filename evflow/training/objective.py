"""The objective on one batch: forward and inverse losses (Eq. 11), part by part."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from evflow.network import architecture, encoder, flow, pooling
from evflow.network.coordinates import (
    Output,
    squash,
    squash_summary,
    unsquash,
    unsquash_summary,
)
from evflow.network.pooling import Stats
from evflow.process.devices import by_shard
from evflow.training import losses
from evflow.training.batch import Batch
from evflow.training.config import LossConfig, TrainConfig

Array = jax.Array
Metrics = dict[str, Array]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Block:
    """The pixels that the flow sees: one block (B, h, w) of one window of each sequence.
    changes (B, h, w, m); context (B, h, w, 3); y: true parameters (B, h, w, 4)."""

    voxels: Array
    dlogI: Array
    changes: Array
    context: Array
    y: Array


def cut_block(key: Array, batch: Batch, config: TrainConfig) -> Block:
    """A random block of pixels from a random window of each sequence."""
    h, w = config.block
    context = pooling.window_features(
        batch.window_s[:, None, None, None], batch.intensity, batch.dlogI.shape)
    y = jnp.broadcast_to(unsquash(batch.camera, config.model.output)[:, None],
                         (*batch.dlogI.shape, 4))

    def cut(key: Array, *arrays: Array) -> list[Array]:
        k_window, k_row, k_column = jax.random.split(key, 3)
        windows, rows, columns = arrays[0].shape[:3]
        start = (jax.random.randint(k_window, (), 0, windows),
                 jax.random.randint(k_row, (), 0, rows - h + 1),
                 jax.random.randint(k_column, (), 0, columns - w + 1))
        return [jax.lax.dynamic_slice(
            a, (*start, *(0,) * (a.ndim - 3)), (1, h, w, *a.shape[3:]))[0] for a in arrays]

    keys = jax.random.split(key, batch.dlogI.shape[0])
    return Block(*jax.vmap(cut)(keys, batch.voxels, batch.dlogI, batch.changes, context, y))


def over(y: Array, like: Array) -> Array:
    """(B, C) -> (B, h, w, C)."""
    return jnp.broadcast_to(y[:, None, None], (*like.shape[:-1], y.shape[-1]))


def summary_losses(
    net: dict[str, Any], batch: Batch, key: Array, config: TrainConfig
) -> tuple[Array, Array, Metrics]:
    """Estimate each camera from the first 1..W windows (drawn per sequence, so that `finish` is
    trained on little and much data). Returns the loss, y (B, 6) and metrics."""
    count, windows = batch.dlogI.shape[:2]
    k_windows, k_intensity = jax.random.split(key)
    known = jax.random.bernoulli(k_intensity, 0.5, (count, 1, 1, 1))
    intensity = jnp.where(known, batch.intensity, jnp.nan)  # unknown in half of them
    stats = _pool_windows(net["summary"], batch, intensity, config)
    used = jax.random.randint(k_windows, (count, 1), 1, windows + 1)
    keep = (jnp.arange(windows)[None] < used).astype(jnp.float32)

    def add(leaf: Array) -> Array:
        return jnp.einsum("bw,bw...->b...", keep, leaf, precision="highest")

    total: Stats = jax.tree.map(add, stats)
    y, y_std = pooling.finish(config.model, net["summary"], total)
    target = unsquash_summary(batch.nominal)
    loss = losses.summary_loss(y, y_std, target).mean()
    seen = squash_summary(y)
    names = ("theta_on", "theta_off", "eta_on", "eta_off")
    metrics = {f"summary/{n}": jnp.abs(getattr(seen, n) - getattr(batch.nominal, n)).mean()
               for n in names}
    return loss, y, metrics


def _pool_windows(
    net: dict[str, Any], batch: Batch, intensity: Array, config: TrainConfig
) -> Stats:
    """Stats (B, W), window by window and recomputed in the backward pass: activations of one
    window stay in cache (gradient of 48 windows of 64x64: .23 s against .82 s at once)."""
    window_s = jnp.broadcast_to(batch.window_s[:, None], batch.dlogI.shape[:2])

    def pool(net: dict[str, Any], arrays: tuple[Array, ...]) -> Stats:
        lead = arrays[0].shape[:2]
        flat = tuple(a.reshape(-1, *a.shape[2:]) for a in arrays)
        one = jax.checkpoint(lambda window: pooling.pool(config.model, net, *window))
        return jax.tree.map(lambda a: a.reshape(*lead, *a.shape[1:]), jax.lax.map(one, flat))

    return by_shard(pool)(net, (batch.voxels, batch.dlogI, window_s, intensity))


def pixel_losses(
    net: dict[str, Any], block: Block, known: Array, seen: Array, key: Array, config: TrainConfig
) -> tuple[Metrics, Metrics]:
    """Losses of encoder, flow in both directions and spread.

    known, seen: the true and the estimated summary y (B, 6). Even scenes run on the true
    code and summary, odd ones on the predicted: otherwise the flow fitted to predicted codes
    and its inverse at true codes would be two different maps. Events are made of true codes only.
    """
    c = config.model
    even = (jnp.arange(known.shape[0]) // config.cameras % 2 == 0)[:, None]
    y6 = over(jnp.where(even, known, seen), block.y)
    predicted, logits = architecture.encode_changes(
        c, net, block.voxels, block.dlogI, block.context, y6)
    parts = {"condition": losses.condition_loss(
        logits, encoder.targets(c, block.changes)).mean()}
    changes = predicted
    if c.code == "changes":
        parts["change_l1"] = _change_loss(predicted, block.changes)
        # The encoder is trained on true changes only: features that serve the flow better are no
        # changes of intensity, which a video could supply.
        changes = jnp.where(even[:, None, None], encoder.split_sign(block.changes),
                            jax.lax.stop_gradient(predicted))
    if config.parts == ("encoder",) and c.code == "changes":
        return parts, {}
    flow_parts, metrics = _flow_losses(net, block, changes, y6, even, key, config)
    return parts | flow_parts, metrics


def _change_loss(predicted: Array, changes: Array) -> Array:
    """Charbonnier loss of rises and falls in each part of the window, and of their sum."""
    up, down = jnp.split(predicted, 2, -1)
    off = jnp.cumsum(up - down - changes, -1)
    return (losses.charbonnier(predicted - encoder.split_sign(changes)).mean()
            + losses.charbonnier(off).mean())


def _flow_losses(
    net: dict[str, Any], block: Block, changes: Array, y6: Array, even: Array, key: Array,
    config: TrainConfig,
) -> tuple[Metrics, Metrics]:
    """Losses of the flow at the given changes, forward and inverse, and of the spread."""
    c, flow_config = config.model, config.model.flow
    k_dequantise, k_latent = jax.random.split(key)
    u = architecture.condition(c, changes, block.context, y6)
    centre = architecture.centre(c, y6)
    # L_P uses the pass with the small noise that keeps L_F finite on zero-inflated counts: a second
    # pass on clean voxels would cost another third of the step.
    noise = config.loss.dequantise * jax.random.normal(k_dequantise, block.voxels.shape)
    y, z, log_det = flow.forward(net["flow"], block.voxels + noise, u, flow_config)
    y = y + centre
    latent = jax.random.normal(k_latent, z.shape)
    plain = dataclasses.replace(flow_config, asinh=False)  # stops before sinh, which can overflow
    generated, inverse_det = flow.inverse(net["flow"], block.y - centre, latent, u, plain)
    if not flow_config.asinh:
        generated = jnp.arcsinh(generated)
    # Events are generated from the true changes. Those of the encoder contain a pixel's excess of
    # events, so that the flow would learn to use its thresholds less.
    share = (even[:, 0] / jnp.mean(even, dtype=block.y.dtype) if c.code == "changes"
             else jnp.ones(()))
    parts = {
        "parameter": _parameter_loss(y, block, config),
        "flow": losses.flow_loss(
            architecture.log_normal(y, y6[..., :4], architecture.base_std(y6)).sum(-1) if c.pool
            else jnp.zeros(log_det.shape),
            architecture.log_normal(z, 0.0, jnp.ones(())).sum(-1), log_det).mean(),
        "event": (share * _event_loss(generated, block, config)).mean(),
        "inverse_flow": losses.inverse_flow_loss(inverse_det).mean(),
    }
    if c.spread:
        spread = architecture.spread(net, block.voxels, block.dlogI, block.context, u)
        nll = losses.gaussian_nll(jax.lax.stop_gradient(y) - block.y, spread).mean((1, 2, 3))
        odd = jnp.maximum(jnp.mean(~even, dtype=nll.dtype), 1e-6)  # 0 of a single scene
        parts["spread"] = jnp.where(even[:, 0], 0.0, nll / odd).mean()
    return parts, {"pixel/y": jnp.abs(y - block.y).mean(), "max_z": jnp.abs(z).max()}


def _event_loss(generated: Array, block: Block, config: TrainConfig) -> Array:
    """L_E of each block, (B,)."""
    expected, loss = _expected(block, config.model.output), config.loss
    if loss.events == "rate":
        return losses.rate_loss(generated, block.voxels, expected, loss.patches)
    # Mean log intensity of the two frames, about the middle.
    strength = (block.changes.sum(-1) if loss.edges == "change"
                else losses.gradient(block.context[..., 1]))
    return losses.event_loss(generated, block.voxels, strength, expected, loss)


def _expected(block: Block, output: Output) -> Array:
    """Expected events per bin, (B, h, w, 2m): a pixel's changes over its thresholds, plus noise.
    output: of the network, whose coordinates block.y are."""
    camera = squash(block.y, output)
    up, down = jnp.split(encoder.split_sign(block.changes), 2, -1)
    bins = block.changes.shape[-1]
    bin_s = pooling.WINDOW_S * jnp.exp(block.context[..., 0]) / bins
    on = up / camera.theta_on[..., None] + (camera.eta_on * bin_s)[..., None]
    off = down / camera.theta_off[..., None] + (camera.eta_off * bin_s)[..., None]
    return jnp.concatenate([on, off], -1)


def _parameter_loss(y: Array, block: Block, config: TrainConfig) -> Array:
    confidence: Array | float = 1.0
    if config.loss.confidence:
        confidence = losses.confidence_weight(block.voxels)[:, None, None]
    if config.model.output == "tanh":
        return losses.parameter_loss(jnp.tanh(y), jnp.tanh(block.y), confidence).mean()
    return losses.parameter_loss(y, block.y, confidence).mean()


def total_loss(parts: Metrics, weights: LossConfig) -> Array:
    """L_forward + L_inverse (Eq. 11). L_I enters both directions in the paper; once here, with
    its weight, 2 where it counts in both. Adaptive scaling keeps each part within 0..10."""
    total = jnp.zeros(())
    for name, part in parts.items():
        scale = losses.adaptive_weight(part) if weights.adaptive else 1.0
        total += getattr(weights, name) * scale * part
    return total


def loss_fn(
    params: dict[str, Any], batch: Batch, key: Array, config: TrainConfig
) -> tuple[Array, Metrics]:
    """The whole objective on one batch, and its parts."""
    net = next(iter(params.values()))
    k_block, k_summary, k_pixels = jax.random.split(key, 3)
    known = unsquash_summary(batch.nominal)
    parts: Metrics = {}
    metrics: Metrics = {}
    if "summary" in config.parts:
        parts["summary"], y, metrics = summary_losses(net, batch, k_summary, config)
        seen = jax.lax.stop_gradient(y)
    else:
        seen = known + config.summary_noise * jax.random.normal(k_summary, known.shape)
    if set(config.parts) - {"summary"}:
        block = cut_block(k_block, batch, config)
        pixel_parts, pixel_metrics = pixel_losses(net, block, known, seen, k_pixels, config)
        parts |= pixel_parts
        metrics |= pixel_metrics
    total = total_loss(parts, config.loss)
    return total, {"loss": total, **{f"loss/{k}": v for k, v in parts.items()}, **metrics}
