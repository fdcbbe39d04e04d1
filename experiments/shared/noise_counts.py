"""Events that the sensors of `noise` send, simulated, beside those that their laws expect."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from evflow import simulate
from evflow.camera import Camera
from evflow.camera.sensors import SensorModel
from experiments.shared.noise_laws import (
    SCREEN_DT_S,
    camera_of,
    judged,
    model_of,
    rest_law,
    screen,
    screen_law,
)
from experiments.shared.table_two import LEVELS


def table_two(key: jax.Array, size: int, name: str, row: int) -> dict[str, Any]:
    """Signal events of a brightening (ON) and a darkening (OFF) screen, each as step and ramp."""
    k_camera, key = jax.random.split(key)
    camera, model = camera_of(k_camera, name, row, size, spread=True), model_of(name)
    found: dict[str, Any] = {}
    for polarity, up in (("on", True), ("off", False)):
        for way in ("step", "ramp"):
            dn = screen(way, up)
            frames = np.broadcast_to(dn[:, None, None].astype(np.float32),
                                     (len(dn), *camera.shape))
            times = np.arange(len(dn)) * round(1e6 * SCREEN_DT_S)
            events, noise = simulate(jax.random.fold_in(key, 2 * up + (way == "step")), frames,
                                     times, camera, model=model, labels=True)
            found[f"{polarity} {way}"] = judged(((events.p == up) & ~noise).sum(),
                                                screen_law(model, camera, dn, up))
    return found


def duration(model: SensorModel, camera: Camera, events: int) -> float:
    """Seconds in which each noise source is expected to send `events` at each luminance."""
    pixels = camera.theta_on.size / len(LEVELS)
    hz = rest_law(model, camera, 3000.0) / 3000.0
    return float(np.clip(events / pixels / hz[hz > 0.005].min(), 5.0, 3000.0))


def figure_five(
    key: jax.Array, size: int, name: str, row: int, events: int, intervals: int
) -> dict[str, Any]:
    """Noise of vertical bands at rest, by luminance; at least `events` expected of each source."""
    k_camera, key = jax.random.split(key)
    camera, model = camera_of(k_camera, name, row, size, spread=False), model_of(name)
    seconds = duration(model, camera, events)
    times = np.linspace(0, seconds * 1e6, intervals + 1).round().astype(np.int64)
    band = np.repeat(LEVELS, size // len(LEVELS)).astype(np.float32)
    frames = np.broadcast_to(band, (len(times), *camera.shape))
    counts = simulate(key, frames, times, camera, model=model).count_map()
    counts = counts.reshape(2, size, len(LEVELS), -1).sum((1, 3))
    pixels = size**2 / len(LEVELS)
    law = rest_law(model, camera, seconds) * pixels
    return {"seconds": seconds, "pixels": pixels,
            **{p: [judged(*pair) for pair in zip(counts[i], law[i], strict=True)]
               for i, p in enumerate(("on", "off"))}}
