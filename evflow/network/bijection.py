"""The bijection: events <-> (camera coordinates, latents) at a fixed code.

    forward : voxels -> (y, z) at fixed code          an exact bijection (Eqs. 3-5)
    inverse : (y, z) -> voxels at fixed code

A `Code` is what both hold fixed: from a video and a camera (`code_from_video`), or from the events
(`api.encode`). Shapes: voxels (..., H, W, 32), y (..., H, W, 4), z (..., H, W, 28).
"""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from evflow.camera import Camera, Summary
from evflow.camera.arguments import check_key, real
from evflow.camera.optics import Optics
from evflow.camera.sensors import SensorModel
from evflow.checks import need
from evflow.errors import EvflowDataError
from evflow.network import architecture, coordinates, encoder, flow, pooling
from evflow.network.architecture import Params, config_of
from evflow.network.config import ModelConfig
from evflow.network.coordinates import unsquash_summary
from evflow.network.inputs import (
    check_change,
    check_finite,
    check_shape,
    prepare,
    same_precision,
    summary_of_pixels,
)
from evflow.network.seen import photoreceptor, seen_changes

Array = jax.Array

DEFAULT_WINDOW_S = 0.05


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class Code:
    """The condition of the flow: what the bijection between events and (y, z) holds fixed.

    Attributes:
        changes: (..., H, W, 2m), the changes of log intensity dL_j in the window's m = 16 equal
            parts, as relu(+dL_j), then relu(-dL_j); for the paper's network the encoder's feature.
        summary: of the camera, (...,).
        context: (..., H, W, 3), window length and mean log intensity.
    """

    changes: Array
    summary: Summary
    context: Array


def parts(params: Params) -> tuple[ModelConfig, Params]:
    """The static structure, and the parts of the network."""
    return config_of(params), next(iter(params.values()))


def _check_code(config: ModelConfig, code: Code) -> None:
    """Raise EV020 unless it is a code, EV018 if it is of other weights, EV002 if of two sizes."""
    need(code, Code, "code", "Give that of code_from_video(params, dL, camera), or of encode.")
    width = config.flow.condition if config.code == "feature" else 2 * config.changes
    changes, context = np.shape(code.changes), np.shape(code.context)
    if changes[-1:] != (width,):
        raise EvflowDataError(
            "EV018", f"the code's changes have shape {changes}, these weights take (..., H, W, "
            f"{width}).", "Is it of other weights? Make it with these: encode(params, ...).")
    if context != (*changes[:-1], 3):
        raise EvflowDataError("EV002", f"the code's changes have shape {changes}, its context "
                              f"{context}.", f"Expected a context {(*changes[:-1], 3)}.")


def pixel_context(window_s: Array, intensity: Array | None, shape: tuple[int, ...]) -> Array:
    """The code's context, `shape` + (3,), of window lengths (...,)."""
    return pooling.window_features(window_s[..., None, None], intensity, shape)


def code_from_video(
    params: Params, dL: ArrayLike, camera: Camera, *, window_s: ArrayLike = DEFAULT_WINDOW_S,
    intensity: ArrayLike | None = None, sensor: SensorModel | None = None,
    optics: Optics | None = None,
) -> Code:
    """Code from a video and a camera, without events: the input of `generate`.

    Args:
        params: of `load_weights`.
        dL: (..., H, W, 16), change of log intensity in each of the window's 16 equal parts,
            natural-log units.
        camera: maps (..., H, W) or (H, W), whose summary enters the code.
        window_s: length of the window in seconds, a number or (...,).
        intensity: as in `summarize`.
        sensor: the camera's circuit, whose `cutoff_hz` makes its pixels respond late; None: no
            low-pass. The light is constant before the window.
        optics: how frames recorded by this camera differ from the light on its pixels
            (`found.optics`): an offset, and the delay of its events; None for other videos.

    Returns:
        The code.

    Raises:
        EvflowDataError: EV001 (no pixel), EV002 (shape), EV003 (not logarithms), EV007 (NaN), EV014
            (camera out of range), EV015 (camera of another size), EV018 (weights of the paper's
            network, whose condition contains the events, or not weights), EV020 (window_s; or a
            sensor whose low-pass depends on an intensity that is not given).

    Example:
        >>> dL = jnp.moveaxis(jnp.diff(log_frames, axis=0), 0, -1)  # from 17 frames (17, H, W)
        >>> code = ef.code_from_video(params, dL, camera)
    """
    config, _ = parts(params)
    if config.code == "feature":
        raise EvflowDataError(
            "EV018", "the paper's condition contains the events; it cannot be computed from a "
                     "video.",
            'Use load_weights("default").')
    if np.ndim(dL) < 3 or np.shape(dL)[-1] != config.changes:
        raise EvflowDataError(
            "EV002", f"dL has shape {np.shape(dL)}.", f"Expected (..., H, W, {config.changes}), "
            "the change in each of that many equal parts of the window: sum those of finer "
            f"frames, dL.reshape(H, W, {config.changes}, -1).sum(-1).")
    check_finite("dL", dL)
    check_change("dL", dL)
    dL = real(dL)
    _, _, window_s, intensity = prepare(
        config, jnp.zeros((*dL.shape[:-1], 2 * config.bins)), dL[..., 0], window_s, intensity)
    known = summary_of_pixels(camera, dL.shape[:-1])
    context = pixel_context(window_s, intensity, dL.shape[:-1])
    return seen_code(Code(encoder.split_sign(dL), known, context), sensor, optics)


def seen_code(code: Code, sensor: SensorModel | None, optics: Optics | None) -> Code:
    """The code of the light as the pixels see it. EV020 if that depends on an intensity that is
    unknown; if it is unknown at some pixels, 55 DN is assumed there."""
    seen_by = photoreceptor(sensor, optics)
    if seen_by.ideal and not seen_by.logarithmic:
        return code
    window_s, intensity = pooling.given_features(code.context)
    traced = isinstance(code.context, jax.core.Tracer)
    if not traced and not np.asarray(code.context)[..., 2].any():
        raise EvflowDataError(
            "EV020", "a slow pixel, one that sees additional light, or one that is logarithmic in "
            "dim light too, but no intensity.", "What it sees depends on the light: pass "
            "intensity to code_from_video, the mean lin-log of the frames.")
    rise, fall = jnp.split(code.changes, 2, -1)
    changes, intensity = seen_changes(seen_by, rise - fall, intensity, window_s)
    known = code.context[..., 2]
    context = pooling.window_features(window_s, jnp.where(known > 0, intensity, jnp.nan),
                                      known.shape)
    return dataclasses.replace(code, changes=encoder.split_sign(changes), context=context)


def _flow_condition(config: ModelConfig, code: Code) -> tuple[Array, Array]:
    y = architecture.over_pixels(unsquash_summary(code.summary), code.context.shape[:-1])
    u = architecture.condition(config, code.changes, pooling.of_pixels(code.context), y)
    return u, architecture.centre(config, y)


def forward(params: Params, voxels: ArrayLike, code: Code) -> tuple[Array, Array, Array]:
    """Events -> camera coordinates and latents, exactly invertible at a fixed code (Eqs. 3-5).

    Args:
        params: of `load_weights`.
        voxels: (..., H, W, 32), events per pixel and bin.
        code: of `encode` or `code_from_video`, for the same pixels.

    Returns:
        y (..., H, W, 4), `squash(y)` is the camera (`squash(y, "tanh")` of the paper's network); z
        (..., H, W, 28), the latents; log_det (..., H, W), the log determinant of
        d(y, z) / d voxels.

    Raises:
        EvflowDataError: EV002 (voxels and code of different pixels), EV003 (not real numbers),
            EV007 (NaN), EV018 (not weights, or a code of others), EV020 (not a code).
    """
    config, net = parts(params)
    _check_code(config, code)
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


def inverse(params: Params, y: ArrayLike, z: ArrayLike, code: Code) -> Array:
    """Camera coordinates and latents -> events: the exact inverse of `forward` at the same code.

    Args:
        params: of `load_weights`.
        y: (..., H, W, 4), of `forward` or `unsquash`.
        z: (..., H, W, 28).
        code: the code of `forward`.

    Returns:
        Voxels (..., H, W, 32).

    Raises:
        EvflowDataError: EV002, EV003, EV007, EV018, EV020 as in `forward`.
    """
    config, net = parts(params)
    _check_code(config, code)
    pixels = code.context.shape[:-1]
    for name, values, channels in (("y", y, 4), ("z", z, 2 * config.bins - 4)):
        check_shape(name, values, (*pixels, channels))
    y, z = real(y), real(z)
    return _inverse(net, y, z, same_precision(y, code), config=config)


@partial(jax.jit, static_argnames="config")
def _inverse(net: Params, y: Array, z: Array, code: Code, *, config: ModelConfig) -> Array:
    u, centre = _flow_condition(config, code)
    return flow.inverse(net["flow"], y - centre, z, u, config.flow)[0]


def generate(
    params: Params, key: Array, camera: Camera, code: Code, *, sensor: SensorModel | None = None,
    optics: Optics | None = None,
) -> Array:
    """Events of a code's scene as another camera would record them, with z ~ N(0, 1).

    The code's summary is replaced by the camera's. The camera is assumed to have been running: its
    pixels' memories lie anywhere between the thresholds, whereas a simulation that starts at the
    window's first frame gives some 5 % fewer events (15 % for high thresholds). Noise follows eta
    up to the 2 Hz of the training, and hardly rises above: where nothing moves, a pixel and
    polarity has .04 events in 50 ms at 1 Hz (.05 expected), .09 at 5 Hz (.25). Values are not
    clipped: noise of the latents leaves small negative weights.

    Args:
        params: of `load_weights`.
        key: of jax.random, for z.
        camera: maps (..., H, W) or (H, W).
        code: of `code_from_video`, or of `encode`.
        sensor: the circuit of this camera, whose `cutoff_hz` makes its pixels respond late to the
            code's light; None if the code already describes what they see
            (`code_from_video(sensor=...)`).
        optics: as in `code_from_video`.

    Returns:
        Voxels (..., H, W, 32).

    Raises:
        EvflowDataError: EV002, EV014 (no valid camera), EV015 (camera of another size), EV018 (not
            weights, a code of others, or a sensor with the paper's network), EV020 (a sensor whose
            low-pass depends on an intensity that the code does not have; no key, camera or code).
    """
    config, _ = parts(params)
    check_key(key)
    need(camera, Camera, "camera", "For example that of estimate_camera: found.camera.")
    _check_code(config, code)
    if config.code == "feature" and not photoreceptor(sensor, optics).ideal:
        raise EvflowDataError(
            "EV018", "the paper's condition contains the events, not the light that a low-pass "
                     "could act on.",
            'Use load_weights("default").')
    code = seen_code(code, sensor, optics)
    shape = code.context.shape[:-1]
    known = summary_of_pixels(camera, shape)
    y = jnp.broadcast_to(coordinates.unsquash(camera, config.output), (*shape, 4))
    z = jax.random.normal(key, (*shape, 2 * config.bins - 4))
    return inverse(params, y, z, dataclasses.replace(code, summary=known))


def log_prob(params: Params, voxels: ArrayLike, code: Code) -> Array:
    """Log density of events given a code (Eq. 3): y ~ N(summary, mismatch^2), z ~ N(0, 1).

    A density only if the code came from a true video and a camera (`code_from_video`); with an
    encoded code, which depends on the events, it is a score.

    Args:
        params: of `load_weights`.
        voxels: (..., H, W, 32), events per pixel and bin.
        code: for the same pixels.

    Returns:
        Natural-log density of each pixel, (..., H, W).

    Raises:
        EvflowDataError: EV002, EV003, EV007 as in `forward`; EV018 (weights of the paper's
            network, which has no summary, or not weights).
    """
    if not config_of(params).pool:
        raise EvflowDataError("EV018", "these weights have no summary, the mean of y's density.",
                              "Use the default network's.")
    y, z, log_det = forward(params, voxels, code)
    y6 = architecture.over_pixels(unsquash_summary(code.summary), y.shape[:-1])
    prior = architecture.log_normal(y, y6[..., :4], architecture.base_std(y6)).sum(-1)
    return prior + architecture.log_normal(z, 0.0, jnp.ones(())).sum(-1) + log_det
