"""The part of a long recording that is read, its thirds, and its halves."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.networks import hidden, small_params

from evflow import Recording, estimate_camera
from evflow.estimation import drift, reading
from evflow.estimation.front_end import find_front_end
from evflow.estimation.halves import divided
from evflow.estimation.refine import chunk, cut, make_chunk, path
from evflow.estimation.refine import stretches as cutting
from evflow.estimation.refine.frame_exposure import UNSEEN
from evflow.estimation.state import State, read_stretch
from evflow.recordings.windows import plan_windows
from evflow.types import Events


def film(seconds: float, size: tuple[int, int] = (32, 24), hz: int = 25) -> Recording:
    """Events everywhere, most in the last of every five stretches."""
    rng, n = np.random.default_rng(0), round(seconds * 4000)
    t = np.sort(rng.integers(0, round(seconds * 1e6), n))
    busy = (t // 320_000) % 5 == 4
    t = t[busy | (rng.random(n) < 0.3)]
    x, y = (rng.integers(0, s, len(t)) for s in size)
    frames = np.arange(round(seconds * hz) + 1)
    moving = (100 + 50 * (frames % 2)).astype(np.uint8)
    return Recording(Events(x, y, t, rng.random(len(t)) < 0.5, size),
                     np.broadcast_to(moving[:, None, None], (len(frames), *size[::-1])),
                     frames * (1_000_000 // hz))


@pytest.fixture
def stretches() -> tuple:
    recording = film(16.0)
    pairs = tuple((i, i + 1) for i in range(400))
    return cut(recording, dataclasses.replace(plan_windows(film(1.0)), pairs=pairs, skipped=()))


def test_a_short_recording_is_read_whole_in_order(stretches: tuple) -> None:
    for effort in reading.EFFORTS:
        order = reading.ordered(stretches, effort)
        assert order.numbers == tuple(range(50))
        assert order.every == 1


@pytest.mark.parametrize(("effort", "number"), [("quick", 6), ("normal", 18), ("full", 50)])
def test_of_a_long_one_a_spread_and_lively_part(
    stretches: tuple, monkeypatch: pytest.MonkeyPatch, effort: reading.Effort, number: int
) -> None:
    monkeypatch.setattr(reading, "UNIT", 8 * 24 * 32)  # as if it were a DAVIS346
    monkeypatch.setattr(reading, "PART", (24, 32))
    order = reading.ordered(stretches, effort)
    assert len(order.numbers) == len(set(order.numbers)) == number
    assert order.simulated <= set(order.numbers)
    first = np.sort(order.numbers[:4])
    assert effort == "full" or first[0] < 15 < 30 < first[-1]  # any beginning is spread
    if effort == "quick":  # each of 8 stretches, in which one or two lively ones lie
        assert np.mean([i % 5 == 4 for i in order.numbers]) > 0.8


def test_a_large_sensor_goes_band_by_band_as_a_small_one_at_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    recording = film(0.2)
    whole = make_chunk(recording, range(2), steps=4)
    for module in (chunk, path):
        monkeypatch.setattr(module, "LARGE", 100)
        monkeypatch.setattr(module, "BAND", 200)
    parts = make_chunk(recording, range(2), steps=4)
    np.testing.assert_allclose(parts.path, whole.path, rtol=1e-6)
    for name in ("equations", "bounds", "start"):
        np.testing.assert_allclose(getattr(parts.evidence, name), getattr(whole.evidence, name),
                                   rtol=1e-4, atol=1e-5)
    np.testing.assert_array_equal(parts.quiet, whole.quiet)


def test_longer_and_larger_recordings_get_a_little_more(stretches: tuple) -> None:
    lengths = [8] * len(stretches)
    one = reading._affordable(stretches, lengths, "quick")
    recording = stretches[0].recording
    hours = dataclasses.replace(recording, frame_times=recording.frame_times * 100)
    slow = [dataclasses.replace(s, recording=hours) for s in stretches]
    assert reading._affordable(slow, lengths, "quick") == pytest.approx(2 * one, abs=1)


def test_the_gain_of_reading_more() -> None:
    def history(floor: float) -> list[tuple[int, float]]:
        return [(n, floor + 1.0 / n) for n in (4, 8, 16)]

    assert reading.gain(history(0.0)) == pytest.approx(1 - np.sqrt(0.5))
    assert reading.gain(history(100.0)) < 0.001
    assert np.isnan(reading.gain(history(0.0)[:1]))


def parts(theta: np.ndarray, scatter: float = 0.02) -> list[drift.Part]:
    """A stretch a second with thresholds theta (N, 2)."""
    noise = np.random.default_rng(1).normal(0, scatter, theta.shape)
    return [drift.Part(i * 1_000_000, t) for i, t in enumerate(theta * np.exp(noise))]


def test_a_camera_that_stays_the_same_has_three_like_thirds() -> None:
    found = drift.thirds(parts(np.full((18, 2), 0.2)))
    assert [t.stretches for t in found] == [6, 6, 6]
    assert drift.changed(found) == []
    assert drift.notes(found) == []
    assert found[1].theta_on == pytest.approx(0.2, abs=3 * found[1].std_on)
    assert drift.thirds(parts(np.full((8, 2), 0.2))) == ()


def test_a_threshold_that_changes_is_noted() -> None:
    theta = np.full((18, 2), 0.2)
    theta[12:, 1] *= 1.15
    found = drift.thirds(parts(theta))
    assert drift.changed(found) == ["off"]
    note, = drift.notes(found)
    assert note.code == "theta_off.drift"
    gradual = theta.copy()
    gradual[:, 0] *= np.linspace(1, 1.2, 18)
    assert "on" in drift.changed(drift.thirds(parts(gradual)))
    assert drift.changed(drift.thirds(parts(theta, scatter=0.2))) == []


def test_a_stretch_s_regression_is_that_of_its_pixels_together() -> None:
    on, off = np.random.default_rng(0).integers(1, 9, (2, 200)).astype(float)
    value = 0.3 * on - 0.2 * off
    sums = [on * on, on * -off, off * off, on * value, -off * value, value * value, 3 + 0 * on]
    told = drift.part((0, 10), SimpleNamespace(equations=np.stack(sums).reshape(7, 10, 20)))
    np.testing.assert_allclose(told.theta, [0.3, 0.2])
    few = SimpleNamespace(equations=np.stack(sums).reshape(7, 10, 20) * 0.1)
    assert np.isnan(drift.part((0, 10), few).theta).all()


@pytest.mark.parametrize(("runs", "first", "rest"), [
    (((0, 8), (8, 16), (16, 24)), range(0, 1), (8, 24)),  # of two that are as near, the earlier
    (((0, 8), (8, 12)), range(0, 1), (8, 12)),
    (((0, 8), (9, 17), (17, 25), (25, 29)), range(1, 2), (17, 29)),  # behind a gap there is more
    (((0, 8), (9, 17)), None, None),
    (((0, 8),), None, None),
    (((0, 0),), None, None),  # no path
])
def test_a_recording_is_divided_near_the_middle_of_its_longest_part(
    runs: tuple[tuple[int, int], ...], first: range | None, rest: tuple[int, int] | None
) -> None:
    found = divided([SimpleNamespace(run=tuple(range(*run))) for run in runs])
    assert (found and found.first, found and found.rest) == (first, rest)


@pytest.mark.parametrize(("change", "said", "windows"), [
    ("the events end", "windows.skipped", 3),
    ("the camera rests", None, 12),
])
def test_what_ends_in_the_middle_is_estimated_from_its_beginning(
    change: str, said: str | None, windows: int
) -> None:
    """Events that end before the frames do, and a camera that stops moving: nothing is lost."""
    recording, camera = hidden(3)
    events, frames, times = recording.events, recording.frames, recording.frame_times
    middle = int(times[3])
    if change == "the events end":
        recording = Recording(events.slice(int(events.t[0]), middle), frames, times)
    else:  # noise alone, and frames of which no two are equal
        rng = np.random.default_rng(0)
        still = np.clip(frames[-1] + rng.integers(-1, 2, (6, *frames.shape[1:])), 0, 255)
        t = np.sort(rng.integers(events.t[-1] + 1, events.t[-1] + 240_000, 600))
        y, x = (rng.integers(0, n, 600) for n in frames.shape[1:])
        recording = Recording(
            Events.concatenate([events, Events(x, y, t, rng.random(600) < 0.5, events.size)]),
            np.concatenate([frames, still.astype(frames.dtype)]),
            np.concatenate([times, times[-1] + 40_000 * np.arange(1, 7)]))
    found = estimate_camera(recording)
    assert found.windows == windows
    assert said is None or any(
        note.code == said and "not covered by the events" in note.text for note in found.notes)
    theta = float(np.median(camera.theta_on))
    assert abs(float(found.summary.theta_on) - theta) < 3 * float(found.summary_std.theta_on)


def test_until_ends_reading_and_nothing_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    recording, _ = hidden(3)
    monkeypatch.setattr(cutting, "INTERVALS", 2)
    told = []

    def enough(summary, std) -> bool:
        told.append(float(std.eta_on))
        return len(told) == 2

    found = estimate_camera(recording, refine="off", until=enough)
    assert len(told) == found.extent.stretches == 2
    assert found.extent.of == 3
    assert "reading.ended" in [note.code for note in found.notes]
    assert found.windows == 4


def test_reading_may_end_before_a_stretch_that_is_simulated(
    monkeypatch: pytest.MonkeyPatch
) -> None:
    """One of three stretches is simulated, the middle one; the estimate ends after the first."""
    recording, camera = hidden(3)
    monkeypatch.setattr(cutting, "INTERVALS", 2)
    monkeypatch.setattr(reading, "most_simulated", lambda _: 1)
    found = estimate_camera(recording, pixel="ideal", until=lambda *_: True)
    assert found.extent.stretches == 1
    theta = float(np.median(camera.theta_on))
    assert abs(float(found.summary.theta_on) - theta) < 3 * float(found.summary_std.theta_on)
    alone = estimate_camera(Recording(
        recording.events.slice(int(recording.events.t[0]), int(recording.frame_times[2])),
        recording.frames[:3], recording.frame_times[:3]), pixel="ideal")
    np.testing.assert_allclose(found.summary.theta_on, alone.summary.theta_on, rtol=1e-3)


@pytest.mark.parametrize("every", [1, 2])
def test_events_of_a_pixel_are_counted_as_they_were_pooled(every: int) -> None:
    """Those of a hot pixel are taken out of the statistics again, and only those: of a long
    recording every second window is pooled, and not where frames are black."""
    recording, _ = hidden(3)
    frames = recording.frames.copy()
    frames[3:, :8] = 0
    recording = dataclasses.replace(recording, frames=frames)
    stretches = cut(recording, plan_windows(recording))
    front_end = find_front_end(stretches, UNSEEN, measured=False)
    read = read_stretch(State(small_params(), front_end), stretches[0], simulate=False,
                        every=every)
    for k, name in enumerate(("events_on", "events_off")):
        assert float(getattr(read.stats, name)) == read.pooled[k].sum()
    assert read.pooled.sum() < read.sent.sum() / (0.8 * every)
