"""Noise of frames: measured where nothing happens, taken away or left out where it matters."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from evflow.estimation.refine.chunk import make_chunk
from evflow.estimation.refine.denoise import denoised, frame_noise
from evflow.light.log_maps import LINLOG_KNEE
from evflow.recordings.glitches import SATURATED_DN
from evflow.simulator.photoreceptor import Photoreceptor
from evflow.types import Events, Recording

SHAPE = (72, 96)


def scene(noise_dn: float, moves: int = 0) -> Recording:
    """A smooth picture, of which `moves` px pass between two of nine frames."""
    rng = np.random.default_rng(0)
    wide = cv2.GaussianBlur(rng.normal(0, 1, (72, 240)), (0, 0), 5)
    wide = 120 + 60 * wide / wide.std()
    frames = np.stack([wide[:, k * moves:k * moves + 96] for k in range(9)])
    frames = frames + noise_dn * rng.normal(0, 1, frames.shape)
    one = np.array([0, 180_000])
    events = Events(np.array([3, 4]), np.array([3, 4]), one, np.array([True, False]), SHAPE[::-1])
    return Recording(events, np.clip(np.rint(frames), 0, 255).astype(np.uint8),
                     1000 + 20_000 * np.arange(9))


def noise(recording: Recording) -> float:
    return frame_noise([(recording, i) for i in range(8)])


@pytest.mark.parametrize("noise_dn", [1.0, 3.0, 6.0])
@pytest.mark.parametrize("moves", [0, 1])
def test_noise_is_measured(noise_dn: float, moves: int) -> None:
    """The quantile of the tiles lies a little below."""
    assert noise(scene(noise_dn, moves)) == pytest.approx(noise_dn, rel=0.25)


def test_busy_frames_tell_nothing() -> None:
    calm = scene(3.0)
    rng = np.random.default_rng(1)
    t = np.sort(rng.integers(0, 180_000, 60_000))
    events = Events(rng.integers(0, 96, 60_000), rng.integers(0, 72, 60_000), t,
                    rng.random(60_000) < 0.5, SHAPE[::-1])
    assert noise(Recording(events, calm.frames, calm.frame_times)) == 0.0


def test_much_noise_is_taken_away_and_little_is_left() -> None:
    clean, noisy = scene(0.0).frame_dn(0), scene(4.0).frame_dn(0)
    before, after = (float(np.std(f - clean)) for f in (noisy, denoised(noisy, 4.0)))
    assert after < 0.9 * before
    assert np.std(denoised(clean, 4.0) - clean) < 1.0
    assert denoised(noisy, 0.7) is noisy


def test_a_little_noise_is_taken_away_where_it_matters_in_dark_scenes() -> None:
    """At 20 DN, 1 DN of noise is .05 log units."""
    clean, noisy = (scene(dn).frame_dn(0) / 5 for dn in (0.0, 5.0))
    before, after = (float(np.std(f - clean)) for f in (noisy, denoised(noisy, 1.0)))
    assert after < 0.8 * before


@pytest.mark.parametrize("added", [0.0, 8.0])
def test_pixels_below_the_knee_of_the_lin_log_map_are_not_compared(added: float) -> None:
    """There half a DN of noise is .075 log units: of a dark scene of low thresholds, simulated with
    its noise, theta_off came out 12 % too high, and 31 % with 1 DN of noise."""
    light = np.broadcast_to(np.linspace(0, 255, 32, dtype=np.uint8), (3, 24, 32))
    one = np.array([0, 50_000])
    events = Events(one % 7, one % 7, one, np.array([True, False]), (32, 24))
    seen_by = Photoreceptor(offset_dn=added)
    chunk = make_chunk(Recording(events, light, 25_000 * np.arange(3)), (0, 1), seen_by=seen_by)
    assert (chunk.bright == ((light[0] + added >= LINLOG_KNEE) & (light[0] <= SATURATED_DN))).all()
