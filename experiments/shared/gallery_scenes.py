"""What the gallery shows: a hidden camera before a moving scene, and before a stepped screen."""

from __future__ import annotations

import itertools
from functools import cached_property

import jax
import numpy as np

from evflow import (
    Camera,
    CameraEstimate,
    CameraPrior,
    Recording,
    SensorModel,
    estimate_camera,
    simulate,
)
from evflow.camera import Summary
from evflow.estimation.bench.calibration import calibrate_step
from evflow.estimation.bench.levels import Bench
from experiments.shared.hidden_scene import hidden_camera

SPAN_US = 30_000  # of the events in a picture
LEVELS = (40, 220, 55, 100, 40, 100, 220, 55, 220, 100, 40, 220, 40, 55, 100)  # DN of the screen
REST, EDGE = 200, 4  # ms of a level, and of the step to it
EDGES_US = 1000 * (REST - 1 + (REST + EDGE) * np.arange(len(LEVELS) - 1))  # when steps begin


class Scenes:
    """Recordings and estimates that pictures share, each made on first use."""

    def __init__(self, seed: int) -> None:
        self.seed = seed

    @cached_property
    def hidden(self) -> tuple[Recording, Camera, Summary]:
        return hidden_camera(self.seed, 160, 120, 300)

    @property
    def recording(self) -> Recording:
        return self.hidden[0]

    @property
    def truth(self) -> Camera:
        return self.hidden[1]

    @cached_property
    def found(self) -> CameraEstimate:
        """The estimate of `recording`."""
        return estimate_camera(self.recording)

    @cached_property
    def bench(self) -> CameraEstimate:
        """The step protocol's measurement of a camera, with triggers."""
        return calibrate_step(screen(self.seed), triggers_us=EDGES_US)

    @property
    def levels(self) -> Bench:
        """Noise, speed and latency of `bench` at each level of light."""
        assert self.bench.bench is not None
        return self.bench.bench

    @cached_property
    def other(self) -> CameraEstimate:
        """The same of another camera, without triggers."""
        return calibrate_step(screen(self.seed + 1))

    @property
    def span(self) -> tuple[int, int]:
        """The middle of `recording`, in us."""
        t = self.recording.events.t
        middle = (int(t[0]) + int(t[-1])) // 2
        return middle - SPAN_US // 2, middle + SPAN_US // 2


def screen(seed: int) -> Recording:
    """A v2e-like camera before a screen that steps between four levels of light."""
    shape = (48, 64)
    k_camera, k_events = jax.random.split(jax.random.key(seed))
    camera = Camera.sample(k_camera, shape, CameraPrior(theta=(0.2, 0.24), noise="none"))
    model = SensorModel(cutoff_hz=200.0, refractory_s=5e-4, leak_hz=0.1, shot_hz=2.0,
                        noise_resets_memory=True)
    logs = [np.full(REST, np.log(LEVELS[0]))]
    for a, b in itertools.pairwise(np.log(LEVELS)):
        logs += [np.linspace(a, b, EDGE + 1)[1:], np.full(REST, b)]
    light = np.exp(np.concatenate(logs)).astype(np.float32)
    frames = np.broadcast_to(light[:, None, None], (len(light), *shape))
    times = 1000 * np.arange(len(light))
    events = simulate(k_events, frames, times, camera, model=model)
    return Recording(events, np.rint(frames[::20]).astype(np.uint8), times[::20])
