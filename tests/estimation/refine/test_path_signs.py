"""What the search for a photoreceptor tells the fusion."""

from __future__ import annotations

import numpy as np
import pytest

from evflow.estimation.refine.path_signs import LENIENT, NAMES, path_signs
from evflow.estimation.refine.receptor_result import Found
from evflow.simulator.photoreceptor import Photoreceptor

THETA = np.array([0.2, 0.3])


def found(chance: float, few: float = 0.0) -> Found:
    return Found(
        Photoreceptor(20.0, 1e-3, 2e-4), np.array([0.19, 0.27]), np.array([0.25, 0.36]),
        np.diag([4.0, 1e-7, 1e-7]), np.array([0.04, 0.06]), (0.7, 0.9),
        chance, few, 400.0, np.array([[0.01, 0.02, 0.03], [0.04, 0.05, 0.06]]), np.zeros((2, 2)))


def named(chance: float, few: float = 0.0) -> dict[str, float]:
    return dict(zip(NAMES, path_signs(found(chance, few), 1.5, 0.02, THETA), strict=True))


def test_signs_are_those_that_are_named() -> None:
    seen, ideal = named(1.0), named(0.0)
    assert seen["regression_on"] == pytest.approx(np.log(0.19 / (1 - 1.5 * 0.1) / 0.2))
    assert seen["found_regression_off"] == pytest.approx(np.log(0.27 / 0.3))
    assert seen["ideal_regression_on"] == pytest.approx(np.log(0.25 / 0.2))
    assert (seen["smear_10"], seen["theta_10_on"], seen["theta_20_off"]) == (0.01, 0.02, 0.06)
    assert (seen["offset"], seen["offset_unneeded"], seen["odds"]) == (1.0, 0.0, 1.0)
    assert (seen["tau"], seen["delay"], seen["frame_noise"]) == pytest.approx((1.0, 0.2, 0.5))
    assert seen["blur"] == pytest.approx(2.0)
    assert seen["open_on"] == pytest.approx(np.log(0.05))
    assert seen["open_unneeded_on"] == pytest.approx(np.log(0.01))
    assert seen["unexplained"] == pytest.approx(0.1)
    assert seen["poor"] == seen["missed_on"] == 0.0
    assert ideal["regression_off"] == pytest.approx(np.log(0.36 / (1 - 1.5 * 0.3) / 0.3))
    assert ideal["needed"] == ideal["offset"] == ideal["tau"] == 0.0
    assert (ideal["offset_unneeded"], ideal["tau_unneeded"], ideal["odds"]) == (1.0, 1.0, -1.0)
    assert ideal["open_unneeded_off"] == pytest.approx(np.log(0.07))


@pytest.mark.parametrize(("chance", "missed"), [
    (1.0, 0.0), (1e-9, 0.0), (1 / (1 + np.exp(LENIENT)), 0.5)], ids=["found", "none", "open"])
def test_what_may_have_been_missed_counts_by_its_chance(chance: float, missed: float) -> None:
    assert named(chance)["missed_on"] == pytest.approx(missed * np.log(0.19 / 0.25), abs=1e-4)


def test_where_little_was_watched_a_slow_pixel_is_missed_as_easily() -> None:
    """What it takes to believe in one makes no camera the more ideal."""
    odds = -7.0
    less = 1 / (1 + np.exp(-odds + 3.0))
    assert named(less, 3.0) == pytest.approx(named(1 / (1 + np.exp(-odds))))


def test_thresholds_far_apart_are_bounded_and_no_search_says_nothing() -> None:
    far = path_signs(found(1.0), 1.5, 0.02, np.array([1e-3, 10.0]))
    assert np.abs(far).max() < 10.0
    assert not path_signs(None, 1.5, 0.02, THETA).any()
    assert path_signs(None, 1.5, 0.02, THETA).shape == (len(NAMES),)
