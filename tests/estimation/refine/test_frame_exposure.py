"""The exposure of frames that nobody tells, from what it blurs."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers.films import FRAME_S, INTERVALS, integrated, view

from evflow import CameraEstimator, Recording, estimate_camera, read_recording
from evflow.camera.optics import read_sensor
from evflow.estimation import front_end
from evflow.estimation.dead_time import DeadTime
from evflow.estimation.refine import between_events
from evflow.estimation.refine import frame_exposure as frame_exposure_module
from evflow.estimation.refine.frame_exposure import (
    UNSEEN,
    Exposure,
    frame_exposure,
    is_untold,
    with_exposure,
    with_exposures,
)
from evflow.estimation.refine.path import STEPS
from evflow.estimation.refine.stretches import cut
from evflow.notes import Note
from evflow.recordings import adjust
from evflow.recordings.windows import plan_windows
from evflow.types import Events

STEP_US = 1e6 * FRAME_S / STEPS
RUN = tuple(range(INTERVALS - 2))


def blurred(steps: int, theta: float = 0.1, offset_dn: float = 0.0) -> Recording:
    """A texture that swings past, its frames exposed for so many steps: one instant and event at a
    time. Without the film's first and last frame, whose exposure is not in it."""
    dn = view(2)
    light = np.cumsum(np.concatenate([np.zeros((1, *dn.shape[1:])), 0.5 * (dn[1:] + dn[:-1])]), 0)
    middle = np.arange(1, INTERVALS) * STEPS
    half = steps // 2
    frames = dn[middle] if not half else (light[middle + half] - light[middle - half]) / (2 * half)
    path = integrated(dn + offset_dn, FRAME_S / STEPS, 0.0, 0.0, 8)
    memory, rows = path[0].copy(), []
    for i, now in enumerate(path):
        while (crossed := np.abs(now - memory) > theta).any():
            up = now > memory
            memory = memory + np.where(up, theta, -theta) * crossed
            y, x = np.nonzero(crossed)
            rows.append(np.stack([x, y, np.full(len(x), round(i * STEP_US / 8)), up[crossed]]))
    x, y, t, p = np.concatenate(rows, 1)
    return Recording(Events(x, y, t, p > 0, dn.shape[:0:-1]), np.rint(frames).astype(np.uint8),
                     np.round(middle * STEP_US).astype(np.int64))


@pytest.mark.parametrize(("steps", "offset_dn"), [(0, 20.0), (12, 0.0), (12, 20.0), (16, 0.0)])
@pytest.mark.parametrize("theta", [0.1, 0.2])
def test_the_length_that_explains_the_frames_is_theirs(
    steps: int, offset_dn: float, theta: float
) -> None:
    """Of 0, 15 and 20 ms, at 20 ms between frames; also where pixels see other light."""
    found = frame_exposure([(blurred(steps, theta, offset_dn), RUN)])
    if steps:
        assert found.seconds == pytest.approx(1e-6 * steps * STEP_US, abs=1e-3)
        assert 2e-3 < found.std_s < 4e-3
    else:
        assert found.seconds == 0


def test_a_delay_beyond_the_search_is_no_exposure() -> None:
    """Of frames on another clock, 12 ms late: an exposure of 17 ms seemed to explain them."""
    recording = blurred(0)
    late = dataclasses.replace(recording, frame_times=recording.frame_times + 12_000)
    assert frame_exposure([(late, RUN)]) == UNSEEN


def test_a_single_place_says_nothing() -> None:
    """The scatter over tiles is the test of a gain."""
    recording = blurred(12)
    events = recording.events
    corner = (events.x < 8) & (events.y < 8)
    one = dataclasses.replace(recording, events=Events(
        *(getattr(events, name)[corner] for name in "xytp"), events.size))
    assert frame_exposure([(one, RUN)]) == UNSEEN
    assert frame_exposure([(one, RUN)] * 4) != UNSEEN  # as if of four tiles


def test_events_that_are_left_out_have_no_part(monkeypatch: pytest.MonkeyPatch) -> None:
    place = blurred(12, theta=0.15), RUN
    monkeypatch.setattr(frame_exposure_module, "MOST", 1500)
    found, used = frame_exposure([place]), []
    near = between_events._near
    monkeypatch.setattr(between_events, "_near", lambda *a: (
        used.append(len(near(*a)) / len(a[-2])), np.arange(len(a[-2])))[1])
    assert frame_exposure([place]) == found != UNSEEN
    assert used[0] < 0.9


def test_every_event_twice_can_be_solved() -> None:
    """As ON and as OFF: thresholds cannot be told, nor an exposure."""
    recording = blurred(12)
    events = recording.events
    twice = Events(*(np.repeat(getattr(events, name), 2) for name in "xyt"),
                   np.tile([True, False], len(events)), events.size)
    assert frame_exposure([(dataclasses.replace(recording, events=twice), RUN)]) == UNSEEN


def test_where_little_happens_between_frames_it_stays_unknown() -> None:
    for theta in (0.8, 1.5):  # too few changes, and none
        assert frame_exposure([(blurred(12, theta=theta), RUN)]) == UNSEEN


def test_one_polarity_alone_and_frames_that_stay_say_nothing() -> None:
    recording = blurred(12)
    events, on = recording.events, recording.events.p
    rising = dataclasses.replace(recording, events=Events(
        events.x[on], events.y[on], events.t[on], on[on], events.size))
    still = dataclasses.replace(recording, frames=np.full_like(recording.frames, 90))
    for one in (rising, still):
        assert frame_exposure([(one, RUN)]).seconds == 0


def test_what_is_told_is_not_measured() -> None:
    recording = blurred(12)
    left = adjust.exposed(recording, 0.0)
    made = dataclasses.replace(recording, notes=(Note("frames.made", "by a network"),))
    assert is_untold(recording)
    for told in (dataclasses.replace(recording, exposure_us=5000), left, made):
        assert not is_untold(told)
        assert frame_exposure([(told, RUN)]) == UNSEEN
    assert is_untold(dataclasses.replace(left, notes=adjust.exposed(left, 5.0).notes))
    assert [note.code for note in left.notes] == ["frames.blur"]


def test_stretches_of_one_recording_still_share_it() -> None:
    recording = blurred(0)
    stretches = cut(recording, plan_windows(recording))
    longer = with_exposures((*stretches, *stretches), Exposure(0.012, 0.002))
    assert {s.recording.exposure_us for s in longer} == {12_000}
    assert len({id(s.recording) for s in longer}) == 1
    assert all(s.recording is recording for s in with_exposures(stretches, UNSEEN))
    assert with_exposure(recording, 0.0) is recording
    assert [s.recording.exposure_us for s in with_exposures(
        longer[:1], Exposure(0.015, 0.002), before=Exposure(0.012, 0.002))] == [15_000]
    for told in (adjust.exposed(recording, 5.0), adjust.exposed(recording, 0.0)):
        assert with_exposure(told, 0.012) is told


def test_an_estimate_takes_the_blur_out_and_says_so(tmp_path: Path) -> None:
    recording = blurred(12, theta=0.15)
    found = estimate_camera(recording)
    assert found.optics.exposure_s == pytest.approx(0.015, abs=2.5e-3)
    note, = (str(n) for n in found.notes if n.code == "frames.exposure")
    assert f"{1e3 * found.optics.exposure_s:.0f} ± " in note
    found.save(tmp_path / "camera.npz")
    assert read_sensor(tmp_path / "camera.npz")[1].exposure_s == found.optics.exposure_s
    told = dataclasses.replace(
        recording, exposure_us=round(1e6 * found.optics.exposure_s))
    assert estimate_camera(told).summary == found.summary
    estimator = CameraEstimator()
    estimator.add(recording)
    assert estimator.estimate().optics == found.optics
    ideal = estimate_camera(recording, pixel="ideal")
    assert ideal.optics.exposure_s == 0


def test_events_that_wait_are_not_taken_for_a_blur(monkeypatch: pytest.MonkeyPatch) -> None:
    recording = blurred(12)
    stretches = cut(recording, plan_windows(recording))
    assert front_end.find_exposure(stretches, measured=True).seconds > 0.01
    monkeypatch.setattr(front_end, "dead_time", lambda _: DeadTime(5e-3, 1e-4))
    assert front_end.find_exposure(stretches, measured=True) == UNSEEN


def test_of_a_real_camera_it_is_what_its_file_says(data_file: Callable[[str], Path]) -> None:
    """A DAVIS346 before a Newton's cradle, exposed for 20 ms."""
    pytest.importorskip("aedat")
    cradle = read_recording(data_file("data/recordings/newton_cradle_davis346.aedat4"))
    assert cradle.exposure_us == 20_000
    untold = dataclasses.replace(cradle, exposure_us=0)
    runs = [s.run for s in cut(untold, plan_windows(untold))]
    found = frame_exposure([(untold, run) for run in runs])
    assert abs(found.seconds - 0.02) < 2 * found.std_s
