"""From pixel values (DN, 0..255) to log intensity, and back.

All logarithms are natural. `lin_log` is v2e's map: linear below 20 DN and logarithmic above, so
that quantisation steps in dark pixels do not become contrast. `log_eps` is ESIM's.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from evflow.checks import plain
from evflow.errors import EvflowDataError
from evflow.light.ranges import check_bits

DEPTHS = (np.dtype(np.uint8), np.dtype(np.uint16))  # dtypes whose maximum is white

Array = jax.Array
Values = Any  # jax.Array or np.ndarray; results have the same type

LINLOG_KNEE = 20.0  # DN; v2e's threshold between the linear and the logarithmic part
LINLOG_SLOPE = float(np.log(LINLOG_KNEE) / LINLOG_KNEE)
LOG_EPS = 1e-3
LOG_EPS_DN = 255.0 * LOG_EPS
MOST_LOG = 6.0  # above the logarithm of 255 DN
MOST_OF_ONE = 12.0  # for a single pixel: a thousand times as bright as white
SAMPLED = 61  # stride of the values that are compared with it
BELOW_BLACK = -1e-3  # lin-log begins at 0, but for rounding
TO_DN = ("Scale both: evflow.light.log_maps.to_dn(frame, {:g}); if they are really that dark: "
         "to_dn(frame, 65535).")
MOST_EPS = 0.1  # mean of `log_eps`, which ends at .001: above, the average would outshine white


def lin_log(dn: ArrayLike) -> Array:
    """v2e's lin-log map of DN 0..255: I ln(20)/20 up to 20 DN, ln I above. Range 0..5.54."""
    dn = jnp.asarray(dn)
    dn = dn if jnp.issubdtype(dn.dtype, jnp.floating) else dn.astype(jnp.float32)
    above = jnp.log(jnp.maximum(dn, LINLOG_KNEE))
    return jnp.where(dn <= LINLOG_KNEE, dn * LINLOG_SLOPE, above)


def lin_log_inverse(log_i: Array) -> Array:
    """The DN of a lin-log value."""
    above = jnp.exp(jnp.maximum(log_i, LINLOG_KNEE * LINLOG_SLOPE))
    return jnp.where(log_i <= LINLOG_KNEE * LINLOG_SLOPE, log_i / LINLOG_SLOPE, above)


def log_eps(dn: ArrayLike) -> Array:
    """ESIM's map ln(I/255 + 1e-3) of DN 0..255."""
    dn = jnp.asarray(dn)
    dn = dn if jnp.issubdtype(dn.dtype, jnp.floating) else dn.astype(jnp.float32)
    return jnp.log(dn / 255.0 + LOG_EPS)


def log_eps_inverse(log_i: Array) -> Array:
    """The DN of a `log_eps` value."""
    return 255.0 * (jnp.exp(log_i) - LOG_EPS)


def log_dn(dn: ArrayLike) -> Array:
    """`log_eps` in units of DN, ln(I + .255): for I far above .255 the same as ln I."""
    return jnp.log(jnp.asarray(dn) + LOG_EPS_DN)


def log_dn_inverse(log_i: Array) -> Array:
    """The DN of a `log_dn` value."""
    return jnp.exp(log_i) - LOG_EPS_DN


LOG_MAPS = {"linlog": (lin_log, lin_log_inverse), "log_eps": (log_eps, log_eps_inverse)}


@lru_cache
def uint8_table(log_map: str) -> np.ndarray:
    """The log map of the 256 byte values, computed in float64 and rounded to 1e-8 as in v2e,
    then float32: exact threshold ties of 8-bit video are resolved as in v2e."""
    value = log64(np.arange(256), log_map)
    return (np.round(value, 8) if log_map == "linlog" else value).astype(np.float32)


def log64(dn: np.ndarray, log_map: str) -> np.ndarray:
    """The log map of DN 0..255 in float64 (host)."""
    dn = dn.astype(np.float64)
    if log_map == "linlog":
        return np.where(dn <= LINLOG_KNEE, dn * LINLOG_SLOPE, np.log(np.maximum(dn, 1.0)))
    return np.log(dn / 255.0 + LOG_EPS)


def to_log(frames: ArrayLike, log_map: str = "linlog") -> Array:
    """Log intensity (float32) of uint8 or float DN frames 0..255, or uint16 on 0..65535."""
    frames = jnp.asarray(plain("frames", frames))
    if frames.dtype == jnp.uint8:
        return jnp.take(jnp.asarray(uint8_table(log_map)), frames, axis=0, mode="clip")
    if frames.dtype == jnp.uint16:
        frames = frames.astype(jnp.float32) * (255.0 / 65535.0)
    return LOG_MAPS[log_map][0](frames.astype(jnp.float32))


def check_log(name: str, values: Any, log_map: str | None = None) -> None:
    """Raise EV007 unless all values are finite (fast path: a finite sum implies it), EV003 if they
    cannot be logarithms of DN, in this map if one is given. Traced values pass."""
    if isinstance(values, jax.core.Tracer):
        return
    values = np.asarray(values)
    with np.errstate(over="ignore", invalid="ignore"):
        wide = np.float64 if values.dtype.itemsize < 4 else None  # half precision overflows
        mean = values.sum(dtype=wide) / max(values.size, 1)
        if not (np.isfinite(mean) or np.isfinite(values).all()):
            raise EvflowDataError(
                "EV007", f"{name} holds NaN or infinite values.",
                "A logarithm of 0, or of a missing pixel? Use evflow.light.log_maps.to_log.")
    if log_map == "log_eps" and mean > MOST_EPS:
        raise EvflowDataError(
            "EV003", f"{name} has a mean of {mean:.3g}, but the model's log_map is 'log_eps', in "
            "which white is 0.",
            "Convert frames in DN: evflow.light.log_maps.to_log(frames, 'log_eps').")
    if 0 < mean < 1:
        _check_no_fractions(name, values)
    some = float(values.reshape(-1)[::SAMPLED].max(initial=0))
    if mean > MOST_LOG or some > MOST_OF_ONE:
        raise EvflowDataError(
            "EV003", f"{name} has a mean of {mean:.3g} and reaches {max(some, mean):.3g}, but the "
            "logarithm of white (255 DN) is 5.54.",
            "Is it DN? Convert: evflow.light.log_maps.to_log(frames).")
    if log_map == "linlog" and values.size and (low := float(values.min())) < BELOW_BLACK:
        raise EvflowDataError(
            "EV003", f"{name} reaches down to {low:.3g}, but the model's log_map is 'linlog', in "
            "which black is 0.",
            "Convert frames in DN: evflow.light.log_maps.to_log(frames). If it is log(I / 255 + "
            ".001), as ESIM's: SensorModel(log_map='log_eps').")


def _check_no_fractions(name: str, values: np.ndarray) -> None:
    """Raise EV003 if all values are non-negative logarithms of DN below 7: those are fractions of
    white, not logarithms."""
    low, high = values.min(), values.max()
    if low >= 0 and high <= 1:
        raise EvflowDataError(
            "EV003", f"{name} spans {low:.3g}..{high:.3g}, but the logarithm of white is 5.54.",
            "Fractions of white? Convert: evflow.light.log_maps.to_log(255 * frames).")


def to_dn(frames: np.ndarray, full_scale: float) -> np.ndarray:
    """Frames on 0..full_scale (255, 1023, 4095, 65535...) as float32 DN on 0..255 (host)."""
    if not full_scale > 0:
        raise EvflowDataError("EV020", f"full_scale={full_scale}.", "It must be > 0.")
    return np.asarray(frames, np.float32) * np.float32(255.0 / full_scale)


def normalised_intensity(dn: Values) -> Values:
    """I01 = (I + 20) / 275 in (.07, 1]: v2e's rescaling, N_01 of Eq. 12."""
    return (dn + 20.0) / 275.0


def noise_factor(i01: Values) -> Values:
    """((F - 1) I01 + 1) of Eq. 12 with F = 0.25: noise decreases linearly with intensity."""
    return 1.0 - 0.75 * i01


def mean_and_change(frame0: ArrayLike, frame1: ArrayLike) -> tuple[Array, Array]:
    """Mean of the lin-log intensity of two frames in DN on 0..255, and its change."""
    before, after = lin_log(frame0), lin_log(frame1)
    return 0.5 * (before + after), after - before


def delta_log_intensity(frame0: ArrayLike, frame1: ArrayLike) -> Array:
    """Change of log intensity between two frames: the dlogI of `estimate`.

    The logarithm is v2e's lin-log, I ln(20)/20 up to 20 DN and ln I above.

    Args:
        frame0: (..., H, W) grey frames at the start of the window: uint8, floats on 0..255 DN, or
            uint16 on 0..65535 (`evflow.light.log_maps.to_dn` for fewer bits: values that all lie
            below 4096 are refused).
        frame1: frames at its end, of the same shape.

    Returns:
        float32 (..., H, W), natural-log units, > 0 where the pixel became brighter.

    Raises:
        EvflowDataError: EV002 (shapes differ, or colour), EV003 (dtype or range), EV007 (NaN).

    Example:
        >>> dlogI = ef.delta_log_intensity(window.frame0, window.frame1)
    """
    before, after = _native(frame0), _native(frame1)
    for name, frame in (("frame0", before), ("frame1", after)):
        _check_frame(name, frame)
    if before.shape != after.shape:
        raise EvflowDataError(
            "EV002", f"the frames differ in shape: {before.shape} and {after.shape}.")
    if len({f.dtype for f in (before, after) if f.dtype in DEPTHS}) > 1:
        raise EvflowDataError("EV003", f"the frames are {before.dtype} and {after.dtype}.",
                              "They are on different scales: evflow.light.log_maps.to_dn on each.")
    if before.dtype == np.uint16 == after.dtype and not isinstance(before, jax.core.Tracer):
        check_bits(max(int(np.max(f, initial=0)) for f in (before, after)), TO_DN)
    return to_log(after) - to_log(before)


def _native(frame: ArrayLike) -> Any:
    """The array in this machine's byte order."""
    if isinstance(frame, jax.Array):
        return frame
    frame = np.asarray(plain("frame", frame))
    return frame.astype(frame.dtype.newbyteorder("="), copy=False)


def _check_frame(name: str, frame: Any) -> None:
    shape = frame.shape
    if len(shape) < 2:
        raise EvflowDataError("EV002", f"{name} has shape {shape}.", "Expected (..., H, W).")
    if len(shape) > 2 and shape[-1] in (3, 4) and shape[-2] > 16:
        raise EvflowDataError("EV002", f"{name} has shape {shape}: colour?",
                              "Expected grey frames (..., H, W): evflow.light.colour.luma(frame).")
    if frame.dtype in DEPTHS or isinstance(frame, jax.core.Tracer):
        return
    if not jnp.issubdtype(frame.dtype, jnp.integer) and not jnp.issubdtype(
            frame.dtype, jnp.floating):
        raise EvflowDataError("EV003", f"{name} is {frame.dtype}.",
                              "Expected uint8, uint16 or DN on 0..255.")
    low, high = float(np.min(frame, initial=0.0)), float(np.max(frame, initial=0.0))
    if not np.isfinite([low, high]).all():
        raise EvflowDataError("EV007", f"{name} holds NaN or infinite values.")
    if low < 0 or high > 255.5 or 0 < high <= 1:
        raise EvflowDataError(
            "EV003", f"{name} reaches from {low:.4g} to {high:.4g}.",
            "Expected DN on 0..255, not their logarithm nor 0..1; scale with "
            "evflow.light.log_maps.to_dn.")
