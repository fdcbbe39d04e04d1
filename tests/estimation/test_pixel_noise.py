"""Noise rates of single pixels: as uneven as their events show, with errors that say so."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from evflow.camera import Camera, Summary
from evflow.estimation.maps import with_hot_rates, with_rates, with_unquiet_error
from evflow.estimation.pixel_noise import (
    ODD,
    SPREAD,
    SPREAD_ERROR,
    _shapes,
    hot_rates,
    pixel_rates,
    quiet_time,
    threshold_law,
    uneven_rate,
)

SHAPE = (96, 128)
NONE_HOT = np.zeros(SHAPE, bool)
ALIKE = np.full(2, 0.1)  # mismatch of thresholds, relative


def drawn(spread: float, seconds: np.ndarray, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Rates (H, W) around .4 Hz, and events in these seconds."""
    rng = np.random.default_rng(seed)
    rates = 0.4 * (rng.gamma(spread**-2, spread**2, SHAPE) if spread else np.ones(SHAPE))
    return rates, rng.poisson(rates * seconds)


@pytest.mark.parametrize("spread", [0.2, 0.5, 1.0])
def test_intervals_hold_the_rates(spread: float) -> None:
    seconds = np.random.default_rng(1).uniform(0.0, 20.0, SHAPE)
    rates, events = drawn(spread, seconds)
    found, std = pixel_rates(events, seconds, 0.4, NONE_HOT, error=0.0)
    away = np.abs(found - rates) / std
    # A gamma distribution is steeper than a normal one: of spread 1, 86 % lie within its std.
    assert 0.64 < (away < 1).mean() < 0.78
    assert 0.93 < (away < 1.96).mean() < 0.97
    assert np.square(found - rates).mean() < 0.95 * rates.var()
    assert np.square(found - rates).mean() == pytest.approx(np.square(std).mean(), rel=0.15)


def test_equal_pixels_stay_equal() -> None:
    rates, events = drawn(0.0, np.full(SHAPE, 5.0))
    found, std = pixel_rates(events, np.full(SHAPE, 5.0), 0.4, NONE_HOT, error=0.0)
    assert np.abs(found / rates - 1.0).max() < 0.1
    assert std.max() < 0.08 * 0.4


def test_what_is_uncertain_of_the_camera_is_so_of_its_pixels_but_not_of_hot_ones() -> None:
    seconds, hot = np.full(SHAPE, 5.0), NONE_HOT.copy()
    hot[3, 4] = True
    _, events = drawn(0.0, seconds)
    events[3, 4] = 1000
    (found, own), (same, std) = (pixel_rates(events, seconds, 0.4, hot, error=e) for e in (0, 0.5))
    np.testing.assert_array_equal(found, same)
    np.testing.assert_allclose(std[~hot], np.hypot(own, 0.5 * found)[~hot])
    assert std[3, 4] == own[3, 4]


@pytest.mark.parametrize("spread", [0.0, 0.3])
def test_warm_pixels_of_a_scene_at_rest_have_their_own_rate(spread: float) -> None:
    """Too noisy for chance, too quiet for hot ones; without the share of odd pixels they were
    shrunk to a fraction of what they sent, with intervals of several std beside it."""
    seconds = np.full(SHAPE, 20.0)
    rates, events = drawn(spread, 0.25 * seconds)
    warm = np.zeros(SHAPE, bool)
    warm[10:90:10, 20:120:10] = True
    rates, events = np.where(warm, 1.5, 0.25 * rates), np.where(
        warm, np.random.default_rng(2).poisson(1.5 * seconds), events)
    found, std = pixel_rates(
        events, seconds, events.mean() / 20.0, NONE_HOT, error=0.0, odd=ODD)
    away = np.abs(found - rates)[warm] / std[warm]
    assert (away < 1).mean() > 0.55
    assert away.max() < 4
    shrunk, small = pixel_rates(events, seconds, events.mean() / 20.0, NONE_HOT, error=0.0)
    assert np.abs(found - rates)[~warm].mean() < np.abs(shrunk - rates)[~warm].mean()
    assert (np.abs(shrunk - rates)[warm] / small[warm]).mean() > 1.5 * away.mean()


def test_pixels_that_were_not_watched_have_the_camera_s_rate() -> None:
    seconds = np.where(np.arange(SHAPE[1]) < 64, 10.0, 0.0) * np.ones(SHAPE)
    _, events = drawn(0.5, seconds)
    found, std = pixel_rates(events, seconds, 0.3, NONE_HOT, error=0.0)
    np.testing.assert_allclose(found[:, 64:], 0.3)
    np.testing.assert_allclose(std[:, 64:], 0.3 * 0.5, rtol=0.1)
    nothing, wide = pixel_rates(0 * events, 0 * seconds, 0.3, NONE_HOT, error=0.0)
    np.testing.assert_allclose(nothing, 0.3)
    assert 0.02 < wide.min() / 0.3 == wide.max() / 0.3 < 0.2


def test_hot_pixels_have_their_own_rate_and_leave_the_others_alone() -> None:
    seconds = np.full(SHAPE, 4.0)
    _, events = drawn(0.3, seconds)
    hot = NONE_HOT.copy()
    hot[5, 7] = True
    loud = events.copy()
    loud[5, 7] = 400
    found, std = pixel_rates(loud, seconds, 0.4, hot, error=0.0)
    assert found[5, 7] == 100.0
    assert std[5, 7] == pytest.approx(np.sqrt(401) / 4)
    np.testing.assert_array_equal(
        found[~hot], pixel_rates(events, seconds, 0.4, hot, error=0.0)[0][~hot])


def test_spreads_are_as_likely_as_the_negative_binomial_says() -> None:
    expected = np.random.default_rng(2).uniform(0.1, 4.0, 300)
    n = np.random.default_rng(3).poisson(expected * 1.2)
    shapes, weights = _shapes(n, expected)
    likely = np.array([stats.nbinom.logpmf(n, a, a / (a + expected)).sum() for a in shapes])
    prior = -0.5 * (np.log(shapes**-0.5 / SPREAD) / SPREAD_ERROR) ** 2
    np.testing.assert_allclose(np.log(weights[1:] / weights[:-1]), np.diff(likely + prior),
                               rtol=1e-8, atol=1e-8)


def watched(counts: np.ndarray, dlog: np.ndarray, hot: np.ndarray = NONE_HOT) -> np.ndarray:
    return quiet_time(counts, dlog, np.ones(SHAPE, bool), hot, 0.05, np.array([0.1, 0.1]))


def test_quiet_is_where_nothing_else_fires_or_changes() -> None:
    counts, dlog = np.zeros((2, *SHAPE), int), np.zeros(SHAPE, np.float32)
    counts[0, 40, 50] = 3
    dlog[:, 100:] = 0.2
    dlog[:20, :60] = 0.008  # a drift of .16 a second
    on, off = watched(counts, dlog)
    assert on[0].sum() == 3  # its own events are no company
    assert on[1, 40, 50] == off[1, 40, 51] == np.float32(0.05)
    assert on[1, 40, 51] == on[1, 44, 46] == 0.0  # but they are for its neighbours
    assert on[1, 45, 50] == np.float32(0.05)
    assert not off[:, :, 99:].any()
    assert not off[1, :17, :57].any()
    assert (off[1, 23:, :98] == np.float32(0.05)).all()


def test_hot_pixels_are_no_company() -> None:
    counts, hot = np.zeros((2, *SHAPE), int), NONE_HOT.copy()
    counts[:, 40, 50], hot[40, 50] = 3, True
    on, _ = watched(counts, np.zeros(SHAPE, np.float32), hot)
    assert (on[1] == np.float32(0.05)).all()
    assert on[0, 40, 50] == 3


def quiet_counts(rates: np.ndarray, seconds: float) -> np.ndarray:
    """Events and seconds (2, 2, H, W) of pixels with the rates (2, H, W)."""
    rng = np.random.default_rng(4)
    return np.stack([np.stack([rng.poisson(r * seconds), np.full(SHAPE, seconds)]) for r in rates])


@pytest.mark.parametrize("share", [1.0, 0.75])
def test_rates_follow_the_thresholds_where_the_events_say_so(share: float) -> None:
    theta = np.maximum(np.random.default_rng(3).normal(0.3, 0.12, (2, *SHAPE)), 0.03)
    rates = 0.2 * (share * np.median(theta, (1, 2), keepdims=True) / theta + 1.0 - share)
    quiet = quiet_counts(rates, 20.0)
    law = threshold_law(quiet, theta, NONE_HOT)
    assert law is not None
    np.testing.assert_allclose(law, rates / rates.mean((1, 2), keepdims=True), rtol=0.04)
    quiet = quiet_counts(rates, 2.0)
    found, std = pixel_rates(*quiet[0], rates[0].mean(), NONE_HOT, law[0], error=0.0)
    assert found.mean() == pytest.approx(rates[0].mean(), rel=0.05)
    assert np.median(found) == pytest.approx(np.median(rates[0]), rel=0.05)
    assert (np.abs(found - rates[0]) < 2 * std).mean() > 0.9


def test_rates_of_their_own_do_not_follow_the_thresholds() -> None:
    theta = np.maximum(np.random.default_rng(3).normal(0.3, 0.12, (2, *SHAPE)), 0.03)
    for rates in (0.2 * np.ones((2, *SHAPE)), np.zeros((2, *SHAPE))):
        assert threshold_law(quiet_counts(rates, 2.0), theta, NONE_HOT) is None


@pytest.mark.parametrize("uneven", [True, False])
def test_the_summary_has_the_rates_of_the_maps_where_noise_follows_the_thresholds(
    uneven: bool
) -> None:
    """Else it keeps its own, which is better known than the few events of quiet pixels tell."""
    theta = np.maximum(np.random.default_rng(3).normal(0.3, 0.12, (2, *SHAPE)), 0.03)
    rates = 0.4 * (0.3 / theta if uneven else np.ones(theta.shape))
    quiet = quiet_counts(rates, 20.0)
    camera = Camera(*map(jnp.asarray, (*theta, *np.ones_like(theta))))
    low = Summary(*(jnp.float32(v) for v in (0.2, 0.2, 0.4, 0.4, 0.08, 0.08)))
    std = Summary(*(jnp.float32(v) for v in (0.01, 0.01, 0.04, 0.04, 0.01, 0.01)))
    _, _, summary, error = with_rates(camera, camera, quiet, NONE_HOT, low, std)
    if uneven:
        law = threshold_law(quiet, theta, NONE_HOT)
        assert law is not None
        rate, relative = uneven_rate(*quiet[0], 0.4, 0.1, NONE_HOT, law[0])
        assert 0.4 < rate < float(rates[0].mean()) * 1.05
        assert float(summary.eta_on) == pytest.approx(rate)
        assert float(error.eta_on) == pytest.approx(rate * relative)
        assert summary.theta_on == low.theta_on
    else:
        assert (summary, error) == (low, std)


def test_the_rate_of_uneven_pixels_is_what_they_sent_where_they_sent_enough() -> None:
    rates = np.full(SHAPE, 2.0)
    quiet = quiet_counts(np.stack([rates, rates]), 2.0)[0]
    law = np.where(np.arange(SHAPE[1]) % 10, 0.4, 6.4) * np.ones(SHAPE)  # mean 1, median .4

    def found(quiet: np.ndarray, law: np.ndarray) -> tuple[float, float]:
        return uneven_rate(*quiet, 1.0, 0.05, NONE_HOT, law)

    many, error = found(quiet, law)
    few, wider = found(quiet * (np.arange(SHAPE[1]) < 1) / 50, law)
    assert 1.5 < many < 2.0
    assert 1.0 < few < 1.4
    assert 0.05 < error < wider < 0.3
    assert found(quiet, np.ones(SHAPE)) == pytest.approx((1.0, 0.05), rel=0.03)
    assert found(0 * quiet, law)[0] == pytest.approx(1.0)


def test_signal_left_among_even_noise_does_not_make_it_follow_the_thresholds() -> None:
    """Near what moves, pixels of low thresholds send more: a seventh of all events are theirs."""
    theta = np.maximum(np.random.default_rng(3).normal(0.2, 0.05, (2, *SHAPE)), 0.05)
    signal = theta**-3.0
    rates = 0.01 * (6.5 + signal / signal.mean((1, 2), keepdims=True)) / 7.5
    assert threshold_law(quiet_counts(rates, 4.0), theta, NONE_HOT) is None


def test_a_few_events_do_not_follow_the_thresholds_that_they_have_lowered_themselves() -> None:
    """Of a pixel that has sent little else, an event of noise halves the threshold found."""
    quiet = quiet_counts(np.full((2, *SHAPE), 0.05), 0.05)
    theta = np.where(quiet[:, 0] > 0, 0.15, 0.3)
    assert 0 < quiet[:, 0].sum() < 100
    assert threshold_law(quiet, theta, NONE_HOT) is None


def test_signal_of_the_lowest_thresholds_alone_is_no_law() -> None:
    theta = np.maximum(np.random.default_rng(3).normal(0.25, 0.1, (2, *SHAPE)), 0.02)
    rates = np.where(theta < 0.1, 0.5, 0.02)
    quiet = quiet_counts(rates, 1.0)
    assert quiet[:, 0].sum() > 200
    assert threshold_law(quiet, theta, NONE_HOT) is None


def test_rates_are_less_certain_where_little_is_quiet_and_noise_events_are_many() -> None:
    summary, std = (Summary(*(jnp.float32(v) for v in values)) for values in (
        (0.3, 0.3, 0.1, 0.1, 0.01, 0.01), (0.02, 0.02, 0.01, 0.01, 0.01, 0.01)))

    def of(share: float, pixel_s: float) -> Summary:
        return with_unquiet_error(summary, std, np.full(2, share), pixel_s)

    assert float(of(0.0, 1e9).eta_on) == pytest.approx(np.hypot(0.01, 0.3 * 0.1), rel=1e-5)
    assert float(of(0.03, 3000.0).eta_off) == pytest.approx(
        np.hypot(0.01, 0.1 * 0.3 / 2 / 2), rel=1e-5)
    assert float(of(1.0, 10.0).eta_on) == pytest.approx(0.01, rel=0.01)
    assert of(0.0, 1e9).theta_on == std.theta_on


def test_hot_pixels_before_moving_scenes_have_what_they_send_beyond_their_neighbours() -> None:
    rng = np.random.default_rng(0)
    seconds, shape = 2.0, (60, 80)
    sent = rng.poisson(14.0, (2, *shape)).astype(np.float64)
    hot = np.zeros(shape, bool)
    hot[4::8, 4::8] = True
    sent[0, hot] += rng.poisson(24.0 * seconds, hot.sum())
    rate, std = hot_rates(np.zeros((2, 2, *shape), np.float32), sent, seconds, hot, ALIKE)
    away = (rate - [[24.0], [0.0]]) / std
    assert abs(away[0].mean()) < 0.3
    assert 0.8 < away[0].std() < 1.2
    assert (away[1] < 4.0).all()
    assert (std < 8.0).all()


def test_what_hot_pixels_send_at_rest_counts_by_its_precision() -> None:
    """One of 24 Hz ON, no OFF, that was often quiet, before neighbours that send 600 events."""
    shape, hot = (20, 20), np.zeros((20, 20), bool)
    hot[10, 10] = True
    sent = np.random.default_rng(1).poisson(600.0, (2, *shape)).astype(np.float64)
    sent[:, 10, 10] = 600 + 60 * 24, 601
    quiet = np.zeros((2, 2, *shape), np.float32)
    quiet[:, :, 10, 10] = [[480.0, 20.0], [0.0, 20.0]]
    (on, off), (on_std, off_std) = (v[:, 0] for v in hot_rates(quiet, sent, 60.0, hot, ALIKE))
    assert on == pytest.approx(24.0, abs=2 * on_std)
    assert on_std < 1.0
    assert off < 0.1
    assert 0.02 < off_std < 0.06


def test_quiet_time_is_counted_once() -> None:
    """Of pixels that are quiet all the time, quiet events are all that they send."""
    rng, shape = np.random.default_rng(2), (60, 80)
    hot = np.zeros(shape, bool)
    hot[4::8, 4::8] = True
    sent = np.where(hot, rng.poisson(600.0, (2, *shape)), rng.poisson(3.0, (2, *shape)))
    quiet = np.stack([sent, np.full(sent.shape, 30.0)], 1)
    for alone in (False, True):
        rate, std = hot_rates(quiet, sent, 30.0, hot, ALIKE, alone=alone)
        assert 0.85 < ((rate - 20.0) / std).std() < 1.15
    quiet[:, 0] *= 2.0  # at another light
    np.testing.assert_allclose(hot_rates(quiet, sent, 30.0, hot, ALIKE, alone=True)[0],
                               sent[:, hot] / 15.0)


def test_signal_of_low_thresholds_is_no_noise_of_hot_pixels() -> None:
    """Of pixels of which one in six has half the threshold, one that sends five times as much and
    was quiet for a while, and one that never was; with even thresholds both are hot."""
    shape, hot = (20, 20), np.zeros((20, 20), bool)
    hot[5, 10] = hot[15, 10] = True
    sent = np.random.default_rng(1).poisson(100.0, (2, *shape)).astype(np.float64)
    sent[:, hot] = 500.0
    quiet = np.zeros((2, 2, *shape), np.float32)
    quiet[:, :, 5, 10] = 4.0, 0.4
    rates, _ = hot_rates(quiet, sent, 1.0, hot, np.full(2, 0.5))
    np.testing.assert_allclose(rates[:, 0], 10.0, rtol=1e-5)
    assert np.isnan(rates[:, 1]).all()
    np.testing.assert_allclose(hot_rates(quiet, sent, 1.0, hot, ALIKE)[0][:, 1], 400.0, rtol=0.1)
    camera = Camera.constant(shape, theta_on=0.2, theta_off=0.2, eta_on=0.3, eta_off=0.3)
    kept, _ = with_hot_rates(camera, camera, hot, rates, rates)
    np.testing.assert_allclose(np.asarray(kept.eta_on)[hot], [10.0, 0.3], rtol=1e-5)
