"""The network: events <-> camera parameters, given the change of intensity.

params is a plain nested dict {architecture name: {"summary", "encoder", "spread", "flow"}} of
arrays; everything static follows from the name (config.MODELS) and the leaves' shapes, so
`estimate(params, voxels, dlogI)` needs nothing else and passes through jit, vmap and grad.

    summarize -> Stats -> finish -> Summary          all pixels pooled: the camera
    encode    -> Code                                 per pixel: the condition of the flow
    forward   : voxels -> (y, z) at fixed code        an exact bijection (Eqs. 3-5)
    inverse   : (y, z) -> voxels at fixed code

Shapes: voxels (..., H, W, 32), dlogI (..., H, W); pooling is over (H, W) only. Keyword-only
conditions: window_s, seconds, default .05, a float or (...,); intensity, mean log intensity
(lin-log of DN), (..., H, W), optional.
"""

from __future__ import annotations

import dataclasses
import math
from functools import partial
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from evflow import encoder, flow
from evflow import summary as pooling
from evflow.camera import Camera, Summary
from evflow.config import MODELS, ModelConfig
from evflow.encoder import IntensityEncoder
from evflow.errors import EvflowDataError
from evflow.squash import (
    SCALE,
    camera_std,
    per_channel,
    squash,
    squash_summary,
    summary_std,
    unsquash,
    unsquash_summary,
)
from evflow.summary import Stats

__all__ = [
    "Code", "Stats", "architecture", "code_from_video", "encode", "estimate", "estimate_with_std",
    "finish", "forward", "generate", "init", "inverse", "log_prob", "squash", "summarize",
    "unsquash",
]

Array = jax.Array
Params = dict[str, Any]

DEFAULT_WINDOW_S = 0.05
CHUNK = 2048  # pixels at a time: 16 x 96 encoder activations of a frame would take 550 MB


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Code:
    """The condition of the flow.

    changes: (..., H, W, 2m) relu(+dL_j), relu(-dL_j), natural log (the paper's preset: the
    encoder's feature); summary: of the camera, (...,); context: (..., H, W, 3) window length
    and intensity.
    """

    changes: Array
    summary: Summary
    context: Array


class SpreadNet(nn.Module):
    """Log standard deviation of y (..., 4) from what a pixel shows and the condition."""

    hidden: int

    @nn.compact
    def __call__(self, x: Array) -> Array:
        x = nn.relu(nn.Dense(self.hidden)(x))
        x = nn.relu(nn.Dense(self.hidden)(x))
        return jnp.clip(nn.Dense(4)(x) - 1.0, -5.0, 2.0)


def architecture(params: Params) -> ModelConfig:
    """The static structure behind params: its name, and the sizes of its leaves."""
    if len(params) != 1 or next(iter(params)) not in MODELS:
        raise EvflowDataError(
            "EV018", f"params have the top-level keys {sorted(params)}.",
            f"Expected exactly one of {sorted(MODELS)}, as load_weights() returns.")
    name, net = next(iter(params.items()))
    base = MODELS[name]
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


def _encoder_features(
    config: ModelConfig, voxels: Array, dlogI: Array, context: Array, y: Array
) -> Array:
    """Encoder input: the paper's [E, dlogI], or ours with the contrast that the events carry
    if the thresholds are the camera's, theta_on E_on and theta_off E_off."""
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
    features = _encoder_features(config, voxels, dlogI, context, y)
    logits, hidden = IntensityEncoder(config, _outputs(config)).apply(
        {"params": net["encoder"]}, features)
    return hidden if config.code == "feature" else encoder.changes_of_logits(logits), logits


def condition(config: ModelConfig, changes: Array, context: Array, y: Array) -> Array:
    """u (..., condition): the changes in units of the camera's thresholds (events expected
    per sub-window, in asinh), the summary, the context. The paper's u is the feature alone."""
    if config.code == "feature":
        return changes
    camera = squash(y[..., :4])
    up, down = jnp.split(changes, 2, -1)
    expected = [up / camera.theta_on[..., None], down / camera.theta_off[..., None]]
    return jnp.concatenate([jnp.arcsinh(e) for e in expected] + [y, context], -1)


def spread(net: Params, voxels: Array, dlogI: Array, context: Array, u: Array) -> Array:
    features = jnp.concatenate([pooling.pixel_features(voxels, dlogI, context), u], -1)
    hidden = net["spread"]["Dense_0"]["kernel"].shape[-1]
    return jnp.exp(SpreadNet(hidden).apply({"params": net["spread"]}, features))


def centre(config: ModelConfig, y: Array) -> Array:
    """Where y = 0 of the flow lies: at the camera's summary, so that it models the residual."""
    return y[..., :4] if config.pool else jnp.zeros_like(y[..., :4])


def init(key: Array, config: ModelConfig, name: str = "default") -> Params:
    """Fresh params (the flow's actnorms still want `flow.data_init`)."""
    k_summary, k_encoder, k_spread, k_flow = jax.random.split(key, 4)
    shape = (1, 1)
    voxels, dlogI = jnp.zeros((*shape, 2 * config.bins)), jnp.zeros(shape)
    context, y = jnp.zeros((*shape, 3)), jnp.zeros((*shape, 6))
    features = _encoder_features(config, voxels, dlogI, context, y)
    seen = pooling.pixel_features(voxels, dlogI, context)
    wide = jnp.zeros((*shape, seen.shape[-1] + config.flow.condition))
    net = {
        "encoder": IntensityEncoder(config, _outputs(config)).init(k_encoder, features)["params"],
        "spread": SpreadNet(config.flow.hidden).init(k_spread, wide)["params"],
        "flow": flow.init(k_flow, config.flow),
    }
    if config.pool:
        net["summary"] = pooling.init(k_summary, config)
    return {name: net}


def _net(params: Params) -> tuple[ModelConfig, Params]:
    return architecture(params), next(iter(params.values()))


def _prepare(
    config: ModelConfig, voxels: Any, dlogI: Any, window_s: Any, intensity: Any
) -> tuple[Array, Array, Array, Array | None]:
    """Checked float32 inputs; window_s (...,), intensity (..., H, W) or None."""
    channels = 2 * config.bins
    if np.ndim(voxels) < 3 or np.shape(voxels)[-1] != channels:
        raise EvflowDataError(
            "EV002", f"voxels have shape {np.shape(voxels)}.",
            f"Expected (..., H, W, {channels}): {config.bins} ON bins, then {config.bins} OFF bins,"
            " as voxelize returns.")
    if np.shape(dlogI) != np.shape(voxels)[:-1]:
        raise EvflowDataError(
            "EV002", f"dlogI has shape {np.shape(dlogI)}, voxels {np.shape(voxels)}.",
            "dlogI must be voxels' shape without the channels: (..., H, W).")
    for name, value in (("voxels", voxels), ("dlogI", dlogI), ("window_s", window_s)):
        if not isinstance(value, jax.core.Tracer) and not np.isfinite(np.asarray(value)).all():
            raise EvflowDataError(
                "EV007", f"{name} holds NaN or infinite values.",
                "A logarithm of missing pixels? Set them to 0.")
    if not isinstance(window_s, jax.core.Tracer) and not (np.asarray(window_s) > 0).all():
        raise EvflowDataError("EV020", f"window_s={window_s}.", "It is a length in seconds, > 0.")
    voxels, dlogI = jnp.asarray(voxels, jnp.float32), jnp.asarray(dlogI, jnp.float32)
    lead = dlogI.shape[:-2]
    window_s = jnp.broadcast_to(jnp.asarray(window_s, jnp.float32), lead)
    if intensity is not None:
        intensity = jnp.asarray(intensity, jnp.float32)
        if intensity.shape == lead:
            intensity = intensity[..., None, None]
        intensity = jnp.broadcast_to(intensity, dlogI.shape)
    return voxels, dlogI, window_s, intensity


def summarize(
    params: Params, voxels: Array, dlogI: Array, *, window_s: Any = DEFAULT_WINDOW_S,
    intensity: Any = None,
) -> Stats:
    """Additive statistics (...,) of the pixels; add those of windows and tiles of one camera."""
    config, net = _net(params)
    if not config.pool:
        raise EvflowDataError(
            "EV018", "these weights estimate every pixel alone and have no summary.",
            'Use load_weights("default").')
    inputs = _prepare(config, voxels, dlogI, window_s, intensity)
    return _pool(net["summary"], *inputs, config=config)


@partial(jax.jit, static_argnames="config")
def _pool(
    net: Params, voxels: Array, dlogI: Array, window_s: Array, intensity: Array | None, *,
    config: ModelConfig,
) -> Stats:
    return pooling.pool(config, net, voxels, dlogI, window_s, intensity)


def finish(params: Params, stats: Stats) -> tuple[Summary, Summary]:
    """The camera's summary and its standard deviation, natural units, each (...,)."""
    config, net = _net(params)
    y, y_std = pooling.finish(config, net["summary"], stats)
    result = squash_summary(y)
    return result, summary_std(result, y_std)


def encode(
    params: Params, voxels: Array, dlogI: Array, *, summary: Summary | None = None,
    window_s: Any = DEFAULT_WINDOW_S, intensity: Any = None,
) -> Code:
    """Code of what was seen: intensity changes predicted per pixel, and the camera's summary
    (estimated from these very pixels unless given)."""
    config, net = _net(params)
    voxels, dlogI, window_s, intensity = _prepare(config, voxels, dlogI, window_s, intensity)
    summary = _summary_or_estimate(params, config, voxels, dlogI, window_s, intensity, summary)
    context = _context(window_s, intensity, dlogI.shape)
    y = _over_pixels(unsquash_summary(summary), dlogI.shape)
    changes, _ = encode_changes(config, net, voxels, dlogI, context, y)
    return Code(changes, summary, context)


def _context(window_s: Array, intensity: Array | None, shape: tuple[int, ...]) -> Array:
    return pooling.window_features(window_s[..., None, None], intensity, shape)


def _over_pixels(y: Array, shape: tuple[int, ...]) -> Array:
    """(..., C) of a camera -> (..., H, W, C)."""
    return jnp.broadcast_to(y[..., None, None, :], (*shape, y.shape[-1]))


def _summary_or_estimate(
    params: Params, config: ModelConfig, voxels: Array, dlogI: Array, window_s: Array,
    intensity: Array | None, given: Summary | None,
) -> Summary:
    lead = dlogI.shape[:-2]
    if given is not None:
        return jax.tree.map(lambda v: jnp.broadcast_to(jnp.asarray(v, jnp.float32), lead), given)
    if not config.pool:
        return squash_summary(jnp.zeros((*lead, 6)))
    stats = summarize(params, voxels, dlogI, window_s=window_s, intensity=intensity)
    return finish(params, stats)[0]


def code_from_video(
    params: Params, dL: Array, camera: Camera, *, window_s: Any = DEFAULT_WINDOW_S,
    intensity: Any = None,
) -> Code:
    """Code without any events: true log-intensity changes dL (..., H, W, m) of the window's m
    equal parts, and the summary of `camera` (maps (..., H, W) or (H, W))."""
    config, _ = _net(params)
    if config.code == "feature":
        raise EvflowDataError(
            "EV018", "the paper's condition contains the events; a video cannot make it.",
            'Use load_weights("default").')
    dL = jnp.asarray(dL, jnp.float32)
    if dL.ndim < 3 or dL.shape[-1] != config.changes:
        raise EvflowDataError("EV002", f"dL has shape {dL.shape}.",
                              f"Expected (..., H, W, {config.changes}).")
    _, _, window_s, intensity = _prepare(
        config, jnp.zeros((*dL.shape[:-1], 2 * config.bins)), dL[..., 0], window_s, intensity)
    lead = dL.shape[:-3]
    known = jax.tree.map(lambda v: jnp.broadcast_to(v, lead), camera_summary(camera))
    return Code(encoder.split_sign(dL), known, _context(window_s, intensity, dL.shape[:-1]))


def camera_summary(camera: Camera) -> Summary:
    """Medians and mismatches of a camera's maps (..., H, W)."""
    def median(m: Array) -> Array:
        return jnp.median(m, axis=(-2, -1))

    def sigma(m: Array) -> Array:  # 1.4826 MAD: pixels at the clamp are no measure of mismatch
        return 1.4826 * median(jnp.abs(m - median(m)[..., None, None]))

    return Summary(median(camera.theta_on), median(camera.theta_off), median(camera.eta_on),
                   median(camera.eta_off), sigma(camera.theta_on), sigma(camera.theta_off))


def _flow_condition(config: ModelConfig, code: Code) -> tuple[Array, Array]:
    y = _over_pixels(unsquash_summary(code.summary), code.context.shape[:-1])
    return condition(config, code.changes, code.context, y), centre(config, y)


def forward(params: Params, voxels: Array, code: Code) -> tuple[Array, Array, Array]:
    """voxels (..., H, W, 32) -> y (..., H, W, 4), z (..., H, W, 28), log_det (..., H, W) of
    d(y, z)/d voxels at fixed code (Eqs. 3-5)."""
    config, net = _net(params)
    u, middle = _flow_condition(config, code)
    y, z, log_det = flow.forward(net["flow"], jnp.asarray(voxels, jnp.float32), u, config.flow)
    return y + middle, z, log_det


def inverse(params: Params, y: Array, z: Array, code: Code) -> Array:
    """(y, z) -> voxels, the exact inverse of `forward` at the same code."""
    config, net = _net(params)
    u, middle = _flow_condition(config, code)
    return flow.inverse(net["flow"], y - middle, z, u, config.flow)[0]


def generate(params: Params, key: Array, camera: Camera, code: Code) -> Array:
    """Voxels (..., H, W, 32) as `camera` would see the scene of `code`, z ~ N(0, 1).

    The code's summary is replaced by the camera's. Values are not clipped: noise of the
    latents leaves small negative weights.
    """
    config, _ = _net(params)
    shape = code.context.shape[:-1]
    known = jax.tree.map(lambda v: jnp.broadcast_to(v, shape[:-2]), camera_summary(camera))
    y = jnp.broadcast_to(unsquash(camera, config.output), (*shape, 4))
    z = jax.random.normal(key, (*shape, 2 * config.bins - 4))
    return inverse(params, y, z, dataclasses.replace(code, summary=known))


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


def log_prob(params: Params, voxels: Array, code: Code) -> Array:
    """Log density (..., H, W) of the voxels given the code (Eq. 3): y ~ N(summary, mismatch^2),
    z ~ N(0, 1), plus the log-det. A density only where the code came from a true video and a
    camera; with an encoded code it is a score."""
    y, z, log_det = forward(params, voxels, code)
    y6 = _over_pixels(unsquash_summary(code.summary), y.shape[:-1])
    prior = log_normal(y, y6[..., :4], base_std(y6)).sum(-1)
    return prior + log_normal(z, 0.0, jnp.ones(())).sum(-1) + log_det


def estimate(
    params: Params, voxels: Array, dlogI: Array, *, window_s: Any = DEFAULT_WINDOW_S,
    intensity: Any = None, summary: Summary | None = None,
) -> Camera:
    """Camera maps (..., H, W) from one window: voxels (..., H, W, 32), dlogI (..., H, W).

    Jitted; compiles once per shape. A `summary` pooled over more windows replaces the one of
    this window.
    """
    return estimate_with_std(params, voxels, dlogI, window_s=window_s, intensity=intensity,
                             summary=summary)[0]


def estimate_with_std(
    params: Params, voxels: Array, dlogI: Array, *, window_s: Any = DEFAULT_WINDOW_S,
    intensity: Any = None, summary: Summary | None = None,
) -> tuple[Camera, Camera]:
    """`estimate` and the standard deviation of every value, in the same units."""
    y, y_std = estimate_y(params, voxels, dlogI, window_s=window_s, intensity=intensity,
                          summary=summary)
    camera = squash(y, architecture(params).output)
    return camera, camera_std(camera, y_std)


def estimate_y(
    params: Params, voxels: Array, dlogI: Array, *, window_s: Any = DEFAULT_WINDOW_S,
    intensity: Any = None, summary: Summary | None = None,
) -> tuple[Array, Array]:
    """`estimate_with_std` in the coordinates y: (..., H, W, 4) each."""
    config, net = _net(params)
    voxels, dlogI, window_s, intensity = _prepare(config, voxels, dlogI, window_s, intensity)
    known = _summary_or_estimate(params, config, voxels, dlogI, window_s, intensity, summary)
    return _estimate_y(net, voxels, dlogI, window_s, intensity, unsquash_summary(known), config)


def _estimate_pixels(
    net: Params, voxels: Array, dlogI: Array, window_s: Array, intensity: Array | None, y6: Array,
    config: ModelConfig,
) -> tuple[Array, Array]:
    """Encoder, flow and spread on all pixels, in chunks so that activations stay in cache."""
    context = _context(window_s, intensity, dlogI.shape)
    rows = [a.reshape(math.prod(dlogI.shape), -1) for a in (
        voxels, dlogI[..., None], context, _over_pixels(y6, dlogI.shape))]
    folded = flow.fold(net["flow"], config.flow)

    def pixels(row: tuple[Array, ...]) -> tuple[Array, Array]:
        voxels, dlogI, context, y = row
        dlogI = dlogI[..., 0]
        changes, _ = encode_changes(config, net, voxels, dlogI, context, y)
        u = condition(config, changes, context, y)
        residual, _ = flow.forward_folded(folded, voxels, u, config.flow)
        return residual + centre(config, y), spread(net, voxels, dlogI, context, u)

    y, std = _map_chunks(pixels, rows)
    return y.reshape(*dlogI.shape, 4), std.reshape(*dlogI.shape, 4)


_estimate_y = jax.jit(_estimate_pixels, static_argnames="config")


def _map_chunks(f: Any, rows: list[Array]) -> Any:
    """f over rows (N, C) in chunks of CHUNK, the last one padded with zeros."""
    n = rows[0].shape[0]
    if n <= CHUNK:
        return f(tuple(rows))
    pad = -n % CHUNK
    chunks = tuple(jnp.pad(r, ((0, pad), (0, 0))).reshape(-1, CHUNK, r.shape[-1]) for r in rows)
    out = jax.lax.map(f, chunks)
    return jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:])[:n], out)
