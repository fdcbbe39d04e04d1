"""The offset of the frames by what events add up to between them, and what is made of it."""

from __future__ import annotations

import numpy as np
import pytest

from evflow.estimation.refine.net_changes import (
    ENOUGH,
    LAGS,
    LEAST_SEEN,
    Changes,
    changes,
    joined,
    offset_by_changes,
)
from evflow.estimation.refine.receptor_prior import PRIOR, Prior
from evflow.estimation.refine.sightings import sight
from evflow.light.log_maps import log64
from evflow.types import Events

THETA = (0.25, 0.2)


def seen_with(offset: float, n: int = 4000, there_and_back: float = 0.5, seed: int = 0) -> Changes:
    """Changes between two frames of pixels that see `offset` DN more than these show: the memory
    lies anywhere within a threshold at the first, and some go up and down again meanwhile."""
    rng = np.random.default_rng(seed)
    before, after = np.exp(rng.uniform(np.log(25.0), np.log(220.0), (2, n)))
    rise = log64(after + offset, "linlog") - log64(before + offset, "linlog")
    pairs = rng.poisson(there_and_back, n)
    on = np.floor(np.maximum(rise, 0.0) / THETA[0] + rng.random(n)) + pairs * (rng.random(n) < 0.9)
    off = np.floor(np.maximum(-rise, 0.0) / THETA[1] + rng.random(n)) + pairs
    return Changes(before, after, on, off, rng.integers(0, 48, n))


@pytest.mark.parametrize("offset", [-16.0, -6.0, 0.0, 10.0, 25.0])
def test_the_offset_is_found_without_a_path(offset: float) -> None:
    found, std = offset_by_changes((seen_with(offset), seen_with(offset, seed=1)), LEAST_SEEN)
    assert std < 6.0
    assert abs(found - offset) < 2.0 * std


@pytest.mark.parametrize("of_lags", [
    (seen_with(0.0), seen_with(0.0, ENOUGH - 1)),
    tuple(c._replace(on=np.random.default_rng(0).permutation(c.on),
                     off=np.random.default_rng(1).permutation(c.off))
          for c in (seen_with(0.0), seen_with(0.0, seed=1))),
    (seen_with(-16.0), seen_with(40.0)),
], ids=["few", "events that no change explains", "lags that contradict each other"])
def test_where_nothing_is_told(of_lags: tuple[Changes, ...]) -> None:
    assert offset_by_changes(of_lags, LEAST_SEEN) == (0.0, np.inf)


def test_of_few_pixels_nothing_is_told() -> None:
    alike = seen_with(25.0), seen_with(25.0, seed=1)
    assert offset_by_changes(alike, 64 * 64 * 8) == (0.0, np.inf)


def test_changes_are_those_of_shown_pixels_with_their_events() -> None:
    """Five frames of three pixels, one of which is dark and one of which does not change."""
    times = np.arange(5) * 10_000
    light = np.array([[50, 2, 90], [60, 2, 90], [70, 9, 90], [80, 9, 91], [90, 9, 91]], float)
    path = np.repeat(np.log(light), 2, axis=0)[:9, None].astype(np.float32)
    events = Events(np.array([0, 0, 2, 0]), np.zeros(4, int), np.array([5_000, 15_000, 16_000,
                                                                       38_000]),
                    np.array([True, True, True, False]), (3, 1))
    s = sight(events, times, path, 2)
    short, long = changes(
        light[:, None], s, np.arange(3), np.zeros(3, bool), np.random.default_rng(0))
    assert short.before.tolist() == [50, 60, 70]
    assert short.after.tolist() == [70, 80, 90]
    assert (short.on.tolist(), short.off.tolist()) == ([2, 1, 0], [0, 0, 1])
    assert [v.tolist() for v in long] == [[50], [90], [2], [1], [0]]
    of_first = np.arange(3) == 0
    rest = changes(light[:, None], s, np.arange(3), of_first, np.random.default_rng(0))
    assert [len(c.on) for c in rest] == [0, 0]
    twice = joined([(short, long), (short, long)])
    assert len(twice) == len(LAGS)
    assert twice[0].on.tolist() == [2, 1, 0] * 2


def test_the_measured_offset_and_the_spread_of_cameras_make_the_prior() -> None:
    prior = Prior(16.0, 2.0)
    weights = np.array([PRIOR[0] ** -2, prior.offset_std**-2])
    assert prior.centre[0] == pytest.approx(weights[1] * 16.0 / weights.sum())
    assert prior.std[0] == pytest.approx(weights.sum() ** -0.5)
    assert Prior().centre.tolist() == [0.0, 0.0, 0.0]
    np.testing.assert_allclose(Prior().std, PRIOR)
    assert prior.minus_log(prior.centre) == 0.0


@pytest.mark.parametrize(("prior", "for_some"), [
    (Prior(16.0, 2.0), True), (Prior(-9.0, 3.0), True), (Prior(1.0, 2.0), False),
    (Prior(11.0, 14.0), False)])
def test_odds_of_an_offset(prior: Prior, for_some: bool) -> None:
    assert (prior.evidence() > 0.0) == for_some
    assert prior.evidence() < 5.0  # changes mislead now and then
    assert prior.log_odds(prior.offset_dn) > prior.log_odds(3.0 * prior.offset_dn)


def test_without_changes_the_odds_are_even() -> None:
    assert Prior().evidence() == Prior().log_odds(20.0) == 0.0
