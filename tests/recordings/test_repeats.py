"""Frames that a converter or a camera shows twice are left out before a camera is estimated."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from helpers.videos import drifting

from evflow import Events, Recording
from evflow.recordings.repeats import ends_stale, repeated_frames, without_repeats

WIDTH, HEIGHT = 32, 24
RNG = np.random.default_rng(0)
FILM = drifting(60, (HEIGHT, WIDTH), 1.0).astype(np.uint8)  # of even motion
TICK_US = 10_000


def recording(order: np.ndarray, times: np.ndarray | None = None, fires: bool = True) -> Recording:
    """Frames order[i] of the film, 10 ms apart, while a tenth of the pixels fire in each."""
    times = TICK_US * np.arange(len(order)) if times is None else times
    count = 80 * len(order) if fires else 80
    span = (0, times[-1]) if fires else (TICK_US, 2 * TICK_US)  # there new frames come
    t = np.sort(RNG.integers(*span, count))
    pixel = RNG.integers(0, WIDTH * HEIGHT, count)
    events = Events(pixel % WIDTH, pixel // WIDTH, t, RNG.random(count) < 0.5, (WIDTH, HEIGHT))
    return Recording(events, FILM[order], times)


TWICE, PULLDOWN = np.repeat(np.arange(20), 2), np.arange(50) * 4 // 5
HICCUPS = np.arange(40)
HICCUPS[[5, 13, 19, 30]] -= 1


@pytest.mark.parametrize(("order", "even"), [
    (TWICE, False), (PULLDOWN, True), (HICCUPS, False), (np.arange(50) * 2 // 3, True)])
def test_what_is_left_shows_the_scene_at_its_time(order: np.ndarray, even: bool) -> None:
    """Frames of a converter from 24 to 30 a second are evenly spaced, as they were filmed; what a
    camera showed again because it had no new one leaves a gap."""
    given = recording(order)
    cleaned = without_repeats(given)
    first = np.flatnonzero(np.diff(order, prepend=-1) > 0)
    np.testing.assert_array_equal(cleaned.frames, FILM[order[first]])
    steps = np.diff(cleaned.frame_times)
    if even:
        per_frame = TICK_US * len(order) / (order[-1] + 1)
        np.testing.assert_allclose(steps, per_frame, rtol=0.02)
    else:
        np.testing.assert_array_equal(cleaned.frame_times, given.frame_times[first])
    assert [note.code for note in cleaned.notes] == ["frames.repeated"]
    assert f"{len(order) - len(first)} of {len(order)}" in cleaned.notes[0].text
    assert ("evenly" in cleaned.notes[0].text) == even
    assert without_repeats(cleaned) is cleaned


@pytest.mark.parametrize("given", [
    recording(np.arange(30)), recording(np.zeros(12, int)), recording(TWICE, fires=False),
    recording(np.concatenate([np.zeros(10, int), np.arange(10)]))])
def test_scenes_that_stand_still_keep_their_frames(given: Recording) -> None:
    assert without_repeats(given) is given


def test_the_check_names_what_is_left_out() -> None:
    given = recording(TWICE)
    assert repeated_frames(given).tolist() == list(range(1, 40, 2))


def test_dark_frames_at_the_end_are_looked_at() -> None:
    given = recording(np.arange(30))
    frames = given.frames.astype(np.float32)
    frames[-2:] /= 300
    assert ends_stale(dataclasses.replace(given, frames=frames)) is None


def test_frames_without_a_picture_repeat_nothing() -> None:
    given = recording(TWICE)
    assert not len(repeated_frames(
        Recording(given.events, np.full_like(given.frames, 255), given.frame_times)))
