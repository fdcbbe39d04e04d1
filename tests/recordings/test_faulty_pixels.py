"""Columns and rows that never fire, and scenes that merely end."""

from __future__ import annotations

import numpy as np
import pytest

from evflow.estimation.static import estimate_noise
from evflow.recordings.faulty_pixels import dead_pixels, hot_pixels, silent_lines
from evflow.types import Events, Recording

SHAPE = (24, 40)


def noise(mean: float, seed: int = 0) -> np.ndarray:
    """Events (H, W) of pixels that send so many."""
    return np.random.default_rng(seed).poisson(mean, SHAPE)


@pytest.mark.parametrize("part", [
    np.s_[:, 30:], np.s_[:, :5], np.s_[14:, :], np.s_[:, 17:19], np.s_[10:12, :]])
def test_lines_beside_busy_ones_are_silent(part: tuple[slice, slice]) -> None:
    counts = noise(3.0)
    counts[part] = 0
    expected = np.zeros(SHAPE, bool)
    expected[part] = True
    np.testing.assert_array_equal(silent_lines(counts), expected)
    assert dead_pixels(counts)[part].all()


def test_a_region_of_interest_is_what_fires() -> None:
    counts = np.zeros(SHAPE, int)
    counts[5:17, 8:30] = noise(3.0)[5:17, 8:30]
    outside = np.ones(SHAPE, bool)
    outside[5:17, 8:30] = False
    np.testing.assert_array_equal(silent_lines(counts), outside)


def test_where_a_scene_ends_nothing_is_silent() -> None:
    """A disc passes few pixels of the last column, and sparse noise leaves columns out."""
    y, x = np.mgrid[:SHAPE[0], :SHAPE[1]]
    assert not silent_lines(5 * ((y - 12) ** 2 + (x - 20) ** 2 < 80)).any()
    for seed in range(20):
        assert not silent_lines(noise(0.05, seed)).any()
        assert not silent_lines(noise(0.02, seed)).any()
    assert not silent_lines(np.zeros(SHAPE, int)).any()
    assert not silent_lines(5 * (np.arange(100) < 30)[None]).any()  # a line of pixels


def test_noise_of_half_a_sensor_is_that_of_the_half() -> None:
    rng, seconds, rate_hz = np.random.default_rng(1), 5.0, 0.5
    counts = rng.poisson(rate_hz * seconds, (2, *SHAPE))
    counts[:, :, 20:] = 0
    p, y, x = (np.repeat(a, counts.ravel()) for a in np.indices(counts.shape).reshape(3, -1))
    t = np.sort(rng.integers(0, round(seconds * 1e6), len(x)))
    order = rng.permutation(len(x))
    events = Events(x[order], y[order], t, p[order] > 0, SHAPE[::-1])
    found = estimate_noise(Recording.of_events(events))
    for rate, error, map_ in (
        (found.summary.eta_on, found.summary_std.eta_on, found.camera.eta_on),
        (found.summary.eta_off, found.summary_std.eta_off, found.camera.eta_off),
    ):
        assert float(rate) == pytest.approx(rate_hz, abs=3 * float(error))
        assert float(error) < 0.03
        np.testing.assert_allclose(np.asarray(map_)[:, 20:], float(rate), rtol=0.02)
    assert found.dead[:, 20:].all()
    assert "pixels.dead" in [note.code for note in found.notes]


def test_in_slow_scenes_pixels_that_fire_in_quiet_times_are_not_hot() -> None:
    """In 2 s of slow motion, 60 frame intervals are quiet for each pixel, which sends 3 to 7 events
    in them and 10 in all. One that sends twice as many is within what scenes do; 12 Hz are not."""
    quiet = np.zeros((4, *SHAPE))
    quiet[0] = np.random.default_rng(1).integers(3, 8, SHAPE)
    quiet[1:3] = np.array([1.5, 60.0])[:, None, None]
    counts = noise(10.0)
    for y, x, events in ((8, 8, 11), (8, 30, 21)):
        quiet[0, y - 2:y + 3, x - 2:x + 3] = 5
        quiet[0, y, x], counts[y, x] = events, events + 5
    quiet[3] = quiet[0]
    hot = hot_pixels(quiet, 0.2, counts, 2.0)
    assert np.argwhere(hot).tolist() == [[8, 30]]
