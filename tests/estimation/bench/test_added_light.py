"""Light that pixels see beside the levels of a bench: black level of the frames, dark light."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest
from helpers.benches import CYCLES, bench, cameras

from evflow import Recording
from evflow.estimation.bench.added_light import measured_light, seen
from evflow.estimation.bench.calibration import calibrate_step
from evflow.estimation.result import CameraEstimate
from evflow.light.log_maps import lin_log

LEVELS = [40.0, 60.0, 95.0, 150.0, 225.0]
WALK = [0, 1, 4, 3, 1, 2, 0, 4, 2, 3, 0, 2, 1, 3, 4, 0, 1, 2, 4, 1, 0, 3, 2, 4, 0]
CAMERA = cameras(0.03)
EVENTS = np.array([8.0, 9.0])


@functools.cache
def screen() -> Recording:
    return bench(CAMERA, [LEVELS[k] for k in WALK])


def lacking(light: float) -> Recording:
    """The screen by frames that show so much light less than there is."""
    whole = screen()
    return dataclasses.replace(whole, frames=whole.frames - np.float32(light))


def sigmas(found: CameraEstimate) -> np.ndarray:
    """Errors of the camera's thresholds in standard deviations."""
    names = "theta_on", "theta_off"
    return np.array([
        (float(getattr(found.summary, n)) - np.median(np.asarray(getattr(CAMERA, n))))
        / float(getattr(found.summary_std, n)) for n in names])


@pytest.mark.parametrize("light", [-8.0, 10.0, 20.0])
def test_light_that_frames_lack_is_found_by_steps_of_different_levels(light: float) -> None:
    found = calibrate_step(lacking(light))
    assert "levels.added" in [note.code for note in found.notes]
    assert found.optics.offset_dn == pytest.approx(light, abs=1.0)
    assert 0.5 < found.optics.offset_dn_std < 4.0
    assert np.abs(sigmas(found)).max() < 2.0
    assert float(found.summary_std.theta_on) < 0.05 * float(found.summary.theta_on)


def test_right_levels_stay_as_they_are() -> None:
    found = calibrate_step(lacking(0.0))
    assert not [note for note in found.notes if note.code.startswith("levels.")]
    assert found.optics.offset_dn == 0.0
    assert np.abs(sigmas(found)).max() < 2.0


def test_levels_of_a_light_meter_say_nothing_of_the_frames() -> None:
    rests = [(k * 120_000, k * 120_000 + 99_000) for k in range(len(WALK))]
    found = calibrate_step(screen(), rests_us=rests, light=[LEVELS[k] - 10.0 for k in WALK])
    assert "levels.added" in [note.code for note in found.notes]
    assert found.optics.offset_dn == 0.0
    assert np.isnan(found.optics.offset_dn_std)
    assert np.abs(sigmas(found)).max() < 2.0


def test_two_levels_do_not_tell_and_the_error_says_so() -> None:
    whole = bench(CAMERA, CYCLES)
    found = calibrate_step(dataclasses.replace(whole, frames=whole.frames - np.float32(8.0)))
    text = next(note.text for note in found.notes if note.code == "levels.black")
    assert "± 8 DN" in text
    assert 0.5 < sigmas(found).max() < 2.0


def test_contrast_lost_on_fast_edges_is_no_light() -> None:
    """n theta = C - n C / 12: sizes alone, whatever the levels."""
    levels = np.log([LEVELS[k] for k in WALK])
    change = np.diff(levels)
    up, theta = change > 0, np.array([0.2, 0.25])
    way = np.abs(change) - 0.5 * np.diff(up, prepend=up[0]) * theta.sum()
    n = way / (np.where(up, *theta) + np.abs(change) / 12.0)
    sent = np.stack([n * up, n * ~up], 1)
    added = measured_light(levels, None, sent, np.ones(len(n), bool), theta, 0.1 * theta)
    assert added.amount == 0.0
    assert added.std < 3.0


def test_too_few_kinds_of_steps_tell_nothing() -> None:
    levels = np.log([40.0, 90.0] * 10)
    added = measured_light(levels, "linlog", np.tile(EVENTS, (19, 1)), np.ones(19, bool),
                           np.array([0.1, 0.1]), np.array([0.01, 0.01]))
    assert (added.amount, added.unsure) == (0.0, 8.0)
    assert np.isnan(added.std)


def test_light_is_added_before_the_logarithm() -> None:
    dn = np.array([10.0, 30.0, 200.0])
    shown = np.asarray(lin_log(dn), np.float64)
    np.testing.assert_allclose(seen(shown, 12.0, "linlog"), np.asarray(lin_log(dn + 12.0)), 1e-5)
    np.testing.assert_allclose(seen(np.log(dn), 12.0, None), np.log(dn + 12.0))
    assert seen(shown, 0.0, "linlog") is shown
