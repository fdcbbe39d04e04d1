"""Direct integration and the complementary filter against plain loops, and what they promise."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from evflow.baselines.complementary import Complementary
from evflow.baselines.integration import Integration
from evflow.baselines.reconstruction import Reconstructor
from evflow.camera import Camera
from evflow.light.logarithm import LIN_LOG, Logarithm
from evflow.simulator import simulate
from evflow.types import Events

SIZE = (6, 5)  # width, height
T0 = 1_643_243_628_737_093


def case(seed: int) -> tuple[Events, np.ndarray, np.ndarray, Camera, np.ndarray]:
    """Random events, frames and thresholds; events at the frames' own instants among them."""
    rng = np.random.default_rng(seed)
    t = T0 + np.sort(rng.integers(0, 900, 300)) * 100
    events = Events(rng.integers(0, 6, 300), rng.integers(0, 5, 300), t, rng.integers(0, 2, 300),
                    SIZE)
    frames = rng.integers(0, 256, (4, 5, 6), np.uint8)
    theta = rng.uniform(0.05, 0.4, (2, 5, 6)).astype(np.float32)
    eye = Camera(*jax.numpy.asarray(theta), *jax.numpy.zeros((2, 5, 6)))
    times = T0 + np.array([5_000, 10_000, 10_001, 30_000, 42_000, 42_000, 88_000])
    return events, frames, T0 + 10_000 + 20_000 * np.arange(4), eye, times


def logs(frame: np.ndarray, offset: float) -> np.ndarray:
    dn = frame.astype(np.float64)
    if offset:
        return np.log(dn + offset)
    return np.where(dn > 20, np.log(np.maximum(dn, 1)), dn * np.log(20) / 20)


@pytest.mark.parametrize("offset", [0.0, 40.0])
@pytest.mark.parametrize("alpha", [None, 5.0, 300.0])
def test_equals_a_loop(offset: float, alpha: float | None) -> None:
    """alpha None is integration, which takes frames as they come; else the filter."""
    events, frames, frame_times, eye, times = case(0)
    logarithm = Logarithm(offset, "log") if offset else LIN_LOG
    system: Reconstructor = (
        Integration(logarithm) if alpha is None else
        Complementary(logarithm, cutoff_rad_s=alpha, trust=1.0))
    found = system.log_images(events, frames, frame_times, eye, times)
    todo = [(int(t), 0, i) for i, t in enumerate(events.t)]
    todo += [(int(t), 1, i) for i, t in enumerate(times)]
    todo += [(int(t), 2, i) for i, t in enumerate(frame_times)]
    x = np.full((5, 6), logs(np.array(127.5), offset))
    shown, now = x.copy(), min(todo)[0]
    for t, kind, i in sorted(todo):
        x = shown + (x - shown) * np.exp(-(alpha or 0.0) * (t - now) * 1e-6)
        now = t
        if kind == 0:
            v, u = events.y[i], events.x[i]
            x[v, u] += float(eye.theta_on[v, u]) if events.p[i] else -float(eye.theta_off[v, u])
        elif kind == 1:
            np.testing.assert_allclose(found[i], x, rtol=0, atol=1e-5)
        else:
            shown = logs(frames[i], offset)
            x = shown.copy() if i == 0 or alpha is None else x


def test_a_known_camera_is_followed_to_within_a_threshold() -> None:
    """The memory of a pixel is within a threshold of its brightness, at every instant."""
    t = np.arange(121)
    phase = np.linspace(0, 3, 48).reshape(6, 8)[None]
    video = (110 + 70 * np.sin(0.06 * t[:, None, None] + phase)).astype(np.float32)
    eye = Camera.constant((6, 8), 0.2, 0.13)
    events = simulate(jax.random.key(0), video, t * 1000, eye)
    times = t[1:] * 1000
    seen = Integration().log_images(events, video[:1], np.zeros(1, np.int64), eye, times)
    error = logs(video[1:], 0) - seen
    assert error.max() < 0.2 + 1e-4
    assert error.min() > -0.13 - 1e-4
    assert np.abs(error).max() > 0.1  # and not better: the bound is what is known
    wrong = Integration().log_images(
        events, video[:1], np.zeros(1, np.int64), Camera.constant((6, 8), 0.26, 0.13), times)
    assert np.abs(logs(video[1:], 0) - wrong).max() > 0.3


def test_events_alone_tell_changes_only() -> None:
    events, frames, frame_times, eye, times = case(1)
    none, at = frames[:0], frame_times[:0]
    for start in (60.0, 200.0):
        seen = Integration(start_dn=start).log_images(events, none, at, eye, times)
        counts = events.slice(T0, int(times[-1]) + 1).count_map().astype(np.float64)
        net = counts[0] * np.asarray(eye.theta_on) - counts[1] * np.asarray(eye.theta_off)
        np.testing.assert_allclose(seen[-1], np.log(start) + net, rtol=0, atol=1e-5)


def test_an_image_at_a_frames_instant_is_a_prediction_of_it() -> None:
    events, frames, frame_times, eye, _ = case(2)
    other = frames.copy()
    other[2] = 255 - other[2]
    for system in (Integration(), Complementary()):
        a, b = (system.reconstruct(events, f, frame_times, eye, frame_times[2:3])
                for f in (frames, other))
        np.testing.assert_array_equal(a, b)
    later = frame_times[2:3] + 1
    silent = events.slice(0, 1)
    held = Integration().reconstruct(silent, frames, frame_times, eye, later)
    np.testing.assert_allclose(held[0], frames[2], rtol=0, atol=1e-3)


def test_the_filter_trusts_the_ends_of_a_frame_less() -> None:
    """A pixel in mid-range forgets its events at alpha, a black and a white one at a tenth."""
    frame = np.array([[[0, 90, 255]]], np.uint8)
    events = Events([0, 1, 2], [0, 0, 0], np.array([2, 2, 2]), [1, 1, 1], (3, 1))
    at = np.array([2_000_002])
    seen = Complementary(cutoff_rad_s=1.0).log_images(
        events, frame, np.array([1]), Camera.constant((1, 3), 0.5), at)
    rest = (seen - logs(frame, 0))[0, 0] / 0.5
    np.testing.assert_allclose(rest, np.exp([-0.2, -2.0, -0.2]), rtol=1e-4)


def test_frames_are_trusted_but_where_black_or_white() -> None:
    """The ends are the sensor's: in a frame of grey every pixel counts, also its darkest one."""
    trusted = Complementary()._alpha(np.array([[60.0, 120.0], [180.0, 200.0]]))
    np.testing.assert_allclose(trusted, 2 * np.pi)
    clipped = Complementary()._alpha(np.array([[0.0, 255.0], [6.375, 128.0]]))
    np.testing.assert_allclose(clipped, 2 * np.pi * np.array([0.1, 0.1, 0.55, 1.0]))
