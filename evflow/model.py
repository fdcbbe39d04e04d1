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

from evflow import encoder, flow, network, pixelwise
from evflow import summary as pooling
from evflow.camera import Camera, Summary
from evflow.config import ModelConfig
from evflow.coordinates import (
    camera_std,
    squash,
    squash_summary,
    summary_std,
    unsquash,
    unsquash_summary,
)
from evflow.errors import EvflowDataError
from evflow.intensity import check_log
from evflow.network import Params, architecture
from evflow.summary import Stats

__all__ = [
    "Code", "Params", "Stats", "code_from_video", "encode", "estimate", "estimate_with_std",
    "estimate_y", "finish", "forward", "generate", "inverse", "log_prob", "squash", "summarize",
    "unsquash",
]

Array = jax.Array

DEFAULT_WINDOW_S = 0.05


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
    return architecture(params), next(iter(params.values()))


def _real(values: ArrayLike) -> Array:
    """As float32; float64 stays where JAX's x64 mode keeps it."""
    values = jnp.asarray(values)
    return values if values.dtype == jnp.float64 else values.astype(jnp.float32)


def _check_shape(name: str, values: ArrayLike, expected: tuple[int, ...], code: Code) -> None:
    if np.shape(values) != expected:
        raise EvflowDataError(
            "EV002", f"{name} has shape {np.shape(values)}, the code's pixels are "
            f"{code.context.shape[:-1]}.", f"Expected {expected}: both of one window.")


def _prepare(
    config: ModelConfig, voxels: ArrayLike, dlogI: ArrayLike, window_s: Any, intensity: Any
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
    if np.size(dlogI) == 0:
        raise EvflowDataError("EV001", f"voxels of shape {np.shape(voxels)} hold no pixel.")
    for name, value in (("voxels", voxels), ("dlogI", dlogI), ("window_s", window_s)):
        if not isinstance(value, jax.core.Tracer) and not np.isfinite(np.asarray(value)).all():
            raise EvflowDataError(
                "EV007", f"{name} holds NaN or infinite values.",
                "A logarithm of missing pixels? Set them to 0.")
    if not isinstance(voxels, jax.core.Tracer):
        _check_counts(np.asarray(voxels))
    if not isinstance(window_s, jax.core.Tracer) and not (np.asarray(window_s) > 0).all():
        raise EvflowDataError("EV020", f"window_s={window_s}.", "It is a length in seconds, > 0.")
    voxels, dlogI = _real(voxels), _real(dlogI)
    lead = dlogI.shape[:-2]
    window_s = _spread_over("window_s", jnp.asarray(window_s, jnp.float32), lead)
    if intensity is not None:
        if not isinstance(intensity, jax.core.Tracer):
            given = np.asarray(intensity)
            check_log("intensity", given[~np.isnan(given)])
        intensity = jnp.asarray(intensity, jnp.float32)
        if intensity.shape == lead:
            intensity = intensity[..., None, None]
        intensity = _spread_over("intensity", intensity, dlogI.shape)
    return voxels, dlogI, window_s, intensity


def _check_counts(voxels: np.ndarray) -> None:
    """EV003 for what no counts are; `generate`'s own, a fraction of an event below 0, pass."""
    if (least := voxels.min()) <= -1 or voxels.sum() < 0:
        raise EvflowDataError(
            "EV003", f"voxels go down to {least:.3g}, but they are numbers of events.",
            "Signed polarities in one grid, or normalised? Take evflow.voxelize.")


def _spread_over(name: str, values: Array, shape: tuple[int, ...]) -> Array:
    """Broadcast to shape, or EV002."""
    try:
        return jnp.broadcast_to(values, shape)
    except ValueError:
        raise EvflowDataError(
            "EV002", f"{name} has shape {values.shape}.",
            f"Expected one value, or {shape} as the voxels.") from None


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
    params: Params, voxels: ArrayLike, dlogI: ArrayLike, *, summary: Summary | None = None,
    window_s: Any = DEFAULT_WINDOW_S, intensity: Any = None,
) -> Code:
    """Code of what was seen: intensity changes predicted per pixel, and the camera's summary
    (estimated from these very pixels unless given)."""
    config, net = _net(params)
    voxels, dlogI, window_s, intensity = _prepare(config, voxels, dlogI, window_s, intensity)
    y, _ = _known_summary(params, config, voxels, dlogI, window_s, intensity, summary)
    context = _context(window_s, intensity, dlogI.shape)
    changes = _encode(net, voxels, dlogI, context, y, config=config)
    return Code(changes, squash_summary(y), context)


@partial(jax.jit, static_argnames="config")
def _encode(
    net: Params, voxels: Array, dlogI: Array, context: Array, y: Array, *, config: ModelConfig
) -> Array:
    over = network.over_pixels(y, dlogI.shape)
    return network.encode_changes(config, net, voxels, dlogI, context, over)[0]


def _context(window_s: Array, intensity: Array | None, shape: tuple[int, ...]) -> Array:
    return pooling.window_features(window_s[..., None, None], intensity, shape)


def _known_summary(
    params: Params, config: ModelConfig, voxels: Array, dlogI: Array, window_s: Array,
    intensity: Array | None, given: Summary | None,
) -> tuple[Array, Array]:
    """y (..., 6) of the camera's summary and its std (0 where it is given)."""
    lead = dlogI.shape[:-2]
    if given is not None:
        known = jax.tree.map(lambda v: jnp.broadcast_to(jnp.asarray(v, jnp.float32), lead), given)
        return unsquash_summary(known), jnp.zeros((*lead, 6))
    if not config.pool:
        return jnp.zeros((*lead, 6)), jnp.zeros((*lead, 6))
    stats = summarize(params, voxels, dlogI, window_s=window_s, intensity=intensity)
    return pooling.finish(config, _net(params)[1]["summary"], stats)


def code_from_video(
    params: Params, dL: ArrayLike, camera: Camera, *, window_s: Any = DEFAULT_WINDOW_S,
    intensity: Any = None,
) -> Code:
    """Code without any events: true log-intensity changes dL (..., H, W, m) of the window's m
    equal parts, and the summary of `camera` (maps (..., H, W) or (H, W)). Raises EV002, EV015."""
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
    known = _of_pixels(camera, dL.shape[:-1])
    return Code(encoder.split_sign(dL), known, _context(window_s, intensity, dL.shape[:-1]))


def _of_pixels(camera: Camera, shape: tuple[int, ...]) -> Summary:
    """The summary (...,) of a camera with maps (..., H, W) or (H, W), or EV015."""
    lead = camera.shape[:-2]
    if camera.shape[-2:] != shape[-2:] or lead not in ((), shape[:-2]):
        raise EvflowDataError(
            "EV015", f"the camera is {camera.shape}, the pixels are {shape}.",
            "Give maps (H, W), or one camera for each of the leading axes.")
    return jax.tree.map(lambda v: jnp.broadcast_to(v, shape[:-2]), camera_summary(camera))


def camera_summary(camera: Camera) -> Summary:
    """Medians and mismatches of a camera's maps (..., H, W)."""
    def median(m: Array) -> Array:
        return jnp.median(m, axis=(-2, -1))

    def sigma(m: Array) -> Array:  # 1.4826 MAD: pixels at the clamp are no measure of mismatch
        return 1.4826 * median(jnp.abs(m - median(m)[..., None, None]))

    return Summary(median(camera.theta_on), median(camera.theta_off), median(camera.eta_on),
                   median(camera.eta_off), sigma(camera.theta_on), sigma(camera.theta_off))


def _flow_condition(config: ModelConfig, code: Code) -> tuple[Array, Array]:
    y = network.over_pixels(unsquash_summary(code.summary), code.context.shape[:-1])
    return network.condition(config, code.changes, code.context, y), network.centre(config, y)


def forward(params: Params, voxels: ArrayLike, code: Code) -> tuple[Array, Array, Array]:
    """voxels (..., H, W, 32) -> y (..., H, W, 4), z (..., H, W, 28), log_det (..., H, W) of
    d(y, z)/d voxels at fixed code (Eqs. 3-5). Raises EV002 for voxels of other pixels."""
    config, net = _net(params)
    _check_shape("voxels", voxels, (*code.context.shape[:-1], 2 * config.bins), code)
    return _forward(net, _real(voxels), code, config=config)


@partial(jax.jit, static_argnames="config")
def _forward(
    net: Params, voxels: Array, code: Code, *, config: ModelConfig
) -> tuple[Array, Array, Array]:
    u, centre = _flow_condition(config, code)
    y, z, log_det = flow.forward(net["flow"], voxels, u, config.flow)
    return y + centre, z, log_det


def inverse(params: Params, y: Array, z: Array, code: Code) -> Array:
    """(y, z) -> voxels, the exact inverse of `forward` at the same code; EV002 as there."""
    config, net = _net(params)
    pixels = code.context.shape[:-1]
    for name, values, channels in (("y", y, 4), ("z", z, 2 * config.bins - 4)):
        _check_shape(name, values, (*pixels, channels), code)
    return _inverse(net, _real(y), _real(z), code, config=config)


@partial(jax.jit, static_argnames="config")
def _inverse(net: Params, y: Array, z: Array, code: Code, *, config: ModelConfig) -> Array:
    u, centre = _flow_condition(config, code)
    return flow.inverse(net["flow"], y - centre, z, u, config.flow)[0]


def generate(params: Params, key: Array, camera: Camera, code: Code) -> Array:
    """Voxels (..., H, W, 32) as `camera` would see the scene of `code`, z ~ N(0, 1).

    The code's summary is replaced by the camera's, which has been running: its pixels' memory is
    anywhere between the thresholds. A simulation that starts at the window's first frame sends
    about a tenth fewer events, and a fifth where thresholds are high. Values are not clipped:
    noise of the latents leaves small negative weights. Raises EV015 for a camera of other pixels.
    """
    config, _ = _net(params)
    shape = code.context.shape[:-1]
    known = _of_pixels(camera, shape)
    y = jnp.broadcast_to(unsquash(camera, config.output), (*shape, 4))
    z = jax.random.normal(key, (*shape, 2 * config.bins - 4))
    return inverse(params, y, z, dataclasses.replace(code, summary=known))


def log_prob(params: Params, voxels: ArrayLike, code: Code) -> Array:
    """Log density (..., H, W) of the voxels given the code (Eq. 3): y ~ N(summary, mismatch^2),
    z ~ N(0, 1), plus the log-det. A density only where the code came from a true video and a
    camera; with an encoded code it is a score."""
    y, z, log_det = forward(params, voxels, code)
    y6 = network.over_pixels(unsquash_summary(code.summary), y.shape[:-1])
    prior = network.log_normal(y, y6[..., :4], network.base_std(y6)).sum(-1)
    return prior + network.log_normal(z, 0.0, jnp.ones(())).sum(-1) + log_det


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
    camera = squash(y, architecture(params).output)
    return camera, camera_std(camera, y_std)


def estimate_y(
    params: Params, voxels: ArrayLike, dlogI: ArrayLike, *, window_s: Any = DEFAULT_WINDOW_S,
    intensity: Any = None, summary: Summary | None = None,
) -> tuple[Array, Array]:
    """`estimate_with_std` in the coordinates y: (..., H, W, 4) each. With a given summary the
    std is that of a pixel in a camera so described; else it includes the summary's own."""
    config, net = _net(params)
    voxels, dlogI, window_s, intensity = _prepare(config, voxels, dlogI, window_s, intensity)
    y6, y6_std = _known_summary(params, config, voxels, dlogI, window_s, intensity, summary)
    own = dlogI.shape if intensity is not None else (*dlogI.shape[:-2], 1, 1)
    context = _context(window_s, intensity, own)
    y, y_std = pixelwise.estimate(config, net, voxels, dlogI, context, y6)
    shared = y6_std[..., None, None, :4]  # an error of the summary moves all pixels alike
    return y, jnp.sqrt(y_std**2 + shared**2)
