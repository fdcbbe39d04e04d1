"""The texture bank: textures and cut-outs of scenes, drawn once and kept on the device.

`make_bank` is host code and pure given its key; the bank it returns is a pytree that passes
through jit. Backgrounds are squares that the renderer continues by mirroring; cut-outs carry
a value and a mask on one grid.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from evflow.errors import EvflowDataError
from evflow.scenes.photos import crop, load_photos
from evflow.scenes.textures import cutout_mask, finish, sample_texture

Array = jax.Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class TextureBank:
    """backgrounds (N, S, S); cutouts (M, 2, S2, S2): value and alpha; all float32 in [0, 1].
    diameter (M,): the extent of each cut-out in texels."""

    backgrounds: Array
    cutouts: Array
    diameter: Array


def make_bank(
    key: Array,
    procedural: int = 128,
    photos: bool | Sequence[np.ndarray] = True,
    size: int = 256,
    cutout_size: int = 96,
    crops: int = 4,
) -> TextureBank:
    """Draw a bank of N = M = procedural + crops * (number of photographs) textures.

    procedural: how many synthetic textures and as many cut-outs.
    photos: True for scikit-image's own, or your images, float (H, W) in [0, 1], or False.
    size, cutout_size: S and S2 in texels; crops: random windows taken from every photograph.
    Raises EV020 for sizes below 16 or an empty bank, EV002/EV003/EV007 for unfit images.
    """
    images = _check_images(photos)
    if min(size, cutout_size) < 16 or min(procedural, crops) < 0:
        raise EvflowDataError(
            "EV020", f"make_bank({procedural=}, {size=}, {cutout_size=}, {crops=}).",
            "Sizes must be >= 16 and counts >= 0.")
    count = procedural + crops * len(images)
    if count == 0:
        raise EvflowDataError(
            "EV020", "the bank would hold no texture.", "Ask for procedural ones or for photos.")
    k_back, k_cut, k_mask, k_back_crop, k_cut_crop = jax.random.split(key, 5)
    backgrounds = _draw_textures(jax.random.split(k_back, procedural), size)
    values = _draw_textures(jax.random.split(k_cut, procedural), cutout_size)
    alpha, diameter = _draw_masks(jax.random.split(k_mask, count), cutout_size)
    backgrounds = jnp.concatenate([backgrounds, _draw_crops(k_back_crop, images, size, crops)])
    values = jnp.concatenate([values, _draw_crops(k_cut_crop, images, cutout_size, crops)])
    return TextureBank(backgrounds, jnp.stack([values, alpha], axis=1), diameter)


@functools.partial(jax.jit, static_argnames="size")
def _draw_textures(keys: Array, size: int) -> Array:
    return jax.lax.map(lambda key: sample_texture(key, size), keys)


@functools.partial(jax.jit, static_argnames="size")
def _draw_masks(keys: Array, size: int) -> tuple[Array, Array]:
    return jax.lax.map(lambda key: cutout_mask(key, size), keys)


@jax.jit
def _finish_all(images: Array) -> Array:
    return jax.lax.map(finish, images)


def _draw_crops(key: Array, images: Sequence[np.ndarray], size: int, crops: int) -> Array:
    """Random windows (crops * len(images), size, size) of the photographs.

    The scale is log-uniform from half a source pixel per texel to all of the short side (at
    least 1): a whole object at one end, its surface at the other.
    """
    draws = np.asarray(jax.random.uniform(key, (len(images), crops, 5), jnp.float32), np.float64)
    out = np.empty((len(images) * crops, size, size), np.float32)
    windows = ((image, w) for image, row in zip(images, draws, strict=True) for w in row)
    for n, (image, window) in enumerate(windows):
        largest = max(min(image.shape) / size, 1.0)
        scale = 0.5 * (2 * largest) ** window[2]
        out[n] = crop(image, size, window[:2], scale, 2 * np.pi * window[3], window[4] < 0.5)
    return _finish_all(jnp.asarray(out))


def _check_images(photos: bool | Sequence[np.ndarray]) -> list[np.ndarray]:
    """The photographs as contiguous float32 arrays (H, W) in [0, 1], or a coded error."""
    if isinstance(photos, bool):
        return list(load_photos().values()) if photos else []
    for n, image in enumerate(photos):
        where = f"photos[{n}]"
        if np.ndim(image) != 2 or min(np.shape(image)) < 2:
            raise EvflowDataError(
                "EV002", f"{where} has shape {np.shape(image)}.", "Pass luma (H, W).")
        if not np.issubdtype(np.asarray(image).dtype, np.floating):
            raise EvflowDataError(
                "EV003", f"{where} is {np.asarray(image).dtype}.", "Pass floats in [0, 1].")
        if not np.isfinite(image).all():
            raise EvflowDataError("EV007", f"{where} holds NaN or infinities.", "Drop it.")
        if np.min(image) < 0 or np.max(image) > 1:
            raise EvflowDataError(
                "EV003", f"{where} spans [{np.min(image):g}, {np.max(image):g}].",
                "Divide 8-bit images by 255.")
    return [np.ascontiguousarray(image, np.float32) for image in photos]
