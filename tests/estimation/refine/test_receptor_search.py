"""What pixels see frames by: the low-pass against a plain integration, and all three constants
found again in events that an independent pixel makes of a known film."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
from helpers.films import (
    DEAD_S,
    FRAME_S,
    INTERVALS,
    SHAPE,
    SUB,
    dead_events,
    film,
    integrated,
    lin_log,
    log_eps,
    view,
)

from evflow.estimation.refine import lost_contrast as lost_module
from evflow.estimation.refine import receptor_search
from evflow.estimation.refine.held_in_reset import held_in_reset
from evflow.estimation.refine.lost_contrast import lost_contrast
from evflow.estimation.refine.path import STEPS
from evflow.estimation.refine.receptor_data import Sample, sample
from evflow.estimation.refine.receptor_prior import FEW, FEWER, small_sample_odds
from evflow.estimation.refine.receptor_profile import Other
from evflow.estimation.refine.receptor_regression import Regression
from evflow.estimation.refine.receptor_search import find
from evflow.estimation.refine.sightings import Sightings, sight
from evflow.estimation.refine.waiting import kept_contrast, without_waiting
from evflow.simulator.photoreceptor import FAST, IDEAL, Photoreceptor, seen_path
from evflow.types import Events


def events_of(
    path: np.ndarray, dt_s: float, delay_s: float, on: float, off: float, noise_hz: float = 0.0
) -> Events:
    """Events of pixels that see path (T, H, W), instants dt_s apart: one instant and event at a
    time. Noise of either polarity stores what is seen, as every event does."""
    rng = np.random.default_rng(1)
    a, b = (rng.normal(theta, 0.03 * theta, path.shape[1:]) for theta in (on, off))
    memory = path[0] + rng.uniform(-a, b)
    rows = []

    def happen(where: np.ndarray, at: np.ndarray, up: np.ndarray) -> None:
        y, x = np.nonzero(where)
        rows.append(np.stack([x, y, np.round((at * dt_s + delay_s) * 1e6)[where], up[where]]))

    for i in range(1, len(path)):
        before, now = path[i - 1], path[i]
        if noise_hz:
            struck = rng.random(now.shape) < 2 * noise_hz * dt_s
            memory = np.where(struck, now, memory)
            happen(struck, np.full(now.shape, i), rng.random(now.shape) < 0.5)
        while (crossed := (now - memory > a) | (memory - now > b)).any():
            up = now > memory
            memory = memory + np.where(up, a, -b) * crossed
            part = (memory - before) / np.where(crossed, now - before, 1.0)
            happen(crossed, i - 1 + part, up)
    x, y, t, p = np.concatenate(rows, 1).astype(np.int64)
    order = np.argsort(t, kind="stable")
    return Events(x[order], y[order], t[order] + 10_000, p[order] > 0, SHAPE[::-1])


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


NONE_HOT = np.zeros(SHAPE[0] * SHAPE[1], bool)


def no_readouts(s: Sightings) -> np.ndarray:
    """How many events of their pixel that come with a readout precede those sighted: none."""
    return np.zeros(len(s.pixel), int)


def looked_at(
    offset: float, cutoff_hz: float, delay_s: float = 0.0, by_light: bool = True,
    noise_hz: float = 0.0, gain: float = 1.0, log: Callable[[np.ndarray], np.ndarray] = lin_log,
) -> Sample:
    """What such pixels, of .25 and .2, show of the film, whose light is multiplied by gain."""
    dn, dt_s = gain * film(), FRAME_S / STEPS
    tau_s = 1 / (2 * np.pi * cutoff_hz) if cutoff_hz else 0.0
    seen = integrated(dn, dt_s, offset, tau_s, SUB, by_light, log)
    events = events_of(seen, dt_s / SUB, delay_s, 0.25, 0.2, noise_hz)
    return sample_of(dn, events)


def sample_of(dn: np.ndarray, events: Events) -> Sample:
    """The sample of events beside a film."""
    times = 10_000 + np.round(np.arange(INTERVALS + 1) * FRAME_S * 1e6).astype(np.int64)
    s = sight(events, times, lin_log(dn).astype(np.float32), STEPS)
    steps_s = np.full(INTERVALS * STEPS, FRAME_S / STEPS)
    data = sample([(dn.astype(np.float32), steps_s, s, no_readouts(s), np.zeros(dn[0].size, bool))])
    assert data is not None
    return data


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


@pytest.mark.parametrize(("asked", "kept"), [(0.0, True), (1e6, False)])
def test_an_offset_must_explain_something(
    monkeypatch: pytest.MonkeyPatch, asked: float, kept: bool
) -> None:
    data = looked_at(24.0, 200.0, 1e-3)
    monkeypatch.setattr(receptor_search, "BY_OFFSET", asked)
    found = find(data)
    assert found.needed
    assert found.seen.offset_dn == (pytest.approx(24.0, abs=4.0) if kept else 0.0)
    assert found.covariance[0, 0] > (0.0 if kept else 15.0**2)


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
    worth = [receptor_search._worth(slow, model, 400.0) for model in (clear, poor)]
    assert worth == pytest.approx([400.0, 400.0 * (1 - np.exp(left[1])) / receptor_search.CLEAR])
    assert receptor_search._worth(slow, poor, 10.0) == 10.0
    odds = [receptor_search._odds(slow, poor, 400.0, left[1] + gain) for gain in (0.0, 0.1)]
    assert odds[1] - odds[0] == pytest.approx(0.05 * worth[1])


def test_the_less_probable_law_widens_what_is_left_open() -> None:
    """As a mixture of two values: chance times the square of their distance."""
    other = Other(0.25, 5e-3, np.array([0.2, 0.6]))
    covariance, theta_error = other.beside(
        3e-3, np.array([0.2, 0.3]), np.diag([4.0, 1e-8, 1e-8]), np.array([0.1, 0.0]))
    assert covariance == pytest.approx(np.diag([4.0, 1e-8 + 0.25 * 4e-6, 1e-8]))
    assert theta_error == pytest.approx([0.1, 0.5 * np.log(2)])


@pytest.mark.parametrize("law", ["keeps", "drops", "resets"])
def test_contrast_lost_in_dead_times_is_told_from_contrast_kept(law: str) -> None:
    """Taken as kept, these thresholds would come out up to twice too high."""
    dn, dt_s = film(), FRAME_S / STEPS
    seen = integrated(dn, dt_s, 0.0, 0.0, SUB)
    data = sample_of(dn, dead_events(seen, dt_s / SUB, law))
    shortest_s, edge_s = (1.3 * DEAD_S, 0.0) if law == "resets" else (DEAD_S, DEAD_S)
    found, lost = lost_contrast(data, find(data), shortest_s, edge_s)
    assert (lost.law if lost else "keeps") == law
    theta = found.theta / (lost.excess if lost else 1.0)
    np.testing.assert_allclose(theta, [0.25, 0.2], rtol=0.08)
    if lost:
        assert lost.dead_s == pytest.approx(DEAD_S, rel=0.12)
        assert min(lost.excess) > 1.1


@pytest.mark.parametrize("law", ["ideal", "keeps", "drops", "resets"])
def test_changes_from_event_to_event_tell_of_a_reset(law: str) -> None:
    dn, dt_s = film(), FRAME_S / STEPS
    seen = integrated(dn, dt_s, 0.0, 0.0, SUB)
    data = sample_of(dn, events_of(seen, dt_s / SUB, 0.0, 0.25, 0.2) if law == "ideal"
                     else dead_events(seen, dt_s / SUB, law))
    if law == "keeps":
        data = without_waiting(data, DEAD_S)
    found = held_in_reset(data, [IDEAL], 1.3 * DEAD_S)
    sure = found is not None and 200 * found.gain > lost_module.SURELY
    assert sure == (law == "resets")
    if found and sure:
        assert found.dead_s == pytest.approx(DEAD_S, rel=0.1)
        np.testing.assert_allclose(found.theta, [0.25, 0.2], rtol=0.08)
        assert (found.kept > 1.1 * found.theta).all()


def test_a_reset_that_sums_do_not_show(monkeypatch: pytest.MonkeyPatch) -> None:
    """The path's errors may add up in them: of 60 cameras 4 more were recognised, and the worst
    threshold was off by 29 instead of 44 %."""
    dn, dt_s = film(), FRAME_S / STEPS
    data = sample_of(dn, dead_events(integrated(dn, dt_s, 0.0, 0.0, SUB), dt_s / SUB, "resets"))
    kept = find(data)
    monkeypatch.setattr(lost_module, "_reset_by_sums", lambda found, *_: (found, None))
    found, lost = lost_contrast(data, kept, 1.3 * DEAD_S)
    assert lost is not None
    assert lost.law == "resets"
    theta = (found.theta if found.needed else found.ideal_theta) / lost.excess
    np.testing.assert_allclose(theta, [0.25, 0.2], rtol=0.1)
    np.testing.assert_allclose(lost.theta, [0.25, 0.2], rtol=0.1)


def test_events_that_waited_for_their_dead_time_do_not_count_as_crossings() -> None:
    """Their light has gone on: it looks like a slow photoreceptor, and like frames with a delay."""
    dn, dt_s = view(), FRAME_S / STEPS
    data = sample_of(dn, dead_events(integrated(dn, dt_s, 0.0, 0.0, SUB), dt_s / SUB, "keeps"))
    before, after = find(data), find(without_waiting(data, DEAD_S))
    assert before.seen.cutoff_hz > 0
    assert before.seen.delay_s < -2e-3
    assert after.used.cutoff_hz == 0
    assert abs(after.used.delay_s) < 5e-4
    assert after.explained[0] > max(before.explained) + 0.02
    np.testing.assert_allclose(after.theta, [0.25, 0.2], rtol=0.05)


def test_intervals_that_are_missing_tell_a_loss_from_an_offset(
    monkeypatch: pytest.MonkeyPatch
) -> None:
    """An offset may explain as much; but then there are intervals as short as the path makes."""
    dn, dt_s = film(), FRAME_S / STEPS
    seen = integrated(dn, dt_s, 0.0, 0.0, SUB)
    data = sample_of(dn, dead_events(seen, dt_s / SUB, "resets"))
    kept = find(data)
    share = lost_module._too_fast(data, kept, 0.7 * 1.3 * DEAD_S)
    assert share > 4 * lost_module.MISSING > 0
    ideal = sample_of(dn, events_of(seen, dt_s / SUB, 0.0, 0.25, 0.2))
    shortest_s = np.quantile(intervals_of(ideal), 0.01) * dt_s
    assert lost_module._too_fast(ideal, find(ideal), 0.7 * shortest_s) < 0.2 * share
    monkeypatch.setattr(lost_module, "held_in_reset", lambda *_: None)
    monkeypatch.setattr(lost_module, "find", lambda one: dataclasses.replace(
        find(one), explained=(kept.explained[int(kept.needed)],) * 2))  # as by an offset
    found = [lost_contrast(data, kept, 1.3 * DEAD_S)[1]]
    monkeypatch.setattr(lost_module, "_too_fast", lambda *_: 0.0)
    found.append(lost_contrast(data, kept, 1.3 * DEAD_S)[1])
    assert found[0] is not None
    assert found[0].law == "resets"
    assert found[1] is None


def test_long_intervals_tell_of_no_dead_time() -> None:
    """A loss in 10 ms seemed to explain an ideal camera with few events: theta_off was 62 % low."""
    dn, dt_s = film(), FRAME_S / STEPS
    data = sample_of(dn, dead_events(integrated(dn, dt_s, 0.0, 0.0, SUB), dt_s / SUB, "resets"))
    kept = find(data)
    assert lost_contrast(data, kept, 1.01 * lost_module.TOO_LONG_S) == (kept, None)
    assert lost_contrast(data, kept, 0.8 * lost_module.TOO_LONG_S)[1] is not None


def intervals_of(data: Sample) -> np.ndarray:
    """Between successive events of a pixel, in fine steps."""
    used = np.asarray(data.weight[0]) > 0
    pixel, at = np.asarray(data.pixel[0])[used], np.asarray(data.at[0])[used]
    return np.diff(at)[np.diff(pixel) == 0]


def test_thresholds_that_are_none_say_nothing_of_a_loss(monkeypatch: pytest.MonkeyPatch) -> None:
    dn, dt_s = film(), FRAME_S / STEPS
    data = sample_of(dn, dead_events(integrated(dn, dt_s, 0.0, 0.0, SUB), dt_s / SUB, "drops"))
    assert lost_contrast(data, find(data), DEAD_S, DEAD_S)[1] is not None
    solved = lost_module._solved
    monkeypatch.setattr(lost_module, "_solved", lambda *a: (
        solved(*a)[0] * np.array([1.0, -1.0]), solved(*a)[1]))
    kept = find(data)
    assert lost_contrast(data, kept, DEAD_S, DEAD_S) == (kept, None)


def test_too_few_events_and_no_thresholds_say_nothing_of_what_is_never_sent() -> None:
    dn, dt_s = view(), FRAME_S / STEPS
    data = sample_of(dn, dead_events(integrated(dn, dt_s, 0.0, 0.0, SUB), dt_s / SUB, "keeps"))
    found = find(without_waiting(data, DEAD_S))
    for theta in ([np.nan, 0.2], [0.2, np.nan], [-0.1, 0.2], [0.25, 50.0]):
        other = dataclasses.replace(found, theta=np.array(theta))
        assert kept_contrast(data, other, DEAD_S) is None


@pytest.mark.parametrize(("dead_s", "some"), [(DEAD_S, True), (1e-4, False)])
def test_contrast_that_is_kept_and_never_sent_is_known_from_the_path(
    dead_s: float, some: bool
) -> None:
    dn, dt_s = view(), FRAME_S / STEPS
    data = sample_of(dn, dead_events(integrated(dn, dt_s, 0.0, 0.0, SUB), dt_s / SUB, "keeps"))
    found = find(without_waiting(data, DEAD_S))
    lost = kept_contrast(data, found, dead_s)
    assert (lost is not None) == some
    if lost:
        assert lost.law == "keeps"
        assert ((lost.excess > 1.05) & (lost.excess < 1.5)).all()
        value, error = lost.corrected(0, 0.3, 0.01)
        assert value == pytest.approx(0.3 / lost.excess[0])
        assert error > 0.01 / lost.excess[0]
