"""Scores of images against frames, and means over seeds with their confidence."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import stdtrit

from evflow.metrics import psnr, rmse, ssim

Array = jax.Array
SCORES = ("rmse", "psnr", "ssim", "ssim_global")


def score(images: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """SCORES (N, 4) of images (N, H, W) against frames, DN 0..255 and rounded to bytes: RMSE in
    DN, PSNR in dB, SSIM by Gaussian windows (sigma 1.5), SSIM with one window (ECC's)."""
    pair = [jnp.asarray(np.rint(np.clip(i, 0, 255)) / 255, jnp.float32) for i in (images, frames)]
    return np.asarray(_score(*pair))


@jax.jit
def _score(a: Array, b: Array) -> Array:
    return jnp.stack([rmse(a, b), psnr(a, b), ssim(a, b), ssim(a, b, "global")], -1)


def mean_ci(values: np.ndarray) -> tuple[float, float]:
    """Mean and the half-width of its 95 % interval (Student's t); 0 of a single value."""
    n = len(values)
    if n < 2:
        return float(values.mean()), 0.0
    return float(values.mean()), float(stdtrit(n - 1, 0.975) * values.std(ddof=1) / np.sqrt(n))
