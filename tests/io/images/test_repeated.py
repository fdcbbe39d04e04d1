"""Frames that converters between frame rates show again: counted, left out, the others at the
times at which they were filmed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.videos import drifting

from evflow.io.images.cadence import evened
from evflow.io.source import open_frames
from evflow.notes import Note

MOVING = drifting(100, (24, 32), 1.0).astype(np.uint8)
PULLDOWN = np.array([i * 4 // 5 for i in range(30)])  # 24 -> 30 frames/s: frame 0 0 1 2 3 4 4 5
STILL = np.concatenate([np.zeros(20, int), np.arange(10)])  # stands still, then moves
LOST = np.array([0, 1, 2, 2, 4, 5, 6, 7, 8, 8, 10, 11, 12, 12, 14, 15, 15, 17, 18, 19])
CUT = np.concatenate([PULLDOWN, np.arange(24, 40), np.arange(80, 30, -2)[PULLDOWN]])


def shown(tmp_path: Path, order: np.ndarray, noise: int = 0, **hints: Any) -> tuple[
        list[np.ndarray], list[int], list[Note]]:
    """(frames, their times, notes) of a stack of frames `order` of MOVING, 10 ms apart."""
    frames = MOVING[order]
    spots = np.random.default_rng(1).random(frames.shape) < 0.1 * noise
    np.save(tmp_path / "a.npy", np.where(spots & (frames < 255), frames + 1, frames).astype(
        np.uint8))
    source = open_frames(tmp_path / "a.npy", fps=100, **hints)
    frames, times = zip(*source.open(), strict=True)
    return list(frames), list(times), [n for n in source.notes if n.code == "frames.repeated"]


@pytest.mark.parametrize(("order", "repeats"), [
    (PULLDOWN, 6), (np.repeat(np.arange(8), 2), 8), (np.repeat(np.arange(8), 3), 16),
    (np.arange(24), 0), (STILL, 0), (STILL[::-1], 0), (np.zeros(9, int), 0), (LOST, 4),
    (np.array([0, 1, 2, 2, 3, 4, 5, 6, 6, 7]), 2), (np.repeat(np.arange(6), 5), 24),
    (np.repeat(np.arange(5), 10), 45), (np.repeat(np.arange(3), [20, 6, 9]), 0),
    (np.repeat([0, 30, 60], 10), 0), (np.tile([0, 1, 1], 20), 0), (np.tile([0, 0, 3, 3], 10), 0)])
@pytest.mark.parametrize("noise", [0, 1])
def test_repeated_frames_are_counted_and_dropped(
    tmp_path: Path, order: np.ndarray, repeats: int, noise: int
) -> None:
    """Also where a codec leaves a little of them; a scene that stands still is none of a
    converter's, nor are pages that turn or a light that blinks."""
    first = np.flatnonzero(np.diff(order, prepend=-1)) if repeats else np.arange(len(order))
    for hints in ({}, {"repeated": "drop"}):
        frames, times, notes = shown(tmp_path, order, noise, **hints)
        wanted = first if hints else np.arange(len(order))
        assert len(frames) == len(wanted)
        for frame, i in zip(frames, wanted.tolist(), strict=True):
            assert np.abs(frame.astype(int) - MOVING[order[i]]).max() <= noise
        assert len(notes) == (repeats > 0)
        assert all(f"{repeats} of {len(order)} frames" in note.text for note in notes)
        if not hints:
            assert times == [10_000 * i for i in range(len(order))]


def test_frames_closer_than_any_that_are_shown_have_no_cadence() -> None:
    """As where the times are those of a recording."""
    times = np.cumsum(np.append(0, np.tile([100, 66_000], 16)))
    assert evened(times, np.ones(32), 33_333.0) is None


@pytest.mark.parametrize(("show", "film"), [(30, 24), (60, 24), (30, 25), (60, 50), (30, 20),
                                            (60, 23.976), (25, 24)])
@pytest.mark.parametrize("late", [0.0, 0.5, 0.999])
def test_a_pulldown_is_undone(tmp_path: Path, show: int, film: float, late: float) -> None:
    """What moves evenly does so again, whatever the converter's rounding."""
    order = np.floor(np.arange(260) * film / show + late).astype(int)
    order = order[order < len(MOVING)]
    frames, times, (note,) = shown(tmp_path, order, repeated="drop")
    assert times[0] == 0
    steps = np.diff(times)
    np.testing.assert_allclose(steps, 10_000 * show / film, rtol=0.02)
    assert f"evenly spaced again, {1e6 / np.median(steps):.4g} frames/s" in note.text
    speed = np.abs(np.diff(np.array(frames, float), axis=0)).mean((1, 2)) / steps
    assert speed.std() < 0.1 * speed.mean()  # 0.2 with 24 to 30 frames/s as shown


@pytest.mark.parametrize("order", [LOST, np.repeat(np.arange(9), 3), np.sort(
    np.random.default_rng(5).choice(40, 40))])
def test_a_frame_that_came_late_leaves_a_gap(tmp_path: Path, order: np.ndarray) -> None:
    """Where a camera or a recorder had no new frame, the times of the others were right."""
    first = np.flatnonzero(np.diff(order, prepend=-1))
    _, times, (note,) = shown(tmp_path, order, repeated="drop")
    assert times == [10_000 * i for i in first.tolist()]
    assert "evenly" not in note.text


def test_a_cadence_may_break_and_be_another_later(tmp_path: Path) -> None:
    _, times, _ = shown(tmp_path, CUT, repeated="drop")
    steps = np.diff(times)
    np.testing.assert_allclose(steps[:22], 12_500, atol=1_000)
    np.testing.assert_allclose(np.median(steps[25:38]), 10_000, atol=100)
    np.testing.assert_allclose(steps[41:], 12_500, atol=1_000)
    shown_at = np.flatnonzero(np.diff(CUT, prepend=-1)) * 10_000
    assert np.abs(np.array(times) - shown_at).max() <= 11_200


def test_even_times_of_an_hour_are_found_at_once() -> None:
    late = np.ceil(np.arange(86_400) * 1.25) * (1e6 / 30)
    found = evened(np.rint(late / 1000).astype(np.int64) * 1000, np.ones(86_399), 1e6 / 30)
    assert found is not None
    assert np.abs(found - np.arange(86_400) * (1e6 / 24)).max() < 3_000
