"""The kinds of arguments that every simulation takes, checked at the border."""

from __future__ import annotations

import math
from typing import Any

import jax
import numpy as np

from evflow.camera.arguments import check_key, number
from evflow.camera.camera import Camera
from evflow.camera.sensors import SensorModel
from evflow.checks import need
from evflow.errors import EvflowDataError


def check_arguments(key: Any, camera: Any, model: Any) -> None:
    """Raise EV020 unless `key` is one key of jax.random, `camera` a Camera, and `model` a
    SensorModel or None; traced keys pass."""
    need(camera, Camera, "camera", "For the same thresholds at all pixels: "
         "Camera.constant((height, width), theta_on=0.2, theta_off=0.2).")
    if model is not None:
        need(model, SensorModel, "model", "For example SensorModel(cutoff_hz=100.0).")
    check_key(key)


def check_interval(frame_dt_s: Any) -> float | None:
    """The seconds from frame to frame, None if they are traced. Raises EV020 unless they are one
    number > 0."""
    traced = isinstance(frame_dt_s, jax.core.Tracer)
    seconds = None if traced else number(frame_dt_s)
    if np.ndim(frame_dt_s) or not (seconds is None or 0 < seconds < math.inf):
        raise EvflowDataError(
            "EV020", f"frame_dt_s={frame_dt_s!r:.60}.", "It is one number of seconds, > 0, for all "
            "frames; jax.vmap takes one for each video.")
    return seconds
