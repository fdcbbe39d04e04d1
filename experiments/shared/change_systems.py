"""Intensity changes of one recording by every system, scored against its frames (Table XI).

All systems know the thresholds that `estimate_camera` finds, the filters with the light that it
measures, the encoder, which was trained on ideal pixels, those of such; and answer alike: the
change of their state since a frame was taken in. "next": up to the next frame, the paper's
protocol; the encoder and the published filter see that frame, which makes it easy for them.
"middle": up to the middle one of three frames, when only the outer two are known: no system sees
the answer. "path": up to instants between two frames, against a fast video (simulated only).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

import jax.numpy as jnp
import numpy as np

from evflow import Recording, encode, estimate_camera
from evflow.baselines.akf import Akf
from evflow.baselines.base import usable
from evflow.baselines.complementary import Complementary
from evflow.baselines.integration import Integration
from evflow.baselines.reconstruction import Reconstructor
from evflow.camera import Camera, Summary
from evflow.estimation.pooled import window_inputs
from evflow.light.log_maps import lin_log
from evflow.light.logarithm import LIN_LOG, Logarithm
from evflow.types import Window
from experiments.shared.alone import logarithm_of

LOG_255 = float(np.log(255.0))
PARTS = 16  # instants between two frames
FILTERS: dict[str, Reconstructor] = {
    "integration": Integration(), "complementary": Complementary(),
    "AKF, latest frame": Akf(reference="latest"), "AKF": Akf(),
    "AKF, published log and .1": Akf(logarithm=Logarithm(255.0, "log"))}
PUBLISHED = 0.1  # threshold of the published filter, in its own log map
Changes = dict[str, np.ndarray]


@dataclasses.dataclass(frozen=True, eq=False)
class Scene:
    """A recording, its estimated camera and the logarithm of that camera's thresholds, the summary
    of its pixels taken for ideal, and the true log video (K, PARTS + 1, H, W) from each frame to
    the next, where there is one. good: usable intervals."""

    recording: Recording
    camera: Camera
    logarithm: Logarithm
    summary: Summary
    good: list[int]
    video: np.ndarray | None = None

    def log_frame(self, index: int) -> np.ndarray:
        return np.asarray(lin_log(self.recording.frame_dn(index)))


@dataclasses.dataclass(frozen=True, eq=False)
class Predicted:
    """Changes since `frame` (H, W) DN: the true ones (T, H, W), and every system's."""

    frame: np.ndarray
    true: np.ndarray
    made: Changes


def make_scene(params: Any, recording: Recording, video: np.ndarray | None = None) -> Scene:
    """The scene, with its camera measured both ways."""
    found, ideal = (estimate_camera(recording, params, pixel=p) for p in ("measured", "ideal"))
    return Scene(recording, found.camera, logarithm_of(found), ideal.summary, usable(recording),
                 video)


def next_frame(scene: Scene, params: Any) -> Iterator[Predicted]:
    """The changes in each usable interval; T is 1, the next frame, or PARTS with a video (whose
    last is the next frame)."""
    times = scene.recording.frame_times
    steps = 1 if scene.video is None else PARTS
    instants = np.array([_instants(times[i:i + 2], steps) for i in scene.good])
    states = {name: _states(scene, name, np.arange(len(times)), instants.ravel())
              for name in FILTERS}
    for place, i in enumerate(scene.good):
        start = scene.log_frame(i)
        true = (scene.log_frame(i + 1)[None] if scene.video is None else scene.video[i, 1:])
        rows = slice(place * (steps + 1), (place + 1) * (steps + 1))
        made = {name: s[rows][1:] - s[rows][:1] for name, s in states.items()}
        made["frames alone"] = np.linspace(0, 1, steps + 1)[1:, None, None] * (
            scene.log_frame(i + 1) - start)[None]
        made["encoder"] = _encoded(scene, params, i, i + 1)[PARTS // steps::PARTS // steps]
        made["no change"] = np.zeros_like(true)
        true = true - (start if scene.video is None else scene.video[i, 0])[None]
        yield Predicted(scene.recording.frame_dn(i), true, made)


def middle_frame(scene: Scene, params: Any) -> Iterator[Predicted]:
    """For each two adjacent usable intervals: the change (1, H, W) from the first frame to the
    second, predicted from the first and the third."""
    times, pairs = scene.recording.frame_times, [i for i in scene.good if i + 1 in scene.good]
    for parity in (0, 1):
        mine = [i for i in pairs if i % 2 == parity]
        instants = np.array([_instants(times[i:i + 2], 1) for i in mine])
        kept = np.arange(parity, len(times), 2)
        states = {n: _states(scene, n, kept, instants.ravel()) for n in FILTERS} if mine else {}
        for place, i in enumerate(mine):
            start = scene.log_frame(i)
            share = float((times[i + 1] - times[i]) / (times[i + 2] - times[i]))
            rows = slice(2 * place, 2 * place + 2)
            made = {name: s[rows][1:] - s[rows][:1] for name, s in states.items()}
            made["frames alone"] = share * (scene.log_frame(i + 2) - start)[None]
            made["encoder"] = _between(_encoded(scene, params, i, i + 2), share)[None]
            made["no change"] = np.zeros((1, *start.shape))
            true = (scene.log_frame(i + 1) - start)[None]
            yield Predicted(scene.recording.frame_dn(i), true, made)


def _instants(ends: np.ndarray, steps: int) -> np.ndarray:
    """(steps + 1,) us, up to the next frame's; the first is the one after the frame is known."""
    return np.rint(np.linspace(ends[0], ends[1], steps + 1)).astype(np.int64) + np.eye(
        1, steps + 1, dtype=np.int64)[0]


def _states(scene: Scene, name: str, kept: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Lin-log states (T, H, W) of a filter that is given the frames `kept`."""
    system, recording = FILTERS[name], scene.recording
    frames = np.stack([recording.frame_dn(int(i)) for i in kept])
    camera = Camera.constant(scene.camera.shape, PUBLISHED, PUBLISHED)
    if system.logarithm == LIN_LOG:
        camera, system = scene.camera, dataclasses.replace(system, logarithm=scene.logarithm)
    states = system.log_images(
        recording.events, frames, recording.frame_times[kept], camera, times)
    if system.logarithm == LIN_LOG:
        return states
    return np.asarray(lin_log(jnp.maximum(system.logarithm.dn(states), 0.0)))


def _encoded(scene: Scene, params: Any, first: int, last: int) -> np.ndarray:
    """Change (PARTS + 1, H, W) from frame `first` on by the encoder, which knows frame `last`."""
    recording = scene.recording
    t0, t1 = (int(recording.frame_times[i]) for i in (first, last))
    window = Window(recording.events.slice(t0, t1), recording.frame_dn(first),
                    recording.frame_dn(last), t0, t1, 0)
    voxels, dlogI, given = window_inputs(window)
    up, down = np.split(np.asarray(
        encode(params, voxels, dlogI, summary=scene.summary, **given).changes), 2, -1)
    return np.pad(np.moveaxis(np.cumsum(up - down, -1), -1, 0), ((1, 0), (0, 0), (0, 0)))


def _between(path: np.ndarray, share: float) -> np.ndarray:
    """A path (PARTS + 1, H, W) at a share of its length, (H, W)."""
    low = min(int(share * PARTS), PARTS - 1)
    return path[low] + (share * PARTS - low) * (path[low + 1] - path[low])


def scored(
    scene: Scene, params: Any
) -> tuple[dict[str, dict[str, np.ndarray]], Predicted | None]:
    """Mean `errors` (4,) of each protocol and system over a recording's intervals; and the
    predictions of the held-out frame that changed most, None where there is no such frame."""
    rows: dict[str, dict[str, list[list[float]]]] = {}
    most, largest = None, -1.0
    for name, task in (("next", next_frame), ("middle", middle_frame)):
        for predicted in task(scene, params):
            fired = predicted.made["integration"][-1] != 0
            for system, change in predicted.made.items():
                row = rows.setdefault(name, {}).setdefault(system, [])
                row.append(errors(predicted.true[-1:], change[-1:], fired))
                if len(predicted.true) > 1:
                    rows.setdefault("path", {}).setdefault(system, []).append(
                        errors(predicted.true, change, fired))
            size = float(np.abs(predicted.true).mean())
            if name == "middle" and size > largest:
                most, largest = predicted, size
    return {task: {s: np.nanmean(found, 0) for s, found in row.items()}
            for task, row in rows.items()}, most


def errors(true: np.ndarray, made: np.ndarray, fired: np.ndarray) -> list[float]:
    """Mean absolute errors of a change (T, H, W): in log units, in log_255, of the magnitude in
    log_255 held to 0..1 as in the paper, and in log units of the pixels `fired` (H, W) alone."""
    off = np.abs(made - true)
    sizes = [np.minimum(np.abs(c) / LOG_255, 1.0) for c in (made, true)]
    return [float(off.mean()), float(off.mean()) / LOG_255,
            float(np.abs(sizes[0] - sizes[1]).mean()),
            float(off[:, fired].mean()) if fired.any() else float("nan")]
