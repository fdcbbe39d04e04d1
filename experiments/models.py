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
import jax.numpy as jnp
import numpy as np

from evflow import simulate
from evflow.camera import Summary, noise_of_threshold, sample_pixels
from evflow.camera.sensors import SENSORS, KnownSensor
from evflow.process.terminal import bar
from evflow.report import plots
from evflow.scenes.photos import load_photos
from evflow.types import Events
from experiments.shared import pages
from experiments.shared.common import begin, run_script, write_result, write_text
from experiments.shared.sources import density, gaps

FPS, SHOWN_US, RATE_US = 1000, 8_000, 5_000
SPEED, SHAKE, SHAKE_HZ = 150.0, 6.0, 8.0  # px/s, px, Hz
EDGES_S = np.geomspace(1e-5, 1.0, 41)
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


def sensors() -> dict[str, KnownSensor]:
    """All known sensors, and the clean one with v2e's time stamps."""
    clean = SENSORS["clean"]
    slots = dataclasses.replace(clean, model=dataclasses.replace(clean.model, timestamps="v2e"))
    return {"clean": clean, "clean, slots": slots, **SENSORS}


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


def seen_by(
    key: jax.Array, sensor: KnownSensor, frames: np.ndarray
) -> tuple[Events, np.ndarray]:
    """Events and which of them are noise. The paper's sensor has the noise of Eq. 12 at the
    middle of its range of intensity factors."""
    k_camera, k_noise = jax.random.split(key)
    eta = 0.0
    if sensor.model.kind == "paper":
        eta = 0.625 * float(noise_of_threshold(jnp.float32(sensor.theta)))
    values = (sensor.theta, sensor.theta, eta, eta, sensor.mismatch, sensor.mismatch)
    camera = sample_pixels(k_camera, Summary(*map(jnp.float32, values)), frames.shape[1:])
    times = np.arange(len(frames)) * (1_000_000 // FPS)
    return simulate(k_noise, frames, times, camera, model=sensor.model, labels=True)


def describe(events: Events, noise: np.ndarray, seconds: float) -> dict[str, Any]:
    """The numbers of the page; densities are per decade of the interval."""
    pixels = events.size[0] * events.size[1]
    edges = np.arange(0, round(seconds * 1e6) + 1, RATE_US)
    rates = {name: np.histogram(events.t[events.p == on] - 1, edges)[0] / (pixels * RATE_US * 1e-6)
             for name, on in (("rate_on", True), ("rate_off", False))}
    between = gaps(events)
    decades = np.log10(EDGES_S)
    return {"on": int(events.p.sum()), "off": int((~events.p).sum()), "noise": int(noise.sum()),
            "distinct": len(np.unique(events.t)), "rate_s": (edges[:-1] * 1e-6).tolist(),
            **{k: v.tolist() for k, v in rates.items()},
            "interval_s": np.sqrt(EDGES_S[1:] * EDGES_S[:-1]).tolist(),
            "intervals": density(np.log10(np.maximum(between, 1e-6)), decades).tolist(),
            "median_interval_s": float(np.median(between))}


def table(result: dict[str, Any], seconds: float) -> str:
    lines = ["| sensor | θ | mismatch | ON | OFF | noise | distinct time stamps | median interval "
             "[ms] |", "|" + "---|" * 8]
    for name, sensor in sensors().items():
        row = result[name]
        lines.append(
            f"| {name} | {sensor.theta:.3f} | {sensor.mismatch} | {row['on']:,} | {row['off']:,} | "
            f"{row['noise']:,} | {row['distinct']:,} | {1e3 * row['median_interval_s']:.2f} |")
    return "\n".join([*lines, "", f"{seconds:g} s hold {1e6 * seconds:,.0f} microseconds: no more "
                      "time stamps can differ."])


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
