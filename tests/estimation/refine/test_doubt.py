"""How far thresholds may be off: what it goes by, and its fit."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from evflow.camera import Summary
from evflow.errors import EvflowDataError
from evflow.estimation.refine.doubt import LENIENT, NAMES, doubted, relative_error, signs
from evflow.estimation.refine.receptor_result import Found
from evflow.simulator.photoreceptor import Photoreceptor
from experiments.shared import doubt_fit

SUMMARY = Summary(*(np.float32(v) for v in (0.2, 0.3, 0.1, 0.1, 0.03, 0.03)))
STD = Summary(*(np.float32(v) for v in (0.01, 0.02, 0.03, 0.04, 0.005, 0.006)))


def found(chance: float, few: float = 0.0) -> Found:
    return Found(
        Photoreceptor(20.0, 1e-3, 0.0), np.array([0.19, 0.27]), np.array([0.25, 0.36]),
        np.diag([4.0, 1e-7, 1e-7]), np.array([0.04, 0.06]), (0.7, 0.9),
        chance, few, 400.0, np.array([[0.01, 0.02, 0.03], [0.04, 0.05, 0.06]]), np.zeros((2, 2)))


def test_signs_are_those_that_are_named() -> None:
    rows = signs(found(1.0), 1.5, SUMMARY, STD)
    assert rows.shape == (2, len(NAMES))
    seen = [dict(zip(NAMES, row, strict=True)) for row in rows]
    assert seen[0]["regression"] == pytest.approx(np.log(0.19 / 0.2))
    assert seen[1]["regression"] == seen[0]["other_regression"]
    assert (seen[0]["theta_10"], seen[1]["theta_20"]) == (0.02, 0.06)
    assert (seen[0]["offset"], seen[0]["offset_unneeded"], seen[0]["odds"]) == (1.0, 0.0, 1.0)
    assert seen[0]["ideal_regression"] == pytest.approx(np.log(0.25 / 0.2))
    assert seen[0]["open_unneeded"] == pytest.approx(np.log(0.01))
    assert seen[0]["open"] == pytest.approx(np.log(0.02 * 2.0 + 0.01))
    assert seen[0]["poor_ideal"] == 0.0
    ideal = [dict(zip(NAMES, row, strict=True)) for row in signs(found(0.0), 1.5, SUMMARY, STD)]
    assert ideal[0]["regression"] == pytest.approx(np.log(0.25 / 0.2))
    assert ideal[0]["offset"] == ideal[0]["needed"] == 0.0
    assert (ideal[0]["offset_unneeded"], ideal[0]["odds"]) == (1.0, -1.0)
    assert ideal[0]["open_unneeded"] == seen[0]["open"]
    assert ideal[1]["unexplained_ideal"] == pytest.approx(0.3)


@pytest.mark.parametrize(("chance", "missed"), [
    (1.0, 0.0), (1e-9, 0.0), (1 / (1 + np.exp(LENIENT)), 0.5)], ids=["found", "none", "open"])
def test_what_may_have_been_missed_is_added_by_its_chance(chance: float, missed: float) -> None:
    seen = dict(zip(NAMES, signs(found(chance), 0.0, SUMMARY, STD)[0], strict=True))
    more = missed * (np.log(0.19 / 0.25) ** 2 + 0.04**2)
    assert seen["with_missed"] == pytest.approx(0.5 * np.log(0.05**2 + more), abs=1e-4)


def test_the_std_of_the_thresholds_alone_is_replaced() -> None:
    rows = signs(found(1.0), 0.0, SUMMARY, STD)
    net: dict[str, Any] = {"mean": np.zeros(len(NAMES)), "scale": np.ones(len(NAMES)),
                           "map": np.r_[np.zeros(len(NAMES)), np.log(0.05)], "widen": 2.0}
    std = doubted({"other": net}, rows, SUMMARY, STD)
    assert float(std.theta_on) == pytest.approx(0.2 * 0.05 * 2.0)
    assert float(std.theta_off) == pytest.approx(0.3 * 0.05 * 2.0)
    assert dataclasses.replace(std, theta_on=STD.theta_on, theta_off=STD.theta_off) == STD
    ideal = signs(found(0.0), 0.0, SUMMARY, STD)
    narrow = doubted({"other": net, "ideal": {**net, "widen": 1.0}}, ideal, SUMMARY, STD)
    assert float(narrow.theta_on) == pytest.approx(0.2 * 0.05)
    other = {"other": {**net, "mean": np.zeros(3)}}
    for nets, count in ((other, 3), ({"ideal": net}, 0), (net, 0)):
        with pytest.raises(EvflowDataError, match=rf"EV018.*{count} signs"):
            doubted(nets, rows, SUMMARY, STD)


def test_the_fit_finds_whose_errors_are_larger() -> None:
    rng = np.random.default_rng(0)
    x = rng.normal(size=(1500, 3))
    true = 0.05 * np.exp(0.6 * np.clip(x[:, 1], -2.0, 2.0))
    net = doubt_fit.fit(x, true * rng.normal(size=1500), np.full(1500, 0.05))
    fresh = rng.normal(size=(400, 3))
    error = relative_error(net, fresh) / (0.05 * np.exp(0.6 * np.clip(fresh[:, 1], -2.0, 2.0)))
    # Held by RIDGE, and of Student's t: a little less steep, a little narrower.
    assert np.abs(np.log(error)).mean() < 0.15


def test_where_little_was_watched_a_slow_pixel_is_missed_as_easily() -> None:
    """What it takes to believe in one makes no camera the more ideal."""
    odds = -7.0
    less = 1 / (1 + np.exp(-odds + 3.0))
    assert signs(found(less, 3.0), 1.5, SUMMARY, STD) == pytest.approx(
        signs(found(1 / (1 + np.exp(-odds))), 1.5, SUMMARY, STD))
