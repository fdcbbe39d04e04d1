"""Long recordings of photographs that pan before a hidden camera, kept in files."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Iterator
from pathlib import Path

import cv2
import jax
import numpy as np

from evflow import Camera, simulate_stream
from evflow.camera import CameraPrior
from evflow.camera.sensors import SensorModel
from evflow.errors import EvflowDataError
from evflow.io import open_writer
from experiments.shared.common import slug

SPEED = 90.0  # pixels per second
BLUR = 0.8  # pixels: of the lens


@dataclasses.dataclass(frozen=True)
class Pan:
    """What a recording follows from. images: folder of photographs; size: (width, height) of the
    sensor; frames_hz: of the frames that are kept; mismatch: of the camera's thresholds."""

    images: Path
    size: tuple[int, int]
    seconds: float
    frames_hz: int
    mismatch: float
    seed: int


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


def film(pan: Pan) -> Iterator[np.ndarray]:
    """Frames (H, W) of every millisecond: a pan that changes its direction all the time."""
    rng = np.random.default_rng(pan.seed)
    scene = panorama(pan.images, pan.size, rng)
    scene = np.concatenate([scene, scene[:, ::-1]], 1)
    scene = np.concatenate([scene, scene[::-1]], 0)  # mirrored, so that it wraps without an edge
    count = round(pan.seconds * 1000) + 1
    seconds, phase = np.arange(count) / 1000, rng.uniform(0, 2 * np.pi, 3)
    angle = sum(2.0 * np.sin(2 * np.pi * seconds / period + p)
                for period, p in zip((2.3, 5.9, 17.0), phase, strict=True))
    step = SPEED / 1000 * np.stack([np.cos(angle), np.sin(angle)], -1)
    for x, y in np.cumsum(step, 0) + rng.uniform(0, 1000, 2):
        move = np.array([[1, 0, x % scene.shape[1]], [0, 1, y % scene.shape[0]]])
        yield cv2.warpAffine(scene, move, pan.size, borderMode=cv2.BORDER_WRAP,
                             flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)


def recorded(pan: Pan, folder: Path) -> tuple[Path, Camera]:
    """The recording's file, written now or kept in the folder before, and its camera. EV020 where
    frames are not whole milliseconds apart."""
    if 1000 % pan.frames_hz:
        raise EvflowDataError("EV020", f"--frames-hz {pan.frames_hz}.", "Give a divisor of 1000.")
    width, height = pan.size
    images = pan.images.resolve()
    place = hashlib.sha256(str(images).encode()).hexdigest()[:8]  # two folders may share a name
    path = folder / (f"{slug(images.name)}_{place}_{width}x{height}_{pan.seconds:g}s_"
                     f"{pan.frames_hz}hz_{pan.mismatch:g}_{pan.seed}.h5")
    k_camera, k_events = jax.random.split(jax.random.key(pan.seed))
    prior = CameraPrior(theta=(0.2, 0.3), mismatch=(pan.mismatch, pan.mismatch))
    camera = Camera.sample(k_camera, (height, width), prior)
    if not path.exists():
        write(path, pan, k_events, camera)
    return path, camera


def write(path: Path, pan: Pan, key: jax.Array, camera: Camera) -> None:
    """Write the recording's file: events as they are simulated, then the frames."""
    kept: list[np.ndarray] = []
    every = 1000 // pan.frames_hz  # ms

    def watched() -> Iterator[np.ndarray]:
        for i, frame in enumerate(film(pan)):
            if i % every == 0:
                kept.append(np.clip(np.rint(frame), 0, 255).astype(np.uint8))
            yield frame

    times = iter(range(0, 1000 * round(1000 * pan.seconds) + 1, 1000))
    path.parent.mkdir(parents=True, exist_ok=True)
    with open_writer(path, pan.size) as out:
        for events in simulate_stream(key, watched(), times, camera,
                                      model=SensorModel(noise_resets_memory=True)):
            out.append(events)
        for i, frame in enumerate(kept):
            out.append_frames(frame[None], np.array([1000 * every * i]))
