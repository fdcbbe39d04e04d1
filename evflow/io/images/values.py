"""Pixel values of a decoded image -> light on 0..255 DN: uint8 stays if it already is that, all
else becomes float32. Nothing is clipped, but for what rounding leaves just above white.

The response is undone before colours are summed: a pixel adds light, not code values.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from evflow.errors import EvflowDataError
from evflow.files.regular import need_regular
from evflow.io.images.pictures import stated_white
from evflow.light.colour import luma
from evflow.light.ranges import Meaning, likely_white, meaning
from evflow.light.response import linear_light
from evflow.notes import Note

WHITE = {"u1": 255.0, "u2": 65535.0, "f4": 255.0}  # default DN of a saturated pixel
WHITE_PERCENT = 99.0
NEARLY = 1.001  # times white: what a conversion or a filter rounds up to is still white
USUAL = {int(WHITE["u1"]), int(WHITE["u2"])}
NETPBM, HEAD = (".pgm", ".ppm"), 1 << 12  # bytes in which these name their white
BACKGROUNDS = {"black": 0.0, "white": 1.0}


def as_dn(
    pixels: np.ndarray, where: str, *, full_scale: float | None, response: str, colour: str,
) -> np.ndarray:
    """The frame (H, W), or (H, W, 3) unless colour is "luma".

    pixels: (H, W) or (H, W, 3) in B, G, R, of a dtype in `WHITE`; where: names it in messages.
    Raises EV003 (range), EV007 (NaN).
    """
    seen: Callable[[np.ndarray], np.ndarray] = (
        luma if pixels.ndim == 3 and colour == "luma" else _as_it_is)
    if response == "linear":  # integers are rounded as by OpenCV
        return _scaled(seen(pixels), where, full_scale)
    if response == "log":
        return seen(_exponential(pixels, where, full_scale))
    return seen(linear_light(_scaled(pixels, where, full_scale), response))


def white_of(dtype: np.dtype, where: str) -> float:
    """DN of a saturated pixel; EV003 for an unsupported dtype."""
    if dtype.str[1:] not in WHITE:
        raise EvflowDataError(
            "EV003", f"{where} is {dtype}.", "Expected uint8, uint16 or floats: "
            + ("255 * frames.astype(np.uint8)." if dtype.kind == "b" else
               "frames.astype(np.float32), with --full-scale if white is not 255."),
            where=where)
    return WHITE[dtype.str[1:]]


def white_of_radiance(pixels: np.ndarray, full_scale: float | None) -> tuple[float, Note]:
    """White for images of radiance, which have no upper limit: `full_scale`, or a value that all
    but a hundredth of the first image's pixels stay below; and the note on it."""
    if full_scale is not None:
        return full_scale, Note("frames.white", f"radiance of {full_scale:g} is white; brighter "
                                "values are treated as white.")
    grey = luma(pixels[..., :3].astype(np.float32)) if pixels.ndim == 3 else pixels
    finite = grey[np.isfinite(grey) & (grey > 0)]
    white = float(np.percentile(finite, WHITE_PERCENT)) if finite.size else 1.0
    return white, Note(
        "frames.white", f"radiance of {white:.4g} is white: {WHITE_PERCENT:g} % of the first image "
        "is darker; brighter values are treated as white; --full-scale sets another value.")


def white_of_files(files: Sequence[Path]) -> int | None:
    """The white that PGM or PPM files name, if it is not that of their depth; None for others.
    EV003 if they do not agree."""
    named: dict[int, Path] = {}
    for file in files:
        if file.suffix.lower() in NETPBM:
            with contextlib.suppress(OSError), open(need_regular(file), "rb") as f:
                if white := stated_white(f.read(HEAD)):
                    named.setdefault(white, file)
    if not named.keys() - USUAL:
        return None
    if len(named) > 1:
        (white, file), (other, another) = [*named.items()][:2]
        raise EvflowDataError(
            "EV003", f"{file.name} names {white} as white (maxval), {another.name} {other}.",
            "Save them with one white (netpbm: pamdepth), or pass it: --full-scale (full_scale=).",
            where=file.parent)
    return next(iter(named))


def opaque(pixels: np.ndarray, background: str) -> tuple[np.ndarray, bool]:
    """(H, W, 3) from (H, W, 4), laid over a background ("black" or "white") as image viewers do,
    and whether any of it shows through."""
    colour, alpha = np.ascontiguousarray(pixels[..., :3]), pixels[..., 3:]
    whole = np.iinfo(pixels.dtype).max if pixels.dtype.kind == "u" else (
        1.0 if alpha.max(initial=0) <= 1 else 255.0)
    if (alpha >= whole).all():
        return colour, False
    share = alpha.astype(np.float32) / np.float32(whole)
    behind = BACKGROUNDS[background] * white_of(pixels.dtype, "an image")
    laid = share * colour + (1 - share) * np.float32(behind)
    return (np.rint(laid) if pixels.dtype.kind == "u" else laid).astype(pixels.dtype), True


def _as_it_is(pixels: np.ndarray) -> np.ndarray:
    return pixels


def _scaled(pixels: np.ndarray, where: str, full_scale: float | None) -> np.ndarray:
    """Pixels as DN on 0..255, checked."""
    white = full_scale or white_of(pixels.dtype, where)
    if pixels.dtype == np.uint8 and white == 255:
        return pixels
    if pixels.dtype == np.uint8 and white > 255:
        raise EvflowDataError("EV003", f"--full-scale {white:g} with 8-bit frames, which end at "
                              "255.", "Leave it out.", where=where)
    _check_finite(pixels, where)
    low, high = float(pixels.min()), float(pixels.max())
    floats = pixels.dtype == np.float32
    if low < 0 and (meant := meaning(pixels)):
        raise misread(meant, where, pixels, white)
    if high > white * NEARLY:
        likely = high if floats else likely_white(high)
        raise EvflowDataError(
            "EV003", f"{where} reaches {high:g}, beyond white at {white:g}.",
            f"Pass the value of white: --full-scale {likely:g} (full_scale=).",
            where=where)
    return _below_white(pixels.astype(np.float32) * np.float32(255 / white))


def _below_white(dn: np.ndarray) -> np.ndarray:
    """DN (overwritten) with white itself and what was admitted just above it at 255."""
    return np.minimum(dn, np.float32(255), out=dn)


def misread(meant: Meaning, where: str, pixels: np.ndarray, white: float) -> EvflowDataError:
    """EV003 for values that are probably something else than DN."""
    return EvflowDataError("EV003", f"{where} spans {pixels.min():g}..{pixels.max():g}, with white "
                           f"at {white:g}: {meant.what}?", meant.fix, where=where)


def _exponential(pixels: np.ndarray, where: str, full_scale: float | None) -> np.ndarray:
    """Light from its natural logarithms."""
    if pixels.dtype.kind != "f":
        raise EvflowDataError("EV003", f"{where} is {pixels.dtype}: integers are not "
                              "logarithms.", "Leave out --response log.", where=where)
    _check_finite(pixels, where)
    white = full_scale or 255.0
    if (high := float(pixels.max())) > np.log(white) + 1e-2:
        raise EvflowDataError(
            "EV003", f"{where} reaches {high:.4g}, but the logarithm of white, {white:g}, is "
            f"{np.log(white):.4g}.", f"Pass the value of white: --full-scale {np.exp(high):.4g}, "
            "or leave out --response log.", where=where)
    return _below_white(np.exp(pixels) * np.float32(255 / white))


def _check_finite(pixels: np.ndarray, where: str) -> None:
    finite = np.isfinite(pixels)
    if not finite.all():
        raise EvflowDataError(
            "EV007", f"{where} holds {(~finite).sum():,} NaN or infinite values.",
            "A log of dark pixels? Use linear intensity.", where=where)
