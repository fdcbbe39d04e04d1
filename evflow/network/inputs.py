"""Input validation of the network: arrays are checked and converted to real numbers.

Wrong shapes, dtypes, values and units raise `EvflowDataError`s that say what was seen; of traced
values only the shape is checked. Inner functions check nothing.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from evflow.camera import Camera, Summary
from evflow.camera.arguments import is_real, real, real_maps
from evflow.checks import plain
from evflow.errors import EvflowDataError
from evflow.light.log_maps import check_log
from evflow.network.config import ModelConfig

Array = jax.Array

MOST_CHANGE = 7.0  # log units: above black to white, in lin-log and in log(DN / 255 + .001)
LONGEST_WINDOW_S = 10.0  # a hundred times the longest in training: more is probably microseconds


def same_precision(values: Array, tree: Any) -> Any:
    """The tree's leaves in the precision of `values`, since the coarser one limits the result."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, values.dtype), tree)


def check_finite(name: str, values: ArrayLike) -> None:
    """Raise EV003 for values that are not real numbers, EV007 if they are not finite."""
    if isinstance(values, jax.core.Tracer):
        return
    given = np.asarray(plain(name, values))
    if not is_real(given.dtype):
        raise EvflowDataError("EV003", f"{name} has dtype {given.dtype}.",
                              "Expected real numbers.")
    if not np.isfinite(given).all():
        raise EvflowDataError("EV007", f"{name} holds NaN or infinite values.",
                              "A logarithm of missing pixels? Set them to 0.")


def check_shape(name: str, values: ArrayLike, expected: tuple[int, ...]) -> None:
    """Raise EV002 unless the shape matches a code's pixels; then check as `check_finite`."""
    if np.shape(values) != expected:
        raise EvflowDataError(
            "EV002", f"{name} has shape {np.shape(values)}, the code's pixels are "
            f"{expected[:-1]}.", f"Expected {expected}: both must come from one window.")
    check_finite(name, values)


def prepare(
    config: ModelConfig, voxels: ArrayLike, dlogI: ArrayLike, window_s: ArrayLike,
    intensity: ArrayLike | None,
) -> tuple[Array, Array, Array, Array | None]:
    """Checked real inputs; window_s (...,), intensity (..., H, W) or None."""
    channels = 2 * config.bins
    if np.ndim(voxels) < 3 or np.shape(voxels)[-1] != channels:
        raise EvflowDataError(
            "EV002", f"voxels have shape {np.shape(voxels)}.",
            f"Expected (..., H, W, {channels}): {config.bins} ON bins, then {config.bins} OFF bins,"
            " as returned by voxelize.")
    if np.shape(dlogI) != np.shape(voxels)[:-1]:
        raise EvflowDataError(
            "EV002", f"dlogI has shape {np.shape(dlogI)}, voxels {np.shape(voxels)}.",
            "dlogI must have the shape of voxels without channels: (..., H, W).")
    if 0 in np.shape(dlogI):
        raise EvflowDataError("EV001", f"voxels of shape {np.shape(voxels)} hold no pixel.")
    for name, value in (("voxels", voxels), ("dlogI", dlogI), ("window_s", window_s)):
        check_finite(name, value)
    _check_counts(voxels)
    check_change("dlogI", dlogI)
    if not isinstance(window_s, jax.core.Tracer):
        length = np.asarray(window_s)
        if not ((length > 0) & (length <= LONGEST_WINDOW_S)).all():
            raise EvflowDataError(
                "EV020", f"window_s={window_s}.",
                f"It must be a length in seconds, > 0 and at most {LONGEST_WINDOW_S:g}.")
    voxels, dlogI = real(voxels), real(dlogI)
    lead = dlogI.shape[:-2]
    window_s = _spread_over("window_s", jnp.asarray(window_s, jnp.float32), lead)
    if intensity is not None:
        intensity = _intensity(intensity, dlogI.shape)
    return voxels, dlogI, window_s, intensity


def _intensity(values: ArrayLike, shape: tuple[int, ...]) -> Array:
    values = plain("intensity", values, "np.nan")
    if np.shape(values) not in ((), shape[:-2]) and np.shape(values)[-2:] != shape[-2:]:
        raise EvflowDataError(
            "EV002", f"intensity has shape {np.shape(values)}, the pixels {shape}.",
            f"Give one value for each pixel, {shape}, or for each window, "
            f"{shape[:-2] or 'a number'}.")
    if not isinstance(values, jax.core.Tracer):
        given = np.asarray(values)
        if not is_real(given.dtype):
            raise EvflowDataError("EV003", f"intensity has dtype {given.dtype}.",
                                  "Expected logarithms (lin-log of DN), NaN where unknown.")
        known = given[~np.isnan(given)]
        check_log("intensity", known)
        if known.size and known.min() < 0:
            raise EvflowDataError("EV003", f"the minimum of intensity is {known.min():.3g}.",
                                  "Black is 0 in lin-log of DN; use NaN where it is unknown.")
    result = jnp.asarray(values, jnp.float32)
    if result.shape == shape[:-2]:
        result = result[..., None, None]
    return _spread_over("intensity", result, shape)


def check_change(name: str, values: ArrayLike) -> None:
    """Raise EV003 if values, changes of log intensity, exceed the change from black to white, or
    are whole numbers other than 0."""
    if isinstance(values, jax.core.Tracer):
        return
    values = np.asarray(values)
    if values.dtype.kind in "biu" and values.any():
        raise EvflowDataError(
            "EV003", f"{name} has dtype {values.dtype}, but changes of log intensity are mostly "
            "below 1.", "A difference of DN? Use evflow.delta_log_intensity.")
    most = np.abs(values).max()
    if most > MOST_CHANGE:
        raise EvflowDataError(
            "EV003", f"{name} reaches {most:.3g} in magnitude, but black to white is 5.54.",
            "A difference of DN? Use evflow.delta_log_intensity.")


def _check_counts(voxels: ArrayLike) -> None:
    """Raise EV003 for values that are not counts; small negative ones from `generate` pass."""
    if isinstance(voxels, jax.core.Tracer):
        return
    given = np.asarray(voxels)
    if (least := given.min()) <= -1 or given.sum(dtype=np.float64) < 0:
        raise EvflowDataError(
            "EV003", f"the minimum of voxels is {least:.3g}, but they count events.",
            "Signed polarities in one grid, or normalised? Use evflow.voxelize.")


def _spread_over(name: str, values: Array, shape: tuple[int, ...]) -> Array:
    """Broadcast to shape; raises EV002."""
    try:
        return jnp.broadcast_to(values, shape)
    except ValueError:
        raise EvflowDataError(
            "EV002", f"{name} has shape {values.shape}.",
            f"Expected one value, or the voxels' {shape}.") from None


def given_summary(summary: Summary, lead: tuple[int, ...]) -> Summary:
    """A summary from the caller, (...,) or scalars, broadcast to lead; raises EV002, EV014."""
    if not isinstance(summary, Summary):
        raise EvflowDataError("EV003", f"summary is a {type(summary).__name__}.",
                              "Expected a Summary, as returned by evflow.finish.")
    for name, value in vars(summary).items():
        if isinstance(value, jax.core.Tracer):
            continue
        array = np.asarray(value)
        allowed = array > 0 if name.startswith("theta") else array >= 0
        if not (np.isfinite(array) & allowed).all():
            raise EvflowDataError("EV014", f"the summary's {name} is {array}.",
                                  "Thresholds must be > 0, noise rates and mismatches >= 0.")
    return Summary(**{name: _spread_over(f"the summary's {name}", real(value), lead)
                      for name, value in vars(summary).items()})


def camera_summary(camera: Camera) -> Summary:
    """Medians and mismatches of a camera's maps (..., H, W)."""
    def median(m: Array) -> Array:
        return jnp.median(m, axis=(-2, -1))

    def sigma(m: Array) -> Array:  # 1.4826 MAD: robust to pixels at the clamp
        return 1.4826 * median(jnp.abs(m - median(m)[..., None, None]))

    return Summary(median(camera.theta_on), median(camera.theta_off), median(camera.eta_on),
                   median(camera.eta_off), sigma(camera.theta_on), sigma(camera.theta_off))


def summary_of_pixels(camera: Camera, shape: tuple[int, ...]) -> Summary:
    """The summary (...,) of a camera with maps (..., H, W) or (H, W), for pixels of this shape;
    raises EV014, EV015."""
    camera = real_maps(camera.validate())
    lead = camera.shape[:-2]
    if camera.shape[-2:] != shape[-2:] or lead not in ((), shape[:-2]):
        raise EvflowDataError(
            "EV015", f"the camera has shape {camera.shape}, the pixels {shape}.",
            "Give maps (H, W), or one camera for each of the leading axes.")
    return jax.tree.map(lambda v: jnp.broadcast_to(v, shape[:-2]), camera_summary(camera))
