"""Wasserstein critics of event counts, one per class of patches, with gradient penalty.

Patches are sorted by the structure tensor of their frame, as in RAISR (Romano, Isidoro, Milanfar,
IEEE TCI 2017): angle, strength and coherence of the gradient. All critics' params and optimiser
states are stacked on a leading axis; a step updates a few of them.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax

from evflow.baselines.unet import KERNEL

Array = jax.Array
Params = Any

PENALTY = 1.0  # weight of the gradient penalty, as published
CRITICS = 8  # class counts are rounded up to a multiple, so that few programs are compiled
CHANNELS = 4  # of `features`


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class Patches:
    """places (C, M, 3) int32: clip, row and column of the patches of each of C classes, repeated
    to M; share (C,): of all patches, 0 for classes that are padding."""

    places: Array
    share: Array


class Critic(nn.Module):
    """A score (...,) of a patch (..., P, P, CHANNELS): dense layers."""

    hidden: tuple[int, ...]

    @nn.compact
    def __call__(self, x: Array) -> Array:
        x = x.reshape(*x.shape[:-3], -1)
        for width in self.hidden:
            x = nn.leaky_relu(nn.Dense(width, kernel_init=KERNEL)(x), 0.2)
        return nn.Dense(1, kernel_init=KERNEL)(x)[..., 0]


def sort_patches(
    frames: np.ndarray, usable: np.ndarray, size: int, stride: int, classes: tuple[int, int, int]
) -> Patches | None:
    """Sort patches into classes by the structure tensor.

    Args:
        frames: (N, H, W) log frames.
        usable: (N, H', W') bool, for the patches' upper left corners.
        size, stride: of the patches, px.
        classes: numbers of angles, strengths (quantiles over the patches) and coherences.

    Returns:
        The patches; None without usable ones.
    """
    gy, gx = np.gradient(frames, axis=(1, 2))
    tensor = np.stack([window_sums(a, size)[:, ::stride, ::stride]
                       for a in (gx * gx, gx * gy, gy * gy)])
    keep = usable[:, ::stride, ::stride]
    if not keep.any():
        return None
    xx, xy, yy = tensor[:, keep]
    root = np.sqrt((xx - yy) ** 2 + 4 * xy**2)
    strong, weak = (np.sqrt(np.maximum(xx + yy + sign * root, 0.0)) for sign in (1, -1))
    angle = 0.5 * np.arctan2(2 * xy, xx - yy) % np.pi / np.pi
    rank = np.argsort(np.argsort(strong, kind="stable"), kind="stable") / len(strong)
    coherence = (strong - weak) / np.maximum(strong + weak, 1e-9)
    number = np.zeros(len(xx), int)
    for value, count in zip((angle, rank, coherence), classes, strict=True):
        number = number * count + np.minimum((value * count).astype(int), count - 1)
    places = np.argwhere(keep) * [1, stride, stride]
    return _table([places[number == n] for n in np.unique(number)])


def _table(groups: list[np.ndarray]) -> Patches:
    most = 1 << (max(map(len, groups)) - 1).bit_length()
    spare = -len(groups) % CRITICS
    places = [np.resize(g, (most, 3)) for g in groups] + [np.zeros((most, 3), int)] * spare
    share = np.array([len(g) for g in groups] + [0] * spare, np.float32)
    return Patches(jnp.asarray(np.stack(places), jnp.int32), jnp.asarray(share / share.sum()))


def window_sums(a: np.ndarray, size: int) -> np.ndarray:
    """Sums over all size x size windows of (N, H, W), by their upper left corners."""
    total = np.pad(a.astype(np.float64), ((0, 0), (1, 0), (1, 0))).cumsum(1).cumsum(2)
    return (total[:, size:, size:] - total[:, :-size, size:]
            - total[:, size:, :-size] + total[:, :-size, :-size])


def features(counts: Array, saturating: bool) -> Array:
    """The critics' features (N, H, W, CHANNELS): of counts (N, 2, H, W) and their spatial gradient.

    saturating: tanh, as published, of the counts and of |Sobel x| + |Sobel y|, which hardly
    distinguishes pixels of three and more events, or slopes. Else log(1 + x) of the counts and of
    the gradient's length.
    """
    if saturating:
        seen = jnp.concatenate([counts, _sobel(counts)], 1)
        return jnp.tanh(jnp.moveaxis(seen, 1, -1))
    gy, gx = jnp.gradient(counts, axis=(-2, -1))
    slope = jnp.sqrt(gx**2 + gy**2 + 1e-6)
    return jnp.log1p(jnp.moveaxis(jnp.concatenate([counts, slope], 1), 1, -1))


def _sobel(counts: Array) -> Array:
    """|Sobel x| + |Sobel y| of images (..., H, W)."""
    padded = jnp.pad(counts, [(0, 0)] * (counts.ndim - 2) + [(1, 1), (1, 1)], mode="edge")
    smooth_y = padded[..., :-2, :] + 2.0 * padded[..., 1:-1, :] + padded[..., 2:, :]
    smooth_x = padded[..., :-2] + 2.0 * padded[..., 1:-1] + padded[..., 2:]
    return (jnp.abs(smooth_y[..., 2:] - smooth_y[..., :-2])
            + jnp.abs(smooth_x[..., 2:, :] - smooth_x[..., :-2, :]))


def cut(images: Array, places: Array, size: int) -> Array:
    """Patches (..., size, size, C) of images (N, H, W, C) at places (..., 3)."""
    def one(place: Array) -> Array:
        start = (*place, jnp.zeros((), place.dtype))
        return jax.lax.dynamic_slice(images, start, (1, size, size, images.shape[-1]))[0]

    flat = jax.vmap(one)(places.reshape(-1, 3))
    return flat.reshape(*places.shape[:-1], *flat.shape[1:])


def init(
    key: Array, count: int, size: int, hidden: tuple[int, ...], tx: optax.GradientTransformation
) -> tuple[Params, Any]:
    """Stacked params and optimiser states of `count` critics of patches of `size` px."""
    x = jnp.zeros((size, size, CHANNELS))
    params = jax.vmap(lambda k: Critic(hidden).init(k, x)["params"])(jax.random.split(key, count))
    return params, jax.vmap(tx.init)(params)


def score(params: Params, patches: Array, hidden: tuple[int, ...]) -> Array:
    """Scores (G, n) of patches (G, n, P, P, CHANNELS) by G critics."""
    def one(params: Params, patches: Array) -> Array:
        return jnp.asarray(Critic(hidden).apply({"params": params}, patches))

    return jax.vmap(one)(params, patches)


def losses(
    params: Params, key: Array, real: Array, made: Array, counted: Array, hidden: tuple[int, ...]
) -> Array:
    """WGAN-GP loss (G,) of G critics. real, made: (G, n, P, P, CHANNELS) recorded and simulated
    patches; counted: (G, n) weights of the simulated ones."""
    def one(params: Params, key: Array, real: Array, made: Array, counted: Array) -> Array:
        def scored(x: Array) -> Array:
            return jnp.asarray(Critic(hidden).apply({"params": params}, x))

        mix = jax.random.uniform(key, (len(real), 1, 1, 1))
        between = real + mix * (made - real)
        slope = jax.vmap(jax.grad(scored))(between)
        steep = jnp.sqrt((slope**2).sum((1, 2, 3)) + 1e-12)
        missing = (scored(made) * counted).sum() / jnp.maximum(counted.sum(), 1.0)
        return missing - scored(real).mean() + PENALTY * ((steep - 1.0) ** 2).mean()

    return jax.vmap(one)(params, jax.random.split(key, len(real)), real, made, counted)
