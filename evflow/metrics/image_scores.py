"""Scores of reconstructed video under a stated protocol, so that they can be compared.

A result holds the protocol that made it: which SSIM, which LPIPS, clipped or not, linear or log
domain, and whether frames or sequences weigh the same.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from evflow.checks import need
from evflow.errors import EvflowDataError
from evflow.metrics import image as measures
from evflow.metrics.perceptual import LEAST_SIDE, Params, lpips

Array = jax.Array

BLOCK = 16  # frames at a time: VGG16 makes 11 MB of one 240x180 frame in its first layer
AGGREGATES = ("frames", "sequences")
DOMAINS = ("linear", "log")
BEYOND = 1e-3  # of [0, 1], what rounding may do to references
FAR_BEYOND = 5.0  # mean size that no image of a network is expected to have


@dataclasses.dataclass(frozen=True)
class ImageProtocol:
    """ssim: a preset of `evflow.metrics.image.SSIM`; aggregate: means over all "frames", or over
    the means of "sequences"; clip: images are limited to [0, 1] first; domain: "linear", or
    "log" of both by `log_map` (which clips)."""

    ssim: str = "evreal"
    aggregate: str = "frames"
    clip: bool = True
    domain: str = "linear"

    def __post_init__(self) -> None:
        for name, choices in (("ssim", tuple(measures.SSIM)), ("aggregate", AGGREGATES),
                              ("domain", DOMAINS)):
            if getattr(self, name) not in choices:
                raise EvflowDataError("EV020", f"ImageProtocol({name}={getattr(self, name)!r}).",
                                      f"Choose one of {choices}.")
        if not isinstance(self.clip, bool) or (self.domain == "log" and not self.clip):
            raise EvflowDataError(
                "EV020", f"ImageProtocol(clip={self.clip!r}, domain={self.domain!r}).",
                "Give True or False; the log domain always clips: True.")


# As EVREAL, and as ET-Net and S2R, score; `global` is ECC's SSIM. All in the linear domain.
PROTOCOLS = {
    "evreal": ImageProtocol(),
    "etnet": ImageProtocol("etnet", "sequences", clip=False),
    "global": ImageProtocol("global", "frames"),
}


def frame_scores(
    images: Array, references: Array, protocol: ImageProtocol | str,
    lpips_params: Params | None = None,
) -> dict[str, Array]:
    """mse, rmse (DN), psnr (dB), ssim and, with weights, lpips, each (...), of (..., H, W); ssim
    and lpips of images too small for them are NaN.

    Raises EV002 (shapes), EV003 (integers), EV020 (unknown protocol; what are no weights).
    """
    if lpips_params is not None:
        need(lpips_params, dict, "lpips_params", "Pass what load_lpips returns.")
    return _frame_scores(images, references, _protocol(protocol), lpips_params)


@functools.partial(jax.jit, static_argnames="protocol")
def _frame_scores(
    images: Array, references: Array, protocol: ImageProtocol, lpips_params: Params | None
) -> dict[str, Array]:
    images, references = measures.check_images(images, references)  # clipped bytes would be 0 and 1
    if protocol.clip:
        images, references = (jnp.clip(a, 0.0, 1.0) for a in (images, references))
    if protocol.domain == "log":
        images, references = measures.log_map(images), measures.log_map(references)
    side = min(images.shape[-2:])
    scores = {
        "mse": measures.mse(images, references),
        "rmse": measures.rmse(images, references),
        "psnr": measures.psnr(images, references),
    }
    unmeasured = jnp.full_like(scores["mse"], jnp.nan)
    scores["ssim"] = (measures.ssim(images, references, protocol.ssim)
                      if side >= measures.least_side(protocol.ssim) else unmeasured)
    if lpips_params is not None:
        scores["lpips"] = (lpips(lpips_params, images, references) if side >= LEAST_SIDE
                           else unmeasured)
    return scores


def score_images(
    sequences: Mapping[str, tuple[np.ndarray, np.ndarray]],
    protocol: ImageProtocol | str = "evreal", lpips_params: Params | None = None,
) -> dict[str, Any]:
    """Scores of sequences {name: (images, references)}, each (T, H, W) on [0, 1]; JSON-ready.

    Holds "protocol", "lpips_net", "frames", the means, and "sequences" with the mean of each.
    A mean that is not finite (PSNR of equal images, SSIM or LPIPS of images too small for them)
    is None. Raises EV001 (nothing to score), EV002 (shapes), EV003 (integers, references beyond
    0..1), EV007 (NaN), EV020 (unknown protocol).
    """
    protocol = _protocol(protocol)
    need(sequences, Mapping, "sequences", "Give {name: (images, references)}.")
    if not sequences:
        raise EvflowDataError("EV001", "there are no sequences to score.")
    if wrong := [name for name, pair in sequences.items() if len(pair) != 2]:
        raise EvflowDataError("EV002", f"{wrong[0]} holds {len(sequences[wrong[0]])} arrays.",
                              "Give {name: (images, references)}.")
    scores = {name: _sequence(name, *pair, protocol, lpips_params)
              for name, pair in sequences.items()}
    kinds = next(iter(scores.values())).keys()
    each = {name: {kind: float(s[kind].mean()) for kind in kinds} for name, s in scores.items()}
    if protocol.aggregate == "frames":
        means = {k: float(np.concatenate([s[k] for s in scores.values()]).mean()) for k in kinds}
    else:
        means = {kind: float(np.mean([e[kind] for e in each.values()])) for kind in kinds}
    frames = {name: len(s["mse"]) for name, s in scores.items()}
    return {
        "protocol": dataclasses.asdict(protocol),
        "lpips_net": _net(lpips_params) if math.isfinite(means.get("lpips", math.nan)) else None,
        "frames": sum(frames.values()), **_finite(means),
        "sequences": {name: {"frames": frames[name], **_finite(e)} for name, e in each.items()},
    }


def _protocol(protocol: ImageProtocol | str) -> ImageProtocol:
    if isinstance(protocol, ImageProtocol):
        return protocol
    if not isinstance(protocol, str) or protocol not in PROTOCOLS:
        raise EvflowDataError("EV020", f"protocol {protocol!r}.",
                              f"Choose one of {list(PROTOCOLS)}, or an ImageProtocol.")
    return PROTOCOLS[protocol]


def _sequence(
    name: str, images: np.ndarray, references: np.ndarray, protocol: ImageProtocol,
    lpips_params: Params | None,
) -> dict[str, np.ndarray]:
    images, references = np.asarray(images), np.asarray(references)
    if images.ndim != 3 or images.shape != references.shape or not images.size:
        raise EvflowDataError("EV002", f"{name}: images {images.shape}, references "
                              f"{references.shape}.", "Expected two of (T, H, W).")
    for kind, array in (("images", images), ("references", references)):
        if not np.issubdtype(array.dtype, np.floating):
            raise EvflowDataError("EV003", f"{name}: {kind} are {array.dtype}.",
                                  "Expected floats on [0, 1]: divide bytes by 255.")
        if not np.isfinite(array).all():
            raise EvflowDataError("EV007", f"{name or 'the sequence'}: {kind} are not all finite.",
                                  "Weights that diverged?" if kind == "images" else "")
    if (size := np.abs(images).mean()) > FAR_BEYOND:
        raise EvflowDataError(
            "EV003", f"{name or 'the sequence'}: images are {size:.4g} on average.",
            "Expected about [0, 1]: divide DN by 255. Or weights that diverged?")
    low, high = references.min(), references.max()
    if low < -BEYOND or high > 1 + BEYOND:
        raise EvflowDataError(
            "EV003", f"{name or 'the sequence'}: references span {low:.4g} to {high:.4g}.",
            "Expected [0, 1]: divide DN by 255.")
    parts = []
    for i in range(0, len(images), BLOCK):
        part = [a[i:i + BLOCK].astype(np.float32) for a in (images, references)]
        spare = BLOCK - len(part[0]) if len(images) > BLOCK else 0  # one shape, one compilation
        padded = [np.pad(a, ((0, spare), (0, 0), (0, 0))) for a in part]
        scores = _frame_scores(*map(jnp.asarray, padded), protocol, lpips_params)
        parts.append({k: np.asarray(v)[:len(part[0])] for k, v in scores.items()})
    return {kind: np.concatenate([p[kind] for p in parts]) for kind in parts[0]}


def _net(params: Params | None) -> str | None:
    if params is None:
        return None
    return "alex v0.1" if "AlexNet_0" in params else "vgg v0.1"


def _finite(means: dict[str, float]) -> dict[str, float | None]:
    return {k: v if math.isfinite(v) else None for k, v in means.items()}
