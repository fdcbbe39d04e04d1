"""upsample: frames in between are where the motion puts them, the given ones are untouched."""

from __future__ import annotations

import itertools
import re
import threading
from collections.abc import Iterator

import cv2
import numpy as np
import pytest
import skimage.data
from helpers.videos import code_of

import evflow.simulator.between as ways_between
from evflow.errors import EvflowDataError
from evflow.notes import Note
from evflow.simulator.between import _edges, intervals
from evflow.simulator.interpolate import AHEAD, MAX_STEPS, unzip, upsample
from evflow.simulator.motion import MOTION_QUANTILE, length, motion_between, speed

SIZE = 96


def shifted(dx: float, dy: float = 0.0) -> np.ndarray:
    """A random smooth texture (wavelengths 8-60 px) moved by a fraction of a pixel, exactly."""
    rng = np.random.default_rng(11)
    y, x = np.mgrid[:SIZE, :SIZE]
    total = np.zeros((SIZE, SIZE))
    for _ in range(24):
        angle, wave, phase = rng.uniform(0, np.pi), rng.uniform(8, 60), rng.uniform(0, 2 * np.pi)
        along = np.cos(angle) * (x - dx) + np.sin(angle) * (y - dy)
        total += np.sin(2 * np.pi * along / wave + phase)
    return (127.5 + 120 * np.tanh(total / 5)).astype(np.float32)


@pytest.mark.parametrize("shape", [(1, 1), (1, 2), (43, 57), (120, 160)])
def test_the_speed_is_a_percentile_of_the_motion(shape: tuple[int, int]) -> None:
    flow = np.random.default_rng(0).normal(0, 3, (*shape, 2)).astype(np.float32)
    assert speed(flow) == float(np.percentile(length(flow), MOTION_QUANTILE))


def between(a: np.ndarray, b: np.ndarray, dt: int = 40_000, **options: float) -> list:
    return list(upsample([(a, 0), (b, dt)], **options))


@pytest.mark.parametrize(("dx", "dy"), [(4.0, 0.0), (0.0, -6.0), (7.0, 5.0)])
def test_linear_motion_is_followed_and_blending_is_much_worse(dx: float, dy: float) -> None:
    a, b = shifted(0, 0), shifted(dx, dy)
    filled = between(a, b)
    assert 2 * np.hypot(dx, dy) - 1 <= len(filled) - 1 <= 2 * np.hypot(dx, dy) + 4
    inner = np.s_[12:-12, 12:-12]  # what enters at the border cannot be known
    for frame, t in filled[1:-1]:
        s = t / 40_000
        truth = shifted(s * dx, s * dy)
        error = np.abs(frame - truth)[inner].mean()
        blended = np.abs((1 - s) * a + s * b - truth)[inner].mean()
        assert error < 0.2 * blended
        assert error < 2.0


@pytest.mark.parametrize("shape", [(8, 64), (64, 8), (15, 64), (1, 40), (3, 48), (12, 12)])
def test_narrow_frames_are_filled_too(shape: tuple[int, int]) -> None:
    frames = np.random.default_rng(0).uniform(0, 255, (2, *shape)).astype(np.float32)
    interval, = intervals(zip(frames, (0, 100), strict=True))
    made = list(interval.at((0.25, 0.5, 0.75)))
    assert [f.shape for f in made] == [shape] * 3
    assert np.isfinite(made).all()
    assert np.isfinite(interval.speed_px)


def test_steps_follow_the_wanted_motion() -> None:
    a, b = shifted(0), shifted(6)
    steps = {px: len(between(a, b, max_motion_px=px)) - 1 for px in (0.5, 1.0, 3.0, 100.0)}
    assert steps[100.0] == 1
    assert steps[3.0] in (2, 3)
    assert steps[0.5] >= 2 * steps[1.0] - 1
    assert 6 <= steps[1.0] <= 8


def test_times_rise_and_are_even() -> None:
    frames = [shifted(5.0 * i) for i in range(4)]
    times = [t for _, t in upsample(zip(frames, (7, 40_007, 50_000, 1_000_000), strict=True))]
    assert all(isinstance(t, int) for t in times)
    assert (np.diff(times) > 0).all()
    gaps = np.diff([t for t in times if t <= 40_007])
    assert gaps.max() - gaps.min() <= 1


def test_no_more_frames_than_microseconds() -> None:
    for dt in (1, 2, 3, 5):
        times = [t for _, t in between(shifted(0), shifted(9), dt)]
        assert (times[0], times[-1], len(times)) == (0, dt, dt + 1)
        assert (np.diff(times) > 0).all()


def test_given_frames_come_out_unchanged_and_still_scenes_stay_short() -> None:
    a, b = shifted(0).astype(np.uint8), shifted(4).astype(np.uint8)
    out = list(upsample([(a, 0), (a, 10), (b, 20), (b, 30)]))
    given = {t: frame for frame, t in out if t in (0, 10, 20, 30)}
    for t, frame in zip((0, 10, 20, 30), (a, a, b, b), strict=True):
        np.testing.assert_array_equal(given[t], frame)
        assert given[t].dtype == np.float32
    assert [t for _, t in out if not 10 < t < 20] == [0, 10, 20, 30]
    assert len(out) > 6
    assert all(f.min() >= 0 and f.max() <= 255 for f, _ in out)


def test_tells_at_the_end_where_motion_is_too_fast() -> None:
    noted: list[Note] = []
    pairs = [(shifted(6.0 * i), 40_000 * i) for i in range(3)]
    out = list(upsample(pairs, max_motion_px=0.04, warn=noted.append))
    assert abs(len(out) - 2 * MAX_STEPS) <= 2
    note, = noted
    assert note.code == "frames.fast"
    assert str(MAX_STEPS) in note.text
    assert "in 2 of 2 intervals" in note.text
    list(upsample(pairs, warn=noted.append))
    assert len(noted) == 1


def test_two_frames_ahead_are_enough_and_few_more_are_read() -> None:
    """A video is a stream: what lies between two frames needs the two after them, and no other."""
    asked: list[int] = []
    released = [threading.Event() for _ in range(10)]

    def video() -> Iterator[tuple[np.ndarray, int]]:
        for i in range(10):
            assert i <= 3 or released[i - 4].wait(10.0)
            asked.append(i)
            yield shifted(3.0 * i), 1000 * i

    for _, t in upsample(video()):
        released[t // 1000].set()

    asked.clear()
    for event in released:
        event.set()
    for _, t in upsample(video()):
        assert asked[-1] <= t // 1000 + 3 + AHEAD + 2


def test_lengths_of_flow_do_not_depend_on_where_they_lie_in_memory() -> None:
    """Or two runs would differ in the last bit of some pixels."""
    rng = np.random.default_rng(0)
    for shape in [(45, 61), (30, 40), (9, 9)] * 4:
        flow = rng.normal(size=(*shape, 2)).astype(np.float32)
        kept = [length(flow) for _ in range(16)]
        assert len({found.ctypes.data % 64 for found in kept}) > 1
        assert len({found.tobytes() for found in kept}) == 1


@pytest.mark.parametrize("shape", [(20, 30), (20, 31), (7, 40)])
@pytest.mark.parametrize("reach", [(1, 1), (3, 9), (9, 3), (10, 400), (400, 1)])
@pytest.mark.parametrize("band", [1, 4, 40])
def test_edges_hold_all_that_is_near_the_border_once(
    shape: tuple[int, int], reach: tuple[int, int], band: int
) -> None:
    seen = np.zeros(shape, int)
    for top in range(0, shape[0], band):
        rows = slice(top, min(top + band, shape[0]))
        for edge in _edges(rows, shape, reach):
            seen[rows][edge] += 1
    y, x = np.indices(shape)
    near = (np.minimum(x, shape[1] - 1 - x) < reach[0]) | (
        np.minimum(y, shape[0] - 1 - y) < reach[1])
    assert seen.max() == 1
    assert (seen[near] == 1).all()


@pytest.mark.parametrize("threads", [1, 2])
def test_pictures_do_not_depend_on_how_much_is_made_at_a_time(
    monkeypatch: pytest.MonkeyPatch, threads: int
) -> None:
    """Of OpenCV's threads one: half of the bands are filled by another."""
    *_, interval = intervals([(shifted(4 * k), 1_000 * k) for k in range(4)])
    shares, before = [0.1, 0.4, 0.7, 0.9], cv2.getNumThreads()
    for sharp in (True, False):
        whole = list(interval.at(shares, sharp=sharp))
        monkeypatch.setattr(ways_between, "BAND", 3 * whole[0].shape[1])
        monkeypatch.setattr(ways_between, "TOGETHER", 3 * whole[0].nbytes)
        try:
            cv2.setNumThreads(threads)
            np.testing.assert_array_equal(list(interval.at(shares, sharp=sharp)), whole)
        finally:
            cv2.setNumThreads(before)
        monkeypatch.undo()


def test_flow_is_the_same_with_any_number_of_threads() -> None:
    """One: both ways at the same time."""
    a, b, before = shifted(0), shifted(5), cv2.getNumThreads()
    found = []
    try:
        for threads in (1, 2, 5):
            cv2.setNumThreads(threads)
            motion = motion_between(a, b)
            found.append(np.stack([motion.there, motion.back]))
    finally:
        cv2.setNumThreads(before)
    np.testing.assert_array_equal(found[1], found[0])
    np.testing.assert_array_equal(found[2], found[0])
    assert np.median(found[0][0] + found[0][1]) == pytest.approx(0, abs=0.1)
    assert np.abs(np.median(found[0][0], (0, 1))).max() == pytest.approx(5, abs=0.3)


def test_motion_does_not_depend_on_what_was_looked_at_before() -> None:
    """OpenCV's objects remember that they began from a shift."""
    middle = (SIZE / 2, SIZE / 2)
    turned = cv2.warpAffine(shifted(0), cv2.getRotationMatrix2D(middle, 8, 1), (SIZE, SIZE))
    first = motion_between(shifted(0), turned)
    assert np.abs(motion_between(shifted(0), shifted(24)).there).max() > 20
    again = motion_between(shifted(0), turned)
    np.testing.assert_array_equal([again.there, again.back], [first.there, first.back])


def test_empty_and_single() -> None:
    assert list(upsample([])) == []
    assert [t for _, t in upsample([(shifted(0), 5)])] == [5]


@pytest.mark.parametrize("shapes", [[(8, 8), (8, 8)], [(3, 4)], [(16, 16), (16, 20)], [(16, 16, 3)],
                                    [(16,)]])
def test_frames_it_cannot_follow_are_refused(shapes: list[tuple[int, ...]]) -> None:
    pairs = [(np.zeros(shape, np.uint8), i) for i, shape in enumerate(shapes)]
    assert code_of(lambda: list(upsample(pairs))) == "EV002"


def test_frames_too_small_for_motion_may_be_taken_as_they_are() -> None:
    tiny = [(np.zeros((8, 8), np.uint8), i) for i in range(2)]
    with pytest.raises(EvflowDataError, match=r"8x8 pixels are too small.*--no-interpolate"):
        list(upsample(tiny))


def at_middle(frames: list[np.ndarray], number: int, times: tuple[int, ...]) -> np.ndarray:
    interval = list(intervals(zip(frames, times, strict=True)))[number]
    middle, = interval.at([0.5])
    return middle


INNER = np.s_[16:-16, 16:-16]


@pytest.mark.parametrize(("places", "times", "wanted"), [
    ((0, 1, 4, 9), (0, 10, 20, 30), 2.25),  # constant acceleration
    ((0, 2, 6, 8), (0, 10, 30, 40), 4.0),  # constant velocity, one interval twice as long
    ((0, 0, 0, 6), (0, 10, 20, 30), 0.0),  # what rests stays until it moves
    ((0, 3, 6, 6), (0, 10, 900, 910), 4.5)])  # long after, velocities tell nothing
def test_paths_are_smooth(
    places: tuple[float, ...], times: tuple[int, ...], wanted: float
) -> None:
    made = at_middle([shifted(x) for x in places], 1, times)[INNER]
    errors = [np.abs(made - shifted(x)[INNER]).mean() for x in (wanted - 0.2, wanted, wanted + 0.2)]
    assert np.argmin(errors) == 1


def test_what_swings_keeps_its_speed() -> None:
    """A hand's swing of five frames: through four frames alone it would be slower at each."""
    def place(u: float) -> float:
        return 5.0 * float(np.sin(1.2 * u))

    film = [(shifted(place(k)), 1_000 * k) for k in range(6)]
    for jerk, most in ((True, 0.1), (False, 1.0)):
        interval = list(intervals(film, jerk=jerk))[2]
        speeds = []
        for begin, end in ((0.001, 0.1), (0.45, 0.55), (0.9, 0.999)):
            pictures = list(interval.at((begin, end)))
            way = np.abs(pictures[1] - pictures[0])[INNER].mean()
            truth = np.abs(shifted(place(2 + end)) - shifted(place(2 + begin)))[INNER].mean()
            speeds.append(way / truth)
        assert np.abs(np.array(speeds) - 1).max() < most
        assert jerk or np.abs(np.array(speeds) - 1).max() > 0.12


def test_paths_begin_and_end_at_the_frames() -> None:
    frames = [shifted(x) for x in (0, 1, 4, 9)]
    interval = list(intervals(zip(frames, range(4), strict=True)))[1]
    begin, end = interval.at((0.0, 1.0))
    np.testing.assert_allclose(begin, frames[1], atol=1e-3)
    np.testing.assert_allclose(end, frames[2], atol=1e-3)


def test_constant_velocity_changes_brightness_at_a_constant_rate() -> None:
    """Cubic interpolation of the frames as they are would be unsteady by a tenth."""
    out = list(upsample([(shifted(4.3 * i), 10_000 * i) for i in range(4)]))
    changes = np.array([np.abs(np.log(b[INNER]) - np.log(a[INNER])).mean() / (t1 - t0)
                        for (a, t0), (b, t1) in itertools.pairwise(out)])
    assert changes.std() < 0.05 * changes.mean()


@pytest.mark.parametrize("speed", [5, 10, 20, 30])
def test_light_changes_as_much_as_in_the_dense_truth(speed: int) -> None:
    """What events count: the way of log intensity at each pixel. A fade leaves most of it out."""
    noise = np.random.default_rng(0).uniform(0, 255, (96, 260)).astype(np.float32)
    texture = cv2.GaussianBlur(noise, (0, 0), 2.0)
    film = [texture[:, x:x + 160] for x in range(3 * speed + 1)]
    given = film[::speed]
    made = [f for f, _ in upsample(zip(given, range(0, 4_000, 1_000), strict=True))]

    def way(film: list[np.ndarray]) -> float:
        seen = np.log(np.stack(film)[:, 12:-12, 36:-36])
        return float(np.abs(np.diff(seen, axis=0)).sum())

    assert 0.9 < way(made) / way(film) < 1.07
    assert way(given) / way(film) < 0.8


@pytest.mark.parametrize("dx", [20, -30])
def test_fast_pans_of_fine_textures_are_followed(dx: int) -> None:
    noise = np.random.default_rng(0).uniform(0, 255, (120, 260)).astype(np.float32)
    texture = cv2.GaussianBlur(noise, (0, 0), 1.5)
    first, middle, last = (texture[:, 50 + x:210 + x] for x in (0, dx // 2, dx))
    made = at_middle([first, last], 0, (0, 1))
    error, faded = (np.abs(m - middle)[:, 16:-16].mean() for m in (made, (first + last) / 2))
    assert error < 0.1 * faded


def test_what_comes_into_view_takes_no_more_steps() -> None:
    """Flow there is a guess, and often faster than the pan."""
    photo = skimage.data.camera().astype(np.float32)
    pan = [photo[120:240, 20 * k:20 * k + 160].copy() for k in range(4)]
    found = list(intervals(zip(pan, range(0, 4_000, 1_000), strict=True)))
    assert max(speed(interval.motion.there) for interval in found) > 24
    assert [interval.speed_px for interval in found] == pytest.approx([20] * 3, rel=0.05)


FOLDED = np.where(np.arange(SIZE) < SIZE * 0.6, shifted(5.0), shifted(0)[::-1])


@pytest.mark.parametrize(("second", "code"), [
    (shifted(5.0), ""), (0.7 * shifted(5.0), ""), (shifted(0), ""), (FOLDED, "frames.flow"),
    (shifted(0)[::-1].copy(), "frames.cut"), (shifted(4).T.copy(), "frames.cut")])
def test_flow_that_fails_is_told_with_its_share(second: np.ndarray, code: str) -> None:
    """Unrelated pictures, whole or in part; not what moves, gets darker or stays."""
    noted: list[Note] = []
    list(upsample([(shifted(0), 0), (second, 40_000)], max_motion_px=9.0, warn=noted.append))
    assert [note.code for note in noted] == [code] * bool(code)
    assert all(re.search(r"0( us.*)? and 40000 us|at 0 us .* at 40000 us", note.text)
               for note in noted)
    assert all(re.search(r"in \d\d% of the pixels", note.text) for note in noted
               if code == "frames.flow")


def test_nothing_is_warped_across_a_cut() -> None:
    """A shot is filled up as it would be alone, and fades into the next."""
    shots = [[shifted(4.0 * i) for i in range(3)], [shifted(6.0 * i).T.copy() for i in range(3)]]
    noted: list[Note] = []
    film = [(frame, 10_000 * i) for i, frame in enumerate(shots[0] + shots[1])]
    made = list(upsample(film, warn=noted.append))
    assert [t for _, t in made if 20_000 < t < 30_000] == []
    before = [pair for pair in made if pair[1] <= 20_000]
    for (frame, t), (alone, t_alone) in zip(before, upsample(film[:3]), strict=True):
        assert t == t_alone
        np.testing.assert_array_equal(frame, alone)
    for t, frame in ((t, frame) for frame, t in made if 30_000 < t < 50_000):
        truth = shifted(6.0 * (t - 30_000) / 10_000).T
        assert np.abs(frame - truth)[INNER].mean() < 2.0
    note, = noted
    assert note.code == "frames.cut"
    assert re.search("at 20000 us .* at 30000 us", note.text)
    cut = list(intervals(film))[2]
    middle, = cut.at([0.5])
    np.testing.assert_allclose(middle, (film[2][0] + film[3][0]) / 2, rtol=1e-5)


@pytest.mark.parametrize("step", [0.0, -1.0, float("nan")])
def test_motion_step_must_be_positive(step: float) -> None:
    assert code_of(lambda: between(shifted(0), shifted(1), max_motion_px=step)) == "EV020"


def test_unzip_walks_in_step() -> None:
    frames, times = unzip((i, 10 * i) for i in range(4))
    assert list(zip(frames, times, strict=True)) == [(0, 0), (1, 10), (2, 20), (3, 30)]


@pytest.mark.parametrize(("second", "time", "code"), [
    (100.0, 0, "EV004"), (100.0, -5, "EV004"), (np.nan, 10, "EV007")])
def test_frames_that_cannot_follow_are_refused(second: float, time: int, code: str) -> None:
    frames = [np.full((16, 16), value, np.float32) for value in (100.0, second)]
    with pytest.raises(EvflowDataError, match=code):
        list(upsample(zip(frames, (0, time), strict=True)))
