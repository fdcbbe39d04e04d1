"""Thresholds of cameras that are not ideal: the network's, the regression's, and their mean."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import numpy as np
import pytest

from evflow.camera import Camera, Summary
from evflow.estimation import maps
from evflow.estimation.maps import (
    SLOW_BIAS,
    regressed,
    with_contrast_lost,
    with_rolling_error,
)
from evflow.estimation.refine import Lost
from evflow.estimation.refine.receptor_result import STEPPED_LOW, Found, OtherMap
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


def test_thresholds_from_rolling_frames_are_less_certain() -> None:
    std = with_rolling_error(SUMMARY, STD, 0.01)
    assert thetas(std) == pytest.approx([np.hypot(0.01, 0.016), np.hypot(0.02, 0.02)])
    assert dataclasses.replace(std, theta_on=STD.theta_on, theta_off=STD.theta_off) == STD
    assert thetas(with_rolling_error(SUMMARY, STD, 1.0))[0] == pytest.approx(0.0316, rel=0.01)


def test_what_is_open_of_offset_map_and_loss_is_in_the_errors_of_thresholds() -> None:
    ideal = found(0.9)
    assert thetas(maps._with_open(SUMMARY, STD, ideal)) == pytest.approx([0.01, 0.02])
    open_ = dataclasses.replace(ideal, offset_open=np.array([0.05, 0.08]))
    assert thetas(maps._with_open(SUMMARY, STD, open_)) == pytest.approx(
        [np.hypot(0.01, 0.01), np.hypot(0.02, 0.02)])
    losing = dataclasses.replace(open_, loss_open=np.array([0.1, 0.0]))
    assert thetas(maps._with_open(SUMMARY, STD, losing)) == pytest.approx(
        [np.sqrt(2e-4 + 4e-4), np.hypot(0.02, 0.02)], rel=1e-5)
    both = dataclasses.replace(open_, other_map=OtherMap(0.25, np.exp([0.1, 0.0])))
    assert thetas(maps._with_open(SUMMARY, STD, both)) == pytest.approx(
        [np.sqrt(2e-4 + 1e-4), np.hypot(0.02, 0.02)], rel=1e-5)


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


@pytest.mark.parametrize("offset", [20.0, -8.0, 0.0])
def test_the_offset_follows_the_refined_thresholds(offset: float) -> None:
    """As an offset of a true camera that was found 6 DN too large, with thresholds 8 % too low."""
    searched = dataclasses.replace(
        found(0.9, offset_dn=offset), covariance=np.diag([36.0, 0.0, 0.0]),
        theta_error=np.full(2, 0.08))
    optics = searched.optics
    same = searched.optics_given(STEPPED_LOW, 0.02)  # what the steps always lack
    assert dataclasses.asdict(same) == pytest.approx(
        dataclasses.asdict(optics), rel=0, abs=0, nan_ok=True)
    moved = searched.optics_given(STEPPED_LOW + 0.08, 0.02).offset_dn - offset
    assert moved == pytest.approx(-5.0 if offset else 0.0, abs=0.5)
    unsure = searched.optics_given(STEPPED_LOW + 0.08, 0.2).offset_dn - offset
    assert abs(unsure) <= abs(moved) / 3
    assert offset * searched.optics_given(3.0, 0.02).offset_dn >= 0
    assert abs(searched.optics_given(-3.0, 0.02).offset_dn) <= 2 * abs(offset)


def test_all_but_the_thresholds_are_left() -> None:
    summary = regressed(SUMMARY, STD, found(0.9))[0]
    same = dataclasses.replace(summary, theta_on=SUMMARY.theta_on, theta_off=SUMMARY.theta_off)
    assert same == SUMMARY


def lost_by_reset(on: float, unexplained: float = 0.0) -> Lost:
    """SUMMARY's thresholds, too high by 1.25 (ON) and right (OFF); a regression that says `on`."""
    return Lost("resets", 2e-3, np.array([1.25, 1.0]), np.array([on, 0.25]), unexplained)


def test_thresholds_of_pixels_that_lose_contrast_are_lowered_and_their_errors_grow() -> None:
    maps, errors = (Camera(*(np.full((2, 3), v, np.float32) for v in values))
                    for values in ((0.2, 0.25, 0.1, 0.1), (0.02, 0.02, 0.03, 0.03)))
    camera, std, summary, summary_std = with_contrast_lost(
        maps, errors, SUMMARY, STD, lost_by_reset(0.16), ())
    for values in (camera, summary):
        np.testing.assert_allclose(values.theta_on, 0.16, rtol=1e-6)
        np.testing.assert_allclose(values.theta_off, 0.25, rtol=1e-6)
        np.testing.assert_array_equal(values.eta_on, np.float32(0.1))
    assert 0.16 * 0.045 < float(summary_std.theta_on) < 0.16 * 0.06  # neither of the two alone
    for got, value, error, shared in ((std.theta_on, 0.16, summary_std.theta_on, 0.01 / 0.2),
                                      (std.theta_off, 0.25, summary_std.theta_off, 0.02 / 0.25)):
        own = (0.1 if value == 0.16 else 0.08) ** 2 - shared**2  # relative; of all, 0 for OFF
        np.testing.assert_allclose(got, np.hypot(value * np.sqrt(own), float(error)), rtol=1e-4)
    assert float(summary.sigma_on) == pytest.approx(0.03 / 1.25)
    assert float(summary.sigma_off) == pytest.approx(0.03)


def test_where_counts_and_regression_disagree_about_a_loss_both_count_and_errors_grow() -> None:
    apart, alike = (lost_by_reset(on).corrected(0, 0.2, 0.002) for on in (0.1, 0.16))
    assert 0.11 < apart[0] < 0.15
    assert apart[1] > 3 * alike[1]
    assert lost_by_reset(0.1).corrected(0, 0.2, np.nan)[0] < 0.16
    unclear = lost_by_reset(0.16, 0.2).corrected(0, 0.2, 0.002)
    assert unclear[0] == pytest.approx(0.16)
    assert unclear[1] > 1.5 * alike[1]
    assert np.isnan(lost_by_reset(0.1).corrected(0, 0.2, np.nan)[1])


def test_a_threshold_of_the_prior_is_not_corrected() -> None:
    maps = Camera(*(np.full((2, 3), v, np.float32) for v in (0.2, 0.25, 0.1, 0.1)))
    camera, std, summary, summary_std = with_contrast_lost(
        maps, maps, SUMMARY, STD, lost_by_reset(0.1), ("on", "off"))
    assert (summary, summary_std) == (SUMMARY, STD)
    assert camera is std is maps


def test_what_pixels_share_may_become_smaller_and_is_not_made_their_own() -> None:
    """A camera that is drawn from the estimate is as uneven as before."""
    shape, own, shared = (40, 50), 0.03, 0.2
    camera = Camera(*(np.full(shape, v, np.float32) for v in (0.2, 0.25, 0.1, 0.1)))
    errors = Camera(*(np.full(shape, 0.2 * np.hypot(own, shared), np.float32),) * 4)
    sure = dataclasses.replace(STD, theta_on=np.float32(0.2 * shared))
    lowered, std, summary, summary_std = with_contrast_lost(
        camera, errors, SUMMARY, sure, lost_by_reset(0.16), ("off",))
    assert float(summary_std.theta_on) / 0.16 < 0.07
    known = {"theta_on": float(summary_std.theta_on) / float(summary.theta_on)}
    drawn = lowered.drawn(jax.random.key(0), std, known)
    assert np.std(np.asarray(drawn.theta_on)) / 0.16 == pytest.approx(own, rel=0.1)
