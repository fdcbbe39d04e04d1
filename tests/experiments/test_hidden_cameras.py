"""Hidden cameras are what their protocol says."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest

from evflow.camera import CameraPrior
from evflow.camera.sensors import SensorModel
from evflow.light.log_maps import lin_log
from evflow.scenes import make_bank
from experiments.shared.cameras import Protocol, hidden_recording, low_passed, with_dark_light

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


def test_true_noise_rates_are_of_all_noise() -> None:
    """Of shot noise too, which an estimate's rates include."""
    bank = make_bank(jax.random.key(1), 4, photos=False)
    quiet = Protocol(prior=CameraPrior(noise="none", mismatch=(0.1, 0.1)), intervals=16)
    loud = dataclasses.replace(quiet, model=SensorModel(shot_hz=5.0, noise_resets_memory=True))
    for protocol in (quiet, loud):
        hidden = hidden_recording(jax.random.key(3), bank, protocol)
        events = hidden.recording.events
        seconds = 1e-6 * (hidden.recording.frame_times[-1] + 1)
        for on, name in ((True, "on"), (False, "off")):
            sent = (hidden.noise & (events.p == on)).sum() / (64 * 64 * seconds)
            expected = float(getattr(hidden.nominal, f"eta_{name}"))
            assert abs(sent - expected) < 0.07 * expected + 1e-9
            assert float(getattr(hidden.camera, f"eta_{name}").mean()) == pytest.approx(expected)


def test_dark_light_adds_and_saturates_nothing() -> None:
    frames = np.array([0.0, 55.0, 255.0], np.float32)[:, None, None]
    lit = with_dark_light(frames, 24.0)
    np.testing.assert_allclose(lit / lit[0], (frames + 24.0) / 24.0, rtol=1e-6)
    assert lit.max() == pytest.approx(255.0)
    assert with_dark_light(frames, 0.0) is frames
