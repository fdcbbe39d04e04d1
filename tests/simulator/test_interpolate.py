"""upsample: frames in between are where the motion puts them, the given ones are untouched."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from helpers.videos import code_of

from evflow.errors import EvflowDataError
from evflow.notes import Note
from evflow.simulator.interpolate import MAX_STEPS, Interpolator, unzip, upsample

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


def between(a: np.ndarray, b: np.ndarray, dt: int = 40_000, **options: float) -> list:
    return list(upsample([(a, 0), (b, dt)], **options))


@pytest.mark.parametrize(("dx", "dy"), [(4.0, 0.0), (0.0, -6.0), (7.0, 5.0)])
def test_linear_motion_is_followed_and_blending_is_much_worse(dx: float, dy: float) -> None:
    a, b = shifted(0, 0), shifted(dx, dy)
    filled = between(a, b)
    assert np.hypot(dx, dy) - 1 <= len(filled) - 1 <= np.hypot(dx, dy) + 3
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
    made, motion = Interpolator().between(*frames, 4)
    assert [f.shape for f in made] == [shape] * 3
    assert np.isfinite(made).all()
    assert np.isfinite(motion)


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


def test_warns_once_where_motion_is_too_fast() -> None:
    told: list[Note] = []
    pairs = [(shifted(6.0 * i), 40_000 * i) for i in range(3)]
    out = list(upsample(pairs, max_motion_px=0.05, warn=told.append))
    assert len(out) == 2 * MAX_STEPS + 1
    assert len(told) == 1
    assert "between the frames at 0 and 40000 us" in told[0].text
    assert str(MAX_STEPS) in told[0].text
    list(upsample(pairs, max_motion_px=1.0, warn=told.append))
    assert len(told) == 1


def test_nothing_is_read_ahead() -> None:
    """A video is a stream: each pair is filled before the next frame is asked for."""
    asked: list[int] = []

    def video() -> Iterator[tuple[np.ndarray, int]]:
        for i in range(3):
            asked.append(i)
            yield shifted(3.0 * i), 1000 * i

    stream = upsample(video())
    next(stream)
    assert asked == [0]
    next(stream)
    assert asked == [0, 1]


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


@pytest.mark.parametrize("step", [0.0, -1.0, float("nan")])
def test_motion_step_must_be_positive(step: float) -> None:
    assert code_of(lambda: between(shifted(0), shifted(1), max_motion_px=step)) == "EV020"


def test_unzip_walks_in_step() -> None:
    frames, times = unzip((i, 10 * i) for i in range(4))
    assert list(zip(frames, times, strict=True)) == [(0, 0), (1, 10), (2, 20), (3, 30)]
