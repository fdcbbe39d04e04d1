"""The network behind api.py: its static structure, its parts, and their joint pass over pixels.

Everything per pixel is a function of (voxels, dlogI, context, y of the camera's summary) on any
leading axes; nothing here combines pixels (see pooling.py).
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from evflow.checks import need
from evflow.errors import EvflowDataError
from evflow.network import encoder, flow, pooling
from evflow.network.config import MODELS, ModelConfig
from evflow.network.coordinates import SCALE, per_channel, squash, squash_summary
from evflow.network.encoder import IntensityEncoder

Array = jax.Array
Params = dict[str, Any]


class SpreadNet(nn.Module):
    """Log standard deviation of y (..., 4), from the pixel's features and the condition."""

    hidden: int

    @nn.compact
    def __call__(self, x: Array) -> Array:
        x = nn.relu(nn.Dense(self.hidden)(x))
        x = nn.relu(nn.Dense(self.hidden)(x))
        return jnp.clip(nn.Dense(4)(x) - 1.0, -5.0, 2.0)


def config_of(params: Params) -> ModelConfig:
    """The static structure of params, from their name and the sizes of their leaves."""
    need(params, dict, "params", "Pass the result of load_weights().")
    if len(params) != 1 or next(iter(params)) not in MODELS:
        raise EvflowDataError(
            "EV018", f"params have the top-level keys {sorted(params)}.",
            f"Expected exactly one of {sorted(MODELS)}, as load_weights() returns.")
    name, net = next(iter(params.items()))
    base = MODELS[name]
    missing = {"encoder", "flow", *(("spread",) if base.spread else ())} - set(net)
    if missing:
        raise EvflowDataError("EV018", f"params[{name!r}] has no {', '.join(sorted(missing))}.",
                              "Pass the whole result of load_weights().")
    try:
        return _sized(base, net)
    except (KeyError, TypeError, AttributeError, IndexError) as e:
        raise EvflowDataError("EV018", f"params[{name!r}] do not fit the network: {e} is "
                              "missing or not an array.", "Pass the whole result of load_weights()."
                              ) from e


def _sized(base: ModelConfig, net: Params) -> ModelConfig:
    """The structure with the sizes taken from the leaves. EV018 if these have one axis more."""
    if (axes := net["encoder"]["Dense_0"]["kernel"].ndim) != 2:
        raise EvflowDataError(
            "EV018", f"params have {axes - 2} leading axes, as of several networks.",
            "Use jax.vmap over them: jax.vmap(estimate, (0, None, None))(params, voxels, dlogI).")
    steps = net["flow"]["level_0"]["actnorm"]["raw"].shape[0]
    hidden = net["flow"]["level_0"]["coupling"]["w_2"].shape[-1]
    return dataclasses.replace(
        base,
        flow=dataclasses.replace(base.flow, steps=steps, hidden=hidden),
        encoder_hidden=net["encoder"]["Dense_0"]["kernel"].shape[-1],
        summary_hidden=net["summary"]["pixel"]["Dense_0"]["kernel"].shape[-1]
        if "summary" in net else base.summary_hidden,
    )


def _outputs(config: ModelConfig) -> int:
    return 1 if config.code == "feature" else 2


def encoder_features(
    config: ModelConfig, voxels: Array, dlogI: Array, context: Array, y: Array
) -> Array:
    """Encoder input: the paper's [E, dlogI], or ours with the contrast that the events carry at the
    camera's thresholds, theta_on E_on and theta_off E_off."""
    if config.code == "feature":
        return jnp.concatenate([voxels, dlogI[..., None]], -1)
    camera = squash(y[..., :4])
    on, off = jnp.split(voxels, 2, -1)
    on, off = on * camera.theta_on[..., None], off * camera.theta_off[..., None]
    missing = dlogI - on.sum(-1) + off.sum(-1)
    seen = pooling.pixel_features(voxels, dlogI, context)
    return jnp.concatenate(
        [seen, jnp.arcsinh(10.0 * on), jnp.arcsinh(10.0 * off), 5.0 * missing[..., None], y], -1)


def encode_changes(
    config: ModelConfig, net: Params, voxels: Array, dlogI: Array, context: Array, y: Array
) -> tuple[Array, Array]:
    """Per-pixel changes (..., 2m or feature) and their logits (..., outputs, m)."""
    features = encoder_features(config, voxels, dlogI, context, y)
    outputs: Any = IntensityEncoder(config, _outputs(config)).apply(
        {"params": net["encoder"]}, features)
    logits, hidden = outputs
    return hidden if config.code == "feature" else encoder.changes_of_logits(logits), logits


def condition(config: ModelConfig, changes: Array, context: Array, y: Array) -> Array:
    """u (..., condition): the expected events, the summary, the context. The paper's u is only the
    feature."""
    if config.code == "feature":
        return changes
    camera = squash(y[..., :4])
    thetas = camera.theta_on[..., None], camera.theta_off[..., None]
    return jnp.concatenate([expected_events(changes, *thetas, axis=-1), y, context], -1)


def expected_events(changes: Array, theta_on: Array, theta_off: Array, axis: int) -> Array:
    """The changes, 2m along `axis`, in units of the camera's thresholds: expected events per
    sub-window, in asinh."""
    up, down = jnp.split(changes, 2, axis)
    return jnp.concatenate([jnp.arcsinh(up / theta_on), jnp.arcsinh(down / theta_off)], axis)


def spread(net: Params, voxels: Array, dlogI: Array, context: Array, u: Array) -> Array:
    features = jnp.concatenate([pooling.pixel_features(voxels, dlogI, context), u], -1)
    hidden = net["spread"]["Dense_0"]["kernel"].shape[-1]
    log_std: Any = SpreadNet(hidden).apply({"params": net["spread"]}, features)
    return jnp.exp(log_std)


def centre(config: ModelConfig, y: Array) -> Array:
    """The origin of the flow's y: the camera's summary, so that the flow models the residual."""
    return y[..., :4] if config.pool else jnp.zeros_like(y[..., :4])


def init(key: Array, config: ModelConfig, name: str = "default") -> Params:
    """New params (the flow's actnorms still need `flow.data_init`)."""
    k_summary, k_encoder, k_spread, k_flow = jax.random.split(key, 4)
    shape = (1, 1)
    voxels, dlogI = jnp.zeros((*shape, 2 * config.bins)), jnp.zeros(shape)
    context, y = jnp.zeros((*shape, 3)), jnp.zeros((*shape, 6))
    features = encoder_features(config, voxels, dlogI, context, y)
    net = {
        "encoder": IntensityEncoder(config, _outputs(config)).init(k_encoder, features)["params"],
        "flow": flow.init(k_flow, config.flow),
    }
    if config.spread:
        seen = pooling.pixel_features(voxels, dlogI, context)
        wide = jnp.zeros((*shape, seen.shape[-1] + config.flow.condition))
        net["spread"] = SpreadNet(config.flow.hidden).init(k_spread, wide)["params"]
    if config.pool:
        net["summary"] = pooling.init(k_summary, config)
    return {name: net}


def base_std(summary_y: Array) -> Array:
    """Standard deviation (..., 4) of y around the summary: the mismatch sigma/theta, and 0.3
    in log eta. Floored, so that a camera without mismatch still has a density."""
    known = squash_summary(summary_y)
    theta = jnp.stack([known.sigma_on / known.theta_on, known.sigma_off / known.theta_off], -1)
    theta = jnp.sqrt(theta**2 + 0.05**2)
    spread = jnp.concatenate([theta, jnp.full_like(theta, 0.3)], -1)
    return spread / per_channel(SCALE, spread)


def log_normal(x: Array, mean: Array | float, std: Array | float) -> Array:
    """Log density of N(mean, std^2), element-wise."""
    return -0.5 * ((x - mean) / std) ** 2 - jnp.log(std) - 0.5 * math.log(2 * math.pi)


def over_pixels(y: Array, shape: tuple[int, ...]) -> Array:
    """(..., C) of a camera -> (..., H, W, C)."""
    return jnp.broadcast_to(y[..., None, None, :], (*shape, y.shape[-1]))
