"""The kinds of arguments that every simulation takes, checked at the border."""

from __future__ import annotations

from typing import Any

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
    dtype, shape = getattr(key, "dtype", None), getattr(key, "shape", None)
    typed = str(dtype).startswith("key<")
    if not (typed or (str(dtype) == "uint32" and shape)):
        raise EvflowDataError("EV020", f"key is {key!r:.60}.",
                              "Give a key of jax.random: jax.random.key(0).")
    if typed and shape:
        raise EvflowDataError("EV020", f"key holds keys of shape {shape}.",
                              "Give one of them: keys[0].")
