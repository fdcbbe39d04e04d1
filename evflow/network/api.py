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
(lin-log of DN), (..., H, W), optional; NaN where it is unknown.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from evflow.camera import Camera, Summary
from evflow.errors import EvflowDataError
from evflow.network import architecture, coordinates, encoder, flow, inference, pooling
from evflow.network.architecture import Params, config_of
from evflow.network.config import ModelConfig
from evflow.network.coordinates import (
    Output,
    camera_std,
    squash_summary,
    summary_std,
    unsquash_summary,
)
from evflow.network.inputs import (
    check_change,
    check_finite,
    check_shape,
    given_summary,
    prepare,
    real,
    same_precision,
    summary_of_pixels,
)
from evflow.network.pooling import Stats

__all__ = [
    "Code", "Params", "Stats", "code_from_video", "encode", "estimate", "estimate_with_std",
    "estimate_y", "finish", "forward", "generate", "inverse", "log_prob", "squash", "summarize",
    "unsquash",
]

Array = jax.Array

DEFAULT_WINDOW_S = 0.05


def squash(y: ArrayLike, output: Output = "log") -> Camera:
    """y (..., 4) -> Camera of maps (...). Raises EV002, EV007."""
    if np.ndim(y) < 1 or np.shape(y)[-1] != 4:
        raise EvflowDataError("EV002", f"y has shape {np.shape(y)}.", "Expected (..., 4).")
    check_finite("y", y)
    return coordinates.squash(real(y), output)


def unsquash(camera: Camera, output: Output = "log") -> Array:
    """Camera of maps (...) -> y (..., 4); eta below 1e-3 Hz is taken as 1e-3 Hz. Raises EV014,
    EV015."""
    camera.check_values()
    return coordinates.unsquash(camera, output)


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


def _net(params: Params) -> tuple[ModelConfig, Params]:
    return config_of(params), next(iter(params.values()))


def summarize(
    params: Params, voxels: ArrayLike, dlogI: ArrayLike, *, window_s: Any = DEFAULT_WINDOW_S,
    intensity: Any = None,
) -> Stats:
    """Additive statistics (...,) of the pixels; add those of windows and tiles of one camera."""
    config, net = _net(params)
    if not config.pool:
        raise EvflowDataError(
            "EV018", "these weights estimate every pixel alone and have no summary.",
            'Use load_weights("default").')
    inputs = prepare(config, voxels, dlogI, window_s, intensity)
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
    y, y_std = _finish(net["summary"], stats, config=config)
    result = squash_summary(y)
    return result, summary_std(result, y_std)


@partial(jax.jit, static_argnames="config")
def _finish(net: Params, stats: Stats, *, config: ModelConfig) -> tuple[Array, Array]:
    return pooling.finish(config, net, stats)


def encode(
    params: Params, voxels: ArrayLike, dlogI: ArrayLike, *, summary: Summary | None = None,
    window_s: Any = DEFAULT_WINDOW_S, intensity: Any = None,
) -> Code:
    """Code of what was seen: intensity changes predicted per pixel, and the camera's summary
    (estimated from these very pixels unless given)."""
    config, net = _net(params)
    voxels, dlogI, window_s, intensity = prepare(config, voxels, dlogI, window_s, intensity)
    y, _ = _known_summary(params, config, voxels, dlogI, window_s, intensity, summary)
    context = _context(window_s, intensity, dlogI.shape)
    changes = _encode(net, voxels, dlogI, context, y, config=config)
    return Code(changes, squash_summary(y), context)


@partial(jax.jit, static_argnames="config")
def _encode(
    net: Params, voxels: Array, dlogI: Array, context: Array, y: Array, *, config: ModelConfig
) -> Array:
    over = architecture.over_pixels(y, dlogI.shape)
    return architecture.encode_changes(config, net, voxels, dlogI, context, over)[0]


def _context(window_s: Array, intensity: Array | None, shape: tuple[int, ...]) -> Array:
    return pooling.window_features(window_s[..., None, None], intensity, shape)


def _known_summary(
    params: Params, config: ModelConfig, voxels: Array, dlogI: Array, window_s: Array,
    intensity: Array | None, given: Summary | None,
) -> tuple[Array, Array]:
    """y (..., 6) of the camera's summary and its std (0 where it is given)."""
    lead = dlogI.shape[:-2]
    if given is not None:
        known = same_precision(dlogI, given_summary(given, lead))
        return unsquash_summary(known), jnp.zeros((*lead, 6), dlogI.dtype)
    if not config.pool:
        return jnp.zeros((*lead, 6)), jnp.zeros((*lead, 6))
    stats = summarize(params, voxels, dlogI, window_s=window_s, intensity=intensity)
    return _finish(_net(params)[1]["summary"], stats, config=config)


def code_from_video(
    params: Params, dL: ArrayLike, camera: Camera, *, window_s: Any = DEFAULT_WINDOW_S,
    intensity: Any = None,
) -> Code:
    """Code without any events: true log-intensity changes dL (..., H, W, m) of the window's m
    equal parts, and the summary of `camera` (maps (..., H, W) or (H, W)). Raises EV002, EV003,
    EV007, EV014, EV015."""
    config, _ = _net(params)
    if config.code == "feature":
        raise EvflowDataError(
            "EV018", "the paper's condition contains the events; a video cannot make it.",
            'Use load_weights("default").')
    if np.ndim(dL) < 3 or np.shape(dL)[-1] != config.changes:
        raise EvflowDataError("EV002", f"dL has shape {np.shape(dL)}.",
                              f"Expected (..., H, W, {config.changes}).")
    check_finite("dL", dL)
    check_change("dL", dL)
    dL = real(dL)
    _, _, window_s, intensity = prepare(
        config, jnp.zeros((*dL.shape[:-1], 2 * config.bins)), dL[..., 0], window_s, intensity)
    known = summary_of_pixels(camera, dL.shape[:-1])
    return Code(encoder.split_sign(dL), known, _context(window_s, intensity, dL.shape[:-1]))


def _flow_condition(config: ModelConfig, code: Code) -> tuple[Array, Array]:
    y = architecture.over_pixels(unsquash_summary(code.summary), code.context.shape[:-1])
    u = architecture.condition(config, code.changes, code.context, y)
    return u, architecture.centre(config, y)


def forward(params: Params, voxels: ArrayLike, code: Code) -> tuple[Array, Array, Array]:
    """voxels (..., H, W, 32) -> y (..., H, W, 4), z (..., H, W, 28), log_det (..., H, W) of
    d(y, z)/d voxels at fixed code (Eqs. 3-5). Raises EV002 for voxels of other pixels, EV007."""
    config, net = _net(params)
    check_shape("voxels", voxels, (*code.context.shape[:-1], 2 * config.bins))
    voxels = real(voxels)
    return _forward(net, voxels, same_precision(voxels, code), config=config)


@partial(jax.jit, static_argnames="config")
def _forward(
    net: Params, voxels: Array, code: Code, *, config: ModelConfig
) -> tuple[Array, Array, Array]:
    u, centre = _flow_condition(config, code)
    y, z, log_det = flow.forward(net["flow"], voxels, u, config.flow)
    return y + centre, z, log_det


def inverse(params: Params, y: Array, z: Array, code: Code) -> Array:
    """(y, z) -> voxels, the exact inverse of `forward` at the same code; EV002, EV007 as there."""
    config, net = _net(params)
    pixels = code.context.shape[:-1]
    for name, values, channels in (("y", y, 4), ("z", z, 2 * config.bins - 4)):
        check_shape(name, values, (*pixels, channels))
    y, z = real(y), real(z)
    return _inverse(net, y, z, same_precision(y, code), config=config)


@partial(jax.jit, static_argnames="config")
def _inverse(net: Params, y: Array, z: Array, code: Code, *, config: ModelConfig) -> Array:
    u, centre = _flow_condition(config, code)
    return flow.inverse(net["flow"], y - centre, z, u, config.flow)[0]


def generate(params: Params, key: Array, camera: Camera, code: Code) -> Array:
    """Voxels (..., H, W, 32) as `camera` would see the scene of `code`, z ~ N(0, 1).

    The code's summary is replaced by the camera's, which has been running: its pixels' memory is
    anywhere between the thresholds. A simulation that starts at the window's first frame sends
    about a tenth fewer events, and a fifth where thresholds are high. Values are not clipped:
    noise of the latents leaves small negative weights. Raises EV014, and EV015 for a camera of
    other pixels.
    """
    config, _ = _net(params)
    shape = code.context.shape[:-1]
    known = summary_of_pixels(camera, shape)
    y = jnp.broadcast_to(coordinates.unsquash(camera, config.output), (*shape, 4))
    z = jax.random.normal(key, (*shape, 2 * config.bins - 4))
    return inverse(params, y, z, dataclasses.replace(code, summary=known))


def log_prob(params: Params, voxels: ArrayLike, code: Code) -> Array:
    """Log density (..., H, W) of the voxels given the code (Eq. 3): y ~ N(summary, mismatch^2),
    z ~ N(0, 1), plus the log-det. A density only where the code came from a true video and a
    camera; with an encoded code it is a score. Raises EV018 for weights of the paper's network,
    which knows no summary."""
    if not config_of(params).pool:
        raise EvflowDataError("EV018", "the weights have no summary, around which y is expected.",
                              "Take those of the default network.")
    y, z, log_det = forward(params, voxels, code)
    y6 = architecture.over_pixels(unsquash_summary(code.summary), y.shape[:-1])
    prior = architecture.log_normal(y, y6[..., :4], architecture.base_std(y6)).sum(-1)
    return prior + architecture.log_normal(z, 0.0, jnp.ones(())).sum(-1) + log_det


def estimate(
    params: Params, voxels: ArrayLike, dlogI: ArrayLike, *, window_s: Any = DEFAULT_WINDOW_S,
    intensity: Any = None, summary: Summary | None = None,
) -> Camera:
    """Camera maps (..., H, W) from one window: voxels (..., H, W, 32), dlogI (..., H, W).

    Jitted; compiles once per shape. A `summary` pooled over more windows replaces the one of
    this window.
    """
    return estimate_with_std(params, voxels, dlogI, window_s=window_s, intensity=intensity,
                             summary=summary)[0]


def estimate_with_std(
    params: Params, voxels: ArrayLike, dlogI: ArrayLike, *, window_s: Any = DEFAULT_WINDOW_S,
    intensity: Any = None, summary: Summary | None = None,
) -> tuple[Camera, Camera]:
    """`estimate` and the standard deviation of every value, in the same units."""
    y, y_std = estimate_y(params, voxels, dlogI, window_s=window_s, intensity=intensity,
                          summary=summary)
    output = config_of(params).output
    return coordinates.squash(y, output), camera_std(y, y_std, output)


def estimate_y(
    params: Params, voxels: ArrayLike, dlogI: ArrayLike, *, window_s: Any = DEFAULT_WINDOW_S,
    intensity: Any = None, summary: Summary | None = None,
) -> tuple[Array, Array]:
    """`estimate_with_std` in the coordinates y: (..., H, W, 4) each. With a given summary the
    std is that of a pixel in a camera so described; else it includes the summary's own."""
    config, net = _net(params)
    voxels, dlogI, window_s, intensity = prepare(config, voxels, dlogI, window_s, intensity)
    y6, y6_std = _known_summary(params, config, voxels, dlogI, window_s, intensity, summary)
    own = dlogI.shape if intensity is not None else (*dlogI.shape[:-2], 1, 1)
    context = _context(window_s, intensity, own)
    y, y_std = inference.estimate(config, net, voxels, dlogI, context, y6)
    shared = y6_std[..., None, None, :4]  # an error of the summary moves all pixels alike
    return y, jnp.sqrt(y_std**2 + shared**2)
