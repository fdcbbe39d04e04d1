"""Fast edges before pixels that lose contrast in their dead time."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.benches import SHAPE, cameras, screen

from evflow.camera import Camera
from evflow.estimation.bench import calibration
from evflow.estimation.bench.calibration import calibrate_step
from evflow.estimation.bench.fast_edges import kept_by_small_steps, with_fast_edges
from evflow.estimation.result import CameraEstimate
from evflow.types import Events, Recording

LEVELS = [40.0, 120.0, 60.0, 200.0, 90.0, 180.0, 50.0, 70.0, 220.0, 100.0, 40.0, 160.0, 60.0, 90.0]
FINE = 20  # instants of a ms


def held_in_reset(camera: Camera, dead_s: float, ramp: int) -> Recording:
    """Events of pixels without noise that begin anew `dead_s` after each: an instant at a time."""
    dn = screen(LEVELS, ramp=ramp)
    logs = np.interp(np.arange(0, len(dn) - 1, 1 / FINE), np.arange(len(dn)), np.log(dn))
    on, off = np.asarray(camera.theta_on), np.asarray(camera.theta_off)
    memory = logs[0] + np.random.default_rng(0).uniform(-on, off)
    until, rows = np.full(SHAPE, -1.0), []
    for i in np.flatnonzero(np.diff(logs, prepend=logs[0])):
        now, t = logs[i], i * 1e-3 / FINE
        memory = np.where(t < until, now, memory)
        for side, fires in ((1, now - memory >= on), (0, memory - now >= off)):
            y, x = np.nonzero(fires)
            rows.append(np.stack([x, y, np.full(len(x), round(1e6 * t)), np.full(len(x), side)]))
            memory = np.where(fires, now, memory)
            until = np.where(fires, t + dead_s, until)
    x, y, t, p = np.concatenate(rows, 1)
    times = np.arange(0, len(dn), 10)
    frames = np.broadcast_to(dn[times, None, None], (len(times), *SHAPE))
    return Recording(Events(x, y, t, p > 0, SHAPE[::-1]), np.ascontiguousarray(frames),
                     1000 * times)


def measured(dead_s: float, ramp: int) -> tuple[CameraEstimate, np.ndarray]:
    """The estimate, and the relative errors (2,) of its thresholds."""
    camera = cameras(0.03)
    found = calibrate_step(held_in_reset(camera, dead_s, ramp))
    return found, np.array([float(getattr(found.summary, name)) / np.median(
        np.asarray(getattr(camera, name))) - 1.0 for name in ("theta_on", "theta_off")])


@pytest.mark.usefixtures("known_levels")
@pytest.mark.parametrize(("dead_s", "ramp"), [(1e-3, 20), (5e-4, 10), (5e-4, 20)])
def test_contrast_lost_on_edges_is_told_and_in_the_errors(dead_s: float, ramp: int) -> None:
    found, away = measured(dead_s, ramp)
    assert [note.code for note in found.notes] == ["steps.fast"]
    assert np.abs(away).max() < 0.04
    for name, relative in zip(("theta_on", "theta_off"), away, strict=True):
        theta, std = (float(getattr(s, name)) for s in (found.summary, found.summary_std))
        assert abs(relative * theta) < std
        assert np.median(np.asarray(getattr(found.std, name))) > 0.7 * std
        assert np.median(np.asarray(getattr(found.camera, name))) == pytest.approx(theta, rel=0.02)


def test_without_that_they_are_too_high(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(calibration, "with_fast_edges", lambda found, *_: found)
    assert (measured(1e-3, 20)[1] > 0.07).all()


@pytest.mark.parametrize(("dead_s", "ramp"), [(0.0, 20), (1e-4, 50)])
def test_thresholds_of_all_sizes_agree_without_a_loss(dead_s: float, ramp: int) -> None:
    found, away = measured(dead_s, ramp)
    assert not found.notes
    assert np.abs(away).max() < 0.03


def test_too_few_steps_tell_nothing() -> None:
    changes = np.array([0.7, -0.7, 1.4, -1.4])
    sent = np.stack([np.maximum(changes, 0), np.maximum(-changes, 0)], -1) / 0.25
    assert kept_by_small_steps(changes, sent, np.full(2, 0.25), np.ones(4, bool)) is None
    assert kept_by_small_steps(np.tile(changes[:2], 8), np.tile(sent[:2], (8, 1)),
                               np.full(2, 0.25), np.ones(16, bool)) is None


def test_absurd_thresholds_of_vanishing_steps_are_in_the_errors_alone() -> None:
    """Levels that are wrong, as by a black level, look alike."""
    found, _ = measured(0.0, 20)
    theta = np.array([float(found.summary.theta_on), float(found.summary.theta_off)])
    changes = np.array([0.7, -0.7, 1.4, -1.4, 0.9, -0.9, 1.1, -1.1] * 2)
    sizes = np.abs(changes) - 0.5 * theta.sum()
    n = sizes / (0.2 * theta.mean() + 0.25 * np.abs(changes))
    sent = np.where((changes > 0)[:, None], np.stack([n, 0 * n], 1), np.stack([0 * n, n], 1))
    told = with_fast_edges(found, changes, sent, np.ones(16, bool))
    assert "The former is given" in told.notes[-1].text
    assert told.summary.theta_on == found.summary.theta_on
    assert float(told.summary_std.theta_on) > 0.2 * theta[0]
