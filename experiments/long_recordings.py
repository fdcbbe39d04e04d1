"""Long recordings of a hidden camera: what an estimate costs, and how near it comes.

    python -m experiments.long_recordings --images photographs/ --seconds 30 --keep /tmp/long

Photographs side by side pan before the camera at 1000 frames per second; 25 of them a second are
kept, as a DAVIS346 records them. Printed are the CPU seconds and the memory of
`estimate_camera`, the errors of the summary and of the pixels, and how often the 95 % interval
holds the truth.
"""

from __future__ import annotations

import dataclasses
import resource
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import cv2
import jax
import numpy as np

from evflow import Camera, CameraEstimate, estimate_camera, simulate_stream
from evflow.camera import CameraPrior
from evflow.camera.sensors import SensorModel
from evflow.errors import EvflowDataError
from evflow.io import open_writer
from evflow.network.weights import load_weights
from experiments.shared.common import begin, conclude, estimator, markdown, run_script

SPEED = 90.0  # pixels per second
BLUR = 0.8  # pixels: of the lens


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """Estimate a camera from a long recording."""

    images: Path
    """Folder of photographs."""
    keep: Path
    """Folder in which recordings are kept between runs."""
    out: Path = Path("out/long_recordings")
    seed: int = 5_000_101
    seconds: float = 30.0
    size: tuple[int, int] = (346, 260)
    frames_hz: int = 25
    mismatch: float = 0.03
    effort: Literal["quick", "normal", "full"] = "normal"
    weights: str = "default"


def panorama(folder: Path, size: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """Photographs side by side, float32 DN, twice as high and eight times as wide as a sensor."""
    paths = sorted(p for p in folder.rglob("*") if p.suffix.lower() in (".jpg", ".png"))
    if len(paths) < 8:
        raise EvflowDataError("EV016", f"{len(paths)} photographs in {folder}.", "It takes 8.")
    width, height = size
    rows = []
    for path in rng.permutation(np.array(paths, dtype=object))[:8]:
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if image is None:
            raise EvflowDataError("EV009", f"{path} is no image.")
        rows.append(cv2.resize(image, (width, 2 * height), interpolation=cv2.INTER_AREA))
    whole = np.concatenate(rows, 1).astype(np.float32)
    return np.clip(cv2.GaussianBlur(whole, (0, 0), BLUR), 8.0, 245.0)


def film(options: Options, rng: np.random.Generator) -> Iterator[np.ndarray]:
    """Frames (H, W) of every millisecond: a pan that changes its direction all the time."""
    width, height = options.size
    scene = panorama(options.images, options.size, rng)
    scene = np.concatenate([scene, scene[:, ::-1]], 1)
    scene = np.concatenate([scene, scene[::-1]], 0)  # mirrored, so that it wraps without an edge
    count = round(options.seconds * 1000) + 1
    seconds, phase = np.arange(count) / 1000, rng.uniform(0, 2 * np.pi, 3)
    angle = sum(2.0 * np.sin(2 * np.pi * seconds / period + p)
                for period, p in zip((2.3, 5.9, 17.0), phase, strict=True))
    step = SPEED / 1000 * np.stack([np.cos(angle), np.sin(angle)], -1)
    for x, y in np.cumsum(step, 0) + rng.uniform(0, 1000, 2):
        move = np.array([[1, 0, x % scene.shape[1]], [0, 1, y % scene.shape[0]]])
        yield cv2.warpAffine(scene, move, (width, height), borderMode=cv2.BORDER_WRAP,
                             flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)


def make(options: Options) -> tuple[Path, Camera]:
    """The file of the recording, written now or kept before, and its camera."""
    width, height = options.size
    name = f"{width}x{height}_{options.seconds:g}s_{options.frames_hz}hz_{options.mismatch:g}_" \
           f"{options.seed}"
    path = options.keep / f"{name}.h5"
    k_camera, k_events = jax.random.split(jax.random.key(options.seed))
    prior = CameraPrior(theta=(0.2, 0.3), mismatch=(options.mismatch, options.mismatch))
    camera = Camera.sample(k_camera, (height, width), prior)
    if not path.exists():
        write(path, options, k_events, camera)
    return path, camera


def write(path: Path, options: Options, key: jax.Array, camera: Camera) -> None:
    """The recording's file, event by event as they are simulated, and its frames."""
    kept: list[np.ndarray] = []

    def watched() -> Iterator[np.ndarray]:
        for i, frame in enumerate(film(options, np.random.default_rng(options.seed))):
            if i % (1000 // options.frames_hz) == 0:
                kept.append(np.clip(np.rint(frame), 0, 255).astype(np.uint8))
            yield frame

    times = iter(range(0, 1000 * round(1000 * options.seconds) + 1, 1000))
    path.parent.mkdir(parents=True, exist_ok=True)
    with open_writer(path, options.size) as out:
        for events in simulate_stream(key, watched(), times, camera,
                                      model=SensorModel(noise_resets_memory=True)):
            out.append(events)
        step = 1000 * (1000 // options.frames_hz)
        for i, frame in enumerate(kept):
            out.append_frames(frame[None], np.array([i * step]))


def score(found: CameraEstimate, camera: Camera) -> dict[str, float]:
    """Errors of the summary and of the pixels, and whether intervals hold the truth."""
    result: dict[str, float] = {}
    for side in ("on", "off"):
        truth = np.asarray(getattr(camera, f"theta_{side}"))
        theta, std = (np.asarray(getattr(c, f"theta_{side}")) for c in (found.camera, found.std))
        summary, error = (float(getattr(s, f"theta_{side}"))
                          for s in (found.summary, found.summary_std))
        away = summary - float(np.median(truth))
        result |= {f"summary_error_{side}": away, f"summary_z_{side}": away / error,
                   f"mae_pixel_{side}": float(np.abs(theta - truth).mean()),
                   f"r_{side}": float(np.corrcoef(theta.ravel(), truth.ravel())[0, 1]),
                   f"within_95_{side}": float((np.abs(theta - truth) < 1.96 * std).mean())}
    return result


def main(options: Options) -> dict[str, Any]:
    begin(options, "long_recordings")
    estimator(options.weights, "summary")
    path, camera = make(options)
    before, wall = time.process_time(), time.monotonic()
    found = estimate_camera(path, load_weights(options.weights), effort=options.effort)
    result = {"cpu_s": time.process_time() - before, "wall_s": time.monotonic() - wall,
              "peak_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6,
              "events": int(found.n_events.sum()), "read_s": found.extent.read_s,
              **score(found, camera)}
    conclude(options, "long_recordings", result, markdown(
        ("what", "value"), ((k, f"{v:.4g}") for k, v in result.items())))
    return result


if __name__ == "__main__":
    run_script(main, Options, __doc__)
