"""Noise among the events of the pooled regression: how much there is, and where groups part."""

from __future__ import annotations

import numpy as np
import pytest

from evflow.estimation.refine import receptor_noise
from evflow.estimation.refine.receptor_data import Sample
from evflow.estimation.refine.receptor_noise import split_at_noise
from evflow.estimation.refine.receptor_prior import Prior
from evflow.estimation.refine.receptor_profile import along_offset, offset_open
from evflow.estimation.refine.sightings import sight
from evflow.estimation.refine.still_noise import noise_rates
from evflow.simulator.photoreceptor import IDEAL, Photoreceptor
from evflow.types import Events

SHAPE, INTERVALS, STEPS, FRAME_US = (24, 32), 40, 2, 50_000


def seen(rates: tuple[float, float], moving: slice) -> np.ndarray:
    """`noise_rates` of pixels at rest that send noise, and of some columns that brighten and send
    an ON event in every interval."""
    rng = np.random.default_rng(0)
    height, width = SHAPE
    path = np.full((INTERVALS * STEPS + 1, *SHAPE), 4.0, np.float32)
    path[:, :, moving] += 0.1 * np.arange(len(path), dtype=np.float32)[:, None, None]
    rows = []
    for on, hz in zip((True, False), rates, strict=True):
        n = rng.poisson(hz * height * width * INTERVALS * FRAME_US * 1e-6)
        rows.append((rng.integers(0, width, n), rng.integers(0, height, n),
                     rng.integers(1, INTERVALS * FRAME_US, n), np.full(n, on)))
    y, x = np.mgrid[:height, range(*moving.indices(width))]
    for k in range(INTERVALS):
        rows.append((x.ravel(), y.ravel(), np.full(x.size, k * FRAME_US + 25_000),
                     np.full(x.size, True)))
    x, y, t, p = (np.concatenate(column) for column in zip(*rows, strict=True))
    order = np.argsort(t, kind="stable")
    events = Events(x[order], y[order], t[order], p[order], (width, height))
    times = np.arange(INTERVALS + 1) * FRAME_US
    return noise_rates(sight(events, times, path, STEPS), np.full(INTERVALS, FRAME_US * 1e-6))


@pytest.mark.parametrize(("rates", "moving"), [
    ((2.0, 0.7), slice(0, 0)), ((2.0, 0.7), slice(0, 12)), ((0.0, 3.0), slice(20, 32))])
def test_noise_is_counted_where_nothing_brightens(
    rates: tuple[float, float], moving: slice
) -> None:
    np.testing.assert_allclose(seen(rates, moving), rates, rtol=0.1, atol=0.02)


def test_where_all_brightens_no_on_noise_is_told() -> None:
    on, off = seen((0.0, 1.0), slice(0, 32))
    assert on == 0.0
    assert off == pytest.approx(1.0, rel=0.1)


def one_pixel(noise_hz: float) -> Sample:
    """Of a pixel that brightens for 40 fine steps of a millisecond and then rests: ON events while
    it does, then ON and OFF."""
    light = np.exp(np.concatenate([np.linspace(4.0, 5.0, 41), np.full(40, 5.0)]))
    at = np.array([10.0, 20.0, 30.0, 55.0, 65.0, 75.0, 0.0])
    on, off = np.array([1, 2, 3, 4, 4, 5, 0.0]), np.array([0, 0, 0, 0, -1, -1, 0.0])
    weight, zeros = np.array([1, 1, 1, 1, 1, 1, 0.0]), np.zeros(7, np.int32)
    return Sample(*(np.asarray(v)[None] for v in (
        light[:, None].astype(np.float32), np.full(80, 1e-3, np.float32), zeros, at, on, off,
        weight, zeros, np.zeros(1, np.int32), np.full(2, noise_hz, np.float32), np.float32(0.08))))


@pytest.mark.parametrize(("noise_hz", "tau_s", "groups"), [
    (0.1, 0.0, [0, 0, 0, 0, 0, 0, 0]), (2.0, 0.0, [0, 0, 0, 1, 2, 3, 0]),
    (2.0, 0.02, [0, 0, 0, 0, 1, 1, 0])])  # a slow pixel still rises
def test_groups_part_where_noise_is_likely(
    noise_hz: float, tau_s: float, groups: list[int]
) -> None:
    seen_by = Photoreceptor(tau_s=tau_s, by_light=False) if tau_s else IDEAL
    assert np.asarray(split_at_noise(one_pixel(noise_hz), seen_by).group)[0].tolist() == groups


def test_thresholds_that_noise_makes_small_do_not_explain_it(
    monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(receptor_noise, "MISSED_HZ", 0.0)
    data = one_pixel(2.0)
    small = split_at_noise(data, IDEAL, np.full(2, 1e-3)).group
    np.testing.assert_array_equal(small, split_at_noise(data, IDEAL).group)


class Bent:
    """A regression whose thresholds go with the offset, e-fold in 50 DN and 25 DN, and which says
    nothing of it, or that there is none."""

    prior = Prior()

    def __init__(self, sharp: float = 0.0) -> None:
        self.sharp = sharp

    def unexplained(self, phi: np.ndarray) -> float:
        return self.sharp * float(phi[0]) ** 2

    def solved(self, phi: np.ndarray) -> tuple[np.ndarray, float, float]:
        return np.exp(np.array([-0.02, -0.04]) * phi[0]), 0.0, 1.0


@pytest.mark.parametrize("above", [1.0, 2.0, 4.0])
def test_how_far_the_offset_goes_is_read_off_the_likelihood(above: float) -> None:
    """Two halves of normal distributions, whose mean square is known; the curvature knows one."""
    def minus_log(phi: np.ndarray) -> float:
        away = (phi[0] - 10.0) / (2.0 * (above if phi[0] > 10.0 else 1.0))
        return 0.5 * float(away**2)

    square, thetas = along_offset(
        np.array([10.0, 0.0, 0.0]), Bent(), np.diag([4.0, 1.0, 1.0]),  # type: ignore[arg-type]
        minus_log, lambda at: at)
    expected = 4.0 * (1 + above**3) / (1 + above)
    assert square == pytest.approx(expected, rel=0.15)
    np.testing.assert_allclose(np.sqrt(thetas / square), [0.02, 0.04], rtol=1e-6)


def test_an_offset_of_which_nothing_is_known_is_in_the_errors() -> None:
    """By half, as of every second camera."""
    one, other = offset_open(Bent(), 400.0)  # type: ignore[arg-type]
    assert other == pytest.approx(2 * one)
    offsets = np.random.default_rng(0).normal(0, 25.0, 100_000)
    offsets = offsets[(offsets > -26) & (offsets < 62)]
    assert one == pytest.approx(0.02 * np.sqrt(0.5 * (offsets**2).mean()), rel=0.02)
    assert offset_open(Bent(1.0), 400.0).max() < 1e-3  # type: ignore[arg-type]


def test_an_offset_at_which_brightness_falls_with_on_events_is_none() -> None:
    class Falling(Bent):
        def solved(self, phi: np.ndarray) -> tuple[np.ndarray, float, float]:
            theta, *rest = super().solved(phi)
            return theta * np.where([phi[0] > 20.0, phi[0] < -15.0], [0.0, -1.0], 1.0), *rest

    errors = offset_open(Falling(), 400.0)  # type: ignore[arg-type]
    assert (errors > 0.0).all()
    assert (errors < offset_open(Bent(), 400.0)).all()  # type: ignore[arg-type]
