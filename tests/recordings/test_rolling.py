"""Frames that are read row by row become frames of one time, by moving the events."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from evflow import EvflowDataError, Recording
from evflow.recordings import rolling as rolling_module
from evflow.recordings.rolling import Rolling, Side, delays_us, unrolled
from evflow.types import Events

SIZE = 40, 30


def random_recording(n: int = 5_000) -> Recording:
    """Events of a second, many at the same time, and frames around and in it."""
    rng = np.random.default_rng(0)
    x, y = (rng.integers(0, side, n) for side in SIZE)
    events = Events(x, y, np.sort(rng.integers(0, 1_000, n)) * 1000, rng.random(n) < 0.5, SIZE)
    times = np.arange(-40_000, 1_100_000, 40_000)
    return Recording(events, rng.integers(0, 255, (len(times), 30, 40), np.uint8), times)


@pytest.mark.parametrize(("first", "late"), [
    ("top", lambda e: (e.y + 0.5) / 30 - 0.5), ("bottom", lambda e: 0.5 - (e.y + 0.5) / 30),
    ("left", lambda e: (e.x + 0.5) / 40 - 0.5), ("right", lambda e: 0.5 - (e.x + 0.5) / 40)])
@pytest.mark.parametrize("at_once", [300, 10**6])
def test_every_event_is_moved_by_the_delay_of_its_line(
    monkeypatch: pytest.MonkeyPatch, first: Side, late: Callable[[Events], np.ndarray],
    at_once: int,
) -> None:
    """Whole, and part by part."""
    monkeypatch.setattr(rolling_module, "AT_ONCE", at_once)
    recording = random_recording()
    events = recording.events
    t = events.t - np.rint(25e3 * late(events)).astype(np.int64)
    order = np.argsort(t, kind="stable")
    found = unrolled(recording, Rolling(0.025, first)).events
    for name, expected in zip("xytp", (events.x, events.y, t, events.p), strict=True):
        column = getattr(found, name)
        np.testing.assert_array_equal(column, expected[order])
        assert column.dtype == getattr(events, name).dtype


def test_frames_without_events_around_every_row_are_left_out() -> None:
    recording = random_recording()
    found = unrolled(recording, Rolling(0.05, "top"))
    assert found.frame_times[[0, -1]].tolist() == [40_000, 960_000]
    np.testing.assert_array_equal(found.frames, recording.frames[2:-3])
    note, = found.notes
    assert note.code == "frames.unrolled"
    assert "from the top to the bottom in 50 ms" in note.text
    assert "5 frames at the ends were left out" in note.text


def test_frames_of_one_time_and_no_events_stay_as_they_are() -> None:
    recording = random_recording()
    assert unrolled(recording, Rolling(0.0, "left")) is recording
    silent = dataclasses.replace(recording, events=recording.events.slice(-2, -1))
    assert unrolled(silent, Rolling(0.02, "top")) is silent


def test_delays_are_those_of_the_middle_frame_time() -> None:
    np.testing.assert_array_equal(
        delays_us(Rolling(0.01, "right"), (4, 9)), [3750, 1250, -1250, -3750])
    assert delays_us(Rolling(0.01, "top"), (4, 9)).sum() == 0


@pytest.mark.parametrize("rolling", [
    Rolling(-0.01, "top"), Rolling(float("nan"), "top"),
    Rolling(0.01, "above"), Rolling(1.5, "top")])  # type: ignore[arg-type]
def test_impossible_ones_are_refused(rolling: Rolling) -> None:
    with pytest.raises(EvflowDataError, match="EV020"):
        unrolled(random_recording(), rolling)
