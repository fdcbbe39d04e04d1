"""Similarity of images: MSE, RMSE, PSNR, SSIM, and the error of intensity changes.

Images are (..., H, W) on [0, 1], results (...): one number an image. Pure, jit-able; leading
axes batch. SSIM is one name for several numbers (the same pair: .61 by `evreal`, .75 by `etnet`,
.91 by `global`), so the preset is always reported.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from evflow.errors import EvflowDataError

Array = jax.Array

FULL_SCALE = 255.0  # DN of RMSE
K1, K2 = 0.01, 0.03  # of SSIM's constants (K range)^2


@dataclasses.dataclass(frozen=True)
class SsimPreset:
    """A convention of SSIM. window: normalised weights of the taps along an axis, () for one
    window over the image; sample: variances are unbiased; data_range: of the constants."""

    window: tuple[float, ...]
    sample: bool
    data_range: float


def _gaussian(sigma: float, radius: int) -> tuple[float, ...]:
    taps = np.exp(-0.5 * (np.arange(-radius, radius + 1) / sigma) ** 2)
    return tuple((taps / taps.sum()).tolist())


SSIM = {
    # EVREAL; Wang et al. 2004: Gaussian of sigma 1.5, 11 x 11, range 1.
    "evreal": SsimPreset(_gaussian(1.5, 5), False, 1.0),
    # ET-Net, S2R and their time: uniform 7 x 7; range 2, an old default for floats in [0, 1].
    "etnet": SsimPreset((1.0 / 7.0,) * 7, True, 2.0),
    # ECC's evaluation: one covariance over the image, means by column.
    "global": SsimPreset((), True, 1.0),
}


def least_side(preset: str) -> int:
    """Pixels that each side of an image must have for SSIM by this preset."""
    return max(len(SSIM[preset].window), 2)


def check_images(*images: Any) -> list[Array]:
    """The images as arrays. Raises EV003 for integers, EV002 for other shapes than (..., H, W) and
    for sizes or leading axes that differ."""
    arrays = [check_floats(image) for image in images]
    for image in arrays:
        if image.ndim < 2:
            raise EvflowDataError("EV002", f"an image of shape {image.shape}.",
                                  "Expected (..., H, W).")
    if len({image.shape[-2:] for image in arrays}) > 1 or not pair_up(*arrays):
        raise EvflowDataError(
            "EV002", f"images of different shapes: {', '.join(str(i.shape) for i in arrays)}.",
            "Expected (..., H, W) of one size and one number; resize or repeat one of them.")
    return arrays


def check_floats(image: Any) -> Array:
    """A list as an array, an array as it is; EV003 for integers, EV002 for ragged lists."""
    image = as_array(image)
    if not jnp.issubdtype(image.dtype, jnp.floating):
        raise EvflowDataError("EV003", f"an image of {image.dtype}.",
                              "Expected floats on [0, 1]: divide bytes by 255.")
    return image


def as_array(values: Any) -> Array:
    """An array, with the precision of JAX and NumPy arrays; half precision, in which sums over an
    image overflow, becomes float32. Raises EV002 for other objects."""
    if not hasattr(values, "dtype"):
        try:
            values = jnp.asarray(values)
        except (TypeError, ValueError) as e:
            raise EvflowDataError(
                "EV002", f"a {type(values).__name__} that is no array ({e}).") from e
    half = jnp.issubdtype(values.dtype, jnp.floating) and values.dtype.itemsize < 4
    return values.astype(jnp.float32) if half else values


def pair_up(*arrays: Array) -> bool:
    """Whether arrays can be taken element by element: `check_images` compares the sizes first."""
    try:
        np.broadcast_shapes(*(a.shape for a in arrays))
    except ValueError:
        return False
    return True


def mse(image: Array, reference: Array) -> Array:
    """Mean squared error. Raises EV002 for different sizes and EV003 for integers, as do the
    measures based on it."""
    image, reference = check_images(image, reference)
    return jnp.mean((image - reference) ** 2, (-2, -1))


def rmse(image: Array, reference: Array) -> Array:
    """Root mean squared error in DN, 0..255."""
    return FULL_SCALE * jnp.sqrt(mse(image, reference))


def psnr(image: Array, reference: Array) -> Array:
    """Peak signal to noise ratio in dB, 10 log10(1 / MSE); inf for equal images."""
    return -10.0 / math.log(10.0) * jnp.log(mse(image, reference))


def ssim(image: Array, reference: Array, preset: str = "evreal") -> Array:
    """Structural similarity by a convention of `SSIM`: "evreal", "etnet" or "global".

    Raises EV020 for another preset, EV003 for images of integers, EV002 for images smaller than
    its window.
    """
    if preset not in tuple(SSIM):
        raise EvflowDataError("EV020", f"SSIM preset {preset!r}.", f"Choose one of {list(SSIM)}.")
    image, reference = check_images(image, reference)
    how = SSIM[preset]
    if min(image.shape[-2:]) < least_side(preset):
        raise EvflowDataError("EV002", f"images of {image.shape[-2:]} pixels.",
                              f"SSIM by {preset!r} needs at least {least_side(preset)}.")
    return (_ssim_windowed if how.window else _ssim_global)(image, reference, how)


def _ssim_windowed(x: Array, y: Array, how: SsimPreset) -> Array:
    """Mean of the local index where the window is wholly inside the image."""
    taps = len(how.window)
    unbiased = taps**2 / (taps**2 - 1) if how.sample else 1.0
    # Moments about the image's mean, for less cancellation.
    around_x, around_y = (jnp.mean(a, (-2, -1), keepdims=True) for a in (x, y))
    x, y = x - around_x, y - around_y
    mean_x, mean_y = _blur(x, how.window), _blur(y, how.window)
    var_x = unbiased * (_blur(x * x, how.window) - mean_x**2)
    var_y = unbiased * (_blur(y * y, how.window) - mean_y**2)
    covariance = unbiased * (_blur(x * y, how.window) - mean_x * mean_y)
    mean_x, mean_y = mean_x + around_x, mean_y + around_y
    c1, c2 = (K1 * how.data_range) ** 2, (K2 * how.data_range) ** 2
    above = (2 * mean_x * mean_y + c1) * (2 * covariance + c2)
    below = (mean_x**2 + mean_y**2 + c1) * (var_x + var_y + c2)
    return jnp.mean(above / below, (-2, -1))


def _ssim_global(x: Array, y: Array, how: SsimPreset) -> Array:
    """The index of each column's means and the image's covariance, as one number: the factor
    that maps the denominators to the numerators best, which is MATLAB's row / row."""
    centred = [a - jnp.mean(a, (-2, -1), keepdims=True) for a in (x, y)]
    pixels = x.shape[-2] * x.shape[-1] - 1

    def moment(a: Array, b: Array) -> Array:
        return jnp.sum(a * b, (-2, -1))[..., None] / pixels

    mean_x, mean_y = jnp.mean(x, -2), jnp.mean(y, -2)
    c1, c2 = (K1 * how.data_range) ** 2, (K2 * how.data_range) ** 2
    above = (2 * mean_x * mean_y + c1) * (2 * moment(*centred) + c2)
    spread = moment(centred[0], centred[0]) + moment(centred[1], centred[1])
    below = (mean_x**2 + mean_y**2 + c1) * (spread + c2)
    return jnp.sum(above * below, -1) / jnp.sum(below**2, -1)


def _blur(x: Array, window: tuple[float, ...]) -> Array:
    """Separable filter of (..., H, W), where it fits: (..., H - n + 1, W - n + 1).

    As products with banded matrices: the gradient of a sum of shifted slices is a sum of padded
    ones, which on a CPU takes ten times as long.
    """
    across = _banded(x.shape[-1], window).astype(x.dtype)
    down = _banded(x.shape[-2], window).T.astype(x.dtype)
    x = jnp.matmul(x, across, precision="highest")
    return jnp.einsum("hk,...kw->...hw", down, x, precision="highest")


@functools.cache
def _banded(size: int, window: tuple[float, ...]) -> np.ndarray:
    """(size, size - n + 1): column i holds the window from row i on."""
    tap = np.arange(size)[:, None] - np.arange(size - len(window) + 1)
    taps = np.append(window, 0.0)
    return taps[np.where((tap >= 0) & (tap < len(window)), tap, -1)]


def log_map(image: Array) -> Array:
    """[0, 1] -> [0, 1] by log(1 + 255 I) / log 256: the log domain of these metrics. EV003 for
    integers."""
    image = check_floats(image)
    return jnp.log1p(FULL_SCALE * jnp.clip(image, 0.0, 1.0)) / math.log(1.0 + FULL_SCALE)


def mae_intensity_change(change: Array, reference: Array, *, magnitude: bool = False) -> Array:
    """Mean absolute error of changes of log intensity (..., H, W), natural log, in units of
    ln 255 (Table XI). magnitude: of their absolute values, limited to 0..1, as the paper's.
    Raises EV002 for two sizes, EV003 for integers."""
    change, reference = check_images(change, reference)
    x, y = change / math.log(FULL_SCALE), reference / math.log(FULL_SCALE)
    if magnitude:
        x, y = jnp.clip(jnp.abs(x), 0.0, 1.0), jnp.clip(jnp.abs(y), 0.0, 1.0)
    return jnp.mean(jnp.abs(x - y), (-2, -1))
