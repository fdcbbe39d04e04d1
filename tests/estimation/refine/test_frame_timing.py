"""When frames were exposed and for how long, from what they show of the events."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers.films import FRAME_S, INTERVALS, integrated, view

from evflow import CameraEstimator, Recording, estimate_camera, read_recording
from evflow.camera.optics import read_sensor
from evflow.estimation import front_end
from evflow.estimation.clock import aligned, rolling
from evflow.estimation.dead_time import DeadTime
from evflow.estimation.refine import between_events, busy
from evflow.estimation.refine import frame_timing as frame_timing_module
from evflow.estimation.refine.frame_exposure import (
    ON_TIME,
    UNSEEN,
    Exposure,
    is_untold,
    with_exposure,
    with_exposures,
)
from evflow.estimation.refine.frame_timing import UNTIMED, frame_timing
from evflow.estimation.refine.path import STEPS
from evflow.estimation.refine.stretches import cut
from evflow.notes import Note
from evflow.recordings import adjust
from evflow.recordings.rolling import GLOBAL, Side, unrolled
from evflow.recordings.windows import plan_windows
from evflow.types import Events

STEP_US = 1e6 * FRAME_S / STEPS
RUN = tuple(range(INTERVALS - 2))


@functools.cache
def blurred(
    steps: int, theta: float = 0.1, offset_dn: float = 0.0, tau_s: float = 0.0,
    every: int = STEPS,
) -> Recording:
    """A texture that swings past, a frame `every` so many steps, exposed for some, before pixels of
    this time constant: one instant and event at a time. Without the film's first and last frame,
    whose exposure is not in it."""
    dn = view(2)
    light = np.cumsum(np.concatenate([np.zeros((1, *dn.shape[1:])), 0.5 * (dn[1:] + dn[:-1])]), 0)
    middle = np.arange(STEPS, INTERVALS * STEPS, every)
    half = steps // 2
    frames = dn[middle] if not half else (light[middle + half] - light[middle - half]) / (2 * half)
    path = integrated(dn + offset_dn, FRAME_S / STEPS, 0.0, tau_s, 8, by_light=False)
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


@pytest.fixture(autouse=True)
def few_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    """A part of them suffices here."""
    monkeypatch.setattr(busy, "MOST", 1500)


def moved(recording: Recording, ms: float) -> Recording:
    """With other frame times."""
    times = recording.frame_times + round(1e3 * ms)
    return dataclasses.replace(recording, frame_times=times)


@pytest.mark.parametrize(("steps", "offset_dn"), [(0, 20.0), (14, 0.0), (14, 20.0), (16, 0.0)])
@pytest.mark.parametrize("theta", [0.1, 0.2])
def test_the_length_that_explains_the_frames_is_theirs(
    steps: int, offset_dn: float, theta: float
) -> None:
    """Of 0, 17.5 and 20 ms, at 20 ms between frames; also where pixels see other light."""
    found, late = frame_timing([(blurred(steps, theta, offset_dn), RUN)])[:2]
    assert late == ON_TIME
    if steps:
        assert found.seconds == pytest.approx(1e-6 * steps * STEP_US, abs=1e-3)
        assert 2e-3 < found.std_s < 4e-3
    else:
        assert found.seconds == 0


@pytest.mark.parametrize("steps", [0, 14])
@pytest.mark.parametrize("late_ms", [-12.0, -3.0, 5.0, 12.0])
def test_wrong_frame_times_show(steps: int, late_ms: float) -> None:
    """Events that come after the frames, and before; whatever the exposure, told or not."""
    recording = moved(blurred(steps), -late_ms)
    for told in (0.0, 1.25 * steps):
        found = frame_timing([(dataclasses.replace(recording, exposure_us=round(1e3 * told)), RUN)])
        assert 1e3 * found.late.seconds == pytest.approx(late_ms, abs=0.4)
        assert 7e-4 <= found.late.std_s < 1.5e-3
        alike_ms = np.sqrt(told**2 + 12 * late_ms**2) if late_ms > 0 and not (told or steps) else 99
        assert bool(found.late.exposed_s) == (alike_ms < 20)  # the interval between frames
        assert bool(found.exposure.seconds) == (steps > 0 and not told)


@pytest.mark.parametrize("tau_s", [3e-3, 6e-3])
def test_slow_pixels_are_not_late(tau_s: float) -> None:
    """They blur the events as much as they delay them; wrong times are what is left."""
    recording = blurred(0, tau_s=tau_s)
    found = frame_timing([(recording, RUN)])
    assert found[:2] == UNTIMED[:2]
    assert found.left_s == pytest.approx(0.0, abs=2e-3)
    for ms in (-12.0, 6.0) if tau_s < 5e-3 else (-12.0,):
        late = frame_timing([(moved(recording, -ms), RUN)]).late
        assert abs(1e-3 * ms - late.seconds) < 2 * late.std_s


def test_slow_pixels_before_frames_that_are_exposed_are_told_beside_the_delay() -> None:
    """To second order, both are the same as wrong frame times."""
    late = frame_timing([(blurred(16, tau_s=5e-3), RUN)]).late
    assert late.seconds == pytest.approx(5e-3, abs=1e-3)
    assert late.exposed_s == pytest.approx(20e-3, abs=3e-3)


@pytest.mark.parametrize("ms", [19.0, 30.0, -60.0])
def test_a_delay_beyond_the_search_says_nothing(ms: float) -> None:
    """Of frames on another clock."""
    assert frame_timing([(moved(blurred(0), ms), RUN)]) == UNTIMED


def test_frames_that_come_fast_tell_their_clock_too() -> None:
    """At 10 ms from frame to frame, without an exposure."""
    recording = moved(blurred(0, theta=0.05, every=STEPS // 2), 3.0)
    found = frame_timing([(recording, RUN)])
    assert found.late.seconds == pytest.approx(-3e-3, abs=4e-4)
    assert found.exposure == UNSEEN


def test_the_times_of_frames_are_aligned() -> None:
    recording = blurred(0)
    assert aligned(recording) is recording
    for ms in (-35.0, -8.0, 5.0):
        found = aligned(moved(recording, -ms))
        assert found.frame_times[0] - recording.frame_times[0] == pytest.approx(0.0, abs=400.0)
        assert [note.code for note in found.notes] == ["frames.moved"]


@pytest.mark.parametrize("ms", [-45.0, 38.0])
def test_the_times_of_frames_before_slow_pixels_are_aligned(ms: float) -> None:
    """Not by what the pixels are late."""
    recording = blurred(0, tau_s=5e-3)
    found = aligned(moved(recording, ms))
    assert found.frame_times[0] - recording.frame_times[0] == pytest.approx(0.0, abs=2000.0)


def test_frames_are_aligned_as_an_estimate_uses_them() -> None:
    """Those that come faster are left out, as are repeated ones; all are shifted."""
    dense = blurred(0, theta=0.05, every=STEPS // 4)
    found = aligned(moved(dense, -5.0))
    assert len(found.frames) == len(dense.frames)
    np.testing.assert_allclose(found.frame_times, dense.frame_times, atol=400)


def test_times_that_are_wrong_by_nearly_half_an_interval_are_aligned() -> None:
    recording = blurred(0, every=2 * STEPS)
    found = aligned(moved(recording, 17.0))
    np.testing.assert_allclose(found.frame_times, recording.frame_times, atol=600)


def rolled(steps: int, first: Side, tau_s: float = 0.0) -> Recording:
    """`blurred(0)`, with frames that are read in so many steps."""
    recording, dn = blurred(0, tau_s=tau_s), view(2)
    axis, sign = {"top": (1, 1), "bottom": (1, -1), "left": (2, 1), "right": (2, -1)}[first]
    dn = np.moveaxis(dn, axis, 1)
    late = np.round(np.linspace(-0.5, 0.5, dn.shape[1]) * sign * steps).astype(int)
    middle = np.round(recording.frame_times / STEP_US).astype(int)
    frames = np.stack([dn[k + late, np.arange(len(late))] for k in middle])
    return dataclasses.replace(
        recording, frames=np.rint(np.moveaxis(frames, 1, axis)).astype(np.uint8))


@pytest.mark.parametrize(("steps", "first"), [
    (8, "top"), (16, "bottom"), (8, "right"), (12, "left")])
@pytest.mark.parametrize("tau_s", [0.0, 4e-3])
def test_frames_that_are_read_row_by_row_show(steps: int, first: Side, tau_s: float) -> None:
    """In 10 to 20 ms; and are not taken for exposed ones, or late."""
    found = frame_timing([(rolled(steps, first, tau_s), RUN)])
    assert found.rolling == (pytest.approx(1e-6 * steps * STEP_US, rel=0.12), first)
    assert found[:2] == UNTIMED[:2]


@pytest.mark.parametrize("first", ["top", "right"])
def test_what_the_events_tell_of_it_can_be_undone(first: Side) -> None:
    recording = rolled(12, first)
    found = rolling(recording)
    assert frame_timing([(unrolled(recording, found), RUN[2:-2])]).rolling == GLOBAL
    assert rolling(unrolled(recording, found)) == GLOBAL == rolling(blurred(0))


def test_what_slow_pixels_explain_from_row_to_row_is_not_rolling() -> None:
    """Products of which least squares leave (delay - that of the row)^2."""
    at, rows = 2e3 * np.arange(-2.0, 3.0), np.arange(6)
    slow = np.array([0.7, 0.7, 0.8, 1.0, 1.3, 1.5])

    def sloping(delays: np.ndarray) -> float:
        products = np.tile(np.eye(3), (5, 6, 1, 1))
        products[..., 0, 2] = products[..., 2, 0] = np.sqrt(1e8 - (at[:, None] - delays) ** 2)
        return frame_timing_module._sloping(at, products, rows, slow)

    assert sloping(2000.0 * slow) == pytest.approx(0.0, abs=30.0)
    assert sloping(2000.0 + 0.0 * slow) == pytest.approx(0.0, abs=30.0)
    assert sloping(1000.0 * slow + 500.0 * rows) == pytest.approx(3000.0, abs=60.0)
    assert sloping(500.0 * rows - 1200.0) == pytest.approx(3000.0, abs=60.0)


def test_a_single_place_says_nothing() -> None:
    """The scatter over tiles is the test of a gain."""
    recording = blurred(14)
    events = recording.events
    corner = (events.x < 8) & (events.y < 8)
    one = dataclasses.replace(recording, events=Events(
        *(getattr(events, name)[corner] for name in "xytp"), events.size))
    assert frame_timing([(one, RUN)]) == UNTIMED
    assert frame_timing([(one, RUN)] * 4) != UNTIMED  # as if of four tiles


def test_events_that_are_left_out_have_no_part(monkeypatch: pytest.MonkeyPatch) -> None:
    place = blurred(14, theta=0.15), RUN
    found, used = frame_timing([place]), []
    near = between_events._near
    monkeypatch.setattr(between_events, "_near", lambda *a: (
        used.append(len(near(*a)) / len(a[-2])), np.arange(len(a[-2])))[1])
    assert frame_timing([place]) == found != UNTIMED
    assert used[0] < 0.9


def test_residuals_are_compared_with_what_neighbours_show_alone() -> None:
    """A pixel's own counts share the rounding of its residuals. Here no neighbour fires."""
    recording = blurred(0)
    events = recording.events
    apart = (events.x % 3 == 1) & (events.y % 3 == 1)
    lonely = dataclasses.replace(recording, events=Events(
        *(getattr(events, name)[apart] for name in "xytp"), events.size))
    run = busy.busy(lonely, RUN, frame_timing_module.REACH_US, np.random.default_rng(0))
    products = frame_timing_module._products([run], [(500.0, 0.0)], 0.0, 0.0)
    assert len(run.block) > 100
    assert (products[..., :4, :] == 0).all()
    assert (products[..., 4:, 4:].sum((0, 1, 2)) != 0).all()


def test_every_event_twice_can_be_solved() -> None:
    """As ON and as OFF: thresholds cannot be told, nor an exposure."""
    recording = blurred(14)
    events = recording.events
    twice = Events(*(np.repeat(getattr(events, name), 2) for name in "xyt"),
                   np.tile([True, False], len(events)), events.size)
    assert frame_timing([(dataclasses.replace(recording, events=twice), RUN)]) == UNTIMED


def test_where_little_happens_between_frames_it_stays_unknown() -> None:
    for theta in (1.2, 1.5):  # too few changes, and none
        assert frame_timing([(blurred(14, theta=theta), RUN)]) == UNTIMED


def test_one_polarity_alone_and_frames_that_stay_say_nothing() -> None:
    recording = blurred(14)
    events, on = recording.events, recording.events.p
    rising = dataclasses.replace(recording, events=Events(
        events.x[on], events.y[on], events.t[on], on[on], events.size))
    still = dataclasses.replace(recording, frames=np.full_like(recording.frames, 90))
    for one in (rising, still):
        assert frame_timing([(one, RUN)]) == UNTIMED


def test_what_is_told_is_not_measured() -> None:
    recording = blurred(14)
    left = adjust.exposed(recording, 0.0)
    made = dataclasses.replace(recording, notes=(Note("frames.made", "by a network"),))
    assert is_untold(recording)
    for told in (dataclasses.replace(recording, exposure_us=5000), left, made):
        assert not is_untold(told)
        assert frame_timing([(told, RUN)])[:2] == UNTIMED[:2]
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
    recording = blurred(14, theta=0.15)
    found = estimate_camera(recording)
    assert found.optics.exposure_s == pytest.approx(0.0175, abs=2.5e-3)
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


def test_what_cannot_be_trusted_of_rolling_frames_is_in_the_errors() -> None:
    recording = rolled(16, "top")
    (as_it_is, std), (undone, certain) = (
        (found.summary, found.summary_std) for found in map(
            estimate_camera, (recording, unrolled(recording, rolling(recording)))))
    assert abs(undone.theta_on - 0.1) < 2 * certain.theta_on < 0.02 < 2 * std.theta_on
    assert abs(as_it_is.theta_on - 0.1) < 2 * std.theta_on


def test_events_that_wait_are_not_taken_for_a_blur(monkeypatch: pytest.MonkeyPatch) -> None:
    recording = blurred(14)
    stretches = cut(recording, plan_windows(recording))
    assert front_end.find_timing(stretches, measured=True).exposure.seconds > 0.01
    monkeypatch.setattr(front_end, "dead_time", lambda _: DeadTime(5e-3, 1e-4))
    assert front_end.find_timing(stretches, measured=True) == UNTIMED


def test_of_a_real_camera_it_is_what_its_file_says(data_file: Callable[[str], Path]) -> None:
    """A DAVIS346 before a Newton's cradle, exposed for 20 ms."""
    pytest.importorskip("aedat")
    cradle = read_recording(data_file("data/recordings/newton_cradle_davis346.aedat4"))
    assert cradle.exposure_us == 20_000
    untold = dataclasses.replace(cradle, exposure_us=0)
    runs = [s.run for s in cut(untold, plan_windows(untold))]
    found, late = frame_timing([(untold, run) for run in runs])[:2]
    assert abs(found.seconds - 0.02) < 2 * found.std_s
    assert late == ON_TIME
