"""Direct integration: L(t) = L(t0) + sum of p theta over the events since a frame at t0.

Wang et al. (ACRA 2019) judge a calibration by these images, and so does the paper (Table X). The
state is set to each new frame; without frames it starts at a constant. There is no decay, so a
threshold's error adds up over the events.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from evflow.baselines.reconstruction import Reconstructor, checked, segments, steps_of
from evflow.camera import Camera
from evflow.types import Events


@dataclasses.dataclass(frozen=True)
class Integration(Reconstructor):
    """Direct integrated images."""

    def log_images(
        self, events: Events, frames: np.ndarray, frame_times: np.ndarray, camera: Camera,
        times: np.ndarray,
    ) -> np.ndarray:
        frames, frame_times, theta, times = checked(events, frames, frame_times, camera, times)
        width, height = events.size
        state = np.full(height * width, float(self.logarithm.of(self.start_dn)))
        images = np.zeros((len(times), height, width), np.float32)
        for part in segments(events, frame_times, times):
            if part.frame >= 0:
                state = np.asarray(self.logarithm.of(frames[part.frame]), np.float64).ravel()
            pixel, step = steps_of(events, part.events, theta)
            state = state + np.bincount(pixel, step, state.size)
            images[part.images] = state.reshape(height, width)
        return images
