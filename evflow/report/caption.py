"""A caption below a picture: its time, and what its colours mean. Uses Pillow's own font."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

LEAST, SHARE = 16, 28  # minimum height in pixels, or this fraction of the width if more
INK, GROUND = 40, 255


def captioned(picture: np.ndarray, words: str) -> np.ndarray:
    """(H, W, 3) uint8 above a white strip with the words; the height stays even."""
    width = picture.shape[1]
    strip = 2 * (max(LEAST, width // SHARE) // 2)
    image = Image.new("L", (width, strip), GROUND)
    ImageDraw.Draw(image).text((strip // 4, strip // 2), words, INK, anchor="lm",
                               font=_font(words, width - strip // 2, strip))
    text = np.repeat(np.asarray(image)[..., None], 3, -1)
    return np.concatenate([picture, text])


def _font(words: str, width: int, strip: int) -> Any:
    """The largest font in which the words fit, with all digits assumed to be the widest."""
    plain = "".join("0" if c.isdigit() else c for c in words)  # one size for a whole film
    return next((font for size in range(round(0.62 * strip), 7, -1)
                 if (font := _sized(size)).getlength(plain) <= width), _sized(7))


@lru_cache(maxsize=64)
def _sized(size: int) -> Any:
    return ImageFont.load_default(size)
