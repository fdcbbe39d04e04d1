"""Frames that the events contradict are found in a busy scene, and sound ones are left alone."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax
import numpy as np
import pytest

from evflow import Camera, Recording, simulate
from evflow.recordings import plan_windows

FAULTY, EVERY, FRAMES = 5, 20, 12
Fault = Callable[[np.ndarray, np.ndarray], np.ndarray]  # the frame and the first one -> the frame


@pytest.fixture(scope="module")
def busy() -> Recording:
    """Stripes and blobs that cross the image; most pixels fire, as many ON as OFF."""
    t = np.arange(EVERY * (FRAMES - 1) + 1)
    y, x = np.mgrid[:48, :64]
    frames = np.stack([
        120 + 60 * np.sin((x + 0.13 * k) / 3.0) + 40 * np.sin((x - y + 0.07 * k) / 5.0)
        for k in t]).astype(np.float32)
    events = simulate(jax.random.key(0), frames, 1000 * t, Camera.constant(
        (48, 64), theta_on=0.2, theta_off=0.25, eta_on=0.3, eta_off=0.3))
    return Recording(events, np.rint(frames[::EVERY]).astype(np.uint8), 1000 * t[::EVERY])


def with_frame(recording: Recording, fault: Fault) -> Recording:
    frames = recording.frames.copy()
    frames[FAULTY] = fault(frames[FAULTY].astype(float), frames[0].astype(float)).clip(0, 255)
    return dataclasses.replace(recording, frames=frames)


def test_a_busy_scene_has_no_faults(busy: Recording) -> None:
    fired = busy.events.slice(0, EVERY * 1000).count_map().sum(0) > 0
    assert fired.mean() > 0.5
    plan = plan_windows(busy)
    assert (len(plan.pairs), plan.skipped) == (5, ())


@pytest.mark.parametrize(("fault", "said"), [
    (lambda frame, old: old, "does not match"),
    (lambda frame, old: np.random.default_rng(0).uniform(20, 250, frame.shape), "does not match"),
    (lambda frame, old: np.zeros_like(frame), "frame"),
    (lambda frame, old: np.full_like(frame, 255), "frame"),
    (lambda frame, old: 0.6 * frame, "auto-exposure")])
def test_windows_at_a_frame_that_the_events_contradict_are_left_out(
    busy: Recording, fault: Fault, said: str
) -> None:
    plan = plan_windows(with_frame(busy, fault))
    assert all(not first <= FAULTY <= last for first, last in plan.pairs)
    assert len(plan.pairs) >= 4
    assert said in plan.skipped[0].why


def test_a_step_of_exposure_is_left_out_and_what_follows_is_used(busy: Recording) -> None:
    frames = busy.frames.copy()
    frames[FAULTY:] = (0.75 * frames[FAULTY:]).astype(np.uint8)
    plan = plan_windows(dataclasses.replace(busy, frames=frames))
    assert plan.pairs == ((0, 2), (2, 4), (5, 7), (7, 9), (9, 11))
    assert "auto-exposure" in plan.skipped[0].why


def test_light_that_changes_is_no_fault(busy: Recording) -> None:
    """Events say that all of the scene gets brighter by a half within one interval."""
    t = np.arange(EVERY * (FRAMES - 1) + 1)
    gain = np.interp(t, [EVERY * FAULTY, EVERY * (FAULTY + 1)], [1.0, 1.5])
    x = np.broadcast_to(np.arange(64), (48, 64))
    frames = np.stack([g * (80 + 50 * np.sin((x + 0.3 * k) / 3.0))
                       for g, k in zip(gain, t, strict=True)]).astype(np.float32)
    events = simulate(jax.random.key(0), frames, 1000 * t, Camera.constant((48, 64)))
    recording = Recording(events, np.rint(frames[::EVERY]).astype(np.uint8), 1000 * t[::EVERY])
    assert plan_windows(recording).skipped == ()
