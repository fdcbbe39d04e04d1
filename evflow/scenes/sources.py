"""Scenes from your own images: a folder as textures, or objects cut out by a COCO json.

Host code. `folder_bank` and `coco_bank` give a `TextureBank` as `make_bank` does, each a pure
function of its key and the files; `join_banks` puts banks together.
"""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from evflow.errors import EvflowDataError
from evflow.io.images.folder import decode, list_images
from evflow.io.images.frames import existing
from evflow.io.images.values import opaque
from evflow.light.colour import luma
from evflow.scenes.bank import TextureBank, make_bank
from evflow.scenes.coco import Coco, CocoObject, read_coco
from evflow.scenes.textures import BLUR_TEXELS
from evflow.types import BIT_DEPTHS

Array = jax.Array

EXTENTS = (0.25, 0.9)  # shares of the square that objects take up, as procedural cut-outs do
FINEST = 0.5  # source pixels per texel at least: small objects are enlarged no further


def load_folder(
    folder: str | os.PathLike, *, key: Array | None = None, limit: int | None = None
) -> dict[str, np.ndarray]:
    """name -> luma, float32 (H, W) in [0, 1], of a folder's images, in natural order.

    limit: largest number, drawn by `key`, else the first ones. Raises EV008 (no images), EV009
    (damaged), EV016 (missing).
    """
    files = list_images(existing(folder))
    if not files:
        raise EvflowDataError("EV008", f"{folder} holds no image.", "Pass a folder of pictures.")
    return {files[i].name: read_picture(files[i]) for i in _some(key, len(files), limit)}


def folder_bank(
    key: Array, folder: str | os.PathLike, *, limit: int = 256, size: int = 256,
    cutout_size: int = 96, crops: int = 4,
) -> TextureBank:
    """A bank of `crops` textures of each of at most `limit` pictures; see `make_bank`."""
    k_pick, k_bank = jax.random.split(key)
    pictures = load_folder(folder, key=k_pick, limit=limit)
    return make_bank(k_bank, 0, list(pictures.values()), size, cutout_size, crops)


def coco_bank(
    key: Array, coco: Coco | str | os.PathLike, images: str | os.PathLike | None = None, *,
    limit: int = 256, min_area: float = 400.0, crowds: bool = False, size: int = 256,
    cutout_size: int = 96, crops: int = 1,
) -> TextureBank:
    """A bank with `crops` backgrounds of each image in use and at most `limit` objects cut out.

    coco: a json (images: their folder) or the result of `read_coco`. Objects below `min_area`
    pixels, and crowds unless wanted, are left out. Raises EV001 where none is left, and as
    `read_coco` and `CocoObject.mask`.
    """
    coco = coco if isinstance(coco, Coco) else read_coco(coco, images)
    fit = [o for o in coco.objects if (crowds or not o.crowd) and not o.area < min_area]
    if not fit:
        raise EvflowDataError(
            "EV001", f"of {len(coco.objects)} objects in {coco.path} none is of {min_area:g} "
            "pixels or more.", "Lower min_area, or pass crowds=True.")
    k_pick, k_extent, k_bank = jax.random.split(key, 3)
    chosen = [fit[i] for i in _some(k_pick, len(fit), limit)]
    low, high = EXTENTS
    extents = low * (high / low) ** np.asarray(jax.random.uniform(k_extent, (len(chosen),)))
    pictures: dict[str, np.ndarray] = {}
    cut, diameters = [], []
    for item, extent in zip(chosen, extents.tolist(), strict=True):
        if item.image not in pictures:
            pictures[item.image] = _picture_of(coco, item)
        mask = item.mask()
        if not mask.any():
            raise EvflowDataError("EV009", f"{item.where} has a mask without a pixel.",
                                  "Drop it from the json (or raise min_area of coco_bank).")
        planes, diameter = cut_out(pictures[item.image], mask, cutout_size, extent)
        cut.append(_finished(planes))
        diameters.append(diameter)
    backgrounds = make_bank(k_bank, 0, list(pictures.values()), size, cutout_size, crops)
    return TextureBank(backgrounds.backgrounds, jnp.asarray(np.stack(cut)),
                       jnp.asarray(diameters, jnp.float32))


def join_banks(*banks: TextureBank) -> TextureBank:
    """All textures and cut-outs of banks of the same sizes; EV002 where they differ."""
    sizes = sorted({(b.backgrounds.shape[-1], b.cutouts.shape[-1]) for b in banks})
    if len(sizes) != 1:
        raise EvflowDataError(
            "EV002", f"banks of sizes (background, cut-out) {sizes}.", "Draw them in one size.")
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *banks)


def read_picture(path: Path) -> np.ndarray:
    """One image as luma, float32 (H, W) in [0, 1]; 16-bit data on the smallest scale of 8, 10,
    12, 14 or 16 bits that holds it; what is transparent is laid over black. Raises EV003 (dtype,
    floats beyond [0, 1]), EV009, EV016."""
    image = decode(path)
    if image.ndim == 3:
        image = opaque(image, "black")[0] if image.shape[-1] == 4 else image[..., :3]
    if image.dtype in (np.uint8, np.uint16):
        least = 8 if image.dtype == np.uint8 else 10
        white = next(2**b - 1 for b in BIT_DEPTHS if b >= least and image.max() < 2**b)
    elif image.dtype == np.float32 and image.min() >= 0 and image.max() <= 1:
        white = 1
    else:
        raise EvflowDataError(
            "EV003", f"{path} is {image.dtype} on {image.min()}..{image.max()}.",
            "Expected 8 or 16 bits, or floats in [0, 1].")
    values = image.astype(np.float32) * np.float32(1 / white)
    return np.clip(luma(values) if values.ndim == 3 else values, 0.0, 1.0)


def cut_out(
    picture: np.ndarray, mask: np.ndarray, size: int, extent: float = EXTENTS[1]
) -> tuple[np.ndarray, float]:
    """An object's value and alpha (2, size, size) in [0, 1], and its diameter in texels.

    picture: float32 (H, W); mask: bool (H, W); extent: the share of `size` to fill, less for small
    objects, which are enlarged up to FINEST. The circle around the object is centred. Outside the
    object its nearest inner value is repeated, so that no rim of the background shows.
    """
    solid = mask.astype(np.uint8)
    edge = mask & (cv2.erode(solid, np.ones((3, 3), np.uint8)) == 0)
    points = np.argwhere(edge if edge.any() else mask)[:, ::-1].astype(np.float32)
    (x, y), radius = cv2.minEnclosingCircle(points)
    diameter = 2 * radius + 1  # the pixels' own extent
    scale = max(diameter / (extent * size), FINEST)
    planes = (_continued(picture, mask & ~edge if (mask & ~edge).any() else mask),
              mask.astype(np.float32))
    shift = np.array([x, y]) - scale * (size - 1) / 2
    matrix = np.column_stack([np.eye(2) * scale, shift])
    out = np.zeros((2, size, size), np.float32)
    for n, (plane, border) in enumerate(zip(
            planes, (cv2.BORDER_REPLICATE, cv2.BORDER_CONSTANT), strict=True)):
        if scale > 1:  # blur away what is finer than the texels
            plane = cv2.GaussianBlur(plane, (0, 0), 0.5 * scale, borderType=border)
        out[n] = cv2.warpAffine(plane, matrix, (size, size), borderMode=border,
                                flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    out[1] = np.pad(out[1, 1:-1, 1:-1], 1)
    return np.clip(out, 0.0, 1.0), diameter / scale


def _finished(planes: np.ndarray) -> np.ndarray:
    """Value and alpha with the value stretched and band-limited as by `textures.finish`, its
    percentiles taken where the object is."""
    value, alpha = planes
    inside = value[alpha >= 0.5] if (alpha >= 0.5).any() else value
    low, high = np.percentile(inside, [0.5, 99.5])
    stretched = np.clip((value - (low + high) / 2) / max(high - low, 0.2) + 0.5, 0.0, 1.0)
    blurred = cv2.GaussianBlur(stretched.astype(np.float32), (0, 0), BLUR_TEXELS)
    return np.stack([blurred, alpha])


def _continued(picture: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """The picture with every pixel outside replaced by the nearest inside."""
    _, label = cv2.distanceTransformWithLabels(
        (~inside).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL)
    values = np.zeros(label.max() + 1, np.float32)
    values[label[inside]] = picture[inside]
    return values[label]


def _picture_of(coco: Coco, item: CocoObject) -> np.ndarray:
    """The image of an object; EV015 where it is not of the size that the json states."""
    picture = read_picture(coco.image_path(item.image))
    if picture.shape != item.size[::-1]:
        raise EvflowDataError(
            "EV015", f"{item.image} is {picture.shape[1]}x{picture.shape[0]}, {coco.path} says "
            f"{item.size[0]}x{item.size[1]}.", "Scaled or turned images? Use the original ones.")
    return picture


def _some(key: Array | None, count: int, limit: int | None) -> list[int]:
    """The indices to take, in order: all, or `limit` of them."""
    if limit is not None and limit < 1:
        raise EvflowDataError("EV020", f"limit={limit}.", "It must be >= 1.")
    if limit is None or limit >= count or key is None:
        return list(range(count))[:limit]
    return sorted(np.asarray(jax.random.permutation(key, count)[:limit]).tolist())


def own_bank(key: Array, images: str | os.PathLike) -> TextureBank:
    """A bank of one's own images: a folder of pictures, or a COCO json of objects."""
    make = coco_bank if os.fspath(images).lower().endswith(".json") else folder_bank
    return make(key, images)
