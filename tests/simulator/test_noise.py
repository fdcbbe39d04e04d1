"""Noise: rates per polarity on still scenes, whatever the frame rate; the leak; the counts.

A rate is held to 2 % of nominal where at least 40,000 events make that four standard deviations.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.videos import by_pixel

from evflow.camera import Camera, CameraPrior
from evflow.camera.leak import without_leak
from evflow.camera.sensors import SecondOrder, SensorModel
from evflow.simulator import simulate, simulate_counts
from evflow.simulator.constants import Constants
from evflow.simulator.noise import (
    cosine,
    draw,
    event,
    further,
    nominal_thresholds,
    pixel_words,
    poisson,
    rates,
    salts,
    uniform,
)
from evflow.types import Events

SHAPE = (64, 64)
LEVELS = np.array([5.0, 50.0, 128.0, 200.0])  # DN of four vertical bands of 1024 pixels
I01 = (LEVELS + 20.0) / 275.0
BANDS = np.repeat(LEVELS, 16)[None, :].repeat(64, 0).astype(np.float32)
ETA = SensorModel()
SHOT = SensorModel(shot_hz=300.0)


@functools.cache
def still(model: SensorModel, eta: tuple[float, float], seconds: float, dt_us: int = 10_000,
          theta: tuple[float, float] = (0.2, 0.2)) -> Events:
    """What a uniform camera sees of the four bands, standing still."""
    times = np.arange(0, round(seconds * 1e6) + 1, dt_us)
    frames = np.broadcast_to(BANDS, (len(times), *SHAPE))
    camera = Camera.constant(SHAPE, *theta, *eta)
    return simulate(jax.random.key(2), frames, times, camera, model=model)


def band_rates(events: Events, seconds: float) -> np.ndarray:
    """Hz per pixel, (2 polarities, 4 bands); each from at least 40,000 events."""
    counts = events.count_map().astype(float).reshape(2, 64, 4, 16).sum((1, 3))
    assert counts.min() >= 40_000
    return counts / (1024 * seconds)


@pytest.mark.parametrize("dt_us", [1_000, 10_000])
def test_eta_is_the_rate_of_each_polarity_at_any_frame_rate(dt_us: int) -> None:
    counts = still(ETA, (110.0, 50.0), 0.2, dt_us).count_map().reshape(2, -1)
    assert counts.sum(1).min() >= 40_000
    np.testing.assert_allclose(counts.sum(1) / (4096 * 0.2), [110.0, 50.0], rtol=0.02)
    # A Poisson count varies as its mean: the variance over 4096 pixels has a 2.2 % sd.
    np.testing.assert_allclose(counts.var(1), counts.mean(1), rtol=0.09)
    assert abs(np.corrcoef(counts)[0, 1]) < 4 / 64


def test_one_polarity_may_be_silent() -> None:
    events = still(ETA, (0.0, 30.0), 0.5)
    assert len(events) > 50_000
    assert not events.p.any()


@pytest.mark.parametrize(("timestamps", "resets"), [("crossing", False), ("v2e", True)])
def test_shot_noise_falls_with_intensity(timestamps: str, resets: bool) -> None:
    """v2e's rate R/2 ((F-1) I01 + 1) per polarity, at four intensities."""
    model = dataclasses.replace(SHOT, timestamps=timestamps, noise_resets_memory=resets)
    rates = band_rates(still(model, (0.0, 0.0), 0.7), 0.7)
    np.testing.assert_allclose(rates, np.tile(150.0 * (1 - 0.75 * I01), (2, 1)), rtol=0.02)


@pytest.mark.parametrize("resets", [False, True])
def test_eta_follows_intensity_relative_to_the_mean_of_the_first_frame(resets: bool) -> None:
    model = SensorModel(eta_intensity=True, noise_resets_memory=resets)
    rates = band_rates(still(model, (140.0, 100.0), 0.7), 0.7)
    factor = (1 - 0.75 * I01) / (1 - 0.75 * I01.mean())
    np.testing.assert_allclose(rates, np.outer([140.0, 100.0], factor), rtol=0.02)


def test_shot_noise_grows_where_the_threshold_is_low_and_adds_to_eta() -> None:
    """v2e divides by theta / nominal. Left half .1, right half .3: the median is .2."""
    theta = jnp.where(jnp.arange(64) < 32, 0.1, 0.3)[None, :].repeat(64, 0)
    eta = jnp.full(SHAPE, 10.0)
    frames = np.full((41, *SHAPE), 117.5, np.float32)  # I01 = .5
    events = simulate(jax.random.key(3), frames, 10_000 * np.arange(41),
                      Camera(theta, theta, eta, eta), model=SHOT)
    counts = events.count_map().reshape(2, 64, 2, 32).sum((1, 3))
    expected = 10.0 + 150.0 * 0.625 * 0.2 / np.array([0.1, 0.3])
    np.testing.assert_allclose(counts / (2048 * 0.4), np.tile(expected, (2, 1)), rtol=0.02)


def test_noise_is_uniform_in_time_and_memoryless() -> None:
    """Gaps between the events of a pixel are exponential (rate 160 Hz), seen through 0.2 s."""
    rate, seconds = 160.0, 0.2
    events = still(ETA, (110.0, 50.0), seconds, 1000)
    counts = np.histogram((events.t - 1) % 1000, 20, (0, 1000))[0]
    expected = len(events) / 20
    assert ((counts - expected) ** 2 / expected).sum() < 19 + 5 * np.sqrt(2 * 19)  # chi-squared
    pixel, t, _ = by_pixel(events)
    gaps = np.diff(t)[np.diff(pixel) == 0] * 1e-6

    def pairs(g: float) -> float:
        """Integral of exp(-rate s) (seconds - s) from 0 to g: gaps that fit into the record."""
        e = np.exp(-rate * g)
        return seconds * (1 - e) / rate - (1 - e * (1 + rate * g)) / rate**2

    for g in (0.003, 0.01, 0.03):
        assert (gaps < g).mean() == pytest.approx(pairs(g) / pairs(seconds), rel=0.02)


def test_a_noise_event_resets_the_memory_only_where_asked() -> None:
    """A slow ramp of 1.1 log units in 1 s under 100 + 100 Hz of noise: five signal events per
    pixel without the reset, on top of the very same noise; none with it."""
    log = np.log(30.0) + 1.1 * np.linspace(0, 1, 101)
    frames = np.exp(log)[:, None, None] * np.ones((1, *SHAPE), np.float32)
    times = 10_000 * np.arange(101)
    quiet = still(ETA, (100.0, 100.0), 1.0)  # 100 frame intervals, as below
    camera = Camera.constant(SHAPE, 0.2, 0.2, 100.0, 100.0)
    added = simulate(jax.random.key(2), frames.astype(np.float32), times, camera)
    np.testing.assert_array_equal(added.count_map() - quiet.count_map(),
                                  np.array([5, 0])[:, None, None] * np.ones(SHAPE))
    reset = simulate(jax.random.key(2), frames.astype(np.float32), times, camera,
                     model=SensorModel(noise_resets_memory=True))
    np.testing.assert_array_equal(reset.count_map(), quiet.count_map())


def leaks(model: SensorModel, seed: int = 4) -> Events:
    """1 s of a still scene, thresholds around .1 to .5 with mismatch .1."""
    camera = Camera.sample(jax.random.key(5), SHAPE, CameraPrior(mismatch=(0.1, 0.1), noise="none"))
    frames = np.broadcast_to(BANDS, (101, *SHAPE))
    return simulate(jax.random.key(seed), frames, 10_000 * np.arange(101), camera, model=model)


def test_leak_is_on_events_at_its_rate_whatever_the_threshold() -> None:
    """50 Hz over 1 s: an event every 20 ms; the 50th may fall beyond the end by rounding."""
    events = leaks(SensorModel(leak_hz=50.0))
    assert events.p.all()
    counts = events.count_map()[0]
    assert set(np.unique(counts)) <= {49, 50}
    pixel, t, _ = by_pixel(events)
    gaps = np.diff(t)[np.diff(pixel) == 0]
    np.testing.assert_allclose(gaps, 20_000, atol=20)


@pytest.mark.parametrize("photoreceptor", [None, SecondOrder().at(200.0)])
def test_leak_too_small_for_float32_is_carried_on(photoreceptor: SecondOrder | None) -> None:
    """2e-7 an interval, where a memory of 5.3 holds steps of 4.8e-7."""
    frames, times = np.full((25_001, 1, 1), 200, np.uint8), 100 * np.arange(25_001)
    camera = Camera.constant((1, 1), 0.002, 0.002)
    model = SensorModel(leak_hz=1.0, photoreceptor=photoreceptor)
    events = simulate(jax.random.key(0), frames, times, camera, model=model)
    np.testing.assert_allclose(events.t, [1_000_000, 2_000_000], rtol=1e-3)
    counts = simulate_counts(jax.random.key(0), frames, camera, frame_dt_s=1e-4, model=model)
    np.testing.assert_array_equal(counts.ravel(), [2.0, 0.0])
    if photoreceptor is None:  # contrast stays where the ramp of width .2 begins, at .9
        smooth = simulate_counts(jax.random.key(0), frames, camera, frame_dt_s=1e-4, model=model,
                                 smooth=0.2)
        np.testing.assert_allclose(smooth.ravel(), [2.5 - 0.9, 0.0], atol=0.01)


def test_noise_ignores_the_dead_time() -> None:
    """As the help of --refractory-s says."""
    dead, free = (still(SensorModel(refractory_s=s), (20.0, 10.0), 0.5) for s in (0.05, 0.0))
    for name in ("x", "y", "t", "p"):
        np.testing.assert_array_equal(getattr(dead, name), getattr(free, name))
    assert min(np.diff(t)[np.diff(pixel) == 0].min() for pixel, t, _ in [by_pixel(dead)]) < 1000


def test_leak_is_a_part_of_eta_that_is_all_noise() -> None:
    model = SensorModel(leak_hz=8.0, eta_is_all=True, noise_resets_memory=True)
    on, off = still(model, (12.0, 6.0), 4.0).count_map().reshape(2, -1).mean(1) / 4.0
    assert on == pytest.approx(12.0, rel=0.03)  # of which leak is 4 Hz: the others reset it
    assert off == pytest.approx(6.0, rel=0.02)
    alone = without_leak(np.float64(12.0), np.float64(6.0), 8.0)
    assert 12.0 - alone == pytest.approx((alone + 6.0) / np.expm1((alone + 6.0) / 8.0), rel=1e-3)


@pytest.mark.parametrize("resets", [False, True])
def test_leak_of_a_measured_camera_has_run_before(resets: bool) -> None:
    """Half a period of the leak has as much of it as any other, at no time more than at others."""
    model = SensorModel(leak_hz=2.0, eta_is_all=True, noise_resets_memory=resets)
    events = still(model, (3.0, 1.0), 0.25)
    assert events.p.sum() / 4096 / 0.25 == pytest.approx(3.0, rel=0.07)  # 3,072, to 4 sd
    counts = np.histogram(events.t[events.p], 10, (0, 250_000))[0]
    np.testing.assert_allclose(counts, 307, atol=80)
    counts = simulate_counts(
        jax.random.key(2), np.broadcast_to(BANDS, (26, *SHAPE)).astype(np.uint8),
        Camera.constant(SHAPE, 0.2, 0.2, 3.0, 1.0), frame_dt_s=0.01, model=model)
    np.testing.assert_array_equal(counts, np.moveaxis(events.count_map(), 0, -1))
    alone = still(SensorModel(leak_hz=2.0, noise_resets_memory=resets), (0.0, 0.0), 0.49)
    assert len(alone) == 0  # v2e's begins with the video


def test_eta_that_is_all_noise_follows_light_where_there_is_shot_noise() -> None:
    """As much of it in all as shot_hz says, as uneven as eta is."""
    model = Constants.of(SensorModel(shot_hz=6.0, eta_is_all=True))
    uneven = jnp.asarray(np.random.default_rng(0).gamma(4.0, 0.25, (8, 8)), jnp.float32)
    camera = Camera(0.2 * jnp.ones((8, 8)), 0.2 * jnp.ones((8, 8)), 2.0 * uneven, uneven)
    nominal = nominal_thresholds(model, camera)
    for i01, factor in ((0.1, 0.925), (1.0, 0.25)):
        on, off = rates(model, camera, jnp.float32(0.5), nominal).at(jnp.float32(i01))
        assert float((on + off).mean()) == pytest.approx(6.0 * factor, rel=1e-5)
        np.testing.assert_allclose(on, 2.0 * off, rtol=1e-5)
        np.testing.assert_allclose(off / off.mean(), uneven / uneven.mean(), rtol=1e-5)


def test_hot_pixels_and_crops_leave_the_measured_noise_of_others_alone() -> None:
    """A rate is shot_hz / shot_eta_hz times the pixel's own eta, whatever its neighbours'; a hot
    pixel's its own, in any light."""
    model = Constants.of(SensorModel(shot_hz=2.0, shot_eta_hz=0.5, eta_is_all=True))
    eta = np.full((8, 8), 0.5, np.float32)
    eta[0, 0] = 50.0

    def at(eta: np.ndarray, i01: float = 0.0) -> np.ndarray:
        camera = Camera(*np.full((2, *eta.shape), 0.2, np.float32), eta, eta)
        seen = rates(model, camera, jnp.float32(0.5), nominal_thresholds(model, camera))
        return np.asarray(sum(seen.at(jnp.float32(i01))))

    dark = np.where(eta == 50.0, 100.0, 2.0)
    np.testing.assert_allclose(at(eta), dark, rtol=1e-6)
    np.testing.assert_allclose(at(eta, 1.0), np.where(eta == 50.0, 100.0, 0.25 * dark), rtol=1e-6)
    np.testing.assert_array_equal(at(eta[:2]), at(eta)[:2])


@pytest.mark.parametrize("part", ["shot_hz", "leak_hz"])
@pytest.mark.parametrize("eta_hz", [0.0, 20.0])
def test_a_traced_part_of_measured_noise_that_is_0_is_as_if_left_out(
    part: str, eta_hz: float
) -> None:
    rising = jnp.asarray(np.log(np.linspace(BANDS, 1.18 * BANDS, 11)), jnp.float32)
    camera = Camera.constant(SHAPE, 0.2, 0.2, eta_hz, eta_hz)

    def counted(value: Any) -> jax.Array:
        model = SensorModel(eta_is_all=True, noise_resets_memory=True, **{part: value})
        return simulate_counts(jax.random.key(2), rising, camera, frame_dt_s=1e-3, model=model)

    left_out = counted(0.0)
    assert bool(left_out.any()) == (eta_hz > 0)
    np.testing.assert_array_equal(jax.jit(counted)(0.0), left_out)


def test_leak_has_a_fixed_log_normal_pattern_and_jitter() -> None:
    """4096 pixels: the sd of log10(rate) is known to 1.1 %, its median to .002 decades."""
    model = SensorModel(leak_hz=50.0, leak_fpn_decades=0.1, leak_jitter=0.5)
    counts = leaks(model).count_map()[0].astype(float)
    decades = np.log10((counts + 0.5) / 50.0)  # a count is rounded down
    assert decades.std() == pytest.approx(0.1, rel=0.05)
    assert np.median(decades) == pytest.approx(0.0, abs=0.008)
    other = leaks(model, seed=6).count_map()[0]
    assert abs(np.corrcoef(counts.ravel(), other.ravel())[0, 1]) < 4 / 64
    jitter = leaks(dataclasses.replace(model, leak_fpn_decades=0.0)).count_map()[0]
    assert jitter.mean() == pytest.approx(49.5, rel=0.02)
    assert jitter.std() == pytest.approx(0.25 * np.sqrt(100), rel=0.15)  # .5 x .5 event a frame


@pytest.mark.parametrize("mean", [1e-4, 1e-2, 0.3, 1.0, 3.0, 12.0, 40.0])
def test_counts_are_poisson(mean: float) -> None:
    """On an even grid of a million quantiles, mean and variance are those of the distribution to
    within the grid, and each count agrees with the float64 quantile function."""
    n = 1 << 20
    u = (np.arange(n) + 0.5) / n
    counts = np.asarray(jax.jit(poisson)(jnp.asarray(u, jnp.float32), jnp.float32(mean)))
    assert counts.mean() == pytest.approx(mean, rel=1e-3, abs=2e-6)
    assert counts.var() == pytest.approx(mean, rel=4e-3, abs=3e-6)
    k = np.arange(200)
    log_factorial = np.cumsum(np.log(np.maximum(k, 1)))
    tail = 1.0 - np.cumsum(np.exp(k * np.log(mean) - mean - log_factorial))  # P(N > k)
    exact = np.searchsorted(-tail, -u)  # how many k have u < P(N > k)
    assert (counts != exact).mean() < 1e-5 * max(1.0, mean)
    assert np.abs(counts - exact).max() <= 1


@pytest.mark.parametrize("mean", [1e-7, 1e-6, 1e-4])
def test_rare_events_keep_their_probability(mean: float) -> None:
    """jax.random.uniform's steps of 1.2e-7 could not tell these apart."""
    u = jnp.array([0.5, 0.98, 1.02, 2.0]) * mean
    np.testing.assert_array_equal(poisson(u, jnp.float32(mean)), [1.0, 1.0, 0.0, 0.0])


def test_draws_are_uniform_and_independent() -> None:
    """2^22 draws of 4096 pixels in 1024 intervals: moments to 4 sd, by pixel, interval and draw."""
    k_words, k_salts = jax.random.split(jax.random.key(8))
    words = pixel_words(k_words, 4096)
    drawn = jax.vmap(lambda salt: draw(words, salt))(salts(k_salts, jnp.arange(1024)))
    every = jnp.broadcast_to(words, drawn.shape)
    values = [uniform(drawn), *(further(every, drawn, jnp.uint32(n)) for n in (0, 1, 2))]
    for u in (np.asarray(v, np.float64) for v in values):
        assert u.min() > 0
        assert u.max() <= 1
        assert u.mean() == pytest.approx(0.5, abs=4 * 0.2887 / 2048)
        assert u.var() == pytest.approx(1 / 12, rel=0.003)
        for axis, n in ((0, 1024), (1, 4096)):  # means of each pixel, of each interval
            assert u.mean(axis).std() == pytest.approx(0.2887 / np.sqrt(n), rel=0.1)
        assert abs(np.mean((u[1:] - 0.5) * (u[:-1] - 0.5))) < 4 / 12 / 2048
        assert abs(np.mean((u[:, 1:] - 0.5) * (u[:, :-1] - 0.5))) < 4 / 12 / 2048
    first, *others = (np.asarray(v, np.float64) for v in values)
    for other in others:  # uniform where the first is small, as in the pixels that noise strikes
        rare = other[first < 0.005]
        assert len(rare) == pytest.approx(0.005 * (1 << 22), rel=0.03)
        counts = np.histogram(rare, 16, (0, 1))[0]
        chi2 = ((counts - len(rare) / 16) ** 2 / (len(rare) / 16)).sum()
        assert chi2 < 15 + 5 * np.sqrt(30)


def test_host_and_device_place_events_alike() -> None:
    words = pixel_words(jax.random.key(1), 1000)
    salt = salts(jax.random.key(2), jnp.arange(1))[0]
    drawn, k = draw(words, salt), np.arange(1000, dtype=np.uint32) % 5
    share = jnp.full(1000, 0.3)
    for theirs, ours in zip(event(ETA, words, drawn, jnp.asarray(k), share),
                            event(ETA, *map(np.asarray, (words, drawn, k, share))), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_the_cosine_of_a_draw_is_that_of_the_angle() -> None:
    turns = np.append(np.linspace(0, 1, 4097), [2.0**-33, 0.25 - 2.0**-26]).astype(np.float32)
    exact = np.cos(2 * np.pi * turns.astype(np.float64))
    np.testing.assert_allclose(cosine(jnp.asarray(turns)), exact, rtol=0, atol=2.5e-7)
