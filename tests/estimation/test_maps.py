"""Thresholds of cameras that are not ideal: the network's, the regression's, and their mean."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from evflow.camera import Summary
from evflow.estimation.maps import SLOW_BIAS, agreed, regressed
from evflow.estimation.refine.receptor_result import Found
from evflow.simulator.photoreceptor import TYPICAL, Photoreceptor

SUMMARY = Summary(*(np.float32(v) for v in (0.2, 0.25, 0.1, 0.1, 0.03, 0.03)))
STD = Summary(*(np.float32(v) for v in (0.01, 0.02, 0.03, 0.04, 0.005, 0.006)))


def found(explained: float, **photoreceptor: Any) -> Found:
    """A photoreceptor with thresholds of .3 by the regression, which explains this share."""
    return Found(
        Photoreceptor(**photoreceptor), np.full(2, 0.3), np.full(2, 0.3), np.eye(3), np.zeros(2),
        (0.5, explained), 1.0, 0.0, 400.0, np.zeros((2, 3)), np.zeros((2, 2)))


def thetas(summary: Summary) -> list[float]:
    return [float(summary.theta_on), float(summary.theta_off)]


def test_of_slow_pixels_the_networks_thresholds_are_lowered_and_count_less() -> None:
    poor = found(0.5)  # a path that explains half of the events says next to nothing
    fast, error = regressed(SUMMARY, STD, poor)
    assert thetas(fast) == pytest.approx([0.2, 0.25], rel=0.2)
    slow, wider = regressed(SUMMARY, STD, found(0.5, tau_s=5e-3, by_light=False))
    by_light, _ = regressed(SUMMARY, STD, found(0.5, tau_s=5e-3 * TYPICAL))
    late = np.exp(-SLOW_BIAS * 5e-3)
    assert thetas(by_light) == thetas(slow)
    assert late < thetas(slow)[0] / thetas(fast)[0] < late**0.3
    assert float(wider.theta_on) / thetas(slow)[0] == pytest.approx(
        float(error.theta_on) / thetas(fast)[0], rel=0.15)
    slowest, widest = regressed(SUMMARY, STD, found(0.5, tau_s=2e-2, by_light=False))
    assert float(widest.theta_on) / thetas(slowest)[0] > 1.3 * (
        float(error.theta_on) / thetas(fast)[0])


@pytest.mark.parametrize(("explained", "weight"), [(1.0, 0.8), (0.9, 0.29), (0.5, 0.04)])
def test_the_regression_counts_by_what_it_explains(explained: float, weight: float) -> None:
    by_regression = found(explained).thresholds()[0]
    away = np.log(thetas(agreed(SUMMARY, found(explained)))) - np.log(thetas(SUMMARY))
    np.testing.assert_allclose(
        away / np.log(by_regression / np.array(thetas(SUMMARY))), weight, atol=0.03)


def test_all_but_the_thresholds_are_left() -> None:
    for summary in (regressed(SUMMARY, STD, found(0.9))[0], agreed(SUMMARY, found(0.9))):
        same = dataclasses.replace(
            summary, theta_on=SUMMARY.theta_on, theta_off=SUMMARY.theta_off)
        assert same == SUMMARY
