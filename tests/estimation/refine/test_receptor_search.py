"""What pixels see frames by: the low-pass against a plain integration, and all three constants
found again in events that an independent pixel makes of a known film."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
from helpers.films import (
    FRAME_S,
    INTERVALS,
    SHAPE,
    film,
    integrated,
    lin_log,
    log_eps,
)
from helpers.samples import NONE_HOT, looked_at, no_readouts

from evflow.estimation.refine import receptor_descent, receptor_prior, receptor_search
from evflow.estimation.refine.path import STEPS
from evflow.estimation.refine.receptor_data import Sample, sample
from evflow.estimation.refine.receptor_prior import (
    FEW,
    FEWER,
    Prior,
    beyond_bias,
    small_sample_odds,
)
from evflow.estimation.refine.receptor_profile import Other
from evflow.estimation.refine.receptor_regression import Regression
from evflow.estimation.refine.receptor_result import TRADED
from evflow.estimation.refine.receptor_search import find
from evflow.estimation.refine.sightings import sight
from evflow.simulator.photoreceptor import FAST, IDEAL, Photoreceptor, seen_path
from evflow.types import Events


@pytest.mark.parametrize(("offset", "tau_s", "by_light"), [
    (0.0, 0.0, True), (24.0, 2e-3, True), (-12.0, 5e-3, True), (24.0, 4e-3, False)])
def test_the_path_is_that_of_a_plain_integration(
    offset: float, tau_s: float, by_light: bool
) -> None:
    dn = film()[:40].astype(np.float32)
    dt_s = FRAME_S / STEPS
    want = integrated(dn, dt_s, offset, tau_s, 400, by_light)[::400]
    got = seen_path(dn, np.full(39, dt_s, np.float32), np.float32(offset),
                    np.float32(max(tau_s, FAST)), by_light)
    assert np.abs(np.asarray(got) - want).max() < (5e-3 if tau_s else 0.02)


def test_slopes_are_those_of_differences() -> None:
    """Gauss's and Newton's curvature, too, but for what the lin-log bends."""
    model = Regression(looked_at(0.0, 60.0))
    phi = np.array([2.0, 3e-3, 2e-4])
    slopes = model.slopes(phi)
    for k, step in enumerate(np.diag([0.4, 4e-5, 4e-5])):
        rise = model.unexplained(phi + step) - model.unexplained(phi - step)
        assert slopes.gradient[k] == pytest.approx(rise / (2 * step[k]), rel=0.05)
        change = np.log(model.solved(phi + step)[0] / model.solved(phi - step)[0])
        np.testing.assert_allclose(slopes.of_theta[:, k], change / (2 * step[k]), rtol=0.05)
    best = find(model.data).seen
    phi = np.array([best.offset_dn, best.tau_s, best.delay_s])
    bent = model.slopes(phi).bent
    np.testing.assert_allclose(bent[1:, 1:], model.curvature(phi)[1:, 1:], rtol=0.4)


@pytest.mark.parametrize(("offset", "cutoff_hz", "delay_s", "by_light"), [
    (0.0, 0.0, 0.0, True), (0.0, 100.0, 0.0, True), (24.0, 200.0, 1e-3, True),
    (-12.0, 30.0, -1e-3, True), (0.0, 30.0, 0.0, False), (24.0, 60.0, 1e-3, False)])
def test_the_constants_are_found_again(
    offset: float, cutoff_hz: float, delay_s: float, by_light: bool
) -> None:
    tau_s = 1 / (2 * np.pi * cutoff_hz) if cutoff_hz else 0.0
    found = find(looked_at(offset, cutoff_hz, delay_s, by_light))
    assert found.seen.by_light == by_light
    std = np.sqrt(np.diag(found.covariance))
    assert found.needed == bool(offset or cutoff_hz)
    assert abs(found.seen.offset_dn - offset) < 3 * std[0] + 0.5
    assert abs(found.seen.tau_s - tau_s) < 3 * std[1] + 0.05 * tau_s
    assert abs(found.seen.delay_s - delay_s) < 3 * std[2]
    assert np.abs(found.theta / [0.25, 0.2] - 1).max() < 0.04 + 3 * found.theta_error.max()
    assert found.explained[1] > 0.98
    if cutoff_hz:
        assert found.seen.cutoff_hz == pytest.approx(cutoff_hz, rel=0.15)


@pytest.mark.parametrize("cutoff_hz", [0.0, 60.0])
@pytest.mark.parametrize(("log", "name"), [(lin_log, "linlog"), (log_eps, "log_eps")])
def test_dark_light_shows_which_logarithm_it_is(
    log: Callable[[np.ndarray], np.ndarray], name: str, cutoff_hz: float
) -> None:
    """Of which the wrong one would be taken for an offset, with thresholds far too low."""
    found = find(looked_at(0.0, cutoff_hz, gain=0.15, log=log))
    assert found.seen.log_map == name
    assert found.needed == bool(cutoff_hz)
    assert found.optics.offset_dn == 0.0
    np.testing.assert_allclose(found.theta, [0.25, 0.2], rtol=0.04)
    assert found.used == (found.seen if cutoff_hz else Photoreceptor(log_map=name))


def test_bright_light_does_not() -> None:
    assert find(looked_at(0.0, 0.0, log=log_eps)).seen.log_map == "linlog"


@pytest.mark.parametrize(("gain", "log", "name"), [
    (0.15, lin_log, "linlog"), (0.25, log_eps, "log_eps")])
def test_logarithms_are_compared_on_the_same_groups_of_events(
    monkeypatch: pytest.MonkeyPatch, gain: float, log: Callable[[np.ndarray], np.ndarray], name: str
) -> None:
    """Each divides a pixel's events at other ones as noise. Of the groups by log_eps either map
    explains more than of those by lin-log in the first case, and less in the second."""
    data = looked_at(0.0, 30.0, gain=gain, log=log, noise_hz=5.0)
    monkeypatch.setattr(receptor_prior, "FEW", 1.0)
    found = find(data._replace(noise_hz=np.full((1, 2), 5.0, np.float32)))
    assert found.seen.log_map == name
    assert found.seen.cutoff_hz == pytest.approx(30.0, rel=0.1)
    np.testing.assert_allclose(found.theta, [0.25, 0.2], rtol=0.08)


@pytest.mark.parametrize(("asked", "kept"), [(0.0, True), (1e6, False)])
def test_an_offset_must_explain_something(
    monkeypatch: pytest.MonkeyPatch, asked: float, kept: bool
) -> None:
    data = looked_at(24.0, 200.0, 1e-3)
    monkeypatch.setattr(receptor_descent, "BY_OFFSET", asked)
    found = find(data)
    assert found.needed
    assert found.seen.offset_dn == (pytest.approx(24.0, abs=4.0) if kept else 0.0)
    assert found.covariance[0, 0] > (0.0 if kept else 15.0**2)


@pytest.mark.parametrize("offset", [-14.0, 24.0])
def test_a_good_path_shows_an_offset_by_itself(
    monkeypatch: pytest.MonkeyPatch, offset: float
) -> None:
    """Of which all three constants together are no evidence, nor net changes."""
    for name in ("DOUBT", "ALONE"):
        monkeypatch.setattr(receptor_search, name, 1e6)
    monkeypatch.setattr(receptor_prior, "FEW", 1.0)
    found = find(looked_at(offset, 0.0))
    assert found.needed
    assert found.used.offset_dn == pytest.approx(offset, abs=3.0)
    assert found.used.tau_s == 0.0
    assert not found.offset_open.any()
    monkeypatch.setattr(receptor_search, "BY_PATH", 1e6)
    found = find(looked_at(offset, 0.0))
    assert not found.needed
    assert (found.offset_open > 0.05).all()


def test_what_a_path_says_of_an_offset_is_worth_more_the_better_it_is() -> None:
    data = looked_at(24.0, 0.0)
    off = np.random.default_rng(0).normal(0, 2.0, (2, *np.shape(data.on))).astype(np.float32)
    clear, poor = (Regression(one) for one in (
        data, data._replace(on=data.on + off[0], off=data.off + off[1])))
    none = np.array([0.0, FAST, 0.0])
    phi, odds = receptor_search._offset_by_path(clear, 2.0, clear.unexplained(none))
    assert phi[1:] == pytest.approx(none[1:])
    gain = 0.5 * 10.0 * (clear.unexplained(none) - clear.unexplained(phi))
    bound = 0.5 * (phi[0] / receptor_prior.BIASED) ** 2
    gain = min(gain, bound)
    rest = clear.prior.log_odds(float(phi[0])) - Prior().minus_log(phi)
    assert odds == pytest.approx(
        gain - receptor_search.BY_PATH - small_sample_odds(data) + rest)
    assert receptor_search._offset_by_path(poor, 2.0, poor.unexplained(none))[1] == -np.inf


@pytest.mark.parametrize(("gain", "offset", "odds"), [
    (3.0, 35.0, 3.0), (60.0, 35.0, 50.0), (3.0, -3.5, 0.5), (-2.0, 3.5, -2.0)])
def test_a_small_offset_may_be_a_bias_of_the_path(gain: float, offset: float, odds: float) -> None:
    assert beyond_bias(gain, offset) == pytest.approx(odds)


def test_a_slow_pixel_is_found_among_noise() -> None:
    """Which makes thresholds too small unless it parts a pixel's events."""
    data = looked_at(0.0, 30.0, noise_hz=15.0)
    slow = np.array([0.0, 1 / (2 * np.pi * 30.0), 0.0])
    assert (Regression(data).solved(slow)[0] < [0.87 * 0.25, 0.87 * 0.2]).all()
    found = find(data._replace(noise_hz=np.full((1, 2), 15.0, np.float32)))
    assert found.needed
    assert found.seen.cutoff_hz == pytest.approx(30.0, rel=0.15)
    np.testing.assert_allclose(found.theta, [0.25, 0.2], rtol=0.08)
    assert found.explained[1] > 0.97


def test_where_little_happens_nothing_is_looked_for() -> None:
    dn = np.full((INTERVALS * STEPS + 1, *SHAPE), 100.0, np.float32)
    events = Events(np.array([1]), np.array([1]), np.array([30_000]), np.array([True]), SHAPE[::-1])
    times = 10_000 + 20_000 * np.arange(INTERVALS + 1)
    s = sight(events, times, lin_log(dn), STEPS)
    steps_s = np.full(INTERVALS * STEPS, FRAME_S / STEPS)
    assert sample([(dn, steps_s, s, no_readouts(s), NONE_HOT)]) is None
    assert sample([]) is None


@pytest.mark.parametrize("shown", [True, False])
def test_events_that_no_frame_shows_tell_nothing(shown: bool) -> None:
    """Of black or saturated frames: thousands of events, and no brightness beside them."""
    rng, n = np.random.default_rng(0), 4000
    dn = np.full((INTERVALS * STEPS + 1, *SHAPE), 100.0, np.float32)
    t = np.sort(rng.integers(10_001, 10_000 + INTERVALS * 20_000, n))
    y, x = (rng.integers(0, side, n) for side in SHAPE)
    events = Events(x, y, t, rng.random(n) < 0.5, SHAPE[::-1])
    times = 10_000 + 20_000 * np.arange(INTERVALS + 1)
    s = sight(events, times, lin_log(dn), STEPS, np.full((INTERVALS + 1, *SHAPE), shown))
    steps_s = np.full(INTERVALS * STEPS, FRAME_S / STEPS)
    found = sample([(dn, steps_s, s, no_readouts(s), NONE_HOT)])
    assert (found is not None) == shown


@pytest.mark.parametrize("noise_hz", [0.0, 30.0])
def test_noise_that_divides_all_pixels_leaves_nothing_to_search(noise_hz: float) -> None:
    """Each event is a group of its own, and none has counts that vary."""
    data = looked_at(0.0, 0.0)
    noisy = data._replace(noise_hz=np.full((1, 2), 1e4 * noise_hz, np.float32))
    found = find(noisy)
    assert (found is None) == (noise_hz > 0)
    share = receptor_search.explained(noisy, IDEAL, np.array([0.25, 0.2]))
    assert np.isnan(share) == (noise_hz > 0)


def test_counts_that_smearing_levels_say_nothing_of_an_exposure(
    monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of bursts shorter than the exposure, the mean of a pixel's counts is the same throughout."""
    def levelled(data: Sample, _: float) -> Sample:
        return data._replace(on=0 * data.on, off=0 * data.off)

    monkeypatch.setattr(receptor_search, "smeared_sample", levelled)
    found = find(looked_at(0.0, 0.0))
    assert found is not None
    assert not found.smear.any()


def test_the_less_was_watched_the_more_it_takes() -> None:
    """To take a pixel for slow, or frames for lacking light."""
    data = looked_at(0.0, 0.0)
    assert data.watched == pytest.approx(INTERVALS * FRAME_S * SHAPE[0] * SHAPE[1], rel=1e-5)
    much, less, least = (small_sample_odds(data._replace(watched=np.array([seconds])))
                         for seconds in (2 * FEW, FEW / np.e, FEW / np.e**2))
    assert (much, less, least) == pytest.approx((0.0, FEWER, 2 * FEWER))


def test_a_gain_by_a_path_that_explains_little_counts_less() -> None:
    data, slow = looked_at(0.0, 60.0), np.array([0.0, 1 / (2 * np.pi * 60.0), 0.0])
    clear = Regression(data)
    off = np.random.default_rng(0).normal(0, 2.0, (2, *np.shape(data.on))).astype(np.float32)
    poor = Regression(data._replace(on=data.on + off[0], off=data.off + off[1]))
    left = [model.unexplained(slow) for model in (clear, poor)]
    assert 1 - np.exp(left[0]) > 0.9 > 0.5 > 1 - np.exp(left[1])
    worth = [receptor_descent.worth(slow, model, 400.0) for model in (clear, poor)]
    assert worth == pytest.approx([400.0, 400.0 * (1 - np.exp(left[1])) / receptor_descent.CLEAR])
    assert receptor_descent.worth(slow, poor, 10.0) == 10.0
    odds = [receptor_search._odds(slow, poor, 400.0, left[1] + gain) for gain in (0.0, 0.1)]
    assert odds[1] - odds[0] == pytest.approx(0.05 * worth[1])


def test_the_less_probable_law_widens_what_is_left_open() -> None:
    """As a mixture of two values: chance times the square of their distance."""
    other = Other(0.25, 5e-3, np.array([0.2, 0.6]))
    covariance, theta_error = other.beside(
        3e-3, np.array([0.2, 0.3]), np.diag([4.0, 1e-8, 1e-8]), np.array([0.1, 0.0]))
    assert covariance == pytest.approx(np.diag([4.0, 1e-8 + 0.25 * 4e-6, 1e-8]))
    assert theta_error == pytest.approx([0.1, 0.5 * np.log(2)])


@pytest.mark.parametrize("by_light", [False, True])
def test_what_an_even_low_pass_and_a_delay_trade_is_in_their_errors(by_light: bool) -> None:
    found = find(looked_at(0.0, 30.0, 0.0, by_light))
    assert found.seen.by_light == by_light
    own = np.sqrt(np.diag(found.covariance))
    assert found.std[0] == own[0]
    np.testing.assert_allclose(found.std[1:], np.hypot(own[1:], 0.0 if by_light else TRADED))
    assert found.sensor[1]["cutoff_hz"] == pytest.approx(
        found.seen.cutoff_hz * found.std[1] / found.seen.tau_s)


def test_a_low_pass_that_the_events_show_is_kept_however_it_trades_with_a_delay() -> None:
    found = find(looked_at(0.0, 30.0, 0.0, False))
    short = dataclasses.replace(
        found, seen=dataclasses.replace(found.seen, tau_s=1.5 * TRADED),
        covariance=np.diag([1.0, (0.5 * TRADED) ** 2, 1e-8]))
    assert short.sensor[0].cutoff_hz > 0.0
    assert dataclasses.replace(
        short, covariance=np.diag([1.0, TRADED**2, 1e-8])).sensor[0].cutoff_hz == 0.0
