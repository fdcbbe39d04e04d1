"""Frames to events and to voxels: evflow against a one-thread numba loop.

The video is made here: a photograph of scikit-image under a smooth similarity motion, 346x260 at
1000 frames per second. Each pixel has thresholds of its own, .2 with a mismatch of .03. "noise on"
is v2e's noisy pixel (`--sensor noisy`): low-pass at 30 Hz, leak .1 Hz that jitters and differs from
pixel to pixel, shot noise 5 Hz, each noise event resetting the memory. Events are delivered as one
sorted list in memory.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import cv2
import jax
import numpy as np

from benchmarks.harness import Case, Setting, Workload
from evflow.camera import Camera, CameraPrior
from evflow.camera.sensors import SENSORS, SensorModel
from evflow.light.log_maps import uint8_table
from evflow.scenes.photos import load_photos
from evflow.simulator import simulate, simulate_voxels

PRIOR = CameraPrior((0.2, 0.2), (0.03, 0.03), noise="none")
MODELS = {False: SensorModel(), True: SENSORS["noisy"].model}  # noise off, on
DT_US, BINS = 1000, 16
WINDOW_FRAMES = 50  # intervals per voxel grid: 50 ms


def video(setting: Setting, frames: int) -> np.ndarray:
    """uint8 (frames, H, W): about .13 px, .02 degrees and .01 % of zoom per frame."""
    width, height = (48, 36) if setting.quick else (346, 260)
    sharp = load_photos()["brick" if setting.quick else "camera"]
    photo = cv2.GaussianBlur(255 * sharp, (0, 0), 0.8)
    centre = (photo.shape[1] / 2, photo.shape[0] / 2)
    corner = (width / 2 - centre[0], height / 2 - centre[1])
    out = np.empty((frames, height, width), np.uint8)
    for i in range(frames):
        move = cv2.getRotationMatrix2D(centre, 0.02 * i, 1 + 1e-4 * i)
        move[:, 2] += (corner[0] - 0.12 * i, corner[1] - 3 * np.sin(i / 40))
        out[i] = np.rint(cv2.warpAffine(photo, move, (width, height), flags=cv2.INTER_LINEAR,
                                        borderMode=cv2.BORDER_REFLECT_101))
    return out


def _camera(frames: np.ndarray) -> Camera:
    return Camera.sample(jax.random.key(1), frames.shape[1:], PRIOR)


def events_evflow(setting: Setting, noisy: bool) -> Workload:
    frames = video(setting, 20 if setting.quick else 300)
    times = np.arange(len(frames)) * DT_US
    camera, model = _camera(frames), MODELS[noisy]
    return Workload(lambda: simulate(jax.random.key(0), frames, times, camera, model=model),
                    lambda events: _work(frames, len(events)))


def events_numba(setting: Setting, noisy: bool) -> Workload:
    from benchmarks import peer_numba

    frames, table = video(setting, 20 if setting.quick else 300), uint8_table("linlog")
    pixels = peer_numba.Pixels.of(_camera(frames), MODELS[noisy], DT_US * 1e-6)
    return Workload(lambda: peer_numba.simulate(frames, table, pixels),
                    lambda events: _work(frames, len(events[0])))


def _work(frames: np.ndarray, events: int) -> dict[str, float]:
    return {"frames": len(frames) - 1, "events": events,
            "GB": 1e-9 * (frames.nbytes + 13 * events)}  # an event: 2 + 2 + 8 + 1 bytes


def voxels_evflow(setting: Setting, noisy: bool) -> Workload:
    frames = video(setting, (10 if setting.quick else WINDOW_FRAMES) + 1)
    camera, model = _camera(frames), MODELS[noisy]
    return Workload(
        lambda: simulate_voxels(jax.random.key(0), frames, camera,
                                frame_dt_s=DT_US * 1e-6, model=model, bins=BINS),
        partial(_voxel_work, frames))


def voxels_numba(setting: Setting, noisy: bool) -> Workload:
    from benchmarks import peer_numba

    frames = video(setting, (10 if setting.quick else WINDOW_FRAMES) + 1)
    pixels = peer_numba.Pixels.of(_camera(frames), MODELS[noisy], DT_US * 1e-6)
    table = uint8_table("linlog")
    return Workload(lambda: peer_numba.simulate_voxels(frames, table, pixels, BINS),
                    partial(_voxel_work, frames))


def _voxel_work(frames: np.ndarray, grid: Any) -> dict[str, float]:
    return {"frames": len(frames) - 1, "events": float(np.asarray(grid).sum(dtype=np.float64)),
            "GB": 1e-9 * (frames.nbytes + grid.nbytes)}


CASES = tuple(
    Case("simulator", f"{output}, noise {'on' if noisy else 'off'}", implementation,
         partial(prepare, noisy=noisy), needs)
    for output, pair in (("events", (events_evflow, events_numba)),
                         (f"voxels, {BINS} bins", (voxels_evflow, voxels_numba)))
    for noisy in (False, True)
    for implementation, prepare, needs in (("evflow", pair[0], ""),
                                           ("numba, 1 thread", pair[1], "numba"))
)
