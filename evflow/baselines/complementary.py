"""The complementary filter: high-passed events plus low-passed frames.

Scheerlinck, Barnes, Mahony, "Continuous-time Intensity Estimation Using Event Cameras" (ACCV
2018): dx/dt = sum of p theta delta(t - t_i) - alpha (x - L_frame), the latest frame held. Between
events x decays to the frame; the filter is linear, so a whole segment is one weighted sum, exactly:
x(t1) = L + (x(t0) - L) e^(-alpha (t1 - t0)) + sum of p theta e^(-alpha (t1 - t_i)).
"""

from __future__ import annotations

import dataclasses

import numpy as np

from evflow.baselines.reconstruction import Reconstructor, checked, segments, steps_of
from evflow.camera import Camera
from evflow.types import Events


@dataclasses.dataclass(frozen=True)
class Complementary(Reconstructor):
    """Complementary filter.

    cutoff_rad_s: alpha, above which events lead (published 2 pi). trust, margin: alpha falls to
    `trust` of itself where the frame is within `margin` of black or white (published .1 and .05;
    clipped pixels carry little information). Before the first frame, or without frames, the
    brightness `start_dn` takes its place.
    """

    cutoff_rad_s: float = 2.0 * np.pi
    trust: float = 0.1
    margin: float = 0.05

    def log_images(
        self, events: Events, frames: np.ndarray, frame_times: np.ndarray, camera: Camera,
        times: np.ndarray,
    ) -> np.ndarray:
        frames, frame_times, theta, times = checked(events, frames, frame_times, camera, times)
        width, height = events.size
        state = np.full(height * width, float(self.logarithm.of(self.start_dn)))
        shown, alpha = state, np.full(state.size, self.cutoff_rad_s)
        images = np.zeros((len(times), height, width), np.float32)
        for part in segments(events, frame_times, times):
            if part.frame >= 0:
                shown = np.asarray(self.logarithm.of(frames[part.frame]), np.float64).ravel()
                alpha = self._alpha(frames[part.frame])
                state = shown if part.frame == 0 else state
            pixel, step = steps_of(events, part.events, theta)
            age_s = 1e-6 * (part.end_us - events.t[part.events])
            kept = np.exp(-alpha * 1e-6 * (part.end_us - part.begin_us))
            fresh = np.bincount(pixel, step * np.exp(-alpha[pixel] * age_s), state.size)
            state = shown + (state - shown) * kept + fresh
            images[part.images] = state.reshape(height, width)
        return images

    def _alpha(self, frame: np.ndarray) -> np.ndarray:
        """alpha (H*W,) of each pixel: full within the range of DN, less near its ends."""
        dn = frame.ravel().astype(np.float64)
        inside = np.minimum(dn, 255.0 - dn)
        share = np.clip(inside / max(self.margin * 255.0, 1e-9), 0.0, 1.0)
        return self.cutoff_rad_s * (self.trust + (1.0 - self.trust) * share)
