"""Frames that are a raw colour mosaic: told, and scaled to one brightness."""

from __future__ import annotations

import numpy as np
import pytest

from evflow import Events, Recording
from evflow.recordings.adjust import balanced
from evflow.recordings.check import check
from evflow.recordings.mosaics import mosaic_planes, planes

SHAPE = (40, 60)
GAINS = np.array([[0.6, 1.0], [1.0, 0.45]])


def recorded(gains: np.ndarray, seed: int = 0) -> Recording:
    """A grey scene seen through filters of these gains, which repeat over the sensor."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:SHAPE[0], :SHAPE[1]]
    frames = [110 + 60 * np.sin((x + 3 * k) / 5) * np.cos(y / 7) + rng.normal(0, 2, SHAPE)
              for k in range(6)]
    seen = np.round(np.stack(frames) * np.tile(gains, (SHAPE[0] // 2, SHAPE[1] // 2)))
    t = np.sort(rng.integers(0, 200_000, 2000))
    events = Events(rng.integers(0, SHAPE[1], 2000), rng.integers(0, SHAPE[0], 2000), t,
                    rng.random(2000) < 0.5, SHAPE[::-1])
    return Recording(events, seen.astype(np.uint8), 40_000 * np.arange(6))


def warned(recording: Recording) -> bool:
    return any(f.code == "EV032" and "raw colour mosaic" in f.seen for f in check(
        recording).warnings)


def test_a_raw_mosaic_is_told_and_can_be_balanced() -> None:
    recording = recorded(GAINS)
    assert warned(recording)
    even = balanced(recording)
    np.testing.assert_allclose(planes(even), planes(recording).max(), rtol=0.02)
    assert not warned(even)
    assert [note.code for note in even.notes] == ["frames.balanced"]
    grey = recorded(np.ones((2, 2)))
    np.testing.assert_allclose(even.frames, grey.frames, rtol=0.03, atol=3)
    # A scale that stays the same changes no contrast.
    before, after = (np.log(r.frames[1] / r.frames[0]) for r in (recording, even))
    np.testing.assert_allclose(after, before, atol=1e-5)


@pytest.mark.parametrize("gains", [np.ones((2, 2)), np.array([[1.0, 0.8], [1.0, 0.8]])],
                         ids=["grey", "columns"])
def test_other_frames_are_no_mosaic(gains: np.ndarray) -> None:
    """Unlike columns are those of a readout."""
    assert mosaic_planes(recorded(gains)) is None
    assert not warned(recorded(gains))


def test_even_frames_stay_as_they_are() -> None:
    recording = recorded(np.ones((2, 2)))
    assert balanced(recording) is recording
