"""The compared systems on cases with known answers, and on recordings that tell nothing."""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from evflow import Recording, simulate
from evflow.baselines import SYSTEMS, Ecc, EccEvents, Fitted, Jaer, Solution, System
from evflow.baselines.base import THETA_MAX, UNKNOWN, intervals
from evflow.camera import THETA_MIN, Camera
from evflow.light.log_maps import lin_log_inverse
from evflow.types import Events

SHAPE = (16, 20)


def ramps(theta_on: float, theta_off: float, frames: int = 60, every: int = 25) -> Recording:
    """Pixels that brighten and darken at speeds of their own between 22 and 250 DN, by about .07 a
    frame of 25 ms; simulated at 1 kHz. every: ms between the frames."""
    rng = np.random.default_rng(0)
    t = np.arange(every * frames + 1)[:, None, None] * 1e-3
    hz, phase = rng.uniform(0.3, 0.8, SHAPE), rng.uniform(0, 1, SHAPE)
    wave = np.abs(2 * ((hz * t + phase) % 1.0) - 1)
    log_i = np.log(22) + (np.log(250) - np.log(22)) * wave
    video = np.asarray(lin_log_inverse(jnp.asarray(log_i, jnp.float32)))
    times = np.arange(len(video)) * 1000
    camera = Camera.constant(SHAPE, theta_on, theta_off)
    events = simulate(jax.random.key(0), video, times, camera)
    return Recording(events, video[::every], times[::every])


@pytest.fixture(scope="module")
def fine() -> Recording:
    return ramps(0.06, 0.09)


@pytest.mark.parametrize("system", [Ecc(span=8), Ecc("median", span=8), Ecc("global", span=8)])
def test_least_squares_recovers_the_thresholds_of_ramps(system: Ecc, fine: Recording) -> None:
    found = system.fit(fine)
    assert found.valid.mean() > 0.95
    np.testing.assert_allclose(found.theta, [0.06, 0.09], rtol=0.01)
    for seen, true in ((found.camera.theta_on, 0.06), (found.camera.theta_off, 0.09)):
        assert np.abs(np.asarray(seen)[found.valid.all(0)] - true).mean() < 0.04 * true


def test_an_offset_compresses_the_thresholds(fine: Recording) -> None:
    """log(DN + 40) has a slope of DN / (DN + 40): between .35 and .86 of the threshold here."""
    ratio = Ecc("median", span=8, offset_dn=40.0).fit(fine).theta / [0.06, 0.09]
    assert (ratio > 0.35).all()
    assert (ratio < 0.86).all()


def test_event_only_least_squares_tells_ratios() -> None:
    """Half of the pixels have half the threshold: same light, twice the walk."""
    rng, shape = np.random.default_rng(1), (16, 32)
    walk = np.cumsum(rng.normal(0, 0.15, (600, *shape)), 0)
    video = np.exp(np.clip(4.2 + walk - walk.mean(0), 3.1, 5.5)).astype(np.float32)
    theta = np.where(np.arange(32) < 16, 0.1, 0.2) * np.ones(shape)
    maps = (jnp.asarray(m, jnp.float32) for m in (theta, theta, 0 * theta, 0 * theta))
    times = np.arange(600) * 1000
    events = simulate(jax.random.key(0), video, times, Camera(*maps))
    found = EccEvents().fit(Recording(events, video[::10], times[::10]))
    mean = (np.asarray(found.camera.theta_on) + np.asarray(found.camera.theta_off)) / 2
    assert np.median(mean[:, 16:]) / np.median(mean[:, :16]) == pytest.approx(2.0, rel=0.15)
    alone = EccEvents().fit(Recording.of_events(events))
    assert alone.valid.mean() > 0.9


def test_tied_gains_converge() -> None:
    """With several events per frame, to the thresholds."""
    seen = ramps(0.02, 0.03)
    np.testing.assert_allclose(Jaer(passes=20).fit(seen).theta, [0.02, 0.03], rtol=0.01)
    normalised = Jaer(passes=100, normalised=True).fit(seen)
    np.testing.assert_allclose(normalised.theta, [0.02, 0.03], rtol=0.05)
    assert normalised.valid.all()


def test_tied_gains_that_are_stuck_are_refused() -> None:
    """Six events per frame from above the threshold: every step ends below zero. From below it,
    the same frames converge."""
    busy = ramps(0.01, 0.015)
    stuck = Jaer(passes=20).fit(busy)
    assert not stuck.valid[0].any()
    assert stuck.notes == ("ON did not converge",)
    np.testing.assert_allclose(Jaer(passes=20, start=0.005).fit(busy).theta, [0.01, 0.015],
                               rtol=0.02)


def test_tied_gains_know_no_more_than_a_frame_of_change() -> None:
    """Less than one event per frame: pixels without events do not vote, and what the others moved
    within the frame (.07) is taken for the threshold."""
    theta = Jaer(passes=50).fit(ramps(0.15, 0.25)).theta
    assert (theta > 0.05).all()
    assert (theta < 0.1).all()


def test_streamed_tied_update_is_the_update_of_the_maps(fine: Recording) -> None:
    """One pass, frame by frame on maps, as the published loop runs."""
    gains = np.array([0.2, 0.2])
    for part in intervals(fine):
        (on, off), d = part.counts.astype(float), part.after - part.before
        error = gains[0] * on - gains[1] * off - d
        for i, (n, sign) in enumerate(((on, 1.0), (off, -1.0))):
            moved = gains[i] - sign * 0.25 * error * n / np.maximum(on + off, 1)
            if (n > 0).any() and (mean := moved[n > 0].mean()) > 0:
                gains[i] = 0.9 * gains[i] + 0.1 * mean
    np.testing.assert_allclose(Jaer(passes=1).fit(fine).theta, gains, rtol=1e-4)


def test_untied_gains_refuse_to_diverge() -> None:
    """More than 8 events per frame: the loop gain passes 2. Normalised, nothing diverges."""
    busy = ramps(0.012, 0.012, frames=20, every=100)
    literal = Jaer(tied=False).fit(busy)
    assert "diverged" in literal.notes[0]
    assert literal.valid.mean() < 0.2
    assert np.isfinite(np.asarray(literal.camera.theta_on)).all()
    stable = Jaer(tied=False, normalised=True).fit(busy)
    assert stable.valid.mean() > 0.9
    assert not stable.notes


def silent(frames: np.ndarray) -> Recording:
    none = np.zeros(0, np.int64)
    events = Events(none, none, none, none, (frames.shape[2], frames.shape[1]))
    return Recording(events, frames, 25_000 * np.arange(len(frames)))


def few(frames: np.ndarray) -> Recording:
    """One pixel, ON alone, while nothing changes."""
    t = np.linspace(0, 25_000 * (len(frames) - 1), 30).astype(np.int64)
    same = np.full(len(t), 3)
    events = Events(same, same, t, np.ones(len(t), bool), (frames.shape[2], frames.shape[1]))
    return Recording(events, frames, 25_000 * np.arange(len(frames)))


FLAT = np.full((8, 16, 20), 100, np.uint8)
CASES = {"no events": silent(FLAT), "no frames": Recording.of_events(few(FLAT).events),
         "no change": few(FLAT), "black": few(0 * FLAT),
         "one frame": Recording(few(FLAT).events, FLAT[:1], np.zeros(1, int))}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("name", [n for n in SYSTEMS if n != "s2r"])
def test_what_tells_nothing_gives_a_defined_map(name: str, case: str) -> None:
    found = SYSTEMS[name].fit(CASES[case])
    assert isinstance(found, Fitted)
    assert found.seconds > 0
    assert found.valid.shape == (2, 16, 20)
    for value in (found.camera.theta_on, found.camera.theta_off, found.theta):
        values = np.asarray(value)
        assert ((values >= THETA_MIN) & (values <= THETA_MAX)).all()
    assert not found.valid[1].any()  # no OFF event anywhere


def test_a_spread_is_saved_as_the_deviation_of_pixels(tmp_path: Path) -> None:
    class Spread(System):
        def solve(self, recording: Recording) -> Solution:
            return Solution(np.full((2, 1, 2), 0.2), np.ones((2, 1, 2), bool), spread=(0.03, 0.05))

    Spread().fit(silent(np.full((2, 1, 2), 9, np.uint8))).save(tmp_path / "spread.npz")
    camera, std = Camera.load_with_std(tmp_path / "spread.npz")
    np.testing.assert_allclose(camera.theta_off, [[0.2, 0.2]])
    assert std is not None
    np.testing.assert_allclose(std.theta_on, [[0.03, 0.03]])
    np.testing.assert_allclose(std.theta_off, [[0.05, 0.05]])
    assert not np.asarray(std.eta_on).any()


def test_what_leaves_the_range_is_not_valid() -> None:
    class Wild(System):
        def solve(self, recording: Recording) -> Solution:
            theta = np.array([[[np.nan, 0.2]], [[1e9, -1.0]]], np.float32)
            return Solution(theta, np.ones((2, 1, 2), bool))

    found = Wild().fit(silent(np.full((2, 1, 2), 9, np.uint8)))
    np.testing.assert_array_equal(found.valid, [[[False, True]], [[False, False]]])
    np.testing.assert_allclose(found.camera.theta_on, [[UNKNOWN, 0.2]])
    np.testing.assert_allclose(found.camera.theta_off, [[THETA_MAX, THETA_MIN]])
    np.testing.assert_allclose(found.theta[0], 0.2)
