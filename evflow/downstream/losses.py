"""Losses of the event networks: image similarity, temporal consistency, optical flow.

Every loss is a scalar of sequences with time first; pure and differentiable.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jax.scipy.ndimage import map_coordinates

from evflow.metrics.image import ssim
from evflow.metrics.perceptual import Params, lpips

Array = jax.Array

OCCLUSION = 50.0  # of exp(-50 (I1 - W(I0))^2): frames that differ by .14 count e^-1
CHARBONNIER, SMOOTHNESS = 0.45, 0.5  # EV-FlowNet's exponent, and weight of smoothness
DN = 255.0  # of a frame's white


def reconstruction(images: Array, frames: Array, lpips_params: Params | None = None) -> Array:
    """Images and true frames (T, B, H, W) on [0, 1]: LPIPS with its weights, else L1 plus
    1 - SSIM; both measure structure rather than brightness, which events do not determine."""
    if lpips_params is not None:
        return jnp.mean(lpips(lpips_params, images, frames))
    return jnp.mean(jnp.abs(images - frames)) + jnp.mean(1.0 - ssim(images, frames))


def temporal(images: Array, frames: Array, back: Array, visible: Array, skip: int = 2) -> Array:
    """Temporal consistency (Lai et al., ECCV 2018) of images after the first `skip`: the image
    before, moved along the true flow, should equal this one, where the frames themselves do. S2R's
    L0 is the first image compared, so its 2 is a skip of 1.

    images, frames, visible: (T, B, H, W); back (T, B, 2, H, W): from frame t to where its points
    were in frame t - 1.
    """
    before, now = slice(skip, -1), slice(skip + 1, None)
    moved_frame = warp(frames[before], back[now])
    moved_image = warp(images[before], back[now])
    trust = jnp.exp(-OCCLUSION * (frames[now] - moved_frame) ** 2) * visible[now]
    size = jnp.abs(images[now]) + jnp.abs(moved_image) + 1e-5
    return jnp.mean(trust * jnp.abs(images[now] - moved_image) / size)


def warp(images: Array, back: Array) -> Array:
    """Images (..., H, W) read bilinearly at each pixel plus back (..., 2, H, W); 0 outside."""
    height, width = images.shape[-2:]
    x = jnp.arange(width, dtype=back.dtype)[None, :]
    y = jnp.arange(height, dtype=back.dtype)[:, None]

    def one(image: Array, back: Array) -> Array:
        return map_coordinates(image, [y + back[1], x + back[0]], order=1, mode="constant")

    flat = jax.vmap(one)(images.reshape(-1, height, width), back.reshape(-1, 2, height, width))
    return flat.reshape(images.shape)


def flow_l1(flow: Array, truth: Array, weight: Array | float = 1.0) -> Array:
    """Mean absolute error of flows (T, B, 2, H, W), px; weight (T, B, H, W) of each pixel."""
    error = jnp.abs(flow - truth).mean(-3)
    weight = jnp.broadcast_to(jnp.asarray(weight, error.dtype), error.shape)
    return jnp.sum(weight * error) / jnp.maximum(jnp.sum(weight), 1.0)


def photometric(flows: Sequence[Array], before: Array, after: Array) -> Array:
    """Self-supervised loss of flow from the frames at a window's ends (EV-FlowNet, Zhu et al., RSS
    2018, Eqs. 3-5), summed over scales: `after` warped by the flow against `before`, plus
    smoothness.

    before, after: (..., H, W) on [0, 1]. flows: one (..., 2, h, w) per scale, px of that scale.
    Frames are compared in DN, as by the authors, for whose scale the weight of smoothness was
    chosen. Outside the image is black, so that flow out of the image is penalised.
    """
    total = jnp.zeros((), before.dtype)
    for flow in flows:
        shape = (*before.shape[:-2], *flow.shape[-2:])
        first, second = (jax.image.resize(DN * frame, shape, "linear")
                         for frame in (before, after))
        total += jnp.mean(_charbonnier(warp(second, flow) - first))
        total += SMOOTHNESS * _roughness(flow)
    return total


def _charbonnier(x: Array) -> Array:
    return (x**2 + 1e-6) ** CHARBONNIER


def _roughness(flow: Array) -> Array:
    """Mean difference to neighbours: vertical, horizontal and along both diagonals."""
    pairs = ((flow[..., 1:, :], flow[..., :-1, :]), (flow[..., 1:], flow[..., :-1]),
             (flow[..., 1:, 1:], flow[..., :-1, :-1]), (flow[..., 1:, :-1], flow[..., :-1, 1:]))
    return sum((jnp.mean(_charbonnier(a - b)) for a, b in pairs), jnp.zeros(())) / len(pairs)
