"""Noise of scenes at rest that are uneven, interrupted or drifting."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from evflow import Recording, simulate
from evflow.camera import Camera
from evflow.camera.sensors import SensorModel
from evflow.estimation.static import estimate_noise, noise_over_light
from evflow.types import Events

SIZE = (80, 60)  # width, height
PIXELS = SIZE[0] * SIZE[1]


def at_random(
    hz: np.ndarray | float, seconds: float, seed: int = 0, on: float = 0.5
) -> Events:
    """Poisson events of pixels with rates hz, (H, W) or one."""
    rng = np.random.default_rng(seed)
    counts = rng.poisson(np.broadcast_to(hz, SIZE[::-1]).ravel() * seconds)
    pixel = np.repeat(np.arange(PIXELS), counts)
    t = rng.uniform(0.0, 1e6 * seconds, pixel.size).astype(np.int64)
    order = np.argsort(t)
    return Events(pixel[order] % SIZE[0], pixel[order] // SIZE[0], t[order],
                  rng.random(pixel.size) < on, SIZE)


def kept(events: Events, mask: np.ndarray) -> Events:
    return Events(*(getattr(events, n)[mask] for n in ("x", "y", "t", "p")), events.size)


@pytest.mark.parametrize("shot_hz", [0.3, 1.0])
def test_noise_beside_leak_is_simulated_as_it_was_recorded_in_every_light(shot_hz: float) -> None:
    """Leak does not fall with light as shot noise does, and shows less where that is frequent."""
    dn = np.where(np.arange(SIZE[0]) < SIZE[0] // 2, 10, 240)
    frames = np.broadcast_to(dn.astype(np.uint8), (601, *SIZE[::-1]))
    times = 100_000 * np.arange(601)
    circuit = SensorModel(shot_hz=shot_hz, leak_hz=0.3, leak_fpn_decades=0.05,
                          noise_resets_memory=True)
    events = simulate(jax.random.key(0), frames, times, Camera.constant(SIZE[::-1], 0.2, 0.2),
                      model=circuit)
    found = estimate_noise(Recording(events, frames[::100], times[::100]))
    assert found.sensor.leak_hz == pytest.approx(0.3, rel=0.1)
    assert found.sensor.shot_hz == pytest.approx(shot_hz, rel=0.05)
    again = simulate(jax.random.key(1), frames, times, found.camera, model=found.sensor)
    for side in range(2):
        seen, made = (e.count_map()[side].reshape(60, 2, 40).sum((0, 2)) for e in (events, again))
        np.testing.assert_allclose(made, seen, rtol=0.08)


def test_hot_pixels_are_as_hot_in_any_light() -> None:
    """They were given v2e's law of shot noise: two to three times as much in the dark."""
    dn = np.where(np.arange(SIZE[0]) < SIZE[0] // 2, 10, 240)
    frames = np.broadcast_to(dn.astype(np.uint8), (11, *SIZE[::-1]))
    factor = 1.0 - 0.75 * (dn + 20.0) / 275.0
    hz = np.broadcast_to(factor / factor.mean(), SIZE[::-1]).copy()
    hot = np.zeros(SIZE[::-1], bool)
    hot[10:50:10, [20, 60]] = True
    hz[hot] = 60.0
    times = 2_000_000 * np.arange(11)
    found = estimate_noise(Recording(at_random(hz, 20.0), frames, times))
    np.testing.assert_array_equal(found.hot, hot)
    assert found.sensor.shot_hz > 0
    for level in (5, 250):
        shown = np.full((101, *SIZE[::-1]), level, np.uint8)
        made = simulate(jax.random.key(0), shown, 50_000 * np.arange(101), found.camera,
                        model=found.sensor)
        assert made.count_map().sum(0)[hot].mean() == pytest.approx(300.0, rel=0.06)


@pytest.mark.parametrize(("hz", "gaps", "lost"), [
    (0.4, 30, 0.1), (0.4, 30, 0.5), (2.0, 2, 0.3), (0.1, 9, 0.2)])
def test_lost_packets_are_no_time_of_observation(hz: float, gaps: int, lost: float) -> None:
    events = at_random(hz, 20.0)
    begins = np.linspace(0.3, 19.0, gaps, endpoint=False)
    inside = [(events.t > 1e6 * b) & (events.t < 1e6 * (b + 20.0 * lost / gaps)) for b in begins]
    found = estimate_noise(Recording.of_events(kept(events, ~np.any(inside, 0))))
    assert "events.gaps" in [note.code for note in found.notes]
    for side in ("on", "off"):
        away = float(getattr(found.summary, f"eta_{side}")) - 0.5 * hz
        assert abs(away) < 4 * float(getattr(found.summary_std, f"eta_{side}"))


def test_steady_noise_has_no_gaps_beside_a_hot_pixel_that_pauses() -> None:
    events, loud = at_random(0.02, 20.0), np.zeros(SIZE[::-1])
    loud[30, 40] = 2000.0
    loud = at_random(loud, 20.0)
    parts = events, kept(loud, loud.t % 2_000_000 < 1_000_000)
    order = np.argsort(np.concatenate([part.t for part in parts]), kind="stable")
    both = Events(*(np.concatenate([getattr(part, n) for part in parts])[order]
                    for n in ("x", "y", "t", "p")), SIZE)
    found = estimate_noise(Recording.of_events(both))
    assert "events.gaps" not in [note.code for note in found.notes]
    assert float(found.summary.eta_on) == pytest.approx(0.01, rel=0.1)


def test_silent_areas_are_dead() -> None:
    hz = np.ones(SIZE[::-1])
    y, x = np.mgrid[:60, :80]
    hz[(x - 40) ** 2 + (y - 30) ** 2 > 35**2] = 0.0
    found = estimate_noise(Recording.of_events(at_random(hz, 20.0)))
    np.testing.assert_array_equal(found.dead, hz == 0)
    assert float(found.summary.eta_on) == pytest.approx(0.5, rel=0.02)


def test_rates_that_drift_are_no_motion() -> None:
    events = at_random(8.0, 5.0)
    rising = np.random.default_rng(1).random(len(events)) < 0.25 + 0.75 * events.t / 5e6
    found = estimate_noise(Recording.of_events(kept(events, rising)))
    assert float(found.summary.eta_on) == pytest.approx(0.625 * 4.0, rel=0.02)


def test_noise_that_is_on_without_regular_intervals_is_noted() -> None:
    found = estimate_noise(Recording.of_events(at_random(0.5, 40.0, on=0.85)))
    assert (found.sensor.leak_hz, "noise.on" in [n.code for n in found.notes]) == (0.0, True)
    even = estimate_noise(Recording.of_events(at_random(0.5, 40.0)))
    assert "noise.on" not in [n.code for n in even.notes]


def test_noise_that_falls_with_light_that_no_frames_show_is_noted() -> None:
    dark, bright = (estimate_noise(Recording.of_events(at_random(hz, 20.0)), lux=lux)
                    for hz, lux in ((1.0, 5.0), (0.2, 500.0)))
    assert "noise.unlit" in [n.code for n in noise_over_light([dark, bright]).notes]
    assert "noise.unlit" not in [n.code for n in noise_over_light([dark, dark]).notes]


def test_leak_is_that_of_the_light_that_shows_it() -> None:
    """Among much shot noise in the dark it is not seen."""
    times, found = 250_000 * np.arange(121), []
    for number, (dn, shot) in enumerate(((20, 4.0), (220, 0.1))):
        frames = np.full((121, *SIZE[::-1]), dn, np.uint8)
        circuit = SensorModel(leak_hz=0.2, leak_fpn_decades=0.05, shot_hz=shot,
                              noise_resets_memory=True)
        events = simulate(jax.random.key(number), frames, times,
                          Camera.constant(SIZE[::-1], 0.2, 0.2), model=circuit)
        found.append(estimate_noise(Recording(events, frames, times), lux=float(dn)))
    assert (found[0].sensor.leak_hz, found[1].sensor.leak_hz) == (0.0, pytest.approx(0.2, rel=0.1))
    joined = noise_over_light(found)
    assert joined.sensor.leak_hz == found[1].sensor.leak_hz
    assert joined.sensor.shot_eta_hz < found[0].sensor.shot_eta_hz
