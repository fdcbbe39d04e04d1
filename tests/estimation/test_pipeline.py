"""From a whole recording to a camera."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.networks import SHAPE, hidden
from scipy import ndimage

from evflow import (
    Camera,
    CameraEstimate,
    Events,
    Recording,
    estimate_camera,
    load_weights,
    simulate,
)
from evflow.camera import PARAMETERS
from evflow.camera.optics import read_shared
from evflow.errors import EvflowDataError


@pytest.fixture(scope="module")
def watched() -> tuple[Recording, Camera]:
    return hidden(14)


Found = tuple[CameraEstimate, list[tuple[int, int]]]


@pytest.fixture(scope="module")
def measured(watched: tuple[Recording, Camera]) -> Found:
    """What is found, and what progress was told."""
    calls: list[tuple[int, int]] = []
    return estimate_camera(watched[0], progress=lambda *c: calls.append(c)), calls


def test_a_hidden_camera_is_found(watched: tuple[Recording, Camera], measured: Found) -> None:
    (found, calls), camera = measured, watched[1]
    for name in ("theta_on", "theta_off"):
        truth = float(jnp.median(getattr(camera, name)))
        assert float(getattr(found.summary, name)) == pytest.approx(truth, abs=0.02)
        assert 0 < float(getattr(found.summary_std, name)) < 0.03
    total = 2 * found.windows + 1  # two passes over the windows, one stretch of 8 intervals
    assert calls == [(i + 1, total) for i in range(total)]
    assert found.windows == 6


def test_maps_have_the_camera_in_the_quiet_and_width_everywhere(
    watched: tuple[Recording, Camera], measured: Found
) -> None:
    found, _ = measured
    assert found.camera.shape == found.std.shape == SHAPE == found.valid.shape
    for name in PARAMETERS:
        assert np.isfinite(getattr(found.camera, name)).all()
        assert (np.asarray(getattr(found.std, name)) > 0).all()
    first, last = watched[0].frame_times[[0, -1]].tolist()
    inside = watched[0].events.slice(first, last)
    assert found.n_events.sum() == len(inside)
    assert (found.valid == ((found.n_events >= 3) & ~found.hot)).all()
    assert found.hot.mean() < 0.01
    assert found.dead.mean() < 0.01


def test_uneven_noise_is_found_pixel_by_pixel_and_its_errors_hold() -> None:
    """What a window tells of a pixel's noise is next to nothing; many windows tell some."""
    recording, camera = hidden(14, 1200)
    events, rng = recording.events, np.random.default_rng(0)
    extra = rng.gamma(1.0, 1.0, SHAPE)  # Hz
    sent = rng.poisson(extra * 1e-6 * events.duration_us).ravel()
    y, x = (i.repeat(sent) for i in np.indices(SHAPE).reshape(2, -1))
    t = rng.integers(events.t[0], events.t[-1], len(x))
    columns = [np.concatenate(both) for both in zip(
        (events.x, events.y, events.t, events.p), (x, y, t, np.ones(len(x), bool)), strict=True)]
    order = np.argsort(columns[2], kind="stable")
    noisy = Events(*(column[order] for column in columns), events.size)
    found = estimate_camera(dataclasses.replace(recording, events=noisy), refine="off",
                            pixel="ideal")
    true = np.asarray(camera.eta_on) + extra
    rate, std = np.asarray(found.camera.eta_on), np.asarray(found.std.eta_on)
    assert np.corrcoef(rate.ravel(), true.ravel())[0, 1] > 0.25
    # Relative to the camera's rate, which the network without refinement finds half as high.
    away = np.abs(rate / rate.mean() - true / true.mean()) / (std / rate.mean())
    assert (away < 1.96).mean() > 0.85
    even = np.asarray(found.camera.eta_off)
    assert even.std() < 0.02 * even.mean()  # as its truth is


@pytest.mark.slow
def test_double_precision_changes_next_to_nothing(
    watched: tuple[Recording, Camera], measured: Found
) -> None:
    found, _ = measured
    with jax.enable_x64(True):
        again = estimate_camera(watched[0])
    for name in PARAMETERS:
        assert float(getattr(again.summary, name)) == pytest.approx(
            float(getattr(found.summary, name)), rel=0.02)


def test_saved_and_loaded(measured: Found, tmp_path: Path) -> None:
    found, _ = measured
    path = found.save(tmp_path / "camera.npz")
    loaded = Camera.load(path)
    np.testing.assert_array_equal(loaded.theta_off, found.camera.theta_off)
    with np.load(path) as data:
        assert {"theta_on_std", "eta_off_std", "valid", "n_events"} <= set(data)
    assert read_shared(path) == pytest.approx(found.shared_error)
    assert found.shared_error.keys() == set(PARAMETERS)
    for name, share in found.shared_error.items():  # a part of every pixel's own error
        relative = getattr(found.std, name) / getattr(found.camera, name)
        assert 0 < share < float(np.median(relative))
    with pytest.raises(EvflowDataError, match="EV013"):
        found.save(path)


@pytest.mark.parametrize("eta_off", [0.1, 1.5])  # .1: few OFF events; 1.5: hundreds, all noise
def test_a_fade_in_tells_the_threshold_of_on_alone(
    watched: tuple[Recording, Camera], eta_off: float
) -> None:
    """Brightness that only rises: OFF keeps the prior's width, ON is found within its own."""
    ms = np.arange(131)
    scene = np.asarray(watched[0].frames[0], np.float32) / 3 + 20
    frames = scene[None] * (1.0 + ms[:, None, None] / 100.0)
    camera = Camera.constant(SHAPE, theta_on=0.1, theta_off=0.5, eta_on=0.1, eta_off=eta_off)
    events = simulate(jax.random.key(1), frames, ms * 1000, camera)
    gray = np.rint(frames[20:121:25]).astype(np.uint8)
    found = estimate_camera(Recording(events, gray, ms[20:121:25] * 1000))
    assert 0.1 < float(found.summary_std.theta_off) < 0.2
    assert abs(float(found.summary.theta_off) - 0.5) < 2 * float(found.summary_std.theta_off)
    assert (np.asarray(found.std.theta_off) > 0.1).all()
    std_on = float(found.summary_std.theta_on)
    assert abs(float(found.summary.theta_on) - 0.1) < 2 * std_on < 0.05
    # No pixel stands still: nobody can tell ON noise from ON signal.
    assert float(found.summary_std.eta_on) > 0.3
    assert float(found.summary.eta_off) == pytest.approx(eta_off, rel=0.3)
    assert found.undetermined == ("theta_off",)
    assert "theta_off.undetermined" in [note.code for note in found.notes]


@pytest.mark.parametrize("refine", ["auto", "off"])
def test_polarity_without_events_is_said_to_be_undetermined(
    watched: tuple[Recording, Camera], refine: Literal["auto", "off"]
) -> None:
    """And what it did to the pixels' memory widens the other threshold."""
    events, camera = watched[0].events, watched[1]
    on = events.p
    only_on = Events(events.x[on], events.y[on], events.t[on], events.p[on], events.size)
    found = estimate_camera(dataclasses.replace(watched[0], events=only_on), refine=refine)
    assert found.undetermined == ("theta_off",)
    away = float(found.summary.theta_on) - float(jnp.median(camera.theta_on))
    assert abs(away) < 2 * float(found.summary_std.theta_on)
    assert float(found.summary_std.theta_on) > 0.2 * float(found.summary.theta_on)
    # No event in some hundred seconds of all pixels: no noise rate either.
    assert float(found.summary.eta_off) < 0.01
    assert float(found.summary_std.eta_off) <= float(found.summary.eta_off)


def test_a_hot_pixel_does_not_determine_a_threshold(watched: tuple[Recording, Camera]) -> None:
    """OFF is switched off, but one pixel sends OFF events at rest."""
    events = watched[0].events
    on = events.p
    t = np.arange(int(events.t[0]), int(events.t[-1]), 2000)
    columns = [np.concatenate([getattr(events, name)[on], more]) for name, more in (
        ("x", np.full(len(t), 7)), ("y", np.full(len(t), 9)), ("t", t), ("p", t < 0))]
    order = np.argsort(columns[2], kind="stable")
    hot = Events(*(column[order] for column in columns), events.size)
    found = estimate_camera(dataclasses.replace(watched[0], events=hot))
    assert found.hot[9, 7]
    assert float(found.camera.eta_off[9, 7]) == pytest.approx(500.0, rel=0.1)
    assert found.undetermined == ("theta_off",)
    assert any("theta_on was measured by itself" in note.text for note in found.notes)


def test_a_dead_pixel_is_listed(watched: tuple[Recording, Camera]) -> None:
    events = watched[0].events
    around = ndimage.median_filter(events.count_map().sum(0), 5)
    y, x = np.unravel_index(np.argmax(around), SHAPE)
    kept = ~((events.x == x) & (events.y == y))
    rest = Events(events.x[kept], events.y[kept], events.t[kept], events.p[kept], events.size)
    found = estimate_camera(dataclasses.replace(watched[0], events=rest), refine="off")
    assert found.dead[y, x]
    assert [int(x), int(y)] in found.as_dict()["dead_pixels"]
    assert "pixels.dead" in [note.code for note in found.notes]


def test_dead_pixels_here_and_there_are_no_sign_of_high_thresholds(
    watched: tuple[Recording, Camera]
) -> None:
    """A tenth of them made the network's OFF threshold .37. Where little moves they stay unseen."""
    recording, camera = watched
    events = recording.events
    dead = np.random.default_rng(0).random(SHAPE) < 0.1
    kept = ~dead[events.y, events.x]
    rest = Events(*(getattr(events, name)[kept] for name in "xytp"), events.size)
    found = estimate_camera(dataclasses.replace(recording, events=rest), refine="off").summary
    assert float(found.theta_off) == pytest.approx(float(jnp.median(camera.theta_off)), rel=0.05)
    assert float(found.theta_on) == pytest.approx(float(jnp.median(camera.theta_on)), rel=0.15)


def test_what_a_region_of_interest_leaves_out_changes_nothing(
    watched: tuple[Recording, Camera], measured: Found
) -> None:
    """Its silence is no sign of little noise, nor of high thresholds."""
    (recording, _), (whole, _) = watched, measured
    events, width = recording.events, SHAPE[1] // 2
    kept = events.x < width
    part = Events(*(a[kept] for a in (events.x, events.y, events.t, events.p)), events.size)
    found = estimate_camera(dataclasses.replace(recording, events=part))
    assert found.dead[:, width:].all()
    np.testing.assert_array_equal(found.dead[:, :width], whole.dead[:, :width])
    assert "pixels.dead" in [note.code for note in found.notes]
    for name in PARAMETERS:
        value, error = (float(getattr(s, name)) for s in (found.summary, found.summary_std))
        assert value == pytest.approx(float(getattr(whole.summary, name)), abs=2 * error)
        beyond = np.asarray(getattr(found.camera, name))[:, width:]
        np.testing.assert_allclose(beyond, value, rtol=1e-3)


def test_refusals(watched: tuple[Recording, Camera]) -> None:
    recording, params = watched[0], load_weights()
    bare = Recording.of_events(recording.events)
    for code, call in (
        ("EV011", lambda: estimate_camera(bare, params)),
        ("EV020", lambda: estimate_camera(recording, params, refine="always")),
        ("EV020", lambda: estimate_camera(recording, params, until=0.01)),
        ("EV016", lambda: estimate_camera("/nonexistent.aedat4", params)),
        ("EV020", lambda: estimate_camera(recording.events, params)),
    ):
        with pytest.raises(EvflowDataError, match=code):
            call()


@pytest.mark.slow
def test_a_real_davis346(data_file) -> None:
    """Newton's cradle: OFF above ON, and pixels that see more light than the frames show."""
    found = estimate_camera(
        data_file("data/recordings/newton_cradle_davis346.aedat4"))
    assert found.camera.shape == (260, 346)
    assert found.windows == 12
    open_ = found.receptor.theta_error  # as light and threshold trade
    for name, theta, least in zip(("theta_on", "theta_off"), (0.247, 0.286), open_, strict=True):
        value, error = (float(getattr(s, name)) for s in (found.summary, found.summary_std))
        assert value == pytest.approx(theta, abs=0.04)
        assert error > 0.75 * least * value > 0.0
    assert 10 < found.optics.offset_dn < 30
    assert "frames.light" in {note.code for note in found.notes}
