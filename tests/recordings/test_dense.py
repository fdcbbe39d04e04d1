"""Frames that are nearer than an estimate can use."""

from __future__ import annotations

import numpy as np
import pytest

from evflow import Events, Recording
from evflow.recordings.dense import LEAST_US, thinned


def recording(interval_us: int, count: int) -> Recording:
    times = interval_us * np.arange(count) + 500
    frames = np.zeros((count, 4, 6), np.uint8) + np.arange(count)[:, None, None].astype(np.uint8)
    events = Events(*(np.array([v]) for v in (1, 2, times[-1] // 2)), np.array([True]), (6, 4))
    return Recording(events, frames, times)


@pytest.mark.parametrize(("interval_us", "step"), [(1000, 10), (4000, 3), (5000, 2), (8333, 2)])
def test_every_nth_is_kept_with_its_time(interval_us: int, step: int) -> None:
    given = recording(interval_us, 60)
    found = thinned(given)
    np.testing.assert_array_equal(found.frame_times, given.frame_times[::step])
    np.testing.assert_array_equal(found.frames, given.frames[::step])
    assert np.diff(found.frame_times).min() >= LEAST_US
    assert [note.code for note in found.notes] == ["frames.dense"]
    assert f"{len(found.frame_times)} of 60" in str(found.notes[0])
    assert thinned(found) is found


@pytest.mark.parametrize(("interval_us", "count"), [(10_000, 60), (9_900, 60), (1000, 15), (1, 2)])
def test_others_are_left_alone(interval_us: int, count: int) -> None:
    given = recording(interval_us, count)
    assert thinned(given) is given
