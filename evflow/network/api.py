"""The network: events <-> camera parameters, given the change of intensity.

params is a plain nested dict {architecture name: {"summary", "encoder", "spread", "flow"}} of
arrays; everything static follows from the name (config.MODELS) and the leaves' shapes, so
`estimate(params, voxels, dlogI)` needs nothing else and passes through jit, vmap and grad.

    summarize -> Stats -> finish -> Summary          all pixels pooled: the camera
    encode    -> Code                                 per pixel: the condition of the flow
    forward, inverse: voxels <-> (y, z) at fixed code, in bijection.py

Shapes: voxels (..., H, W, 32), dlogI (..., H, W); pooling is over (H, W) only. Keyword-only
conditions: window_s, seconds, default .05, a float or (...,); intensity, mean log intensity
(lin-log of DN), (..., H, W), optional; NaN where it is unknown.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from evflow.camera import Camera, Summary
from evflow.camera.arguments import real
from evflow.checks import need
from evflow.errors import EvflowDataError
from evflow.network import architecture, coordinates, inference
from evflow.network.architecture import Params, config_of
from evflow.network.bijection import (
    DEFAULT_WINDOW_S,
    Code,
    code_from_video,
    forward,
    generate,
    inverse,
    log_prob,
    parts,
    pixel_context,
)
from evflow.network.config import ModelConfig
from evflow.network.coordinates import (
    Output,
    camera_std,
    check_output,
    squash_summary,
    unsquash_summary,
)
from evflow.network.inputs import check_finite, given_summary, prepare, same_precision
from evflow.network.pooling import Stats, of_pixels
from evflow.network.posterior import of_window
from evflow.network.summary import finish, pooled_y, summarize

__all__ = [
    "Code", "Params", "Stats", "code_from_video", "encode", "estimate", "estimate_with_std",
    "estimate_y", "finish", "forward", "generate", "inverse", "log_prob", "squash", "summarize",
    "unsquash",
]

Array = jax.Array


def squash(y: ArrayLike, output: Output = "log") -> Camera:
    """Camera of the flow's coordinates y (inverse of `unsquash`).

    Args:
        y: (..., 4), (log theta_on, log theta_off, log eta_on, log eta_off), standardised.
        output: "log", or "tanh" for the paper's network, whose y is arctanh of the parameters.

    Returns:
        A camera of maps (...): theta in natural-log units, eta in Hz.

    Raises:
        EvflowDataError: EV002 (shape), EV003 (no real numbers), EV007 (NaN), EV020 (an unknown
            output).
    """
    check_output(output)
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
        EvflowDataError: EV014 (a parameter out of range), EV015 (maps of different shapes), EV020
            (no camera, or an unknown output).
    """
    check_output(output)
    need(camera, Camera, "camera", "For coordinates: squash(y) is their camera.")
    camera.check_values()
    return coordinates.unsquash(camera, output)


def encode(
    params: Params, voxels: ArrayLike, dlogI: ArrayLike, *, summary: Summary | None = None,
    window_s: ArrayLike = DEFAULT_WINDOW_S, intensity: ArrayLike | None = None,
) -> Code:
    """Code of what was seen: the intensity changes, predicted from the events, and the summary.

    Args:
        params: of `load_weights`.
        voxels: (..., H, W, 32), events per pixel and bin.
        dlogI: (..., H, W), natural-log units.
        summary: of the camera, (...,) or scalars; None estimates it from these pixels.
        window_s: length of the window in seconds, a number or (...,).
        intensity: as in `summarize`.

    Returns:
        The code, for `forward`, `inverse` and `generate`.

    Raises:
        EvflowDataError: EV001, EV002, EV003, EV007, EV020 as in `summarize`; EV014 (a summary out
            of range), EV018 (not weights).
    """
    config, net = parts(params)
    voxels, dlogI, window_s, intensity = prepare(config, voxels, dlogI, window_s, intensity)
    y, _ = _known_summary(params, config, voxels, dlogI, window_s, intensity, summary)
    context = pixel_context(window_s, intensity, dlogI.shape)
    changes = _encode(net, voxels, dlogI, of_pixels(context), y, config=config)
    return Code(changes, squash_summary(y), context)


@partial(jax.jit, static_argnames="config")
def _encode(
    net: Params, voxels: Array, dlogI: Array, context: Array, y: Array, *, config: ModelConfig
) -> Array:
    over = architecture.over_pixels(y, dlogI.shape)
    return architecture.encode_changes(config, net, voxels, dlogI, context, over)[0]


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
    return pooled_y(parts(params)[1]["summary"], stats, config=config)


def estimate(
    params: Params, voxels: ArrayLike, dlogI: ArrayLike, *, window_s: ArrayLike = DEFAULT_WINDOW_S,
    intensity: ArrayLike | None = None, summary: Summary | None = None,
) -> Camera:
    """Camera maps from one window of events and the change of intensity over it.

    Combines the flow's estimate with the summary and the mismatch, each weighted by its precision,
    so that the map of a camera with identical pixels is no worse than its summary. Jitted; compiles
    once per shape. One window determines a camera's thresholds to some percent and its pixels
    hardly (in the README's example the mean is off by .017 and .022, where the std of
    `estimate_with_std` is .025 and .034). `estimate_camera` uses a whole recording: there the
    camera's thresholds are right to .008.

    Args:
        params: of `load_weights`.
        voxels: (..., H, W, 32), events per pixel and bin, of `voxelize`.
        dlogI: (..., H, W), natural-log units, of `delta_log_intensity`.
        window_s: length of the window in seconds, a number or (...,).
        intensity: mean log intensity (lin-log of DN), (..., H, W) or (...,), NaN where unknown;
            None: unknown everywhere.
        summary: of the camera, (...,) or scalars, pooled over more windows; None estimates it from
            this window.

    Returns:
        The camera, maps (..., H, W); for the paper's network, which has no summary, the flow's own.

    Raises:
        EvflowDataError: EV001 (no pixel), EV002 (shape), EV003 (values that cannot be counts or
            logarithms), EV007 (NaN), EV014 (a summary out of range), EV018 (not weights), EV020
            (window_s).

    Example:
        >>> params = ef.load_weights()
        >>> camera = ef.estimate(params, voxels, dlogI, window_s=0.05)
    """
    return estimate_with_std(params, voxels, dlogI, window_s=window_s, intensity=intensity,
                             summary=summary)[0]


def estimate_with_std(
    params: Params, voxels: ArrayLike, dlogI: ArrayLike, *, window_s: ArrayLike = DEFAULT_WINDOW_S,
    intensity: ArrayLike | None = None, summary: Summary | None = None,
) -> tuple[Camera, Camera]:
    """`estimate`, with the standard deviation of every value.

    Args:
        params: of `load_weights`.
        voxels: (..., H, W, 32), events per pixel and bin.
        dlogI: (..., H, W), natural-log units.
        window_s: length of the window in seconds, a number or (...,).
        intensity: as in `estimate`.
        summary: as in `estimate`; the std is then that of a pixel given this summary; otherwise it
            includes the summary's own std.

    Returns:
        The camera and its standard deviations, maps (..., H, W) in the same units; NaN for the
        paper's network, which estimates none.

    Raises:
        EvflowDataError: EV001, EV002, EV003, EV007, EV014, EV018, EV020 as in `estimate`.
    """
    y, y_std, y6, y6_std = _answer(params, voxels, dlogI, window_s, intensity, summary)
    config = config_of(params)
    if not config.pool:
        return squash(y, config.output), camera_std(y, y_std, config.output)
    return of_window(y, y_std, *(a[..., None, None, :] for a in (y6, y6_std)))


def estimate_y(
    params: Params, voxels: ArrayLike, dlogI: ArrayLike, *, window_s: ArrayLike = DEFAULT_WINDOW_S,
    intensity: ArrayLike | None = None, summary: Summary | None = None,
) -> tuple[Array, Array]:
    """The flow's own estimate for a window, in the coordinates y, and its std: (..., H, W, 4) each,
    NaN if the network estimates none. `posterior` combines it with the summary."""
    return _answer(params, voxels, dlogI, window_s, intensity, summary)[:2]


def _answer(
    params: Params, voxels: ArrayLike, dlogI: ArrayLike, window_s: ArrayLike,
    intensity: ArrayLike | None, summary: Summary | None,
) -> tuple[Array, Array, Array, Array]:
    """`estimate_y`, and y (..., 6) of the summary with its std, 0 if it was given."""
    config, net = parts(params)
    voxels, dlogI, window_s, intensity = prepare(config, voxels, dlogI, window_s, intensity)
    y6, y6_std = _known_summary(params, config, voxels, dlogI, window_s, intensity, summary)
    own = dlogI.shape if intensity is not None else (*dlogI.shape[:-2], 1, 1)
    context = of_pixels(pixel_context(window_s, intensity, own))
    return *inference.estimate(config, net, voxels, dlogI, context, y6), y6, y6_std
