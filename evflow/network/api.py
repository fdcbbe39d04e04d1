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
    """Camera of the flow's coordinates y (inverse of `unsquash`).

    Args:
        y: (..., 4), (log theta_on, log theta_off, log eta_on, log eta_off), standardised.
        output: "log", or "tanh" for the paper's network, whose y is arctanh of the parameters.

    Returns:
        A camera of maps (...): theta in natural-log units, eta in Hz.

    Raises:
        EvflowDataError: EV002 (shape), EV003 (no real numbers), EV007 (NaN).
    """
    if np.ndim(y) < 1 or np.shape(y)[-1] != 4:
        raise EvflowDataError("EV002", f"y has shape {np.shape(y)}.", "Expected (..., 4).")
    check_finite("y", y)
    return coordinates.squash(real(y), output)


def unsquash(camera: Camera, output: Output = "log") -> Array:
    """Coordinates y of a camera, in which the flow works (inverse of `squash`).

    Args:
        camera: maps (...). A noise rate below 1e-3 Hz is taken as 1e-3 Hz.
        output: as in `squash`.

    Returns:
        float32 (..., 4).

    Raises:
        EvflowDataError: EV014 (a parameter out of range), EV015 (maps of different shapes).
    """
    camera.check_values()
    return coordinates.unsquash(camera, output)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Code:
    """The condition of the flow: what the bijection between events and (y, z) holds fixed.

    Attributes:
        changes: (..., H, W, 2m), the changes of log intensity dL_j in the window's m = 16 equal
            parts, as relu(+dL_j), then relu(-dL_j); of the paper's network the encoder's feature.
        summary: of the camera, (...,).
        context: (..., H, W, 3), window length and mean log intensity.
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
    """Additive statistics of all pixels: the pooled evidence for the camera's summary.

    Statistics of windows and tiles of one camera are added: `sum(summarize(...) for ...)`.

    Args:
        params: of `load_weights`.
        voxels: (..., H, W, 32), events per pixel and bin, of `voxelize`.
        dlogI: (..., H, W), natural-log units, of `delta_log_intensity`.
        window_s: length of the window in seconds, a number or (...,).
        intensity: mean log intensity (lin-log of DN), (..., H, W) or (...,), NaN where it is
            unknown; None is unknown everywhere.

    Returns:
        Statistics (...,), pooled over (H, W) only.

    Raises:
        EvflowDataError: EV001 (no pixel), EV002 (shape), EV003 (values that are no counts, no
            logarithms), EV007 (NaN), EV018 (weights of the paper's network, which pools nothing,
            or no weights), EV020 (window_s).

    Example:
        >>> stats = sum(ef.summarize(params, v, d) for v, d in windows)
        >>> summary, std = ef.finish(params, stats)
    """
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
    """The camera's summary from pooled statistics.

    Args:
        params: of `load_weights`.
        stats: of `summarize`, one or a sum.

    Returns:
        The summary and its standard deviation, (...,) each, in natural units (natural log, Hz);
        the std falls with the amount of data.

    Raises:
        EvflowDataError: EV018 (no weights).
    """
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
    """Code of what was seen: the intensity changes, predicted from the events, and the summary.

    Args:
        params: of `load_weights`.
        voxels: (..., H, W, 32), events per pixel and bin.
        dlogI: (..., H, W), natural-log units.
        summary: of the camera, (...,) or scalars; None estimates it from these very pixels.
        window_s: length of the window in seconds, a number or (...,).
        intensity: as in `summarize`.

    Returns:
        The code, for `forward`, `inverse` and `generate`.

    Raises:
        EvflowDataError: EV001, EV002, EV003, EV007, EV020 as in `summarize`; EV014 (a summary out
            of range), EV018 (no weights).
    """
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
    """Code without any events, from a video and a camera: what `generate` needs.

    Args:
        params: of `load_weights`.
        dL: (..., H, W, 16), change of log intensity in each of the window's 16 equal parts,
            natural-log units.
        camera: maps (..., H, W) or (H, W), whose summary enters the code.
        window_s: length of the window in seconds, a number or (...,).
        intensity: as in `summarize`.

    Returns:
        The code.

    Raises:
        EvflowDataError: EV001 (no pixel), EV002 (shape), EV003 (no logarithms), EV007 (NaN), EV014
            (camera out of range), EV015 (camera of other pixels), EV018 (weights of the paper's
            network, whose condition holds the events, or no weights), EV020 (window_s).

    Example:
        >>> dL = jnp.moveaxis(jnp.diff(log_frames, axis=0), 0, -1)  # of 17 frames (17, H, W)
        >>> code = ef.code_from_video(params, dL, camera)
    """
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
    """Events -> camera coordinates and latents, exactly invertible at a fixed code (Eqs. 3-5).

    Args:
        params: of `load_weights`.
        voxels: (..., H, W, 32), events per pixel and bin.
        code: of `encode` or `code_from_video`, for the same pixels.

    Returns:
        y (..., H, W, 4), `squash(y)` is the camera; z (..., H, W, 28), the latents; log_det
        (..., H, W), the log determinant of d(y, z) / d voxels.

    Raises:
        EvflowDataError: EV002 (voxels of other pixels than the code's), EV003 (no real numbers),
            EV007 (NaN), EV018 (no weights).
    """
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
    """Camera coordinates and latents -> events: the exact inverse of `forward` at the same code.

    Args:
        params: of `load_weights`.
        y: (..., H, W, 4), of `forward` or `unsquash`.
        z: (..., H, W, 28).
        code: the code of `forward`.

    Returns:
        Voxels (..., H, W, 32).

    Raises:
        EvflowDataError: EV002, EV003, EV007, EV018 as in `forward`.
    """
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
    """Events of the scene of a code as another camera would see it, z ~ N(0, 1).

    The code's summary is replaced by the camera's. The camera has been running: its pixels' memory
    is anywhere between the thresholds, whereas a simulation that starts at the window's first frame
    sends about a tenth fewer events (a fifth where thresholds are high). Values are not clipped:
    noise of the latents leaves small negative weights.

    Args:
        params: of `load_weights`.
        key: of jax.random, for z.
        camera: maps (..., H, W) or (H, W).
        code: of `code_from_video`, or of `encode`.

    Returns:
        Voxels (..., H, W, 32).

    Raises:
        EvflowDataError: EV002, EV014 (no valid camera), EV015 (camera of other pixels), EV018 (no
            weights).
    """
    config, _ = _net(params)
    shape = code.context.shape[:-1]
    known = summary_of_pixels(camera, shape)
    y = jnp.broadcast_to(coordinates.unsquash(camera, config.output), (*shape, 4))
    z = jax.random.normal(key, (*shape, 2 * config.bins - 4))
    return inverse(params, y, z, dataclasses.replace(code, summary=known))


def log_prob(params: Params, voxels: ArrayLike, code: Code) -> Array:
    """Log density of events given a code (Eq. 3): y ~ N(summary, mismatch^2), z ~ N(0, 1).

    A density only where the code came from a true video and a camera (`code_from_video`); with an
    encoded code, which depends on the events, it is a score.

    Args:
        params: of `load_weights`.
        voxels: (..., H, W, 32), events per pixel and bin.
        code: for the same pixels.

    Returns:
        Natural-log density of each pixel, (..., H, W).

    Raises:
        EvflowDataError: EV002, EV003, EV007 as in `forward`; EV018 (weights of the paper's
            network, which has no summary, or no weights).
    """
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
    """Camera maps from one window of events and the change of intensity over it.

    Jitted; compiles once per shape. Of a whole recording `estimate_camera` knows more.

    Args:
        params: of `load_weights`.
        voxels: (..., H, W, 32), events per pixel and bin, of `voxelize`.
        dlogI: (..., H, W), natural-log units, of `delta_log_intensity`.
        window_s: length of the window in seconds, a number or (...,).
        intensity: mean log intensity (lin-log of DN), (..., H, W) or (...,), NaN where it is
            unknown; None is unknown everywhere.
        summary: of the camera, (...,) or scalars, pooled over more windows; None estimates it from
            this window.

    Returns:
        The camera, maps (..., H, W).

    Raises:
        EvflowDataError: EV001 (no pixel), EV002 (shape), EV003 (values that are no counts, no
            logarithms), EV007 (NaN), EV014 (a summary out of range), EV018 (no weights), EV020
            (window_s).

    Example:
        >>> params = ef.load_weights()
        >>> camera = ef.estimate(params, voxels, dlogI, window_s=0.05)
    """
    return estimate_with_std(params, voxels, dlogI, window_s=window_s, intensity=intensity,
                             summary=summary)[0]


def estimate_with_std(
    params: Params, voxels: ArrayLike, dlogI: ArrayLike, *, window_s: Any = DEFAULT_WINDOW_S,
    intensity: Any = None, summary: Summary | None = None,
) -> tuple[Camera, Camera]:
    """`estimate`, with the standard deviation of every value.

    Args:
        params: of `load_weights`.
        voxels: (..., H, W, 32), events per pixel and bin.
        dlogI: (..., H, W), natural-log units.
        window_s: length of the window in seconds, a number or (...,).
        intensity: as in `estimate`.
        summary: as in `estimate`; the std is then that of a pixel in a camera so described, and
            otherwise includes the summary's own.

    Returns:
        The camera and its standard deviations, maps (..., H, W) in the same units.

    Raises:
        EvflowDataError: EV001, EV002, EV003, EV007, EV014, EV018, EV020 as in `estimate`.
    """
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
