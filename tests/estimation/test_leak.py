"""Leak and shot noise told apart, on noise that is drawn here event by event, and by the simulator.
"""

from __future__ import annotations

import jax
import numpy as np
import pytest

from evflow import Camera, Events, Recording, SensorModel, simulate
from evflow.errors import EvflowDataError
from evflow.estimation.intervals import EDGES, QuietWaits, life_table, waits_at_rest
from evflow.estimation.leak import measured_leak
from evflow.estimation.pixel_noise import calm, quiet_time
from evflow.estimation.shot import at_mean_light, by_light, measured_shot, scatter
from evflow.estimation.static import estimate_noise, noise_over_light

SHAPE = (48, 64)
NONE_HOT = np.zeros(SHAPE, bool)


def drawn(
    leak_hz: float, on_hz: float, off_hz: float, seconds: float, running: bool = True,
    seed: int = 0, behind: float = 0.0,
) -> Events:
    """Noise of pixels whose rates differ by a third, their leak by a quarter; every event resets
    the memory. running: for long before; else since the beginning, with memories up to one
    threshold below and `behind` thresholds above the signal, if there is such a number."""
    rng, count = np.random.default_rng(seed), SHAPE[0] * SHAPE[1]
    uneven = rng.gamma(9.0, 1.0 / 9.0, count)
    period = np.exp(0.23 * rng.standard_normal(count)) / max(leak_hz, 1e-9)
    t = np.full(count, -3.0 / max(leak_hz, 0.1) if running else 0.0)
    last, active, found = t - running * rng.random(count) * period, np.arange(count), []
    if behind:
        last = rng.uniform(-1.0, behind, count) * period
    while len(active):
        wait = rng.exponential(1.0 / np.maximum((on_hz + off_hz) * uneven[active], 1e-9))
        leaks = np.maximum(last[active] + period[active], t[active])
        at = np.minimum(t[active] + wait, leaks)
        on = (at == leaks) | (rng.random(len(active)) < on_hz / max(on_hz + off_hz, 1e-9))
        kept = at < seconds
        active, at, on = active[kept], at[kept], on[kept]
        t[active] = last[active] = at
        found.append(np.stack([active, at * 1e6, on])[:, at >= 0])
    pixel, times, on = np.concatenate(found, 1)[:, np.argsort(np.concatenate(found, 1)[1])]
    return Events(pixel.astype(int) % SHAPE[1], pixel.astype(int) // SHAPE[1],
                  times.astype(np.int64), on.astype(bool), SHAPE[::-1])


@pytest.mark.parametrize(("leak_hz", "on_hz", "off_hz", "seconds", "running"), [
    (0.1, 0.1, 0.1, 15.0, True), (0.1, 0.1, 0.1, 15.0, False), (0.3, 0.3, 0.2, 2.0, True),
    (0.3, 1.0, 1.0, 10.0, True), (0.2, 0.0, 0.0, 4.0, True)])
def test_leak_is_measured_at_a_quarter_at_least(
    leak_hz: float, on_hz: float, off_hz: float, seconds: float, running: bool
) -> None:
    events = drawn(leak_hz, on_hz, off_hz, seconds, running)
    found = measured_leak(waits_at_rest(events, NONE_HOT, (0, round(seconds * 1e6))))
    assert found.events > 200
    assert found.hz == pytest.approx(leak_hz, rel=0.15)
    assert abs(found.hz - leak_hz) < 2.5 * found.std_hz < 0.25 * leak_hz


@pytest.mark.parametrize("behind", [0.5, 0.8, 1.5])
def test_leak_shows_in_what_follows_where_moving_things_left_memories_behind(behind: float) -> None:
    """The first leak event of a pixel then comes after up to 1 + behind periods."""
    events = drawn(0.3, 0.05, 0.05, 10.0, running=False, behind=behind)
    found = measured_leak(waits_at_rest(events, NONE_HOT, (0, 10_000_000)))
    assert found.events > 200
    assert abs(found.hz - 0.3) < 2.5 * found.std_hz < 0.075


@pytest.mark.parametrize(("leak_hz", "on_hz", "off_hz", "seconds", "running"), [
    (0.0, 0.4, 0.1, 4.0, True), (0.0, 0.2, 0.2, 4.0, True),  # none
    (0.3, 2.5, 2.5, 3.0, True),  # memories are reset before it comes
    (0.1, 0.2, 0.2, 1.0, True), (0.3, 0.2, 0.2, 1.5, False)])  # too few leak
def test_where_leak_cannot_be_told_nothing_is_said(
    leak_hz: float, on_hz: float, off_hz: float, seconds: float, running: bool
) -> None:
    events = drawn(leak_hz, on_hz, off_hz, seconds, running)
    found = measured_leak(waits_at_rest(events, NONE_HOT, (0, round(seconds * 1e6))))
    assert found.hz == 0
    assert np.isnan(found.std_hz)


def test_regular_events_that_leak_does_not_explain_are_not_called_so() -> None:
    """Both polarities at intervals of their own, as real pixels in some light: no leak."""
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.gamma(6.0, 0.1, (SHAPE[0] * SHAPE[1], 12)), 1)
    on = rng.random(t.shape) < np.clip(1.6 - 2.0 * np.diff(t, axis=1, prepend=0.0), 0.1, 0.9)
    pixel = np.broadcast_to(np.arange(len(t))[:, None], t.shape)
    order = np.argsort(t, axis=None)
    x, y = pixel.ravel()[order] % SHAPE[1], pixel.ravel()[order] // SHAPE[1]
    events = Events(x, y, (t.ravel()[order] * 1e6).astype(np.int64), on.ravel()[order], SHAPE[::-1])
    assert measured_leak(waits_at_rest(events, NONE_HOT)).hz == 0


def test_a_life_table_holds_all_waits() -> None:
    waits, ended = np.array([0.0005, 0.01, 0.5, 0.5, 3.0]), np.array([1, 2, 0, 1, 0])
    seconds, on, off = life_table(waits, ended)
    assert seconds.sum() == pytest.approx(waits.sum())
    at = [np.searchsorted(EDGES, w, side="right") - 1 for w in waits]
    assert on[at[0]] == on[at[2]] == off[at[1]] == 1
    assert on.sum() == 2
    assert off.sum() == 1
    assert not seconds[at[4] + 1:].any()


def test_waits_window_by_window_are_those_of_the_whole_where_all_is_quiet() -> None:
    events = drawn(0.0, 0.5, 0.5, 2.0)
    quiet, whole = QuietWaits(SHAPE), waits_at_rest(events, NONE_HOT, (0, 2_000_000))
    for begin in range(0, 2_000_000, 250_000):
        span = begin, begin + 250_000
        quiet.add(events.slice(*span), span, ~NONE_HOT)
    np.testing.assert_allclose(quiet.table().own, whole.own, rtol=1e-6, atol=1e-6)


def test_what_happens_near_by_ends_a_wait() -> None:
    quiet, still = QuietWaits(SHAPE), ~NONE_HOT
    events = Events(np.array([3, 3]), np.array([2, 2]), np.array([10_000, 260_000]),
                    np.array([True, False]), SHAPE[::-1])
    for begin, rests in ((0, True), (100_000, False), (200_000, True)):
        span = begin, begin + 100_000
        quiet.add(events.slice(*span), span, still if rests else NONE_HOT)
    seconds, on, off = quiet.table().own
    assert seconds.sum() == pytest.approx(0.09 + 0.04)
    assert on.sum() == off.sum() == 0


def light(rate: np.ndarray, seconds: float = 4.0) -> tuple[np.ndarray, np.ndarray]:
    """Light (H, W) from black to white, and quiet (2, 2, H, W) of noise with this rate of I01."""
    dn = np.broadcast_to(np.linspace(0.0, 255.0, SHAPE[1]), SHAPE)
    sent = np.random.default_rng(0).poisson(rate((dn + 20.0) / 275.0) * seconds, (2, *SHAPE))
    return dn, np.stack([np.stack([n, np.full(SHAPE, seconds)]) for n in sent])


def test_shot_noise_is_that_of_the_dark_if_it_falls_with_light() -> None:
    dn, quiet = light(lambda i01: 0.5 * 3.0 * (1.0 - 0.75 * i01))
    found = measured_shot(by_light(quiet, dn, NONE_HOT), 0.0, scatter(quiet, NONE_HOT))
    assert abs(found.hz - 3.0) < 2.5 * found.std_hz < 0.25
    assert found.falls
    assert not found.even
    dn, quiet = light(lambda i01: 0.5 + 0.0 * i01)
    found = measured_shot(by_light(quiet, dn, NONE_HOT), 0.0, scatter(quiet, NONE_HOT))
    assert found.even
    assert not found.falls
    assert found.hz == 0
    few = measured_shot(0.01 * by_light(quiet, dn, NONE_HOT), 0.0, 1.0)
    assert (few.hz, few.even) == (0.0, False)


def test_of_a_polarity_that_is_never_quiet_no_law_of_noise_is_known() -> None:
    dn, quiet = light(lambda i01: 0.5 * 3.0 * (1.0 - 0.75 * i01))
    quiet[1] = 0.0
    with np.errstate(all="raise"):
        found = measured_shot(by_light(quiet, dn, NONE_HOT), 0.0, scatter(quiet, NONE_HOT))
    assert (found.hz, found.even, found.falls) == (0.0, False, False)
    assert np.isnan(found.std_hz)


def test_leak_that_is_not_told_apart_is_not_taken_for_shot_noise() -> None:
    dn, quiet = light(lambda i01: 0.5 * 3.0 * (1.0 - 0.75 * i01))
    quiet[0, 0] += np.random.default_rng(1).poisson(4.0, SHAPE)  # 1 Hz of ON, in any light
    found = measured_shot(by_light(quiet, dn, NONE_HOT), 0.0, scatter(quiet, NONE_HOT))
    assert not found.even
    assert found.hz == pytest.approx(3.0, rel=0.05)
    assert 0.1 < found.std_hz / found.hz < 0.5


def test_calm_pixels_have_no_more_company_than_noise_sends() -> None:
    counts = np.random.default_rng(0).poisson(0.01, (2, *SHAPE))
    counts[0, 20, 20:40] += 3
    place = np.zeros(SHAPE, np.float32), ~NONE_HOT, NONE_HOT, 0.04, np.array([0.25, 0.25])
    found = calm(counts, *place)
    assert not found[20, 22:38].any()
    assert found[30:].mean() > 0.99  # where quiet_time takes about half
    assert (quiet_time(counts, *place)[:, 1] > 0).all(0)[30:].mean() < 0.6


def test_the_simulator_s_leak_and_shot_noise_are_found() -> None:
    sensor = SensorModel(leak_hz=0.3, leak_jitter=0.1, leak_fpn_decades=0.1, shot_hz=0.5,
                         noise_resets_memory=True)
    frame = np.broadcast_to(np.linspace(0.0, 255.0, 64).astype(np.uint8), SHAPE)
    frames, times = np.repeat(frame[None], 41, 0), 250_000 * np.arange(41)
    events = simulate(jax.random.key(0), frames, times, Camera.constant(SHAPE), model=sensor)
    found = estimate_noise(Recording(events, frames, times))
    for name in ("leak_hz", "shot_hz"):
        truth, value = getattr(sensor, name), getattr(found.sensor, name)
        assert value == pytest.approx(truth, rel=0.1)
        assert abs(value - truth) < 2.5 * found.sensor_std[name] < 0.25 * truth
    assert {"sensor_leak_hz", "sensor_shot_hz_std"} <= set(found.as_dict())


@pytest.mark.parametrize("leak_hz", [0.0, 0.2])
def test_noise_of_bright_places_is_that_of_the_mean_light_once_it_falls(leak_hz: float) -> None:
    """Where all is dark but what rests, its own rate would be half of what the camera sends."""
    dn, quiet = light(lambda i01: 0.5 * 3.0 * (1.0 - 0.75 * i01) + leak_hz, seconds=40.0)
    quiet[:, :, dn < 128] = 0.0
    histogram = by_light(quiet, dn, NONE_HOT)
    own = histogram[:, 0].sum(-1) / histogram[:, 1].sum(-1)
    factor = 0.9
    eta, std = at_mean_light(own, 0.05 * own, histogram, leak_hz, factor, 0.02)
    expected = 0.5 * 3.0 * factor + leak_hz
    assert own[0] < 0.65 * expected
    assert eta[0] == pytest.approx(expected, rel=0.05)
    assert abs(eta[0] - expected) < 3.0 * std[0] < 0.15
    certain, _ = at_mean_light(own, 1e-4 * own, histogram, leak_hz, float(
        histogram[0, 2].sum() / histogram[0, 1].sum()), 0.02)
    assert certain[0] == pytest.approx(own[0], rel=1e-3)  # as bright as all: nothing changes


def test_frames_that_begin_long_before_the_events_are_no_time_at_rest() -> None:
    sensor = SensorModel(leak_hz=0.3, leak_jitter=0.1, shot_hz=0.5, noise_resets_memory=True)
    frame = np.full(SHAPE, 100, np.uint8)
    frames, times = np.repeat(frame[None], 41, 0), 250_000 * np.arange(41)
    events = simulate(jax.random.key(0), frames, times, Camera.constant(SHAPE), model=sensor)
    found, early = (estimate_noise(Recording(events, frames, begin)) for begin in (
        times, np.concatenate([[-10_000_000], times[1:]])))
    assert early.sensor.leak_hz == pytest.approx(found.sensor.leak_hz, rel=0.01)
    with pytest.raises(EvflowDataError, match="EV012"):
        estimate_noise(Recording(events, frames, times + 1_700_000_000_000_000))


@pytest.mark.parametrize("hot_hz", [0.0, 50.0])
def test_noise_of_a_scene_at_rest_is_simulated_as_it_was_recorded(hot_hz: float) -> None:
    """From dark to bright columns, beside hot pixels: to 4 %, four sd of 12,000 events."""
    frame = np.tile(np.linspace(2, 250, 80), (60, 1)).astype(np.uint8)
    frames, times = np.repeat(frame[None], 301, 0), 100_000 * np.arange(301)
    hot = np.zeros(frame.shape, np.float32)
    hot[5::20, 3::20] = hot_hz
    camera = Camera(*np.full((2, *hot.shape), 0.2, np.float32), hot, hot)
    events = simulate(jax.random.key(0), frames, times, camera,
                      model=SensorModel(shot_hz=2.0, noise_resets_memory=True))
    found = estimate_noise(Recording(events, frames[::50], times[::50]))
    again = simulate(jax.random.key(1), frames, times, found.camera, model=found.sensor)
    seen, made = (np.where(hot > 0, 0, e.count_map().sum(0)).reshape(60, 4, 20).sum((0, 2))
                  for e in (events, again))
    np.testing.assert_allclose(made, seen, rtol=0.05)
    seen, made = (e.count_map().sum(0)[hot > 0].sum() for e in (events, again))
    assert made == pytest.approx(seen, rel=0.05)


@pytest.mark.parametrize("falls", [True, False])
def test_levels_of_light_tell_whether_noise_falls_with_it(falls: bool) -> None:
    """Of one uniform level nothing tells, and a note says so, until the others are known."""
    found, times = [], 250_000 * np.arange(41)
    for number, (dn, lux) in enumerate(((25, 5.0), (100, 80.0), (220, 1500.0))):
        model = SensorModel(shot_hz=1.0 if falls else 0.0, noise_resets_memory=True)
        frames = np.full((41, *SHAPE), dn, np.uint8)
        rate = 0.0 if falls else 0.2
        events = simulate(jax.random.key(number), frames, times,
                          Camera.constant(SHAPE, 0.2, 0.2, rate, rate), model=model)
        found.append(estimate_noise(Recording(events, frames, times), lux=lux))
        assert found[-1].sensor.shot_hz > 0
        assert "noise.assumed" in [note.code for note in found[-1].notes]
    together = noise_over_light(found[::-1])
    codes = [note.code for note in together.notes]
    if falls:
        assert together.sensor.shot_hz == pytest.approx(1.0, rel=0.1)
    else:
        assert together.sensor.shot_hz == 0
        assert np.isnan(together.sensor_std["shot_hz"])
        assert "noise.even" in codes
    assert "noise.assumed" not in codes
