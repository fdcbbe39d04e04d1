"""How alike things are: numbers alone, no drawing. Event streams, images, optical flow.

The names load on first use: comparing streams needs no JAX.
"""

from __future__ import annotations

import importlib
from typing import Any

_HOME = {
    "aee": "flow",
    "endpoint_error": "flow",
    "fwl": "flow",
    "rsat": "flow",
    "warped_image": "flow",
    "FwlConvention": "flow",
    "score_flow": "flow_scores",
    "log_map": "image",
    "mae_intensity_change": "image",
    "mse": "image",
    "psnr": "image",
    "rmse": "image",
    "ssim": "image",
    "ImageProtocol": "image_scores",
    "PROTOCOLS": "image_scores",
    "frame_scores": "image_scores",
    "score_images": "image_scores",
    "load_lpips": "perceptual",
    "lpips": "perceptual",
}

__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(importlib.import_module(f"evflow.metrics.{_HOME[name]}"), name)
    raise AttributeError(f"module 'evflow.metrics' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
