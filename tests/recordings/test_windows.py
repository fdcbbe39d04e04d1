"""Windows between frames: which are chosen, which are left out and why."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evflow.errors import EvflowDataError
from evflow.io import read_recording
from evflow.notes import Note
from evflow.recordings import condensed, iter_windows, plan_windows
from evflow.recordings.windows import Skipped, WindowPlan, left_out
from evflow.types import Events, Recording


def recording(times_ms: list[float], first_ms: float = 0, last_ms: float = 400) -> Recording:
    """Frames at these times, frame i of brightness i; an event every 100 us."""
    t = np.arange(round(first_ms * 1000), round(last_ms * 1000) + 1, 100)
    events = Events(t % 5, t % 3, t, t % 200 == 0, (5, 3))
    frames = np.broadcast_to(np.arange(len(times_ms), dtype=np.uint8)[:, None, None],
                             (len(times_ms), 3, 5))
    return Recording(events, frames, np.round(np.array(times_ms) * 1000).astype(int))


def refused(call: Callable[[], Any]) -> EvflowDataError:
    with pytest.raises(EvflowDataError) as raised:
        call()
    return raised.value


@pytest.mark.parametrize(("step_ms", "min_us", "stride"), [
    (40, 40_000, 1), (39.9, 40_000, 2), (20, 40_000, 2), (50, 40_000, 1), (10, 35_000, 4)])
def test_windows_are_the_shortest_that_are_long_enough(
    step_ms: float, min_us: int, stride: int
) -> None:
    times = [step_ms * i for i in range(9)]
    plan = plan_windows(recording(times), min_us)
    assert plan.pairs == tuple((i, i + stride) for i in range(0, 9 - stride, stride))
    assert plan.skipped == ()


def test_a_window_holds_its_events_and_the_frames_at_its_edges() -> None:
    made = recording([0, 40, 80])
    windows = list(iter_windows(made))
    assert [w.index for w in windows] == [0, 1]
    assert [(w.t0_us, w.t1_us) for w in windows] == [(0, 40_000), (40_000, 80_000)]
    assert windows[1].window_s == 0.04
    assert (windows[1].frame0.max(), windows[1].frame1.min()) == (1, 2)
    assert windows[0].frame0.dtype == np.float32
    assert [len(w.events) for w in windows] == [400, 400]
    assert np.shares_memory(windows[0].events.t, made.events.t)


def test_frames_are_scaled_to_255() -> None:
    made = recording([0, 40])
    deep = Recording(made.events, np.full((2, 3, 5), 1023, np.uint16), made.frame_times)
    assert next(iter_windows(deep)).frame0.max() == pytest.approx(255)


def test_windows_outside_the_events_are_left_out() -> None:
    plan = plan_windows(recording([40 * i for i in range(10)], first_ms=100, last_ms=300))
    assert plan.pairs == ((3, 4), (4, 5), (5, 6), (6, 7))
    assert len(plan.skipped) == 5
    assert all("not covered" in window.why for window in plan.skipped)


@pytest.mark.parametrize(("first_ms", "kept"), [(4.9, True), (5.2, False)])
def test_events_may_begin_a_little_late(first_ms: float, kept: bool) -> None:
    plan = plan_windows(recording([0, 40, 80], first_ms=first_ms))
    assert ((0, 1) in plan.pairs) == kept


def test_no_window_crosses_a_dropped_frame() -> None:
    times = [0, 20, 40, 60, 180, 200, 220, 240, 260]
    plan = plan_windows(recording(times))
    assert plan.pairs == ((0, 2), (4, 6), (6, 8))
    assert plan.skipped == (Skipped(2, 4, "no frame for 120.0 ms (dropped?)"),)
    assert str(plan.skipped[0]) == "frames 2-4: no frame for 120.0 ms (dropped?)"


def test_no_window_crosses_a_gap_in_the_events() -> None:
    made = recording([0, 40, 80, 120, 160, 200, 240])
    t = made.events.t
    kept = (t < 90_000) | (t > 165_000)
    events = Events(*(a[kept] for a in (made.events.x, made.events.y, t, made.events.p)),
                    made.events.size)
    plan = plan_windows(Recording(events, made.frames, made.frame_times))
    assert plan.pairs == ((0, 1), (1, 2), (5, 6))
    assert condensed(plan.skipped) == (Note(
        "windows.skipped", "3 windows skipped (frames 2-3 to frames 4-5): no events for 75.2 ms "
        "(lost packets, or a static scene?)"),)
    assert [note.text for note in condensed(plan.skipped[:1])] == [
        f"frames 2-3 skipped: {plan.skipped[0].why}"]
    dropped = tuple(Skipped(i, i + 1, f"no frame for {ms:.1f} ms (dropped?)")
                    for i, ms in ((3, 80.0), (7, 40.0), (9, 120.0)))
    assert [note.text for note in condensed(dropped)] == [
        "3 windows skipped (frames 3-4 to frames 9-10): no frame for 40.0 to 120.0 ms (dropped?)"]


def test_a_long_window_begins_anew_right_behind_a_dropped_frame() -> None:
    plan = plan_windows(recording([0, 70, 90, 110, 130, 150, 170, 190]), 100_000)
    assert plan.pairs == ((1, 6),)
    assert len(plan.skipped) == 1


def test_hopeless_recordings_say_why() -> None:
    made = recording([0, 40])
    assert refused(lambda: plan_windows(Recording.of_events(made.events))).code == "EV011"
    assert refused(lambda: plan_windows(recording([0]))).code == "EV011"
    silent = Recording(Events([], [], [], [], (5, 3)), made.frames, made.frame_times)
    assert refused(lambda: plan_windows(silent)).code == "EV001"
    assert refused(lambda: plan_windows(made, 0)).code == "EV020"
    error = refused(lambda: plan_windows(recording([1000, 1040])))
    assert error.code == "EV012"
    assert "events cover 0..400,000 us but frames 1,000,000..1,040,000 us" in str(error)
    error = refused(lambda: iter_windows(recording([0, 20])))
    assert error.code == "EV017"
    assert "span less" in str(error)
    assert "not covered" in str(refused(lambda: iter_windows(recording([380, 450]))))


def test_real_windows(data_file: Callable[[str], Path]) -> None:
    pytest.importorskip("aedat")
    cradle = read_recording(data_file("data/recordings/newton_cradle_davis346.aedat4"))
    windows = list(iter_windows(cradle))
    assert len(windows) == 12
    assert {w.t1_us - w.t0_us for w in windows} == {40_000}
    inside = cradle.events.slice(int(cradle.frame_times[0]), int(cradle.frame_times[-1]))
    assert sum(len(w.events) for w in windows) == len(inside)
    slider = read_recording(data_file("data/recordings/ijrr_slider_depth"))
    plan = plan_windows(slider)  # 38.8 ms apart: two intervals each; frame 0 is 3.8 ms early
    assert plan.pairs == ((0, 2), (2, 4))


def filmed(frames: np.ndarray, share: float = 0.0) -> Recording:
    """Frames 40 ms apart; a share of the pixels has an event after every frame."""
    count, height, width = frames.shape
    y, x = np.nonzero(np.random.default_rng(0).random((height, width)) < share)
    t = np.repeat(np.arange(count - 1) * 40_000 + 10_000, len(x))
    ends = np.array([0, (count - 1) * 40_000])
    x, y = (np.concatenate([np.tile(a, count - 1), [0, 0]]) for a in (x, y))
    t = np.concatenate([t, ends])
    order = np.argsort(t, kind="stable")
    events = Events(x[order], y[order], t[order], np.ones(len(t), bool), (width, height))
    return Recording(events, frames.astype(np.uint8), np.arange(count) * 40_000)


def texture(count: int) -> np.ndarray:
    """A bright square that moves over a random picture, (count, 48, 64)."""
    still = np.random.default_rng(1).integers(40, 160, (48, 64))
    frames = np.repeat(still[None], count, 0)
    for i in range(count):
        frames[i, 10:30, 3 * i:3 * i + 20] = 200
    return frames


def test_a_moving_scene_has_no_faults() -> None:
    plan = plan_windows(filmed(texture(8)))
    assert len(plan.pairs) == 7
    assert plan.skipped == ()


@pytest.mark.parametrize("level", [0, 255])
def test_windows_at_a_black_or_white_frame_are_left_out(level: int) -> None:
    frames = texture(8)
    frames[3] = level
    plan = plan_windows(filmed(frames))
    assert plan.pairs == ((0, 1), (1, 2), (4, 5), (5, 6), (6, 7))
    assert len(plan.skipped) == 1
    assert "glitch" in plan.skipped[0].why


def test_exposure_changes_are_left_out_and_changes_of_light_are_not() -> None:
    frames = texture(6)
    frames[3:] = np.rint(frames[3:] * 1.2)
    plan = plan_windows(filmed(frames))
    assert plan.pairs == ((0, 1), (1, 2), (3, 4), (4, 5))
    assert "+20%" in plan.skipped[0].why
    assert "auto-exposure" in plan.skipped[0].why
    assert len(plan_windows(filmed(frames, share=0.8)).pairs) == 5


@pytest.mark.parametrize(("first", "last", "said"), [
    (0, 10, []), (0, 6, ["0.40 of 1.00 s of events come after the last frame"]),
    (3, 8, ["0.30 of 1.00 s of events come before the first frame",
            "0.20 of 1.00 s of events come after the last frame"])])
def test_events_without_frames_at_either_end_are_named(
    first: int, last: int, said: list[str]
) -> None:
    t = np.arange(0, 1_000_001, 10_000)
    zeros = np.zeros(len(t), int)
    times = 100_000 * np.arange(first, last + 1)
    recording = Recording(Events(zeros, zeros, t, zeros > 0, (4, 4)),
                          np.zeros((len(times), 4, 4), np.uint8), times)
    notes = left_out(recording, WindowPlan((), ()))
    assert [note.text.partition(" and are")[0] for note in notes] == said
