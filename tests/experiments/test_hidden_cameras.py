"""Hidden cameras are what their protocol says."""

from __future__ import annotations

import numpy as np

from evflow.camera.sensors import SensorModel
from evflow.light.log_maps import lin_log
from experiments.shared.cameras import Protocol, low_passed

CUTOFF_HZ, STEP_US = 40.0, 1000


def test_a_slow_camera_has_the_cutoff_that_it_is_said_to_have() -> None:
    """After a step of light what it sees lies 1/e below the end once 1 / (2 pi cutoff) has passed,
    though the video's frames are a quarter of that apart."""
    video = np.full((40, 1, 1), 50.0, np.float32)
    video[1:] = 200.0
    times = np.arange(len(video)) * STEP_US
    protocol = Protocol(model=SensorModel(cutoff_hz=CUTOFF_HZ, cutoff_by_light=False), exact=True)
    shown, behind = low_passed(video, times, protocol)
    assert behind.cutoff_hz == 0
    s = np.asarray(lin_log(shown[:, 0, 0]))
    left = np.log((s[-1] - s[5:25]) / (s[-1] - s[4]))  # from 5 frames on, of one exponential
    pace = -np.polyfit(np.arange(len(left)), left, 1)[0] / (STEP_US * 1e-6)
    np.testing.assert_allclose(pace / (2 * np.pi), CUTOFF_HZ, rtol=0.03)
    same, model = low_passed(video, times, Protocol(model=protocol.model))
    assert same is video
    assert model is protocol.model
