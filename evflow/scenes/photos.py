"""Photographs for scenes, from the installed scikit-image package.

Host code. Nothing is ever downloaded: only files already on the disk are read. The list holds
the pictures that scikit-image documents as CC0, public domain or free of known restrictions,
so that what is trained on them may be released.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from evflow.errors import EvflowDataError
from evflow.light.colour import luma

FILES = (
    "astronaut.png", "brick.png", "camera.png", "cell.png", "chelsea.png", "clock_motion.png",
    "coffee.png", "coins.png", "grass.png", "gravel.png", "hubble_deep_field.jpg", "ihc.png",
    "microaneurysms.png", "retina.jpg", "rocket.jpg", "text.png",
)


def photo_paths() -> tuple[Path, ...]:
    """The photographs of `FILES` that this installation holds, in that order."""
    spec = importlib.util.find_spec("skimage")
    roots = list(spec.submodule_search_locations or ()) if spec else []
    paths = [Path(root) / "data" / name for name in FILES for root in roots]
    return tuple(p for p in paths if p.is_file())


def load_photos() -> dict[str, np.ndarray]:
    """name -> luma, float32 (H, W) in [0, 1]; sizes differ.

    Raises EV016 where scikit-image is absent or ships none of `FILES`, EV009 for a damaged file.
    """
    photos = {path.stem: read_luma(path) for path in photo_paths()}
    if not photos:
        raise EvflowDataError(
            "EV016", "the installed scikit-image holds none of its sample photographs.",
            "Reinstall scikit-image, or use make_bank(photos=False) or photos=[your arrays].")
    return photos


def read_luma(path: Path) -> np.ndarray:
    """One 8-bit image file as luma, float32 (H, W) in [0, 1]. EV009 where it cannot be read."""
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise EvflowDataError("EV009", f"{path} is not a readable image.", "Replace it.")
    return luma(image.astype(np.float32)) / np.float32(255)


def crop(
    photo: np.ndarray, size: int, centre: Sequence[float], scale: float, angle: float, flip: bool
) -> np.ndarray:
    """A turned, scaled and maybe flipped window of `photo`, float32 (size, size).

    centre: (x, y) as fractions of the photograph; scale: source pixels per texel; angle in rad.
    Where the window leaves the photograph it continues mirrored. Source detail finer than the
    texels is blurred away first.
    """
    if scale > 1:
        photo = cv2.GaussianBlur(photo, (0, 0), 0.5 * scale, borderType=cv2.BORDER_REFLECT_101)
    c, s = scale * np.cos(angle), scale * np.sin(angle)
    linear = np.array([[-c if flip else c, -s], [-s if flip else s, c]])
    middle = np.array(centre) * (photo.shape[1] - 1, photo.shape[0] - 1)
    shift = middle - linear @ np.full(2, (size - 1) / 2)
    return cv2.warpAffine(
        photo, np.column_stack([linear, shift]), (size, size),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REFLECT_101)
