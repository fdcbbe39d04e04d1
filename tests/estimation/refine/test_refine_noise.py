"""Noise rates of quiet pixels: found where only noise is, not misled by moving edges."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from evflow.camera import noise_of_threshold
from evflow.estimation.refine.chunk import Chunk
from evflow.estimation.refine.noise import (
    STRATA,
    combined_rate,
    quiet_events,
    rate_error,
    stratum_rates,
    tied_probability,
    tied_rates,
    with_tie,
)
from evflow.estimation.refine.pixels import PixelEvidence
from evflow.estimation.refine.sightings import sight
from evflow.estimation.refine.trace import Trace
from evflow.light.log_maps import lin_log
from evflow.types import Events

SHAPE, INTERVALS, STEPS = (60, 80), 8, 2
ETA = np.array([0.6, 0.2])
UNKNOWN = (np.array([0.2, 0.2]), np.array([1.0, 1.0]))  # a network that has no idea


def chunk(counts: np.ndarray, path: np.ndarray) -> Chunk:
    blank = np.zeros(SHAPE)
    nobody = np.zeros(0, int)
    none = Events(nobody, nobody, nobody, nobody > 0, SHAPE[::-1])
    trace = Trace(blank.astype(np.int32), blank, blank > 0, counts.astype(np.float32))
    return Chunk(path, np.ones(SHAPE, bool), np.full(INTERVALS, 0.025, np.float32),
                 np.zeros(INTERVALS, np.float32), trace, PixelEvidence.nothing(SHAPE),
                 np.zeros((2, *SHAPE)), sight(none, 25_000 * np.arange(INTERVALS + 1), path, STEPS))


def noise(seed: int = 0) -> np.ndarray:
    rate = 0.025 * ETA[None, :, None, None]
    return np.random.default_rng(seed).poisson(rate, (INTERVALS, 2, *SHAPE))


def still() -> np.ndarray:
    return np.full((INTERVALS * STEPS + 1, *SHAPE), float(lin_log(np.float32(120.0))), np.float32)


def test_without_signal_every_stratum_is_unbiased() -> None:
    quiet = sum(quiet_events(chunk(noise(s), still()), STEPS) for s in range(10))
    rates = quiet[..., 0] / quiet[..., 1]
    assert (np.abs(rates / ETA - 1.0) < 4.0 / np.sqrt(quiet[..., 0])).all()
    assert (quiet[..., 1] > 0.02 * 10 * SHAPE[0] * SHAPE[1] * 0.2).all()
    np.testing.assert_allclose(combined_rate(quiet, *UNKNOWN), ETA, rtol=0.06)


def test_a_moving_edge_is_left_out() -> None:
    """A wave of ON events crosses half of the sensor and outnumbers the noise many times."""
    counts, path = noise(), still()
    for k in range(INTERVALS):
        columns = slice(10 * k, 10 * (k + 1))
        counts[k, 0, :30, columns] += 2
        path[(k + 1) * STEPS:, :30, columns] += 0.4
    quiet = quiet_events(chunk(counts, path), STEPS)
    naive = counts.sum((0, 2, 3)) / (SHAPE[0] * SHAPE[1] * 0.2)
    assert naive[0] > 5 * ETA[0]
    found = combined_rate(quiet, *UNKNOWN)
    np.testing.assert_allclose(found, ETA, rtol=0.2)
    # Events of the other polarity under the edge are noise, and are used.
    assert quiet[5, 1, 1] > 1.5 * quiet[5, 0, 1]


def test_a_slow_drift_is_seen_although_no_pixel_shows_it() -> None:
    path = still()
    path += np.linspace(0.0, 0.05, len(path), dtype=np.float32)[:, None, None]
    path += np.random.default_rng(1).normal(0, 0.005, path.shape).astype(np.float32)
    quiet = quiet_events(chunk(noise(), path), STEPS)
    limited = np.array([s.climb < 1.0 for s in STRATA])
    assert (quiet[limited, 0, 1] == 0).all()
    assert (quiet[limited, 1, 1] > 0).all()


def test_hot_and_dark_pixels_do_not_count() -> None:
    one = chunk(noise(), still())
    half = np.arange(SHAPE[1]) < SHAPE[1] // 2
    bright = np.broadcast_to(half, SHAPE)
    some = quiet_events(dataclasses.replace(one, bright=bright), STEPS)
    both = some + quiet_events(dataclasses.replace(one, bright=~bright), STEPS)
    np.testing.assert_allclose(both, quiet_events(one, STEPS), rtol=1e-6)


def test_without_data_the_network_is_believed() -> None:
    nothing = np.zeros((len(STRATA), 2, 2))
    prior, std = np.array([0.3, 0.05]), np.array([0.4, 0.4])
    np.testing.assert_allclose(stratum_rates(nothing, prior, std), np.tile(prior, (len(STRATA), 1)))
    np.testing.assert_allclose(combined_rate(nothing, prior, std), prior)
    assert (rate_error(nothing) > 1.0).all()


def test_the_tie_is_recognised() -> None:
    theta = np.array([0.2, 0.3])
    foretold, error = tied_rates(theta, 0.05 * theta, 0.7)
    np.testing.assert_allclose(foretold, 0.7 * np.asarray(noise_of_threshold(theta)), rtol=1e-6)
    higher, _ = tied_rates(theta * (1 - 1e-3), theta, 0.7)
    slope = np.log(higher / foretold) / 1e-3
    np.testing.assert_allclose(np.sqrt((0.05 * slope) ** 2 + 0.05**2), error, rtol=0.02)
    assert tied_probability(np.zeros(2), error) > 0.9
    assert tied_probability(np.array([0.0, 6 * error[1]]), error) < 0.01
    # Too wide an error says nothing: back to the odds before any data, or less.
    assert tied_probability(np.zeros(2), np.full(2, 3.0)) < 0.5


def test_rates_are_drawn_to_the_tie_only_where_they_may_follow_it() -> None:
    theta, std = np.array([0.2, 0.3]), np.array([0.004, 0.006])
    foretold, _ = tied_rates(theta, std, 0.7)
    wide, near = np.full(2, 0.3), np.log(foretold) + np.array([0.2, -0.2])
    drawn, drawn_std = with_tie(theta, std, near, wide, 0.7)
    assert (np.abs(drawn - np.log(foretold)) < 0.5 * np.abs(near - np.log(foretold))).all()
    assert (drawn_std < wide).all()
    far = np.log(foretold) + np.array([2.0, -1.0])
    kept, kept_std = with_tie(theta, std, far, wide, 0.7)
    np.testing.assert_allclose(kept, far, atol=1e-3)
    np.testing.assert_allclose(kept_std, wide, rtol=1e-2)
    # Where both are about as likely, the std says that it may be either.
    _, torn = with_tie(theta, std, np.log(foretold) + 0.55, np.full(2, 0.2), 0.7)
    assert (torn > 0.2).any()


@pytest.mark.parametrize("theta", [0.05, 0.1, 0.5, 1.0])
def test_tied_rates_are_finite(theta: float) -> None:
    rates, error = tied_rates(np.array([theta, theta]), np.array([0.01, 0.01]), 1.0)
    assert np.isfinite(rates).all()
    assert np.isfinite(error).all()
    assert (rates > 0).all()
