"""A camera measured piece by piece."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest
from helpers.networks import hidden

from evflow import CameraEstimate, CameraEstimator, Recording, estimate_camera
from evflow.errors import EvflowDataError
from evflow.estimation import estimator as estimator_module
from evflow.estimation.extent import covered_s
from evflow.estimation.front_end import FrontEnd
from evflow.estimation.refine import stretches as cutting
from evflow.estimation.refine.frame_exposure import UNSEEN, Exposure
from evflow.estimation.refine.frame_timing import Timing
from evflow.estimation.state import State, thinned
from evflow.types import Events

NAMES = ("theta_on", "theta_off")


def piece(recording: Recording, first: int, last: int) -> Recording:
    """Frames first to last and the events between."""
    times = recording.frame_times[first:last + 1]
    return Recording(recording.events.slice(int(times[0]), int(times[-1]) + 1),
                     recording.frames[first:last + 1], times)


def test_one_piece_is_the_whole_to_the_byte_and_pieces_come_near() -> None:
    recording, _ = hidden(3)
    whole = estimate_camera(recording)
    estimator = CameraEstimator()
    assert estimator.add(recording) == whole.windows == 6
    again = estimator.estimate()
    for a, b in zip(jax.tree.leaves((whole.camera, whole.std, whole.summary, whole.summary_std)),
                    jax.tree.leaves((again.camera, again.std, again.summary, again.summary_std)),
                    strict=True):
        np.testing.assert_array_equal(a, b)
    assert whole.extent.whole
    assert whole.extent.read_s == pytest.approx(0.24)


def test_of_dense_frames_pieces_use_every_nth(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[int] = []
    plan = estimator_module.plan_windows
    monkeypatch.setattr(estimator_module, "plan_windows", lambda piece, us: (
        seen.append(len(piece.frame_times)), plan(piece, us))[1])
    recording, _ = hidden(3)
    times = recording.frame_times[0] + 2000 * np.arange(101)
    frames = np.repeat(recording.frames, 21, 0)[:101] + np.arange(101)[:, None, None] % 2
    whole = dataclasses.replace(recording, frames=frames.astype(np.uint8), frame_times=times)
    estimator = CameraEstimator()
    for first in (0, 50):
        estimator.add(piece(whole, first, first + 50))
    assert seen == [11, 11]
    assert [n.code for n in estimator._notes].count("frames.dense") == 1


def test_pieces_have_one_white() -> None:
    """A dark piece of a 12-bit camera does not show its white; a brighter one after it is refused,
    as what was read before would be too bright."""
    recording, _ = hidden(3)
    deep = dataclasses.replace(recording, frames=recording.frames.astype(np.uint16) * 16)
    dark = dataclasses.replace(deep, frames=deep.frames // 8, full_scale=0)
    assert (deep.full_scale, dark.full_scale) == (4095, 1023)
    estimator = CameraEstimator()
    estimator.add(deep)
    estimator.add(dark)
    assert estimator._busiest[-1].recording.full_scale == 4095
    other = CameraEstimator()
    other.add(dark)
    with pytest.raises(EvflowDataError, match=r"full_scale=4095"):
        other.add(deep)
    other.add(dataclasses.replace(dark, full_scale=1023))


def test_windows_left_out_are_told_by_the_recording_s_frames() -> None:
    recording, _ = hidden(3)
    frames = recording.frames.copy()
    frames[5] = 255 - frames[5]  # a glitch
    estimator = CameraEstimator()
    for first in (0, 3):
        estimator.add(piece(dataclasses.replace(recording, frames=frames), first, first + 3))
    told = [n.text for n in estimator._notes if n.code == "windows.skipped"]
    assert told
    assert "frames 4-5" in told[0]


def test_a_repeated_last_frame_does_not_begin_the_next_piece() -> None:
    """Its time is not that of its content: with it, a threshold was a fifth too high here."""
    recording, camera = hidden(1, 1000)
    frames = recording.frames.copy()
    frames[3::3] = frames[2:-1:3]
    held = dataclasses.replace(recording, frames=frames)
    estimator = CameraEstimator()
    for first in range(0, len(frames) - 6, 6):  # every piece ends with a repeat
        estimator.add(piece(held, first, first + 6))
    summary = estimator.estimate().summary
    for name in NAMES:
        truth = float(np.median(getattr(camera, name)))
        assert float(getattr(summary, name)) == pytest.approx(truth, rel=0.06)
    two = CameraEstimator()
    two.add(piece(held, 0, 3))
    assert two.add(piece(held, 3, 4)) == 0


def test_what_was_read_is_no_longer_than_the_recording(monkeypatch: pytest.MonkeyPatch) -> None:
    """Windows of three intervals in stretches of two: each ends in the next stretch."""
    recording, _ = hidden(3)
    monkeypatch.setattr(cutting, "INTERVALS", 2)
    part = estimate_camera(recording, min_window_us=120_000, until=lambda *_: True)
    assert (part.extent.stretches, part.extent.of) == (1, 3)
    assert (part.extent.read_s, part.extent.seconds) == pytest.approx((0.12, 0.24))
    assert "0.1 of 0.2 s were read" in part.extent.notes()[0].text
    estimator = CameraEstimator(min_window_us=120_000)
    assert estimator.add(recording) == 2
    whole = estimator.estimate().extent
    assert whole.whole
    assert (whole.read_s, whole.seconds) == pytest.approx((0.24, 0.24))


def test_spans_are_counted_once() -> None:
    assert covered_s([]) == 0.0
    assert covered_s([(0, 4_000_000), (1_000_000, 2_000_000)]) == 4.0
    assert covered_s([(7_000_000, 9_000_000), (0, 2_000_000), (1_000_000, 3_000_000)]) == 5.0


def test_what_cannot_be_added_leaves_what_was() -> None:
    recording, _ = hidden(3)
    estimator = CameraEstimator(refine="off")
    with pytest.raises(EvflowDataError, match="EV017"):
        estimator.estimate()
    assert estimator.add(piece(recording, 0, 3)) == 3
    silent = dataclasses.replace(
        recording, events=Events(*(np.zeros(0, int),) * 4, recording.events.size))
    assert estimator.add(silent) == 0  # the camera stopped
    bare = Recording.of_events(recording.events)
    small = Events(*(np.zeros(1, int),) * 4, (16, 16))
    other = Recording(small, np.zeros((2, 16, 16), np.uint8), np.array([0, 40_000]))
    for code, wrong in (("EV011", bare), ("EV015", other), ("EV020", recording.events)):
        with pytest.raises(EvflowDataError, match=code):
            estimator.add(wrong)
    before = estimator.estimate()
    assert before.windows == 3
    assert estimator.add(piece(recording, 3, 6)) == 3
    found = estimator.estimate()
    assert found.windows == 6
    assert found.summary_std.eta_on < before.summary_std.eta_on  # it shrinks as it reads
    assert found.n_events.sum() > before.n_events.sum()


def numbers(found: CameraEstimate) -> list[np.ndarray]:
    return [np.asarray(leaf) for leaf in jax.tree.leaves(
        (found.camera, found.std, found.summary, found.summary_std))]


def test_an_early_question_changes_no_later_answer() -> None:
    recording, _ = hidden(3)
    found = []
    for ask in (False, True):
        estimator = CameraEstimator()
        for first in (0, 2, 4):
            estimator.add(piece(recording, first, first + 2))
            if ask:
                estimator.estimate()
        found.append(estimator.estimate())
    for a, b in zip(*map(numbers, found), strict=True):
        np.testing.assert_array_equal(a, b)


def sparse(recording: Recording, share: float) -> Recording:
    """The recording with a part of its events."""
    e, kept = recording.events, np.random.default_rng(0).random(len(recording.events)) < share
    return dataclasses.replace(
        recording, events=Events(e.x[kept], e.y[kept], e.t[kept], e.p[kept], e.size))


def test_an_exposure_that_is_seen_later_is_that_of_all_that_is_kept(
    monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where it changes: what was measured before is not told."""
    recording, _ = hidden(3)
    seen = iter([UNSEEN, Exposure(0.012, 0.002), Exposure(0.015, 0.002), UNSEEN])
    exposures: list[set[int]] = []
    monkeypatch.setattr(estimator_module, "find_timing", lambda _, measured: Timing(next(seen)))
    monkeypatch.setattr(estimator_module, "find_front_end", lambda on, timing, **_: (
        exposures.append({s.recording.exposure_us for s in on}), FrontEnd(timing=timing))[1])
    monkeypatch.setattr(estimator_module, "agree", lambda *_: False)
    monkeypatch.setattr(CameraEstimator, "FIRST", 1)
    monkeypatch.setattr(CameraEstimator, "AGAIN", 0.0)
    estimator = CameraEstimator(refine="off")
    for first in range(4):
        estimator.add(piece(recording, first, first + 1))
        state = estimator._state
        assert state is not None
        assert {s.recording.exposure_us for s in state.read} == exposures[-1]
    assert exposures == [{0}, {12_000}, {15_000}, {15_000}]
    assert estimator.estimate().optics.exposure_s == 0.015


@pytest.mark.parametrize("same", [False, True])
def test_a_camera_at_rest_at_first_is_measured_again_when_it_moves(
    same: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording, _ = hidden(3)
    measured: list[int] = []
    find = estimator_module.find_front_end
    monkeypatch.setattr(estimator_module, "find_front_end", lambda on, *a, **k: (
        measured.append(sum(map(estimator_module._events, on))), find(on, *a, **k))[1])
    monkeypatch.setattr(estimator_module, "agree", lambda *_: same)
    monkeypatch.setattr(CameraEstimator, "FIRST", 2)
    monkeypatch.setattr(CameraEstimator, "KEPT", 2)
    estimator = CameraEstimator(refine="off")
    for first in (0, 1):
        estimator.add(sparse(piece(recording, first, first + 1), 0.2))
    for first in (2, 3):
        estimator.add(sparse(piece(recording, first, first + 1), 0.3))
    assert len(measured) == 1
    assert estimator.estimate().extent.whole
    for first in (4, 5):
        estimator.add(piece(recording, first, first + 1))
    assert len(measured) == 2
    assert measured[1] >= 2 * measured[0]
    found = estimator.estimate()
    if same:
        assert found.extent.whole
        return
    assert found.extent.stretches < found.extent.of == 6
    assert found.extent.read_s == pytest.approx(0.04 * found.extent.stretches)
    assert [n.code for n in found.extent.notes()] == ["reading.again"]


def test_pieces_with_as_few_events_as_the_first_are_not_measured_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    recording, _ = hidden(3)
    monkeypatch.setattr(CameraEstimator, "FIRST", 1)
    monkeypatch.setattr(estimator_module, "_events", lambda _: 0)
    estimator = CameraEstimator(refine="off")
    estimator.add(piece(recording, 0, 1))
    monkeypatch.setattr(estimator, "_again", None)
    assert estimator.add(piece(recording, 1, 2)) == 1


def test_what_is_kept_does_not_grow() -> None:
    state = State({}, FrontEnd(), chunks=tuple(range(8)), read=tuple(range(32)))
    less = thinned(state, 8, 32)
    assert less.chunks == (0, 2, 4, 6)
    assert less.read == tuple(range(0, 32, 2))
    assert thinned(state, 9, 33).chunks == state.chunks


def test_a_refused_piece_leaves_no_trace() -> None:
    """A piece on another clock, darker than the ones to come, that ends with a repeated frame."""
    recording, _ = hidden(3)
    deep = dataclasses.replace(recording, frames=recording.frames.astype(np.uint16) * 16)
    frames = deep.frames // 8
    frames[-1] = frames[-2]
    elsewhere = dataclasses.replace(
        deep, frames=frames, full_scale=0, frame_times=deep.frame_times + 10**12)
    whole, estimator = CameraEstimator(), CameraEstimator()
    with pytest.raises(EvflowDataError, match="EV012"):
        estimator.add(elsewhere)
    assert estimator.add(deep) == whole.add(deep)
    for a, b in zip(*(numbers(e.estimate()) for e in (whole, estimator)), strict=True):
        np.testing.assert_array_equal(a, b)
