"""One photograph under motion, seen by every known sensor: a page to compare the models by.

    python -m experiments.models --preset full

The photograph ships with scikit-image, nothing is downloaded. It drifts and shakes under a camera
at 1000 frames per second, thresholds and mismatch are each sensor's own; "clean, slots" is the
clean sensor with v2e's time stamps, in which all pixels share the slots of a frame. Writes
models.json, models.md and models.png: event images, event counts per polarity, distinct time
stamps, event rates over time, and intervals between the events of a pixel.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, Literal

import cv2
import jax
import numpy as np

from evflow.process.terminal import bar
from evflow.report import plots
from evflow.scenes.photos import load_photos
from experiments.shared import pages
from experiments.shared.common import begin, run_script, write_result, write_text
from experiments.shared.sensor_page import FPS, SHOWN_US, describe, seen_by, sensors, table

SPEED, SHAKE, SHAKE_HZ = 150.0, 6.0, 8.0  # px/s, px, Hz
PHOTO = "camera"


@dataclasses.dataclass(frozen=True)
class Options:
    """Compare all sensor models on one scene."""

    preset: Literal["debug", "full"] = "debug"
    out: Path = Path("out/models")
    seed: int = 43

    @property
    def shape(self) -> tuple[int, int]:
        return {"debug": (96, 128), "full": (260, 346)}[self.preset]

    @property
    def milliseconds(self) -> int:
        return {"debug": 200, "full": 500}[self.preset]


def video(options: Options) -> np.ndarray:
    """DN (T, H, W) float32: the photograph drifts to the right and shakes up and down."""
    height, width = options.shape
    zoom = 0.9 * height / 260 + 0.1  # texels per pixel are fewer on a small sensor
    photo = cv2.GaussianBlur(255 * load_photos()[PHOTO], (0, 0), 0.8 / zoom)
    seconds = np.arange(options.milliseconds + 1) / FPS
    start = np.array([60.0, 50.0])
    frames = np.empty((len(seconds), height, width), np.float32)
    for i, t in enumerate(seconds):
        moved = start + np.array([SPEED * t, SHAKE * np.sin(2 * np.pi * SHAKE_HZ * t)]) / zoom
        view = np.array([[1 / zoom, 0, moved[0]], [0, 1 / zoom, moved[1]]])
        frames[i] = cv2.warpAffine(
            photo, view, (width, height), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REFLECT_101)
    return frames


def main(options: Options) -> dict[str, Any]:
    begin(options, "models")
    plots.require()
    frames, key = video(options), jax.random.key(options.seed)
    seconds = options.milliseconds / 1000
    seen, result = {}, {}
    with bar("sensors") as progress:
        for k, (name, sensor) in enumerate(sensors().items()):
            # One key for all: pixels have the same deviates, so only the model differs.
            seen[name], noise = seen_by(key, sensor, frames)
            result[name] = describe(seen[name], noise, seconds)
            progress(k + 1, len(sensors()))
    text = table(result, seconds)
    print(text)
    middle = 500 * options.milliseconds
    shown = (middle - SHOWN_US // 2, middle + SHOWN_US // 2)
    pages.sensor_models(options.out / "models.png", frames[len(frames) // 2], seen, result, shown)
    write_result(options.out / "models.json", result, dataclasses.asdict(options))
    write_text(options.out / "models.md", text)
    return result


if __name__ == "__main__":
    run_script(main, Options, __doc__)
