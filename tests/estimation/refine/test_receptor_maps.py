"""Which logarithm pixels have in dim light, and what stays open of it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
from helpers.films import FRAME_S, INTERVALS, SHAPE, SUB, integrated, lin_log, log_eps
from helpers.samples import events_of, looked_at, sample_of

from evflow.estimation.refine.path import STEPS
from evflow.estimation.refine.receptor_data import Sample
from evflow.estimation.refine.receptor_descent import PLAIN
from evflow.estimation.refine.receptor_maps import BLACK, left_open, with_map
from evflow.estimation.refine.receptor_result import OtherMap
from evflow.estimation.refine.receptor_search import find

THETA = [0.25, 0.2]


def two_levels(log: Callable[[np.ndarray], np.ndarray]) -> Sample:
    """What such pixels show of one edge that swings to and fro, of 10 DN beside 30, with a path
    that fades from frame to frame where the edge moves."""
    t = np.linspace(0, INTERVALS * FRAME_S, INTERVALS * STEPS + 1)[:, None, None]
    x = np.arange(SHAPE[1])[None, None] + np.zeros((1, SHAPE[0], 1))
    edge = SHAPE[1] * (0.5 + 0.45 * np.sin(4 * np.pi * t))
    dn = 10 + 20 / (1 + np.exp(3 * (x - edge)))
    seen = integrated(dn, FRAME_S / STEPS, 0.0, 0.0, SUB, log=log)
    late = np.arange(STEPS)[None, :, None, None] / STEPS
    frames = dn[::STEPS, None]
    faded = (frames[:-1] * (1 - late) + frames[1:] * late).reshape(-1, *SHAPE)
    return sample_of(np.concatenate([faded, dn[-1:]]),
                     events_of(seen, FRAME_S / STEPS / SUB, 0.0, *THETA))


def test_of_two_levels_either_map_may_be_the_right_one() -> None:
    """Of ESIM's pixels: twice too high thresholds by lin-log, whose error knows of the others."""
    found = find(two_levels(log_eps))
    assert found.seen.log_map == "linlog"
    other = found.other_map
    assert other.chance > 0.3
    away = np.log(found.ideal_theta / THETA)
    assert (away > 0.3).all()
    assert (away < 1.5 * other.theta_error).all()
    assert found.ideal_theta * other.ratio == pytest.approx(THETA, rel=0.3)


def test_of_two_levels_lin_log_shows_by_its_slope_in_the_dark() -> None:
    found = find(two_levels(lin_log))
    assert found.seen.log_map == "linlog"
    assert (found.other_map.theta_error < 0.01).all()
    assert (np.abs(np.log(found.other_map.ratio)) > 0.5).all()


@pytest.mark.parametrize(("log", "gain"), [(lin_log, 0.15), (log_eps, 0.15), (lin_log, 1.0)])
def test_of_many_levels_the_other_map_is_none(
    log: Callable[[np.ndarray], np.ndarray], gain: float
) -> None:
    found = find(looked_at(0.0, 0.0, gain=gain, log=log))
    assert found.other_map is None or (found.other_map.theta_error < 0.005).all()


def test_bright_light_leaves_nothing_open() -> None:
    data = looked_at(0.0, 0.0)
    _, other = with_map(data._replace(dn=data.dn + BLACK))  # 36 DN and more
    assert other is None


def test_an_offset_counts_against_the_map_that_needs_it() -> None:
    begun, other = with_map(looked_at(0.0, 60.0, gain=0.15))
    at = np.array([0.0, *begun.phi[1:]])
    same = dataclasses.replace(begun, phi=at)
    assert left_open(begun.model, at, None, 100.0) is None
    assert left_open(begun.model, at, same, 100.0).chance == 0.5
    assert left_open(begun.model, PLAIN, same, 100.0).chance == 0.5  # of two that are ideal
    ahead = left_open(begun.model, np.array([0.01, *at[1:]]), same, 100.0)
    assert ahead.chance == 0.5  # at most, also where the other is the better
    assert left_open(begun.model, at, other, 100.0).chance < 1e-6


def test_a_mixture_of_two_values_has_their_distance_as_error() -> None:
    assert OtherMap(0.25, np.array([np.e, 1 / np.e])).theta_error == pytest.approx([0.5, 0.5])
    assert OtherMap(0.5, np.ones(2)).theta_error == pytest.approx([0.0, 0.0])
